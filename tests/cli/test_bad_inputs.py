"""Bad recordings, options and outputs: one line of error from every command, and nothing half-written.

Each case is a file that is damaged on purpose, a name, or options; the folder has to be the same after the command,
byte for byte. No case may come as far as a solve.
"""

import gzip
import os
import shutil
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("solves")


# --- Recordings that cannot be read: each by every command that reads one.


def cut(name: str, length: int) -> Callable[[], str]:
    """The file with only its first `length` bytes, or all but the last ones if that is negative."""

    def make() -> str:
        Path(name).write_bytes(Path(name).read_bytes()[:length])
        return name

    return make


def written(name: str, content: bytes) -> Callable[[], str]:
    def make() -> str:
        Path(name).write_bytes(content)
        return name

    return make


def archive(**arrays: object) -> Callable[[], str]:
    def make() -> str:
        content: dict[str, Any] = {name: np.asarray(value) for name, value in arrays.items()}
        np.savez("bad.npz", **content)
        return "bad.npz"

    return make


def array(value: object) -> Callable[[], str]:
    def make() -> str:
        np.save("bad.npy", np.asarray(value))
        return "bad.npy"

    return make


def header(text: str, version: bytes = b"\x01\x00") -> Callable[[], str]:
    """A `.npy` with this header, and 100 bytes after it."""
    padded = text.encode("latin-1").ljust(117) + b"\n"
    return written("bad.npy", b"\x93NUMPY" + version + len(padded).to_bytes(2, "little") + padded + bytes(100))


def hdf5(fill: Callable[[h5py.File], object]) -> Callable[[], str]:
    def make() -> str:
        with h5py.File("bad.h5", "w") as file:
            fill(file)
        return "bad.h5"

    return make


def linked(name: str, target: str) -> Callable[[], str]:
    def make() -> str:
        os.symlink(target, name)
        return name

    return make


def folder(name: str) -> Callable[[], str]:
    def make() -> str:
        os.mkdir(name)
        return name

    return make


def pipe() -> str:
    os.mkfifo("pipe.dat")
    return "pipe.dat"


def plug() -> str:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind("plug.npz")
    return "plug.npz"


def named(name: str) -> Callable[[], str]:
    return lambda: name


def flipped_byte(name: str, place: int) -> Callable[[], str]:
    """The file with all bits of a byte turned."""

    def make() -> str:
        content = bytearray(Path(name).read_bytes())
        content[place] ^= 0xFF
        Path(name).write_bytes(bytes(content))
        return name

    return make


def spikes_hdf5(file: h5py.File, **attributes: object) -> None:
    file["raw_spike"] = np.tile(np.eye(8, dtype=np.uint8), (8, 1, 1))
    file.attrs.update(attributes)


