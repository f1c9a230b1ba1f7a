"""Fixtures: the programs that JAX compiles while a test runs, and programs that are not let go meanwhile."""

from collections.abc import Iterator
from typing import Any

import jax.monitoring
import pytest


@pytest.fixture(scope="module")
def heard() -> Iterator[list[str]]:
    """The names of the programs that JAX compiles."""
    names: list[str] = []
    listening = True

    def hear(event: str, duration_secs: float, **more: Any) -> None:
        if listening and event == "/jax/core/compile/backend_compile_duration":
            names.append(str(more.get("fun_name")))

    jax.monitoring.register_event_duration_secs_listener(hear)
    yield names
    listening = False  # JAX has no public way to stop listening


@pytest.fixture(scope="module")
def programs_stay() -> Iterator[None]:
    """However many programs the tests before have left, none is let go while tests count what is compiled anew."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scsr_opt._kernels.programs._MOST_MAPPINGS", 1_000_000)
        yield
