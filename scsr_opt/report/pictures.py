"""Pictures to files, by ending: PNG, TIFF, NPZ, and the moving ones GIF and MP4.

A picture is linear intensity, 1 = white. By default the numbers go into the file as they are, so that what is read back
can be measured. What is looked at, 8-bit PNG and films, may have another `white` (`scsr_opt.camera.white`). Viewers
take PNG for gamma-encoded and show it darker than the scene was; `gamma` = 2.2 stores it for viewers.
"""

import io
import os
import re
import shutil
import subprocess
import warnings
import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Num, UInt8, UInt16
from numpy.typing import ArrayLike

from scsr_opt._arrays import as_array
from scsr_opt._files import as_path, read_meanwhile, whole_file
from scsr_opt._validation import finite
from scsr_opt.camera.white import White
from scsr_opt.errors import InputError, shown

PICTURE_BITS = {".png": (8, 16), ".tif": (16, 8, 32), ".tiff": (16, 8, 32), ".npz": (32,)}
"""Endings of still pictures with the bits per pixel that each can have, the default first; 32 is floating point."""
FILM_ENDINGS = (".gif", ".mp4")
# Beyond these every level becomes black, or every one white.
_GAMMAS = (0.1, 10)
# Pictures per second; a GIF shows one for 655 seconds at most.
_RATES = (0.01, 1000)
# Pictures per second of a film, at most, and seconds that it lasts, at least, where no rate is given: 25 pictures a
# second look smooth, and the eye needs a moment for a film of a few.
_USUAL_RATE, _LEAST_SECONDS = 25.0, 2.0
# Pixels along a side of a GIF: it has two bytes for them.
_GIF_SIDE = 65535


@dataclass(frozen=True)
class PictureFormat:
    """How a picture is stored.

    **Fields:**
    - `ending`: `.png`, `.tif`, `.tiff` or `.npz`.
    - `bits`: per pixel. 8 and 16 are whole numbers, of which the largest is white; 32 is floating point, not clipped.
    - `gamma`: intensity^(1/gamma) is stored; 1 is linear. Only for whole numbers.
    - `white`: intensity of the largest grey level. Only for 8-bit PNG; others are absolute.
    """

    ending: str
    bits: int
    gamma: float = 1.0
    white: float = 1.0

    @classmethod
    def of(
        cls, path: str | os.PathLike[str], *, bits: int | None = None, gamma: float = 1.0, white: float = 1.0
    ) -> "PictureFormat":
        """The format for `path`, to be asked before the picture is made.

        **Raises:** `InputError` if the ending is not known or cannot have these bits, if gamma is not from 0.1 to 10,
            or if white is no intensity, or not 1 where the format is absolute.
        """
        ending = as_path(path).suffix.lower()
        if ending not in PICTURE_BITS:
            raise InputError(
                f"Cannot tell the format of {path}: its ending is {ending or 'missing'!r}, but pictures end in "
                f"{', '.join(PICTURE_BITS)}."
            )
        allowed = PICTURE_BITS[ending]
        if bits is not None and finite(bits) not in allowed:
            raise InputError(
                f"{shown(bits)} bits per pixel cannot be stored in {ending}: choose "
                f"{' or '.join(map(str, sorted(allowed)))}, or another ending."
            )
        chosen = allowed[0] if bits is None else int(bits)
        _check_gamma(gamma)
        if chosen == 32 and gamma != 1.0:
            raise InputError(f"gamma is {gamma:g}, but 32-bit pictures hold linear intensity: leave it at 1.")
        made = cls(ending, chosen, gamma, White.given(white).level)
        if made.absolute and white != 1:
            raise InputError(
                f"white is {white:g}, but {path} holds intensity as it is, 1 = white; only an 8-bit .png has another."
            )
        return made

    @property
    def absolute(self) -> bool:
        """True where numbers in the file are intensities with 1 = white, for measuring rather than looking at."""
        return not (self.ending == ".png" and self.bits == 8)


def _check_gamma(gamma: float) -> None:
    least, most = _GAMMAS
    if not least <= finite(gamma) <= most:
        raise InputError(
            f"gamma is {shown(gamma)}, but it must be from {least:g} to {most:g}: 1 for linear intensity, 2.2 for "
            f"viewers."
        )


