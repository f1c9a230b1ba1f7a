"""`scsr info`."""

import json

import numpy as np
import pytest

from scsr_opt.camera import Recording, write_recording

FRAMES, HEIGHT, WIDTH = 31, 24, 40  # of the fixture `spikes`


def test_info(scsr, file, spikes):
    said = scsr("info", file)
    assert "40 x 24 pixels" in said and "31 at 40000 Hz = 0.775 ms" in said
    assert f"{spikes.sum():,}, {spikes.mean():.4g} per pixel and frame" in said
    assert f"none are marked; {(spikes.sum(0) == 0).sum()} never fired" in said
    assert "read as top-down; if scsr play shows the scene upside down, give --flip" in said
    assert scsr("info", file, "--quiet") == ""


def test_info_as_json(scsr, here, spikes):
    flat = here / "ramp_40x24.dat"
    write_recording(flat, Recording.from_array(spikes))
    facts = json.loads(scsr("info", flat, "--json", "--white-rate", "0.5", "--readout-rate", "20000"))
    assert facts["frames"] == FRAMES and facts["width"] == WIDTH and facts["height"] == HEIGHT
    assert facts["spikes"] == spikes.sum() and facts["stored_bottom_up"] is True
    assert facts["white_rate"] == 0.5 and facts["duration"] == pytest.approx(FRAMES / 20000)
    assert facts["rate_high"] == pytest.approx(spikes.mean(0).max(), rel=0.01)


def test_info_says_how_much_is_saturated(scsr, spikes):
    assert "saturated" not in scsr("info", write(spikes))
    spikes[:, :, 30:] = 1
    said = scsr("info", write(spikes))
    assert "saturated    25 % of the pixels fired in 90 % of the frames or more" in said and "a lower bound" in said
    assert json.loads(scsr("info", "light.npz", "--json"))["saturated"] == 0.25


def test_info_says_one_share_of_saturated_pixels(scsr, spikes):
    """White is found in windows of the recording, where more pixels are saturated than in all of it: only the share of
    all of it is given."""
    spikes[:] = np.arange(WIDTH) * 31 // WIDTH >= np.arange(len(spikes))[:, None, None]  # from dark to every frame
    spikes[:, :, 36:] = 1
    spikes[:6, :, 34:36] = 0
    said = scsr("info", write(spikes))
    assert "(the most light that a pixel can measure)" in said
    assert said.count(" % of the pixels fired") == said.count("saturat") == 1


def write(spikes: np.ndarray) -> str:
    write_recording("light.npz", Recording.from_array(spikes))
    return "light.npz"


def test_info_counts_a_long_recording_in_windows(scsr, monkeypatch, here):
    spikes = np.zeros((700, 250, 400), np.uint8)
    spikes[::3, 10] = 1
    write_recording(here / "long_400x250.dat", Recording.from_array(spikes))
    largest = []
    real = Recording.window
    monkeypatch.setattr(
        Recording,
        "window",
        lambda self, a, b: (largest.append((b - a) * self.height * self.width), real(self, a, b))[1],
    )
    facts = json.loads(scsr("info", "long_400x250.dat", "--json"))
    assert facts["spikes"] == spikes.sum() and max(largest) <= 32 << 20 and len(largest) > 1


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npz", None, "There is no file"),
        ("a.dat", b"", "is empty"),
        ("a.dat", b"\0" * 100, "The size of the frames in a.dat is not known"),
        ("a.npz", b"garbage", "a.npz"),
        ("a.xyz", b"\0", r"a.xyz"),
    ],
)
def test_files_that_cannot_be_read(scsr, here, name, content, message):
    if content is not None:
        (here / name).write_bytes(content)
    assert message in scsr("info", name, code=2)


def test_reading_options_are_passed_on(scsr, here, spikes):
    (here / "raw.dat").write_bytes(np.packbits(spikes, axis=2, bitorder="little").tobytes())
    np.savez(here / "odd.npz", light=spikes)
    np.save(here / "bad.npy", np.eye(HEIGHT, WIDTH, dtype=bool))
    facts = json.loads(scsr("info", "raw.dat", "--size", "40x24", "--no-flip", "--bad-pixels", "bad.npy", "--json"))
    assert facts["stored_bottom_up"] is False and facts["bad_pixels"] == HEIGHT
    assert json.loads(scsr("info", "odd.npz", "--array", "light", "--json"))["spikes"] == spikes.sum()
    assert "row_bits" in scsr("info", "odd.npz", "--row-bits", "48", code=2)
    assert "nowhere.npy" in scsr("info", "odd.npz", "--array", "light", "--bad-pixels", "nowhere.npy", code=2)
