"""The unrolled iteration: the tie to the solver, what is learned in it, and what it is given."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage import data

from learned.networks.inputs import Inputs, make_inputs
from learned.networks.spikesr import parameter_count, spikesr_loss
from learned.networks.unrolled_ista import ProxOf, UnrolledConfig, UnrolledISTA, iterate
from learned.training.registry import trainable
from scsr_opt.camera import Sensor, simulate
from scsr_opt.camera.sampling_rules import Intervals
from scsr_opt.camera.scenes import Translation
from scsr_opt.errors import InputError
from scsr_opt.motion.trajectory import Motion
from scsr_opt.operators import accumulate
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.measurement import measure
from scsr_opt.priors import HuberTotalVariation
from scsr_opt.solvers import ISTA, Problem

SCALE, KEY, SENSOR = 2, 10, (12, 14)
SHAPE = (24, 28)
TINY = UnrolledConfig(SCALE, stages=2, channels=8, blocks=1, boundaries=(4,))


class Case(NamedTuple):
    clip: Clip
    motion: Motion
    truth: jax.Array
    inputs: Inputs


def recorded(
    drift: tuple[float, float], boundaries: tuple[int, ...], white_rate: float = 0.6, darkest: float = 0.0
) -> Case:
    """A photograph, made no darker than `darkest`, that moves by `drift` high-resolution pixels a frame, and its inputs
    from its true motion."""
    still = darkest + (1 - darkest) * data.camera()[100:164, 200:264].astype(np.float32) / 255
    seen = simulate(
        Translation(still, drift, key=KEY), scale=SCALE, frames=21, sensor=Sensor(white_rate=white_rate), seed=0
    )
    rows, columns = (slice(8, 8 + n) for n in SENSOR)
    truth = seen.truth(float(KEY))[16 : 16 + SHAPE[0], 16 : 16 + SHAPE[1]]
    clip = Clip(seen.spikes[:, rows, columns], KEY, white_rate, None)
    velocity = np.broadcast_to(np.array(drift, np.float32)[:, None, None] / SCALE, (2, *SENSOR))
    motion = Motion.of_velocity(velocity)
    inputs = make_inputs(clip, scale=SCALE, boundaries=boundaries, motion=motion)
    return Case(clip, motion, jnp.asarray(truth, jnp.float32), inputs)


@pytest.fixture(scope="module")
def case() -> Case:
    # Slow and bright enough for one position along every exposure.
    return recorded((0.02, -0.01), TINY.boundaries, darkest=0.2)


@pytest.fixture(scope="module")
def net() -> UnrolledISTA:
    return eqx.filter_jit(lambda: UnrolledISTA(TINY, key=jax.random.key(0, impl="unsafe_rbg")))()


def samples_of(case: Case):
    return measure(case.clip, case.motion, scale=SCALE, sampling=Intervals())


def steps_of_the_solver(problem: Problem, start: jax.Array, number: int) -> tuple[list[jax.Array], list[jax.Array]]:
    """R^(t) and X^(t) of ISTA, its proximal steps from the prior's first state each."""
    solver, steps, images = ISTA(), [], []
    state = solver.init(problem, start)
    for _ in range(number):
        state, _ = solver.step(problem, state)
        steps.append(solver.gradient_step(problem, state))
        images.append(solver.image(state))
        state = state._replace(prior=problem.prior.initial_state(start))
    return steps, images


@pytest.mark.parametrize("boundaries", [(), (2, 6)])
def test_without_networks_it_is_ista_to_the_last_bit(case: Case, boundaries: tuple[int, ...]):
    """T = 1, b = 1, all weights 1, N the identity: one step of the solver for a prior of strength 0. T = 3 without
    momentum: three."""
    inputs = make_inputs(case.clip, scale=SCALE, boundaries=boundaries, motion=case.motion)
    plain = accumulate(samples_of(case).placed)
    problem = Problem(plain, HuberTotalVariation(), jnp.zeros(()))
    steps, images = steps_of_the_solver(problem, inputs.image, 3)
    for stages in (1, 3):
        config = UnrolledConfig(SCALE, stages=stages, boundaries=boundaries, proximal=False)
        net = UnrolledISTA(config, key=jax.random.key(0))
        assert net.momenta.shape == (stages - 1,)
        found = eqx.tree_at(lambda n: n.momenta, net, jnp.zeros(stages - 1))(inputs)
        np.testing.assert_array_equal(found.gradient_steps, jnp.stack(steps[:stages]))
        np.testing.assert_array_equal(found.images, jnp.stack(images[:stages]))
    assert float(jnp.abs(images[0] - inputs.image).max()) > 0.01  # a step that goes somewhere


