"""Values that a prior or a solver accepts as a number."""

import math

import numpy as np
import pytest

from scsr_opt._validation import finite


@pytest.mark.parametrize("given", ["1", b"1", None, [1.0, 2.0], 1 + 0j, math.inf, math.nan, 10**400])
def test_what_is_no_finite_number(given):
    assert math.isnan(finite(given))


@pytest.mark.parametrize("given", [2, 2.0, np.float32(2), np.int64(2)])
def test_numbers(given):
    assert finite(given) == 2.0
