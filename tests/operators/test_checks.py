"""The dot test and the norms of operators: that they notice, and that their bounds hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.errors import InputError
from scsr_opt.operators.checks import dot_test, norm_bound, spectral_norm
from scsr_opt.operators.downsample import Downsample
from scsr_opt.operators.operator import LinearOperator
from scsr_opt.operators.warp import Warp


class Lopsided(LinearOperator):
    """An operator whose adjoint is wrong in one place."""

    @property
    def input_shape(self) -> tuple[int, ...]:
        return (20, 20)

    @property
    def output_shape(self) -> tuple[int, ...]:
        return (20, 20)

    def _forward(self, x):
        return 2 * x

    def _adjoint(self, y):
        return (2 * y).at[3, 4].set(0)


def test_dot_test_notices_a_single_wrong_value():
    found = dot_test(Lopsided())
    assert not found.passed
    assert found.error > 1e-4
    assert found.forward != found.backward
    assert dot_test(Lopsided(), rtol=1.0).passed


def test_nothing_at_all_has_norm_zero():
    with jax.enable_x64(True):
        nothing = Warp(np.full((2, 6, 9), np.nan))
        found = dot_test(nothing, dtype=jnp.float64)
        assert found.passed and found.error == found.forward == found.backward == 0
        norm = spectral_norm(nothing, dtype=jnp.float64)
        assert norm.value == 0 and norm.upper == 0 and norm_bound(nothing, dtype=jnp.float64) == 0


def test_spectral_norm_of_a_function_and_how_it_ends():
    values = np.array([3.0, 2.9, 1.0, 0.5], np.float32)
    with pytest.raises(InputError, match="without a shape"):
        spectral_norm(lambda x: x * values)
    with pytest.raises(InputError, match="at least 1"):
        spectral_norm(Downsample((2, 2), 1), iterations=0)
    with pytest.raises(InputError, match="for an operator that takes"):
        spectral_norm(Downsample((2, 2), 1), (3, 3))
    with pytest.raises(InputError, match="at least 1"):
        norm_bound(Downsample((2, 2), 1), iterations=0)
    found = spectral_norm(lambda x: x * jnp.asarray(values), (4,), iterations=500, rtol=1e-6)
    assert float(found.value) == pytest.approx(3, rel=1e-4)
    assert found.iterations < 500 and found.change <= 1e-6
    assert norm_bound(lambda x: x * jnp.asarray(values), (4,)) == 3


def test_spectral_norm_ends_on_what_is_not_a_number():
    found = spectral_norm(lambda x: x * jnp.nan, (4,), iterations=50)
    assert np.isnan(found.value) and found.iterations == 2


def test_upper_bound_holds_over_many_starts():
    # One large value among many that are so much smaller that four iterations do not find it yet.
    values = jnp.asarray(np.r_[1.0, np.full(299, 0.6)].astype(np.float32))

    @jax.jit
    def found(key):
        return spectral_norm(lambda x: values * x, (300,), iterations=4, rtol=0.0, key=key)

    many = jax.vmap(found)(jax.random.split(jax.random.key(5), 300))
    assert np.mean(np.asarray(many.value) < 0.9) > 0.5
    assert np.all(np.asarray(many.upper) >= 1)
    np.testing.assert_allclose(many.upper / many.value, (0.824 * 300**0.5 / 1e-3) ** (1 / 7), rtol=1e-5)
    assert np.all(np.asarray(many.value) <= 1 + 1e-6)
