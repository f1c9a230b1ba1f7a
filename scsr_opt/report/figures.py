"""The figure that says on one page whether a reconstruction is worth having.

Top: what playback gives, enlarged, beside the result. Middle: the same small part of both, chosen where there is most
to see. Bottom: the motion that was found, and how the iteration converged. A known truth (simulations) makes a third
column.

Drawn with matplotlib's objects and none of its global figures, so it works in notebooks, in threads and without a
display.
"""

import math
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float, Num
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from scsr_opt.calibration.bad_pixels import BadPixels
from scsr_opt.camera.white import white_of
from scsr_opt.errors import InputError
from scsr_opt.pipeline.scene_summary import TileKind
from scsr_opt.pipeline.solution import Solution
from scsr_opt.report.colours import colour_wheel, full_speed, motion_colours
from scsr_opt.report.shown import ShownFigure

_INK = "#222222"
_FAINT = "#777777"
_ACCENT = "#c8102e"
# Inches; a tall picture is shown smaller than there is room for, so as not to be taller than `_TALLEST`, and its title
# is given `_TITLED`.
_MARGIN, _GUTTER, _TITLE = 0.15, 0.12, 0.3
_WIDEST, _TALLEST, _TITLED, _SCALE = 7.0, 12.0, 3.2, 0.9
_LIGHT = 1.2
"""Height of the course of the light, inches."""
_VARIES = 0.2
"""Difference of the frames that are used, relative to their median, from which on there is a map of them."""
_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 9.0,
    "text.color": _INK,
    "axes.edgecolor": _FAINT,
    "axes.labelcolor": _FAINT,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": _FAINT,
    "ytick.color": _FAINT,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
}


def bicubic(image: Num[Any, "h w"], scale: int) -> Float[np.ndarray, "H W"]:
    """Bicubic interpolation by `scale`: the enlargement to compare with. Pixel p's centre comes to s·p + (s − 1)/2."""
    from skimage.transform import resize

    small = np.asarray(image, dtype=np.float32)
    return np.asarray(resize(small, [side * scale for side in small.shape], order=3), dtype=np.float32)


def figure(
    solution: Solution,
    *,
    window: int = 21,
    truth: Num[Any, "H W"] | None = None,
    title: str | None = None,
) -> ShownFigure:
    """Draws a solution beside the playback of its recording.

    **Arguments:**
    - `window`: frames that the playback (TFP) averages over, if the recording has as many.
    - `truth`: (H, W), the picture of the key frame where it is known.
    - `title`: over everything; none if None.

    **Returns:** a matplotlib figure; `figure.savefig(path)` writes it, a notebook shows it.
    """
    from scsr_opt.camera import tfp

    source, scale = solution.part, solution.scale
    start, stop = source.around(solution.key, window)
    window = min(window, stop - start)
    frames = source.window(start, stop)
    playback = np.asarray(tfp(frames, solution.key - start, window=window, white_rate=solution.white_rate))
    columns = {f"Playback (TFP, {window} frames), bicubic ×{scale}": bicubic(playback, scale)}
    white = "" if solution.white.level == 1 else f", white {solution.white.level:.3g}"
    quality = ", quality best" if solution.diagnostics.quality == "best" else ""
    columns[f"Reconstruction ×{scale}{quality}{white}"] = np.asarray(solution.image)
    if truth is not None:
        columns["Truth"] = np.asarray(truth)
    return compare(columns, solution, scale=scale, title=title)


