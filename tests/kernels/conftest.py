"""Fixture: the programs that JAX compiles while a test runs."""

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
