"""Output files that are either whole or not there."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scsr_opt.errors import InputError


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary name beside `path` with the same ending; what is written there becomes `path` if all goes well.

    Readers see the old file or the new one, never half of one. When the block raises, the old file stays and the
    temporary one is removed.

    **Raises:** `InputError` if a file cannot be written there.
    """
    target = Path(path)
    # The ending stays last, because writers choose the format by it.
    temporary = target.with_name(f".{target.stem[:100]}.{secrets.token_hex(4)}{target.suffix}")
    try:
        # Made here rather than by `tempfile`, whose files only their owner may read.
        temporary.touch(exist_ok=False)
    except OSError as error:
        raise InputError(f"Cannot write {target}: {_reason(error)}.") from error
    try:
        yield temporary
        try:
            os.replace(temporary, target)
        except OSError as error:
            raise InputError(f"Cannot write {target}: {_reason(error)}.") from error
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: str | os.PathLike[str]) -> None:
    """Finds out before the long work starts whether `path` can be written after it.

    **Raises:** `InputError` if its folder is missing or does not take files, or `path` is a folder.
    """
    target = Path(path)
    if target.is_dir():
        raise InputError(f"Cannot write {target}: it is a folder; name a file in it.")
    if not target.parent.is_dir():
        raise InputError(f"Cannot write {target}: the folder {target.parent} does not exist; make it first.")
    # Only trying tells: permissions say nothing of a disk mounted read-only.
    trial = target.with_name(f".{target.stem[:100]}.{secrets.token_hex(4)}.trial")
    try:
        trial.touch(exist_ok=False)
        trial.unlink()
    except OSError as error:
        raise InputError(f"Cannot write {target}: {_reason(error)}.") from error


def _reason(error: OSError) -> str:
    return error.strerror.lower() if error.strerror else str(error)
