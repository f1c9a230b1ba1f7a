"""Small pictures with their mirror images around them."""

import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from learned.networks.layers import LEAST_SIDE, continued

SIDES = st.integers(1, 2 * LEAST_SIDE)


@given(height=SIDES, width=SIDES, unit=st.integers(1, 4), dtype=st.sampled_from([np.uint8, np.float32]))
def test_continued_picture_of_any_size_lies_within_its_mirror_images(height, width, unit, dtype):
    """At the high resolution, too, around the same sensor pixels."""
    coarse = np.random.default_rng(0).integers(0, 100, (2, height, width)).astype(dtype)
    fine = np.repeat(np.repeat(coarse, unit, 1), unit, 2)
    (wide, (rows, columns)), (wide_fine, within) = continued(jnp.asarray(coarse)), continued(jnp.asarray(fine), unit)
    assert wide.shape == (2, max(height, LEAST_SIDE), max(width, LEAST_SIDE)) and wide.dtype == dtype
    border = [(side.start, length - side.stop) for side, length in zip((rows, columns), wide.shape[1:], strict=True)]
    np.testing.assert_array_equal(wide, np.pad(coarse, [(0, 0), *border], mode="symmetric"))
    np.testing.assert_array_equal(wide_fine, np.repeat(np.repeat(np.asarray(wide), unit, 1), unit, 2))
    np.testing.assert_array_equal(wide_fine[:, *within], fine)


def test_continued_picture_that_is_large_enough_is_left_as_it_is():
    picture = jnp.zeros((3, LEAST_SIDE, 40))
    assert continued(picture)[0] is picture
