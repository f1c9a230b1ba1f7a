"""The strength from the recording: by its noise, and by intervals that are held out."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from skimage import data

from scsr_opt import reconstruct
from scsr_opt.baselines import tfp_sr
from scsr_opt.camera import Intervals, SamplingRule, Sensor, Windows, simulate
from scsr_opt.camera.samples import spike_intervals
from scsr_opt.camera.scenes import Static, Translation
from scsr_opt.cli.demo_scene import psnr
from scsr_opt.motion import Motion
from scsr_opt.operators.sampling import accumulate
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.folds import held_out, light_at_rest
from scsr_opt.pipeline.initial_image import initial_image
from scsr_opt.pipeline.measurement import measure
from scsr_opt.pipeline.settings import StrengthSettings
from scsr_opt.pipeline.strength import (
    StrengthSearch,
    ValidatedStrength,
    _chosen_areas,
    _vertex,
    noise_of_mean,
    strength_of_noise,
)
from scsr_opt.priors import (
    BilateralTotalVariation,
    Bounded,
    HuberTotalVariation,
    Prior,
    RidgeRegulariser,
    TotalVariation,
    WaveletL1,
)
from scsr_opt.solvers import FISTA, LBFGS, Solver
from scsr_opt.solvers.loop import run

SCALE = 2


def still(picture, **sensor) -> Clip:
    made = simulate(Static(picture), scale=SCALE, frames=101, sensor=Sensor(**sensor), seed=0)
    return Clip(made.spikes, 50, made.sensor.white_rate, None)


def initial_of(clip: Clip) -> jax.Array:
    height, width = clip.shape
    return initial_image(clip, (SCALE * height, SCALE * width))


def at_rest(
    clip: Clip,
    sampling: SamplingRule = Intervals(),  # noqa: B008
    prior: Prior = TotalVariation(),  # noqa: B008
    solver: Solver = FISTA(),  # noqa: B008
    *,
    skip: bool = True,
    settings: StrengthSettings = StrengthSettings(),  # noqa: B008
) -> ValidatedStrength:
    """Strength found where nothing moves; with `skip` intervals are merged, and sums used again."""
    motion = Motion.none(*clip.shape)
    measurements = measure(clip, motion, scale=SCALE, sampling=sampling, merged_intervals=skip)
    search = StrengthSearch(
        scale=SCALE, prior=prior, solver=solver, sampling=sampling, merged_intervals=skip, reused_sums=skip,
        settings=settings,
    )  # fmt: skip
    return search.find(clip, motion, measurements, initial_of(clip))


def validated(clip: Clip, *arguments: Any, **options: Any) -> float:
    return at_rest(clip, *arguments, **options).strength


def test_find_smooth_and_dim_asks_for_more_than_noise():
    """Smooth and dim: the best strength is several times that of the noise between neighbours (measured: 4)."""
    rows, columns = np.mgrid[0:96, 0:96] / 95.0
    clip = still(0.3 + 0.4 * rows * columns, white_rate=0.1, photons=25.0)
    assert validated(clip) > 2 * strength_of_noise(noise_of_mean(clip), SCALE, TotalVariation())


def test_find_ridge_regulariser_follows_huber_total_variation():
    """On the smooth and dim picture above, where the floor does not decide."""
    rows, columns = np.mgrid[0:96, 0:96] / 95.0
    clip = still(0.3 + 0.4 * rows * columns, white_rate=0.1, photons=25.0)
    learned, noise = RidgeRegulariser.load(), noise_of_mean(clip)
    of_learned, of_huber = (
        validated(clip, prior=prior) / strength_of_noise(noise, SCALE, prior)
        for prior in (learned, HuberTotalVariation())
    )
    assert of_learned > 1
    settings = StrengthSettings()
    raised_by = settings.raised_by[0]
    expected = raised_by * settings.ridge_factor * (of_huber / raised_by) ** settings.ridge_exponent
    np.testing.assert_allclose(of_learned, expected, rtol=1e-5)


def test_find_texture_by_day_stays_near_the_strength_of_noise():
    clip = still(data.gravel()[:96, :96], photons=1000.0)
    least = strength_of_noise(noise_of_mean(clip), SCALE, TotalVariation())
    assert 0.69 * least <= validated(clip) < 1.5 * least


def test_find_windows_ask_for_more_than_intervals():
    """A count is wrong by up to a spike, an interval by a frame's light."""
    clip = still(data.camera()[100:292:2, 100:292:2] / 255)
    assert validated(clip, Windows(4)) > 2 * validated(clip)


