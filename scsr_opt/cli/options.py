"""Options that several commands share.

`scsr_opt.camera` is imported when a recording is opened; its types stand in quotes, by their full names.
"""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Group, Parameter, Token

from scsr_opt._files import check_writable, is_url
from scsr_opt.errors import InputError
from scsr_opt.progress import NoProgress, Progress
from scsr_opt.report.progress import LineProgress, RichProgress

if TYPE_CHECKING:
    import scsr_opt.calibration.maps
    import scsr_opt.camera
    import scsr_opt.camera.stream
    import scsr_opt.camera.white


def _whole(_: Any, tokens: Sequence[Token]) -> int:
    # The parser's own int rounds 2.5 to 2.
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f'"{tokens[0].value}" is not a whole number.') from None


Whole = Annotated[int, Parameter(converter=_whole)]
"""An int on the command line."""

FILE_GROUP = Group("Reading the recording", sort_key=2)


def _path_or_url(_: Any, tokens: Sequence[Token]) -> Path | str:
    # A Path would make one slash of two.
    return tokens[0].value if is_url(tokens[0].value) else Path(tokens[0].value)


PathOrUrl = Annotated[Path | str, Parameter(converter=_path_or_url)]
"""A recording on the command line: a str if it is a URL."""

File = Annotated[
    PathOrUrl,
    Parameter(
        help="The recording: .dat (flat, packed), .npz, .npy, .h5 or .hdf5; or its URL, such as s3://bucket/car.dat, "
        "which is copied to a temporary file.",
        allow_leading_hyphen=False,
    ),
]
Quiet = Annotated[
    bool, Parameter(name=["--quiet", "-q"], negative="", show_default=False, help="Print nothing but errors.")
]

Rate = Annotated[
    float | None,
    Parameter(help="Pictures per second of a film. Default: 25, or fewer, so that the film lasts 2 seconds at least."),
]

ShownWhite = Annotated[
    float | None,
    Parameter(
        help="Intensity that 8-bit .png, figures and films show as white; 1 is the light of a pixel that fires at the "
        "white rate. Default: a value near the brightest light of the recording. Other files hold intensity as it is."
    ),
]

Overwrite = Annotated[
    bool,
    Parameter(
        negative="",
        show_default=False,
        help="Replace files that exist already; without this option the command refuses to.",
    ),
]


