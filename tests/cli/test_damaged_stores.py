"""Stores that are damaged on purpose: one line of error, and nothing half-written."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest


def attributes(**changes: object) -> Callable[[], None]:
    """Changes of the attributes of the store; None removes one. A name with __ is one in another."""

    def damage() -> None:
        place = Path("a.zarr/zarr.json")
        content = json.loads(place.read_bytes())
        for name, value in changes.items():
            *above, last = name.split("__")
            inner = content["attributes"]["scsr"]
            for one in above:
                inner = inner[one]
            if value is None:
                del inner[last]
            else:
                inner[last] = value
        place.write_text(json.dumps(content))

    return damage


def metadata(array: str, **changes: object) -> Callable[[], None]:
    """Changes of the metadata of one array."""

    def damage() -> None:
        place = Path("a.zarr", array, "zarr.json")
        place.write_text(json.dumps(json.loads(place.read_bytes()) | changes))

    return damage


def text(place: str, content: bytes) -> Callable[[], object]:
    return lambda: Path("a.zarr", place).write_bytes(content)


def gone(place: str) -> Callable[[], object]:
    def damage() -> None:
        path = Path("a.zarr", place)
        shutil.rmtree(path) if path.is_dir() else path.unlink()

    return damage


def as_file(place: str) -> Callable[[], object]:
    """A file in the place of a folder."""

    def damage() -> None:
        shutil.rmtree(Path("a.zarr", place))
        Path("a.zarr", place).write_bytes(b"")

    return damage


def as_folder(place: str) -> Callable[[], object]:
    def damage() -> None:
        os.unlink(Path("a.zarr", place))
        os.mkdir(Path("a.zarr", place))

    return damage


def status(value: int) -> Callable[[], object]:
    def damage() -> None:
        import zarr

        group = zarr.open_group("a.zarr", mode="r+")
        array = group["status"]
        assert isinstance(array, zarr.Array)
        array[1] = value

    return damage


DAMAGES: dict[str, Callable[[], object]] = {
    "metadata missing": gone("zarr.json"),
    "metadata empty": text("zarr.json", b""),
    "metadata cut": text("zarr.json", b'{"attributes": {"scsr": {"for'),
    "metadata of bytes": text("zarr.json", bytes(range(256))),
    "metadata a list": text("zarr.json", b"[1, 2]"),
    "metadata null": text("zarr.json", b"null"),
    "metadata deep": text("zarr.json", b"[" * 100_000),
    "metadata of another group": text("zarr.json", b'{"zarr_format": 3, "node_type": "group", "attributes": {}}'),
    "metadata of an array": lambda: shutil.copy("a.zarr/image/zarr.json", "a.zarr/zarr.json"),
    "metadata a folder": as_folder("zarr.json"),
    "format of later": attributes(format=99),
    "format of text": attributes(format="new"),
    "format a list": attributes(format=[1]),
    "no format": attributes(format=None),
    "no sequence": attributes(sequence=None),
    "sequence a list": attributes(sequence=[]),
    "no key frames": attributes(sequence__first_key=None),
    "key frames of text": attributes(sequence__first_key="first"),
    "key frames of fractions": attributes(sequence__first_key=0.5),
    "key frames every 0": attributes(sequence__every=0),
    "key frames of another number": attributes(sequence__last_key=2),
    "no scale": attributes(sequence__scale=None),
    "scale of text": attributes(sequence__scale="large"),
    "group of 0": attributes(sequence__group=0),
    "no recording": attributes(sequence__recording=None),
    "readout rate of 0": attributes(sequence__recording__readout_rate=0),
    "readout rate of text": attributes(sequence__recording__readout_rate="fast"),
    "no white": attributes(white=None),
    "white of other fields": attributes(white={"bright": 1}),
    "white of text": attributes(white={"level": "bright", "reason": "none"}),
    "white of 0": attributes(white={"level": 0.0, "reason": "none"}),
    "array missing": gone("image"),
    "metadata of an array missing": gone("image/zarr.json"),
    "metadata of an array empty": text("status/zarr.json", b""),
    "array of another length": metadata("image", shape=[3, 24, 40]),
    "array of other dimensions": metadata("image", shape=[4, 960]),
    "array of another type": metadata("image", data_type="nonsense"),
    "array of unknown codecs": metadata("velocity", codecs=[{"name": "nonsense"}]),
    "array of a later version": metadata("image", zarr_format=9),
    "array a group": metadata("image", node_type="group"),
    "array a file": as_file("image"),
    "chunks a file": as_file("image/c"),
    "chunk a folder": as_folder("image/c/2/0/0"),
    "chunk missing": gone("image/c/2/0/0"),
    "chunk empty": text("image/c/2/0/0", b""),
    "chunk of something else": text("image/c/2/0/0", b"something else" * 9),
    "chunk of another picture": lambda: shutil.copy("a.zarr/velocity/c/0/0/0/0", "a.zarr/image/c/2/0/0"),
    "chunk of velocities damaged": text("velocity/c/1/0/0/0", b"hurt"),
    "chunk of confidence missing": gone("confidence/c/1"),
    "chunk of states missing": gone("status/c/1"),
    "chunk of states damaged": text("status/c/0", b"hurt"),
    "chunk of states empty": text("status/c/0", b""),
    "states unknown": status(77),
    "state not there": status(0),
    "chunk of origins damaged": text("motion_from/c/0", b"hurt"),
}


@pytest.mark.parametrize("case", DAMAGES)
def test_damaged_stores_are_not_exported(refused, originals, case):
    shutil.copytree(originals / "a.zarr", "a.zarr")
    DAMAGES[case]()
    refused("export", "a.zarr", "-o", "new.npz")


UNREADABLE = [case for case in DAMAGES if case.split()[0] not in ("chunk", "chunks", "state", "states")]


@pytest.mark.parametrize("case", UNREADABLE)
def test_unreadable_stores_are_not_gone_on_with(refused, originals, case):
    """Stores of which more is damaged than chunks, which are made anew."""
    shutil.copytree(originals / "a.zarr", "a.zarr")
    DAMAGES[case]()
    refused("sequence", "ramp.npz", "-o", "a.zarr", "--every", "10", "--scale", "1", "--group", "3")
