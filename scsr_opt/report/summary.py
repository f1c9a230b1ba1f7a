"""The numbers of a reconstruction: for a JSON file, and in three lines for a reader."""

import dataclasses
import enum
import importlib.metadata
import json
import math
import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scsr_opt._files import whole_file
from scsr_opt.camera.saturation import said_of
from scsr_opt.pipeline.solution import Solution
from scsr_opt.solvers.record import Stage

UNEXPLAINED_SHARE = 0.1
"""`Diagnostics.light_unexplained` from which on a reader is told."""
CONTRADICTED = 1.05
"""Misfit of the picture of `quality="best"` over that of the first solution, above which a reader is told that the
measurements contradict the network's picture. Of 150 recordings that were made to fool the network, none has more than
1.04 (docs/learned.md)."""
# Kinds of bad pixels (`scsr_opt.calibration.PixelKind`) for a reader.
_KINDS = {
    "given": "as marked",
    "dead": "dead",
    "hot": "always firing",
    "isolated": "unlike all pixels around",
    "resting": "like dust, unchanged while the scene moves",
}
_VERSIONS_OF = ("scsr-opt", "jax", "jaxlib", "equinox", "jaxopt", "optimistix", "numpy", "scipy", "scikit-image")


@dataclass(frozen=True, repr=False)
class Report:
    """A solution's numbers, without its arrays.

    **Fields** (all of them plain: str, int, float, bool, None, and lists and dictionaries of these):
    - `recording`: name, frames, width, height, readout_rate (Hz), white_rate (spikes per frame of white), bad_pixels
      (how many are known or were found).
    - `picture`: width, height, scale, key, crop (top, left, height, width of the part of the sensor that it shows; None
      for all of it), and the least, mean and greatest intensity (1 = white).
    - `white`: level (intensity that 8-bit pictures and figures show as white), found, reason.
    - `status`: name, message, usable.
    - `motion`: mean and greatest speed, sensor pixels per frame; None where no motion was used.
    - `diagnostics`: the numbers of `Diagnostics`. `scene`, `tiles`: numbers of the scene's summary and of the tiles'
      iterations, where the solution has them.
    - `stages`: one dictionary per iteration, as `Stage` but without its arrays.
    - `seconds`: what took how long, where it was measured.
    - `versions`: Python and the packages that the numbers depend on.
    """

    recording: dict[str, Any]
    picture: dict[str, Any]
    white: dict[str, Any]
    status: dict[str, Any]
    motion: dict[str, Any] | None
    diagnostics: dict[str, Any]
    scene: dict[str, Any] | None
    tiles: dict[str, Any] | None
    stages: list[dict[str, Any]]
    seconds: dict[str, float]
    versions: dict[str, str]

    @classmethod
    def of(
        cls,
        solution: Solution,
        *,
        seconds: Mapping[str, float] | None = None,
    ) -> "Report":
        """The report of a solution; `seconds`: how long parts of the work around it took, by name."""
        recording, image = solution.recording, np.asarray(solution.image)
        bad = recording.bad_pixels if solution.bad_pixels is None else solution.bad_pixels.mask
        motion = None
        if solution.velocity is not None:
            speed = np.hypot(*np.asarray(solution.velocity, dtype=np.float64))
            motion = {
                "unit": "sensor pixels per frame",
                "mean_speed": float(speed.mean()),
                "top_speed": float(speed.max()),
            }
        return cls(
            recording={
                "name": recording.name,
                "frames": recording.frames,
                "width": recording.width,
                "height": recording.height,
                "readout_rate": plain(recording.readout_rate),
                "white_rate": plain(solution.white_rate),
                "bad_pixels": None if bad is None else int(np.count_nonzero(bad)),
            },
            picture={
                "width": image.shape[1],
                "height": image.shape[0],
                "scale": solution.scale,
                "key": solution.key,
                "crop": plain(solution.crop),
                "minimum": plain(image.min()),
                "mean": plain(image.mean(dtype=np.float64)),
                "maximum": plain(image.max()),
            },
            white=plain(solution.white),
            status={
                "name": solution.status.name,
                "message": solution.status.message,
                "usable": solution.status.usable,
            },
            motion=plain(motion),
            diagnostics=plain(solution.diagnostics),
            scene=None if solution.scene is None else plain(solution.scene.numbers),
            tiles=None if solution.tiles is None else plain(solution.tiles.numbers),
            stages=[_stage(stage) for stage in solution.stages],
            seconds={name: round(float(value), 4) for name, value in (seconds or {}).items()},
            versions=versions(),
        )

    def lines(self) -> list[str]:
        """The report for a reader: what was made of what, how it ended, how long it took."""
        seen, made = self.recording, self.picture
        part = ""
        if made["crop"] is not None:
            top, left, height, width = made["crop"]
            part = f", {width}x{height} of them from row {top}, column {left}"
        lines = [
            f"{seen['name']}: {seen['frames']} frames of {seen['width']}x{seen['height']}{part}, key frame "
            f"{made['key']} -> {made['width']}x{made['height']} (x{made['scale']})"
        ]
        if self.motion is not None:
            mean, top = self.motion["mean_speed"], self.motion["top_speed"]
            said = f"{mean:.3g} sensor pixels per frame in the mean, {top:.3g} at most" if top else "none"
            lines.append(f"Motion: {said}.")
        if self.diagnostics["saturated"]:
            lines.append(f"Saturated: {said_of(self.diagnostics['saturated'])}.")
        numbers = {kind: n for kind, n in (self.diagnostics["bad_pixels"] or {}).items() if n}
        if numbers:
            kinds = ", ".join(f"{n:,} {_KINDS[kind]}" for kind, n in numbers.items())
            count = sum(numbers.values())
            lines.append(f"Bad pixels: {count:,} {'is' if count == 1 else 'are'} not used: {kinds}.")
        lines += _of_light(self.diagnostics)
        if self.diagnostics["used_frames"] is not None:
            least, usual, most = self.diagnostics["used_frames"]
            parts = (
                "" if most - least < 1 else f" in the median pixel, {least:.0f} to {most:.0f} in nine tenths of them"
            )
            lines.append(f"Time: {usual:.0f} frames before and after the key frame are used{parts}.")
        lines += _of_quality(self.diagnostics)
        took = f" {self.seconds['solve']:.1f} s in all." if "solve" in self.seconds else ""
        lines.append(f"{self.diagnostics['iterations']} iterations. {self.status['message']}{took}")
        return lines

    def __repr__(self) -> str:
        """The lines for a reader, also as the last line of a notebook's cell; `json` has all."""
        return "\n".join(self.lines())

    def json(self) -> str:
        """The report as indented JSON; what is not a number (NaN, infinity) is null."""
        return json.dumps(dataclasses.asdict(self), indent=1, allow_nan=False, ensure_ascii=False)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Writes the JSON; a file of that name is replaced, as by `numpy.save`.

        **Raises:** `InputError` if the file cannot be written.
        """
        # Names of files may hold bytes that are no text; in JSON they are escapes, as backslashreplace writes them.
        encoded = (self.json() + "\n").encode("utf-8", "backslashreplace")
        with whole_file(path) as temporary:
            temporary.write_bytes(encoded)


def versions() -> dict[str, str]:
    """The versions of Python and of the packages that results depend on; those not installed are left out."""
    found = {"python": platform.python_version()}
    for name in _VERSIONS_OF:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def plain(value: Any) -> Any:
    """`value` in terms of JSON: NumPy and JAX scalars become numbers, arrays lists, enumerations their names, NaN None.

    What is none of these becomes its `str`, so that a report is never lost to one odd entry.
    """
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(name): plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(entry) for entry in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if hasattr(value, "__array__"):
        return plain(np.asarray(value).tolist())
    return value.as_posix() if isinstance(value, Path) else str(value)


def _of_light(found: Mapping[str, Any]) -> list[str]:
    """Lines on the light that was found to change, and on brightness that changes for no reason that was found."""
    lines = []
    if found["light_depth"] is not None:
        often = found["light_frequency"]
        at = "" if often is None else f" at {often:.0f} Hz"
        lines.append(f"Light: flickers{at}, by {100 * found['light_depth']:.0f} % of its mean either way.")
    if (found["light_unexplained"] or 0) >= UNEXPLAINED_SHARE:
        lines.append(
            f"Light: brightness changes on about {100 * found['light_unexplained']:.0f} % of the sensor as neither "
            f"motion nor flicker explains, such as by shadows or reflections; the picture may be wrong there."
        )
    return lines


def _of_quality(found: Mapping[str, Any]) -> list[str]:
    """Sentences on what a network did to the picture, where one was asked for."""
    off, ratio = found["restored_deviations"], found["misfit_ratio"]
    predicted = "" if off is None else f"{abs(off):.1f} standard deviations {'worse' if off > 0 else 'better'}"
    if found["restored"] is False:
        return [
            f"Quality: fast instead of best. The network's picture predicted held-out measurements {predicted} than "
            f"the usual picture does, so it was not used."
        ]
    if ratio is None:
        return []
    contradicts = ", so the measurements contradict the network's picture; compare with the quality fast"
    compared = f"are predicted {predicted} than before" if predicted else "were not compared, as λ was not searched for"
    return [
        f"Quality: best. A network improved the picture, and a second solve made it agree with the measurements: the "
        f"misfit is {ratio:.3f} times that before{contradicts if ratio > CONTRADICTED else ''}. Held-out measurements "
        f"{compared}."
    ]


def _stage(stage: Stage) -> dict[str, Any]:
    numbers = ("number", "objective", "data", "prior", "residual", "step_size", "seconds")
    return {name: plain(getattr(stage, name)) for name in numbers}
