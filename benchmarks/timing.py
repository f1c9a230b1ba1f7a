"""Measurements of time (in turns), of compiled programs and of memory, for all benchmarks."""

import contextlib
import ctypes
import gc
import re
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.experimental.compilation_cache import compilation_cache

from benchmarks.command import system_bytes

_KILOBYTE = 1024


class Spread(NamedTuple):
    """Median and quartiles of repeated measurements, in their unit."""

    low: float
    middle: float
    high: float


def spread(values: Any) -> Spread:
    """Median and quartiles of at least one number."""
    return Spread(*(float(v) for v in np.percentile(np.asarray(values, float), (25, 50, 75))))


def in_turns(calls: Mapping[Any, Callable[[], Any]], rounds: int) -> dict[Any, list[float]]:
    """Seconds of each call, `rounds` of each. All calls take turns, in an order that is drawn anew for each round (from
    a fixed seed): what else the machine does hits all alike, and none always follows the same one. They have to be
    compiled before."""
    names, taken, rng = list(calls), {name: [] for name in calls}, np.random.default_rng(0)
    for _ in range(rounds):
        for number in rng.permutation(len(names)):
            name = names[number]
            begin = time.perf_counter()
            jax.block_until_ready(calls[name]())
            taken[name].append(time.perf_counter() - begin)
    return taken


def ratios(some: Any, others: Any) -> Spread:
    """`some` over `others`, round by round, so that a slow moment of the machine is in both."""
    return spread(np.asarray(some) / np.asarray(others))


@contextlib.contextmanager
def compiling_anew() -> Iterator[None]:
    """Within it no program is taken from the cache folder of `scsr`, so that compiling takes what it takes."""
    before = jax.config.values["jax_enable_compilation_cache"]
    jax.config.update("jax_enable_compilation_cache", False)
    compilation_cache.reset_cache()  # whether there is one is looked up once otherwise
    try:
        yield
    finally:
        jax.config.update("jax_enable_compilation_cache", before)
        compilation_cache.reset_cache()


@contextlib.contextmanager
def compilations() -> Iterator[list[float]]:
    """Seconds of each compilation within it, those included that found their program in the cache folder."""
    found: list[float] = []

    def listen(event: str, duration_secs: float, **_: Any) -> None:
        if event.endswith("/backend_compile_duration"):
            found.append(duration_secs)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield found
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


class Program(NamedTuple):
    """A compiled function as XLA sees it.

    **Fields:** `flops` and `moved` (bytes that its operations read and write, one by one, intermediate results
    included), None where XLA does not count them; `fusions`: how many fused kernels it calls; `memory`:
    bytes of its arguments, results and temporary arrays together. `call()` runs it.

    The body of a loop is counted once.
    """

    flops: float | None
    moved: float | None
    fusions: int
    memory: int
    call: Callable[[], Any]


def program(function: Callable[..., Any], *arguments: Any) -> Program:
    """Compiles `function(*arguments)` as a function of the arrays among its arguments."""
    arrays, rest = eqx.partition(arguments, eqx.is_array)

    def pure(arrays: Any) -> list[jax.Array]:
        return jax.tree.leaves(eqx.filter(function(*eqx.combine(arrays, rest)), eqx.is_array))

    compiled = jax.jit(pure).lower(arrays).compile()
    costs, sizes = compiled.cost_analysis() or {}, compiled.memory_analysis()
    assert sizes is not None  # known of every program that is compiled for a CPU
    memory = sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes
    return Program(
        float(costs["flops"]) if costs.get("flops", -1) >= 0 else None,
        float(costs["bytes accessed"]) if costs.get("bytes accessed", -1) >= 0 else None,
        len(re.findall(r" fusion\(", compiled.as_text() or "")),
        int(memory - sizes.alias_size_in_bytes),
        lambda: compiled(arrays),
    )


class Peak:
    """The most memory that this process has held since the last `reset`, beyond what it held then, bytes; None where
    the system does not report it (elsewhere than on Linux). What the process keeps of memory that it no longer uses is
    handed back first, so that the next call takes longer: not one to be timed."""

    def __init__(self):
        self._before: int | None = None

    def reset(self) -> None:
        self._before = None
        with contextlib.suppress(OSError, AttributeError, TypeError):  # another system, or another C library
            gc.collect()
            ctypes.CDLL(None).malloc_trim(0)
            # Linux forgets the highest mark when 5 is written here.
            Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
            self._before = system_bytes("/proc/self/status", "VmRSS")

    def read(self) -> int | None:
        found = system_bytes("/proc/self/status", "VmHWM")
        return None if found is None or self._before is None else max(found - self._before, 0)


@contextlib.contextmanager
def keeping_memory() -> Iterator[None]:
    """Within it the process keeps what is freed, so that a kernel that runs again and again writes to memory that it
    has, as in a loop that is compiled whole. Memory that is new to a process is cleared by the system page by page,
    which takes as long as many a kernel. Without effect elsewhere than on Linux with glibc."""
    try:
        tune = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # another system, or another C library
        yield
        return
    # Kept, then nearly as it is by default: no mapping for a large array of its own; nothing trimmed; heaps of other
    # threads, of 64 MB, not given back where they are empty; one arena for new threads. (That glibc adapts its
    # thresholds is over for this process.)
    options = ((-4, 0, 65536), (-1, -1, 128 * _KILOBYTE), (-2, 65536 * _KILOBYTE, 128 * _KILOBYTE), (-8, 1, 0))
    for name, kept, _ in options:
        tune(name, kept)
    try:
        yield
    finally:
        for name, _, usual in options:
            tune(name, usual)


def memory_available() -> int | None:
    """Bytes that could be taken now; None where the system does not report it."""
    return system_bytes("/proc/meminfo", "MemAvailable")
