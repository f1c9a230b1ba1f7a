"""Derivatives of the solution against finite differences of it, in float64."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt import assemble
from scsr_opt.camera.scenes import Translation
from scsr_opt.camera.simulator import simulate
from scsr_opt.errors import InputError
from scsr_opt.motion import Motion
from scsr_opt.operators.aperture import Aperture
from scsr_opt.operators.blur import Blur
from scsr_opt.operators.data_term import DataTerm, Stencil
from scsr_opt.operators.exposure import ExposedStencil
from scsr_opt.priors import HuberTotalVariation, PlugAndPlay, RidgeRegulariser, TotalVariation
from scsr_opt.solvers import Problem, implicit_minimiser

SHAPE = (7, 9)
PRIORS = {
    "TV": TotalVariation(),
    "anisotropic TV": TotalVariation(isotropic=False),
    "Huber TV": HuberTotalVariation(knee=0.03),
    "ridge": RidgeRegulariser.load(),
}
# Both equations converge linearly, where TV is isotropic slowly: after 4,000 iterations its derivative is 1e-3 off.
ITERATIONS = 16000


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def problem(prior) -> Problem:
    """Two bright blocks seen with noise, each pixel by itself and with its neighbours."""
    rng = np.random.default_rng(3)
    picture = np.full(SHAPE, 0.2)
    picture[2:5, 2:6] = 0.8
    planes = np.zeros((5, *SHAPE))
    planes[0] = rng.uniform(0.6, 1.2, SHAPE)
    planes[1, :, :-1] = 0.1
    stencil = Stencil(jnp.asarray(planes))
    target = stencil(jnp.asarray(picture + 0.05 * rng.normal(size=SHAPE)))
    data = DataTerm(stencil, target, jnp.asarray(1.0), Aperture(SHAPE, 1), None)
    return Problem(data, prior, jnp.asarray(0.04))


def changed(problem: Problem, strength, target) -> Problem:
    return eqx.tree_at(lambda p: (p.strength, p.data.target), problem, (strength, target))


@pytest.mark.parametrize("name", PRIORS)
def test_derivatives_are_those_of_finite_differences(name):
    """By λ, and by c along a direction; and the picture is a minimiser."""
    base = problem(PRIORS[name])
    rng = np.random.default_rng(4)
    wanted, direction = (jnp.asarray(rng.normal(size=SHAPE)) for _ in range(2))
    start = jnp.full(SHAPE, 0.5)

    @jax.jit
    def loss(strength, target):
        image = implicit_minimiser(
            changed(base, strength, target), start, iterations=ITERATIONS, adjoint_iterations=ITERATIONS
        )
        return jnp.sum(wanted * image)

    at = (base.strength, base.data.target)
    by_strength, by_target = jax.grad(loss, argnums=(0, 1))(*at)
    # Central differences: an error of δ² times the third derivative, and of 1e-13/δ from rounding.
    δ = 1e-5
    for derivative, change in (
        (by_strength, (δ, 0 * direction)),
        (jnp.sum(by_target * direction), (0.0, δ * direction)),
    ):
        difference = loss(at[0] + change[0], at[1] + change[1]) - loss(at[0] - change[0], at[1] - change[1])
        assert float(derivative) == pytest.approx(float(difference) / (2 * δ), rel=1e-4, abs=1e-6)


def test_derivatives_by_m_and_by_the_lens():
    """In the same way, along a direction of all their numbers."""
    base = problem(PRIORS["Huber TV"])
    lens = Blur(SHAPE, np.array([[0.0, 0.1, 0.05], [0.1, 0.5, 0.1], [0.05, 0.1, 0.0]]))
    base = eqx.tree_at(lambda p: p.data.optics, base, lens, is_leaf=lambda leaf: leaf is None)
    rng = np.random.default_rng(6)
    wanted = jnp.asarray(rng.normal(size=SHAPE))
    planes, kernel = base.data.stencil.planes, lens.kernels[0]
    # Where a plane is 0 it couples with what is outside the picture.
    directions = (
        jnp.asarray(np.where(planes != 0, rng.normal(size=planes.shape), 0)),
        jnp.asarray(rng.normal(size=kernel.shape)),
    )

    @jax.jit
    def loss(along_planes, along_kernel):
        numbers = (planes + along_planes * directions[0], kernel + along_kernel * directions[1])
        moved = eqx.tree_at(lambda p: (p.data.stencil.planes, p.data.optics.kernels[0]), base, numbers)
        start = jnp.full(SHAPE, 0.5)
        return jnp.sum(wanted * implicit_minimiser(moved, start, iterations=ITERATIONS, adjoint_iterations=ITERATIONS))

    δ = 1e-5
    for number, derivative in enumerate(jax.grad(loss, argnums=(0, 1))(0.0, 0.0)):
        step = [0.0, 0.0]
        step[number] = δ
        difference = loss(*step) - loss(*(-one for one in step))
        assert float(derivative) == pytest.approx(float(difference) / (2 * δ), rel=1e-4, abs=1e-6)


def test_the_solution_is_the_minimiser():
    """No nearby picture is better, by more than the rest of the iterations."""
    base = problem(TotalVariation())
    image = implicit_minimiser(base, jnp.full(SHAPE, 0.5), iterations=ITERATIONS)

    def objective(image):
        return float(base.data.value(image) + base.strength * base.prior.value(image))

    rng = np.random.default_rng(5)
    for size in (1e-1, 1e-2, 1e-3):
        other = image + size * jnp.asarray(rng.normal(size=SHAPE))
        assert objective(other) > objective(image)
    # Where total variation wins everywhere, the mean fits best what M and c say of a constant picture.
    flat = implicit_minimiser(changed(base, jnp.asarray(10.0), base.data.target), image, iterations=ITERATIONS)
    level = float(jnp.sum(base.data.target) / jnp.sum(base.data.normal(jnp.ones(SHAPE))))
    np.testing.assert_allclose(flat, level, atol=1e-6)


def test_the_start_has_no_influence():
    base = problem(HuberTotalVariation(knee=0.03))
    gradient = jax.grad(
        lambda image: jnp.sum(implicit_minimiser(base, image, iterations=50, adjoint_iterations=50) ** 2)
    )
    np.testing.assert_array_equal(gradient(jnp.full(SHAPE, 0.5)), 0)


def test_without_samples_derivatives_are_finite():
    """All pixels bad: f is 0, and the picture is what the prior makes of its start."""
    base = problem(TotalVariation())
    start = jnp.asarray(np.random.default_rng(6).normal(size=SHAPE))
    nothing = eqx.tree_at(lambda p: p.data.stencil.planes, base, jnp.zeros_like(base.data.stencil.planes))

    def loss(strength, target):
        image = implicit_minimiser(changed(nothing, strength, target), start, iterations=100, adjoint_iterations=100)
        return jnp.sum(start * image)

    for derivative in jax.grad(loss, argnums=(0, 1))(base.strength, jnp.zeros(SHAPE)):
        assert np.isfinite(derivative).all()


def test_implicit_minimiser_of_an_assembled_moving_scene_is_differentiated_by_strength_and_samples():
    """Exposures during which the scene moves are part of the problem, with integers for where the samples lie."""
    picture = np.clip(np.add.outer(np.sin(np.arange(20) / 2), np.cos(np.arange(24) / 3)) / 4 + 0.5, 0, 1)
    with jax.enable_x64(False):
        made = simulate(Translation(picture, velocity=(0.3, 0.4)), scale=2, frames=60, seed=1)
        moving = assemble(
            made.spikes, scale=2, motion=Motion.constant((0.15, 0.2), (10, 12)), strength=0.02, prior=PRIORS["Huber TV"]
        )
    assert isinstance(moving.data.stencil, ExposedStencil)
    base = jax.tree.map(lambda leaf: leaf.astype(float) if eqx.is_inexact_array(leaf) else leaf, moving)
    wanted, direction = (jnp.asarray(np.random.default_rng(n).normal(size=picture.shape)) for n in (4, 5))

    @jax.jit
    def loss(strength, along):
        target = base.data.target + along * direction
        image = implicit_minimiser(changed(base, strength, target), base.start, iterations=800, adjoint_iterations=800)
        return jnp.sum(wanted * image)

    at = base.strength, jnp.asarray(0.0)
    for number, (found, step) in enumerate(zip(jax.grad(loss, argnums=(0, 1))(*at), (1e-5, 1e-6), strict=True)):
        more, less = (loss(*(of + side * step * (n == number) for n, of in enumerate(at))) for side in (1, -1))
        np.testing.assert_allclose(found, (more - less) / (2 * step), rtol=2e-3)


def test_what_it_cannot_differentiate_is_refused():
    with pytest.raises(InputError, match="PlugAndPlay; it needs an Analysis prior"):
        implicit_minimiser(problem(PlugAndPlay(lambda image, σ: image)), jnp.zeros(SHAPE))
    with pytest.raises(InputError, match="0 adjoint_iterations"):
        implicit_minimiser(problem(TotalVariation()), jnp.zeros(SHAPE), adjoint_iterations=0)
