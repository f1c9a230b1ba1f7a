"""Light that changes, against scenes whose light is known."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from scsr_opt.camera import Translation, interval_rates, simulate, spike_intervals
from scsr_opt.camera.light import Light
from scsr_opt.motion import estimate_motion
from scsr_opt.motion.estimators.automatic import corrected_frames, motion_in
from scsr_opt.motion.estimators.evidence import light_explains
from scsr_opt.motion.light import find_light
from scsr_opt.motion.light_settings import LightSettings
from scsr_opt.motion.settings import DEFAULTS
from scsr_opt.pipeline.options import Options
from scsr_opt.pipeline.task import task_of

SHAPE = (48, 64)
FRAMES, BEFORE, PERIOD = 101, 150, 400


def course(t, swing, phase=0.0):
    return 1 + swing * np.sin(2 * np.pi * np.asarray(t, float) / PERIOD + phase)


class Lit(Translation):
    """A texture that moves by 0.1 sensor pixels a frame, under lamps that light columns of equal number."""

    def __init__(self, swing, phases, speed=0.1):
        grey = gaussian_filter(np.random.default_rng(0).standard_normal(SHAPE), 1.5, mode="wrap")
        super().__init__(0.2 + 0.6 * (grey - grey.min()) / np.ptp(grey), (0, speed), key=200)
        self._lamps = swing, phases

    def frame(self, t):
        swing, phases = self._lamps
        return super().frame(t) * np.repeat([course(t, swing, phase) for phase in phases], SHAPE[1] // len(phases))


def recorded(swing, phases=(0.0,), speed=0.1):
    return simulate(Lit(swing, phases, speed), scale=1, frames=PERIOD, seed=1).spikes


def found_in(spikes):
    def read(begin, end):
        return spikes[BEFORE + begin : BEFORE + end]

    clip = read(0, FRAMES)
    return find_light(clip, before=BEFORE, after=len(spikes) - BEFORE - FRAMES, read=read)


@pytest.mark.parametrize("phase", [0.0, 1.57])
@pytest.mark.parametrize("swing", [0.1, 0.5])
def test_find_light_one_lamp_gives_its_course_depth_and_frequency(swing, phase):
    light = found_in(recorded(swing, (phase,))).light
    assert light is not None and light.uniform
    seen = light.at(np.arange(FRAMES, dtype=float))[:, 0, 0]
    np.testing.assert_allclose(seen, course(BEFORE + np.arange(FRAMES), swing, phase), atol=0.03)
    assert light.frequency == pytest.approx(1 / PERIOD, rel=0.1)


@pytest.mark.parametrize("speed", [0.0, 0.1, 0.25])
def test_find_light_steady_lamp_gives_none(speed):
    found = found_in(recorded(0.0, speed=speed))
    assert found.light is None and np.sum(found.suspected) <= 0.2 * found.suspected.size


@pytest.mark.parametrize("depth", [0.0, 0.2, 0.4])
def test_light_unexplained_shadow_is_reported_and_content_that_moves_in_is_not(depth):
    """A shadow that falls on a sixth of the picture; and a bright half that moves in, which motion explains."""
    height, width = shape = (96, 128)
    row, column = np.mgrid[:height, :width]
    grey = gaussian_filter(np.random.default_rng(0).standard_normal(shape), 1.5, mode="wrap")
    surface = 0.2 + 0.6 * (grey - grey.min()) / np.ptp(grey)
    shadow = 1 / (1 + np.exp((np.hypot(row - 30, column - 30) - 30) / 3))

    def scene(t):
        if depth:
            return surface * (1 - depth * shadow * np.clip((t - 20) / 60, 0, 1))
        return surface * np.where(column < 40 + 0.2 * t, 1, 0.3)

    gathered = np.cumsum([0.6 * scene(t) for t in range(101)], axis=0)
    spikes = np.diff(np.floor(gathered + np.random.default_rng(1).random(shape)), axis=0, prepend=0) > 0
    task = task_of(spikes.astype(np.uint8), 1, None, Options(white_rate=0.6))
    frames = task.motion_frames(None)
    share = task.light_unexplained(task.estimate_motion(frames), frames)
    assert (share > 0.1) if depth else (share < 0.1)


def test_find_light_object_that_moves_in_gives_none():
    """A bright square that comes in changes the mean brightness, but is no flicker."""
    spikes = recorded(0.0, speed=0.0)
    bright = np.random.default_rng(2).random(spikes.shape) < 0.8
    for t in range(len(spikes)):
        reach = int(0.12 * t)
        spikes[t, 10:40, :reach] = bright[t, 10:40, :reach]
    assert spikes[BEFORE + FRAMES].mean() > 1.1 * spikes[BEFORE].mean()
    assert found_in(spikes).light is None


def test_find_light_two_lamps_gives_each_half_its_own():
    light = found_in(recorded(0.5, (0.0, 1.57))).light
    assert light is not None and not light.uniform
    times = np.arange(FRAMES)
    for columns, phase in ((slice(4, 20), 0.0), (slice(44, 60), 1.57)):
        seen = light.at(times.astype(float))[:, :, columns].mean((1, 2))
        np.testing.assert_allclose(seen, course(BEFORE + times, 0.5, phase), atol=0.08)


def test_find_light_short_or_dark_clip_gives_none():
    assert find_light(recorded(0.5)[: LightSettings().least_frames - 1]).light is None
    assert find_light(np.zeros((FRAMES, *SHAPE), np.uint8)).light is None
    assert find_light(np.zeros((FRAMES, 4, 64), np.uint8)).light is None


def test_estimate_motion_flicker_finds_the_speed():
    motion = estimate_motion(recorded(0.5)[BEFORE : BEFORE + FRAMES])
    assert np.median(motion.velocity[1]) == pytest.approx(0.1, rel=0.02)


@pytest.mark.parametrize("lamps", [1, 2])
def test_light_rates_and_samples_are_those_at_the_mean_light(lamps):
    """Of a scene at rest whose light is known: intervals and rates give its intensity whenever they were taken."""
    shape, times = (12, 16), np.arange(-5.0, FRAMES + 5)
    share = np.ones((1, 1, 1)) if lamps == 1 else np.stack([np.ones(shape), np.linspace(-1, 1, 192).reshape(shape)])
    courses = np.stack([course(times, 0.5), 0.3 * np.cos(2 * np.pi * times / PERIOD)])[:lamps]
    light = Light(times, courses, share)
    scene = np.random.default_rng(0).uniform(0.2, 0.8, shape)
    gathered = np.cumsum(scene * light.at(np.arange(FRAMES, dtype=float)), axis=0) * 0.6
    spikes = np.diff(np.floor(gathered + np.random.default_rng(1).random(shape)), axis=0, prepend=0) > 0
    samples = light.corrected(spike_intervals(spikes, ends=0), shape[1])
    early = samples.stop < FRAMES / 2
    for some in (early, ~early):
        ratio = samples.value / scene[samples.row, samples.column]
        assert np.average(ratio[some], weights=samples.weight[some]) == pytest.approx(1, abs=0.01)
    rates = interval_rates(spikes, np.linspace(10, 90, 9), light=light)
    np.testing.assert_allclose((rates / scene).mean((1, 2)), 1, atol=0.02)


def test_light_uniform_equals_the_same_light_by_pixel():
    times, edges = np.arange(FRAMES, dtype=float), np.linspace(5, 95, 7)
    spikes = (np.random.default_rng(0).random((FRAMES, 6, 8)) < 0.3).astype(np.uint8)
    one = Light(times, course(times, 0.4)[None], np.ones((1, 1, 1)))
    each = Light(times, np.stack([one.course[0], times]), np.stack([np.ones((6, 8)), np.zeros((6, 8))]))
    np.testing.assert_allclose(
        interval_rates(spikes, edges, light=each), interval_rates(spikes, edges, light=one), atol=1e-6
    )
    np.testing.assert_allclose(each.over(edges)[:, 2, 3], one.over(edges)[:, 0, 0], rtol=1e-6)
    assert one.part(slice(2), slice(3)) is one and each.part(slice(2), slice(3)).share.shape == (2, 2, 3)
    np.testing.assert_allclose(each.relative_to(30).at(30.0), 1, rtol=1e-6)


def test_light_explains_what_flickers_and_not_what_moves():
    """The light of a lamp, taken off a texture under that lamp, and off the same one under the sun."""
    light = found_in(recorded(0.1)).light
    assert light is not None

    def explained(spikes: np.ndarray) -> bool:
        found = []
        for one in (light, None):
            frames = corrected_frames(spikes, key=50, white_rate=0.6, bad_pixels=None, gain=None, light=one)
            assert frames is not None
            found.append((frames, motion_in(frames, None, DEFAULTS)))
        return light_explains(found[0], found[1])

    assert explained(recorded(0.1)[BEFORE : BEFORE + FRAMES]) and not explained(recorded(0.0)[BEFORE : BEFORE + FRAMES])
