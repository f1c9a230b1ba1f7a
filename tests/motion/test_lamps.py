"""The parts of a sensor that several lamps light."""

import dataclasses

import numpy as np
import pytest

from scsr_opt.camera import spike_intervals
from scsr_opt.camera.light import Light
from scsr_opt.motion import Motion
from scsr_opt.motion.estimators.automatic import corrected_frames
from scsr_opt.motion.lamps import along_motion, parts_by, parts_of
from scsr_opt.motion.settings import DEFAULTS

SHAPE, FRAMES = (20, 24), 101
TIMES = np.arange(-5.0, FRAMES + 5)
COURSES = np.stack([1 + 0.5 * np.sin(TIMES / 40), 0.6 * np.cos(TIMES / 40)])
SHARES = np.array([[1.0, 1.0], [-0.5, 0.5]])


def light_of(number):
    return Light(TIMES, COURSES, SHARES[:, number])


def measured(truth, scene):
    """Samples as a camera takes them of a scene at rest, under lamps that light these parts."""
    gathered = np.cumsum(scene * light_of(truth).at(np.arange(FRAMES, dtype=float)), axis=0) * 0.6
    start = np.random.default_rng(1).random(SHAPE)
    return spike_intervals(np.diff(np.floor(gathered + start), axis=0, prepend=0) > 0, ends=0)


def test_parts_of_light_that_passes_over_gives_none():
    uniform = Light(TIMES, COURSES[:1], np.ones((1, 1, 1)))
    passing = Light(TIMES, COURSES, np.stack([np.ones(SHAPE), np.linspace(-1, 1, 480).reshape(SHAPE)]))
    assert parts_of(uniform) is None and parts_of(passing) is None


def test_parts_of_two_lamps_gives_their_parts_and_edge():
    number = np.repeat([0, 1], 12)[None].repeat(SHAPE[0], 0)
    parts = parts_of(light_of(number))
    assert parts is not None
    np.testing.assert_array_equal(parts.share[:, parts.number], SHARES[:, number])
    assert parts.edge(2).sum() == 4 * SHAPE[0] and parts.edge(2)[:, 10:14].all()


@pytest.mark.parametrize("key", [False, True])
def test_parts_by_picture_moves_the_edge_to_where_it_is(key):
    """The edge is curved and was taken for a straight one; the samples are predicted by the true scene. With `key` the
    light is relative to that of a frame."""
    rows, columns = np.indices(SHAPE)
    truth = (columns >= 12 + np.rint(1.4 * np.sin(rows / 3))).astype(int)
    assumed = (columns >= 12).astype(int)
    scene = np.random.default_rng(0).uniform(0.2, 0.8, SHAPE)
    light = light_of(assumed)
    seen = scene
    if key:
        light, seen = light.relative_to(50), scene * light_of(truth).at(50.0)[0]
    samples = light.corrected(measured(truth, scene), SHAPE[1])
    weight = np.asarray(samples.weight)
    parts = parts_of(light)
    assert parts is not None and (assumed != truth).sum() > 12
    everywhere = np.ones(weight.shape)
    found = parts_by(light, parts, samples, seen[samples.row, samples.column], weight, everywhere)
    wrong = found.number != truth
    assert min(wrong.sum(), (~wrong).sum()) <= 1
    # Pixels far from the edge keep their part, whatever the samples say.
    none = dataclasses.replace(samples, value=np.zeros_like(samples.value))
    kept = parts_by(light, parts, none, seen[samples.row, samples.column], weight, everywhere).number
    far = ~parts.edge(2)
    np.testing.assert_array_equal(kept[far], parts.number[far])


def test_along_motion_of_a_cut_stays_a_light():
    """From one frame to the next the scene is another one, most of it forty times as bright: no light does that."""
    dark, bright = (
        np.random.default_rng(2).random((2, FRAMES // 2, 48, 64)) < np.array([0.01, 0.4])[:, None, None, None]
    )
    bright[:, :, 40:] = dark[:, :, 40:]
    spikes = np.concatenate([dark, bright]).astype(np.uint8)
    number = np.repeat([0, 1], 32)[None].repeat(48, 0)
    level = np.linspace(0.04, 1.8, 64)[None].repeat(48, 0)
    light = Light(TIMES, COURSES, np.stack([level, SHARES[1][number]]))
    for _ in range(3):
        frames = corrected_frames(spikes, key=50, white_rate=0.6, bad_pixels=None, gain=None, light=light)
        assert frames is not None
        light = along_motion(light, frames, Motion.none(48, 64), 50, DEFAULTS)
        assert np.isfinite(light.share).all()
        assert light.share[0].min() >= 0.04 - 1e-9 and light.share[0].max() <= 1.8 + 1e-9
