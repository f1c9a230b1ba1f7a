"""Kinds of files by their first bytes, for those that bear the ending of a recording and are something else.

A flat file of spikes begins with any bytes at all, so a signature counts only if it is long, or what must follow it
does: of the files of bits drawn at random less than one in 10⁹ is taken for something else, and none that begins with
dark, saturated or striped frames.
"""

import codecs
import string
import zlib
from collections.abc import Callable
from pathlib import Path

from scsr_opt.camera.settings import CONTENT

NPY, ZIP, HDF5 = "a numpy array (.npy)", "a zip archive, as .npz files are", "an HDF5 file (.h5)"

_PLAIN: tuple[tuple[bytes, str], ...] = (
    (b"\x93NUMPY", NPY),
    (b"\x89HDF\r\n\x1a\n", HDF5),
    (b"#!AER-DAT", "a file of events of a DVS camera (AEDAT)"),
    (b"#ROSBAG V", "a ROS bag"),
    (b"version https://git-lfs.github.com/spec/", "a pointer of Git LFS to a file that was not fetched"),
    (b"\xfd7zXZ\x00", "an xz archive"),
    (b"\x28\xb5\x2f\xfd", "a zstd archive"),
    (b"\x04\x22\x4d\x18", "an lz4 archive"),
    (b"7z\xbc\xaf\x27\x1c", "a 7z archive"),
    (b"Rar!\x1a\x07", "a rar archive"),
    (b"\x89PNG\r\n\x1a\n", "a PNG picture"),
    (b"GIF87a", "a GIF picture"),
    (b"GIF89a", "a GIF picture"),
    (b"\x00\x00\x00\x0cJXL \r\n\x87\n", "a JPEG XL picture"),
    (b"\x00\x00\x00\x0cjP  \r\n\x87\n", "a JPEG 2000 picture"),
    (b"OggS\x00", "an Ogg video"),
    (b"%PDF-", "a PDF document"),
    (b"MATLAB 5.0 MAT-file", "a MATLAB file"),
    (b"MATLAB 7.3 MAT-file", "a MATLAB file"),
    (b"SIMPLE  =", "a FITS picture"),
    (b"SQLite format 3\x00", "an SQLite database"),
)


def kind_of(path: Path) -> str | None:
    """Kind of the file `path` in words with an article, `NPY`, `ZIP` and `HDF5` among them; None for spikes, it seems.

    **Raises:** `OSError` if it cannot be read.
    """
    with path.open("rb") as stream:
        head = stream.read(CONTENT.head_bytes)
    size = path.stat().st_size
    for signature, kind in _PLAIN:
        if head.startswith(signature):
            return kind
    for test, kind in _TESTS:
        if test(head, size):
            return kind
    return _text_kind(head, whole=size <= len(head))


def _is_zip(head: bytes, size: int) -> bool:
    if head[:6] == b"PK\x05\x06\x00\x00":
        return size == 22  # no files in it
    # The version that is needed to unpack, and the method of compression: few of the numbers are in use.
    return head[:4] == b"PK\x03\x04" and len(head) >= 30 and head[4] <= 63 and head[8] <= 99 and head[9] == 0


def _is_gzip(head: bytes, size: int) -> bool:
    if head[:3] != b"\x1f\x8b\x08":
        return False
    try:
        zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(head)
    except zlib.error:
        return False
    return True


def _is_bzip2(head: bytes, size: int) -> bool:
    return head[:3] == b"BZh" and head[4:10] in (b"1AY&SY", b"\x17\x72\x45\x38\x50\x90")


def _is_jpeg(head: bytes, size: int) -> bool:
    """Test for segments that follow each other: the first three bytes alone are also those of a saturated row."""
    if head[:2] != b"\xff\xd8":
        return False
    place, segments = 2, 0
    while place + 4 <= len(head) and head[place] == 0xFF and 0xC0 <= head[place + 1] <= 0xFE:
        segments += 1
        if segments == 3 or head[place + 1] == 0xDA:
            return segments > 1
        place += 2 + int.from_bytes(head[place + 2 : place + 4], "big")
    return segments > 0 and len(head) < place < size and head[6:10] in (b"JFIF", b"Exif", b"http", b"ICC_")


def _is_tiff(head: bytes, size: int) -> bool:
    order = {b"II": "little", b"MM": "big"}.get(head[:2])
    if order is None or len(head) < 8:
        return False
    version = int.from_bytes(head[2:4], order)  # pyright: ignore[reportArgumentType]
    first = int.from_bytes(head[4:8], order)  # pyright: ignore[reportArgumentType]
    return (version == 42 and 8 <= first < size) or (version == 43 and head[4:8] in (b"\x08\0\0\0", b"\0\x08\0\0"))