ONES = np.ones((9, 8, 8), np.uint8)
BAD_RECORDINGS: dict[str, Callable[[], str]] = {
    "missing": named("none.npz"),
    "no name": named(""),
    "this folder": named("."),
    "root": named("/"),
    "missing in a missing folder": named("none/none.dat"),
    "below a file": named("ramp.npz/ramp.npz"),
    "name too long": named("x" * 300 + ".npz"),
    "path too long": named("x/" * 3000 + "a.npz"),
    "null in its name": named("a\0b.npz"),
    "newline in its name": named("a\nb.npz"),
    "colon in its name": named("a:b.dat"),
    "pattern": named("*.npy.npz"),
    "ending only": named(".npz"),
    "without an ending": written("ramp", b"\1\2"),
    "unknown ending": written("ramp.raw", b"\1\2"),
    "spaces after the ending": written("ramp.npz ", b"\1\2"),
    "folder": folder("folder.npz"),
    "folder of a flat file": folder("folder.dat"),
    "dangling link": linked("link.npz", "nowhere.npz"),
    "link to itself": linked("loop.npz", "loop.npz"),
    "link to a folder": linked("link.h5", "."),
    "link to a device": linked("null.dat", "/dev/null"),
    "pipe": pipe,
    "socket": plug,
    "empty npz": written("bad.npz", b""),
    "empty npy": written("bad.npy", b""),
    "empty h5": written("bad.h5", b""),
    "empty dat": written("bad_40x24.dat", b""),
    "npz cut to 3 bytes": cut("ramp.npz", 3),
    "npz cut in its first header": cut("ramp.npz", 40),
    "npz cut before its directory": cut("ramp.npz", -200),
    "npz cut by a byte": cut("ramp.npz", -1),
    "npy cut in its signature": cut("ramp.npy", 4),
    "npy cut in its header": cut("ramp.npy", 60),
    "npy cut in its frames": cut("ramp.npy", -1),
    "h5 cut in its signature": cut("ramp.h5", 6),
    "h5 cut in its header": cut("ramp.h5", 60),
    "h5 cut in its frames": cut("ramp.h5", 2000),
    "dat shorter than a frame": cut("ramp_40x24.dat", 119),
    "npz with a wrong checksum": flipped_byte("ramp.npz", 300),
    "npz with a wrong directory": flipped_byte("ramp.npz", -22),
    "npy of another version": flipped_byte("ramp.npy", 6),
    "h5 with a wrong superblock": flipped_byte("ramp.h5", 9),
    "npz that is text": written("bad.npz", b"frames of a camera, one per line\n" * 40),
    "dat that is text": written("bad_40x24.dat", b"frames of a camera, one per line\n" * 40),
    "dat that is a web page": written("bad_40x24.dat", b"<!DOCTYPE html><html>404</html>" * 40),
    "dat that is gzip": written("bad_40x24.dat", gzip.compress(bytes(1000))),
    "npy that is a zip": lambda: shutil.copy("ramp.npz", "bad.npy"),
    "npz that is an array": lambda: shutil.copy("ramp.npy", "bad.npz"),
    "h5 that is an array": lambda: shutil.copy("ramp.npy", "bad.h5"),
    "dat that is HDF5": lambda: shutil.copy("ramp.h5", "bad_40x24.dat"),
    "dat of an unknown size": lambda: shutil.copy("ramp_40x24.dat", "ramp.dat"),
    "dat with a size of zero": lambda: shutil.copy("ramp_40x24.dat", "ramp_00x24.dat"),
    "dat with a size that is too large": lambda: shutil.copy("ramp_40x24.dat", "ramp_99999x99999.dat"),
    "npz without arrays": archive(),
    "npz of unknown names": archive(light=ONES),
    "npz of objects": archive(spikes=np.array([{"a": 1}], object)),
    "npz of text": archive(spikes=np.array([[["a"]]])),
    "npz of records": archive(spikes=np.zeros((9, 8, 8), [("a", "u1")])),
    "npz of dates": archive(spikes=np.zeros((9, 8, 8), "M8[s]")),
    "npz of floats": archive(spikes=ONES.astype(float)),
    "npz of complex numbers": archive(spikes=ONES.astype(complex)),
    "npz of intensities": archive(spikes=ONES * 9),
    "npz of negative numbers": archive(spikes=-ONES.astype(int)),
    "npz of one frame without its axis": archive(spikes=ONES[0]),
    "npz of four dimensions": archive(spikes=ONES[None]),
    "npz of a number": archive(spikes=1),
    "npz without frames": archive(spikes=ONES[:0]),
    "npz without rows": archive(spikes=ONES[:, :0]),
    "npz of which time cannot be told": archive(arr_0=np.zeros((32, 32, 32), np.uint8)),
    "npz with a white rate of nan": archive(spikes=ONES, white_rate=np.nan),
    "npz with a white rate of text": archive(spikes=ONES, white_rate="bright"),
    "npz with three white rates": archive(spikes=ONES, white_rate=[1, 2, 3]),
    "npz with no white rate in its array": archive(spikes=ONES, white_rate=[]),
    "npz with a readout rate of zero": archive(spikes=ONES, readout_rate=0),
    "npz with a readout rate of a date": archive(spikes=ONES, readout_rate=np.datetime64("2026-01-01")),
    "npz with a mask of another shape": archive(spikes=ONES, bad_pixels=np.ones((3, 3), bool)),
    "npz with a mask of floats": archive(spikes=ONES, bad_pixels=np.ones((8, 8))),
    "npz with a mask of text": archive(spikes=ONES, bad_pixels="none"),
    "npz with a mask of no pixels": archive(spikes=ONES, bad_pixels=np.ones((0, 8), int)),
    "npz packed to another length": archive(seq=ONES, length=5),
    "npz packed to no length": archive(seq=ONES, length="many"),
    "npz packed to a length of none": archive(seq=ONES, length=0),
    "npz packed to two lengths": archive(seq=ONES, length=[72, 72]),
    "npy of objects": array(np.array([None], object)),
    "npy of a number": array(3),
    "npy of intensities": array(ONES * 200),
    "npy of floats": array(ONES * 0.5),
    "npy with a header of nonsense": header("nonsense"),
    "npy with a header that is no dictionary": header("[1, 2]"),
    "npy with an open bracket in its header": header("{'descr': '|u1', 'fortran_order': False, 'shape': (1,"),
    "npy with a type that is none": header("{'descr': '|q9', 'fortran_order': False, 'shape': (1, 1, 1), }"),
    "npy with a negative shape": header("{'descr': '|u1', 'fortran_order': False, 'shape': (-1, 8, 8), }"),
    "npy that promises too much": header("{'descr': '|u1', 'fortran_order': False, 'shape': (9999999, 250, 400), }"),
    "npy beyond any memory": header("{'descr': '|u1', 'fortran_order': False, 'shape': (2**62, 250, 400), }"),
    "npy of more than integers hold": header("{'descr': '|u1', 'fortran_order': False, 'shape': (10**25, 2, 2), }"),
    "npy of a version to come": header("{'descr': '|u1', 'fortran_order': False, 'shape': (1, 8, 8), }", b"\x09\x00"),
    "h5 without datasets": hdf5(lambda file: None),
    "h5 of unknown names": hdf5(lambda file: file.create_dataset("light", data=ONES)),
    "h5 with a group of that name": hdf5(lambda file: file.create_group("raw_spike")),
    "h5 of floats": hdf5(lambda file: file.create_dataset("raw_spike", data=ONES * 0.5)),
    "h5 of text": hdf5(lambda file: file.create_dataset("raw_spike", data="spikes")),
    "h5 of nothing": hdf5(lambda file: file.create_dataset("raw_spike", data=h5py.Empty("u1"))),
    "h5 of intensities": hdf5(lambda file: file.create_dataset("raw_spike", data=ONES * 7)),
    "h5 with a rate of text": hdf5(lambda file: spikes_hdf5(file, white_rate="bright")),
    "h5 with a rate of nothing": hdf5(lambda file: spikes_hdf5(file, white_rate=h5py.Empty("f4"))),
    "h5 with a rate below zero": hdf5(lambda file: spikes_hdf5(file, readout_rate=-1.0)),
    "h5 with a link to nowhere": hdf5(lambda file: file.update({"raw_spike": h5py.SoftLink("/none")})),
    "h5 with a link to no file": hdf5(lambda file: file.update({"raw_spike": h5py.ExternalLink("none.h5", "/a")})),
    "h5 with a link to itself": hdf5(lambda file: file.update({"raw_spike": h5py.SoftLink("/raw_spike")})),
}
OTHERS = (
    ["play", "FILE", "-o", "new.png"],
    ["solve", "FILE", "-o", "new.png", "--report", "new.json", "--figure", "new.pdf"],
    ["sequence", "FILE", "-o", "new.zarr"],
    ["batch", "FILE", "-o", "new", "--quiet"],
)
"""Commands that read a recording, besides `scsr info`."""


