"""The unrolled iteration on what the spike encoder measures."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage import data

from learned.networks.spikesr import spikesr_loss
from learned.networks.unrolled_ista import iterate
from learned.networks.unrolled_ista_pase import SpikeInputs, UnrolledPASE, UnrolledPASEConfig, make_spike_inputs
from learned.training.registry import trainable
from scsr_opt.camera import simulate
from scsr_opt.camera.scenes import Translation
from scsr_opt.errors import InputError
from scsr_opt.motion.trajectory import Motion
from scsr_opt.pipeline.clip import Clip
from scsr_opt.priors import HuberTotalVariation
from scsr_opt.solvers import ISTA, Problem
from scsr_opt.solvers.problem import lipschitz_bound

SCALE, KEY, SENSOR = 2, 10, (12, 14)
SHAPE = (24, 28)
DRIFT = (0.05, -0.03)  # high-resolution pixels per frame
TINY = UnrolledPASEConfig(
    SCALE, stages=2, channels=8, blocks=1, boundaries=(4,), moments=3, length=5, spacing=6, branches=(1, 3),
    encoder_channels=4, encoder_blocks=1,
)  # fmt: skip


@pytest.fixture(scope="module")
def clip() -> Clip:
    still = data.camera()[100:164, 200:264].astype(np.float32) / 255
    seen = simulate(Translation(still, DRIFT, key=KEY), scale=SCALE, frames=21, seed=0)
    rows, columns = (slice(8, 8 + n) for n in SENSOR)
    return Clip(seen.spikes[:, rows, columns], KEY, 0.6, None)


@pytest.fixture(scope="module")
def truth() -> jax.Array:
    return jnp.asarray(data.camera()[116 : 116 + SHAPE[0], 216 : 216 + SHAPE[1]].astype(np.float32) / 255)


@pytest.fixture(scope="module")
def motion() -> Motion:
    velocity = np.broadcast_to(np.array(DRIFT, np.float32)[:, None, None] / SCALE, (2, *SENSOR))
    return Motion.of_velocity(velocity)


@pytest.fixture(scope="module")
def inputs(clip: Clip, motion: Motion) -> SpikeInputs:
    return make_spike_inputs(clip, scale=SCALE, config=TINY, motion=motion)


@pytest.fixture(scope="module")
def net() -> UnrolledPASE:
    return eqx.filter_jit(lambda: UnrolledPASE(TINY, key=jax.random.key(0, impl="unsafe_rbg")))()


def test_blocks_are_placed_at_their_middle_frames(inputs: SpikeInputs):
    """A pixel sees at τ what lies at p − v τ in the key frame; blocks lie at −6, 0 and 6."""
    rows, columns = np.divmod(np.asarray(inputs.index), SHAPE[1])
    row = (rows + np.asarray(inputs.down)).reshape(3, *SENSOR)
    column = (columns + np.asarray(inputs.right)).reshape(3, *SENSOR)
    seen = np.asarray(inputs.weight).reshape(3, *SENSOR) > 0
    for number, after in enumerate((-6, 0, 6)):
        wanted = SCALE * np.mgrid[: SENSOR[0], : SENSOR[1]] - after * np.array(DRIFT)[:, None, None]
        np.testing.assert_allclose(row[number][seen[number]], wanted[0][seen[number]], atol=1e-4)
        np.testing.assert_allclose(column[number][seen[number]], wanted[1][seen[number]], atol=1e-4)
        assert seen[number].mean() > 0.7
    np.testing.assert_array_equal(inputs.spikes.shape, (3, 5, *SENSOR))
    assert float(inputs.members[0].sum()) == 2 * SENSOR[0] * SENSOR[1]  # those that lie 6 frames away


def test_the_measurements_are_what_is_fitted(inputs: SpikeInputs, truth: jax.Array):
    """Blocks that measure exactly what the truth shows leave no gradient at it."""
    zero = inputs.measured_as(jnp.zeros((3, *SENSOR)), SCALE)
    blurred = zero.term.blurred(truth)
    flat, width = blurred.reshape(-1), SHAPE[1]
    down, right, at = inputs.down, inputs.right, inputs.index
    upper = (1 - right) * flat[at] + right * flat[at + 1]
    lower = (1 - right) * flat[at + width] + right * flat[at + width + 1]
    read = ((1 - down) * upper + down * lower).reshape(3, *SENSOR)
    for weight in (0.5, 1.0):
        fitted = inputs.measured_as(read, SCALE).weighted(jnp.asarray([weight]))
        # Rounding of sums of float32 values of the order of 1.
        np.testing.assert_allclose(fitted.gradient(truth), jnp.zeros(SHAPE), atol=1e-6)
        assert float(jnp.abs(zero.weighted(jnp.asarray([weight])).gradient(truth)).max()) > 1e-2


def test_without_networks_it_is_ista_to_the_last_bit(net: UnrolledPASE, inputs: SpikeInputs):
    plain = UnrolledPASE(dataclasses.replace(TINY, proximal=False), key=jax.random.key(0))
    term = inputs.measured_as(plain.encode(inputs), SCALE).term
    problem = Problem(term, HuberTotalVariation(), jnp.zeros(()))
    solver = ISTA()
    state, _ = solver.step(problem, solver.init(problem, inputs.image))
    found = plain(inputs)
    np.testing.assert_array_equal(found.gradient_steps[0], solver.gradient_step(problem, state))
    np.testing.assert_array_equal(found.images[0], solver.image(state))
    assert float(jnp.abs(found.images[0] - inputs.image).max()) > 0.01
    assert float(inputs.step_size) == float(1 / lipschitz_bound(term))


@eqx.filter_jit
def loss_and_slopes(net: UnrolledPASE, inputs: SpikeInputs, truth: jax.Array):
    return eqx.filter_value_and_grad(lambda n: spikesr_loss(n(inputs).images, truth))(net)


def test_gradients_are_finite_and_reach_every_parameter(net: UnrolledPASE, inputs: SpikeInputs, truth: jax.Array):
    slopes = loss_and_slopes(net, inputs, truth)[1]
    for path, slope in jax.tree_util.tree_leaves_with_path(eqx.filter(slopes, eqx.is_array)):
        assert np.all(np.isfinite(slope)) and np.any(slope != 0), jax.tree_util.keystr(path)
    assert sum("encoder" in jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(slopes)) == 8


def test_it_overfits_one_patch(net: UnrolledPASE, inputs: SpikeInputs, truth: jax.Array, overfitted):
    losses = overfitted(net, lambda net: loss_and_slopes(net, inputs, truth), 100)
    assert losses[-1] < 0.5 * losses[0]


def test_arrays_hold_all(net: UnrolledPASE, inputs: SpikeInputs):
    found = iterate(net, SpikeInputs.of_arrays(inputs.arrays())).images
    np.testing.assert_array_equal(found, iterate(net, inputs).images)


def test_batches_in_half_precision(net: UnrolledPASE, inputs: SpikeInputs, truth: jax.Array):
    """As the trainer has them: stacked, floats of pictures and places in float16; a mean of losses."""
    sizes = {name: getattr(TINY, name) for name in ("stages", "channels", "blocks", "moments", "length", "spacing")}
    sizes |= {"boundaries": [4], "branches": [1, 3], "encoder_channels": 4, "encoder_blocks": 1}
    task = trainable("unrolled_pase", SCALE, sizes)
    kept = inputs.arrays() | {"truth": truth}
    half = {k: v.astype(jnp.float16) if v.ndim and v.dtype == jnp.float32 else v for k, v in kept.items()}
    batch = jax.tree.map(lambda v: jnp.stack([v, v]), half)
    losses = eqx.filter_jit(lambda n: jax.vmap(lambda example: task.loss(n, example))(batch))(net)
    border = SCALE * (SENSOR[0] // 8)
    inner = slice(border, -border)
    wanted = spikesr_loss(net(inputs).images[:, inner, inner], truth[inner, inner])
    # Half precision keeps 11 bits of values below 1; the loss is a mean of differences of such values.
    np.testing.assert_allclose(losses, jnp.full(2, wanted), atol=1e-3)


def test_from_spikes(clip: Clip, motion: Motion):
    """As the trainer has it; at scale 1, and a recording that is too short."""
    sizes = {"stages": 1, "channels": 2, "blocks": 0, "moments": 3, "length": 5, "branches": [1], "encoder_channels": 2}
    task = trainable("unrolled_pase", 1, sizes)
    model = task.build(jax.random.key(0))
    spikes, rate = jnp.asarray(clip.spikes, jnp.uint8), jnp.asarray(0.6)
    found = task.picture(model, spikes, rate)
    assert found.shape == SENSOR and np.all(np.isfinite(found))
    with pytest.raises(InputError, match="has 4 frames and a spike block 5"):
        task.picture(model, spikes[:4], rate)
    with pytest.raises(InputError, match="encoder_channels is 0"):
        dataclasses.replace(TINY, encoder_channels=0)
