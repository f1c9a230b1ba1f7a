"""`check_prox`: whether a proximal step belongs to the value of its prior."""

import jax.numpy as jnp
import pytest

from scsr_opt import InputError
from scsr_opt.priors import (
    BilateralTotalVariation,
    HuberTotalVariation,
    Prior,
    TotalVariation,
    WaveletL1,
    check_prox,
)

STRENGTHS = [0.01, 0.1]


class Quadratic(Prior[None]):
    """Ψ(X) = ½‖X − level‖², whose proximal step is wrong by a factor, or not finite."""

    factor: float = 1.0
    level: float = 0.3

    def value(self, image):
        return jnp.sum((image - self.level) ** 2) / 2

    def prox(self, image, strength, state):
        weight = self.factor * strength
        return (image + weight * self.level) / (1 + weight), state


class Turned(Quadratic):
    """Rows and columns exchanged."""

    def prox(self, image, strength, state):
        return super().prox(image.T, strength, state)[0].T[::-1], state


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize(
    "prior",
    [
        Quadratic(),
        WaveletL1(),
        TotalVariation(iterations=500),
        HuberTotalVariation(iterations=500),
        BilateralTotalVariation(iterations=500),
    ],
    ids=lambda prior: type(prior).__name__,
)
def test_right_steps_pass(prior, strength):
    check_prox(prior, strength, tolerance=1e-4)


@pytest.mark.parametrize("strength", STRENGTHS)
@pytest.mark.parametrize("wrong", [Quadratic(factor=2.0), Quadratic(factor=0.5), Turned()], ids=str)
def test_wrong_steps_are_found(wrong, strength):
    with pytest.raises(InputError, match=r"prox does not give the minimum of strength · value\(X\)"):
        check_prox(wrong, strength)


@pytest.mark.parametrize(
    ("changes", "method"), [({"level": float("nan")}, "prox"), ({"level": float("inf")}, "prox")], ids=str
)
def test_numbers_that_are_not_finite_are_named(changes, method):
    with pytest.raises(InputError, match=f"Quadratic.{method} gives a number that is not finite"):
        check_prox(Quadratic(**changes), 0.1)


def test_a_value_that_is_not_finite_is_named():
    class Logarithm(Quadratic):
        def value(self, image):
            return jnp.sum(jnp.log(image - 2))

    with pytest.raises(InputError, match="Logarithm.value gives a number that is not finite"):
        check_prox(Logarithm(), 0.1)
