"""Examples to train on, made while training goes on: pictures that move past a simulated camera.

An example is a patch of a recording around its key frame, with the true high-resolution picture of that moment
(paper, Training Details: 40×40 sensor pixels, turned by 90° and flipped at random). Pictures, motion, light and noise
are drawn anew for every example, so no example is seen twice and nothing lies on the disk.

Example number i of seed s depends on s and i alone, never on the worker that makes it or on what was made before. A run
that starts again at step n therefore takes example n·batch next and sees exactly what it would have seen.

This module does not import JAX: every process that makes examples (`learned.training.data_loader`) imports it.
"""

import functools
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8
from scipy.linalg import expm

from learned.training.drawings import drawing
from scsr_opt.camera.pictures import Picture, as_intensity
from scsr_opt.camera.scenes import Ellipse, MovingObject, Scene, Static, SteadyMotion, TurningDisc
from scsr_opt.camera.simulator import Sensor, simulate
from scsr_opt.camera.video import Video
from scsr_opt.errors import InputError

SCENES = ("static", "translation", "affine", "object", "disc", "video")
"""Kinds of scenes, by the names that `scsr simulate` has for them."""
LIGHTS = ("day", "dim", "pattern")
"""Kinds of light; `pattern` is day with a fixed pattern of the pixels' gain."""
TRAINING_SAMPLES = (
    "astronaut", "brick", "cell", "coffee", "coins", "grass", "gravel", "hubble_deep_field", "immunohistochemistry",
    "moon", "page", "retina", "rocket", "stereo_motorcycle", "text",
)  # fmt: skip
"""Pictures of `skimage.data` that come with scikit-image, without a download: those to train on."""
HELD_OUT_SAMPLES = ("camera", "chelsea")
"""Those that are kept for validation."""

Cut = Callable[[np.random.Generator, int], Float[np.ndarray, "side side"]]
"""A square picture of this many pixels a side, drawn by chance."""

_ENDINGS = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm"}


class Example(NamedTuple):
    """A recording with its answer; or, with one more axis in front, a batch of them.

    **Fields:**
    - `spikes`: (T, h, w) uint8, 0 and 1; the key frame is T // 2.
    - `truth`: (s·h, s·w) float32, the picture of the key frame, intensity 1 = white.
    - `white_rate`: float32, spikes per frame of intensity 1.
    - `velocity`: (2, h, w) float32, of what each sensor pixel sees in the key frame, down and right, sensor pixels per
      frame; NaN where the scene's motion is not known (`video`).
    """

    spikes: Any
    truth: Any
    white_rate: Any
    velocity: Any


@dataclass(frozen=True)
class Pictures:
    """Pictures that scenes are made of.

    **Fields:**
    - `stills`: picture files, or `sample:NAME` for one of `skimage.data`.
    - `clips`: videos, each a tuple of picture files in the order of time.
    """

    stills: tuple[str, ...]
    clips: tuple[tuple[str, ...], ...] = ()

    @classmethod
    def samples(cls, names: tuple[str, ...] = TRAINING_SAMPLES) -> "Pictures":
        """Pictures that come with scikit-image."""
        return cls(tuple(f"sample:{name}" for name in names))

    @classmethod
    def folder(cls, folder: str | os.PathLike[str]) -> "Pictures":
        """Pictures in `folder` are stills; folders in it that hold at least three pictures are clips (as in REDS).

        A folder of clips alone will do: then their frames are the stills as well.

        **Raises:** `InputError` if there is no such folder, or no picture in it.
        """
        top = Path(folder)
        if not top.is_dir():
            raise InputError(f"{top} is not a folder: name one that holds pictures ({', '.join(sorted(_ENDINGS))}).")
        stills = _files(top)
        clips = tuple(files for path in sorted(top.iterdir()) if path.is_dir() and len(files := _files(path)) >= 3)
        stills = stills or tuple(name for clip in clips for name in clip)
        if not stills:
            raise InputError(
                f"{top} holds no pictures ({', '.join(sorted(_ENDINGS))}), and no folder in it holds three: name a "
                f"folder with pictures, or leave it out to train on those that come with scikit-image."
            )
        return cls(stills, clips)


