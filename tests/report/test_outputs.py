"""Rules for every file that is written: odd names, links, and places where nothing can be written."""

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from scsr_opt._files import check_writable, whole_file
from scsr_opt.camera import Recording, read_recording, write_recording
from scsr_opt.errors import InputError
from scsr_opt.report import Report, read_picture, write_film, write_picture

PICTURE = np.random.default_rng(0).random((40, 60)).astype(np.float32)
CHARGE = np.random.default_rng(0).random((40, 60)) + 0.3 * np.arange(31)[:, None, None]
SPIKES = np.diff(np.floor(CHARGE), axis=0).astype(np.uint8)  # regular, as those of a camera
REPORT = Report({"name": "x" * 5000}, {}, {}, {}, None, {}, None, None, [], {}, {})


def _figure(path: Path) -> None:
    drawn = Figure(figsize=(4, 4))
    drawn.add_axes((0, 0, 1, 1)).imshow(PICTURE)
    with whole_file(path) as temporary:
        drawn.savefig(temporary)


def _is_picture(path: Path) -> bool:
    return np.abs(read_picture(path) - PICTURE).max() < 1 / 255


def _is_film(path: Path) -> bool:
    with Image.open(path) as film:
        return film.n_frames == 3  # pyright: ignore[reportAttributeAccessIssue]


def _is_recording(path: Path) -> bool:
    return np.array_equal(read_recording(path, size="60x40" if path.suffix.lower() == ".dat" else None).spikes, SPIKES)


WRITERS = {
    "png": (lambda path: write_picture(path, PICTURE), _is_picture),
    "tif": (lambda path: write_picture(path, PICTURE), _is_picture),
    "npz": (lambda path: write_picture(path, PICTURE), _is_picture),
    "gif": (lambda path: write_film(path, [PICTURE] * 3), _is_film),
    "mp4": (lambda path: write_film(path, [PICTURE] * 3), lambda path: len(path.read_bytes()) > 3 * PICTURE.size),
    "json": (REPORT.write, lambda path: path.read_text() == REPORT.json() + "\n"),
    "svg": (_figure, lambda path: "</svg>" in path.read_text()),
    "pdf": (_figure, lambda path: path.read_bytes().startswith(b"%PDF")),
    "dat": (lambda path: write_recording(path, SPIKES), _is_recording),
    "npy": (lambda path: write_recording(path, SPIKES), _is_recording),
    "recording.npz": (lambda path: write_recording(path, SPIKES), _is_recording),
    "h5": (lambda path: write_recording(path, Recording.from_array(SPIKES, bad_pixels=SPIKES[0])), _is_recording),
}
"""By ending: what writes such a file, and whether that was written."""

every_writer = pytest.mark.parametrize("ending", WRITERS)


@pytest.fixture
def folder(tmp_path, monkeypatch, encoder) -> Path:
    """An empty one, where the test is."""
    path = tmp_path / "here"
    path.mkdir()
    monkeypatch.chdir(path)
    return path


NAMES = {
    "colons": "2026-11-29T08:00:00",
    "protocol": "file:",
    "pipe": "pipe:1",
    "spaces": " two  words ",
    "dash": "-vf",
    "percent": "100%d%s%03d%",
    "quotes": '"it\'s"',
    "letters": "Straße 電影 🎥",
    "hash": "a#1",
    "question mark": "a?b=c&d",
    "star": "*[a-z]{x}",
    "newline": "two\nlines",
    "tab": "a\tb",
    "dollars": "$\\frac{x$",
    "dots": "...a..b.",
    "back": "a\\b",
    "home": "~",
    "no text": os.fsdecode(b"\xff\xfe"),
    "capitals": "A.PNG",
}


@every_writer
@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
def test_odd_names_are_written_and_read(folder, name, ending):
    write, written = WRITERS[ending]
    path = Path(f"{name}.{ending}")
    check_writable(path)
    write(path)
    assert os.listdir() == [str(path)] and written(path)
    assert written(folder / path)


