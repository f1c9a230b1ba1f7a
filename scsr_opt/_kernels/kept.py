"""Compiled programs kept on disk from one process to the next: compiling takes longer than most solves.

JAX's persistent compilation cache does the keeping, keyed by program, version and options. Here it is switched on, in a
folder of its own for each kind of processor, and looked after: what a killed process left incomplete is deleted, and
so are the entries that were not used for longest once there are more than `MOST_BYTES`.
"""

import functools
import hashlib
import os
import platform
import time
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import platformdirs

MOST_BYTES = 500 << 20
"""Bytes of the folder, at most; the programs of one size of sensor take 1.5 to 3 MB."""

# JAX's own waiting time for an entry to be worth keeping; another one is a wish of the user's.
_JAX_LEAST_SECONDS = 1.0
# Entries of JAX's cache that are older than this are not being written any more.
_WRITTEN_SECONDS = 60.0
_ZSTANDARD = b"\x28\xb5\x2f\xfd"
_CHECKED = ".checked"


class Kept(NamedTuple):
    """Programs on disk: how many, and their bytes."""

    programs: int
    bytes: int


@functools.cache
def keep_programs() -> None:
    """Lets JAX keep what it compiles in the user's cache folder, and read it from there.

    JAX's own settings come first: where `JAX_COMPILATION_CACHE_DIR` (`jax_compilation_cache_dir`) names a folder,
    that is used and left alone; `JAX_ENABLE_COMPILATION_CACHE=0` (`jax_enable_compilation_cache`) keeps nothing.
    Nothing is kept either where there is no home, or its folder cannot be made. One that is there and cannot be
    written is read.
    """
    config = jax.config
    if config.jax_compilation_cache_dir or not config.jax_enable_compilation_cache:  # pyright: ignore
        return
    try:
        folder = programs_folder()
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)  # who may write here may run code
        if os.access(folder, os.W_OK):
            tidy()
    except (OSError, RuntimeError):  # the latter where there is no home
        return
    config.update("jax_compilation_cache_dir", str(folder))
    if config.jax_persistent_cache_min_compile_time_secs == _JAX_LEAST_SECONDS:  # pyright: ignore
        # Reading a program takes some milliseconds, compiling the least of them longer.
        config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    # Such an entry is compiled as if it were not there: nothing that a user needs to know.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache entry")


def cache_folder() -> Path:
    """The project's folder among the user's caches, of all kinds of processor."""
    return platformdirs.user_cache_path("scsr-opt", appauthor=False)


def programs_folder() -> Path:
    """The folder of programs for this kind of processor: homes are shared by machines that cannot run each other's."""
    known = [platform.machine(), platform.processor()]
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        known += sorted({line for line in lines if line.startswith(("flags", "Features", "model name"))})
    except OSError:
        pass  # elsewhere than on Linux
    return cache_folder() / hashlib.sha256("\n".join(known).encode()).hexdigest()[:12]


def kept() -> Kept:
    """The programs in the cache folder, for all kinds of processor."""
    sizes = [size for _, _, size in _entries()]
    return Kept(len(sizes), sum(sizes))


def clear() -> Kept:
    """Deletes all kept programs, and says what was there."""
    found = kept()
    for path, _, _ in _entries():
        path.unlink(missing_ok=True)
    return found


def tidy(most: int = MOST_BYTES) -> None:
    """Deletes entries that are incomplete, and the longest unused beyond `most` bytes.

    Only entries that were written since the last call are read, and none of the last minute, which another process may
    be writing.
    """
    stamp, now = programs_folder() / _CHECKED, time.time()
    since = stamp.stat().st_mtime if stamp.exists() else 0.0
    entries = sorted(_entries(), key=lambda entry: -entry[1])
    total = 0
    for path, _, size in entries:
        written = path.stat().st_mtime if path.exists() else now
        total += size
        if total > most or (since <= written < now - _WRITTEN_SECONDS and not _is_whole(path)):
            total -= size
            path.unlink(missing_ok=True)
    stamp.touch()
    os.utime(stamp, (now, now - _WRITTEN_SECONDS))


def _entries() -> Iterator[tuple[Path, float, int]]:
    """(path, last use or writing, bytes) of each kept program."""
    for path in cache_folder().glob("*/*-cache"):
        try:
            about = path.stat()
        except OSError:  # deleted by another process in between
            continue
        yield path, max(about.st_atime, about.st_mtime), about.st_size


def _is_whole(path: Path) -> bool:
    """Whether an entry can be unpacked; those of Zstandard, which JAX uses where it is installed, are believed."""
    try:
        content = path.read_bytes()
        if not content.startswith(_ZSTANDARD):
            zlib.decompress(content)
    except zlib.error:
        return False
    except OSError:
        return True  # deleted by another process in between
    return True
