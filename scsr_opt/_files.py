"""Output files that are either whole or not there.

What stands in the way of a file is found before the work whose outcome it is to hold (`check_writable`); what comes up
only while it is written, such as a full disk, names the file and leaves what was there before.
"""

import os
import re
import secrets
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from scsr_opt.errors import InputError, shown

Item = TypeVar("Item")

# A protocol and what follows it, chains of them included (`zip://a.npz::https://host/b.zip`).
_PROTOCOL = r"[A-Za-z][A-Za-z0-9+.\-]*"
_URL = re.compile(rf"{_PROTOCOL}(::{_PROTOCOL})*://")
# `Path` makes one slash of two.
_URL_AS_PATH = re.compile(rf"({_PROTOCOL}(::{_PROTOCOL})*):/+")


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary name, absolute and with the ending of `path`; what is written there becomes `path` if all goes well.

    Readers see the old file or the new one, never half of one. When the block raises, the old file stays and the
    temporary one is removed. A symbolic link stays one: the file that it leads to is replaced.

    The block should do nothing but write: any `OSError` in it is taken for one about this file, but for those of items
    that come through `read_meanwhile`.

    **Raises:** `InputError` if a file cannot be written there.
    """
    target = _target(path)
    temporary = _beside(target, Path(path).suffix)
    try:
        try:
            # Made here rather than by `tempfile`, whose files only their owner may read.
            temporary.touch(exist_ok=False)
            yield temporary
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)
    except _ReadingFailed as failed:
        raise failed.error from failed.error.__cause__
    except OSError as error:
        raise InputError(f"Cannot write {path}: {_reason(error)}.") from error


def read_meanwhile(items: Iterable[Item]) -> Iterator[Item]:
    """The items, read or made while a `whole_file` is written; their `OSError` comes out of it as it is."""
    try:
        yield from items
    except OSError as error:
        raise _ReadingFailed(error) from error


class _ReadingFailed(Exception):
    def __init__(self, error: OSError):
        super().__init__(str(error))
        self.error = error


def as_path(path: Any) -> Path:
    """`path` as a Path. **Raises:** `InputError` if it is none, or no file can have that name."""
    try:
        made = Path(path)
    except TypeError:
        raise InputError(f"{shown(path)} is no path of a file: give a str or a Path.") from None
    if "\0" in str(made):
        raise InputError(
            f"{shown(str(made))} holds a null character, which no name of a file has: choose another name."
        )
    return made


def is_url(path: Any) -> bool:
    """Whether `path` is a URL, such as `s3://bucket/car.dat`. A file in a folder `s3:` is `./s3:/car.dat`."""
    return isinstance(path, str) and _URL.match(path) is not None


def refuse_url(path: str | os.PathLike[str]) -> None:
    """**Raises:** `InputError` if `path`, where something is to be written or a store lies, is a URL; also one that
    has become a Path, unless there is a folder of that name."""
    text = os.fspath(path)
    url = _URL_AS_PATH.match(text)
    if url is not None and not os.path.isdir(f"{url[1]}:"):
        raise InputError(
            f"{url[1]}://{text[url.end() :]} is a URL, but outputs and stores are files of this machine, only a "
            f"recording is read by its URL: give a path here, and copy it."
        )


def check_writable(path: str | os.PathLike[str]) -> None:
    """Finds out before the long work starts whether `path` can be written after it.

    **Raises:** `InputError` if its folder is missing or does not take files, the file system does not take its name, or
    there is something else than a file.
    """
    target = _target(path)
    # Only trying shows it: permissions do not show a disk mounted read-only.
    trial = _beside(target, Path(path).suffix)
    try:
        trial.touch(exist_ok=False)
        trial.unlink()
    except OSError as error:
        raise InputError(f"Cannot write {path}: {_reason(error)}.") from error


def made_folder(path: str | os.PathLike[str]) -> Path:
    """The folder `path`, made if it is not there; the one that is to hold it has to be.

    **Raises:** `InputError` if it cannot be made.
    """
    refuse_url(path)
    folder = as_path(path)
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"Cannot make the folder {path}: {_reason(error)}.") from error
    return folder


def _target(path: str | os.PathLike[str]) -> Path:
    """The absolute path of the file that is to be there at last: `path`, or what it leads to as a symbolic link."""
    refuse_url(path)
    try:
        target = Path(os.path.realpath(path))
        os.lstat(target)
    except FileNotFoundError:
        pass
    except ValueError as error:  # a null character
        raise InputError(f"Cannot write {os.fspath(path)!r}: {error}; choose another name.") from error
    except OSError as error:
        raise InputError(f"Cannot write {path}: {_reason(error)}.") from error
    else:
        if target.is_symlink():  # `realpath` did not resolve it
            raise InputError(f"Cannot write {path}: it is a symbolic link that leads to itself; remove it first.")
        if target.is_dir():
            raise InputError(f"Cannot write {path}: it is a folder; name a file in it.")
        if not target.is_file():
            raise InputError(f"Cannot write {path}: it is a device or a pipe; name a file.")
    for folder in (Path(path).parent, target.parent):  # of the link, and of what it leads to
        if not folder.is_dir():
            raise InputError(f"Cannot write {path}: the folder {folder} does not exist; make it first.")
    return target


def _beside(target: Path, ending: str) -> Path:
    """A new name in the same folder, for the moment. The ending stays last, as writers choose the format by it."""
    # Nothing else of the target's name is in it: that may be as long as names can be, or mean something to a writer.
    return target.with_name(f".scsr-{secrets.token_hex(4)}{ending}")


def _reason(error: OSError) -> str:
    return error.strerror.lower() if error.strerror else str(error)
