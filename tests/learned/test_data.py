"""Examples to train on."""

import multiprocessing
import subprocess
import sys
from contextlib import closing

import numpy as np
import pytest
from PIL import Image

from learned.training.data import (
    HELD_OUT_SAMPLES,
    LIGHTS,
    SCENES,
    TRAINING_SAMPLES,
    Examples,
    Pictures,
)
from learned.training.data_loader import batches
from scsr_opt.errors import InputError

TINY = Examples(scale=2, frames=21, patch=16, seed=5)


def same(first, second) -> bool:
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("scene", SCENES)
def test_shapes_and_intensities(scene):
    example = Examples(scale=3, frames=20, patch=17, scenes=(scene,), lights=("day",))[0]
    assert example.spikes.shape == (20, 17, 17) and example.spikes.dtype == np.uint8
    assert example.truth.shape == (51, 51) and example.truth.dtype == np.float32
    assert 0 <= example.truth.min() < example.truth.max() <= 1
    # The sensor saw what the truth says, in the mean over the patch: the fan and the objects change little of it.
    mean = example.spikes.mean() / example.white_rate
    assert mean == pytest.approx(example.truth.mean(), abs=0.05)


@pytest.mark.parametrize("number", range(8))
def test_truth_and_spikes_lie_alike(number):
    """Examples of a still scene are turned and flipped, each in its own way; the truth must follow the spikes."""
    pictures = Pictures.samples(("gravel",))  # texture everywhere: a cut without any does not tell directions
    examples = Examples(scale=2, frames=101, patch=24, scenes=("static",), lights=("day",), pictures=pictures)
    example = examples[number]
    rate = example.spikes.mean(0)
    seen = example.truth.reshape(24, 2, 24, 2).mean((1, 3))

    def likeness(picture) -> float:
        return float(np.corrcoef(picture.ravel(), seen.ravel())[0, 1])

    assert likeness(rate) > 0.9
    others = [likeness(np.rot90(side, k)) for side in (rate, rate[:, ::-1]) for k in range(4)][1:]
    assert likeness(rate) > max(others)


def test_turns_and_flips_differ_between_examples(here):
    """All eight ways come up. A picture no larger than the patch is always cut alike, so it shows nothing else."""
    corner = np.zeros((32, 32), np.uint8)
    corner[2:8, 20:30] = 255
    Image.fromarray(corner).save(here / "corner.png")
    examples = Examples(scale=2, frames=3, patch=16, scenes=("static",), pictures=Pictures.folder(here))
    assert len({examples[number].truth.tobytes() for number in range(60)}) == 8


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_an_example_depends_on_seed_and_number_alone():
    wanted = TINY[3]
    TINY[0]
    assert same(TINY[3], wanted)
    assert not same(TINY[4], wanted)
    assert not same(Examples(scale=2, frames=21, patch=16, seed=6)[3], wanted)


def test_lights():
    rates = {
        light: [float(Examples(2, 5, 16, lights=(light,), scenes=("static",))[n].white_rate) for n in range(6)]
        for light in LIGHTS
    }
    # Drawn from half an octave on either side of 0.6 and 0.1.
    for light, rate in (("day", 0.6), ("pattern", 0.6), ("dim", 0.1)):
        assert rate / 2**0.5 <= min(rates[light]) < max(rates[light]) <= rate * 2**0.5
    fixed = Examples(2, 5, 16, lights=("dim",), scenes=("static",), varied=False)
    assert {float(fixed[n].white_rate) for n in range(3)} == {float(np.float32(0.1))}


def test_workers_make_what_one_process_makes():
    with closing(batches(TINY, 2, 1, 4, workers=0)) as feed:
        wanted = list(feed)
    with closing(batches(TINY, 2, 1, 4, workers=2, ahead=1)) as feed:
        made = list(feed)
    assert [batch.spikes.shape for batch in made] == [(2, 21, 16, 16)] * 3
    assert all(same(a, b) for a, b in zip(made, wanted, strict=True))
    assert same([part[1] for part in made[0]], TINY[3])


def test_workers_say_what_is_wrong_and_end(here):
    Image.fromarray(np.zeros((64, 64), np.uint8)).save(here / "black.png")
    examples = Examples(2, 5, 16, scenes=("static",), pictures=Pictures.folder(here))
    (here / "black.png").write_bytes(b"no picture")
    feed = batches(examples, 1, 0, 10, workers=1)
    with pytest.raises(InputError, match="black.png cannot be read as a picture"):
        next(feed)
    assert not multiprocessing.active_children()


def test_samples_need_no_download_and_are_kept_apart():
    assert not set(TRAINING_SAMPLES) & set(HELD_OUT_SAMPLES)
    for names in (TRAINING_SAMPLES, HELD_OUT_SAMPLES):
        for name in names:
            examples = Examples(1, 3, 16, scenes=("static",), pictures=Pictures.samples((name,)))
            assert examples[0].truth.shape == (16, 16)


def test_folder_with_clips(here):
    rows, columns = np.mgrid[0:40, 0:48]
    for folder, count in (("", 2), ("clip", 5), ("pair", 2)):
        (here / "made" / folder).mkdir(parents=True, exist_ok=True)
        for n in range(count):
            waves = 127 + 100 * np.sin((rows + n) / 5) * np.cos(columns / 7)
            Image.fromarray(waves.astype(np.uint8)).save(here / "made" / folder / f"{n}.png")
    pictures = Pictures.folder(here / "made")
    assert len(pictures.stills) == 2 and [len(clip) for clip in pictures.clips] == [5]
    # 101 frames are more than 5 of 16 readouts each: the clip is stretched; 21 frames are fewer: a part is taken.
    for frames in (21, 101):
        example = Examples(2, frames, 16, scenes=("video",), lights=("day",), pictures=pictures, varied=False)[0]
        middle = frames // 2
        near = example.spikes[middle - 8 : middle + 9].mean(0)
        seen = example.truth.reshape(16, 2, 16, 2).mean((1, 3))
        assert np.corrcoef(near.ravel(), seen.ravel())[0, 1] > 0.9


def test_without_jax():
    """Every worker imports the module; a second for JAX and its memory would be paid by each of them."""
    program = (
        "import sys, learned.training.data as d, learned.training.data_loader; "
        "d.Examples(2, 3, 16)[0]; sys.exit('jax' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0