def quantise(
    image: Num[Any, "H W"], *, bits: int = 8, gamma: float = 1.0, white: float = 1.0
) -> UInt8[np.ndarray, "H W"] | UInt16[np.ndarray, "H W"]:
    """Linear intensity as whole numbers: 0 is black, 2^bits − 1 is intensity `white`; what lies outside is
    clipped.

    **Raises:** `InputError` if it is no picture, or a value is not finite.
    """
    return _quantised(_checked(image), bits, gamma, white)


def _quantised(linear: Float[np.ndarray, "H W"], bits: int, gamma: float, white: float) -> np.ndarray:
    stored = np.clip(linear / np.float32(white), 0.0, 1.0) ** (1.0 / gamma) * (2**bits - 1)
    return np.rint(stored).astype(np.uint8 if bits == 8 else np.uint16)


def write_picture(
    path: str | os.PathLike[str],
    image: ArrayLike,
    *,
    bits: int | None = None,
    gamma: float = 1.0,
    white: float = 1.0,
    extras: dict[str, Any] | None = None,
) -> PictureFormat:
    """Writes a picture in the format that the ending of `path` names; a file of that name is replaced, as by
    `numpy.save`, once the new one is whole.

    **Arguments:**
    - `image`: (H, W), linear intensity, 1 = white.
    - `bits`, `gamma`, `white`: see `PictureFormat`; `bits` None takes 8 for PNG, 16 for TIFF, floating point for NPZ.
    - `extras`: more arrays to store beside the picture (`image`) in an NPZ; other formats leave them out.

    **Returns:** the format that was written.

    **Raises:** `InputError` if the format is not possible, `image` is no picture (of other than two dimensions, empty,
    complex, whole numbers beyond 1), a value is not finite, or the file cannot be written.
    """
    chosen = PictureFormat.of(path, bits=bits, gamma=gamma, white=white)
    linear = _checked(image)
    stored = linear if chosen.bits == 32 else _quantised(linear, chosen.bits, gamma, chosen.white)
    # In memory first: on a full disk some libraries say something else than that, or go by the name for the format.
    encoded = io.BytesIO()
    if chosen.ending == ".npz":
        np.savez_compressed(encoded, image=stored, **(extras or {}))
    elif chosen.ending == ".png":
        from PIL import Image

        Image.fromarray(stored).save(encoded, format="PNG")
    else:
        import tifffile

        tifffile.imwrite(encoded, stored, photometric="minisblack")
    with whole_file(path) as temporary:
        temporary.write_bytes(encoded.getbuffer())
    return chosen


def load_pixels(path: str | os.PathLike[str]) -> np.ndarray:
    """The pixels of a picture file as they are stored: (H, W), or (H, W, 3 or 4) in colour; of an NPZ, its `image`.

    **Raises:** `InputError` if there is no such file, or it is not a picture.
    """
    source = as_path(path)
    if not source.is_file():
        raise InputError(f"There is no picture {source}: check the path.")
    if source.suffix.lower() == ".npz":
        try:
            with np.load(source) as stored:
                return stored["image"]
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise InputError(f"{source} does not hold an array `image`, as NPZ pictures do.") from error
    try:
        if source.suffix.lower() in (".tif", ".tiff"):
            import tifffile

            return tifffile.imread(source)
        from PIL import Image

        with Image.open(source) as stored:
            direct = stored.mode in ("L", "RGB", "RGBA", "F") or stored.mode.startswith("I;16")
            # Palettes, bits and the like are ways of storing; what is meant are grey levels or colours.
            return np.asarray(stored if direct else stored.convert("L" if stored.mode in ("1", "LA") else "RGB"))
    except Exception as error:  # each kind of file is damaged in its own way
        raise InputError(f"{source} cannot be read as a picture.") from error


def read_picture(path: str | os.PathLike[str]) -> Float[np.ndarray, "H W"]:
    """A picture file as intensity (H, W) float32, 1 = white.

    Whole numbers are divided by the largest that their type can hold, colours become luma (see `camera.as_intensity`).
    Floating-point values are returned as they are stored.

    **Raises:** `InputError` if there is no such file, or it is not one picture.
    """
    pixels = load_pixels(path)
    if pixels.ndim == 2 and pixels.dtype.kind == "f":
        return pixels.astype(np.float32)
    from scsr_opt.camera.pictures import as_intensity

    return as_intensity(pixels, str(path)).astype(np.float32)


def film_rate(count: int) -> float:
    """Pictures per second of a film of `count` pictures for which no rate is given: 25, and fewer below 50 pictures, so
    that the film lasts 2 seconds."""
    return min(_USUAL_RATE, count / _LEAST_SECONDS)


