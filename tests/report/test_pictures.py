import os
import shutil
import subprocess
import sys

import imageio.v3
import ml_dtypes
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


@pytest.mark.parametrize(("count", "milliseconds"), [(1, 2000), (4, 500), (25, 80), (50, 40), (60, 40)])
def test_write_film_without_a_rate_lasts_two_seconds_at_least(tmp_path, encoder, count, milliseconds):
    """Also from an iterator, whose length is not known before its end."""
    frames = [np.full((2, 4), (number + 1) / count) for number in range(count)]
    assert write_film(tmp_path / "a.gif", iter(frames)) == count
    with Image.open(tmp_path / "a.gif") as film:
        assert film.n_frames == count  # pyright: ignore[reportAttributeAccessIssue]
        assert film.info["duration"] == milliseconds and film.info["loop"] == 0
    assert write_film(tmp_path / "a.mp4", iter(frames)) == count
    options, data = (tmp_path / "a.mp4").read_bytes().split(b"|", 1)
    assert f"-framerate {1000 / milliseconds:g} ".encode() in options and len(data) == 8 * count


def test_a_film_needs_a_picture_and_a_known_ending(tmp_path):
    with pytest.raises(InputError, match="at least one picture"):
        write_film(tmp_path / "a.gif", [])
    with pytest.raises(InputError, match=r"its ending is '\.avi', but films end in \.gif or \.mp4"):
        check_film("a.avi")


def test_mp4_without_an_encoder(monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match=r"needs the program ffmpeg, which is not on this machine.*\.gif"):
        check_film("a.mp4")


def test_mp4_is_fed_to_the_encoder(tmp_path, encoder):
    frames = [np.full((2, 4), 1.0), np.zeros((2, 4))]
    assert write_film(tmp_path / "a.mp4", frames, rate=12.5) == 2
    options, data = (tmp_path / "a.mp4").read_bytes().split(b"|")
    assert b"-video_size 4x2 -framerate 12.5" in options
    assert data == b"\xff" * 8 + b"\x00" * 8


def test_an_encoder_that_fails_leaves_no_film(tmp_path, encoder):
    with pytest.raises(InputError, match=r"Cannot write .*a\.mp4: ffmpeg failed, saying all is black\.$"):
        write_film(tmp_path / "a.mp4", [np.zeros((2, 4))])
    assert os.listdir(tmp_path) == ["bin"]


def test_an_encoder_that_stops_reading_leaves_no_film(tmp_path, encoder):
    """Whatever it says at its end: the film would be cut short."""
    encoder.write_text("#!/bin/sh\nexit 0\n")
    with pytest.raises(InputError, match=r"Cannot write .*a\.mp4: ffmpeg failed, without a reason"):
        write_film(tmp_path / "a.mp4", (np.zeros((512, 512)) for _ in range(50)))
    assert os.listdir(tmp_path) == ["bin"]


@pytest.mark.parametrize(("shape", "size"), [((3, 4), "4x4"), ((4, 5), "6x4"), ((3, 5), "6x4"), ((1, 1), "2x2")])
def test_write_film_says_what_size_an_mp4_gets(tmp_path, encoder, shape, size):
    with pytest.warns(UserWarning, match=f"the film is {size}, for pictures of {shape[1]}x{shape[0]}: an MP4 has even"):
        write_film(tmp_path / "a.mp4", [np.ones(shape)])
    wide, tall = size.split("x")
    assert f"pad={wide}:{tall}".encode() in (tmp_path / "a.mp4").read_bytes()


