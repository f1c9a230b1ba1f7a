"""`scsr simulate`: what a spike camera would record of a picture that moves."""

import io
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter

from scsr_opt.cli.options import Overwrite, Quiet, Whole, check_outputs, progress
from scsr_opt.errors import InputError

if TYPE_CHECKING:
    import scsr_opt.camera.scenes
    import scsr_opt.camera.simulator

SAMPLES = ("astronaut", "brick", "camera", "chelsea", "coffee", "coins", "grass", "gravel", "moon", "page", "text")
"""Pictures that come with scikit-image, without a download."""

# Velocity and radius in sensor pixels: no scene has more to show.
_LARGEST = 1e3

Kind = Literal["static", "translation", "affine", "object", "disc", "video"]

# Options that only some scenes have; another scene refuses them rather than ignore them.
_ONLY = {
    "velocity": ("translation", "affine", "object"),
    "rotation": ("affine", "disc"),
    "zoom": ("affine",),
    "shear": ("affine",),
    "radius": ("disc",),
    "readouts": ("video",),
    "follow_motion": ("video",),
}


@Parameter(name="*", group=Group("What moves, and how", sort_key=2))
@dataclass(frozen=True, kw_only=True)
class Motion:
    """The kind of scene and its numbers; None where not given."""

    scene: Annotated[
        Kind,
        Parameter(
            help="static: nothing moves; translation: the picture moves past; affine: it moves, turns and grows; "
            "object: an elliptical object passes before a still background; disc: a disc turns before such "
            "a background; video: the frames of a video, faded into each other."
        ),
    ] = "translation"
    velocity: Annotated[
        tuple[float, float] | None,
        Parameter(negative="", help="DOWN RIGHT in sensor pixels per frame. Default: 0.05 0.11, for affine none."),
    ] = None
    rotation: Annotated[
        float | None, Parameter(help="Radians per frame, clockwise. Default: 0.002, for disc 0.0068.")
    ] = None
    zoom: Annotated[float | None, Parameter(help="Relative growth per frame of an affine scene. Default: 0.")] = None
    shear: Annotated[float | None, Parameter(help="Columns per row and frame. Default: 0.")] = None
    radius: Annotated[
        float | None, Parameter(help="Radius of the disc, sensor pixels. Default: 0.4 of the shorter side.")
    ] = None
    readouts: Annotated[
        float | None, Parameter(help="Spike frames from one frame of a video to the next. Default: 16.")
    ] = None
    follow_motion: Annotated[
        bool | None, Parameter(negative="", help="Move a video's frames along an optical flow, not only fade them.")
    ] = None

    def check(self) -> None:
        """**Raises:** `InputError` if an option was given that this kind of scene does not have, or one whose unit is
        another in Python is not such a number."""
        for name, kinds in _ONLY.items():
            if getattr(self, name) is not None and self.scene not in kinds:
                raise InputError(
                    f"--{name.replace('_', '-')} is for --scene {' or '.join(kinds)}, but the scene is {self.scene}: "
                    f"leave it out."
                )
        if self.velocity is not None and not all(abs(v) <= _LARGEST for v in self.velocity):
            down, right = self.velocity
            raise InputError(
                f"--velocity is {down:g} {right:g}, but it must be two finite numbers, DOWN RIGHT in sensor pixels per "
                f"frame, of {_LARGEST:g} at most either way."
            )
        if self.radius is not None and not 0 < self.radius <= _LARGEST:
            raise InputError(
                f"--radius is {self.radius:g}, but it must be a number of sensor pixels above 0, {_LARGEST:g} at most."
            )
        if self.readouts is not None and not 1 <= self.readouts < math.inf:
            raise InputError(
                f"--readouts is {self.readouts:g}, but it must be a finite number of spike frames, at least 1."
            )

    def build(self, images: tuple[str, ...], scale: int, key: int) -> "scsr_opt.camera.scenes.Scene":
        """The scene of these pictures, which lie as they are given in frame `key`.

        **Raises:** `InputError` if there are too many or too few of them, or one cannot be read.
        """
        from scsr_opt.camera import scenes
        from scsr_opt.camera.video import Video

        if self.scene == "video":
            readouts = 16.0 if self.readouts is None else self.readouts
            frames = images[0] if len(images) == 1 else [load_image(name) for name in images]
            return Video(
                frames, readouts_per_frame=readouts, motion_compensated=bool(self.follow_motion), key=float(key)
            )
        layered = self.scene in ("object", "disc")
        if len(images) != 1 + layered:
            wanted = "two pictures, the background and what moves before it" if layered else "one picture"
            raise InputError(f"The scene {self.scene} is made of {wanted}, but {len(images)} were given.")
        first, *others = (load_image(name) for name in images)
        time, velocity = float(key), self.velocity
        if velocity is None:
            velocity = (0.0, 0.0) if self.scene == "affine" else (0.05, 0.11)
        drift = (velocity[0] * scale, velocity[1] * scale)
        match self.scene:
            case "static":
                return scenes.Static(first, key=time)
            case "translation":
                return scenes.Translation(first, drift, key=time)
            case "affine":
                turn = 0.002 if self.rotation is None else self.rotation
                zoom, shear = self.zoom or 0.0, self.shear or 0.0
                return scenes.Affine(first, rotation=turn, zoom=zoom, shear=shear, drift=drift, key=time)
            case "object":
                return scenes.MovingObject(first, others[0], drift, key=time)
            case "disc":
                turn = 0.0068 if self.rotation is None else self.rotation
                radius = None if self.radius is None else self.radius * scale
                return scenes.TurningDisc(first, others[0], turn, radius=radius, key=time)


