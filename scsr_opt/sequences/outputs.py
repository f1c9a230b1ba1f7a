"""Files made from a store of a sequence: a folder of pictures, arrays, films.

Pictures are read one at a time, so that a long sequence needs no more memory than a short one. An output is whole or
not there. All pictures of an output are stored with one brightness.
"""

import csv
import os
import shutil
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scsr_opt._files import as_path, check_writable, read_meanwhile, refuse_url, whole_file
from scsr_opt.camera.white import White
from scsr_opt.errors import InputError, shown
from scsr_opt.progress import NoProgress, Progress
from scsr_opt.report.pictures import (
    FILM_ENDINGS,
    PictureFormat,
    check_film,
    film_rate,
    stored_rate,
    write_film,
    write_picture,
)
from scsr_opt.sequences.files import real_place, writing
from scsr_opt.sequences.layout import is_store
from scsr_opt.sequences.store import Picture, SequenceStore

STORE = ".zarr"
# Of the store beside an output. It is removed at the end, so that no user's own store may bear its name, such as
# car.zarr beside the folder car.
_UNFINISHED = f".unfinished{STORE}"
ARRAYS = (".npz", ".npy")
# File in that store from when the output is begun on: an output that is there then is the store's own.
_BEGUN = "output.begun"
STILLS = {8: ".png", 16: ".png", 32: ".tif"}
"""Endings of the pictures of a folder by their bits."""
TABLE, IMAGES = "times.csv", "images"
"""Table and folder of the pictures in an output that is a folder."""
COLUMNS = ["number", "file", "key_frame", "seconds", "status", "motion_from"]
"""Columns of a table of times."""


@dataclass(frozen=True)
class SequenceFormat:
    """Where and how a sequence is stored; the ending of `path` decides.

    - `.zarr`: a store (`SequenceStore`).
    - none: a folder with the numbered pictures in `images/` and their times in `times.csv`.
    - `.npz`: arrays `image` (T, H, W), `velocity`, `confidence`, `bad_pixels`, `key_frame`, `seconds`, `motion_from`,
      `status`, and numbers `scale`, `readout_rate`, `white`.
    - `.npy`: (T, H, W) float32; times in a `.csv` of the same name.
    - `.mp4`, `.gif`: a film.

    **Fields:**
    - `bits`: of the pictures of a folder: 8 or 16 for PNG, 32 for floating-point TIFF.
    - `gamma`: of a film, and of PNG: intensity^(1/gamma) is stored.
    - `rate`: pictures per second of a film; that of `report.film_rate` if None.
    - `white`: intensity of the largest grey level of a film or an 8-bit PNG; that of the store if None.
    """

    path: Path
    bits: int = 8
    gamma: float = 1.0
    rate: float | None = None
    white: float | None = None

    @classmethod
    def of(
        cls,
        path: str | os.PathLike[str],
        *,
        bits: int | None = None,
        gamma: float | None = None,
        rate: float | None = None,
        white: float | None = None,
    ) -> "SequenceFormat":
        """The format for `path`; what is None is as by default.

        **Raises:** `InputError` for an ending that is not known, or a setting that it cannot have.
        """
        ending = as_path(path).suffix.lower()
        known = ("", STORE, *ARRAYS, *FILM_ENDINGS)
        if ending not in known or not as_path(path).name:
            raise InputError(
                f"Cannot tell the format of {path}: its ending is {ending!r}, but sequences end in "
                f"{', '.join(known[1:-1])} or {known[-1]}, or are a folder, whose name has no ending."
            )
        if bits is not None and ending:
            raise InputError(f"bits is for a folder of pictures, but {path} is none: leave it out.")
        if rate is not None and ending not in FILM_ENDINGS:
            raise InputError(f"rate is for films, but {path} is none: leave it out, or write a .mp4 or .gif.")
        if gamma not in (None, 1) and ending not in ("", *FILM_ENDINGS):
            raise InputError(f"gamma is for what is looked at, but {path} holds linear intensity: leave it out.")
        made = cls(
            as_path(path),
            8 if bits is None else bits,
            1.0 if gamma is None else gamma,
            rate,
            None if white is None else White.given(white).level,
        )
        if ending in FILM_ENDINGS:
            check_film(path, rate=made.rate, gamma=made.gamma)
        elif not ending:
            if made.bits not in STILLS:
                raise InputError(f"bits is {shown(bits)}, but the pictures of a folder have 8, 16 or 32: choose one.")
            PictureFormat.of(f"a{STILLS[made.bits]}", bits=made.bits, gamma=made.gamma)
        return made

    @property
    def is_store(self) -> bool:
        """True for a store."""
        return self.ending == STORE

    @property
    def is_film(self) -> bool:
        """True for a film."""
        return self.ending in FILM_ENDINGS

    def film_rate(self, count: int) -> float:
        """Pictures per second of a film of `count` pictures."""
        return stored_rate(self.path, film_rate(count) if self.rate is None else self.rate)

    @property
    def ending(self) -> str:
        """The ending in lower case; empty for a folder."""
        return self.path.suffix.lower()

    @property
    def store(self) -> Path:
        """The store that the sequence is solved into: `path` itself, or a folder beside it until `path` is written."""
        return real_place(self.path) if self.is_store else self.path.with_name(self.path.name + _UNFINISHED)

    @property
    def outputs(self) -> list[Path]:
        """The files, or the folder, that are written in the end."""
        return [self.path, self.path.with_suffix(".csv")] if self.ending == ".npy" else [self.path]

    def begin(self) -> None:
        """Notes in the store that the outputs are written from now on: a run that goes on after a kill replaces them.

        **Raises:** `InputError` if the store cannot be written.
        """
        with writing(self.store):
            (self.store / _BEGUN).touch()

    def check(self, overwrite: bool) -> None:
        """Finds out before the work whether the outputs can be written. Those that a run of this output had begun when
        it was killed may be replaced.

        **Raises:** `InputError` if one cannot, is there already and may not be overwritten, or is inside of a store.
        """
        refuse_url(self.path)
        around = next((folder for folder in self.path.absolute().parents if is_store(folder)), None)
        if around is not None:
            raise InputError(f"{self.path} is in the store {around}: give a name outside of it.")
        if self.is_store:
            return  # `write_sequence` goes on with it, or refuses it
        replaced = overwrite or (is_store(self.store) and (self.store / _BEGUN).exists())
        for path in self.outputs:
            if not self.ending and os.path.isdir(path):
                check_writable(path.with_name(f"{path.name}.new"))  # its place, as it is replaced as a whole
                other = _other_file(path)
                if other is not None:
                    raise InputError(
                        f"{path} is a folder with a file {other}, which is not of a sequence: give another name."
                    )
            else:
                check_writable(path)
            if path.exists() and not replaced:
                raise InputError(f"{path} is there already: give --overwrite to replace it, or another name.")


