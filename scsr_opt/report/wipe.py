"""Before and after behind one line that moves across: as a film, as a page with a slider, and in a notebook."""

import base64
import html
import io
import os
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Num

from scsr_opt._files import as_path, whole_file
from scsr_opt.errors import InputError, shown
from scsr_opt.report.figures import _white_level
from scsr_opt.report.pictures import _checked, check_film, quantise, write_film

_RATE = 12.0  # pictures of the film per second

_PAGE = """<div style="position:relative;width:{width}px;max-width:100%;font:12px sans-serif">
<img alt="{after}" src="{second}" style="width:100%;display:block;image-rendering:pixelated">
<img alt="{before}" src="{first}" style="width:100%;position:absolute;top:0;left:0;image-rendering:pixelated;clip-path:inset(0 50% 0 0)">
<input type="range" min="0" max="100" value="50" aria-label="share of {before}" style="width:100%;margin:4px 0"
 oninput="this.parentNode.children[1].style.clipPath='inset(0 '+(100-this.value)+'% 0 0)'">
<div style="display:flex;justify-content:space-between"><span>{before}</span><span>{after}</span></div></div>"""  # noqa: E501


@dataclass(frozen=True, eq=False)
class Wipe:
    """Two pictures of one scene, divided by a movable line: one picture left of it, the other right.

        Wipe(bicubic(playback, 4), solution.image, names=("playback", "reconstruction")).write("wipe.gif")

    A notebook shows it with a slider, which needs neither a kernel nor a package.

    **Fields:**
    - `before`, `after`: (H, W), intensity, 1 = white, of one size.
    - `names`: what is written below them.
    - `gamma`: 2.2 is what viewers expect, 1 keeps intensity linear.

    Both are drawn with one grey scale, whose white is near the brightest of them.
    """

    before: Num[Any, "_ _"]
    after: Num[Any, "_ _"]
    names: tuple[str, str] = ("before", "after")
    gamma: float = 1.0
    _drawn: list[Float[np.ndarray, "H W"]] = field(init=False, repr=False)

    def __post_init__(self):
        pictures = [_checked(self.before, "The picture before"), _checked(self.after, "The picture after")]
        if pictures[0].shape != pictures[1].shape:
            raise InputError(
                f"The pictures have shapes {pictures[0].shape} and {pictures[1].shape}, but a wipe needs one size: "
                f"enlarge one with scsr_opt.report.bicubic."
            )
        if len(self.names) != 2:
            raise InputError(f"names is {shown(self.names)}, but there are two pictures: give two names.")
        white = _white_level(pictures)
        object.__setattr__(self, "_drawn", [np.clip(image / white, 0.0, 1.0) for image in pictures])

    def frames(self, count: int = 24) -> list[Float[np.ndarray, "H W"]]:
        """Pictures of the film: the line goes from left to right and back, black and two pixels wide."""
        width = self._drawn[0].shape[1]
        there = np.linspace(0, width, max(count // 2, 2)).round().astype(int)
        film = []
        for place in [*there, *there[::-1]]:
            picture = self._drawn[1].copy()
            picture[:, :place] = self._drawn[0][:, :place]
            picture[:, max(place - 1, 0) : place + 1] = 0.0
            film.append(picture)
        return film

    def write(self, path: str | os.PathLike[str]) -> None:
        """Writes a film (`.gif`, `.mp4`) or a page with a slider that any browser shows (`.html`).

        **Raises:** `InputError` if the file cannot be written, or has another ending.
        """
        if as_path(path).suffix.lower() == ".html":
            head = '<!doctype html><html lang="en"><meta charset="utf-8"><title>Wipe</title>'
            page = f"{head}{self._repr_html_()}</html>"
            with whole_file(path) as temporary:
                temporary.write_text(page, encoding="utf-8")
            return
        check_film(path, rate=_RATE, gamma=self.gamma)
        write_film(path, self.frames(), rate=_RATE, gamma=self.gamma)

    def _repr_html_(self) -> str:
        from PIL import Image

        sources = []
        for picture in self._drawn:
            stream = io.BytesIO()
            Image.fromarray(quantise(picture, gamma=self.gamma)).save(stream, "PNG", optimize=True)
            sources.append("data:image/png;base64," + base64.b64encode(stream.getvalue()).decode())
        before, after = (html.escape(name, quote=True) for name in self.names)
        width = max(self._drawn[0].shape[1], 320)
        return _PAGE.format(width=width, first=sources[0], second=sources[1], before=before, after=after)