def compare(
    columns: dict[str, Num[Any, "H W"]],
    solution: Solution | None = None,
    *,
    scale: int = 1,
    title: str | None = None,
    crop: tuple[int, int, int, int] | None = None,
) -> ShownFigure:
    """Pictures of one scene side by side, whole and enlarged; below, motion and convergence of `solution` if given.

    **Arguments:**
    - `columns`: name → picture (H, W), all of one size. They share one grey scale, so that brightness compares: up to
      the white of `solution`, or else of the picture that has the middle one.
    - `scale`: HR pixels per sensor pixel.
    - `crop`: (top, left, height, width) in pixels of the part to enlarge; chosen by `detailed_part` if None.
    """
    pictures = {name: np.asarray(image, dtype=np.float32) for name, image in columns.items()}
    judged = np.asarray(solution.image if solution is not None else list(pictures.values())[-1])
    height, width = judged.shape
    velocity = None if solution is None or solution.velocity is None else np.asarray(solution.velocity)
    top, left, tall, wide = detailed_part(judged, velocity, scale=scale) if crop is None else crop
    white = solution.white.level if solution is not None else _white_level(pictures.values())

    page = 10.0 if len(pictures) < 3 else 13.0
    column = (page - 2 * _MARGIN - (len(pictures) - 1) * _GUTTER) / len(pictures)
    across = min(column, _TALLEST * width / height)
    # All in inches from the top left corner: pictures of a known shape need no layout engine, only this sum.
    first = _MARGIN + (0.4 if title else 0.0) + _TITLE
    second = first + across * height / width + _GUTTER
    third = second + across * tall / wide + 2 * _GUTTER + _TITLE
    bottom = min(max(0.36 * page * height / width, 2.0), 3.0)
    end = third + bottom + 0.45 if solution is not None else third - 2 * _GUTTER - _TITLE + _MARGIN
    fourth, flickers = end + _TITLE, solution is not None and solution.light is not None
    end += _TITLE + _LIGHT + 0.45 if flickers else 0
    fifth, varies = end + _TITLE, solution is not None and _used_frames_vary(solution)
    end += _TITLE + bottom + _MARGIN if varies else 0
    with matplotlib.rc_context(_STYLE):
        drawn = ShownFigure(figsize=(page, end), dpi=120, facecolor="white")
        if title:
            drawn.text(
                _MARGIN / page, 1 - _MARGIN / end, _as_text(title), va="top", fontsize=13, fontweight="bold",
                parse_math=False,
            )  # fmt: skip
        for number, (name, image) in enumerate(pictures.items()):
            x = _MARGIN + number * (column + _GUTTER)
            whole = _axes(drawn, x, first, across, across * height / width)
            _picture(whole, image, white)
            whole.set_title(name, loc="left", fontsize=10)
            whole.add_patch(Rectangle((left - 0.5, top - 0.5), wide, tall, fill=False, color=_ACCENT, linewidth=1.0))
            near = _axes(drawn, x, second, across, across * tall / wide)
            _picture(near, image[top : top + tall, left : left + wide], white)
            for spine in near.spines.values():
                spine.set(visible=True, color=_ACCENT, linewidth=1.0)
        if solution is not None:
            shape = (height // scale, width // scale)
            of_motion = min(bottom * width / height, 0.36 * page)
            _motion(drawn, velocity, shape, _MARGIN, third, of_motion, solution.bad_pixels)
            _convergence(drawn, solution, page / 2 + 0.6, third, page / 2 - 0.6 - _MARGIN, bottom)
            if flickers:
                _light(drawn, solution, _MARGIN + 0.4, fourth, page - 2 * _MARGIN - 0.4, _LIGHT)
            if varies:
                _used_frames(drawn, solution, _MARGIN, fifth, of_motion, of_motion * shape[0] / shape[1])
    return drawn


# One colour for each kind of tile, apart in lightness too; what rests is left as it is.
_OF_KIND = {
    TileKind.STATIC: None,
    TileKind.UNIFORM: "#7f7f7f",
    TileKind.MOVING: "#c8102e",
    TileKind.DARK: "#1f4e9c",
    TileKind.FAST: "#e69f00",
    TileKind.SATURATED: "#56b4e9",
}


def scene_figure(solution: Solution, *, title: str | None = None) -> ShownFigure:
    """Kinds of the tiles of a scene, in colour over the picture, and in words; beside it, where tiles were iterated one
    by one, the iterations of each of them.

    **Arguments:** `solution`: one with a `scene`; `title`: over everything.

    **Raises:** `InputError` if the solution has no summary of its scene.
    """
    scene, tiles = solution.scene, solution.tiles
    if tiles is not None and not tiles.tile_iterations.any():
        tiles = None
    if scene is None:
        raise InputError("This solution has no summary of its scene, as no work was left out: solve with Shortcuts().")
    height, width = solution.image.shape
    across = min(_WIDEST, _TALLEST * width / height)
    tall = across * height / width
    column = max(across, _TITLED)
    page = 2 * _MARGIN + (_WIDEST if tiles is None else max(_WIDEST, column + _GUTTER + across + _GUTTER + _SCALE))
    lines = scene.lines() + ([] if tiles is None else tiles.lines())
    shown = [kind for kind in TileKind if scene.share(kind) > 0]
    top = _MARGIN + (_TITLE if title or tiles is not None else 0)
    with matplotlib.rc_context(_STYLE):
        drawn = ShownFigure(figsize=(page, top + tall + 0.2 * (len(lines) + 1) + _MARGIN), facecolor="white")
        axes = _axes(drawn, _MARGIN, top, across, tall)
        colours = np.zeros((*scene.kind.shape, 4))
        for kind in shown:
            if (colour := _OF_KIND[kind]) is not None:
                colours[scene.kind == kind] = to_rgba(colour, 0.35)
        _tiled(axes, solution.image, solution.white.level, colours, scene.tile * solution.scale)
        named = _as_text(title or f"What each square of {scene.tile}×{scene.tile} sensor pixels needed")
        axes.set_title(named, loc="left", fontsize=10, parse_math=False)
        if tiles is not None:
            x = _MARGIN + column + _GUTTER
            beside = _axes(drawn, x, top, across, tall)
            iterations = tiles.global_iterations + tiles.tile_iterations
            range_ = Normalize(tiles.global_iterations, max(int(iterations.max()), tiles.global_iterations + 1))
            shades = matplotlib.colormaps["viridis"](range_(iterations), alpha=0.5 * (tiles.tile_iterations > 0))
            _tiled(beside, solution.image, solution.white.level, shades, tiles.tile_side)
            beside.set_title(f"Iterations: {tiles.global_iterations}, and more where coloured", loc="left", fontsize=10)
            bar = _axes(drawn, x + across + _GUTTER, top, 0.15, tall)
            drawn.colorbar(ScalarMappable(range_, "viridis"), cax=bar, alpha=0.75)
        below = _axes(drawn, _MARGIN, top + tall, page - 2 * _MARGIN, 0.2 * (len(lines) + 1))
        below.set_axis_off()
        for number, line in enumerate(lines):
            y = 1 - (number + 0.8) / (len(lines) + 1)
            kind = next((kind for kind in shown if line.endswith(f"{scene.reason(kind)}.")), None)
            inches = page - 2 * _MARGIN
            if kind is not None:
                colour = _OF_KIND[kind] or "none"
                edge = _FAINT if colour == "none" else colour
                below.plot(0.056 / inches, y, "s", color=colour, markeredgecolor=edge, alpha=0.6, markersize=7)
            below.text(0.175 / inches, y, line, va="center", fontsize=8)
        below.set(xlim=(0, 1), ylim=(0, 1))
    return drawn


def _tiled(
    axes: Axes, image: Num[Any, "H W"], white: float, colours: Float[np.ndarray, "rows columns 4"], side: int
) -> None:
    """A picture with each of its tiles of side × side pixels in a colour."""
    height, width = image.shape
    _picture(axes, image, white)
    rows, columns, _ = colours.shape
    extent = (-0.5, columns * side - 0.5, rows * side - 0.5, -0.5)
    axes.imshow(colours, extent=extent, interpolation="nearest", aspect="auto")
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))


