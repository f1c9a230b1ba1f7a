"""Trained networks in files that cannot be mistaken for another, nor be damaged unnoticed.

A file is one line `scsr-network 1 SHA256`, a line of JSON (what the file holds), and the arrays as Equinox writes them.
The checksum is that of all that follows the first line. Files are written under another name and renamed when they are
whole.
"""

import dataclasses
import hashlib
import io
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from learned.training.registry import trainable
from scsr_opt._files import whole_file
from scsr_opt.errors import InputError

FORMAT = 1
"""Number of the file's format; a reader refuses others."""
SHIPPED = Path(__file__).parents[1] / "checkpoints"
"""Where the shipped weights are."""
LARGEST = 20_000_000
"""Bytes: what a shipped checkpoint may take."""

_MAGIC = b"scsr-network"


@dataclass(frozen=True)
class Card:
    """Origin, sizes and scores of a trained network.

    **Fields:**
    - `model`: its name in `learned.training.registry`.
    - `configuration`: what it is built from: `scale`, and `network` (a table of sizes).
    - `data`: what it was trained on, in words.
    - `steps`: of training.
    - `hardware`: that it was trained on.
    - `scores`: by name; PSNR in dB.
    - `precision`: `float32` or `float16`, how the weights are stored; they are float32 again when loaded.
    - `training`: how it was trained, if that is known.
    """

    model: str
    configuration: Mapping[str, Any]
    data: str
    steps: int
    hardware: str
    scores: Mapping[str, float | int]
    precision: str = "float32"
    training: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self):
        if self.precision not in ("float32", "float16"):
            raise InputError(f"precision is {self.precision!r}, but weights are stored as float32 or float16.")


def save(path: str | os.PathLike[str], model: Any, card: Card) -> None:
    """Writes a network with its card.

    **Raises:** `InputError` if the file would be larger than 20 MB, or cannot be written.
    """
    stored = _cast(model, jnp.float32, jnp.float16) if card.precision == "float16" else model
    content = packed(dataclasses.asdict(card), stored)
    if len(content) > LARGEST:
        raise InputError(
            f"The checkpoint {path} would take {len(content) / 1e6:.1f} MB, but {LARGEST / 1e6:g} MB are allowed: "
            f"store it with precision float16, or take a smaller network."
        )
    write(path, content)


def load(
    path: str | os.PathLike[str], *, like: Any = None, configuration: Mapping[str, Any] | None = None
) -> tuple[Any, Card]:
    """Reads a network and its card.

    **Arguments:**
    - `like`: a model of the same structure, whose weights are not used; None builds it from the card.
    - `configuration`: what the network must have been built from, or None for any.

    **Raises:** `InputError` if there is no such file, it is none of these, damaged, of another configuration, or does
    not fit `like`.
    """
    header, payload = read(path)
    try:
        card = Card(**header)
        scale, network = card.configuration["scale"], card.configuration["network"]
    except (TypeError, KeyError) as error:
        raise InputError(f"{path} is not the checkpoint of a network (maybe a run's state): name another.") from error
    if configuration is not None:
        check_same(path, card.configuration, configuration)
    if like is None:
        built = trainable(card.model, scale, network)
        # Of float32 as the file, also where `JAX_ENABLE_X64` makes what is built anew float64.
        like = _cast(eqx.filter_eval_shape(built.build, jax.random.key(0)), jnp.float64, jnp.float32)
    stored = _cast(like, jnp.float32, jnp.float16) if card.precision == "float16" else like
    return _cast(unpacked(path, payload, stored), jnp.float16, jnp.float32), card


def grafted(model: Any, name: str) -> tuple[Any, Card]:
    """`model` with the weights of a file in the place of its own wherever the file has some, and the file's card.

    A part of a network (`learned.networks.velocity.VelocityNet`) has a place in it of the same name. Either may be the
    part: the rest of a network keeps its weights, the rest of a file is not used. A whole SpikeSR-Net may be of another
    scale (`learned.networks.rescaling`).

    **Arguments:** `name`: of shipped weights, for example `spikesr-small-x4`, or the path of a .scsr file; with a colon
    and the name of a part behind it, `spikesr-small-x4:velocity`, that part alone is taken.

    **Raises:** `InputError` as `load`, or if the file has no such part, neither's weights all have a place in the
    other, or a shape differs.
    """
    file, _, asked = name.rpartition(":")
    if not (file and asked.isidentifier()):  # a drive's colon has a path behind it
        file, asked = name, None
    shipped = SHIPPED / f"{file}.scsr"
    path = shipped if shipped.is_file() else Path(file)
    given, card = load(path)
    if asked is None:
        given = _rescaled(given, model)
    theirs = {
        jax.tree_util.keystr(place): leaf
        for place, leaf in _weights(given)
        if asked is None or jax.tree_util.keystr(place[:1]) == f".{asked}"
    }
    if not theirs:
        raise InputError(f"{path} has no weights of a part {asked!r}: name one that it has, or the file alone.")
    mine = {jax.tree_util.keystr(place): leaf for place, leaf in _weights(model)}
    part = mine.keys() <= theirs.keys()
    for place, leaf in theirs.items():
        if part and place not in mine:
            continue
        if place not in mine or mine[place].shape != leaf.shape:
            found = f"of shape {mine[place].shape}" if place in mine else "nothing"
            raise InputError(
                f"{path} has weights {place} of shape {leaf.shape}, for which the network to be trained has {found}: "
                f"start from a file of the same scale and sizes."
            )

    def chosen(place: Any, leaf: Any) -> Any:
        found = theirs.get(jax.tree_util.keystr(place)) if eqx.is_inexact_array(leaf) else None
        return leaf if found is None else jnp.asarray(found, leaf.dtype)

    return jax.tree_util.tree_map_with_path(chosen, model), card


