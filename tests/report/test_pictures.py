import os
import sys

import numpy as np
import pytest
import tifffile
from PIL import Image

from scsr_opt.errors import InputError
from scsr_opt.report import PictureFormat, check_film, quantise, read_picture, write_film, write_picture
from scsr_opt.report.pictures import load_pixels

RAMP = np.linspace(0.0, 1.0, 6 * 256, dtype=np.float32).reshape(6, 256)


@pytest.mark.parametrize(
    ("name", "bits", "error"),
    [
        ("a.png", None, 0.5 / 255),
        ("a.png", 8, 0.5 / 255),
        ("a.png", 16, 0.5 / 65535),
        ("a.tif", 8, 0.5 / 255),
        ("a.tif", None, 0.5 / 65535),
        ("a.tiff", 32, 0.0),
        ("a.npz", None, 0.0),
        ("A.PNG", None, 0.5 / 255),
    ],
)
def test_written_and_read_back(tmp_path, name, bits, error):
    write_picture(tmp_path / name, RAMP, bits=bits)
    assert np.abs(read_picture(tmp_path / name) - RAMP).max() <= error * (1 + 1e-4)
    assert os.listdir(tmp_path) == [name]


def test_an_independent_reader_sees_the_numbers(tmp_path):
    image = np.array([[0.0, 0.5, 1.0], [0.25, -3.0, 7.0]])
    write_picture(tmp_path / "a.png", image)
    with Image.open(tmp_path / "a.png") as stored:
        assert stored.mode == "L"
        assert np.asarray(stored).tolist() == [[0, 128, 255], [64, 0, 255]]
    write_picture(tmp_path / "b.png", image, bits=16)
    with Image.open(tmp_path / "b.png") as stored:
        assert np.asarray(stored).tolist() == [[0, 32768, 65535], [16384, 0, 65535]]
    write_picture(tmp_path / "c.tif", image, bits=32)
    assert tifffile.imread(tmp_path / "c.tif").tolist() == image.tolist()  # floating point: not cut to 0..1


def test_npz_holds_the_extras(tmp_path):
    velocity = np.ones((2, 3, 4), np.float32)
    write_picture(tmp_path / "a.npz", RAMP, extras={"velocity": velocity, "scale": 4})
    with np.load(tmp_path / "a.npz") as stored:
        assert stored["image"].dtype == np.float32
        assert np.array_equal(stored["velocity"], velocity) and stored["scale"] == 4


def test_gamma_is_for_looking_at():
    assert quantise(np.array([[0.0, 0.5, 1.0]]), gamma=2.0).tolist() == [[0, round(0.5**0.5 * 255), 255]]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_never_written(tmp_path, value):
    image = RAMP.copy()
    image[2, 3] = value
    for name in ("a.png", "a.tif", "a.npz"):
        with pytest.raises(InputError, match="1 of the picture's 1536 values are not finite, so it is not written"):
            write_picture(tmp_path / name, image)
    with pytest.raises(InputError, match="not finite"):
        write_film(tmp_path / "a.gif", [RAMP, image])
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("a.jpg", {}, r"its ending is '\.jpg', but pictures end in \.png, \.tif, \.tiff, \.npz"),
        ("a", {}, "its ending is 'missing'"),
        ("a.png", {"bits": 32}, r"32 bits per pixel cannot be stored in \.png: choose 8 or 16, or another ending"),
        ("a.npz", {"bits": 8}, r"8 bits per pixel cannot be stored in \.npz: choose 32"),
        ("a.png", {"gamma": 0.0}, r"gamma is 0\.0, but it must be from 0\.1 to 10"),
        ("a.png", {"gamma": float("nan")}, "gamma is nan"),
        ("a.npz", {"gamma": 2.2}, "gamma is 2.2, but 32-bit pictures hold linear intensity"),
    ],
)
def test_formats_that_cannot_be(name, options, message):
    with pytest.raises(InputError, match=message):
        PictureFormat.of(name, **options)


