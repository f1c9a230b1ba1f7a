"""What a long run has measured so far, so that one that was stopped goes on where it was."""

import pickle
from pathlib import Path
from types import TracebackType
from typing import Any, Self


class Journal:
    """A file that grows by one record with each part of a run, and goes when the run is whole.

    What a run of the same request (`asked`: commit, seed, what is measured) left there is in `found`, by name; a file
    of another request is begun anew. A commit with changes on top ("-dirty"), or none, says too little to go on from.

    **Arguments:** `path`: None keeps nothing.
    """

    found: dict[str, Any]

    def __init__(self, path: Path | None, asked: dict[str, Any]):
        self._path = path
        self.found = {}
        known = asked.get("commit") is not None and not asked["commit"].endswith("-dirty")
        if path is None:
            return
        whole = b""
        if known and path.exists():
            whole, before = _read(path)
            if before.pop(_ASKED, None) == asked:
                self.found = before
            else:
                whole = b""
        path.write_bytes(whole or pickle.dumps((_ASKED, asked)))

    def add(self, name: str, value: Any) -> None:
        """Keeps a part."""
        self.found[name] = value
        if self._path is not None:
            with self._path.open("ab") as file:
                file.write(pickle.dumps((name, value)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if kind is None and self._path is not None:
            self._path.unlink()


_ASKED = "asked for"


def _read(path: Path) -> tuple[bytes, dict[str, Any]]:
    """The whole records of a file, as bytes and by name; what a kill cut off in the middle of one is left out."""
    found: dict[str, Any] = {}
    with path.open("rb") as file:
        end = 0
        while True:
            try:
                name, value = pickle.load(file)
            except (EOFError, pickle.UnpicklingError, ValueError, TypeError, AttributeError, ImportError, IndexError):
                break
            found[name] = value
            end = file.tell()
        file.seek(0)
        return file.read(end), found