def stored_rate(path: str | os.PathLike[str], rate: float) -> float:
    """Pictures per second that the film `path` has in the end: a GIF shows each for a whole number of hundredths of a
    second."""
    return 1000.0 / _gif_milliseconds(rate) if as_path(path).suffix.lower() == ".gif" else rate


def _gif_milliseconds(rate: float) -> int:
    return max(round(100.0 / rate), 1) * 10


def check_film(
    path: str | os.PathLike[str], *, rate: float | None = None, gamma: float = 1.0, white: float = 1.0
) -> None:
    """Finds out before the frames are made whether `path` can be written as a film.

    **Raises:** `InputError` if the ending is not known, or it is `.mp4` and there is no encoder; if the rate is not
    from 0.01 to 1000 pictures per second, gamma not from 0.1 to 10, or white no intensity.
    """
    least, most = _RATES
    if rate is not None and not least <= finite(rate) <= most:
        raise InputError(f"rate is {shown(rate)}, but it must be from {least:g} to {most:g} pictures per second.")
    _check_gamma(gamma)
    White.given(white)
    ending = as_path(path).suffix.lower()
    if ending not in FILM_ENDINGS:
        raise InputError(
            f"Cannot tell the format of {path}: its ending is {ending or 'missing'!r}, but films end in "
            f"{' or '.join(FILM_ENDINGS)}."
        )
    if ending == ".mp4":
        _encoder()


def write_film(
    path: str | os.PathLike[str],
    frames: Iterable[ArrayLike],
    *,
    rate: float | None = None,
    gamma: float = 1.0,
    white: float = 1.0,
) -> int:
    """Writes pictures as a film; they are taken one at a time, so a long film needs no more memory than a short one.

    The film has as many pictures as `frames`, equal ones too. A file of that name is replaced, as by
    `numpy.save`, once the new one is whole.

    **Arguments:**
    - `path`: ends in `.gif` or `.mp4`. MP4 needs the program `ffmpeg`, of the machine or of the package
      imageio-ffmpeg, and even sides: an odd one gets a black row or column more, which a warning says.
    - `frames`: pictures (H, W), linear intensity, all of one size.
    - `rate`: pictures per second; that of `film_rate` if None, for which up to 50 pictures are held in memory. A GIF
      counts in hundredths of a second, so it comes out at the nearest such rate, and is repeated without end.
    - `gamma`: as in `PictureFormat`. `white`: intensity of the largest grey level in all of its pictures.

    **Returns:** the number of pictures.

    **Raises:** `InputError` as `check_film`, if there is no frame, one is no picture (as of `write_picture`) or of
    another size than the first, or the file cannot be written. No file is written then.
    """
    check_film(path, rate=rate, gamma=gamma, white=white)
    if not isinstance(frames, Iterable):
        raise InputError(f"frames is {shown(frames)}, but a film is made of several pictures: give a list of them.")
    pictures = _Pictures(read_meanwhile(frames), gamma, white)
    with whole_file(path) as temporary:
        first = next(pictures, None)
        if first is None:
            raise InputError("A film needs at least one picture, but there is none.")
        everything = chain([first], pictures)
        if rate is None:
            begin = list(islice(everything, round(_USUAL_RATE * _LEAST_SECONDS)))  # a longer film has the usual rate
            rate, everything = film_rate(len(begin)), chain(begin, everything)
        if temporary.suffix.lower() == ".gif":
            _write_gif(temporary, everything, rate)
        else:
            tall, wide = (side + side % 2 for side in first.shape)
            if (tall, wide) != first.shape:
                warnings.warn(
                    f"{path}: the film is {wide}x{tall}, for pictures of {first.shape[1]}x{first.shape[0]}: an MP4 has "
                    f"even sides, so it has black pixels more at the right or the bottom; a .gif keeps the size.",
                    stacklevel=2,
                )
            _write_mp4(temporary, everything, first.shape, (tall, wide), rate)
    return pictures.count