def test_with_the_proximal_step_of_a_prior_it_is_ista_with_that_prior(case: Case):
    prior, strength = HuberTotalVariation(iterations=3), jnp.asarray(0.02)
    problem = Problem(accumulate(samples_of(case).placed), prior, strength)
    steps, images = steps_of_the_solver(problem, case.inputs.image, 2)
    net = UnrolledISTA(dataclasses.replace(TINY, proximal=False), key=jax.random.key(0))
    net = eqx.tree_at(lambda n: (n.networks, n.momenta), net, ((ProxOf(prior, strength),) * 2, jnp.zeros(1)))
    found = net(case.inputs)
    np.testing.assert_array_equal(found.gradient_steps, jnp.stack(steps))
    np.testing.assert_array_equal(found.images, jnp.stack(images))
    assert float(jnp.abs(images[0] - steps[0]).max()) > 1e-3


def test_the_momentum_starts_as_that_of_fista(case: Case):
    """Without a prior, X^(3) follows from X^(1) and X^(2) by Nesterov's momentum."""
    config = UnrolledConfig(SCALE, stages=3, boundaries=TINY.boundaries, proximal=False)
    images = UnrolledISTA(config, key=jax.random.key(0))(case.inputs).images
    t = [1.0]
    for _ in range(3):
        t.append((1 + (1 + 4 * t[-1] ** 2) ** 0.5) / 2)
    ahead = images[1] + np.float32((t[2] - 1) / t[3]) * (images[1] - images[0])
    wanted = ahead - case.inputs.step_size * case.inputs.term.gradient(ahead)
    np.testing.assert_allclose(images[2], wanted, atol=1e-6)  # rounding of intensities near 1


def test_weights_are_those_of_the_samples(case: Case):
    """Weight 0 for the later samples is to be without them, weight 2 to have them twice."""
    taken = samples_of(case)
    away = np.abs((taken.padded.start + taken.padded.stop) / 2 - KEY)
    for weight in (0.0, 2.0):
        found = case.inputs.weighted(jnp.asarray([weight]))
        wanted = accumulate(taken.placed, robust=jnp.where(jnp.asarray(away) >= TINY.boundaries[0], weight, 1.0))
        # The sums of a few hundred float32 products of the order of 1, in another order.
        np.testing.assert_allclose(found.stencil.planes, wanted.stencil.planes, atol=1e-5)
        np.testing.assert_allclose(found.target, wanted.target, atol=1e-5)
    assert float(jnp.abs(case.inputs.targets).sum()) > 0.1 * float(case.inputs.term.target.sum())


def test_exposures_are_corrected_for():
    """Where the picture moves by pixels during them, the gradient at the truth is mostly due to the plain c."""
    case = recorded((0.5, -0.3), TINY.boundaries, white_rate=0.2)
    placed = samples_of(case).placed
    assert placed.finest > 1
    term, weight = case.inputs.term, placed.weight
    blurred = term.blurred(case.truth)
    exact = placed.spread(weight * (placed.read(blurred) - placed.value))
    wrong = [jnp.linalg.norm(term.stencil(blurred) - t.target - exact) for t in (term, accumulate(placed))]
    assert wrong[0] < 0.5 * wrong[1]
    near, far = (case.inputs.weighted(jnp.asarray([w])).target for w in (0.0, 2.0))
    np.testing.assert_allclose(near + far, 2 * term.target, atol=1e-5)


