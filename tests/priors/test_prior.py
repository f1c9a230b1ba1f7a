"""Priors of one's own: what is checked of them before a solve."""

import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.errors import InputError
from scsr_opt.priors import Prior

SHAPE = (24, 32)


class L1(Prior):
    weight: float = 1.0

    def value(self, image):
        return self.weight * jnp.sum(jnp.abs(image))

    def prox(self, image, strength, state):
        return jnp.sign(image) * jnp.maximum(jnp.abs(image) - strength * self.weight, 0), state


class NoState(L1):
    def prox(self, image, strength, state):
        return image


class OtherState(L1):
    def prox(self, image, strength, state):
        return image, image


class Cropped(L1):
    def prox(self, image, strength, state):
        return image[1:], state


class Narrow(L1):
    def prox(self, image, strength, state):
        return super().prox(image, strength, state)[0].astype(jnp.float16), state


class NoStrength(L1):
    def prox(self, image, state):  # pyright: ignore[reportIncompatibleMethodOverride]
        return image, state


class Map(L1):
    def value(self, image):
        return jnp.abs(image)


class NumPy(L1):
    def value(self, image):
        return np.sum(np.abs(image))


def test_check_accepts_a_prior_of_one_s_own():
    L1(2.0).check(SHAPE)


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (NoState, r"NoState.prox must return a picture .* \(\(24, 32\), \(\)\), but it returns \(24, 32\)\."),
        (OtherState, r"it returns \(\(24, 32\), \(24, 32\)\)"),
        (Cropped, r"it returns \(\(23, 32\), \(\)\)"),
        (NoStrength, r"NoStrength.prox raised TypeError for a picture of shape \(24, 32\)"),
        (Narrow, r"Narrow.prox must return numbers of the types that it was given, \(float32, \(\)\), but .*float16"),
        (Map, r"Map.value must return one number, but it returns \(24, 32\)"),
        (NumPy, r"NumPy.value raised TracerArrayConversionError"),
    ],
)
def test_check_says_what_is_wrong_with_it(prior, message):
    with pytest.raises(InputError, match=message):
        prior().check(SHAPE)
