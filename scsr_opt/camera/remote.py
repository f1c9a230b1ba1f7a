"""Recordings by URL, through fsspec: the object is copied to a file of this machine, which is then read like any other.

A copy, rather than reading over the network, because flat and `.npy` files are mapped, and a solve reads the frames
around a key frame several times. It lies in the folder of temporary files (`TMPDIR`) as long as its recording is in
use, and the object is never held in memory as a whole. A process that gets the recording by pickle uses the copy if it
finds it, as on the same machine, and otherwise makes one of its own.
"""

import functools
import os
import re
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import UInt8

from scsr_opt.camera.recording import Recording
from scsr_opt.camera.sources import ArraySource, FlatSource, Hdf5Source, NpySource, SpikeSource
from scsr_opt.errors import InputError

_HTTP = ("http", "https")


def file_name(url: str) -> Path:
    """Name of the file behind a URL, which has the ending and may have the size; without what a query adds."""
    protocol, _, place = next(part for part in url.split("::") if "://" in part).partition("://")
    if protocol in _HTTP:
        place = unquote(_before_query(place).partition("/")[2])
    return Path(PurePosixPath(place).name)


def shown_url(url: str) -> str:
    """The URL for people: without a password, or a query, which may hold a signature."""
    return "::".join(_shown(part) for part in url.split("::"))


def _shown(part: str) -> str:
    protocol, mark, place = part.partition("://")
    if protocol in _HTTP:
        place = _before_query(place)
    host, slash, path = place.partition("/")
    return f"{protocol}{mark}{host.rpartition('@')[2]}/{path}" if slash else f"{protocol}{mark}{place}"


def _before_query(place: str) -> str:
    return re.split("[?#]", place, maxsplit=1)[0]


def read_url(url: str, read: Callable[[Path], Recording]) -> Recording:
    """The recording behind a URL; `read` opens a file.

    **Raises:** `InputError` if it cannot be fetched, and those of `read`, with the URL in the place of the file.
    """
    copy = _fetched(url)
    if isinstance(copy, Path):
        return read(copy)
    try:
        with _told(url, copy.path):
            recording = read(copy.path)
    except BaseException:
        copy.remove()  # the traceback keeps what refers to it
        raise
    if isinstance(recording.source, ArraySource):  # all of it has been read
        return recording
    assert isinstance(recording.source, FlatSource | NpySource | Hdf5Source)
    return replace(recording, source=RemoteSource(url, recording.source, copy.path.stat().st_size, copy))


class LocalCopy:
    """A file that was fetched; it is removed when nothing refers to this object, at the end of the process at last."""

    def __init__(self, url: str, fetch: Callable[[str], Any]):
        folder = tempfile.mkdtemp(prefix="scsr-")
        self.remove = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        # Two folders deep, as a config.yaml beside a recording, or one folder up, would say its size.
        self.path = Path(folder, "copy", file_name(url))
        try:
            self.path.parent.mkdir()
            fetch(str(self.path))
        except BaseException:
            self.remove()
            raise


@dataclass(frozen=True)
class RemoteSource(SpikeSource):
    """The file behind a URL, read from a copy on this machine.

    **Fields:** `url`; `source`: of the copy; `length`: its bytes; `copy`: what keeps it, None in a process that got
    this by pickle.
    """

    url: str
    source: FlatSource | NpySource | Hdf5Source
    length: int
    copy: LocalCopy | None

    @property
    def shape(self) -> tuple[int, int, int]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """(frames, rows, columns)."""
        return self.source.shape

    def read(self, start: int, stop: int) -> UInt8[np.ndarray, "n h w"]:
        source, again = self.source, None
        if not source.path.is_file():
            again = _fetched_again(self.url, source.path, self.length)
            source = replace(source, path=again.path)
        with _told(self.url, source.path):
            return source.read(start, stop)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "copy": None}


# The last one stays, as a worker gets the same recording with each of its tasks.
@functools.lru_cache(maxsize=1)
def _fetched_again(url: str, first: Path, length: int) -> LocalCopy:
    """A copy in the place of the `first` one, which another process made. **Raises:** `InputError` also if the object
    is of another length now."""
    copy = _fetched(url)
    assert isinstance(copy, LocalCopy)
    now = copy.path.stat().st_size
    if now != length:
        raise InputError(
            f"{shown_url(url)} holds {now:,} bytes, but held {length:,} when it was opened: leave it as it is until "
            f"the run has ended, and give the command again."
        )
    return copy


def _fetched(url: str) -> LocalCopy | Path:
    """A copy of the object behind a URL, or its path if it is a file of this machine.

    **Raises:** `InputError` if it cannot be fetched.
    """
    shown = shown_url(url)
    try:
        from fsspec.core import url_to_fs
        from fsspec.implementations.local import LocalFileSystem
    except ImportError:
        raise InputError(
            f"{shown} is a URL, which needs the package fsspec, which is not installed: pip install "
            f"'scsr-opt[sequence]'."
        ) from None
    try:
        system, place = url_to_fs(url)
        if isinstance(system, LocalFileSystem):
            return Path(place)
        return LocalCopy(url, functools.partial(system.get_file, place))
    except FileNotFoundError as error:
        raise InputError(f"There is no file {shown}: check the URL.") from error
    except ImportError as error:
        raise InputError(
            f"{shown} needs a package that is not installed ({_clause(error, url)}): install it with pip."
        ) from error
    except Exception as error:  # each protocol has its own kinds
        raise InputError(
            f"{shown} cannot be fetched ({_clause(error, url)}): check the URL, that you may read it, and that there "
            f"is room for a copy in {tempfile.gettempdir()}, or in another folder by the variable TMPDIR."
        ) from error


def _clause(error: Exception, url: str) -> str:
    """What an error says, in a clause; of HTTP: the status, as its text holds the whole URL."""
    status = getattr(error, "status", None)
    said = f"{status} {getattr(error, 'message', '')}" if isinstance(status, int) else str(error)
    if isinstance(error, OSError) and error.strerror:
        said = error.strerror
    said = " ".join(said.replace(url, shown_url(url)).split()).rstrip(".")
    return said[:200] or type(error).__name__


@contextmanager
def _told(url: str, path: Path) -> Iterator[None]:
    """Has an `InputError` name the URL rather than its copy."""
    try:
        yield
    except InputError as error:
        raise InputError(str(error).replace(os.fspath(path), shown_url(url))) from error
