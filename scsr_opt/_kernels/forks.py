"""Processes in which JAX would hang: those forked from one in which it had been started.

A fork takes along the memory of JAX's pool of threads, but none of the threads, so that the first program that is
compiled or run there waits for them for ever. This module imports no JAX: it is loaded with the package, before a
script can fork.
"""

import os
import sys

from scsr_opt.errors import InputError

_started = False
"""Whether JAX had been started when this process forked last."""
_orphaned = False
"""True in a process that was forked from one in which JAX had been started."""


def refuse_fork() -> None:
    """**Raises:** `InputError` in a process that was forked from one in which JAX had been started."""
    if _orphaned:
        raise InputError(
            "This process was forked from one in which JAX had been started, and would wait for ever for JAX's "
            'threads, which a forked process lacks; start it by multiprocessing.get_context("spawn") instead.'
        )


def _before() -> None:
    global _started
    bridge = sys.modules.get("jax._src.xla_bridge")  # nothing public tells without starting it
    _started = _orphaned or (bridge is not None and bridge.backends_are_initialized())


def _in_child() -> None:
    global _orphaned
    _orphaned = _started


if hasattr(os, "register_at_fork"):  # Windows knows no fork
    os.register_at_fork(before=_before, after_in_child=_in_child)
