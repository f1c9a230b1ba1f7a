"""`SequenceStore`: pictures of a sequence written and read, in the layout of `layout`.

Every chunk carries a checksum and is written under another name first, so that it is whole or absent. `status` has one
chunk for each group of pictures, written last: a group whose chunk is missing is solved again from its beginning. A
second run would do the same work and write the same bits; a lock keeps it from wasting them.
"""

import json
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from scsr_opt._files import as_path, refuse_url
from scsr_opt._validation import positive, whole
from scsr_opt.calibration.bad_pixels import BadPixels
from scsr_opt.camera.white import White
from scsr_opt.errors import InputError
from scsr_opt.pipeline.solution import Solution
from scsr_opt.sequences.files import beside, writing
from scsr_opt.sequences.layout import FORMAT, METADATA, PICTURE, RESULTS, fixed_arrays, lay_out, need_zarr, status_of
from scsr_opt.sequences.plan import Plan, differences, groups_of, versions
from scsr_opt.solvers.record import Status

if TYPE_CHECKING:
    import zarr

_SPIKES = "spikes is "
_IN_WORDS = {
    "first_key": "the first key frame",
    "last_key": "the last key frame",
    "every": "the number of frames from one key frame to the next",
}


class Picture(NamedTuple):
    """A picture of a store: its `number`, `key` frame, time in `seconds`, `status` (None where it is not there) and the
    key frame `motion_from` at which its motion was estimated."""

    number: int
    key: int
    seconds: float
    status: Status | None
    motion_from: int


