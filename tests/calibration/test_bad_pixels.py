"""Bad pixels that were put into recordings, and scenes that look as if they had some."""

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter, map_coordinates

from scsr_opt.calibration.bad_pixels import BadPixels, PixelKind, isolated_pixels, resting_pixels
from scsr_opt.camera.rates import interval_rates

SHAPE, FRAMES, RATE = (60, 80), 101, 0.6
ROWS, COLUMNS = np.mgrid[: SHAPE[0], : SHAPE[1]]


def spikes_of(light, frames: int = FRAMES, photons: float = 100.0, seed: int = 0) -> np.ndarray:
    """Spikes of a camera that sees `light(t)`, (h, w), with shot noise, and keeps the residual."""
    rng = np.random.default_rng(seed)
    charge, spikes = rng.random(SHAPE), np.zeros((frames, *SHAPE), np.uint8)
    for t in range(frames):
        charge += RATE * rng.poisson(np.maximum(light(t), 0) * photons) / photons
        spikes[t] = charge >= 1
        charge -= spikes[t]
    return spikes


def texture(smoothness: float, seed: int = 0) -> np.ndarray:
    field = gaussian_filter(np.random.default_rng(seed).normal(size=(120, 140)), smoothness, mode="wrap")
    return 0.5 + 0.14 * field / field.std()


def moving(velocity: tuple[float, float], picture: np.ndarray):
    def light(t: float) -> np.ndarray:
        at = [ROWS + 30 - velocity[0] * (t - 50), COLUMNS + 30 - velocity[1] * (t - 50)]
        return map_coordinates(picture, at, order=1)

    return light


def counts(light: np.ndarray) -> np.ndarray:
    return spikes_of(lambda t: light).sum(0)


def sky(blur: float, brightest: float, background: float = 0.03) -> np.ndarray:
    rng, stars = np.random.default_rng(3), np.zeros(SHAPE)
    stars[rng.integers(3, 57, 25), rng.integers(3, 77, 25)] = rng.uniform(0.1, 1, 25) * brightest
    return background + gaussian_filter(stars, blur)


def print_of(ink: float, paper: float, words: str) -> np.ndarray:
    page = Image.new("L", (SHAPE[1], SHAPE[0]), 255)
    for line in range(5):
        ImageDraw.Draw(page).text((2, 1 + 12 * line), words, fill=0, font=ImageFont.load_default_imagefont())
    return ink + (paper - ink) * np.asarray(page) / 255