@pytest.mark.parametrize("number", range(len(BAD_RECORDINGS)), ids=list(BAD_RECORDINGS))
def test_bad_recordings(refused, number):
    """By `scsr info`, and by one of the others in turn."""
    file = list(BAD_RECORDINGS.values())[number]()
    for command in (["info", "FILE"], OTHERS[number % len(OTHERS)]):
        refused(*(file if part == "FILE" else part for part in command))


# --- Options.

LONG = "9" * 5000  # more digits than Python reads
WRONG_OPTIONS = [
    # Reading, the same in all commands.
    "info ramp_40x24.dat --size 40",
    "info ramp_40x24.dat --size 40x",
    "info ramp_40x24.dat --size 40x-24",
    "info ramp_40x24.dat --size 0x24",
    "info ramp_40x24.dat --size 40x24x3",
    "info ramp_40x24.dat --size 40.5x24",
    "info ramp_40x24.dat --size 100000x100000",
    f"info ramp_40x24.dat --size {LONG}x24",
    "info ramp_40x24.dat --size",
    "info ramp.npz --size 41x24",
    "info ramp_40x24.dat --row-bits 0",
    "info ramp_40x24.dat --row-bits 8",
    "info ramp_40x24.dat --row-bits 1.5",
    "info ramp_40x24.dat --row-bits 99999999",
    f"info ramp_40x24.dat --row-bits {LONG}",
    "info ramp.npz --row-bits 40",
    "info ramp_40x24.dat --array spikes",
    "info ramp.npy --array spikes",
    "info ramp.npz --array none",
    "info ramp.h5 --array none/none",
    "info ramp.h5 --array /",
    "info ramp.npz --array white_rate",
    "info ramp.npz --white-rate 0",
    "info ramp.npz --white-rate nan",
    "info ramp.npz --white-rate -inf",
    "info ramp.npz --white-rate bright",
    "info ramp.npz --readout-rate 1e99",
    "info ramp.npz --readout-rate -4",
    "info ramp.npz --bad-pixels none.npy",
    "info ramp.npz --bad-pixels .",
    "info ramp.npz --bad-pixels ramp.npz",
    "info ramp.npz --bad-pixels ramp.npy",
    "info ramp.npz --bad-pixels ramp_40x24.dat",
    "info ramp.npz --calibration none.npz",
    "info ramp.npz --calibration .",
    "info ramp.npz --calibration ramp.npz",
    "info ramp.npz --calibration ramp.npy",
    "info ramp.npz --calibration ramp_40x24.dat",
    "info ramp.npz --crop 0,0,25,40",
    "info ramp.npz --crop -1,0,5,5",
    "info ramp.npz --crop 0,0,0,5",
    "info ramp.npz --crop 0,0,5",
    "info ramp.npz --crop a,b,c,d",
    "info ramp.npz --crop 0.5,0,5,5",
    f"info ramp.npz --crop 0,0,{LONG},5",
    "info ramp.npz --crop 0,0,99999999999999999999,5",
    "info ramp.npz --flip yes",
    "info ramp.npz --jsn",
    "info ramp.npz ramp.npy",
    "info",
    "info --quiet",
    "info --size 40x24",
    "inof ramp.npz",
    "play ramp.npz -o new.jpg",
    "play ramp.npz -o new",
    "play ramp.npz -o .png",
    "play ramp.npz -o none/new.png",
    "play ramp.npz -o ramp.npz",
    "play ramp.npz -o ramp.npz --overwrite",
    "play ramp.npz -o ramp.npy",
    "play ramp.npz -o /proc/new.png",
    "play ramp.npz -o /dev/null",
    "play ramp.npz -o new.png --key 31",
    "play ramp.npz -o new.png --key -1",
    "play ramp.npz -o new.png --key 1.0",
    f"play ramp.npz -o new.png --key {LONG}",
    "play ramp.npz -o new.png --key 99999999999999999999",
    "play ramp.npz -o new.png --window 0",
    "play ramp.npz -o new.png --window 32",
    "play ramp.npz -o new.png --window 5 --method stp",
    "play ramp.npz -o new.png --method none",
    "play ramp.npz -o new.png --bits 7",
    "play ramp.npz -o new.png --gamma nan",
    "play ramp.npz -o new.png --gamma 1e-400",
    "play ramp.npz -o new.png --white 0",
    "play ramp.npz -o new.npz --white 1",
    "play ramp.npz -o new.png --start 3",
    "play ramp.npz -o new.gif --start 20 --stop 10",
    "play ramp.npz -o new.gif --start 5 --stop 5",
    "play ramp.npz -o new.gif --start -5",
    "play ramp.npz -o new.gif --stop 32",
    "play ramp.npz -o new.gif --step 0",
    "play ramp.npz -o new.gif --rate inf",
    "play ramp.npz -o new.gif --key 3",
    "play ramp.npz -o new.gif --bits 8",
    "play ramp.npz -o new.mp4 --rate -1",
    "solve ramp.npz",
    "solve ramp.npz -o",
    "solve ramp.npz -o new.bmp",
    "solve ramp.npz -o new.png --scale 0",
    "solve ramp.npz -o new.png --scale -3",
    "solve ramp.npz -o new.png --scale 2.5",
    "solve ramp.npz -o new.png --scale two",
    f"solve ramp.npz -o new.png --scale {LONG}",
    "solve ramp.npz -o new.png --key 31",
    "solve ramp.npz -o new.png --key -1",
    "solve ramp.npz -o new.png --frames 0",
    "solve ramp.npz -o new.png --frames -2",
    "solve ramp.npz -o new.png --bits 32",
    "solve ramp.npz -o new.npz --bits 8",
    "solve ramp.npz -o new.npz --gamma 2",
    "solve ramp.npz -o new.tif --white 1",
    "solve ramp.npz -o new.png --white -1",
    "solve ramp.npz -o new.png --report new.txt",
    "solve ramp.npz -o new.png --report none/new.json",
    "solve ramp.npz -o new.png --figure new.gif",
    "solve ramp.npz -o new.png --figure new.png",
    "solve ramp.npz -o new.png --figure ./new.png",
    "solve ramp.npz -o new.png --motion north",
    "solve ramp.npz -o new.png --motion nan,0",
    "solve ramp.npz -o new.png --motion 1,2,3",
    "solve ramp.npz -o new.png --motion 1e9,0",
    "solve ramp.npz -o new.png --motion none.npy",
    "solve ramp.npz -o new.png --motion ramp.npy",
    "solve ramp.npz -o new.png --samples windows",
    "solve ramp.npz -o new.png --samples windows:0",
    "solve ramp.npz -o new.png --samples windows:32",
    f"solve ramp.npz -o new.png --samples windows:{LONG}",
    "solve ramp.npz -o new.png --samples windows:²",
    "solve ramp.npz -o new.png --gain ramp.npy",
    "solve ramp.npz -o new.png --gain none.npy",
    "solve ramp.npz -o new.png --gain 2",
    "solve ramp.npz -o new.png --optics wide",
    "solve ramp.npz -o new.png --optics nan",
    "solve ramp.npz -o new.png --optics 41",
    "solve ramp.npz -o new.png --bounds 1,0",
    "solve ramp.npz -o new.png --bounds 0",
    "solve ramp.npz -o new.png --bounds nan,1",
    "solve ramp.npz -o new.png --prior none",
    "solve ramp.npz -o new.png --robust none",
    "solve ramp.npz -o new.png --strength none",
    "info ramp.npz --white-rate null",
    "solve ramp.npz -o new.png --solver none",
    "solve ramp.npz -o new.png --quality good",
    "solve ramp.npz -o new.png --robust both",
    "solve ramp.npz -o new.png --light off",
    "solve ramp.npz -o new.png --strength -1",
    "solve ramp.npz -o new.png --strength nan",
    "solve ramp.npz -o new.png --iterations 0",
    "solve ramp.npz -o new.png --refine -1",
    "solve ramp.npz -o new.png --every 3",
    "sequence ramp.npz",
    "sequence -o new.zarr",
    "sequence -x -o new.zarr",
    "sequence ramp.npz -o new.png",
    "sequence ramp.npz -o ramp.npz --overwrite",
    "sequence ramp.npz -o ramp.npz/new.zarr",
    "sequence ramp.npz -o /proc/new.zarr",
    "sequence ramp.npz -o /proc/new",
    "sequence ramp.npz -o new.zarr --start 31",
    "sequence ramp.npz -o new.zarr --start 20 --stop 10",
    "sequence ramp.npz -o new.zarr --stop 99",
    f"sequence ramp.npz -o new.zarr --stop {LONG}",
    "sequence ramp.npz -o new.zarr --every 0",
    "sequence ramp.npz -o new.zarr --workers 2 --scheduler tcp://localhost:1",
    "sequence ramp.npz -o new.zarr --workers 0",
    "sequence ramp.npz -o new.zarr --group 0",
    "sequence ramp.npz -o new.zarr --latest",
    "sequence ramp.npz -o new.zarr --bits 16",
    "sequence ramp.npz -o new.zarr --rate 5",
    "sequence ramp.npz -o new.zarr --gamma 2",
    "sequence ramp.npz -o new.gif --rate 0",
    "sequence ramp.npz -o new --bits 9",
    "sequence ramp.npz -o new.zarr --motion 1,0",
    "sequence ramp.npz -o new.zarr --scale 100000",
    "sequence ramp.npz -o new.zarr --crop 0,0,99,99",
    "batch -o new --quiet",
    "batch ramp.npz --quiet",
    "batch ramp.npz -o ramp.npy --quiet",
    "batch ramp.npz -o ramp.npy/new --quiet",
    "batch ramp.npz -o /proc/new --quiet",
    "batch ramp.npz ramp.npy -o new --quiet",
    "batch ramp.npz -o new --format gif --quiet",
    "batch ramp.npz -o new --scale 0 --quiet",
    "batch ramp.npz -o new --key 31 --quiet",
    "batch ramp.npz -o new --white 1 --format npz --quiet",
    "batch ramp.npz -o . --format npz --overwrite --quiet",
    "batch [ -o new --quiet",
    "batch *.none -o new --quiet",
    "export ramp.npz -o new.gif",
    "export none.zarr -o new.gif",
    # URLs: what cannot be fetched, and what is no recording.
    "info memory://none.npz",
    "info memory://none",
    "info memory://",
    "info none://host/a.npz",
    "info none::memory://a.npz",
    "info file:///none/none.npz",
    "info file://ramp.npz/none.npz",
    "info ://a.npz",
    "play memory://none.npz",
    "solve memory://none.npz -o new.png",
    "sequence memory://none.npz -o new.zarr",
    "batch memory://none.npz -o new --quiet",
    "play ramp.npz -o memory://new.png",
    "solve ramp.npz -o file:///tmp/new.png",
    "solve ramp.npz -o new.png --report s3://bucket/new.json",
    "sequence ramp.npz -o s3://bucket/new.zarr",
    "sequence ramp.npz -o s3://bucket/new",
    "sequence ramp.npz -o https://host/new.gif",
    "batch ramp.npz -o s3://bucket/new --quiet",
    "export s3://bucket/a.zarr -o new.gif",
    "export file:///tmp/a.zarr -o new.gif",
    "export . -o new.gif",
    "export -o new.gif",
]