def test_each_stage_gives_pictures_and_starts_where_it_is_told(case: Case, net: UnrolledISTA):
    found = iterate(net, case.inputs)
    for iterates in found:
        assert iterates.shape == (TINY.stages, *SHAPE) and iterates.dtype == jnp.float32
    again = iterate(net, case.inputs, case.inputs.image)
    np.testing.assert_array_equal(again.images, found.images)
    other = iterate(net, case.inputs, case.inputs.image + 0.1)
    assert float(jnp.abs(other.gradient_steps[0] - found.gradient_steps[0]).mean()) > 0.01


def test_arrays_hold_all_that_counts(case: Case, net: UnrolledISTA):
    kept = case.inputs.arrays()
    found = iterate(net, Inputs.of_arrays(kept, SCALE)).images
    np.testing.assert_array_equal(found, iterate(net, case.inputs).images)
    half = {name: v.astype(jnp.float16) if v.ndim else v for name, v in kept.items()}
    # Intensities below 1, rounded at the 11th bit in planes, targets and start.
    np.testing.assert_allclose(iterate(net, Inputs.of_arrays(half, SCALE)).images, found, atol=4e-3)


@eqx.filter_jit
def loss_and_slopes(net: UnrolledISTA, inputs: Inputs, truth: jax.Array):
    return eqx.filter_value_and_grad(lambda n: spikesr_loss(n(inputs).images, truth))(net)


def test_gradients_are_finite_and_reach_every_parameter(case: Case, net: UnrolledISTA):
    slopes = loss_and_slopes(net, case.inputs, case.truth)[1]
    leaves = jax.tree_util.tree_leaves_with_path(eqx.filter(slopes, eqx.is_array))
    assert len(leaves) == 3 + TINY.stages * 2 * (
        2 + 2 * TINY.blocks
    )  # b, γ, weights; weight and bias of each convolution
    for path, slope in leaves:
        assert np.all(np.isfinite(slope)) and np.any(slope != 0), jax.tree_util.keystr(path)


def test_it_overfits_one_patch(net: UnrolledISTA, overfitted):
    case = recorded((0.02, -0.01), TINY.boundaries)
    losses = overfitted(net, lambda net: loss_and_slopes(net, case.inputs, case.truth), 200)
    assert losses[-1] < 0.5 * losses[0]


@pytest.mark.parametrize("scale", [1, 3])
def test_other_scales(scale: int):
    """Spikes to a picture, as the trainer has it, with the motion estimated."""
    task = trainable("unrolled", scale, {"stages": 1, "channels": 2, "blocks": 0})
    model = task.build(jax.random.key(0))
    spikes = np.random.default_rng(0).random((5, 6, 7)) < 0.4
    found = task.picture(model, jnp.asarray(spikes, jnp.uint8), jnp.asarray(0.5))
    assert found.shape == (6 * scale, 7 * scale) and np.all(np.isfinite(found))


def test_size():
    """The networks of the shipped configurations: as many parameters as the small SpikeSR-Net, or fewer."""
    assert 0.1e6 < parameter_count(UnrolledISTA(UnrolledConfig(), key=jax.random.key(0))) < 0.35e6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"stages": 0}, "stages is 0"),
        ({"channels": 0}, "channels is 0"),
        ({"folding": 3}, "folding is 3; it must divide the scale, 2"),
        ({"boundaries": (4, 4)}, r"boundaries is \(4, 4\)"),
        ({"boundaries": (0,)}, "must be above 0"),
    ],
)
def test_sizes_that_cannot_be(changes, message):
    with pytest.raises(InputError, match=message):
        dataclasses.replace(TINY, **changes)


def test_calls_that_cannot_be(case: Case, net: UnrolledISTA):
    other = make_inputs(case.clip, scale=SCALE, motion=case.motion)
    with pytest.raises(InputError, match="samples in 1 groups, but this network has weights for 2"):
        net(other)
    with pytest.raises(InputError, match=r"start has shape \(3, 3\)"):
        net(case.inputs, jnp.zeros((3, 3)))