def _is_bmp(head: bytes, size: int) -> bool:
    return head[:2] == b"BM" and int.from_bytes(head[2:6], "little") == size and head[6:10] == bytes(4)


def _is_mp4(head: bytes, size: int) -> bool:
    length = int.from_bytes(head[:4], "big")
    if head[4:8] == b"ftyp":
        return 8 <= length <= 4096
    return head[4:8] in (b"moov", b"mdat", b"wide") and 8 <= length <= size


def _is_riff(head: bytes, size: int) -> bool:
    return head[:4] == b"RIFF" and head[8:12] in (b"AVI ", b"WAVE", b"WEBP")


def _is_matroska(head: bytes, size: int) -> bool:
    return head[:4] == b"\x1a\x45\xdf\xa3" and (b"webm" in head[:64] or b"matroska" in head[:64])


def _is_elf(head: bytes, size: int) -> bool:
    return head[:4] == b"\x7fELF" and head[4:5] in b"\x01\x02" and head[5:7] in (b"\x01\x01", b"\x02\x01")


def _is_exe(head: bytes, size: int) -> bool:
    place = int.from_bytes(head[0x3C:0x40], "little")
    return head[:2] == b"MZ" and head[place : place + 4] == b"PE\0\0"


def _is_pickle(head: bytes, size: int) -> bool:
    # Protocol 4 and 5 begin with a frame, whose length lies in the file.
    return head[:3] in (b"\x80\x04\x95", b"\x80\x05\x95") and 0 < int.from_bytes(head[3:11], "little") <= size


def _is_tar(head: bytes, size: int) -> bool:
    return head[257:262] == b"ustar"


_TESTS: tuple[tuple[Callable[[bytes, int], bool], str], ...] = (
    (_is_zip, ZIP),
    (_is_gzip, "a gzip archive"),
    (_is_bzip2, "a bzip2 archive"),
    (_is_tar, "a tar archive"),
    (_is_jpeg, "a JPEG picture"),
    (_is_tiff, "a TIFF picture"),
    (_is_bmp, "a BMP picture"),
    (_is_mp4, "an MP4 or MOV video"),
    (_is_riff, "a RIFF file (AVI, WAV or WebP)"),
    (_is_matroska, "a Matroska or WebM video"),
    (_is_elf, "a program or library (ELF)"),
    (_is_exe, "a program of Windows"),
    (_is_pickle, "a pickle of Python"),
)

_PRINTABLE = bytes(string.printable, "ascii")


def _text_kind(head: bytes, *, whole: bool) -> str | None:
    """Kind of a file that begins with text, or is text as far as `head` goes; `whole`: that is all of it."""
    if head[:1] == b"%":
        # Headers of Prophesee: lines that begin with %, then events in binary.
        lines = [line for line in head.split(b"\n")[:-1] if line.startswith(b"%")]
        if lines and len(lines[0]) >= 4 and not lines[0].translate(None, _PRINTABLE):
            if any(line.lower().startswith((b"% evt", b"% format evt")) for line in lines):
                return "a raw file of events (Prophesee EVT)"
            return "a file of events with a text header (Prophesee CD events)"
    text = head.removeprefix(b"\xef\xbb\xbf")
    start = text.lstrip().lower()
    if start.startswith((b"<!doctype html", b"<html", b"<head")):
        return "a web page, perhaps the error message of a download"
    if start.startswith((b"<?xml", b"<svg")):
        return "an XML file"
    if head[:2] in (b"\xff\xfe", b"\xfe\xff") and len(head) >= CONTENT.shortest_text_bytes:
        zeros = head[3::2] if head[0] == 0xFF else head[2::2]
        others = head[2::2] if head[0] == 0xFF else head[3::2]
        if not any(zeros) and not others.translate(None, _PRINTABLE):
            return "a text file (UTF-16)"
    if len(text) < CONTENT.shortest_text_bytes or len(set(text)) < min(CONTENT.least_different_bytes, len(text) // 2):
        return None
    try:
        characters = codecs.getincrementaldecoder("utf-8")().decode(text, final=whole)  # its end may be cut
    except UnicodeDecodeError:
        return None
    return None if any(character < " " and character not in "\t\n\r\f\v" for character in characters) else "a text file"