def test_reading_what_is_no_picture(tmp_path):
    with pytest.raises(InputError, match="There is no picture .*a.png: check the path"):
        read_picture(tmp_path / "a.png")
    (tmp_path / "a.png").write_text("not a picture")
    with pytest.raises(InputError, match="a.png cannot be read as a picture"):
        read_picture(tmp_path / "a.png")
    np.savez(tmp_path / "a.npz", other=RAMP)
    with pytest.raises(InputError, match="does not hold an array `image`"):
        read_picture(tmp_path / "a.npz")


@pytest.mark.parametrize("mode", ["1", "P", "LA", "RGBA"])
def test_ways_of_storing_a_picture(tmp_path, mode):
    levels = np.zeros((4, 6), np.uint8)
    levels[:, 3:] = 255
    Image.fromarray(levels).convert("RGB").convert(mode).save(tmp_path / "a.png")
    assert read_picture(tmp_path / "a.png") == pytest.approx(levels / 255, abs=1e-6)


def test_colours_are_read_as_luma(tmp_path):
    colours = np.zeros((4, 4, 3), np.uint8)
    colours[..., 1] = 255
    Image.fromarray(colours).save(tmp_path / "green.png")
    assert load_pixels(tmp_path / "green.png").shape == (4, 4, 3)
    assert read_picture(tmp_path / "green.png") == pytest.approx(np.full((4, 4), 0.587), abs=1e-6)


def test_gif(tmp_path):
    frames = [np.full((5, 7), level) for level in (0.0, 0.5, 1.0)]
    assert write_film(tmp_path / "a.gif", iter(frames), rate=25.0) == 3
    with Image.open(tmp_path / "a.gif") as film:
        assert film.size == (7, 5)
        levels = []
        for number in range(film.n_frames):  # pyright: ignore[reportAttributeAccessIssue]
            film.seek(number)
            assert film.info["duration"] == 40
            levels.append(int(np.asarray(film.convert("L"))[2, 3]))
    assert levels == [0, 128, 255]


def test_a_film_needs_a_picture_and_a_known_ending(tmp_path):
    with pytest.raises(InputError, match="at least one picture"):
        write_film(tmp_path / "a.gif", [])
    with pytest.raises(InputError, match=r"its ending is '\.avi', but films end in \.gif or \.mp4"):
        check_film("a.avi")


def test_mp4_without_an_encoder(monkeypatch):
    monkeypatch.setenv("PATH", "")
    with pytest.raises(InputError, match=r"needs the program ffmpeg, which is not on this machine.*\.gif"):
        check_film("a.mp4")


@pytest.fixture
def encoder(tmp_path, monkeypatch):
    """A stand-in for ffmpeg: stores what it is fed, or fails if the picture is all black."""
    program = tmp_path / "bin" / "ffmpeg"
    program.parent.mkdir()
    program.write_text(
        f"#!{sys.executable}\n"
        "import sys\n"
        "data = sys.stdin.buffer.read()\n"
        "if not any(data):\n"
        "    sys.exit('first line\\nall is black')\n"
        "open(sys.argv[-1], 'wb').write(' '.join(sys.argv[1:-1]).encode() + b'|' + data)\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent))


def test_mp4_is_fed_to_the_encoder(tmp_path, encoder):
    frames = [np.full((2, 3), 1.0), np.zeros((2, 3))]
    assert write_film(tmp_path / "a.mp4", frames, rate=12.5) == 2
    options, data = (tmp_path / "a.mp4").read_bytes().split(b"|")
    assert b"-video_size 3x2 -framerate 12.5" in options
    assert data == b"\xff" * 6 + b"\x00" * 6


def test_an_encoder_that_fails_leaves_no_film(tmp_path, encoder):
    with pytest.raises(InputError, match="ffmpeg could not write the film: all is black"):
        write_film(tmp_path / "a.mp4", [np.zeros((2, 3))])
    assert os.listdir(tmp_path) == ["bin"]