@Parameter(name="*", group=Group("The camera", sort_key=3))
@dataclass(frozen=True, kw_only=True)
class Camera:
    """The fields of `scsr_opt.camera.Sensor`."""

    white_rate: Annotated[float, Parameter(help="Spikes per frame of a white pixel; lower is dimmer light.")] = 0.6
    photons: Annotated[float, Parameter(help="Photons per frame of a white pixel: fewer is more shot noise.")] = (
        math.inf
    )
    dark_rate: Annotated[
        float, Parameter(help="Thermal charge per frame, as the intensity of light that would give as much.")
    ] = 0.0
    fixed_pattern: Annotated[
        float, Parameter(help="Standard deviation of the pixels' gain; of real cameras about 0.06.")
    ] = 0.0
    dead: Annotated[float, Parameter(help="Fraction of the pixels that never fire, 0 to 1.")] = 0.0
    hot: Annotated[float, Parameter(help="Fraction of the pixels that always fire, 0 to 1.")] = 0.0
    psf_sigma: Annotated[float, Parameter(help="Standard deviation of the optical blur, in pixels of the picture.")] = (
        0.0
    )

    def sensor(self) -> "scsr_opt.camera.simulator.Sensor":
        """**Raises:** `InputError` if a value is out of range."""
        from scsr_opt.camera.simulator import Sensor

        return Sensor(**asdict(self))


