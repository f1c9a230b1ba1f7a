"""Programs are let go where they take too much room, and nothing else is."""

import gc
import importlib
import pkgutil
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt._kernels import programs
from scsr_opt.operators import Blur, norm_bound
from scsr_opt.priors import HuberTotalVariation, TotalVariation


@pytest.fixture
def room(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A room of its own, empty."""
    monkeypatch.setattr(programs, "_room", programs._Room())
    return programs


def denoised(shape: tuple[int, int]) -> jax.Array:
    prior, picture = TotalVariation(), np.ones(shape, np.float32)
    picture[0, 0] = 2
    return prior.prox(jnp.asarray(picture), 0.1, prior.initial_state(jnp.asarray(picture)))[0]


@jax.jit
def somebodys(x: jax.Array) -> jax.Array:
    return jnp.sum(x**2) + x


@eqx.filter_jit
def somebodys_filtered(x: jax.Array) -> jax.Array:
    return TotalVariation().value(x) + x


def test_let_go_drops_the_librarys_programs_and_no_others(heard):
    image = jnp.ones((11, 13))
    denoised((11, 13))
    somebodys(image)
    somebodys_filtered(image)
    programs.let_go()
    heard.clear()
    somebodys(image)
    somebodys_filtered(image)
    assert not heard
    denoised((11, 13))
    assert heard


@pytest.mark.parametrize(
    "call",
    [
        lambda shape: HuberTotalVariation().value(jnp.ones(shape)),
        pytest.param(lambda shape: Blur.gaussian(shape, 1.0)(np.ones(shape, np.float32)), marks=pytest.mark.slow),
        pytest.param(lambda shape: norm_bound(Blur.gaussian(shape, 1.0)), marks=pytest.mark.slow),
        lambda shape: jnp.sum(jnp.ones(shape), axis=0) / 3,
    ],
    ids=["prior", "operator", "norm", "operations of JAX itself"],
)
@pytest.mark.skipif(not programs.mappings(), reason="this system does not tell how many mappings there are")
def test_many_shapes_take_bounded_room(room, monkeypatch, call: Callable[[tuple[int, int]], Any]):
    """Twelve shapes, of which two fill the room."""
    call((8, 9))
    programs.let_go()
    before = programs.mappings()
    for n in range(2):
        call((9, 9 + n))
    each = (programs.mappings() - before) / 2
    assert each > 0
    monkeypatch.setattr(programs, "_MOST_MAPPINGS", int(2 * each))
    for n in range(12):
        programs.ready()
        call((10 + n, 11))
    assert programs.mappings() - before < 6 * each


def test_programs_are_counted_where_mappings_are_not(room, monkeypatch, heard):
    monkeypatch.setattr(programs, "mappings", lambda: 0)
    monkeypatch.setattr(programs, "_MOST_MAPPINGS", 3 * programs._MAPPINGS_PER_PROGRAM)
    let_go, times = programs.let_go, []
    monkeypatch.setattr(programs, "let_go", lambda: (times.append(len(heard)), let_go()))
    heard.clear()
    for n in range(12):
        denoised((8, 20 + n))
    assert len(times) > 2 and max(np.diff([0, *times])) < 12


def test_shapes_that_return_compile_nothing(room, heard):
    for turn in range(5):
        if turn == 1:
            heard.clear()
        for width in (9, 10, 11):
            denoised((7, width))
    assert not heard


def test_ready_does_not_look_where_nothing_was_compiled(room, monkeypatch):
    denoised((7, 9))
    programs.ready()

    def looked() -> int:
        raise AssertionError("it looked")

    monkeypatch.setattr(programs, "mappings", looked)
    denoised((7, 9))
    programs.ready()


def test_programs_let_go_while_other_threads_compile_and_run():
    """Every result is right, whatever was let go meanwhile."""
    shapes = [(6 + n, 7 + n % 3) for n in range(4)]
    expected = [np.asarray(denoised(shape)) for shape in shapes]
    wrong: list[object] = []
    stop = threading.Event()

    def work(offset: int) -> None:
        for n in range(2 * len(shapes)):
            k = (n + offset) % len(shapes)
            try:
                if not np.array_equal(np.asarray(denoised(shapes[k])), expected[k]):
                    wrong.append(k)
            except Exception as error:
                wrong.append(error)

    def clear() -> None:
        while not stop.is_set():
            programs.let_go()
            time.sleep(0.05)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(2)]
    cleaner = threading.Thread(target=clear)
    for thread in (*threads, cleaner):
        thread.start()
    for thread in threads:
        thread.join()
    stop.set()
    cleaner.join()
    assert not wrong


@pytest.mark.parametrize("package", ["scsr_opt", "learned"])
def test_every_jitted_function_of_the_library_is_found(package):
    """Those of modules and classes, by another way than the one under test."""
    missed, jitted = [], 0
    for info in pkgutil.walk_packages(importlib.import_module(package).__path__, package + "."):
        if not info.name.endswith("__main__"):
            importlib.import_module(info.name)
    gc.collect()
    found = {id(program) for program in programs._programs()}
    for name in [name for name in sys.modules if name.split(".")[0] == package]:
        for key, value in vars(sys.modules[name]).items():
            members = vars(value).items() if isinstance(value, type) else [(key, value)]
            for member, thing in members:
                thing = getattr(thing, "method", thing)  # as Equinox keeps those of its modules
                program = getattr(thing, "_cached", thing)
                if hasattr(program, "clear_cache"):
                    jitted += 1
                    if id(program) not in found and str(getattr(thing, "__module__", "")).startswith(package):
                        missed.append(f"{name}.{key}.{member}")
    assert jitted > 5 and not missed


def test_instances_leave_tuples_alone_that_other_threads_fill():
    """Equinox's modules tell their class in Python, during which another thread may go on with a tuple."""
    kept = [eqx.nn.Identity() for _ in range(2000)]
    errors: list[SystemError] = []
    stop = threading.Event()

    def fill() -> None:
        while not stop.is_set():
            try:
                tuple(number for number in range(200))
            except SystemError as error:
                errors.append(error)

    threads = [threading.Thread(target=fill) for _ in range(3)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        for _ in range(10):
            assert len(programs._instances(eqx.nn.Identity)) == len(kept)
    finally:
        stop.set()
        sys.setswitchinterval(interval)
        for thread in threads:
            thread.join()
    assert not errors