def _other_file(folder: Path) -> Path | None:
    """A file in a folder that a sequence does not write there, relative to it; None if there is none."""
    stills = tuple(STILLS.values())
    for path in sorted(folder.rglob("*")):
        inside = path.relative_to(folder)
        picture = inside.parent == Path(IMAGES) and path.suffix in stills and path.stem.isdecimal()
        if not picture and inside not in (Path(TABLE), Path(IMAGES)):
            return inside
    return None


def export(
    store: SequenceStore | str | os.PathLike[str],
    output: str | os.PathLike[str] | SequenceFormat,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> list[Picture]:
    """Writes the pictures of a store in another format (`SequenceFormat`).

    A picture whose solve failed is black in a film, NaN in an array, and left out of a folder.

    **Returns:** what is known of each picture.

    **Raises:** `InputError` if pictures are missing or damaged, or the output cannot be written; it is not there then.
    """
    source = store if isinstance(store, SequenceStore) else SequenceStore.open(store)
    chosen = output if isinstance(output, SequenceFormat) else SequenceFormat.of(output)
    if chosen.is_store:
        raise InputError(f"{chosen.path} would be a store as well: copy the folder {source.path} instead.")
    chosen.check(overwrite)
    pictures = source.pictures()
    missing = [one for one in pictures if one.status is None]
    if missing:
        raise InputError(
            f"{source.path} is not complete: {len(missing)} of its {len(pictures)} pictures are missing, the first is "
            f"frame {missing[0].key}; give the command that made it again."
        )
    if all(not one.status.usable for one in pictures if one.status is not None):
        raise InputError(f"{source.path} has no picture that can be used: all {len(pictures)} solves failed.")
    meter = NoProgress() if progress is None else progress
    meter.start(len(pictures), "Writing")
    try:
        write = {"": _write_folder, ".npy": _write_npy, ".npz": _write_npz}.get(chosen.ending, _write_film)
        write(source, pictures, chosen, meter)
    finally:
        meter.finish()
    return pictures


def real_time(store_rate: float, every: int, film_rate: float) -> str:
    """Sentence on how much slower a film is than the scene was.

    **Arguments:** `store_rate`: frames of the recording per second; `every`: frames from one picture to the next;
    `film_rate`: pictures of the film per second.
    """
    seconds = film_rate * every / store_rate
    unit, factor = next(((u, f) for u, f in (("s", 1), ("ms", 1e3), ("µs", 1e6)) if seconds * f >= 1), ("ns", 1e9))
    return f"1 s of the film is {seconds * factor:.3g} {unit} of the recording."


def _images(store: SequenceStore, meter: Progress) -> Iterator[Float[np.ndarray, "H W"]]:
    for number in range(len(store.keys)):
        yield store.picture(number)
        meter.advance(1)


def _write_film(store: SequenceStore, pictures: list[Picture], chosen: SequenceFormat, meter: Progress) -> None:
    white = store.white.level if chosen.white is None else chosen.white
    shown = (np.nan_to_num(image, nan=0.0) for image in _images(store, meter))
    rate = chosen.film_rate(len(pictures))
    count = write_film(chosen.path, shown, rate=rate, gamma=chosen.gamma, white=white)
    assert count == len(pictures)


def _write_folder(store: SequenceStore, pictures: list[Picture], chosen: SequenceFormat, meter: Progress) -> None:
    place = real_place(chosen.path)
    new, old = (place.with_name(f".{place.name}.{what}") for what in ("new", "old"))
    white = (store.white.level if chosen.white is None else chosen.white) if chosen.bits == 8 else 1.0
    names = _names(pictures, STILLS[chosen.bits])
    try:
        for left in (new, old):  # by an export that was killed
            shutil.rmtree(left, ignore_errors=True)
        (new / IMAGES).mkdir(parents=True)
        for name, image in zip(names, read_meanwhile(_images(store, meter)), strict=True):
            if name is not None:
                write_picture(new / IMAGES / name, image, bits=chosen.bits, gamma=chosen.gamma, white=white)
        with open(new / TABLE, "w", newline="", encoding="utf-8") as file:
            _write_table(file, pictures, names)
        if place.exists():
            os.replace(place, old)
        os.replace(new, place)
    except OSError as error:
        raise InputError(f"Cannot write {chosen.path}: {(error.strerror or str(error)).lower()}.") from error
    finally:
        for left in (new, old):
            shutil.rmtree(left, ignore_errors=True)


def _write_npy(store: SequenceStore, pictures: list[Picture], chosen: SequenceFormat, meter: Progress) -> None:
    array, table = chosen.outputs
    with whole_file(table) as beside:
        with whole_file(array) as temporary, open(temporary, "wb") as file:
            _write_array(file, store.shape, read_meanwhile(_images(store, meter)))
        with open(beside, "w", newline="", encoding="utf-8") as file:
            _write_table(file, pictures, [None] * len(pictures))


def _write_npz(store: SequenceStore, pictures: list[Picture], chosen: SequenceFormat, meter: Progress) -> None:
    motion = store.motion_shape
    small = {
        "key_frame": np.array([one.key for one in pictures]),
        "seconds": np.array([one.seconds for one in pictures]),
        "motion_from": np.array([one.motion_from for one in pictures]),
        "status": np.array([one.status.name for one in pictures if one.status is not None]),
        "scale": np.array(store.scale),
        "readout_rate": np.array(store.readout_rate),
        "white": np.array(store.white.level),
    }
    count = len(pictures)
    with whole_file(chosen.path) as temporary, zipfile.ZipFile(temporary, "w", allowZip64=True) as archive:
        for name, values in small.items():
            with archive.open(f"{name}.npy", "w") as file:
                np.lib.format.write_array(file, values, allow_pickle=False)
        large: dict[str, tuple[tuple[int, ...], Any]] = {
            "image": (store.shape, _images(store, meter)),
            "velocity": ((count, 2, *motion), (store.motion(one)[0] for one in range(count))),
            "confidence": ((count, *motion), (store.motion(one)[1] for one in range(count))),
            "bad_pixels": ((count, *motion), (store.bad_pixels(one).kind for one in range(count))),
        }
        for name, (shape, items) in large.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                _write_array(file, shape, read_meanwhile(items), "|u1" if name == "bad_pixels" else "<f4")


def _write_array(file: Any, shape: tuple[int, ...], items: Iterator[np.ndarray], kind: str = "<f4") -> None:
    """Writes an array of `shape` in the format of NumPy, one item along its first axis at a time."""
    header = {"descr": kind, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_2_0(file, header)
    for item in items:
        file.write(np.ascontiguousarray(item, kind).tobytes())


def _write_table(file: Any, pictures: list[Picture], names: list[str | None]) -> None:
    """The times of the pictures, with the name of each one's file if it has one."""
    rows = csv.writer(file, lineterminator="\n")
    rows.writerow(COLUMNS)
    rows.writerows(row_of(one, name) for one, name in zip(pictures, names, strict=True))


def row_of(picture: Picture, name: str | None) -> list[Any]:
    """The row of a picture in a table of times, in the order of `COLUMNS`."""
    status = "" if picture.status is None else picture.status.name
    return [picture.number, name or "", picture.key, repr(picture.seconds), status, picture.motion_from]


def _names(pictures: list[Picture], ending: str) -> list[str | None]:
    """Names by key frame, all of one length so that they sort by time; None for a picture that failed."""
    digits = max(6, len(str(pictures[-1].key)))
    return [
        f"{one.key:0{digits}d}{ending}" if one.status is not None and one.status.usable else None for one in pictures
    ]
