"""The layout of a store: its arrays and attributes, as a Zarr v3 group with OME-Zarr 0.5 metadata.

    image        (T, H, W)     float32  intensity, 1 = white; one chunk a picture
    velocity     (T, 2, h, w)  float32  sensor pixels per frame, down and right
    confidence   (T, h, w)     float32  of the velocity, 0 to 1
    bad_pixels   (T, h, w)     uint8    pixels that were not used, by kind (`calibration.PixelKind`)
    t, y, x      (T,) (H,) (W,)         seconds, sensor pixels: the coordinates of `image`
    key_frame    (T,)                   of each picture
    status       (T,)          uint8    0: not there; others: how the solve ended (its attribute `meanings`)
    motion_from  (T,)                   key frame at which the motion was estimated; another one where it was carried on
    iterations, strength  (T,)          of the solve

`status` has one chunk for each group of pictures, written last.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from scsr_opt.camera.white import White
from scsr_opt.errors import InputError
from scsr_opt.sequences.plan import Plan, versions
from scsr_opt.solvers.record import Status

FORMAT = 2
"""Number of this layout of arrays and attributes; a store with another one is refused."""
METADATA = "zarr.json"
"""File with the attributes of a store."""
STATUS_CODES = {status: number for number, status in enumerate(Status, 1)}
"""Numbers of `status`; 0 is a picture that is not there."""
PICTURE = ("image", "velocity", "confidence", "bad_pixels")
"""Arrays with a chunk for each picture."""
RESULTS = {
    "motion_from": ("int64", -1),
    "iterations": ("int32", 0),
    "strength": ("float64", float("nan")),
    "status": ("uint8", 0),
}
"""Arrays with a number for each picture, a chunk for each group: type, and value where there is no picture. `status` is
the last one."""


def need_zarr() -> Any:
    """The package zarr. **Raises:** `InputError` if it is not installed."""
    try:
        import zarr
    except ImportError:
        raise InputError(
            "A sequence needs the package zarr, which is not installed: pip install 'scsr-opt[sequence]'."
        ) from None
    return zarr


def is_store(path: Path) -> bool:
    """Whether `path` is a folder that `SequenceStore.create` made, whatever its version and state."""
    try:
        return "scsr" in json.loads((path / METADATA).read_bytes())["attributes"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def lay_out(path: Path, plan: Plan, white: White) -> None:
    """Makes the group and its arrays, with those that do not wait for pictures filled in."""
    zarr = need_zarr()
    from zarr.codecs import Crc32cCodec, ZstdCodec

    scale, pictures = plan.scale, len(plan.keys)
    height, width = plan.part.height, plan.part.width
    fixed = fixed_arrays(plan)
    corner = [float(fixed[name][0]) for name in ("t", "y", "x")]
    attributes = _attributes(plan, corner, white)
    arrays = zarr.create_group(path, zarr_format=3, attributes=attributes)
    checked = Crc32cCodec()

    def add(name: str, shape: tuple[int, ...], chunks: tuple[int, ...], names: tuple[str, ...], **others: Any) -> Any:
        packed = (ZstdCodec(level=1), checked) if len(shape) > 1 else (checked,)
        kinds = {"dtype": "float32", "fill_value": float("nan"), "compressors": packed}
        return arrays.create_array(name, shape=shape, chunks=chunks, dimension_names=names, **{**kinds, **others})

    size = (scale * height, scale * width)
    add("image", (pictures, *size), (1, *size), ("t", "y", "x"))
    add("velocity", (pictures, 2, height, width), (1, 2, height, width), ("t", "direction", "row", "column"))
    sensor = {"shape": (pictures, height, width), "chunks": (1, height, width), "names": ("t", "row", "column")}
    add("confidence", **sensor)
    add("bad_pixels", **sensor, dtype="uint8", fill_value=0)
    for name, (kind, missing) in RESULTS.items():
        add(name, (pictures,), (plan.group,), ("t",), dtype=kind, fill_value=missing)
    arrays["status"].attrs["meanings"] = {"0": "not there"} | {
        str(code): status.message for status, code in STATUS_CODES.items()
    }
    for name, values in fixed.items():
        kinds = {"dtype": values.dtype, "fill_value": {"f": float("nan"), "i": -1}.get(values.dtype.kind, 0)}
        add(
            name,
            values.shape,
            values.shape,
            (name if name in "tyx" else "t",),
            config={"write_empty_chunks": True},
            **kinds,
        )[:] = values


def _attributes(plan: Plan, corner: list[float], white: White) -> dict[str, Any]:
    """Attributes of the group: OME-Zarr's, and ours.

    **Arguments:** `corner`: (t, y, x) of the first pixel of the first picture, in seconds and sensor pixels.
    """
    step = [plan.keys.step / plan.recording.readout_rate, 1 / plan.scale, 1 / plan.scale]
    return {
        "ome": {
            "version": "0.5",
            "multiscales": [
                {
                    "name": plan.recording.name,
                    "axes": [
                        {"name": "t", "type": "time", "unit": "second"},
                        {"name": "y", "type": "space", "unit": "pixel"},
                        {"name": "x", "type": "space", "unit": "pixel"},
                    ],
                    "datasets": [
                        {
                            "path": "image",
                            "coordinateTransformations": [
                                {"type": "scale", "scale": step},
                                {"type": "translation", "translation": corner},
                            ],
                        }
                    ],
                }
            ],
            "omero": {
                "channels": [
                    {
                        "label": "intensity",
                        "color": "FFFFFF",
                        "active": True,
                        "window": {"min": 0.0, "max": max(1.0, white.level), "start": 0.0, "end": white.level},
                    }
                ],
                "rdefs": {"model": "greyscale"},
            },
        },
        "scsr": {
            "format": FORMAT,
            "versions": versions(),
            "sequence": plan.description,
            "white": {"level": white.level, "found": white.found, "reason": white.reason},
        },
    }


def fixed_arrays(plan: Plan) -> dict[str, np.ndarray]:
    """The arrays that do not wait for pictures, by their names."""
    part, scale = plan.part, plan.scale
    top, left = (0, 0) if plan.options.crop is None else (int(plan.options.crop[0]), int(plan.options.crop[1]))
    # Centres of the pixels, in sensor pixels whose centres are whole numbers.
    first = 0.5 / scale - 0.5
    return {
        "t": np.asarray(plan.keys) / plan.recording.readout_rate,
        "y": top + first + np.arange(scale * part.height) / scale,
        "x": left + first + np.arange(scale * part.width) / scale,
        "key_frame": np.asarray(plan.keys, np.int64),
    }


def status_of(code: int) -> Status | None:
    """**Raises:** `InputError` for a number that stands for nothing."""
    if code == 0:
        return None
    known = {number: status for status, number in STATUS_CODES.items()}
    if code not in known:
        raise InputError(f"The store is damaged: it has a status {code}, but there are 0 to {len(known)}.")
    return known[code]