def simulate(
    images: Annotated[
        tuple[str, ...],
        Parameter(
            help="A picture file, or sample:NAME for one that comes with scikit-image, such as sample:coffee. The "
            "scenes object and disc take a second one, for what moves; video takes frames, or one folder of them.",
            negative="",
        ),
    ],
    /,
    *,
    output: Annotated[
        Path, Parameter(name=["--output", "-o"], help="Recording to write: .npz, .dat, .npy, .h5 or .hdf5.")
    ],
    scale: Annotated[Whole, Parameter(help="Pixels of the picture per sensor pixel, along each axis.")] = 4,
    frames: Annotated[Whole, Parameter(help="Spike frames to record.")] = 101,
    key: Annotated[
        Whole | None, Parameter(help="Frame in which the pictures are not displaced. Default: the middle one.")
    ] = None,
    readout_rate: Annotated[float, Parameter(help="Frames per second, Hz; noted in the recording.")] = 40_000.0,
    seed: Annotated[Whole, Parameter(help="Seed of the random numbers; the same seed gives the same recording.")] = 0,
    truth: Annotated[
        Path | None, Parameter(help="Also write the true picture of the key frame here (.png, .tif, .npz).")
    ] = None,
    true_velocity: Annotated[
        Path | None,
        Parameter(
            help="Also write the true velocity at the key frame here: .npy of (2, height, width), down and right, "
            "sensor pixels per frame."
        ),
    ] = None,
    motion: Motion | None = None,
    camera: Camera | None = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> int:
    """Record a moving picture with a simulated spike camera.

    Grey levels of pictures are read as linear intensity, 1 = white. Dead and hot pixels are marked in the recording
    where its format has room for them (.npz, .h5).
    """
    motion, camera = motion or Motion(), camera or Camera()
    _check(images, motion, output, truth, true_velocity)
    sources = [Path(name) for name in images if not name.startswith("sample:")]
    check_outputs(sources, overwrite, output=output, truth=truth, true_velocity=true_velocity)
    if frames < 1:
        raise InputError(f"--frames is {frames}, but at least 1 is needed.")
    if scale < 1:
        raise InputError(f"--scale is {scale}, but a sensor pixel is at least 1 pixel of the picture.")
    middle = frames // 2 if key is None else key
    if not 0 <= middle < frames:
        raise InputError(f"--key is {middle}, but the recording will have frames 0 to {frames - 1}.")

    from scsr_opt.camera.recording import Recording
    from scsr_opt.camera.simulator import simulate as record
    from scsr_opt.camera.writing import write_recording

    simulation = record(
        motion.build(images, scale, middle),
        scale=scale,
        frames=frames,
        sensor=camera.sensor(),
        seed=seed,
        progress=progress(quiet),
    )
    bad = simulation.bad_pixels
    recording = Recording.from_array(
        simulation.spikes,
        readout_rate=readout_rate,
        white_rate=camera.white_rate,
        bad_pixels=bad if bad.any() else None,
        name=output.stem,
    )
    write_recording(output, recording)
    written = [f"{output}: {frames} frames of {recording.width}x{recording.height}, key frame {middle}."]
    if truth is not None:
        from scsr_opt.report.pictures import write_picture

        picture = simulation.truth(float(middle))
        write_picture(truth, picture)
        written.append(f"{truth}: the true picture, {picture.shape[1]}x{picture.shape[0]}.")
    if true_velocity is not None:
        _write_velocity(true_velocity, simulation.velocity(float(middle)))
        written.append(f"{true_velocity}: the true velocity, sensor pixels per frame.")
    if not quiet:
        print("\n".join(written))
    return 0


def load_image(name: str) -> Any:
    """The pixels of a picture file as they are stored, or of `sample:NAME`.

    **Raises:** `InputError` if there is no such picture.
    """
    if name.startswith("sample:"):
        chosen = name.removeprefix("sample:")
        if chosen not in SAMPLES:
            raise InputError(f"There is no sample picture {chosen!r}: choose one of {', '.join(SAMPLES)}.")
        from skimage import data

        return getattr(data, chosen)()
    from scsr_opt.report.pictures import load_pixels

    return load_pixels(name)


def _check(
    images: tuple[str, ...], motion: Motion, output: Path, truth: Path | None, true_velocity: Path | None
) -> None:
    """Raises `InputError` for what is known to fail before anything is simulated."""
    from scsr_opt.camera.writing import ENDINGS
    from scsr_opt.report.pictures import PictureFormat

    motion.check()
    if output.suffix.lower() not in ENDINGS:
        raise InputError(
            f"Cannot tell the format of {output}: its ending is {output.suffix or 'missing'!r}, but recordings end in "
            f"{', '.join(ENDINGS)}."
        )
    if truth is not None:
        PictureFormat.of(truth)
    if true_velocity is not None and true_velocity.suffix.lower() != ".npy":
        raise InputError(f"--true-velocity {true_velocity} must end in .npy.")
    if true_velocity is not None and motion.scene == "video":
        raise InputError("--true-velocity cannot be had for a video, whose motion is not known: leave it out.")


def _write_velocity(path: Path, velocity: Any) -> None:
    import numpy as np

    from scsr_opt._files import whole_file

    encoded = io.BytesIO()  # in a file np.save would add another ending to one in capitals
    np.save(encoded, velocity.astype(np.float32))
    with whole_file(path) as temporary:
        temporary.write_bytes(encoded.getbuffer())