@pytest.mark.parametrize("line", WRONG_OPTIONS, ids=[line.replace(LONG, "9…9") for line in WRONG_OPTIONS])
def test_wrong_options(refused, line):
    refused(*line.split())


# --- Outputs that cannot be there.

OUTPUTS = {
    "play": ["play", "ramp.npz", "--overwrite", "-o"],
    "solve": ["solve", "ramp.npz", "--overwrite", "-o"],
    "solve, the report": ["solve", "ramp.npz", "-o", "new.png", "--overwrite", "--report"],
    "sequence": ["sequence", "ramp.npz", "--overwrite", "-o"],
    "batch": ["batch", "ramp.npz", "--overwrite", "--quiet", "-o"],
    "export": ["export", "a.zarr", "--overwrite", "-o"],
}
ENDINGS = {"sequence": (".zarr", ""), "batch": ("",), "export": (".npz", "")}
ENDINGS |= {"play": (".png", ".gif"), "solve": (".npz",), "solve, the report": (".json",)}


@pytest.mark.parametrize("command", OUTPUTS)
def test_outputs_that_cannot_be_there(refused, originals, command):
    """Names that a file system does not take, folders and devices in the way, links that lead to nothing."""
    shutil.copytree(originals / "a.zarr", "a.zarr")
    os.mkdir("mine")
    for ending in ENDINGS[command]:
        os.mkdir(f"folder{ending}")
        Path(f"folder{ending}", "thesis.txt").write_text("years of work")
        os.symlink(f"loop{ending}", f"loop{ending}")
        os.symlink(f"none/new{ending}", f"away{ending}")
        os.symlink("/dev/null", f"null{ending}")
        names = ["x" * 256, "é" * 128, "a\0b", "ramp.npy/new", "/proc/new", "loop", "away", "null"]
        others = [] if command == "batch" else ["none/new", "folder"]  # the first it makes, into the second it writes
        for name in (*names, *others):
            refused(*OUTPUTS[command], f"{name}{ending}")