@pytest.fixture(scope="module")
def bricks() -> Clip:
    return still(data.brick()[:32, :32], photons=1000.0)


@pytest.fixture(scope="module")
def usual(bricks) -> float:
    return validated(bricks)


@pytest.mark.parametrize("prior", [BilateralTotalVariation(), Bounded(WaveletL1(1))])
def test_find_other_prior_has_a_strength_of_its_own(prior, bricks, usual):
    """As many times that of total variation as an edge costs less, to an octave: 0.25 and 6.3 times."""
    assert abs(np.log2(validated(bricks, prior=prior) / usual / prior.relative_strength)) < 1


class Smoothness(Prior[None]):
    """½‖∇X‖², by its value alone."""

    smooth: ClassVar[bool] = True

    def value(self, image):
        return jnp.sum(jnp.diff(image, axis=0) ** 2) / 2 + jnp.sum(jnp.diff(image, axis=1) ** 2) / 2

    def initial_state(self, image):
        return None

    def prox(self, image, strength, state):
        raise NotImplementedError


def test_find_smooth_prior_needs_no_proximal_step(bricks):
    assert validated(bricks, prior=Smoothness(), solver=LBFGS()) > 0


def test_find_whole_sensor_looked_at_comes_with_a_picture():
    """80×48 high-resolution pixels are no more than three parts of 64×64 have, 260×48 are more."""
    for height, whole in ((40, True), (130, False)):
        picture = data.brick()[: 2 * height, :48] / 255
        image = at_rest(still(picture), settings=StrengthSettings(part_px=64)).image
        assert (image is not None) == whole
        if image is not None:
            assert np.abs(np.asarray(image) - picture)[8:-8, 8:-8].mean() < 0.03


def test_find_picture_is_that_of_the_nearest_strength(monkeypatch):
    """A solve that began elsewhere ended elsewhere: by up to 0.09 dB."""
    tried: list[tuple[float, np.ndarray]] = []

    def watched(solver, problem, first, **others):
        outcome = run(solver, problem, first, **others)
        tried.append((float(problem.strength), np.asarray(outcome.image)))
        return outcome

    clip = still(data.brick()[:80, :80] / 255)
    monkeypatch.setattr("scsr_opt.pipeline.strength.run", watched)
    found = at_rest(clip)
    assert len(tried) > 2 and found.image is not None
    nearest = min(tried, key=lambda one: abs(np.log(one[0] / found.strength)))[1]
    np.testing.assert_array_equal(found.image, nearest)
    assert not np.array_equal(nearest, tried[-1][1])  # or the last one would do


def test_find_nothing_merged_uses_the_measurements_again():
    """A scene that moves everywhere: the same strength as from samples that are made anew."""
    made = simulate(
        Translation(data.camera()[100:228, 100:228] / 255, (0.2, -0.3), key=20), scale=SCALE, frames=41, seed=0
    )
    clip = Clip(made.spikes, 20, made.sensor.white_rate, None)
    motion = Motion.constant((0.1, -0.15), clip.shape)
    measurements = measure(clip, motion, scale=SCALE, sampling=Intervals())
    assert (measurements.merged_for == 1).all()
    search = StrengthSearch(scale=SCALE, prior=TotalVariation(), solver=FISTA(), sampling=Intervals())
    first, apart = initial_of(clip), measurements._replace(merged_for=2 * measurements.merged_for)
    again = search.find(clip, motion, measurements, first)
    anew = search.find(clip, motion, apart, first)
    assert again.strength == pytest.approx(anew.strength, rel=1e-6)  # sums in another order
    # And what was summed for it is the picture's data term, but for the order of sums.
    whole = accumulate(measurements.placed)
    assert again.term is not None and anew.term is None
    for found, wanted in zip(jax.tree.leaves(again.term), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)
    without = dataclasses.replace(search, merged_intervals=False, reused_sums=False).find(
        clip, motion, measurements, first
    )
    assert without.term is None and without.strength == pytest.approx(again.strength, rel=1e-6)


