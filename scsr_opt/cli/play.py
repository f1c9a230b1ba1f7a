"""`scsr play`: a recording made visible without solving anything."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from scsr_opt.cli.options import (
    File,
    Overwrite,
    Quiet,
    Rate,
    Reading,
    ShownWhite,
    Whole,
    check_outputs,
    key_frame,
    moments,
    progress,
    shown_white,
    white_of_picture,
)
from scsr_opt.errors import InputError
from scsr_opt.progress import Progress

if TYPE_CHECKING:
    import scsr_opt.calibration.maps
    import scsr_opt.camera

Method = Literal["tfp", "tfi", "stp"]

# Playback from intervals looks back to the last spikes of a pixel: enough frames for pixels that fire 5 times in 1000.
_CONTEXT = 1001
# Pictures of a film, about, where nothing else is said.
_PICTURES = 100


def play(
    file: File,
    /,
    *,
    output: Annotated[
        Path | None,
        Parameter(
            name=["--output", "-o"],
            help="Picture (.png, .tif, .npz) or film (.gif, .mp4) to write. Default: FILE_METHOD.png in this folder.",
        ),
    ] = None,
    method: Annotated[
        Method,
        Parameter(
            help="tfp: mean over a window of frames; tfi: from the interval between two spikes; "
            "stp: from a model of short-term plasticity."
        ),
    ] = "tfp",
    key: Annotated[
        Whole | None, Parameter(help="Frame to show, from 0. Default: the middle one. Pictures only.")
    ] = None,
    window: Annotated[
        Whole | None, Parameter(help="Frames that tfp averages over. Default: 21, or all of a shorter recording.")
    ] = None,
    start: Annotated[Whole, Parameter(help="First frame of a film.")] = 0,
    stop: Annotated[Whole | None, Parameter(help="Frame before which a film ends. Default: the end.")] = None,
    step: Annotated[
        Whole | None,
        Parameter(help="Frames from one picture of a film to the next. Default: about 100 pictures in all."),
    ] = None,
    rate: Rate = None,
    bits: Annotated[Whole | None, Parameter(help="Bits per pixel of a picture: 8 or 16; 32 (float) for .tif.")] = None,
    gamma: Annotated[
        float, Parameter(help="Store intensity^(1/gamma): 1 is linear; 2.2 is what viewers expect.")
    ] = 1.0,
    white: ShownWhite = None,
    reading: Reading | None = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> int:
    """Show a recording as a picture of one moment, or as a film.

    Films and 8-bit pictures show a value near the brightest light of the recording as white (see --white), and are
    linear unless --gamma is given. Other files hold intensity as it is, 1 = white.
    """
    from scsr_opt.report.pictures import FILM_ENDINGS, PictureFormat, check_film, film_rate, write_film, write_picture

    target = Path(f"{_stem(file)}_{method}.png") if output is None else output
    is_film = target.suffix.lower() in FILM_ENDINGS
    if is_film:
        check_film(target, rate=rate, gamma=gamma, white=1.0 if white is None else white)
        if key is not None or bits is not None:
            raise InputError(f"--key and --bits are for pictures, but {target} is a film: leave them out.")
    else:
        absolute = PictureFormat.of(target, bits=bits, gamma=gamma).absolute
        white_of_picture(target, bits, white)
        if start or stop is not None or step is not None or rate is not None:
            raise InputError(
                f"--start, --stop, --step and --rate are for films, but {target} is a picture: give --key for the "
                f"frame to show, or a name that ends in {' or '.join(FILM_ENDINGS)}."
            )
    if window is not None and method != "tfp":
        raise InputError(f"--window is for --method tfp, but the method is {method}: leave it out.")
    check_outputs([file], overwrite, output=target)
    reading = reading or Reading()
    recording, crop = reading.whole(file)
    maps = reading.maps()
    if crop is not None:
        recording, maps = recording.crop(*crop), None if maps is None else maps.crop(*crop)
    player = _Player(recording, method, window, maps)
    if is_film:
        keys = moments(recording, start, stop, step, about=_PICTURES)
        level = shown_white(recording, white, keys[0], keys[-1])
        count = write_film(
            target,
            player.film(keys, progress(quiet)),
            rate=film_rate(len(keys)) if rate is None else rate,
            gamma=gamma,
            white=level.level,
        )
        made = f"{count} pictures of frames {keys[0]} to {keys[-1]}, every {keys.step}."
    else:
        moment = key_frame(recording, key)
        level = None if absolute else shown_white(recording, white, moment, moment)
        shown = 1.0 if level is None else level.level
        write_picture(target, player.picture(moment), bits=bits, gamma=gamma, white=shown)
        made = f"frame {moment} by {method}."
    if not quiet:
        print(f"{target}: {made}")
        if level is not None:
            print(level.sentence)
    return 0


def _stem(file: Path | str) -> str:
    """Name of the recording without its ending."""
    if isinstance(file, Path):
        return file.stem
    from scsr_opt.camera.remote import file_name

    return file_name(file).stem


class _Player:
    """Playback of a recording at any frame; only the frames around it are read."""

    def __init__(
        self,
        recording: "scsr_opt.camera.Recording",
        method: Method,
        window: int | None,
        maps: "scsr_opt.calibration.maps.Calibration | None" = None,
    ):
        from scsr_opt.camera.playback import WINDOW_FRAMES

        self._recording = recording
        self._method = method
        self._maps = maps
        self._window = min(WINDOW_FRAMES, recording.frames) if window is None else window
        if not 1 <= self._window <= recording.frames:
            raise InputError(
                f"--window is {window}, but it must be from 1 to the {recording.frames} frames of the recording."
            )

    def picture(self, moment: int) -> Any:
        shown = self._as_recorded(moment)
        return shown if self._maps is None else self._maps.corrected(shown, self._recording.white_rate)

    def _as_recorded(self, moment: int) -> Any:
        from scsr_opt import camera

        frames = self._window if self._method == "tfp" else _CONTEXT
        start, stop = self._recording.around(moment, frames)
        spikes, white_rate = self._recording.window(start, stop), self._recording.white_rate
        if self._method == "tfp":
            return camera.tfp(spikes, moment - start, window=self._window, white_rate=white_rate)
        function = camera.tfi if self._method == "tfi" else camera.stp
        return function(spikes, moment - start, white_rate=white_rate)

    def film(self, moments: range, meter: Progress) -> Any:
        meter.start(len(moments), "Playing")
        try:
            for moment in moments:
                yield self.picture(moment)
                meter.advance(1)
        finally:
            meter.finish()