@every_writer
@pytest.mark.parametrize("letter", ["x", "é", "電"])
def test_the_longest_names_are_written(folder, letter, ending):
    """255 bytes."""
    write, written = WRITERS[ending]
    room = 255 - len(f".{ending}")
    path = Path(letter * (room // len(letter.encode())) + f".{ending}")
    check_writable(path)
    write(path)
    assert os.listdir() == [str(path)] and written(path)


@every_writer
def test_endings_in_capitals(folder, ending):
    write, written = WRITERS[ending]
    path = Path(f"a.{ending.upper()}")
    write(path)
    assert os.listdir() == [str(path)] and written(path)


def _file(path: Path) -> Path:
    path.write_text("a file")
    return path


def _link(path: Path, to: str) -> Path:
    path.symlink_to(to)
    return path


def _pipe(path: Path) -> Path:
    os.mkfifo(path)
    return path


def _folder(path: Path) -> Path:
    path.mkdir()
    return path


REFUSED = {
    "too long": (lambda name: Path("x" * 255 + name), "file name too long"),
    "too long in bytes": (lambda name: Path("é" * 127 + name), "file name too long"),
    "null": (lambda name: Path("a\0b" + name), "(holds a null character|embedded null byte)"),
    "missing folder": (lambda name: Path("missing") / name, "the folder missing does not exist; make it first"),
    "a file as folder": (lambda name: _file(Path("file")) / name, "not a directory"),
    "folder": (lambda name: _folder(Path(name)), "it is a folder; name a file in it"),
    "pipe": (lambda name: _pipe(Path(name)), "it is a device or a pipe; name a file"),
    "link to a folder": (lambda name: _link(Path(name), "."), "it is a folder; name a file in it"),
    "link to a device": (lambda name: _link(Path(name), "/dev/null"), "it is a device or a pipe; name a file"),
    "link to itself": (lambda name: _link(Path(name), name), "a symbolic link that leads to itself; remove it first"),
    "link into nothing": (lambda name: _link(Path(name), "missing/a"), "the folder .*missing does not exist"),
}


@every_writer
@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_written_is_refused_before_and_while_writing(folder, case, ending):
    make, message = REFUSED[case]
    path = make(f"a.{ending}")
    there = sorted(os.listdir())
    for write in (check_writable, WRITERS[ending][0]):
        with pytest.raises(InputError, match=f"(Cannot write .*: .*)?{message}") as refused:
            write(path)
        assert ". " not in str(refused.value).replace("\0", "")
    assert sorted(os.listdir()) == there and os.path.exists("/dev/null") and not os.path.isfile("/dev/null")


@every_writer
def test_a_folder_that_takes_no_files_is_named(folder, monkeypatch, ending):
    def refuse(*_, **__):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("pathlib.Path.touch", refuse)
    for write in (check_writable, WRITERS[ending][0]):
        with pytest.raises(InputError, match=rf"^Cannot write a\.{ending}: read-only file system\.$"):
            write(Path(f"a.{ending}"))
    assert os.listdir() == []


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file may grow beyond `size` bytes meanwhile: the kernel refuses to write, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("ending", sorted(WRITERS.keys() - {"mp4"}))  # where a stand-in writes
@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 0.99])
@pytest.mark.parametrize("old", [False, True])
def test_a_full_disk_is_said_with_the_file_s_name_and_leaves_nothing(folder, ending, share, old):
    write, written = WRITERS[ending]
    path = Path(f"a.{ending}")
    write(path)
    size = path.stat().st_size
    if not old:
        path.unlink()
    with largest_file(int(share * size)), pytest.raises(InputError) as refused:
        write(path)
    assert str(refused.value) == f"Cannot write {path}: file too large."
    assert os.listdir() == [str(path)] * old
    assert not old or written(path)


@every_writer
@pytest.mark.parametrize("there", [False, True])
def test_a_link_stays_and_what_it_leads_to_is_written(folder, ending, there):
    write, written = WRITERS[ending]
    target = _folder(folder / "elsewhere") / "stored"  # whatever its ending
    if there:
        target.write_text("old")
    _link(folder / "chain", "elsewhere/stored")
    path = _link(Path(f"a.{ending}"), "chain")
    check_writable(path)
    write(path)
    assert path.is_symlink() and os.readlink(path) == "chain" and os.readlink("chain") == "elsewhere/stored"
    assert not target.is_symlink() and os.listdir("elsewhere") == ["stored"] and written(path)
    assert sorted(os.listdir()) == sorted([path.name, "chain", "elsewhere"])


@every_writer
def test_a_link_to_a_folder_on_the_way_is_followed(folder, ending):
    write, written = WRITERS[ending]
    _folder(folder / "real")
    path = _link(Path("link"), "real") / f"a.{ending}"
    write(path)
    assert os.listdir("real") == [path.name] and written(path) and Path("link").is_symlink()


def test_what_a_link_leads_to_stays_when_writing_fails(folder):
    target = _file(folder / "stored")
    path = _link(Path("a.gif"), "stored")
    with pytest.raises(InputError, match="Picture 2 of the film is 2x2"):
        write_film(path, [PICTURE, np.ones((2, 2))])
    assert target.read_text() == "a file" and path.is_symlink() and sorted(os.listdir()) == ["a.gif", "stored"]


def test_a_fault_of_what_is_read_meanwhile_is_not_the_file_s(folder):
    def frames():
        yield PICTURE
        raise OSError(28, "No space left on device", "of the camera")

    with pytest.raises(OSError, match="of the camera") as raised:
        write_film(Path("a.gif"), frames())
    assert not isinstance(raised.value, InputError) and os.listdir() == []