@dataclass(frozen=True)
class Examples:
    """An endless list of examples, `examples[i]`.

    **Fields:**
    - `scale`: s, HR pixels per sensor pixel along each axis.
    - `frames`: T, spike frames; the key frame is T // 2.
    - `patch`: h = w, sensor pixels.
    - `seed`: the same one gives the same examples.
    - `scenes`, `lights`: kinds to draw from (`SCENES`, `LIGHTS`); one that is named twice comes twice as often.
    - `pictures`: what to look at.
    - `readouts`: spike frames from one frame of a video to the next.
    - `drawings`: every n-th example looks at drawings (`learned.training.drawings`) in the place of stills; 0: none.
    - `defects`: every n-th example is of a sensor with pixels that never fire or always do, singly and in rows or
      columns; 0: none.
    - `varied`: draw light, photons and turns from ranges. If not, every light is that of its name with one set of
      numbers, and nothing is turned or flipped: for validation.

    Motions, per spike frame: 0.05 to 0.3 sensor pixels; turning by up to 0.0015 rad and growing by up to 0.001 in
    `affine`; 0.0034 to 0.0085 rad in `disc` (2600 rpm at 40 kHz are 0.0068). A `video` is a clip if there are any, else
    a still under a moving, shaking camera; frames are cross-faded over `readouts`.
    """

    scale: int
    frames: int = 41
    patch: int = 40
    seed: int = 0
    scenes: tuple[str, ...] = SCENES
    lights: tuple[str, ...] = LIGHTS
    pictures: Pictures = Pictures.samples()  # noqa: RUF009 (frozen)
    varied: bool = True
    readouts: int = 16
    drawings: int = 0
    defects: int = 0

    def __getitem__(self, number: int) -> Example:
        """Example `number`, from 0.

        **Raises:** `InputError` if a picture that it is made of cannot be read.
        """
        rng = np.random.default_rng([self.seed, number])
        drawn = self.drawings and number % self.drawings == self.drawings - 1
        scene = self._scene(self.scenes[rng.integers(len(self.scenes))], rng, drawing if drawn else self._cut)
        sensor = _sensor(self.lights[rng.integers(len(self.lights))], rng if self.varied else None)
        recorded = simulate(scene, scale=self.scale, frames=self.frames, sensor=sensor, seed=int(rng.integers(2**32)))
        spikes = recorded.spikes
        if self.defects and number % self.defects == self.defects // 2:
            spikes = _with_defects(spikes, rng)
        truth = recorded.truth(float(self.frames // 2)).astype(np.float32)
        velocity = _seen_velocity(scene, self.scale, self.patch)
        if self.varied:
            turns, flipped = int(rng.integers(4)), bool(rng.integers(2))
            spikes, truth = turned(spikes, turns, flipped), turned(truth, turns, flipped)
            velocity = turned_field(velocity, turns, flipped)
        return Example(spikes, truth, np.float32(recorded.white_rate), velocity)

    def _scene(self, kind: str, rng: np.random.Generator, cut: Cut) -> Scene:
        side, key = self.patch * self.scale, float(self.frames // 2)
        angle, speed = rng.uniform(0, 2 * np.pi), rng.uniform(0.05, 0.3) * self.scale
        drift = (speed * math.sin(angle), speed * math.cos(angle))
        radius = side * rng.uniform(0.2, 0.3)
        place = tuple((side - 1) / 2 + rng.uniform(-0.12, 0.12, 2) * side)
        turn = math.copysign(rng.uniform(0.0034, 0.0085), rng.uniform(-1, 1))
        match kind:
            case "static":
                return Static(cut(rng, side), key=key)
            case "translation":
                return self._moving(rng, cut, SteadyMotion(drift))
            case "affine":
                spin, zoom = rng.uniform(-0.0015, 0.0015), rng.uniform(-0.001, 0.001)
                gradient = np.array([[zoom, spin], [-spin, zoom]])
                return self._moving(rng, cut, SteadyMotion((0.2 * drift[0], 0.2 * drift[1]), gradient))
            case "object":
                behind, front = cut(rng, side), cut(rng, math.ceil(2.6 * radius) + 4)
                shape = Ellipse(radius, 1.3 * radius)
                return MovingObject(behind, front, drift, shape=shape, position=place, key=key)
            case "disc":
                behind, front = cut(rng, side), cut(rng, math.ceil(2.6 * radius) + 4)
                return TurningDisc(behind, front, turn, radius=1.3 * radius, centre=place, key=key)
            case "video":
                return self._video(rng, cut)
        raise InputError(f"There is no kind of scene {kind!r}: choose from {', '.join(SCENES)}.")

    def _cut(self, rng: np.random.Generator, side: int) -> Float[np.ndarray, "side side"]:
        """A square out of one of the stills, sometimes at half its size; mirrored where the still is too small."""
        picture = _grey(self.pictures.stills[rng.integers(len(self.pictures.stills))])
        # Photographs are soft at the size at which they are stored; halved they are as sharp as a scene.
        if rng.integers(2) and min(picture.shape) >= 2 * side:
            picture = _halved(picture)
        short = [max(0, side - n) for n in picture.shape]
        picture = np.pad(picture, [(n // 2, n - n // 2) for n in short], mode="symmetric") if any(short) else picture
        top, left = (int(rng.integers(n - side + 1)) for n in picture.shape)
        return picture[top : top + side, left : left + side]

    def _moving(self, rng: np.random.Generator, cut: Cut, motion: SteadyMotion) -> Scene:
        """A still that is larger than what the sensor sees of it, so that its edges stay out of sight."""
        side, half = self.patch * self.scale, self.frames // 2 + 1
        growth = 0.0 if motion.gradient is None else float(np.linalg.norm(motion.gradient))
        margin = math.ceil(half * (math.hypot(*motion.drift) + growth * side)) + 2
        return _Window(Picture(cut(rng, side + 2 * margin)), motion, side, margin, float(self.frames // 2))

    def _video(self, rng: np.random.Generator, cut: Cut) -> Scene:
        key = self.frames // 2
        before, after = math.ceil(key / self.readouts), math.ceil((self.frames - 1 - key) / self.readouts)
        if not self.pictures.clips:
            # About one HR pixel from frame to frame: what cross-fades more than that is seen twice.
            drift, shake = rng.uniform(-1, 1, 2), rng.uniform(-0.4, 0.4, (before + after + 1, 2))
            path = np.arange(-before, after + 1)[:, None] * drift + shake
            side, margin = self.patch * self.scale, math.ceil(np.abs(path).max()) + 2
            still, inner = Picture(cut(rng, side + 2 * margin)), np.arange(side) + float(margin)
            frames = [still.grid(inner - down, inner - right) for down, right in path]
            video = Video(frames, readouts_per_frame=self.readouts)
            return _Later(video, float(before * self.readouts - key), float(key))
        clip = self.pictures.clips[rng.integers(len(self.pictures.clips))]
        spacing = self.readouts
        if len(clip) < before + after + 1:  # too short a clip is stretched in time
            before, after = len(clip) // 2, len(clip) - 1 - len(clip) // 2
            spacing = math.ceil(max(key / before, (self.frames - 1 - key) / after))
        first = int(rng.integers(len(clip) - before - after))
        corner = rng.random(2)
        frames = [
            _patch(_clip_frame(name), corner, self.patch * self.scale, name)
            for name in clip[first:][: before + after + 1]
        ]
        return _Later(Video(frames, readouts_per_frame=spacing), float(before * spacing - key), float(key))


class _Window(Scene):
    """A part of a larger still under a steady motion about that part's middle; only this part is rendered."""

    def __init__(self, still: Picture, motion: SteadyMotion, side: int, margin: int, key: float):
        self._still, self._motion, self._margin = still, motion, margin
        self.size, self.key = (side, side), key

    def frame(self, t: float | int) -> Float[np.ndarray, "H W"]:
        elapsed, motion, side = t - self.key, self._motion, self.size[0]
        place = np.arange(side, dtype=float)
        if motion.gradient is None:
            rows, columns = (place + self._margin - d * elapsed for d in motion.drift)
            return self._still.grid(rows, columns)
        generator = np.zeros((3, 3))
        generator[:2, :2], generator[:2, 2] = motion.gradient, motion.drift
        back, middle = expm(-elapsed * generator), (side - 1) / 2
        r, c = place[:, None] - middle, place[None, :] - middle
        rows, columns = (back[i, 0] * r + back[i, 1] * c + (back[i, 2] + middle + self._margin) for i in range(2))
        return self._still.at(rows, columns)

    def velocity(self, t: float | int) -> Float[np.ndarray, "2 H W"]:
        place = np.arange(self.size[0], dtype=float) - (self.size[0] - 1) / 2
        return self._motion.velocity(place[:, None], place[None, :])


class _Later(Scene):
    """A video of which the first `start` readouts were not recorded."""

    def __init__(self, video: Video, start: float, key: float):
        self._video, self._start = video, start
        self.size, self.key = video.size, key
        self.span = (video.span[0] - start, video.span[1] - start)

    def frame(self, t: float | int) -> Float[np.ndarray, "H W"]:
        return self._video.frame(t + self._start)

    def velocity(self, t: float | int) -> Float[np.ndarray, "2 H W"]:
        return self._video.velocity(t)


def _with_defects(spikes: UInt8[np.ndarray, "T h w"], rng: np.random.Generator) -> UInt8[np.ndarray, "T h w"]:
    """The spikes of a sensor with faulty pixels: 0.1 to 3 % of them, and sometimes some rows or columns."""
    faulty = rng.random(spikes.shape[1:]) < np.exp(rng.uniform(np.log(0.001), np.log(0.03)))
    if rng.random() < 0.4:
        lines = rng.choice(spikes.shape[1], int(rng.integers(1, 4)), replace=False)
        (faulty if rng.integers(2) else faulty.T)[lines] = True
    return np.where(faulty, rng.random(faulty.shape) < 0.3, spikes).astype(np.uint8)


def _sensor(light: str, rng: np.random.Generator | None) -> Sensor:
    """The camera in a light of this name; with `rng`, its numbers are drawn from around those."""
    if light not in LIGHTS:
        raise InputError(f"There is no light {light!r}: choose from {', '.join(LIGHTS)}.")
    white_rate, photons = (0.1, 25.0) if light == "dim" else (0.6, 1000.0)
    pattern = 0.05 if light == "pattern" else 0.0
    if rng is None:
        return Sensor(white_rate, photons, fixed_pattern=pattern)
    # Factors are drawn evenly on a logarithmic scale: half as bright is as likely as twice as bright.
    white_rate *= 2 ** rng.uniform(-0.5, 0.5)
    photons *= 4 ** rng.uniform(-0.5, 0.5)
    return Sensor(white_rate, photons, fixed_pattern=pattern * rng.uniform(0.5, 1.5))


@functools.lru_cache(maxsize=16)  # a handful of photographs of 10 MB each, in every worker
def _grey(name: str) -> Float[np.ndarray, "H W"]:
    """A still as intensity, float32."""
    if not name.startswith("sample:"):
        from scsr_opt.report.pictures import load_pixels

        return as_intensity(load_pixels(name), name).astype(np.float32)
    from skimage import data

    found = getattr(data, name.removeprefix("sample:"))()
    return as_intensity(found[0] if isinstance(found, tuple) else found, name).astype(np.float32)


def _clip_frame(name: str) -> Float[np.ndarray, "H W"]:
    """A frame of a clip; large ones are halved, so that neighbouring frames differ by about a pixel."""
    frame = _grey(name)
    return _halved(frame) if frame.shape[1] > 600 else frame


def _patch(frame: Float[np.ndarray, "H W"], corner: Any, side: int, name: str) -> Float[np.ndarray, "side side"]:
    if min(frame.shape) < side:
        raise InputError(
            f"{name} has {frame.shape[0]} rows and {frame.shape[1]} columns (halved, if it had over 600), but a patch "
            f"takes {side} of each: use larger clips, or a smaller patch or scale."
        )
    top, left = (int(share * (n - side + 1)) for share, n in zip(corner, frame.shape, strict=True))
    return frame[top : top + side, left : left + side]


def _halved(picture: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "h w"]:
    h, w = (n // 2 for n in picture.shape)
    return picture[: 2 * h, : 2 * w].reshape(h, 2, w, 2).mean((1, 3))


def turned(array: Any, turns: int, flipped: bool) -> Any:
    """The last two axes turned by 90° `turns` times, then flipped left to right."""
    found = np.rot90(array, turns, axes=(-2, -1))
    return np.ascontiguousarray(found[..., ::-1] if flipped else found)


def turned_field(field: Float[np.ndarray, "2 h w"], turns: int, flipped: bool) -> Float[np.ndarray, "2 h w"]:
    """A field of directions, down and right, in a picture that is turned like this: its arrows turn with it."""
    down, right = turned(field, turns, flipped)
    for _ in range(turns % 4):  # a quarter turn against the clock: what went right goes up, what went down goes right
        down, right = -right, down
    return np.stack([down, -right if flipped else right])


def _seen_velocity(scene: Scene, scale: int, patch: int) -> Float[np.ndarray, "2 h w"]:
    """Velocity in the key frame in the mean over each sensor pixel, sensor pixels per frame; NaN if it is not known."""
    try:
        velocity = scene.velocity(scene.key)
    except InputError:
        return np.full((2, patch, patch), np.nan, np.float32)
    means = velocity.reshape(2, patch, scale, patch, scale).mean((2, 4))
    return (means / scale).astype(np.float32)


def _files(folder: Path) -> tuple[str, ...]:
    return tuple(sorted(str(path) for path in folder.iterdir() if path.suffix.lower() in _ENDINGS and path.is_file()))