def _rescaled(given: Any, model: Any) -> Any:
    """`given`, or if both are whole SpikeSR-Nets and not of one scale, that for the scale of `model`."""
    from learned.networks.rescaling import rescaled
    from learned.networks.spikesr import SpikeSRNet

    whole = isinstance(given, SpikeSRNet) and isinstance(model, SpikeSRNet)
    return rescaled(given, model) if whole and given.config.scale != model.config.scale else given


def _weights(model: Any) -> list[tuple[Any, Any]]:
    return jax.tree_util.tree_leaves_with_path(eqx.filter(model, eqx.is_inexact_array))


def check_same(path: str | os.PathLike[str], found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """**Raises:** `InputError` naming the first entry in which two configurations differ, `model` before all others."""
    a, b = (json.loads(json.dumps(dict(c), default=dict)) for c in (found, wanted))  # tuples are lists in files
    for name in sorted(a.keys() | b.keys(), key=lambda name: (name != "model", name)):
        if a.get(name) != b.get(name):
            raise InputError(
                f"{path} was made with another configuration: {name} is {a.get(name)!r} there, but {b.get(name)!r} is "
                f"wanted; take that, or another file."
            )


def packed(header: Mapping[str, Any], tree: Any) -> bytes:
    """The content of a file: `header`, which must be plain enough for JSON, and the leaves of `tree`."""
    stream = io.BytesIO()
    stream.write(json.dumps(dict(header), default=dict).encode() + b"\n")
    eqx.tree_serialise_leaves(stream, tree)
    content = stream.getvalue()
    return b"%s %d %s\n%s" % (_MAGIC, FORMAT, hashlib.sha256(content).hexdigest().encode(), content)


def write(path: str | os.PathLike[str], content: bytes) -> None:
    """Writes a file that is there whole or not at all, even if the machine goes down. **Raises:** `InputError`."""
    with whole_file(path) as temporary, temporary.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())


def read(path: str | os.PathLike[str]) -> tuple[dict[str, Any], bytes]:
    """The header and the leaves of a file that `packed` made.

    **Raises:** `InputError` if there is no such file, it is of another kind or format, or damaged.
    """
    try:
        first, _, content = Path(path).read_bytes().partition(b"\n")
    except OSError as error:
        raise InputError(f"The checkpoint {path} cannot be read: {(error.strerror or str(error)).lower()}.") from error
    words = first.split(b" ")
    if len(words) != 3 or words[0] != _MAGIC:
        raise InputError(f"{path} is not a checkpoint of a network: name a file that `scsr train` wrote.")
    if words[1] != b"%d" % FORMAT:
        raise InputError(
            f"{path} has format {words[1].decode(errors='replace')}, but this version reads format {FORMAT}: use the "
            f"version of the program that wrote it."
        )
    if hashlib.sha256(content).hexdigest().encode() != words[2]:
        raise InputError(f"{path} is damaged or cut short (its checksum is wrong): fetch or train it again.")
    header, _, payload = content.partition(b"\n")
    return json.loads(header), payload


def unpacked(path: str | os.PathLike[str], payload: bytes, like: Any) -> Any:
    """The leaves of a file in the structure of `like`, whose arrays may be `jax.ShapeDtypeStruct`.

    **Raises:** `InputError` if they do not fit.
    """
    stream = io.BytesIO(payload)
    try:
        tree = eqx.tree_deserialise_leaves(stream, like)
        fits = not stream.read(1)
    except (RuntimeError, ValueError, EOFError, TypeError):
        fits, tree = False, None
    if not fits:
        raise InputError(
            f"{path} holds weights of other shapes than this network has: build it with the configuration of the file."
        )
    return tree


def _cast(tree: Any, given: Any, wanted: Any) -> Any:
    """Every array (or shape of one) of type `given` as `wanted`."""

    def cast(leaf: Any) -> Any:
        if isinstance(leaf, jax.ShapeDtypeStruct):
            return jax.ShapeDtypeStruct(leaf.shape, wanted) if leaf.dtype == given else leaf
        return leaf.astype(wanted) if eqx.is_array(leaf) and leaf.dtype == given else leaf

    return jax.tree.map(cast, tree)
