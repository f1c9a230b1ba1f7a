"""A scene from video: frames taken far apart in spike time, with the moments between them made up.

Video has perhaps a hundred frames per second, a spike camera 40,000 readouts: between two frames lie
`readouts_per_frame` readouts whose pictures nobody took. Two ways to fill them, both exact at the frames themselves:

- **Cross-fade** (default): the one frame fades into the next. Where something moves by more than about a pixel from
  frame to frame it is seen twice, faintly, in both places, instead of once in between. Good for finely sampled video
  only.
- **Motion-compensated**: both frames are moved along an optical flow towards the moment, then faded. Motion stays
  motion, but what the flow gets wrong (occlusions, small fast things) is torn.

Neither knows the true motion, so such a scene refuses to give a velocity.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.ndimage import map_coordinates
from skimage.io import imread
from skimage.registration import optical_flow_tvl1

from scsr_opt.camera.pictures import as_intensity
from scsr_opt.camera.scenes import Scene
from scsr_opt.errors import InputError, shown

_ENDINGS = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm"}


class Video(Scene):
    """Frames of a video, interpolated to the readout rate.

    Frame n is seen at time n · `readouts_per_frame`; the scene is known from the first frame to the last, not beyond.

    **Arguments:**
    - `frames`: a folder with one picture per frame, in the order of their names (numbers in names count as numbers),
      read as they are needed; or an array (N, H, W) or (N, H, W, 3), or a sequence of pictures; see `as_intensity`.
    - `readouts_per_frame`: spike frames from one video frame to the next, at least 1; need not be whole.
    - `motion_compensated`: move the frames towards the moment along an optical flow (TV-L1, about a second per pair of
      frames), instead of only fading.
    - `key`: spike frames; the middle of the video if None.

    **Raises:** `InputError` if the folder or its pictures cannot be used, there are fewer than two frames, they differ
    in size, or `readouts_per_frame` is below 1.
    """

    def __init__(
        self,
        frames: Any,
        *,
        readouts_per_frame: float | int,
        motion_compensated: bool = False,
        key: float | int | None = None,
    ):
        try:
            self._spacing = float(readouts_per_frame)
        except (TypeError, ValueError, OverflowError):
            self._spacing = np.nan
        if not 1 <= self._spacing < np.inf:
            raise InputError(
                f"readouts_per_frame is {shown(readouts_per_frame)}, but it must be a number of at least 1: how many "
                f"spike frames are read out from one video frame to the next."
            )
        self._source: Sequence[Any] = _files(Path(frames)) if isinstance(frames, str | Path) else frames
        if len(self._source) < 2:
            raise InputError(
                f"The video has {len(self._source)} frame(s), but there must be two to go from one to the other."
            )
        self._motion_compensated = motion_compensated
        self._read: dict[int, Float[np.ndarray, "H W"]] = {}
        self._flows: tuple[int, Float[np.ndarray, "2 H W"], Float[np.ndarray, "2 H W"]] | None = None
        self.size = self._load(0).shape
        self.span = (0.0, (len(self._source) - 1) * self._spacing)
        self.key = self.span[1] / 2 if key is None else self._inside(key)

    def frame(self, t: float | int) -> Float[np.ndarray, "H W"]:
        """The picture at time `t`, intensity 0..1.

        **Raises:** `InputError` if `t` lies outside the video.
        """
        place = self._inside(t) / self._spacing
        before = int(place + 1e-9)  # rounding must not cost exactness at the frames
        share = place - before
        if share < 1e-9:
            return self._load(before)
        first, second = self._load(before), self._load(before + 1)
        if not self._motion_compensated:
            return (1 - share) * first + share * second
        onward, backward = self._flow(before)
        flow = (1 - share) * onward - share * backward
        grid = np.indices(self.size).astype(float)
        early = map_coordinates(first, grid - share * flow, order=1, mode="nearest")
        late = map_coordinates(second, grid + (1 - share) * flow, order=1, mode="nearest")
        return (1 - share) * early + share * late

    def velocity(self, t: float | int) -> Float[np.ndarray, "2 H W"]:
        """Always refused: nobody measured how the things in the video moved.

        **Raises:** `InputError`.
        """
        raise InputError(
            "The true velocity of a video is not known: estimate it from the spikes, or simulate a picture that moves "
            "(Translation, Affine, MovingObject, TurningDisc), where it is known."
        )

    def _inside(self, t: Any) -> float:
        first, last = self.span
        if not first - 1e-9 <= t <= last + 1e-9:
            raise InputError(
                f"Time {t:g} is outside the video: its {len(self._source)} frames, {self._spacing:g} readouts apart, "
                f"last from spike frame {first:g} to {last:g}; ask for fewer spike frames, or for more "
                f"readouts_per_frame."
            )
        return min(max(float(t), first), last)

    def _load(self, n: int) -> Float[np.ndarray, "H W"]:
        if n not in self._read:
            item = self._source[n]
            image = as_intensity(imread(item) if isinstance(item, Path) else item, f"Frame {n} of the video")
            if self._read and image.shape != self.size:
                raise InputError(
                    f"Frame {n} of the video has {image.shape[0]} rows and {image.shape[1]} columns, but the ones "
                    f"before it have {self.size[0]} and {self.size[1]}: all must be of one size."
                )
            image.flags.writeable = False
            # Two frames are in use at a time; more would fill the memory with a long video.
            self._read = {m: kept for m, kept in self._read.items() if abs(m - n) <= 1} | {n: image}
        return self._read[n]

    def _flow(self, n: int) -> tuple[Float[np.ndarray, "2 H W"], Float[np.ndarray, "2 H W"]]:
        """Displacement from frame n to n + 1, and back, in pixels."""
        if self._flows is None or self._flows[0] != n:
            first, second = self._load(n), self._load(n + 1)
            self._flows = (n, optical_flow_tvl1(first, second), optical_flow_tvl1(second, first))
        return self._flows[1], self._flows[2]


def _files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder: give the folder that holds the video's frames, one picture each.")
    pictures = [path for path in folder.iterdir() if path.suffix.lower() in _ENDINGS]
    if not pictures:
        raise InputError(
            f"{folder} holds no pictures: one per frame is needed, ending in {', '.join(sorted(_ENDINGS))}."
        )
    return sorted(pictures, key=_by_number)


def _by_number(path: Path) -> list[tuple[int, str]]:
    """A key that puts frame 9 before frame 10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name.lower())]