def checkerboard(side: int) -> np.ndarray:
    return np.where((ROWS // side + COLUMNS // side) % 2, 0.9, 0.05)


SCENES = {
    "sharp stars": sky(0, 1),
    "faint stars": sky(0, 0.5, background=0.2),
    "a star or two": np.where((ROWS == 20) & (COLUMNS % 40 == 7), 0.8, 0.1),
    "stars that saturate": sky(0.8, 20),
    "text": print_of(0.0, 0.8, "it is. a dot: i, j; 1.5 %"),
    "white text": print_of(0.8, 0.02, "it is. a dot: i, j; 1.5 %"),
    "letters apart": print_of(0.0, 0.8, "i     i     :     i"),
    **{f"checkerboard of {side}": checkerboard(side) for side in (1, 2, 3, 9)},
    "white noise": np.random.default_rng(0).random(SHAPE),
    "fine texture": texture(0.7)[: SHAPE[0], : SHAPE[1]],
    "smooth": texture(6.0)[: SHAPE[0], : SHAPE[1]],
    "dark": np.full(SHAPE, 0.01),
}


@pytest.mark.parametrize("light", SCENES.values(), ids=SCENES.keys())
def test_isolated_pixels_scenes_at_rest_have_none(light):
    assert not isolated_pixels(counts(light), FRAMES).mask.any()


@pytest.mark.parametrize("smoothness", [1.0, 2.0, 5.0])
def test_isolated_pixels_finds_dead_and_hot_ones_at_rest(smoothness):
    rng, count = np.random.default_rng(1), counts(texture(smoothness)[: SHAPE[0], : SHAPE[1]])
    dead, hot = rng.choice(count.size, (2, 6), replace=False)
    count.ravel()[dead], count.ravel()[hot] = 0, FRAMES
    kind = isolated_pixels(count, FRAMES).kind.ravel()
    assert np.mean(kind[dead] == PixelKind.DEAD) >= 0.8 and np.mean(kind[hot] == PixelKind.HOT) >= 0.8
    assert np.count_nonzero(kind) <= 12


def test_isolated_pixels_finds_dim_ones_where_the_lens_is_soft():
    """As in a real roadside: dots of half the light on a soft background, and a brighter one."""
    light = texture(5.0)[: SHAPE[0], : SHAPE[1]].copy()
    light[[12, 30, 44], [15, 60, 33]] *= 0.55
    light[25, 40] *= 1.7
    kind = isolated_pixels(counts(np.minimum(light, 1.4)), FRAMES).kind
    assert np.count_nonzero(kind) == 4 and (kind[[12, 30, 44, 25], [15, 60, 33, 40]] == PixelKind.ISOLATED).all()


def test_isolated_pixels_leaves_known_ones_to_others():
    count = counts(texture(5.0)[: SHAPE[0], : SHAPE[1]])
    count[20, 20] = count[20, 21] = 0
    known = np.zeros(SHAPE, bool)
    known[20, 20] = True
    found = isolated_pixels(count, FRAMES, bad=known).mask
    assert found[20, 21] and found.sum() == 1


def dust(places: list[tuple[int, int]], radius: float, depth: float) -> np.ndarray:
    gain = np.ones(SHAPE)
    for row, column in places:
        gain[np.hypot(ROWS - row, COLUMNS - column) <= radius] = 1 - depth
    return gain


def resting(spikes: np.ndarray, velocity: tuple[float, float], bad: np.ndarray | None = None) -> np.ndarray:
    edges = np.linspace(0, FRAMES - 1, 26)
    field = np.broadcast_to(np.array(velocity)[:, None, None], (2, *SHAPE)).astype(np.float32)
    return resting_pixels(
        interval_rates(spikes, edges, white_rate=RATE),
        (edges[1:] + edges[:-1]) / 2 - 50,
        field,
        np.zeros_like(field),
        spikes=RATE * FRAMES,
        bad=bad,
    ).mask


@pytest.mark.parametrize("velocity", [(0.1, 0.14), (0.0, -0.3), (-0.08, 0.0)])
def test_resting_pixels_finds_dust_and_a_hair_in_a_moving_scene(velocity):
    gain = dust([(15, 20), (30, 50), (44, 30)], 1.5, 0.5)
    gain[20:32, 70] = 0.5 if velocity[1] else 1.0  # along the motion a hair is as an edge
    light = moving(velocity, texture(1.5))
    found = resting(spikes_of(lambda t: light(t) * gain), velocity)
    assert np.mean(found[gain < 1]) >= 0.9 and np.count_nonzero(found & (gain == 1)) == 0


@pytest.mark.parametrize("picture", [texture(1.0), texture(3.0), np.pad(sky(0.7, 1), 30, mode="wrap")])
def test_resting_pixels_finds_nothing_without_dust(picture):
    velocity = (0.1, 0.14)
    assert not resting(spikes_of(moving(velocity, picture)), velocity).any()


def test_resting_pixels_finds_nothing_at_rest_or_where_motion_is_wrong():
    gain = dust([(15, 20)], 1.5, 0.5)
    still = spikes_of(lambda t: texture(1.5)[: SHAPE[0], : SHAPE[1]] * gain)
    assert not resting(still, (0.0, 0.0)).any()
    assert resting(spikes_of(moving((0.2, 0.0), texture(1.5))), (0.0, 0.2)).mean() < 1e-3


def test_bad_pixels_numbers_and_parts():
    mask = np.zeros((4, 5), bool)
    mask[1, 2] = True
    bad = BadPixels.given(mask).also(BadPixels(np.full((4, 5), PixelKind.DEAD, np.uint8)))
    assert bad.numbers == {"given": 1, "dead": 19, "hot": 0, "isolated": 0, "resting": 0}
    assert bad.part(slice(1, 3), slice(2, 5)).kind.tolist() == [[1, 2, 2], [2, 2, 2]]