class SequenceStore:
    """An existing store; `create` makes one and `open` opens one.

    **Fields:** `path` (absolute), `keys`, `scale`, `group` (pictures of a group), `readout_rate` in Hz, `white`.
    """

    def __init__(self, path: Path, metadata: bytes, arrays: "zarr.Group"):
        self.path, self._metadata, self._arrays = path, metadata, arrays
        self._opened: dict[str, zarr.Array] = {}
        self._attributes = json.loads(metadata)["attributes"]["scsr"]
        sequence = self._attributes["sequence"]
        self.keys = range(sequence["first_key"], sequence["last_key"] + 1, sequence["every"])
        self.scale, self.group = whole(sequence["scale"], "scale", 1), whole(sequence["group"], "group", 1)
        self.readout_rate = positive("The store", "readout_rate", sequence["recording"]["readout_rate"])
        self.white = White(**self._attributes["white"])
        White.given(self.white.level)

    @classmethod
    def create(cls, path: Path, plan: Plan, white: White) -> "SequenceStore":
        """A new store without pictures, in the place of one that may be at `path`; to be called with its lock held.

        **Arguments:** `white`: of all pictures.

        **Raises:** `InputError` if it cannot be written.
        """
        new, old = beside(path, "new"), beside(path, "old")
        with writing(path):
            for left in (new, old):  # by a run that was killed
                shutil.rmtree(left, ignore_errors=True)
            try:
                lay_out(new, plan, white)
                if path.exists():
                    os.replace(path, old)
                os.replace(new, path)
            finally:
                for left in (new, old):
                    shutil.rmtree(left, ignore_errors=True)
        return cls.open(path, write=True)

    @classmethod
    def open(cls, path: str | os.PathLike[str], *, write: bool = False) -> "SequenceStore":
        """The store at `path`. **Raises:** `InputError` if there is none, or it cannot be read."""
        refuse_url(as_path(path))
        place = Path(os.path.abspath(path))
        if not place.is_dir():
            raise InputError(f"There is no store {path}: check the path, or make one with scsr sequence.")
        no_store = f"{path} is no store of a sequence of pictures: name one that scsr sequence made."
        try:
            metadata = (place / METADATA).read_bytes()
            found = json.loads(metadata)["attributes"]["scsr"]["format"]
        except FileNotFoundError:
            raise InputError(no_store) from None
        except OSError as error:
            raise InputError(f"{path} cannot be read: {error.strerror}.") from error
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise InputError(f"{no_store[:-1]}, or remove it if its {METADATA} is damaged.") from error
        if found != FORMAT:
            raise InputError(
                f"{path} has format {found}, but this version of scsr-opt reads format {FORMAT}: read it with the "
                f"version that made it, or make it anew under another name."
            )
        zarr = need_zarr()
        try:
            arrays = zarr.open_group(place, mode="r+" if write else "r", zarr_format=3)
            store = cls(place, metadata, arrays)
            store._check_arrays()
        except Exception as error:  # zarr raises many kinds, one for each thing that may be damaged
            raise InputError(
                f"{path} is damaged ({_said(error)}): remove it and make it anew, or restore its {METADATA} files."
            ) from error
        return store

    def _check_arrays(self) -> None:
        pictures = len(self.keys)
        fixed = ("y", "x")
        names = (*PICTURE, "t", "key_frame", *fixed, *RESULTS)
        wrong = [name for name in names if name not in self._arrays or name not in fixed and
                 self._array(name).shape[0] != pictures]  # fmt: skip
        if wrong:
            raise InputError(f"array {wrong[0]} is missing or has another length than the {pictures} pictures.")

    def _array(self, name: str) -> "zarr.Array":
        if name not in self._opened:  # zarr reads the metadata each time
            array: Any = self._arrays[name]
            # Otherwise a chunk of nothing but the value that stands for absent ones is not written, and one that was
            # lost could not be told from it.
            self._opened[name] = array.with_config({"write_empty_chunks": True})
        return self._opened[name]

    @property
    def shape(self) -> tuple[int, int, int]:
        """(T, H, W): pictures, rows, columns."""
        pictures, rows, columns = self._array("image").shape
        return pictures, rows, columns

    @property
    def motion_shape(self) -> tuple[int, int]:
        """(h, w): rows and columns of the velocities."""
        _, rows, columns = self._array("confidence").shape
        return rows, columns

    @property
    def groups(self) -> list[range]:
        """The groups, each as a range of numbers of pictures."""
        return groups_of(len(self.keys), self.group)

    def check(self, plan: Plan) -> None:
        """**Raises:** `InputError` if the store is of another plan, or was made by another version."""
        made = {**self._attributes["versions"], **self._attributes["sequence"]}
        found = list(differences(made, {**versions(), **plan.description}))
        if len(found) > 1:  # of other key frames the spikes are others, too
            found = [clause for clause in found if not clause.startswith(_SPIKES)]
        if found:
            others = len(found) - 1
            more = f" (and {others} more difference{'s' if others > 1 else ''})" if others else ""
            raise InputError(
                f"{self.path.name} holds another sequence: {_reworded(found[0])}{more}; give another name, or "
                f"--overwrite to begin anew."
            )

    def write_picture(self, number: int, solution: Solution) -> None:
        """Writes a picture with its motion; of a solve that failed, nothing.

        **Raises:** `InputError` if it cannot be written, or the store was replaced meanwhile.
        """
        if not solution.status.usable:
            return
        self._check_present()
        with writing(self.path):
            self._array("image")[number] = solution.image
            for name, values in (("velocity", solution.velocity), ("confidence", solution.confidence)):
                self._array(name)[number] = np.nan if values is None else values
            self._array("bad_pixels")[number] = 0 if solution.bad_pixels is None else solution.bad_pixels.kind

    def write_results(self, numbers: range, solutions: dict[str, list[Any]]) -> None:
        """Writes what is known of the pictures of a group, of which all are written, and marks the group as done.

        **Arguments:** `solutions`: by the names of `RESULTS`, a value for each picture.

        **Raises:** as `write_picture`.
        """
        self._check_present()
        with writing(self.path):
            for name, (kind, _) in RESULTS.items():  # `status` is the last one
                self._array(name)[numbers.start : numbers.stop] = np.array(solutions[name], kind)

    def unfinished(self, solved: Any = None) -> list[int]:
        """Numbers of the groups that have to be solved: those that are not done, and those with a damaged picture.

        **Arguments:** `solved`: called with the number of pictures each time that a group was found to be whole.
        """
        found = []
        for number, group in enumerate(self.groups):
            if self._is_whole(group):
                if solved is not None:
                    solved(len(group))
            else:
                found.append(number)
        return found

    def _is_whole(self, group: range) -> bool:
        try:
            for name in RESULTS:
                codes = self._read(name, slice(group.start, group.stop))
            for number, code in zip(group, codes, strict=True):
                status = self._status(number, int(code))
                if status is None:
                    return False
                if status.usable:
                    if not np.isfinite(self.picture(number)).all():
                        return False
                    self.motion(number)
                    self.bad_pixels(number)
        except InputError:
            return False
        return True

    def _status(self, number: int, code: int) -> Status | None:
        """How the solve of a picture ended by its code; None if one of its chunks is not there."""
        status = status_of(code)
        names = (*RESULTS, *PICTURE) if status is not None and status.usable else RESULTS
        return status if all(self._has_chunk(name, number) for name in names) else None

    def _has_chunk(self, name: str, number: int) -> bool:
        """Whether the chunk of an array that holds the picture `number` is there; zarr reads one that is not as if it
        held the array's value for absent ones."""
        array = self._array(name)
        key = array.metadata.encode_chunk_key((number // array.chunks[0], *(0,) * (array.ndim - 1)))  # type: ignore
        return (self.path / name / key).is_file()

    def mend_fixed(self, plan: Plan) -> None:
        """Writes the arrays that do not wait for pictures again where one is damaged or lost.

        **Raises:** as `write_picture`.
        """

        def whole(name: str, values: np.ndarray) -> bool:
            try:
                there = self._read(name, slice(None))
            except InputError:
                return False
            return self._has_chunk(name, 0) and np.array_equal(there, values)

        with writing(self.path):
            for name, values in fixed_arrays(plan).items():
                if not whole(name, values):
                    self._array(name)[:] = values

    def pictures(self) -> list[Picture]:
        """What is known of each picture. **Raises:** `InputError` if the store is damaged."""
        codes, origins = self._read("status", slice(None)), self._read("motion_from", slice(None))
        return [
            Picture(number, key, key / self.readout_rate, self._status(number, int(code)), int(origin))
            for number, (key, code, origin) in enumerate(zip(self.keys, codes, origins, strict=True))
        ]

    def picture(self, number: int) -> Float[np.ndarray, "H W"]:
        """A picture, intensity, 1 = white; NaN where it is not there. **Raises:** `InputError` if it is damaged."""
        return self._read("image", number)

    def motion(self, number: int) -> tuple[Float[np.ndarray, "2 h w"], Float[np.ndarray, "h w"]]:
        """Velocity in sensor pixels per frame, and its confidence; NaN where they are not known.

        **Raises:** `InputError` if they are damaged.
        """
        return self._read("velocity", number), self._read("confidence", number)

    def bad_pixels(self, number: int) -> BadPixels:
        """Pixels that a picture does not use. **Raises:** `InputError` if they are damaged."""
        return BadPixels(self._read("bad_pixels", number))

    def _read(self, name: str, part: Any) -> Any:
        try:
            return np.asarray(self._array(name)[part])
        except Exception as error:  # each codec has its own ways to fail
            where = f"frame {self.keys[part]}" if isinstance(part, int) else "one of the chunks"
            raise InputError(
                f"{self.path.name} is damaged: {name} of {where} cannot be read ({_said(error)}); give the command "
                f"that made it again, which makes that part anew."
            ) from error

    def _check_present(self) -> None:
        """**Raises:** `InputError` if the store is not the one that was opened: pictures must not be mixed."""
        try:
            same = (self.path / METADATA).read_bytes() == self._metadata
        except OSError:
            same = False
        if not same:
            raise InputError(f"{self.path} was removed or replaced while it was written: give the command again.")


def _said(error: Exception) -> str:
    """An error in a clause, those of other libraries with their kind."""
    if isinstance(error, InputError):
        return str(error).rstrip(".")
    return " ".join(f"{type(error).__name__}: {error}".split())[:120].rstrip(".")


def _reworded(clause: str) -> str:
    if clause.startswith(_SPIKES):
        return "it is of another recording"
    name, said = clause.split(" ", 1)
    return f"{_IN_WORDS.get(name, name)} {said}"
