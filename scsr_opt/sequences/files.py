"""The place of a store on disk: its lock, and its removal as a whole, so that a kill leaves all of it or nothing."""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scsr_opt.errors import InputError


@contextmanager
def held(path: Path) -> Iterator[None]:
    """The lock of the store `path`, for this process; the system takes it back from a process that ended in any way.

    **Raises:** `InputError` if another run has it, or it cannot be made.
    """
    file = beside(path, "lock")
    if not path.parent.is_dir():
        raise InputError(f"Cannot write {path}: the folder {path.parent} does not exist; make it first.")
    with writing(path):
        descriptor = _locked(file)
    if descriptor is None:
        raise InputError(f"{path} is being written by another run of scsr sequence: wait for it, or end it.")
    try:
        yield
    finally:
        file.unlink(missing_ok=True)
        os.close(descriptor)


def _locked(file: Path) -> int | None:
    """A descriptor of the file that holds its lock; None if another process does."""
    while True:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            there = os.stat(file) if file.exists() else None
            if there is not None and there.st_ino == os.fstat(descriptor).st_ino:
                return descriptor
        except BlockingIOError:
            os.close(descriptor)
            return None
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # whoever held the lock removed the file in between


def tidy(path: Path) -> None:
    """Removes what a killed run left: chunks half-written, and the remains of a store that it replaced or removed."""
    for left in path.rglob("*.partial"):
        left.unlink(missing_ok=True)
    for what in ("new", "old"):
        shutil.rmtree(beside(path, what), ignore_errors=True)


def remove(path: Path) -> None:
    """Removes a store at once, so that a kill does not leave half of it; to be called with its lock held."""
    old = beside(path, "old")
    shutil.rmtree(old, ignore_errors=True)
    with writing(path):
        os.replace(path, old)
    shutil.rmtree(old, ignore_errors=True)


def real_place(path: Path) -> Path:
    """The place on disk that is locked and replaced for the output `path`: the end of a symbolic link, so that all of
    its names have one lock and the link stays; `path` itself where it is none."""
    return Path(os.path.realpath(path)) if os.path.islink(path) else path


def beside(path: Path, what: str) -> Path:
    """A hidden place in the folder of a store, for the lock, or for a store that is being made (`new`) or removed
    (`old`)."""
    return path.with_name(f".{path.name}.{what}")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """**Raises:** `InputError` for an `OSError` of the block, which writes to the store `path`."""
    try:
        yield
    except OSError as error:
        why = error.strerror.lower() if error.strerror else str(error)
        raise InputError(
            f"Cannot write {path}: {why}; what is in it is not lost, give the same command again when that is mended."
        ) from error