def detailed_part(
    image: Num[Any, "H W"], velocity: Num[Any, "2 h w"] | None = None, *, scale: int = 1, share: float = 0.24
) -> tuple[int, int, int, int]:
    """The part of a picture with most detail and motion: (top, left, height, width) in pixels.

    Its score is the mean of the gradient's magnitude, capped so that a single hard edge does not outweigh texture,
    times one plus the mean speed over the largest; parts within 4 sensor pixels of the border are left out.

    **Arguments:**
    - `velocity`: sensor pixels per frame, on the sensor's grid.
    - `share`: of the picture's width and height, but at least 16 sensor pixels.
    """
    from scipy.ndimage import uniform_filter

    pixels = np.clip(np.nan_to_num(np.asarray(image, dtype=np.float32)), 0.0, 1.0)
    height, width = pixels.shape
    tall = min(max(round(height * share), 16 * scale), height)
    wide = min(max(round(width * share), 16 * scale), width)
    size: Any = (tall, wide)
    down, right = np.gradient(pixels) if min(height, width) > 1 else (np.zeros_like(pixels), np.zeros_like(pixels))
    detail = np.hypot(down, right)
    detail = np.minimum(detail, np.percentile(detail, 99.0))
    score = uniform_filter(detail, size=size, mode="constant")
    if velocity is not None:
        speed = np.nan_to_num(np.hypot(*np.asarray(velocity, dtype=np.float32)))
        speed = np.kron(speed, np.ones((scale, scale), np.float32))
        if speed.shape == pixels.shape and speed.max() > 1e-3:
            score *= 1.0 + uniform_filter(speed, size=size, mode="constant") / np.percentile(speed, 99.5).clip(1e-3)
    edge = min(4 * scale, (height - tall) // 2, (width - wide) // 2)
    # The filter's value at (i, j) is the mean over the part that begins at (i − tall//2, j − wide//2).
    starts = score[
        tall // 2 + edge : tall // 2 + height - tall - edge + 1, wide // 2 + edge : wide // 2 + width - wide - edge + 1
    ]
    top, left = np.unravel_index(int(np.argmax(starts)), starts.shape)
    return (int(top) + edge, int(left) + edge, tall, wide)


def _as_text(title: str) -> str:
    """A title in one line: names of files, of which it is made, may hold line breaks and bytes that are no text."""
    return " ".join(title.split()).encode("utf-8", "backslashreplace").decode()


def _white_level(pictures: Any) -> float:
    """The intensity shown as white, by the rule for recordings (`white_of`).

    The middle one of the pictures decides: one with outliers would leave the others dark.
    """
    return float(np.median([white_of(np.nan_to_num(image).ravel()).level for image in pictures]))


def _axes(drawn: Figure, x: float, y: float, wide: float, tall: float) -> Axes:
    """Axes whose top left corner is at (x, y), in inches from that of the figure."""
    page, end = drawn.get_size_inches()
    return drawn.add_axes((x / page, 1 - (y + tall) / end, wide / page, tall / end))


def _picture(axes: Axes, image: Num[Any, "H W"], white: float) -> None:
    axes.imshow(np.asarray(image), cmap="gray", vmin=0.0, vmax=white, interpolation="nearest", aspect="auto")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def _motion(
    drawn: Figure,
    velocity: Any,
    shape: tuple[int, int],
    x: float,
    y: float,
    across: float,
    bad: BadPixels | None,
) -> None:
    """The velocity field `across` inches wide, with bad pixels as dots; its legend to the right of it."""
    tall = across * shape[0] / shape[1]
    axes = _axes(drawn, x, y, across, tall)
    field = np.zeros((2, *shape), np.float32) if velocity is None else velocity
    fastest = full_speed(field)
    axes.imshow(motion_colours(field, fastest), interpolation="nearest", aspect="auto")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set(visible=True, color=_FAINT, linewidth=0.6)
    title = "Motion: none" if fastest == 0.0 else "Motion"
    if bad is not None and bad.mask.any() and bad.mask.shape == shape:
        row, column = np.nonzero(bad.mask)
        axes.scatter(column, row, s=2.0, color=_INK, linewidths=0)
        axes.set(xlim=(-0.5, shape[1] - 0.5), ylim=(shape[0] - 0.5, -0.5))
        title += f"; {row.size:,} bad pixel{'s' if row.size > 1 else ''}"
    axes.set_title(title, loc="left", fontsize=10)
    if fastest > 0.0:
        legend = _axes(drawn, x + across + _GUTTER, y, 0.7, 0.7)
        legend.imshow(colour_wheel(), extent=(-1, 1, -1, 1))
        legend.set_axis_off()
        text = f"rim: {fastest:g}\nsensor pixels\nper frame"
        legend.annotate(text, (0, -0.1), xycoords="axes fraction", va="top", fontsize=8, color=_FAINT)


def _convergence(drawn: Figure, solution: Solution, x: float, y: float, wide: float, tall: float) -> None:
    stages = solution.stages
    if not stages:
        axes = _axes(drawn, x, y, wide, tall)
        axes.set_axis_off()
        axes.set_title("Convergence: not recorded", loc="left", fontsize=10)
        return
    first = solution.diagnostics.first_iterations
    number = [float(stage.number) for stage in stages]
    objective, residual = ([getattr(stage, name) for stage in stages] for name in ("objective", "residual"))
    if first is not None:  # the objectives of two problems are no curve
        for values in (number, objective, residual):
            values.insert(first, math.nan)
    each = (tall - 1.5 * _TITLE) / 2
    upper = _axes(drawn, x, y, wide, each)
    _curve(upper, number, objective)
    ending = solution.status.name.replace("_", " ")
    upper.set_title(f"Objective: {len(stages)} iterations, {ending}", loc="left", fontsize=10)
    upper.tick_params(labelbottom=False)
    lower = _axes(drawn, x, y + tall - each, wide, each)
    _curve(lower, number, residual)
    lower.set_title("Relative residual", loc="left", fontsize=10)
    for axes in (upper, lower):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        if first is not None:  # where the second solve begins
            axes.axvline(first + 0.5, color=_ACCENT, linewidth=0.8, linestyle="--")
    if first is not None:
        text = "second solve, around\na network's picture"
        upper.annotate(
            text, (first + 0.5, 0.95), (4, 0), xycoords=("data", "axes fraction"), textcoords="offset points",
            va="top", fontsize=8, color=_ACCENT,
        )  # fmt: skip
    lower.set_xlabel("iteration")


def _light(drawn: Figure, solution: Solution, x: float, y: float, wide: float, tall: float) -> None:
    """Relative light of the moments of the clip: its median over the pixels, and the range of nine tenths of them."""
    light, found = solution.light, solution.diagnostics
    assert light is not None
    axes = _axes(drawn, x, y, wide, tall)
    now = light.at(light.time).reshape(light.time.size, -1)
    least, usual, most = np.quantile(now, (0.05, 0.5, 0.95), axis=1)
    axes.fill_between(light.time, least, most, color=_ACCENT, alpha=0.25, linewidth=0)
    axes.plot(light.time, usual, color=_ACCENT, linewidth=1.2)
    often = "" if found.light_frequency is None else f", {found.light_frequency:.0f} Hz"
    depth = "" if found.light_depth is None else f": {100 * found.light_depth:.0f} % of its mean either way{often}"
    axes.set_title(f"Light{depth}", loc="left", fontsize=10)
    axes.set_xlabel("frame of the clip")
    axes.set_ylim(0, 1.1 * float(most.max()))


def _used_frames_vary(solution: Solution) -> bool:
    """Whether some parts of the picture are of more frames than others."""
    found = solution.diagnostics.used_frames
    return solution.used_frames is not None and found is not None and found[2] - found[0] >= _VARIES * found[1]


def _used_frames(drawn: Figure, solution: Solution, x: float, y: float, across: float, tall: float) -> None:
    """Map of how far in time samples were used, with its scale to the right."""
    assert solution.used_frames is not None and solution.diagnostics.used_frames is not None
    least, usual, most = solution.diagnostics.used_frames
    axes = _axes(drawn, x, y, across, tall)
    range_ = Normalize(0, most)
    axes.imshow(solution.used_frames, cmap="viridis", norm=range_, interpolation="nearest", aspect="auto")
    axes.set_xticks([])
    axes.set_yticks([])
    text = f"Frames used before and after the key frame: {usual:.0f} ({least:.0f} to {most:.0f})"
    axes.set_title(text, loc="left", fontsize=10)
    drawn.colorbar(ScalarMappable(range_, "viridis"), cax=_axes(drawn, x + across + _GUTTER, y, 0.15, tall))


def _curve(axes: Axes, number: Sequence[float], values: Sequence[float]) -> None:
    finite = np.array([value if math.isfinite(value) else np.nan for value in values], dtype=np.float64)
    mark = "." if len(number) == 1 else ""
    axes.plot(number, finite, color=_INK, linewidth=1.2, marker=mark)
    positive = finite[np.isfinite(finite) & (finite > 0)]
    # A logarithm needs positive values, and is of use only where they span a good part of a decade.
    if positive.size == np.isfinite(finite).sum() and positive.size and positive.max() > 3 * positive.min():
        axes.set_yscale("log")
    axes.margins(x=0.01)
