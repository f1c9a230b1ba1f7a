"""Other kinds of files under the name of a flat recording: refused, and called what they are."""

import bz2
import gzip
import io
import lzma
import pickle
import struct
import tarfile
import zipfile

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from scsr_opt.camera.formats import read_recording
from scsr_opt.camera.magic import kind_of
from scsr_opt.errors import InputError

RNG = np.random.default_rng(1)
NOISE = RNG.bytes(20_000)
PICTURE = Image.fromarray(RNG.integers(0, 255, (64, 64, 3), np.uint8))


def _picture(kind: str, **options) -> bytes:
    stream = io.BytesIO()
    PICTURE.save(stream, kind, **options)
    return stream.getvalue()


def _numpy(save, *arrays) -> bytes:
    stream = io.BytesIO()
    save(stream, *arrays)
    return stream.getvalue()


def _hdf5() -> bytes:
    stream = io.BytesIO()
    with h5py.File(stream, "w") as file:
        file["raw_spike"] = np.zeros((20, 64, 64), np.uint8)
    return stream.getvalue()


def _tar() -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        member = tarfile.TarInfo("a.dat")
        member.size = len(NOISE)
        archive.addfile(member, io.BytesIO(NOISE))
    return stream.getvalue()


def _zip() -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("a.dat", NOISE)
    return stream.getvalue()


EVENTS = struct.pack("<4I", 1, 2, 3, 4) * 3000

# Content, and what it is called.
OTHERS = {
    "Prophesee CD": (b"% Data file containing CD events.\n% Version 2\n% Width 640\n\x0c\x08" + EVENTS, "CD events"),
    "Prophesee date first": (b"% Date 2020-01-01 10:00:00\n% Height 480\n\x0c\x08" + EVENTS, "events"),
    "EVT2": (b"% camera_integrator_name Prophesee\n% evt 2.0\n% end\n" + EVENTS, "Prophesee EVT"),
    "EVT3": (b"% date 2023-01-01\n% evt 3.0\n% format EVT3;height=720;width=1280\n% end\n" + NOISE, "Prophesee EVT"),
    "EVT2.1": (b"% format EVT21;height=720;width=1280\n% end\n" + NOISE, "Prophesee EVT"),
    "AEDAT 2": (b"#!AER-DAT2.0\r\n# This is a raw AE data file\r\n" + EVENTS, "AEDAT"),
    "AEDAT 3.1": (b"#!AER-DAT3.1\r\n" + EVENTS, "AEDAT"),
    "AEDAT 4": (b"#!AER-DAT4.0\r\n" + NOISE, "AEDAT"),
    "ROS bag": (b"#ROSBAG V2.0\n" + NOISE, "ROS bag"),
    "npy": (_numpy(np.save, np.zeros((20, 64, 64), np.uint8)), r"numpy array \(\.npy\).*ending \.npy"),
    "npz": (_numpy(np.savez, np.zeros((20, 64, 64), np.uint8)), r"zip archive.*ending \.npz"),
    "npz compressed": (_numpy(np.savez_compressed, np.zeros((2000, 64, 64), np.uint8)), "zip archive"),
    "zip": (_zip(), "zip archive"),
    "hdf5": (_hdf5(), r"HDF5 file \(\.h5\).*ending \.h5"),
    "gzip": (gzip.compress(NOISE), "gzip"),
    "gzip with a name": (b"\x1f\x8b\x08\x08" + bytes(5) + b"\x03car.dat\0" + gzip.compress(NOISE)[10:], "gzip"),
    "bzip2": (bz2.compress(NOISE), "bzip2"),
    "xz": (lzma.compress(NOISE), "xz"),
    "zstd": (b"\x28\xb5\x2f\xfd\x64" + NOISE, "zstd"),
    "lz4": (b"\x04\x22\x4d\x18\x64" + NOISE, "lz4"),
    "7z": (b"7z\xbc\xaf\x27\x1c\x00\x04" + NOISE, "7z"),
    "rar": (b"Rar!\x1a\x07\x01\x00" + NOISE, "rar"),
    "tar": (_tar(), "tar"),
    "PNG": (_picture("PNG"), "PNG"),
    "JPEG": (_picture("JPEG"), "JPEG"),
    "JPEG with Exif": (_picture("JPEG", exif=b"Exif\0\0" + bytes(200)), "JPEG"),
    "JPEG with a long Exif": (_picture("JPEG", exif=b"Exif\0\0" + bytes(30_000)), "JPEG"),
    "TIFF": (_picture("TIFF"), "TIFF"),
    "TIFF of Motorola": (b"MM\0*\0\0\0\x08" + NOISE, "TIFF"),
    "GIF": (_picture("GIF"), "GIF"),
    "BMP": (_picture("BMP"), "BMP"),
    "WebP": (_picture("WEBP"), "RIFF"),
    "AVI": (b"RIFF\x00\x10\x00\x00AVI LIST" + NOISE, "AVI"),
    "MP4": (b"\0\0\0\x20ftypisom\0\0\x02\0isomiso2avc1mp41" + NOISE, "MP4 or MOV"),
    "MOV": (b"\0\0\0\x14ftypqt  \0\0\x02\0qt  \0\0\0\x08wide" + NOISE, "MP4 or MOV"),
    "MOV of old": (b"\0\0\x10\0mdat" + NOISE, "MP4 or MOV"),
    "MKV": (b"\x1a\x45\xdf\xa3\xa3\x42\x86\x81\x01\x42\xf7\x81\x01\x42\x82\x88matroska" + NOISE, "Matroska"),
    "WebM": (b"\x1a\x45\xdf\xa3\x9f\x42\x86\x81\x01\x42\x82\x84webm" + NOISE, "WebM"),
    "Ogg": (b"OggS\0\x02" + NOISE, "Ogg"),
    "PDF": (b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n" + NOISE, "PDF"),
    "ELF": (b"\x7fELF\x02\x01\x01\0" + NOISE, "ELF"),
    "exe": (b"MZ" + bytes(58) + b"\x80\0\0\0" + bytes(64) + b"PE\0\0" + NOISE, "program of Windows"),
    "pickle": (pickle.dumps(np.zeros((20, 64, 64), np.uint8), protocol=4), "pickle"),
    "MATLAB": (b"MATLAB 5.0 MAT-file, Platform: GLNXA64" + NOISE, "MATLAB"),
    "FITS": (b"SIMPLE  =                    T" + NOISE, "FITS"),
    "SQLite": (b"SQLite format 3\0" + NOISE, "SQLite"),
    "LFS pointer": (
        b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n" + b" " * 4000,
        "Git LFS.*not fetched",
    ),
    "web page": (b"<!DOCTYPE html>\n<html><head><title>404</title></head></html>" * 100, "web page.*download"),
    "web page after a blank line": (b"\n  <html><body>Quota exceeded</body></html>" * 100, "web page"),
    "XML": (b"<?xml version='1.0'?><Error><Code>AccessDenied</Code></Error>" * 100, "XML"),
    "text": (b"t,x,y,p\n" + b"".join(b"%d,%d,%d,1\n" % (i * 7, i % 640, i % 480) for i in range(2000)), "text file"),
    "JSON": (b'{"error": "not found", "code": 404}' * 200, "text file"),
    "text of more bytes a character": ("Zeit;größe;像素\n".encode() * 400, "text file"),
    "text with a byte-order mark": ("t,x,y\n1,2,3\n".encode("utf-8-sig") + b"4,5,6\n" * 500, "text file"),
    "text of Windows": ("t,x,y\n1,2,3\n".encode("utf-16") + "4,5,6\n".encode("utf-16-le") * 500, "text file"),
}  # fmt: skip


@pytest.mark.parametrize("name", OTHERS)
def test_read_recording_other_kinds_of_files_are_named(tmp_path, name):
    content, called = OTHERS[name]
    path = tmp_path / "renamed_64x64.dat"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"renamed_64x64\.dat is an? .*{called}") as caught:
        read_recording(path)
    assert "\n" not in str(caught.value) and str(caught.value).endswith(".")


