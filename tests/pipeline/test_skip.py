"""Shortcuts do not change the picture: scenes made to mislead them, each beside the full computation."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from skimage import data

from scsr_opt import Shortcuts, Solution, reconstruct
from scsr_opt.camera import Intervals, Sensor, Windows, simulate
from scsr_opt.camera.saturation import SATURATED_SHARE
from scsr_opt.camera.scenes import Box, MovingObject, Scene, Static, Translation
from scsr_opt.cli.demo_scene import psnr
from scsr_opt.errors import InputError
from scsr_opt.motion import Motion, estimate_motion
from scsr_opt.operators import Huber, Welsch
from scsr_opt.operators.sampling import accumulate
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.defaults import default_prior
from scsr_opt.pipeline.measurement import measure
from scsr_opt.pipeline.scene_summary import SampleWeights, SceneSummary, TileKind, summarise_scene
from scsr_opt.pipeline.settings import SceneSummarySettings
from scsr_opt.pipeline.updates import _some
from scsr_opt.report import scene_figure

SCALE, FRAMES, KEY = 2, 101, 50
ALL_WORK = Shortcuts.none()
WALL = data.gravel()[40:200, 60:220] / 255  # 80×80 sensor pixels
BRICK = data.brick()[:60, :60] / 255


class Changing(Scene):
    """A still scene whose light changes: `frame` gives it."""

    def __init__(self, picture: Callable[[float], np.ndarray]):
        self._picture, self.size, self.key = picture, WALL.shape, float(KEY)

    def frame(self, t):
        return self._picture(float(t))

    def velocity(self, t):
        return np.zeros((2, *self.size))


def faint() -> Scene:
    """An object that differs from the wall behind it by 2 %."""
    wall = 0.5 + 0.1 * (WALL - 0.5)
    texture = 0.5 + 0.02 * np.sign(BRICK - np.median(BRICK))
    return MovingObject(wall, texture, (0.2, 0.4), shape=Box(40.0, 40.0))


def appearing(t: float) -> np.ndarray:
    """Something bright lies there from the 51st frame on."""
    picture = WALL.copy()
    if t > KEY:
        picture[60:100, 60:100] = 0.2 + 0.7 * BRICK[:40, :40]
    return picture


SCENES = {
    "faint object": faint,
    "object smaller than a tile": lambda: MovingObject(WALL, BRICK, (0.2, 0.5), shape=Box(18.0, 18.0)),
    "flicker": lambda: Changing(lambda t: WALL * (0.9 + 0.1 * np.sin(2 * np.pi * t / 40))),
    "lamp at 100 Hz": lambda: Changing(lambda t: WALL * 0.66 * (1 + 0.2 * np.sin(2 * np.pi * (t - KEY) / 400))),
    "slow drift": lambda: Translation(WALL, velocity=(0.0, 0.01 * SCALE)),
    "object that appears": lambda: Changing(appearing),
    "hot pixel": lambda: Static(WALL),
}


RESTING = "flicker", "lamp at 100 Hz", "hot pixel"
# Tried by `make test-slow`: another of the same kind is left in `make test`.
LONGER = "faint object", "object smaller than a tile", "flicker", "slow drift", "hot pixel"


def all_of(name: str) -> tuple[Clip, np.ndarray, Solution, list[Solution]]:
    """The full computation, and two that skip: with a strength that is looked for, for which nothing is merged where
    something moves in so small a picture, and with that of the full one, where what is still is merged."""
    made = simulate(SCENES[name](), scale=SCALE, frames=FRAMES, sensor=Sensor(photons=1000.0), seed=5)
    spikes = np.array(made.spikes)
    if name == "hot pixel":
        spikes[:, 40, 40] = 1
    full = reconstruct(spikes, scale=SCALE, key=KEY, shortcuts=ALL_WORK)
    skipping = [reconstruct(spikes, scale=SCALE, key=KEY, strength=λ) for λ in (None, full.diagnostics.strength)]
    return Clip(spikes, KEY, 0.6, None), made.truth(KEY), full, skipping


def both(spikes: np.ndarray, scale: int, **options: Any) -> tuple[Solution, Solution]:
    """The full computation, and the one that leaves out what it may."""
    full, skipping = (
        reconstruct(spikes, scale=scale, key=KEY, shortcuts=shortcuts, **options)
        for shortcuts in (ALL_WORK, Shortcuts())
    )
    return full, skipping


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow if name in LONGER else ()) for name in SCENES]
)
def test_shortcuts_scene_that_tries_to_fool_them_loses_nothing(name):
    clip, truth, full, skipping = all_of(name)
    assert full.scene is None and full.status.usable and full.velocity is not None
    motion = Motion.of_velocity(np.asarray(full.velocity))
    every = accumulate(measure(clip, motion, scale=SCALE, sampling=Intervals(), merged_intervals=False).placed)
    strength, prior = full.diagnostics.strength, default_prior(SCALE)
    assert strength is not None

    def objective(solution: Solution) -> float:
        image = jnp.asarray(solution.image)
        return float(every.value(image) + strength * prior.value(image))

    side = SceneSummarySettings().tile_px * SCALE
    for solution in skipping:
        assert solution.scene is not None and solution.status.usable
        # The solve ends at a relative residual of 1e-4, which leaves far less than a tenth of these bounds.
        assert psnr(truth, solution.image, 8) > psnr(truth, full.image, 8) - 0.03
        change = (solution.image - full.image).reshape(160 // side, side, 160 // side, side).mean((1, 3))
        assert np.abs(change).max() < 1 / 255
        assert np.array_equal(full.velocity, np.asarray(solution.velocity))
        assert objective(solution) < objective(full) * 1.001
    if name in RESTING:  # both ways could be fooled
        assert not full.velocity.any()


@pytest.mark.parametrize(
    ("scale", "velocity", "wall"),
    [(2, (0.4, -0.4), "grass"), pytest.param(4, (1.05, -0.55), "gravel", marks=pytest.mark.slow)],
)
def test_shortcuts_few_positions_along_exposures_leave_a_pan_as_sharp(scale, velocity, wall):
    """Too few of them show in the strength: with two from 0.2 sensor pixels on instead of 0.1, and five from 1.2 on
    instead of 0.7, it was 7 and 3 % lower, and 0.09 and 0.03 dB were lost."""
    picture = getattr(data, wall)()[60:220, 60:220] / 255
    scene = Translation(picture, velocity=velocity)
    made = simulate(scene, scale=scale, frames=FRAMES, sensor=Sensor(photons=1000.0), seed=5)
    full, skipping = both(made.spikes, scale)
    assert skipping.diagnostics.samples == pytest.approx(full.diagnostics.samples, rel=0.01)
    assert skipping.diagnostics.strength == pytest.approx(full.diagnostics.strength, rel=0.02)
    truth, border = made.truth(KEY), 8 * scale
    assert psnr(truth, skipping.image, border) == pytest.approx(psnr(truth, full.image, border), abs=0.015)


def test_reconstruct_pan_towards_the_light_is_no_lamp():
    """Most pixels see a surface that gets brighter, by 29 % in all."""
    bright = data.gravel()[40:200, :400] / 255 * np.linspace(0.2, 1, 400)
    scene = Changing(lambda t: bright[:, 60 + int(t) : 220 + int(t)])
    made = simulate(scene, scale=SCALE, frames=FRAMES, sensor=Sensor(photons=1000.0), seed=6)
    solution = reconstruct(made.spikes, scale=SCALE, key=KEY)
    assert solution.scene is not None and solution.velocity is not None and solution.scene.scene == "one motion"
    # One high-resolution pixel per frame to the left.
    np.testing.assert_allclose(np.median(solution.velocity, axis=(1, 2)), (0, -1 / SCALE), atol=0.01)


@pytest.mark.slow  # tests/solvers/test_tiles.py has the iteration of tiles
def test_shortcuts_finished_tiles_beside_a_small_object_are_left_alone():
    """At ×4, where the default prior couples near pixels only: of 9 tiles 3 are gone on with."""
    wall, brick = data.gravel()[100:484, 60:444] / 255, data.brick()[:120, :120] / 255
    scene = MovingObject(wall, brick, (0.4, 1.0), shape=Box(36.0, 36.0))
    made = simulate(scene, scale=4, frames=FRAMES, sensor=Sensor(photons=1000.0), seed=5)
    full, skipping = both(made.spikes, 4)
    assert full.tiles is not None and skipping.tiles is not None
    further = skipping.tiles.tile_iterations
    assert not full.tiles.tile_iterations.any() and 0 < np.count_nonzero(further) < further.size
    truth, side = made.truth(KEY), SceneSummarySettings().tile_px * 4
    assert psnr(truth, skipping.image, 16) > psnr(truth, full.image, 16) - 0.03
    change = (skipping.image - full.image).reshape(384 // side, side, 384 // side, side).mean((1, 3))
    assert np.abs(change).max() < 1 / 255


@pytest.mark.slow  # tests/solvers/test_tiles.py has pictures of few tiles
def test_shortcuts_picture_of_few_tiles_is_iterated_as_a_whole():
    """They would all be finished once the whole picture is near its tolerance."""
    made = simulate(Translation(WALL, velocity=(0.5, 0.8)), scale=4, frames=FRAMES, sensor=Sensor(), seed=5)
    full, skipping = both(made.spikes, 4)
    assert skipping.tiles is not None and not skipping.tiles.tile_iterations.any()
    assert skipping.diagnostics.iterations == full.diagnostics.iterations


@pytest.mark.slow
def test_shortcuts_object_that_is_mostly_hidden_or_hides_is_no_rest():
    """Behind it and before it a sixth of the sensor contradicts any motion, nearly as much as contradicts rest."""
    wall, brick = data.gravel()[60:316, 60:316] / 255, data.brick()[:120, :120] / 255
    scene = MovingObject(wall, brick, (0.8, -1.0), shape=Box(80.0, 80.0))
    made = simulate(scene, scale=4, frames=FRAMES, sensor=Sensor(photons=1000.0), seed=11)
    full, skipping = both(made.spikes, 4)
    assert skipping.scene is not None and skipping.scene.scene == "2 layers"
    truth = made.truth(KEY)
    assert psnr(truth, skipping.image, 32) > psnr(truth, full.image, 32) - 0.03


def test_shortcuts_still_parts_are_merged_beside_what_moves():
    """Unless the strength is tried on the whole of so small a picture, for which intervals have to stay apart."""
    scene = MovingObject(WALL, BRICK, (0.4, 0.6), shape=Box(30.0, 30.0))
    spikes = simulate(scene, scale=SCALE, frames=FRAMES, sensor=Sensor(photons=1000.0), seed=1).spikes
    looked_for = reconstruct(spikes, scale=SCALE)
    λ = looked_for.diagnostics.strength
    full, given = both(spikes, SCALE, strength=λ)
    assert looked_for.scene is not None and given.scene is not None
    for summary, words in ((looked_for.scene, "are kept apart"), (given.scene, "merged into one measurement")):
        assert 0.3 < summary.share(TileKind.STATIC) + summary.share(TileKind.UNIFORM) < 1
        assert any("nothing moves" in line and words in line for line in summary.lines())
    # About half of the sensor rests, and an interval there lasts three frames.
    assert given.diagnostics.samples < 0.7 * looked_for.diagnostics.samples
    assert given.scene.samples == given.diagnostics.samples
    truth = scene.frame(KEY)
    assert psnr(truth, given.image, 8) > psnr(truth, full.image, 8) - 0.03


def test_the_pixels_that_tell_of_a_fixed_pattern_are_no_pattern():
    for shape in ((80, 80), (250, 400)):
        some = _some(np.ones(shape, bool), 400)
        assert some.sum() == 400
        # Of 400 by chance half lie in every second column: six standard deviations.
        assert abs(int(some[:, ::2].sum()) - 200) < 60 and abs(int(some[::2].sum()) - 200) < 60


def test_scene_summary_windows_of_what_rests_are_at_rest():
    spikes = simulate(Static(WALL), scale=SCALE, frames=FRAMES, seed=3).spikes
    scene = reconstruct(spikes, scale=SCALE, samples=Windows(7), strength=0.01).scene
    assert scene is not None and scene.share(TileKind.STATIC) + scene.share(TileKind.UNIFORM) == 1
    assert any("are kept apart" in line for line in scene.lines())


@pytest.mark.parametrize("loss", [Huber(), pytest.param(Welsch(), marks=pytest.mark.slow)])
def test_shortcuts_robust_loss_judges_the_same_intervals(loss):
    """A scene at rest loses light for 15 frames in a part of it; merged, these intervals would be one mean."""

    def dimmed(t: float) -> np.ndarray:
        picture = WALL.copy()
        if 30 <= t < 45:
            picture[60:100, 60:100] *= 0.2
        return picture

    spikes = simulate(Changing(dimmed), scale=SCALE, frames=FRAMES, sensor=Sensor(photons=1000.0), seed=2).spikes
    full, skipping = both(spikes, SCALE, motion=Motion.none(80, 80), strength=0.002, robust=loss)
    side = SceneSummarySettings().tile_px * SCALE
    change = (skipping.image - full.image).reshape(160 // side, side, 160 // side, side).mean((1, 3))
    assert np.abs(change).max() < 1 / 255


def test_scene_summary_recording_that_shows_nothing_is_dark():
    solution = reconstruct(np.zeros((20, 20, 30), np.uint8), scale=SCALE)
    assert not solution.status.usable and solution.scene is not None
    assert solution.scene.numbers["samples"] == 600 and solution.scene.numbers["tiles"]["dark"] == 1


def test_what_is_in_no_layer_is_not_taken_for_still():
    """A small object that no layer is found for: what it covered counts less, as the recording contradicts rest there.
    Measured (128×128 high-resolution pixels): 30.28 dB, 28.51 where all that was seen at rest counted in full."""
    coins = data.coins()[:128, :128] / 255
    scene = MovingObject(coins, data.astronaut().mean(2)[:14, :14] / 255, (0.1, 0.3), key=KEY)
    made = simulate(scene, scale=SCALE, frames=FRAMES)
    found = estimate_motion(made.spikes, key=KEY)
    assert found.trust is not None and not found.velocity.any()
    share = found.trust.share[np.abs(found.trust.after) > 30]
    moved = made.scene.surface(float(KEY))[::SCALE, ::SCALE] > 0
    assert share[:, moved].mean() < 0.7 and np.median(share) > 0.95


def test_measure_merged_at_rest_leaves_the_problem_as_it_is():
    """Merged samples of a scene at rest have the M and c of all intervals, but for rounding: the weighted mean of
    intervals that follow one another is the interval from the first to the last spike."""
    made = simulate(Static(WALL), scale=SCALE, frames=FRAMES, sensor=Sensor(photons=1000.0), seed=5)
    clip = Clip(np.asarray(made.spikes), KEY, 0.6, None)
    rest = Motion.none(80, 80)
    one, every = (
        accumulate(measure(clip, rest, scale=SCALE, sampling=Intervals(), merged_intervals=merge).placed)
        for merge in (True, False)
    )
    # Sums of up to 60 terms of 1e-2 in float32.
    np.testing.assert_allclose(one.stencil.planes, every.stencil.planes, atol=1e-6)
    np.testing.assert_allclose(one.target, every.target, atol=1e-6)


def summary(
    spikes: np.ndarray, merged_for: int, used: float = 1.0, noise: float = 0.003, bad_pixels=None
) -> SceneSummary:
    height, width = spikes.shape[1:]
    each = np.arange(height * width)
    light = np.ones(each.size, np.float32)
    merged = np.full((height, width), merged_for, np.int32)
    motion = Motion.none(height, width)
    weights = SampleWeights(each, light, used * light)
    return summarise_scene(spikes, motion, merged, merged, weights=weights, noise=noise, bad_pixels=bad_pixels)


def test_summarise_scene_each_kind_of_tile_is_told():
    rng = np.random.default_rng(0)
    texture = (rng.random((40, 1, 1)) + np.linspace(0, 1, 40 * 24).reshape(1, 40, 24) > 1).astype(np.uint8)
    assert (summary(texture, 100).kind == TileKind.STATIC).all()
    assert (summary(texture, 3).kind == TileKind.MOVING).all()
    assert (summary(texture, 3, used=0.2).kind == TileKind.FAST).all()
    assert (summary(np.ones((40, 40, 24), np.uint8), 3).kind == TileKind.SATURATED).all()
    dark = np.zeros((40, 40, 24), np.uint8)
    dark[[3, 20]] = 1
    assert (summary(dark, 100).kind == TileKind.DARK).all()
    assert summary(dark, 100).kind.shape == (3, 2)


def test_summarise_scene_false_alarms_of_texture_are_as_rare_as_said():
    """The false-alarm rate is what it says, within what 2,000 tiles can tell; and the faintest texture is seen."""
    rng = np.random.default_rng(1)
    height, width, frames = 16 * 40, 16 * 50, 64
    counts = rng.binomial(frames, 0.5, (height, width))
    spikes = (np.arange(frames)[:, None, None] < counts).astype(np.uint8)
    noise = float(np.sqrt(0.25 / frames))
    found = summary(spikes, frames, noise=noise)
    textured = found.share(TileKind.STATIC)
    assert found.share(TileKind.UNIFORM) + textured == 1
    # A binomial's fourth moment is near a normal's. 2000 tiles at 0.1 %: 2 expected, 10 or more in 5 of 100,000 runs.
    assert textured * 2000 < 10
    stripes = np.where(np.arange(width) % 2, 0.1, -0.1)[None]
    counts = np.clip(np.round(rng.binomial(frames, 0.5, (height, width)) + frames * stripes), 0, frames)
    spikes = (np.arange(frames)[:, None, None] < counts).astype(np.uint8)
    assert summary(spikes, frames, noise=noise).share(TileKind.STATIC) == 1


@pytest.mark.parametrize("rate", [0.25, 0.3, 0.5])
def test_scene_summary_plain_scene_is_uniform_however_regular_its_spikes(rate):
    """The number of spikes of a pixel that fires in every second frame is known to half of one, not to its noise."""
    sensor = Sensor(photons=1000.0)
    scene = Static(np.full((128, 128), rate / sensor.white_rate))
    spikes = simulate(scene, scale=SCALE, frames=FRAMES, sensor=sensor, seed=3).spikes
    found = reconstruct(spikes, scale=SCALE, strength=1e-3, gain=None).scene
    assert found is not None and found.share(TileKind.UNIFORM) == 1


def test_summarise_scene_bad_pixels_have_no_say():
    rng = np.random.default_rng(0)
    plain = (np.arange(64)[:, None, None] < rng.binomial(64, 0.5, (48, 48))).astype(np.uint8)
    bad = np.zeros((48, 48), bool)
    bad[3::8, 5::8] = True
    for spikes, kind in ((plain, TileKind.UNIFORM), (np.ones_like(plain), TileKind.SATURATED)):
        marked = np.where(bad, 0, spikes).astype(np.uint8)
        found = summary(marked, 64, noise=1 / 16, bad_pixels=bad)
        assert (found.kind == kind).all()
        assert found.intervals == summary(spikes, 64, noise=1 / 16).intervals - int(spikes[:, bad].sum()) - bad.sum()
    assert (summary(0 * plain, 64, bad_pixels=np.ones_like(bad)).kind == TileKind.DARK).all()


def test_summarise_scene_few_frames_do_not_tell_saturation():
    """A pixel of intensity 1 may fire in all of them."""
    assert (summary(np.ones((3, 40, 40), np.uint8), 3).kind != TileKind.SATURATED).all()


@pytest.mark.parametrize(
    ("kind", "limit", "beyond"),
    [(TileKind.DARK, SceneSummarySettings().dark_spikes / 64, 3 / 64), (TileKind.SATURATED, SATURATED_SHARE, 0.95)],
)
def test_summarise_scene_false_alarms_at_the_limits_are_as_rare_as_said(kind, limit, beyond):
    """The false-alarm rate of 0.1 % holds at the limit itself; a change well beyond it is reported."""
    rng, frames = np.random.default_rng(2), 64

    def share(rate: float) -> float:
        spikes = (rng.random((frames, 16 * 40, 16 * 50), dtype=np.float32) < rate).astype(np.uint8)
        return summary(spikes, frames, noise=float(np.sqrt(rate * (1 - rate) / frames))).share(kind)

    # 2000 tiles at 0.1 %: 2 expected, 10 or more in 5 of 100,000 runs. A mean alone would call half of them that.
    assert share(limit) * 2000 < 10
    assert share(beyond) == 1


def test_scene_summary_is_told_in_words_numbers_and_a_picture(tmp_path):
    made = simulate(Static(WALL), scale=SCALE, frames=41, sensor=Sensor(photons=1000.0), seed=5)
    solution = reconstruct(made.spikes, scale=SCALE)
    assert solution.scene is not None
    lines = solution.scene.lines()
    assert lines[0] == "Scene: at rest." and any("merged into one measurement" in line for line in lines)
    numbers = solution.scene.numbers
    assert numbers["samples"] < numbers["intervals"] and sum(numbers["tiles"].values()) == pytest.approx(1, abs=1e-3)
    scene_figure(solution, title="wall").savefig(tmp_path / "scene.png")
    full = reconstruct(made.spikes, scale=SCALE, shortcuts=ALL_WORK)
    assert full.scene is None and full.report().scene is None
    with pytest.raises(InputError, match=r"no summary of its scene, as no work was left out: solve with Shortcuts\(\)"):
        scene_figure(full)