@Parameter(name="*", group=FILE_GROUP)
@dataclass(frozen=True, kw_only=True)
class Reading:
    """How a recording is to be read."""

    size: Annotated[
        str | None,
        Parameter(
            help="WIDTHxHEIGHT of the sensor in pixels, such as 400x250. Needed for a .dat file whose name or "
            "config.yaml does not state it, and for an array whose time axis cannot be told from its content."
        ),
    ] = None
    flip: Annotated[
        bool | None,
        Parameter(
            help="Whether the file stores the rows bottom-up. Default: yes for .dat (as cameras do), no for others."
        ),
    ] = None
    row_bits: Annotated[
        Whole | None,
        Parameter(
            help="Bits per row of a .dat file whose rows are padded, such as 416 for 400 columns. Default: found from "
            "the file's length and content."
        ),
    ] = None
    array: Annotated[
        str | None, Parameter(help="Name of the array that holds the spikes in an .npz or HDF5 file, if it is unusual.")
    ] = None
    white_rate: Annotated[
        float | None,
        Parameter(help="Spikes per frame of a white pixel (intensity 1). Default: the file's, else 0.6."),
    ] = None
    readout_rate: Annotated[float | None, Parameter(help="Frames per second, Hz. Default: the file's, else 40000.")] = (
        None
    )
    bad_pixels: Annotated[
        Path | None,
        Parameter(
            help="A .npy file with a (height, width) mask of the whole sensor, upright; pixels marked 1 are not used, "
            "and no others are searched for. Default: those that the recording's file marks or its spikes show."
        ),
    ] = None
    calibration: Annotated[
        Path | None,
        Parameter(
            help="An .npz file of scsr calibrate, of the whole sensor: its bad pixels are not used, measurements are "
            "divided by its gains, and its dark levels are subtracted. info, baseline and compare use its bad "
            "pixels only."
        ),
    ] = None
    crop: Annotated[
        str | None,
        Parameter(
            allow_leading_hyphen=True,
            help="TOP,LEFT,HEIGHT,WIDTH of the part of the sensor to use, in sensor pixels, such as 0,100,120,200; the "
            "rest is ignored. Default: the whole sensor.",
        ),
    ] = None

    def open(self, file: Path | str) -> "scsr_opt.camera.Recording":
        """Opens `file`, and crops it. **Raises:** `InputError` if it cannot be read in this way."""
        recording, crop = self.whole(file)
        return recording if crop is None else recording.crop(*crop)

    def whole(self, file: Path | str) -> "tuple[scsr_opt.camera.Recording, tuple[int, int, int, int] | None]":
        """Opens `file` as it is; with the crop, (top, left, height, width). **Raises:** as `open`."""
        from scsr_opt.camera import read_recording

        return self._corrected(read_recording(file, key=self.array, **self._layout()))

    def stream(self, descriptor: int) -> "tuple[scsr_opt.camera.stream.FrameStream, tuple[int, int, int, int] | None]":
        """Opens a stream; with the crop. **Raises:** `InputError` if it cannot be read in this way."""
        from scsr_opt.camera.stream import open_stream

        if self.array is not None:
            raise InputError(f"--array {self.array} is the name of an array in a file, but a stream has none.")
        if self.size is None:
            raise InputError("A stream does not hold the size of its frames: give --size WIDTHxHEIGHT.")
        stream = open_stream(descriptor, **self._layout())
        stream.recording, crop = self._corrected(stream.recording)
        return stream, crop

    def _layout(self) -> dict[str, Any]:
        """Arguments of `read_recording` that hold for any kind of recording."""
        names = ("size", "flip", "row_bits", "white_rate", "readout_rate", "bad_pixels")
        return {name: getattr(self, name) for name in names}

    def _corrected(
        self, recording: "scsr_opt.camera.Recording"
    ) -> "tuple[scsr_opt.camera.Recording, tuple[int, int, int, int] | None]":
        """The recording with the calibration applied, and the crop."""
        crop = None if self.crop is None else _rectangle(self.crop)
        if crop is not None:
            recording.crop(*crop)
        maps = self.maps()
        return recording if maps is None else maps.applied(recording), crop

    def maps(self) -> "scsr_opt.calibration.maps.Calibration | None":
        """The calibration, if one was given. **Raises:** `InputError` if it cannot be read."""
        if self.calibration is None:
            return None
        from scsr_opt.calibration.maps import Calibration

        return Calibration.load(self.calibration)

    def corrections(self) -> dict[str, Any]:
        """Arguments of `reconstruct` that the calibration gives, and those that bad pixels given as a mask do."""
        maps = self.maps()
        found = {} if self.bad_pixels is None else {"bad_pixels": None}
        return found if maps is None else {**found, "gain": maps.gain, "dark": maps.dark}


def _rectangle(text: str) -> tuple[int, int, int, int]:
    try:
        top, left, height, width = (int(number) for number in text.split(","))
    except ValueError:
        raise InputError(
            f"--crop is {text}, but it must be TOP,LEFT,HEIGHT,WIDTH, four whole numbers of sensor pixels, such as "
            f"0,100,120,200."
        ) from None
    return top, left, height, width


def white_of_picture(path: Path, bits: int | None, white: float | None, *, also_for: Path | None = None) -> None:
    """**Raises:** `InputError` if `white` is no intensity, or neither the picture `path` nor `also_for` (None if there
    is no other file) would show it."""
    from scsr_opt.camera.white import White
    from scsr_opt.report.pictures import PictureFormat

    if white is not None and White.given(white) and also_for is None and PictureFormat.of(path, bits=bits).absolute:
        raise InputError(
            f"--white is for 8-bit pictures, figures and films, but {path} holds intensity as it is, 1 = white: leave "
            f"it out, or write an 8-bit .png."
        )


