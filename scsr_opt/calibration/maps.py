"""`Calibration`: what is known of each pixel of a camera, measured once and used for all of its recordings."""

import io
import os
import zipfile
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Integer, Num, UInt8

from scsr_opt._files import as_path, whole_file
from scsr_opt.calibration.bad_pixels import BadPixels, PixelKind
from scsr_opt.camera.recording import Recording, bad_pixels_of
from scsr_opt.errors import InputError

_NAMES = ("bad_pixels", "gain", "dark")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Maps of a sensor.

    **Fields:**
    - `bad`: pixels that must not be used, and why.
    - `gain`: (h, w), sensitivity of each pixel; 1 is nominal, and where it is not known.
    - `dark`: (h, w), spikes per frame without any light; 0 where it is not known.
    """

    bad: BadPixels
    gain: Float[np.ndarray, "h w"]
    dark: Float[np.ndarray, "h w"]

    @property
    def shape(self) -> tuple[int, int]:
        """(h, w) of the sensor."""
        return self.gain.shape[0], self.gain.shape[1]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the maps to an .npz: `bad_pixels` (the number of a `PixelKind`), `gain`, `dark`.

        **Raises:** `InputError` if the file cannot be written.
        """
        stored = io.BytesIO()
        np.savez_compressed(stored, bad_pixels=self.bad.kind, gain=self.gain, dark=self.dark)
        with whole_file(path) as temporary:
            temporary.write_bytes(stored.getbuffer())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Calibration":
        """The maps in an .npz that `save` wrote, or that holds arrays of these names.

        **Raises:** `InputError` if it cannot be read, or its maps do not fit each other or hold values that none is.
        """
        try:
            with np.load(as_path(path), allow_pickle=False) as stored:
                bad, gain, dark = (np.asarray(stored[name]) for name in _NAMES)
        except FileNotFoundError as error:
            raise InputError(f"There is no calibration {path}: check the path.") from error
        except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile) as error:
            raise InputError(f"{path} holds no calibration: it is an .npz with arrays {', '.join(_NAMES)}.") from error
        wrong = gain.ndim != 2 or bad.shape != gain.shape or dark.shape != gain.shape
        wrong = wrong or bad.dtype.kind not in "iub" or gain.dtype.kind not in "fiu" or dark.dtype.kind not in "fiu"
        wrong = wrong or bad.min() < 0 or bad.max() >= len(PixelKind)
        if wrong or not (np.all((gain > 0) & np.isfinite(gain)) and np.all((dark >= 0) & (dark < 1))):
            raise InputError(
                f"{path} holds maps that cannot be used: bad_pixels are kinds from 0 to {len(PixelKind) - 1}, gains "
                f"above 0, dark levels from 0 to 1 spikes per frame, all of shape (height, width)."
            )
        return cls(_kinds(bad), gain.astype(np.float32), dark.astype(np.float32))

    def checked(self, recording: Recording) -> "Calibration":
        """This calibration. **Raises:** `InputError` if it is of a sensor of another size than the recording's."""
        height, width = self.shape
        if (recording.height, recording.width) != self.shape:
            raise InputError(
                f"The calibration is of {width}x{height} pixels, but {recording.name} has "
                f"{recording.width}x{recording.height}."
            )
        return self

    def crop(self, top: int, left: int, height: int, width: int) -> "Calibration":
        """The maps of a rectangle of the sensor."""
        rows, columns = slice(top, top + height), slice(left, left + width)
        return Calibration(self.bad.part(rows, columns), self.gain[rows, columns], self.dark[rows, columns])

    def applied(self, recording: Recording) -> Recording:
        """The recording with these bad pixels as well as its own."""
        self.checked(recording)
        return replace(recording, bad_pixels=bad_pixels_of(recording, self.bad.mask))

    def corrected(self, picture: Num[np.ndarray, "h w"], white_rate: float | int) -> Float[np.ndarray, "h w"]:
        """A picture at the sensor's resolution, intensity, without dark level and fixed pattern."""
        return np.maximum((picture - self.dark / np.float32(white_rate)) / self.gain, 0).astype(np.float32)


def _kinds(bad: Integer[np.ndarray, "h w"] | np.ndarray) -> BadPixels:
    kind: UInt8[np.ndarray, "h w"] = bad.astype(np.uint8)
    return BadPixels(kind)
