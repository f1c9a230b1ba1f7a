"""Solutions that a network restores, and the solve around it."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from learned.evaluation.compare import compare_stages
from learned.evaluation.reference_problem import reference_problem, reference_task
from learned.networks.restoration import (
    NetworkRestoration,
    RestorationConfig,
    RestorationNet,
    restoration_loss,
    restored,
)
from learned.training import checkpoint
from learned.training.data import Example
from learned.training.registry import trainable
from learned.zoo import Optimizer, best, model
from scsr_opt import InputError, Status, reconstruct, reconstruct_sequence
from scsr_opt.camera import Sensor, Translation, simulate
from scsr_opt.operators import Huber
from scsr_opt.pipeline.restoration import Solved
from scsr_opt.priors import HuberTotalVariation

SIZES: dict[str, Any] = {"channels": 3, "blocks": 1}
SEEING: dict[str, Any] = {**SIZES, "levels": 2, "folding": 2, "sees_data": True}


@functools.cache
def net(**sizes) -> RestorationNet:
    return RestorationNet(RestorationConfig(2, **(sizes or SIZES)), key=jax.random.key(0))


def solved(image, strength=1e-3) -> Solved:
    image = jnp.asarray(image, jnp.float32)
    return Solved(image, 0.1 * image[::-1], 0.1 + image[:, ::-1] ** 2, jnp.float32(strength))


def saved(path, network: RestorationNet):
    card = checkpoint.Card("restoration", {"scale": 2, "network": SIZES}, "none", 1, "none", {"psnr": 1.0})
    checkpoint.save(path, network, card)
    return str(path)


@pytest.fixture
def silent(tmp_path) -> Optimizer:
    """Its network changes nothing, so that the centre is the first solution."""
    still = eqx.tree_at(lambda n: (n.output.weight, n.output.bias), net(), replace_fn=jnp.zeros_like)
    found = model(saved(tmp_path / "still.scsr", still), 2)
    assert isinstance(found, Optimizer) and found.restoration is not None
    return found


@pytest.mark.parametrize("shape", [(8, 12), (9, 14), (3, 5)])
def test_any_size_of_picture(shape):
    """A picture whose size is no multiple of the folding is continued by its last row and column."""
    image = jnp.asarray(np.random.default_rng(0).random(shape), jnp.float32)
    found = restored(net(), solved(image))
    assert found.shape == shape
    assert restored(net(**SEEING), solved(image)).shape == shape
    whole = jnp.pad(image - image.mean(), ((0, -shape[0] % 4), (0, -shape[1] % 4)), mode="edge")
    expected = restored(net(), solved(whole - whole.mean())) - (whole - whole.mean())
    if whole.shape == shape:
        np.testing.assert_allclose(found - image, expected, atol=1e-5)
    else:  # the mean of the larger picture is another one: what is seen differs by a constant
        np.testing.assert_allclose(found - image, expected[: shape[0], : shape[1]], atol=0.05)


@pytest.mark.parametrize("strength", [0.0, 1e-30, 1e3])
def test_any_strength(strength):
    assert np.isfinite(restored(net(), solved(jnp.full((8, 8), 0.5), strength))).all()


def test_pixels_that_no_sample_sees():
    nothing = jnp.zeros((8, 8))
    assert np.isfinite(restored(net(**SEEING), Solved(nothing, nothing, nothing, jnp.float32(0)))).all()


@pytest.mark.parametrize("what", Solved._fields)
def test_the_picture_depends_on_all_that_the_network_sees(what):
    seen = solved(np.random.default_rng(0).random((8, 8)))
    other = seen._replace(**{what: 10 * seen.strength if what == "strength" else getattr(seen, what)[::-1]})
    changes = [restored(net(**SEEING), one) - one.image for one in (seen, other)]
    assert np.abs(changes[0] - changes[1]).max() > 1e-5


def test_it_does_not_see_how_bright_a_scene_is():
    seen = solved(np.random.default_rng(0).random((8, 8)))
    brighter = seen._replace(image=seen.image + 0.5)
    np.testing.assert_allclose(restored(net(), brighter), restored(net(), seen) + 0.5, atol=1e-6)


@pytest.mark.parametrize("views", [1, 2, 4])
def test_restored_is_the_mean_of_all_views(views):
    """The picture of a mirrored solution is then the mirrored picture, as far as there are views of it."""
    seen = solved(np.random.default_rng(0).random((8, 12)))
    alone = net(**SEEING)

    def turned(picture, axes):
        return jnp.flip(picture, axes)

    def mirrored(axes):
        return Solved(turned(seen.image, axes), turned(seen.change, axes), turned(seen.weight, axes), seen.strength)

    axes = [(), (0, 1), (1,), (0,)][:views]
    expected = jnp.mean(jnp.stack([turned(alone(mirrored(one)), one) for one in axes]), axis=0)
    several = net(**SEEING, views=views)
    found = restored(several, seen)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    for one in axes:
        np.testing.assert_allclose(turned(restored(several, mirrored(one)), one), found, atol=1e-6)


@pytest.mark.parametrize("sizes", [SIZES, SEEING])
def test_gradients_of_all_weights(sizes):
    image, truth = (jnp.asarray(np.random.default_rng(seed).random((8, 8)), jnp.float32) for seed in (0, 1))
    slopes = eqx.filter_grad(lambda n: restoration_loss(n(solved(image)), truth, 1))(net(**sizes))
    for slope in jax.tree.leaves(slopes):
        assert np.isfinite(slope).all() and np.abs(slope).max() > 0


def test_every_scene_counts_by_its_decibels():
    truth = jnp.zeros((8, 8))
    losses = [float(restoration_loss(truth + error, truth, 0)) for error in (0.4, 0.2, 0.1)]
    assert losses[0] - losses[1] == pytest.approx(np.log(4), abs=1e-3)
    assert losses[1] - losses[2] == pytest.approx(np.log(4), abs=1e-2)
    framed = truth.at[0].set(9.0).at[:, -1].set(9.0)
    assert float(restoration_loss(framed, truth, 1)) == float(restoration_loss(truth, truth, 1))


def test_examples_are_solutions(recording, silent):
    task = trainable("restoration", 2, SIZES)
    assert task.preparation is not None
    spikes = recording.spikes
    made = task.preparation.make(
        Example(spikes, np.zeros((40, 48), np.float32), np.float32(0.6), np.zeros((2, 20, 24)))
    )
    first = reconstruct(recording, scale=2)
    np.testing.assert_array_equal(made["image"], first.image)
    assert made["strength"] == np.float32(first.diagnostics.strength)
    still = silent.restoration.net
    np.testing.assert_array_equal(task.picture(still, jnp.asarray(spikes), jnp.float32(0.6)), first.image)
    np.testing.assert_array_equal(task.preparation.picture(still, made), first.image)
    assert np.isfinite(task.loss(net(), jax.tree.map(jnp.asarray, made)))
    dark = task.preparation.make(Example(np.zeros_like(spikes), made["truth"], np.float32(0.6), np.zeros((2, 20, 24))))
    assert np.isfinite(task.loss(net(), jax.tree.map(jnp.asarray, dark)))


def test_examples_are_turned_as_they_are_drawn():
    """Picture and truth alike, all eight ways, and the same ones for the same chance."""
    preparation = trainable("restoration", 2, SIZES).preparation
    assert preparation is not None and preparation.varied is not None
    varied = preparation.varied
    image = np.arange(9.0).reshape(3, 3)
    made = {"image": image, "truth": image + 1, "strength": np.float32(0.5)}
    rng, again = (np.random.default_rng(0) for _ in range(2))
    drawn = [varied(made, rng) for _ in range(60)]
    assert len({one["image"].tobytes() for one in drawn}) == 8
    for one, same in zip(drawn, (varied(made, again) for _ in drawn), strict=True):
        np.testing.assert_array_equal(one["truth"], one["image"] + 1)
        np.testing.assert_array_equal(one["image"], same["image"])
        assert one["strength"] == np.float32(0.5)


def test_a_second_solve_about_the_first_solution(recording, silent):
    λ = 1e-3  # one that is given, so that held-out samples are not asked whether to restore
    first, found = (of(recording, scale=2, strength=λ) for of in (model("ridge", 2), silent))
    assert found.status is Status.converged
    count = found.diagnostics.first_iterations
    assert count is not None
    assert count == first.diagnostics.iterations and found.diagnostics.iterations == len(found.stages) > count
    assert [stage.number for stage in found.stages] == list(range(1, len(found.stages) + 1))
    assert {"solving", "restoring"} <= set(found.diagnostics.seconds)
    assert found.diagnostics.strength == first.diagnostics.strength
    assert found.diagnostics.strength is not None
    assert found.diagnostics.centred_strength == pytest.approx(2 * found.diagnostics.strength)
    assert (found.diagnostics.quality, first.diagnostics.quality) == ("best", "fast")
    assert found.diagnostics.restored_deviations is None  # a strength was given
    assert found.diagnostics.prior == first.diagnostics.prior == "RidgeRegulariser"
    # What was held back by the prior is not paid for twice: the picture comes nearer to the data.
    assert found.diagnostics.misfit_ratio == found.stages[-1].data / found.stages[count - 1].data < 1
    assert any(line.startswith("Quality: best") for line in found.report().lines())
    assert not any(line.startswith("Quality") for line in first.report().lines())
    # The objective falls but for rounding: f is the small difference of two sums over n pixels as large as ½ e, each a
    # walk of n roundings with a standard deviation of √n/6 last digits, three of which are allowed.
    # It begins with the data term at the first solution.
    objectives = np.array([stage.objective for stage in found.stages[count:]])
    plain = reference_problem(reference_task(recording, scale=2)).plain
    rounding = 0.5 * plain.target.size**0.5 * float(np.spacing(np.float32(0.5 * plain.energy)))
    assert rounding < 1e-3 * objectives[0]
    assert objectives[0] <= first.stages[-1].data + rounding
    assert (np.diff(objectives) <= rounding).all()


def test_what_the_network_says_comes_through(recording, silent, tmp_path):
    """Bars as wide as a sensor pixel, which the data contradict, stay in part: network and data both count."""
    louder = eqx.tree_at(
        lambda n: n.output.bias,
        silent.restoration.net,
        0.4 * jnp.tile(jnp.array([1.0, 1.0, -1.0, -1.0]), 4)[:, None, None],
    )
    other = model(saved(tmp_path / "louder.scsr", louder), 2)
    # With a strength that is given, held-out samples are not asked.
    before, after = (of(recording, scale=2, strength=1e-3).image for of in (silent, other))
    along = np.asarray(restored(louder, solved(before))) - before
    share = float(np.sum((after - before) * along) / np.sum(along**2))
    assert 0.02 < share < 0.9


def test_it_can_be_compared(recording, silent):
    found = compare_stages(recording, ["ridge", silent], scale=2)
    ridge, both = found.models
    assert [ridge.name, both.name] == ["ridge", silent.name]
    # The stages of both solves, with the time of all of them.
    assert len(both.stages) > len(ridge.stages)
    for stage, same in zip(ridge.stages, both.stages, strict=False):
        assert stage.objective == pytest.approx(same.objective)
    assert both.stages[-1].seconds > both.stages[len(ridge.stages) - 1].seconds > 0
    start = np.zeros((40, 48), np.float32)
    usual, other = silent(recording, scale=2).image, silent(recording, scale=2, start=start).image
    # Of the whole picture, as the tolerance is: 1e-4 a step, and up to a hundred to go. Single pixels of the border,
    # which little is seen of, differ by more.
    assert np.linalg.norm(other - usual) < 0.01 * np.linalg.norm(usual)


def test_nothing_seen(silent):
    found = silent(np.zeros((21, 8, 8), np.uint8), scale=2)
    assert found.status is Status.no_samples and not found.image.any()


def test_a_network_that_fails_is_said(recording, silent, tmp_path):
    wrong = eqx.tree_at(lambda n: n.output.bias, silent.restoration.net, replace_fn=lambda b: b + jnp.nan)
    found = model(saved(tmp_path / "wrong.scsr", wrong), 2)(recording, scale=2)
    assert found.status is Status.non_finite and np.isfinite(found.image).all()


def test_what_is_refused(recording, silent):
    with pytest.raises(InputError, match="still.scsr was trained for scale 2, but scale 3 is wanted"):
        silent(recording, scale=3)
    with pytest.raises(InputError, match="still.scsr was trained for scale 2, but scale 3 is wanted"):
        compare_stages(recording, [silent], scale=3)
    with pytest.raises(InputError, match="folding is 0; it must be at least 1"):
        RestorationConfig(2, folding=0)
    with pytest.raises(InputError, match="views is 3; it must be 1, 2 or 4"):
        RestorationConfig(2, views=3)
    with pytest.raises(
        InputError, match="network.depth is not known: allowed are blocks, channels, contrast, folding, "
    ):
        trainable("restoration", 2, {"depth": 3})


def test_a_restoration_that_predicts_worse_is_not_used(recording, silent):
    """Bars as wide as a sensor pixel, which the data contradict; and the truth, which they do not."""

    class Told:
        strength_ratio = 2.0

        def __init__(self, change):
            self._change = change

        def __call__(self, solved):
            rows, columns = solved.image.shape
            return solved.image + self._change[:rows, :columns]

    bars = np.tile(np.repeat([0.2, -0.2], 2)[:, None], (10, 48)).astype(np.float32)
    usual = reconstruct(recording, scale=2)
    wrong = reconstruct(recording, scale=2, quality=Told(bars))
    assert wrong.diagnostics.restored is False and wrong.diagnostics.first_iterations is None
    assert wrong.diagnostics.restored_deviations is not None and wrong.diagnostics.restored_deviations > 3
    np.testing.assert_array_equal(wrong.image, usual.image)
    assert any(line.startswith("Quality: fast") for line in wrong.report().lines())
    assert usual.diagnostics.restored is None


@pytest.mark.parametrize("scale", [2, 4])
def test_a_restoration_that_predicts_better_is_used(scale):
    """The truth, of a pan in dim light."""
    from skimage import data

    scene = Translation(data.camera()[100:, 150:][: 24 * scale, : 32 * scale] / 255, (0.0, 0.1 * scale), key=30)
    recorded = simulate(scene, scale=scale, frames=61, sensor=Sensor(0.3, 50.0), seed=1)

    class Truth:
        strength_ratio = 2.0

        def __call__(self, solved):
            return jnp.asarray(recorded.truth(30), jnp.float32)

    usual, found = (
        reconstruct(recorded.spikes, scale=scale, white_rate=0.3, quality=quality) for quality in ("fast", Truth())
    )
    assert found.diagnostics.restored is True
    errors = [float(np.mean((one.image - recorded.truth(30)) ** 2)) for one in (usual, found)]
    assert errors[1] < 0.5 * errors[0]


def test_a_sequence_carries_on_what_was_decided(recording):
    """Of its first picture: the strength of the usual prior is not used with another one."""

    class Wrong:
        strength_ratio = 2.0

        def __call__(self, solved):
            return solved.image + jnp.where(jnp.arange(len(solved.image))[:, None] % 8 < 4, 0.2, -0.2)

    options: dict[str, Any] = {"scale": 4, "frames": 21}
    found = list(reconstruct_sequence(recording, (18, 20), quality=Wrong(), **options))
    usual = list(reconstruct_sequence(recording, (18, 20), **options))
    for one, same in zip(found, usual, strict=True):
        assert one.diagnostics.motion_carried == same.diagnostics.motion_carried
        np.testing.assert_array_equal(one.image, same.image)


def test_quality_takes_a_restoration_of_ones_own(recording):
    """Any prior may be centred; the picture of "best" is that of the shipped network."""

    class Lighter:
        strength_ratio = 1.0

        def __call__(self, solved):
            return solved.image + 0.25

    usual = reconstruct(recording, scale=2, prior=HuberTotalVariation())
    lighter = reconstruct(recording, scale=2, prior=HuberTotalVariation(), quality=Lighter())
    # A constant costs nothing by the prior: the data alone decide it.
    assert lighter.status is Status.converged
    assert abs(float(np.mean(lighter.image - usual.image))) < 0.01
    found, same = (reconstruct(recording, scale=4, strength=1e-3, quality=of) for of in ("best", best(4)))
    np.testing.assert_array_equal(found.image, same.image)
    assert found.diagnostics.first_iterations and isinstance(best(4), NetworkRestoration)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"quality": "good"}, "quality is 'good'; it must be 'fast', 'best' or a Restoration"),
        ({"quality": "best", "robust": Huber()}, "quality is 'best' and robust is Huber"),
        ({"quality": "best", "prior": HuberTotalVariation()}, "quality is 'best' and the prior is HuberTotalVariation"),
    ],
)
def test_quality_that_cannot_be(recording, options, message):
    with pytest.raises(InputError, match=message):
        reconstruct(recording, **{"scale": 4, **options})


def test_best_takes_the_network_of_the_next_smaller_scale():
    assert [best(scale).net.config.scale for scale in (1, 2, 3, 4, 7)] == [1, 2, 2, 4, 4]
    assert best(3) == best(2)