@pytest.mark.parametrize("ending", [".npy", ".npz", ".h5"])
@pytest.mark.parametrize(
    "name", ["PNG", "MP4", "gzip", "web page", "LFS pointer", "EVT3", "AEDAT 4", "ELF", "text", "xz"]
)
def test_read_recording_other_endings_name_the_kind_as_well(tmp_path, ending, name):
    content, called = OTHERS[name]
    path = tmp_path / f"renamed{ending}"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"is an? .*{called}.*not what its ending {ending} says"):
        read_recording(path)


@pytest.mark.parametrize(("ending", "content"), [(".npy", "hdf5"), (".npz", "hdf5"), (".h5", "npy"), (".h5", "npz")])
def test_read_recording_formats_exchanged_say_the_right_ending(tmp_path, ending, content):
    path = tmp_path / f"renamed{ending}"
    path.write_bytes(OTHERS[content][0])
    with pytest.raises(InputError, match=rf"give it the ending \.{'h5' if content == 'hdf5' else content}"):
        read_recording(path)


@settings(max_examples=300)
@given(st.binary(min_size=0, max_size=200))
def test_kind_of_any_bytes_is_none_or_has_an_article(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("kind") / "r.dat"
    path.write_bytes(content)
    kind = kind_of(path)
    assert kind is None or kind.startswith(("a ", "an "))


@pytest.mark.parametrize("start", range(40))
def test_kind_of_spikes_is_none(tmp_path, start):
    """Frames of any rate, striped ones and saturated ones among them."""
    rng = np.random.default_rng(start)
    rate = np.linspace(0, 1, 40)[start]
    bits = rng.random((20, 64 * 64)) < rate
    path = tmp_path / "r.dat"
    path.write_bytes(np.packbits(bits, bitorder="little").tobytes())
    assert kind_of(path) is None
    path.write_bytes(bytes([start * 6 + 1]) * 4096 + rng.bytes(100))
    assert kind_of(path) is None
    path.write_bytes(bytes(64) + bytes([start * 6 + 1, 255 - start]) * 4096)
    assert kind_of(path) is None


@pytest.mark.parametrize(
    "start",
    [
        b"\xff\xd8\xff", b"\xff\xd8\xff\xff", b"\xff\xd8\xff\xfe\xff\xff", b"PK\x03\x04", b"PK\x03\x04\xff\xff",
        b"BM", b"MZ", b"II*\0",
        b"\x1f\x8b\x08", b"\x1f\x8b\x08\xff", b"BZh9", b"RIFF", b"\x1a\x45\xdf\xa3", b"\x7fELF\xff",
        b"\x80\x04", b"% ", b"%\n",
        b"\0\0\0\0mdat", b"<?", b"\xff\xfe",
    ],
)  # fmt: skip
def test_kind_of_the_first_bytes_of_a_signature_are_not_enough(tmp_path, start):
    path = tmp_path / "r.dat"
    path.write_bytes(start + b"\xff" * 4096)
    assert kind_of(path) is None