FILMS = {
    "static": lambda number: 0.5,
    "different": lambda number: number / 20,
    "alternating": lambda number: number % 2,
    "in pairs": lambda number: (number // 2) / 10,
    "black": lambda number: 0.0,
}


def film_of(kind: str, count: int) -> list[np.ndarray]:
    ramp = np.linspace(0, 0.02, 24).reshape(4, 6)
    return [np.clip(ramp + FILMS[kind](number), 0, 1) for number in range(count)]


@pytest.mark.parametrize("kind", FILMS)
@pytest.mark.parametrize("count", range(1, 21))
def test_a_gif_has_as_many_pictures_as_were_handed_in(tmp_path, kind, count):
    frames = film_of(kind, count)
    assert write_film(tmp_path / "a.gif", frames) == count
    expected = np.stack([quantise(frame) for frame in frames])
    with Image.open(tmp_path / "a.gif") as film:
        read = []
        for number in range(film.n_frames):  # pyright: ignore[reportAttributeAccessIssue]
            film.seek(number)
            read.append(np.asarray(film.convert("L")))
    np.testing.assert_array_equal(read, expected)
    assert gif_pictures((tmp_path / "a.gif").read_bytes()) == count
    np.testing.assert_array_equal(np.stack(list(imageio.v3.imiter(tmp_path / "a.gif"))), expected)


def gif_pictures(data: bytes) -> int:
    """Image descriptors of a GIF, counted along its blocks (GIF89a specification, appendix A)."""
    assert data[:6] == b"GIF89a"
    place, count = 13 + 3 * 2 ** ((data[10] & 7) + 1) * (data[10] >> 7), 0

    def after_sub_blocks(place: int) -> int:
        while data[place]:
            place += data[place] + 1
        return place + 1

    while data[place] != 0x3B:
        if data[place] == 0x21:
            place = after_sub_blocks(place + 2)
        else:
            assert data[place] == 0x2C
            flags, count = data[place + 9], count + 1
            place = after_sub_blocks(place + 11 + 3 * 2 ** ((flags & 7) + 1) * (flags >> 7))
    assert place == len(data) - 1
    return count


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs the program ffmpeg")
@pytest.mark.parametrize("kind", FILMS)
@pytest.mark.parametrize("count", [1, 2, 3, 5, 8, 20])
@pytest.mark.parametrize("rate", [0.5, 25.0, 1000 / 3])
def test_an_mp4_has_as_many_pictures_as_were_handed_in(tmp_path, kind, count, rate):
    path = tmp_path / "2026-11-29T08:00:00.mp4"
    assert write_film(path, [np.kron(frame, np.ones((16, 16))) for frame in film_of(kind, count)], rate=rate) == count
    command = ["ffmpeg", "-loglevel", "error", "-i", f"file:{path}", "-fps_mode", "passthrough"]
    read = subprocess.run([*command, "-f", "rawvideo", "-pix_fmt", "gray", "-"], capture_output=True, check=True).stdout
    levels = np.frombuffer(read, np.uint8).reshape(-1, 64, 96).mean(axis=(1, 2))
    assert levels == pytest.approx([255 * frame.mean() for frame in film_of(kind, count)], abs=4)


@pytest.mark.parametrize(
    ("pictures", "message"),
    [
        ([(4, 6), (4, 5)], r"Picture 2 of the film is 5x4, but the first is 6x4: bring all to one size\.$"),
        ([(4, 6), (4, 6), (6, 4)], "Picture 3 of the film is 4x6, but the first is 6x4"),
        ([(4, 6), (8, 12)], "Picture 2 of the film is 12x8"),
        ([(4, 6), (4, 6, 3)], r"Picture 2 of the film has shape \(4, 6, 3\), but a picture is \(rows, columns\)"),
        ([(4,)], r"Picture 1 of the film has shape \(4,\)"),
        ([()], r"Picture 1 of the film has shape \(\)"),
        ([(0, 4)], r"Picture 1 of the film has shape \(0, 4\)"),
        ([], "A film needs at least one picture, but there is none"),
    ],
)
@pytest.mark.parametrize("ending", ["gif", "mp4"])
def test_write_film_of_pictures_that_do_not_fit_is_refused(tmp_path, encoder, pictures, message, ending):
    path = tmp_path / f"a.{ending}"
    path.write_bytes(b"old")
    with pytest.raises(InputError, match=message):
        write_film(path, (np.ones(shape) for shape in pictures))
    assert path.read_bytes() == b"old" and sorted(os.listdir(tmp_path)) == sorted([path.name, "bin"])


class Elsewhere:
    """An array that cannot be had, as a tensor on another device."""

    def __array__(self, dtype=None, copy=None):
        raise TypeError("it is on another device")


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.arange(256, dtype=np.uint8).reshape(16, 16), "holds whole numbers from 0 to 255, but intensity is 0 for"),
        (np.full((2, 2), -1), "holds whole numbers from -1 to -1"),
        (np.full((2, 2), 65535, np.uint16), "as in image / 255"),
        (np.ones((2, 2), complex), "holds values of type complex128, but a picture holds real numbers"),
        (np.array([["a", "b"]]), "holds values of type <U1"),
        (np.array([[None, 1.0]]), "holds values of type object"),
        (np.array([["2026-11-29"]], "datetime64[D]"), r"holds values of type datetime64\[D\]"),
        (np.ones((2, 2), [("x", float)]), "holds values of type"),
        (Elsewhere(), r"is a Elsewhere that NumPy cannot read \(TypeError: it is on another device\); give"),
        (np.ones((2, 2, 3)), r"has shape \(2, 2, 3\), but a picture is \(rows, columns\)"),
        (np.ones((0, 3)), r"has shape \(0, 3\)"),
        (np.array(0.5), r"has shape \(\)"),
        (np.array([[np.nan, 1.0]]), "1 of the picture's 2 values are not finite"),
    ],
)
def test_what_is_no_picture_is_not_written(tmp_path, image, message):
    for name in ("a.png", "a.tif", "a.npz"):
        with pytest.raises(InputError, match=message) as refused:
            write_picture(tmp_path / name, image)
        assert ". " not in str(refused.value)  # one sentence
    with pytest.raises(InputError, match=message):
        write_film(tmp_path / "a.gif", [np.ones((2, 2)), image])
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.int64, np.float16, np.float32, np.float64, ml_dtypes.bfloat16])
def test_types_that_hold_intensities(tmp_path, dtype):
    image = np.array([[0, 1, 1], [1, 0, 0]]).astype(dtype)
    write_film(tmp_path / "a.gif", [image, image.astype(float)])
    for name in ("a.png", "a.tif", "a.npz", "a.gif"):
        if name != "a.gif":
            write_picture(tmp_path / name, image)
        assert read_picture(tmp_path / name).tolist() == [[0, 1, 1], [1, 0, 0]]


def test_a_gif_too_wide_for_the_format_is_refused(tmp_path):
    write_film(tmp_path / "a.gif", [np.zeros((1, 65535))])
    with pytest.raises(InputError, match="The pictures are 65536x1, but a GIF has at most 65535 pixels along a side"):
        write_film(tmp_path / "b.gif", [np.zeros((1, 65536))])
    assert os.listdir(tmp_path) == ["a.gif"]


def test_a_film_is_written_picture_by_picture(tmp_path):
    """A long one needs no more memory than a short one: the pictures go into the file as they come."""
    sizes = []

    def frames():
        for _ in range(20):
            yield np.random.default_rng(0).random((100, 100))
            sizes.append(sum(file.stat().st_size for file in tmp_path.iterdir()))

    assert write_film(tmp_path / "a.gif", frames(), rate=25.0) == 20
    assert all(later > sooner for sooner, later in zip(sizes, sizes[1:], strict=False))
