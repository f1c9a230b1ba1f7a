"""Bound on the compiled programs of a process, for its memory and for the kernel's limit of memory mappings.

XLA compiles a program for each shape, and JAX keeps all of them. Sixty programs of one size of sensor took 100 MB and
1,750 memory mappings, of which Linux lets a process have 65,530 (`vm.max_map_count`) before it ends it. Functions that
a user calls therefore run `ready` first, which releases all programs once they take too much room: those of this
library and of JAX's own functions, never those of functions that somebody else has jitted. They are compiled again when
they are needed. Where nothing has been compiled since the last check, the check costs nothing.

A program that is running, or being compiled by another thread, is held by that thread: only the references to it in
caches are dropped.
"""

import functools
import gc
import itertools
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.monitoring
import jax.numpy as jnp

from scsr_opt._kernels.device import check_device
from scsr_opt._kernels.forks import refuse_fork
from scsr_opt._kernels.kept import keep_programs
from scsr_opt._kernels.memory import give_memory_back

P = ParamSpec("P")
T = TypeVar("T")

# A fifth of Linux's limit: the programs of seven sizes of sensor, so that whoever alternates between a few never
# compiles again, and several times as much room for the programs of others.
_MOST_MAPPINGS = 12_000
# Mappings of a program, in the mean of those of a `reconstruct`. For systems that do not tell how many there are, and
# for accelerators, whose programs take room elsewhere.
_MAPPINGS_PER_PROGRAM = 30
_COMPILED_EVENT = "/jax/core/compile/backend_compile_duration"
# Whose programs are let go: JAX's own are those of operations outside `jit`, one for each shape.
_OWNERS = ("scsr_opt", "learned", "jax")


class _Room:
    """Room that compiled programs have taken since they were let go last."""

    def __init__(self):
        self.lock = threading.Lock()
        self.compiled = 0  # programs, by anybody
        self.looked_at = 0
        self.begin = 0
        self.floor = mappings()

    @property
    def full(self) -> bool:
        programs = _MAPPINGS_PER_PROGRAM * (self.compiled - self.begin)
        return max(programs, mappings() - self.floor) > _MOST_MAPPINGS


def mappings() -> int:
    """Memory mappings of this process; 0 where the system does not tell."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return 0


def ready() -> None:
    """To be called first by whatever compiles or runs programs and is called from outside.

    **Raises:** `InputError` in a forked process, where programs cannot be run (`scsr_opt._kernels.forks`), and where
    JAX finds no device (`scsr_opt._kernels.device`).
    """
    refuse_fork()
    check_device()
    keep_programs()
    if _room.compiled == _room.looked_at or not _room.lock.acquire(blocking=False):
        return
    try:
        _room.looked_at = _room.compiled
        if _room.full:
            let_go()
            _room.begin, _room.floor = _room.compiled, mappings()
    finally:
        _room.lock.release()


def let_go() -> None:
    """Drops the compiled programs of this library and of JAX's own functions, and gives their memory back."""
    for program in _programs():
        program.clear_cache()
    give_memory_back()


def compiled(function: Callable[P, T]) -> Callable[P, T]:
    """`function` compiled as by `eqx.filter_jit`, for what is called outside `jit` as well as within.

    A loop whose body is a closure is compiled anew at each call outside `jit`. Python numbers among the arguments, but
    for the first (the object of a method), are traced: other values compile nothing anew.
    """
    program: Any = eqx.filter_jit(function)

    @functools.wraps(function)
    def call(*given: P.args, **named: P.kwargs) -> T:
        ready()
        first, rest = given[:1], map(_traceable, given[1:])
        return program(*first, *rest, **{name: _traceable(value) for name, value in named.items()})

    return call


def _traceable(value: Any) -> Any:
    return jnp.asarray(value) if type(value) in (int, float) else value


_JITTED = type(jax.jit(lambda: None))
_FILTERED = type(eqx.filter_jit(lambda: None))


def _programs() -> Iterator[Any]:
    """The jitted functions of `_OWNERS`, wherever they are kept."""
    for program in _instances(_JITTED):
        if _is_own(program):
            yield program
    for program in _instances(_FILTERED):
        if _is_own(program.__wrapped__):
            yield program._cached  # Equinox offers no other way to it


def _instances(kind: type) -> list[Any]:
    """All objects of exactly this type, found without a step of Python in between.

    While there is a list of all objects, each has one reference more. A tuple that another thread is filling must not:
    CPython would end that thread's call with a SystemError. No other thread runs during a call of C, and none of the
    objects is asked for anything: `isinstance` would ask Equinox's modules for their class, in Python.
    """
    # Runs of objects of another type are replaced by nothing.
    nothing = dict.fromkeys(set(map(type, _everything())) - {kind}, ())
    found = list(itertools.chain.from_iterable(itertools.starmap(nothing.get, itertools.groupby(_everything(), type))))
    return [one for one in found if type(one) is kind]


def _everything() -> Iterator[Any]:
    """All objects; they are listed when the first is asked for."""
    return itertools.chain.from_iterable(itertools.islice(iter(gc.get_objects, None), 1))


def _is_own(function: Any) -> bool:
    return str(getattr(function, "__module__", "")).split(".")[0] in _OWNERS


def _count(event: str, duration_secs: float, **_: Any) -> None:
    if event == _COMPILED_EVENT:
        _room.compiled += 1


_room = _Room()
jax.monitoring.register_event_duration_secs_listener(_count)