def shown_white(
    recording: "scsr_opt.camera.Recording", white: float | None, first: int, last: int, frames: int | None = None
) -> "scsr_opt.camera.white.White":
    """White of pictures and films from key frame `first` to `last`: `white` if it is given, or as found in the frames
    around them, `frames` or the usual number."""
    from scsr_opt.camera.recording import USUAL_FRAMES
    from scsr_opt.camera.white import White, find_white_around

    if white is not None:
        return White.given(white)
    return find_white_around(recording, first, last, USUAL_FRAMES if frames is None else frames)


def key_frame(recording: "scsr_opt.camera.Recording", key: int | None) -> int:
    """The key frame: `key`, or the middle one if None. **Raises:** `InputError` if the recording has no such frame."""
    recording.around(key, 1)
    return recording.frames // 2 if key is None else key


def moments(
    recording: "scsr_opt.camera.Recording",
    start: int,
    stop: int | None,
    step: int | None,
    *,
    about: int,
    option: str = "step",
) -> range:
    """The frames that a film or a sequence shows, from `start` to before `stop`, `about` this number where no step is
    given. `option`: name of the option of the step.

    **Raises:** `InputError` for frames that the recording has not, or a step below 1.
    """
    last = recording.frames if stop is None else stop
    if stop is not None and 0 <= stop <= start:
        raise InputError(f"--start is {start} and --stop is {stop}, but frames go from --start to before --stop.")
    if not 0 <= start < last <= recording.frames:
        raise InputError(
            f"Frames {start} to {last} (excluded) are not in the recording, which has {recording.frames} frames: "
            f"choose 0 <= --start < --stop <= {recording.frames}."
        )
    if step is not None and step < 1:
        raise InputError(f"--{option} is {step}, but pictures are at least 1 frame apart.")
    return range(start, last, max(1, (last - start) // about) if step is None else step)


def progress(quiet: bool) -> Progress:
    """Bars on standard error in a terminal, a line every half a minute elsewhere."""
    if quiet:
        return NoProgress()
    return RichProgress() if sys.stderr.isatty() else LineProgress()


def check_outputs(inputs: Sequence[Path | str], overwrite: bool, /, **outputs: Path | None) -> None:
    """Finds out before the work starts whether every output can be written.

    **Arguments:**
    - `inputs`: files that are read, which no output may replace, or URLs.
    - `overwrite`: whether outputs may replace other files.
    - `outputs`: option (`output`, `report`, …) → path, None where it was not given.

    **Raises:** `InputError` if one cannot be written, would replace an input or, without `overwrite`, another file, or
    two are the same file.
    """
    read = {os.path.realpath(source) for source in inputs if isinstance(source, Path) and source.is_file()}
    seen: dict[str, str] = {}
    for name, path in outputs.items():
        if path is None:
            continue
        option = name.replace("_", "-")
        check_writable(path)
        real = os.path.realpath(path)
        if real in read:
            raise InputError(f"--{option} {path} is the file that is read: give the output another name.")
        if real in seen:
            raise InputError(f"--{option} and --{seen[real]} are both {path}: give them different names.")
        seen[real] = option
        check_new(option, path, overwrite)


def check_new(option: str, path: Path, overwrite: bool) -> None:
    """**Raises:** `InputError` if there is a file `path` already, unless it may be overwritten."""
    if path.exists() and not overwrite:
        raise InputError(f"--{option} {path} is there already: give --overwrite to replace it, or another name.")


def say_error(sentence: str) -> None:
    """One line on standard error, as every error of `scsr` is said."""
    print("scsr: error:", " ".join(sentence.split()), file=sys.stderr, flush=True)


def say_failure(what: str, why: str) -> None:
    """One line on standard error: `what` did not come about, and `why`, the message of a `Status`."""
    say_error(f"{what}: {why[:1].lower()}{why[1:]}")
