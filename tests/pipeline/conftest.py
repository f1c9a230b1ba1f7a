"""Fixtures that the tests of the pipeline share."""

import jaxtyping
import pytest


@pytest.fixture
def types_unchecked():
    """As outside tests: what is refused, the library itself refuses."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