class _Pictures:
    """Iterator over the pictures of a film, checked and in 8 bits, that knows how many it has handed out."""

    def __init__(self, frames: Iterator[Any], gamma: float, white: float):
        self._frames, self._gamma, self._white = frames, gamma, white
        self._shape: tuple[int, ...] | None = None
        self.count = 0

    def __iter__(self) -> "_Pictures":
        return self

    def __next__(self) -> np.ndarray:
        linear = _checked(next(self._frames), f"Picture {self.count + 1} of the film")
        if self._shape is None:
            self._shape = linear.shape
        elif linear.shape != self._shape:
            (tall, wide), (first_tall, first_wide) = linear.shape, self._shape
            raise InputError(
                f"Picture {self.count + 1} of the film is {wide}x{tall}, but the first is {first_wide}x{first_tall}: "
                f"bring all to one size."
            )
        self.count += 1
        return _quantised(linear, 8, self._gamma, self._white)


def _write_gif(path: Path, frames: Iterator[np.ndarray], rate: float) -> None:
    from PIL import GifImagePlugin, Image

    milliseconds = _gif_milliseconds(rate)
    with path.open("wb") as stream:
        # Picture by picture: `Image.save` would hold all of them, and make one of those that are equal.
        for number, frame in enumerate(frames):
            picture = Image.fromarray(frame)
            if number == 0:
                if max(picture.size) > _GIF_SIDE:
                    raise InputError(
                        f"The pictures are {picture.width}x{picture.height}, but a GIF has at most {_GIF_SIDE} pixels "
                        f"along a side: make them smaller."
                    )
                header, _ = GifImagePlugin.getheader(picture, info={"loop": 0, "duration": milliseconds})
                stream.writelines(header)
            stream.writelines(GifImagePlugin.getdata(picture, duration=milliseconds))
        stream.write(b";")


def _write_mp4(
    path: Path, frames: Iterator[np.ndarray], shape: tuple[int, ...], padded: tuple[int, int], rate: float
) -> None:
    """**Arguments:** `path`: absolute, as ffmpeg takes what stands before a colon for a protocol.

    **Raises:** `OSError` with what ffmpeg says if it fails.
    """
    command = [_encoder(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pixel_format", "gray"]
    command += ["-video_size", f"{shape[1]}x{shape[0]}", "-framerate", f"{rate:g}", "-i", "-"]
    # Players want whole pairs of pixels and 4:2:0 colour, grey or not.
    command += ["-vf", f"pad={padded[1]}:{padded[0]}", "-pix_fmt", "yuv420p", str(path)]
    encoder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    assert encoder.stdin is not None and encoder.stderr is not None
    given_up = False
    try:
        for frame in frames:
            encoder.stdin.write(frame.tobytes())
        encoder.stdin.flush()
    except BrokenPipeError:
        given_up = True  # its message follows
    except BaseException:
        encoder.kill()
        encoder.communicate()
        raise
    _, message = encoder.communicate()
    if encoder.returncode != 0 or given_up:
        lines = message.decode(errors="replace").replace(f"{path}: ", "").strip().splitlines()
        why = "saying " + re.sub(r"^\[.*?\] ", "", lines[-1]) if lines else "without a reason"  # [where in ffmpeg]
        raise OSError(f"ffmpeg failed, {why.rstrip('.')}")


def _encoder() -> str:
    """The machine's ffmpeg, or the one that the package imageio-ffmpeg brings."""
    found = shutil.which("ffmpeg")
    if found is not None:
        return found
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return get_ffmpeg_exe()
    except (ImportError, RuntimeError):  # the latter on systems that the package has no program for
        raise InputError(
            "An MP4 needs the program ffmpeg, which is not on this machine: pip install 'scsr-opt[sequence]' brings "
            "one, or write a .gif."
        ) from None


def _checked(image: Any, what: str = "The picture") -> Float[np.ndarray, "H W"]:
    """`image` as float32. **Raises:** `InputError`, in which `what` names it, if it is no picture of intensities."""
    array = as_array(image, what)
    if array.ndim != 2 or 0 in array.shape:
        raise InputError(f"{what} has shape {array.shape}, but a picture is (rows, columns), with one pixel at least.")
    if array.dtype.kind in "cOSUmM" or array.dtype.names:
        raise InputError(f"{what} holds values of type {array.dtype}, but a picture holds real numbers, 1 = white.")
    if array.dtype.kind in "iu" and (array.max() > 1 or array.min() < 0):
        raise InputError(
            f"{what} holds whole numbers from {array.min()} to {array.max()}, but intensity is 0 for black and 1 for "
            f"white: divide by what stands for white, as in image / 255."
        )
    linear = array.astype(np.float32)
    wrong = int(np.count_nonzero(~np.isfinite(linear)))
    if wrong:
        raise InputError(f"{wrong} of the picture's {linear.size} values are not finite, so it is not written.")
    return linear