def test_find_few_pixels_at_rest_are_validated_by_intervals():
    """One sum for each would be too few to tell."""
    clip = still(data.brick()[:16, :16] / 255)
    found = [at_rest(clip, skip=skip) for skip in (True, False)]
    assert found[0].image is not None
    assert found[0].strength == pytest.approx(found[1].strength, rel=0.1)


@pytest.mark.parametrize("frames", [10, 20])
def test_pixels_that_hardly_fire_ask_for_a_strong_prior(frames):
    """Most pixels fire less than twice. Measured: 19.1 and 22.3 dB, 13.6 and 18.7 of playback with a classical
    super-resolution; 11.9 and 15.3 where no noise was known but that between intervals."""
    scene = Translation(data.camera()[150:278, 150:278] / 255, (0.1, 0.22), key=frames // 2)
    made = simulate(scene, scale=2, frames=frames, sensor=Sensor(white_rate=0.1, photons=50.0))
    assert np.median(made.spikes.sum(0)) < 2
    options = {"scale": 2, "key": frames // 2, "white_rate": 0.1}
    truth = made.truth(float(frames // 2))
    image = reconstruct(made.spikes, **options).image
    assert psnr(truth, image, 8) > psnr(truth, tfp_sr(made.spikes, **options), 8) + 2


def test_find_too_few_samples_gives_the_strength_of_noise():
    clip = Clip(np.ones((9, 3, 3), np.uint8), 4, 0.6, None)
    assert validated(clip) == strength_of_noise(noise_of_mean(clip), SCALE, TotalVariation())


@pytest.mark.parametrize("light", [{"photons": 1000.0}, {"photons": 50.0, "white_rate": 0.1}])
def test_find_at_rest_sums_give_the_strength_of_all_intervals(light):
    """Sums over the intervals of each pixel serve as well as these, up to rounding, which may end a solve earlier."""
    sensor = Sensor(**light)
    made = simulate(Static(data.brick()[:192, :192] / 255), scale=SCALE, frames=101, sensor=sensor, seed=0)
    clip, motion = Clip(made.spikes, 50, sensor.white_rate, None), Motion.none(96, 96)
    measurements = measure(clip, motion, scale=SCALE, sampling=Intervals(), on_sensor=True)
    of_sums, of_intervals = (
        StrengthSearch(
            scale=SCALE,
            prior=HuberTotalVariation(),
            solver=FISTA(),
            sampling=Intervals(),
            merged_intervals=skip,
            reused_sums=skip,
        )
        .find(clip, motion, measurements, initial_of(clip))
        .strength
        for skip in (True, False)
    )
    assert of_sums == pytest.approx(of_intervals, rel=0.01)


@pytest.mark.parametrize(("frames", "rate", "ends"), [(101, 0.6, 0.1), (300, 0.1, 0.1), (7, 0.3, 0.0), (40, 0.02, 1.0)])
def test_light_at_rest_is_that_of_the_samples(frames, rate, ends):
    """Pixels that never fire, or in every frame, too."""
    random = np.random.default_rng(0)
    spikes = (random.random((frames, 12, 11)) < 2 * rate * random.random((12, 11))).astype(np.uint8)
    spikes[:, :2], spikes[:, 2:4] = 0, 1
    found = light_at_rest(spikes, ends=ends)
    samples = spike_intervals(spikes, white_rate=1.0, run=1, ends=ends)
    held = held_out(samples, np.zeros((12, 11), np.float32))
    pixel = samples.row * 11 + samples.column
    for which, some in enumerate((~held, held)):
        for sums, of in zip(found[which], (samples.weight * samples.value, samples.weight), strict=True):
            np.testing.assert_allclose(sums.ravel(), np.bincount(pixel, of * some, 12 * 11), rtol=1e-5, atol=1e-4)


def test_a_fifth_of_every_pixels_time_is_held_out():
    samples = spike_intervals(still(data.brick()[:96, :96], photons=1000.0).spikes, white_rate=0.6)
    held = held_out(samples, np.zeros((48, 48), np.float32))
    assert samples.weight[held].sum() / samples.weight.sum() == pytest.approx(0.2, abs=0.03)


def test_where_the_scene_moves_a_fifth_of_the_pixels_is_held_out():
    samples = spike_intervals(still(data.brick()[:96, :96], photons=1000.0).spikes, white_rate=0.6)
    moved = np.zeros((48, 48), np.float32)
    moved[:, 24:] = 1.5
    held = held_out(samples, moved)
    shares = [
        np.mean(held[(samples.row == row) & (samples.column == column)]) for row in range(5) for column in range(48)
    ]
    by_time, by_pixel = np.reshape(shares, (5, 48))[:, :24], np.reshape(shares, (5, 48))[:, 24:]
    assert set(by_pixel.ravel()) == {0.0, 1.0} and by_pixel.mean() == pytest.approx(0.2, abs=0.01)
    assert 0 < by_time.min() and by_time.max() < 0.6


@pytest.mark.parametrize(
    ("shape", "side", "found"),
    [
        ((7, 4), 4, (slice(2, 6), slice(0, 4))),
        ((5, 3), 8, (slice(0, 5), slice(0, 3))),
        ((1, 7), 4, (slice(0, 1), slice(2, 6))),
    ],
)
def test_of_a_small_even_picture_one_part_serves_in_the_middle(shape, side, found):
    parts = _chosen_areas(jnp.ones((2 * shape[0], 2 * shape[1])), 2, side, np.ones(shape, bool), 3)
    assert parts == [found]


def test_a_plain_a_middling_and_a_rich_part_are_chosen():
    contrast = np.repeat([0.1, 0.4, 1.0], 40).astype(np.float32)
    image = jnp.asarray(contrast * np.random.default_rng(0).random((120, 120), np.float32))
    assert [columns.start for _, columns in _chosen_areas(image, 1, 40, np.ones((120, 120), bool), 3)] == [0, 40, 80]


def test_bad_pixels_are_not_looked_at():
    image = jnp.asarray(np.random.default_rng(0).random((120, 120), np.float32))
    good = np.ones((120, 120), bool)
    good[:, 60:] = False
    assert all(columns.start < 60 for _, columns in _chosen_areas(image, 1, 40, good, 3))
    good[:, 20:] = False
    good[20:] = False
    assert _chosen_areas(image, 1, 40, good, 3) == [(slice(0, 40), slice(0, 40))]
    corners = np.zeros((65, 65), bool)
    corners[::64, ::64] = True  # every part has less than its share of these
    assert len(_chosen_areas(image[:65, :65], 1, 64, corners, 3)) == 1


def test_find_all_chosen_parts_have_a_say(monkeypatch):
    """A textured part and a plain one: what both ask for is neither what the one does nor what the other does."""
    picture = np.full((240, 480), 0.5)
    picture[:, :240] = data.gravel()[:240, :240] / 255
    clip, textured, plain = still(picture, photons=1000.0), slice(0, 120), slice(120, 240)
    found = []
    for chosen in ([textured], [textured, plain], [plain]):
        parts = [(slice(0, 120), columns) for columns in chosen]
        monkeypatch.setattr("scsr_opt.pipeline.strength._chosen_areas", lambda *_, parts=parts: parts)
        found.append(validated(clip))
    assert 1.2 * found[0] < found[1] < found[2] / 1.2


def test_the_vertex_of_a_parabola():
    assert _vertex(4.0, 1.0, 0.0) == pytest.approx(1.0)  # (x − 1)², at the end of what is believed
    assert _vertex(*((x - 0.25) ** 2 for x in (-1.0, 0.0, 1.0))) == pytest.approx(0.25)
    assert _vertex(1.0, 1.0, 1.0) == 0.0
