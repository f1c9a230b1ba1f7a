"""`Plan`: which pictures a sequence has, from which recording and by which options.

Everything that decides a bit of a picture is in the plan's description, plain values that a store keeps. Two plans of
one description, by one version of the packages on one kind of device, lead to the same pictures, bit for bit.
"""

import dataclasses
import enum
import functools
import hashlib
import importlib.metadata
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, SupportsFloat, SupportsIndex

import jax
import numpy as np
from numpy.typing import ArrayLike

from scsr_opt._validation import whole
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.sources import CroppedSource, SpikeSource
from scsr_opt.camera.white import White
from scsr_opt.errors import InputError, shown
from scsr_opt.motion.trajectory import Motion
from scsr_opt.pipeline.options import Options

GROUP = 10
"""Pictures of a group, where nothing else is said: a kill costs half a group's work on average, and the first picture
of a group takes twice as long as one that starts from the picture before (docs/decisions/0019)."""

# Frames of a recording, at most, whose spikes tell it from others: in all, and around each key frame, where its picture
# comes from. Reading them takes about a second.
_COMPARED_FRAMES, _COMPARED_AROUND_KEY = 1000, 101


@dataclass(frozen=True, eq=False)
class Plan:
    """The pictures of a sequence; made by `Plan.of`.

    **Fields:**
    - `recording`: with absolute paths, so that workers find its file.
    - `keys`: the key frames.
    - `scale`: pixels of a picture per sensor pixel, along each axis.
    - `options`: of each picture, validated.
    - `group`: number of neighbouring key frames that are solved for one after the other, each from the one before.
      A group starts afresh and depends on no other one.
    - `white`: intensity that is shown as white; None where it is to be found in the recording.
    """

    recording: Recording
    keys: range
    scale: int
    options: Options
    group: int
    white: White | None

    @classmethod
    def of(
        cls,
        spikes: ArrayLike | Recording,
        keys: Any,
        *,
        scale: SupportsIndex,
        options: Options | None = None,
        group: SupportsIndex = GROUP,
        white: SupportsFloat | None = None,
        **changes: Any,
    ) -> "Plan":
        """A plan from what can be given to `reconstruct_sequence`, checked.

        **Arguments:** `keys`: a range of frames, in ascending order; the others: as the fields. `changes`: fields of
        `options`.

        **Raises:** `InputError` for what cannot be used.
        """
        recording = spikes if isinstance(spikes, Recording) else Recording.from_array(spikes)
        if not isinstance(keys, range) or len(keys) == 0 or keys.step < 1:
            raise InputError(f"keys is {shown(keys)}; it must be a range of frames, such as range(60, 160, 10).")
        for key in (keys[0], keys[-1]):
            whole(key, "keys", 0, recording.frames - 1)
        asked = Options.of(options, changes)
        if isinstance(asked.motion, Motion):
            raise InputError("motion is a Motion, which holds at one key frame; give an Estimator, or nothing.")
        if asked.keep_images:
            raise InputError("keep_images is True, but a sequence keeps no stages: leave it out.")
        number = whole(scale, "scale", 1)
        return cls(
            recording=dataclasses.replace(recording, source=_absolute(recording.source)),
            keys=range(keys[0], keys[-1] + 1, keys.step),
            scale=number,
            options=asked.validated(recording, number),
            group=whole(group, "group", 1),
            white=None if white is None else White.given(float(white)),
        )

    @property
    def part(self) -> Recording:
        """The recording of the part of the sensor that is solved for."""
        return self.recording if self.options.crop is None else self.recording.crop(*self.options.crop)

    @property
    def groups(self) -> list[range]:
        """The groups, each as a range of numbers of pictures."""
        return groups_of(len(self.keys), self.group)

    @functools.cached_property
    def description(self) -> dict[str, Any]:
        """All that decides the pictures, in terms of JSON. Of the recording: its shape, rates and bad pixels, and a
        hash of the spikes around the key frames, of 1,000 frames at most."""
        recording = self.recording
        step = max(1, -(-len(self.keys) // _COMPARED_FRAMES))
        digest = hashlib.blake2b(digest_size=16)
        before = (min(_COMPARED_AROUND_KEY, _COMPARED_FRAMES // len(self.keys[::step])) - 1) // 2
        for key in self.keys[::step]:
            around = recording.window(max(0, key - before), min(recording.frames, key + before + 1))
            digest.update(np.packbits(around).tobytes())
        return {
            "first_key": self.keys[0],
            "last_key": self.keys[-1],
            "every": self.keys.step,
            "scale": self.scale,
            "group": self.group,
            "white": None if self.white is None else self.white.level,
            "recording": {
                "shape": list(recording.shape),
                "readout_rate": recording.readout_rate,
                "white_rate": recording.white_rate,
                "bad_pixels": described(recording.bad_pixels),
                "spikes": digest.hexdigest(),
            },
            "options": described(self.options),
        }


def groups_of(pictures: int, group: int) -> list[range]:
    """Numbers 0 to `pictures` − 1 in groups of `group`; the last one may be smaller."""
    return [range(first, min(first + group, pictures)) for first in range(0, pictures, group)]


def versions() -> dict[str, str]:
    """Versions on which the bits of a picture depend, and the kind of device."""
    packages = ("scsr-opt", "jax", "jaxlib", "numpy", "scipy")
    return {**{name: importlib.metadata.version(name) for name in packages}, "device": jax.devices()[0].device_kind}


def described(value: Any) -> Any:
    """`value` in terms of JSON, so that equal descriptions mean equal values: arrays by a hash of their content,
    objects by their class and fields, functions by their name and what they enclose."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        if array.ndim == 0:
            return array.item()
        content = hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=16).hexdigest()
        return f"{array.dtype} {array.shape} {content}"
    if isinstance(value, dict):
        return {str(name): described(one) for name, one in value.items()}
    if isinstance(value, list | tuple | range | frozenset | set):
        return [described(one) for one in (sorted(value, key=str) if isinstance(value, frozenset | set) else value)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {one.name: described(getattr(value, one.name)) for one in dataclasses.fields(value)}
        return {"kind": type(value).__qualname__, **fields}
    if isinstance(value, functools.partial):
        return [described(value.func), described(value.args), described(value.keywords)]
    name = f"{getattr(value, '__module__', '')}.{getattr(value, '__qualname__', type(value).__qualname__)}"
    enclosed = [described(cell.cell_contents) for cell in getattr(value, "__closure__", None) or ()]
    return {"kind": name, "of": enclosed} if enclosed else name


def differences(there: Any, here: Any, name: str = "") -> Iterator[str]:
    """Clauses that say in which of their parts two descriptions differ."""
    both = isinstance(there, dict) and isinstance(here, dict)
    if both and there.get("kind") == here.get("kind"):
        for part in sorted(there.keys() | here.keys()):
            below = f"{name}.{part}" if name and name not in ("options", "recording") else part
            yield from differences(there.get(part), here.get(part), below)
    elif there != here:
        yield f"{name} is {_brief(there)} there and {_brief(here)} here"


def _brief(value: Any) -> str:
    return str(value["kind"]) if isinstance(value, dict) and "kind" in value else shown(value)


def _absolute(source: SpikeSource) -> SpikeSource:
    """`source` with absolute paths."""
    if isinstance(source, CroppedSource):
        return dataclasses.replace(source, source=_absolute(source.source))
    if dataclasses.is_dataclass(source) and hasattr(source, "path"):
        return dataclasses.replace(source, path=source.path.absolute())  # type: ignore[call-arg]
    return source
