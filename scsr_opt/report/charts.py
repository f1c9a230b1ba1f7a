"""Pictures that people expect beside a reconstruction, each one call, titled, with units.

    spike_raster(recording)                                    what a recording holds
    zoomed_crops({"playback": …, "result": …}, scale=4)        the same parts of several pictures
    error_map(image, truth)                                    where a picture is wrong, and which way
    velocity_map(solution)                                     motion, as colour and as arrows
    convergence({"FISTA": solution, "ISTA": other})            objective and residual of each iteration
    time_against_error({"FISTA": outcome, …})                  how long each method takes to how small a gap
    stage_grid({"FISTA": solution, "unrolled": network})       pictures of the stages, a row a method

Lines have the colours of Okabe and Ito (2008), which people with any kind of colour vision tell apart, and dashes of
their own; signed errors go from blue to red by way of white; motion has arrows beside its colours.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float, Num
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.patches import Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike

from scsr_opt._arrays import as_array
from scsr_opt.camera.recording import Recording
from scsr_opt.errors import InputError
from scsr_opt.pipeline.solution import Solution
from scsr_opt.report.colours import colour_wheel, full_speed, motion_colours
from scsr_opt.report.figures import _ACCENT, _FAINT, _INK, _STYLE, _as_text, _picture, _white_level, detailed_part
from scsr_opt.report.shown import ShownFigure
from scsr_opt.solvers.record import Stage

_LINES = ("#000000", "#e69f00", "#56b4e9", "#009e73", "#0072b2", "#d55e00", "#cc79a7", "#999999")
_DASHES: tuple[Any, ...] = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)))
# Inches.
_WIDE, _TALL, _TILE = 7.0, 3.0, 2.0
_ARROWS = 16  # along the longer side of a velocity map
_MARGIN_SHARE = 8  # of a side: pixels nearer to the border are not marked


def spike_raster(
    spikes: ArrayLike | Recording,
    *,
    key: int | None = None,
    pixels: Sequence[tuple[int, int]] | None = None,
    title: str | None = None,
) -> ShownFigure:
    """One frame of a recording, and the spikes of some pixels along time.

    **Arguments:**
    - `spikes`: (T, h, w) of 0 and 1, or a `Recording`. Of a long recording pass a `window`.
    - `key`: frame that is shown; the middle one if None.
    - `pixels`: (row, column) of those whose spikes are shown; five from dark to bright if None.
    """
    recording = spikes if isinstance(spikes, Recording) else Recording.from_array(as_array(spikes, "spikes"))
    frames = np.asarray(recording.window(0, recording.frames))
    shown = len(frames) // 2 if key is None else key
    if not 0 <= shown < len(frames):
        raise InputError(f"key is {key}, but the recording has frames 0 to {len(frames) - 1}.")
    rates = frames.mean(axis=0)
    if pixels is None:
        top, left = (side // _MARGIN_SHARE for side in rates.shape)  # or their marks would be cut off
        inner = rates[top : rates.shape[0] - top, left : rates.shape[1] - left]
        ordered = np.argsort(inner, axis=None, kind="stable")
        places = (np.array([0.02, 0.25, 0.5, 0.75, 0.98]) * (ordered.size - 1)).round().astype(int)
        chosen = [(top + int(p) // inner.shape[1], left + int(p) % inner.shape[1]) for p in ordered[places]]
    else:
        chosen = [(int(row), int(column)) for row, column in pixels]
        for row, column in chosen:
            if not (0 <= row < rates.shape[0] and 0 <= column < rates.shape[1]):
                raise InputError(f"pixels has ({row}, {column}), outside the sensor of {rates.shape} rows and columns.")
    with matplotlib.rc_context(_STYLE):
        drawn, (left, right) = _page((10.0, 3.2), title, columns=2, width_ratios=[1, 1.6])
        _picture(left, frames[shown], 1.0)
        left.set_aspect("equal")
        left.set_title(f"Frame {shown}: white where a pixel fires", loc="left", fontsize=10)
        for number, (row, column) in enumerate(chosen):
            left.plot(column, row, "o", markersize=9, markeredgewidth=2, fillstyle="none", color=_ACCENT)
            left.annotate(
                str(number + 1), (column, row), (6, 3), textcoords="offset points", color=_ACCENT, fontsize=12,
                fontweight="bold", path_effects=[withStroke(linewidth=3, foreground="white")],
            )  # fmt: skip
        times = [np.flatnonzero(frames[:, row, column]) for row, column in chosen]
        right.eventplot(times, colors=_INK, linelengths=0.7, linewidths=1.0)
        right.axvline(shown, color=_ACCENT, linewidth=0.8)
        names = [f"{number + 1}: {rates[place]:.2f}" for number, place in enumerate(chosen)]
        right.set_yticks(range(len(chosen)), names)
        right.set_ylabel("pixel: spikes per frame")
        right.set_xlabel("time, frames")
        right.set_title("Spikes of the marked pixels", loc="left", fontsize=10)
    return drawn


def zoomed_crops(
    columns: Mapping[str, Num[Any, "H W"]],
    *,
    scale: int = 1,
    parts: Sequence[tuple[int, int, int, int]] | None = None,
    title: str | None = None,
) -> ShownFigure:
    """Chart of enlarged parts of several pictures: a row for each part, a column for each picture, one grey scale.

    **Arguments:**
    - `columns`: name → picture (H, W), all of one size; the last one chooses the parts.
    - `scale`: pixels per sensor pixel.
    - `parts`: (top, left, height, width) in pixels; if None, the two with most detail that do not overlap, or one
      where the pictures are too small for two.
    """
    pictures = _alike(columns)
    judged = list(pictures.values())[-1]
    if parts is None:
        first = detailed_part(judged, scale=scale)
        top, left, tall, wide = first
        flat = judged.copy()
        flat[max(top - tall, 0) : top + 2 * tall, max(left - wide, 0) : left + 2 * wide] = float(judged.mean())
        second = detailed_part(flat, scale=scale)
        apart = abs(second[0] - top) >= tall or abs(second[1] - left) >= wide
        parts = [first, second] if apart else [first]
    white = _white_level(pictures.values())
    with matplotlib.rc_context(_STYLE):
        tall = sum(_TILE * part[2] / part[3] for part in parts)
        size = (_TILE * (len(pictures) + 1) + 0.2, tall + 0.5)
        drawn, grid = _page(size, title, rows=len(parts), columns=len(pictures) + 1)
        grid = np.reshape(grid, (len(parts), len(pictures) + 1))
        for row, (top, left, high, wide) in zip(grid, parts, strict=True):
            _picture(row[0], judged, white)
            row[0].set_aspect("equal")
            row[0].add_patch(Rectangle((left - 0.5, top - 0.5), wide, high, fill=False, color=_ACCENT))
            for axes, image in zip(row[1:], pictures.values(), strict=True):
                _picture(axes, image[top : top + high, left : left + wide], white)
                axes.set_aspect("equal")
        for axes, name in zip(grid[0], ["which part", *pictures], strict=True):
            axes.set_title(name, loc="left", fontsize=9)
    return drawn


def error_map(
    image: Num[Any, "H W"] | Mapping[str, Num[Any, "H W"]],
    truth: Num[Any, "H W"],
    *,
    largest: float | None = None,
    label: str = "too dark   ←   intensity   →   too bright",
    title: str | None = None,
) -> ShownFigure:
    """Where a picture is too bright (red) or too dark (blue), in intensity, 1 = white.

    **Arguments:**
    - `image`: (H, W), or name → picture for several beside each other.
    - `truth`: (H, W), the picture that would be right.
    - `largest`: error with full colour; that which 1 in 100 pixels of the last picture exceeds if None.
    - `label`: of the colours, for two pictures of which neither is the truth.
    """
    pictures = _alike({**(image if isinstance(image, Mapping) else {"Error": image}), "": truth})
    right = pictures.pop("")
    errors = {name: picture - right for name, picture in pictures.items()}
    bound = largest or max(float(np.percentile(abs(list(errors.values())[-1]), 99)), 1e-6)
    with matplotlib.rc_context(_STYLE):
        each = min(4.0, 10.0 / len(errors))
        size = (each * len(errors) + 0.8, each * right.shape[0] / right.shape[1] + 0.4)
        drawn, grid = _page(size, title, columns=len(errors))
        range_ = Normalize(-bound, bound)
        for axes, (name, error) in zip(np.ravel(grid), errors.items(), strict=True):
            axes.imshow(error, cmap="RdBu_r", norm=range_, interpolation="nearest")
            axes.set_xticks([])
            axes.set_yticks([])
            root = float(np.sqrt(np.mean(np.square(error, dtype=np.float64))))
            axes.set_title(f"{name}: RMS {root:.3g}", loc="left", fontsize=10)
        bar = drawn.colorbar(ScalarMappable(range_, "RdBu_r"), ax=list(np.ravel(grid)), fraction=0.05, extend="both")
        bar.set_label(label)
    return drawn


def velocity_map(
    motion: Solution | Float[Any, "2 h w"],
    *,
    fastest: float | None = None,
    title: str | None = None,
) -> ShownFigure:
    """A motion as colour (hue: direction, saturation: speed) with the wheel that explains it, and as arrows.

    **Arguments:**
    - `motion`: a `Solution`, or velocities (2, h, w), sensor pixels per frame, [0] down, [1] right.
    - `fastest`: speed of full saturation; nearly the largest if None.
    """
    given = motion.velocity if isinstance(motion, Solution) else motion
    if given is None:
        raise InputError("This solution has no motion: its solve found no sample to use.")
    velocity = np.asarray(given, np.float32)
    if velocity.ndim != 3 or len(velocity) != 2:
        raise InputError(f"The velocities have shape {velocity.shape}, but a field is (2, rows, columns).")
    height, width = velocity.shape[1:]
    full = full_speed(velocity) if fastest is None else float(fastest)
    with matplotlib.rc_context(_STYLE):
        across = 5.0
        drawn, (axes, legend) = _page(
            (across + 2.0, max(across * height / width, 1.5) + 1.0), title, columns=2, width_ratios=[across, 1.4]
        )
        axes.imshow(motion_colours(velocity, full), interpolation="nearest")
        axes.set_title("Motion: none" if full == 0.0 else "Motion", loc="left", fontsize=10)
        axes.set_xlabel("column, sensor pixels")
        axes.set_ylabel("row, sensor pixels")
        if full > 0.0:
            step = max(round(max(height, width) / _ARROWS), 1)
            rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
            down, right = np.nan_to_num(velocity[:, rows, columns])
            axes.quiver(columns, rows, right, down, angles="xy", scale_units="xy", scale=full / step, color=_INK,
                        width=0.004)  # fmt: skip
            legend.imshow(colour_wheel(), extent=(-1, 1, -1, 1))
            legend.set_title(f"rim: {full:g}\nsensor pixels\nper frame", fontsize=8, color=_FAINT)
        legend.set_axis_off()
    return drawn


def convergence(solutions: Any, *, one_problem: bool = False, title: str | None = None) -> ShownFigure:
    """Objective and relative residual of every iteration.

    Objectives with different priors, strengths or recordings are values of different functions, which cannot be
    compared. Of several methods each is therefore drawn relative to its own lowest objective, so that every curve ends
    near 1, unless all of them solve one problem: then the gap to the lowest objective of all is drawn.

    **Arguments:**
    - `solutions`: a `Solution` or `scsr_opt.solvers.Outcome`, a list of `Stage`, or name → one of these.
    - `one_problem`: true if the objectives of all are those of one problem, with the same samples, prior and strength.

    **Raises:** `InputError` if there is no stage, or a lowest objective that others are relative to is not above 0.
    """
    curves = _curves(solutions)
    several = len(curves) > 1
    gaps, relative = several and one_problem, several and not one_problem
    units = {name: _lowest(name, stages) if several else 1.0 for name, stages in curves.items()}
    least = min(units.values())
    with matplotlib.rc_context(_STYLE):
        drawn, (left, right) = _page((10.0, _TALL), title, columns=2)
        for number, (name, stages) in enumerate(curves.items()):
            iterations = [stage.number for stage in stages]
            objectives = [stage.objective for stage in stages]
            shown = _gaps(objectives, least) if gaps else [objective / units[name] for objective in objectives]
            _line(left, iterations, shown, name, number)
            _line(right, iterations, [stage.residual for stage in stages], name, number)
        for axes, name in ((left, "Objective f(X) + λΨ(X)"), (right, "Relative residual")):
            axes.set_title(name, loc="left", fontsize=10)
            axes.set_xlabel("iteration")
        if relative:
            left.set_ylabel("objective / its own lowest value")
            left.ticklabel_format(axis="y", useOffset=False)
        if gaps:
            left.set_ylabel("gap (F − F*) / F*")
            left.set_yscale("log")
        right.set_yscale("log")
        if len(curves) > 1:
            right.legend(frameon=False, fontsize=8)
    return drawn


def _gaps(objectives: Sequence[float], least: float) -> list[float]:
    """(F − F*) / F* of each objective, F* the `least`; NaN for that itself, which a logarithm does not show."""
    return [(objective - least) / least if objective > least else math.nan for objective in objectives]


def time_against_error(
    solutions: Any,
    *,
    least: float | None = None,
    seconds: Mapping[str, Sequence[float]] | None = None,
    title: str | None = None,
) -> ShownFigure:
    """How far each method is above the minimum, over time: (F(X^(t)) − F*) / F*.

    **Arguments:**
    - `solutions`: name → `Solution`, `scsr_opt.solvers.Outcome`, or list of `Stage`, all of one problem. The time of a
      stage is that of its chunk (`Stage.seconds`): run with `keep_images=True` to have one for every iteration, and
      twice, so that compilation is not in it.
    - `least`: F*; the least objective of any stage if None, whose own gap then cannot be shown.
    - `seconds`: name → time of each stage, where it is known better than by `Stage.seconds`.
    """
    curves = _curves(solutions)
    bottom = min(stage.objective for stages in curves.values() for stage in stages) if least is None else least
    if not bottom > 0:
        raise InputError(f"The minimum is {bottom:g}, but gaps are relative to it: it must be above 0.")
    with matplotlib.rc_context(_STYLE):
        drawn, axes = _page((_WIDE, _TALL + 0.6), title)
        for number, (name, stages) in enumerate(curves.items()):
            times = [stage.seconds for stage in stages] if seconds is None else seconds[name]
            gaps = _gaps([stage.objective for stage in stages], bottom)
            _line(axes, [1e3 * time for time in times], gaps, name, number)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("time, milliseconds")
        axes.set_ylabel("gap (F − F*) / F*")
        axes.set_title("Time against error", loc="left", fontsize=10)
        axes.legend(frameon=False, fontsize=8)
    return drawn


def stage_grid(
    solutions: Mapping[str, Solution | Sequence[Stage]],
    *,
    truth: Num[Any, "H W"] | None = None,
    scale: int = 1,
    stages: Sequence[int] = (1, 2, 4, 8),
    part: tuple[int, int, int, int] | None = None,
    title: str | None = None,
) -> ShownFigure:
    """Pictures of the stages of optimizers and networks, a row a method; the last stage at the right, then the truth.

    **Arguments:**
    - `solutions`: name → `Solution` or its stages, made with `keep_images=True`.
    - `truth`: (H, W), where it is known; the captions are PSNR then, without 8 sensor pixels of border (without any
      where that is all), otherwise the objective.
    - `stages`: numbers t of the columns, but those that no method has; the last stage of each method follows. Where a
      method ended before, a remark takes the place of the picture.
    - `part`: (top, left, height, width) in pixels; where there is most detail if None.
    """
    rows = {name: tuple(given.stages if isinstance(given, Solution) else given) for name, given in solutions.items()}
    for name, found in rows.items():
        if not found or any(stage.image is None for stage in found):
            raise InputError(f"The stages of {name} have no pictures: solve with keep_images=True.")
    judged = np.asarray(list(rows.values())[0][-1].image if truth is None else truth, np.float32)
    top, left, tall, wide = detailed_part(judged, scale=scale) if part is None else part
    numbers = [t for t in stages if any(t < len(found) for found in rows.values())]
    across = len(numbers) + 1 + (truth is not None)
    white = _white_level([judged])
    border = 8 * scale if min(judged.shape) > 16 * scale else 0
    inner = np.s_[border : judged.shape[0] - border, border : judged.shape[1] - border]
    with matplotlib.rc_context(_STYLE):
        size = (_TILE * across * 0.85 + 0.3, len(rows) * (_TILE * 0.85 * tall / wide + 0.28))
        drawn, grid = _page(size, title, rows=len(rows), columns=across)
        for axes in np.ravel(grid):
            axes.set_axis_off()
        for row, (name, found) in zip(np.reshape(grid, (len(rows), across)), rows.items(), strict=True):
            shown = [found[t - 1] if t < len(found) else None for t in numbers] + [found[-1]]
            for axes, stage in zip(row, shown, strict=False):
                if stage is None:
                    axes.text(0.5, 0.5, f"ended at\nt = {found[-1].number} →", color=_FAINT, fontsize=9,
                              ha="center", va="center", transform=axes.transAxes)  # fmt: skip
                    continue
                image = np.asarray(stage.image)
                _picture(axes, image[top : top + tall, left : left + wide], white)
                axes.set_aspect("equal")
                error = float(np.mean(np.square((image - judged)[inner], dtype=np.float64)))
                says = f"{stage.objective:.4g}" if truth is None else f"{-10 * math.log10(max(error, 1e-12)):.1f} dB"
                axes.set_title(f"{name}, t = {stage.number}: {says}", loc="left", fontsize=7.5)
            if truth is not None:
                _picture(row[-1], judged[top : top + tall, left : left + wide], white)
                row[-1].set_aspect("equal")
                row[-1].set_title("truth", loc="left", fontsize=7.5)
    return drawn


def _page(
    size: tuple[float, float], title: str | None, rows: int = 1, columns: int = 1, **layout: Any
) -> tuple[ShownFigure, Any]:
    """A figure with its axes, and room for a title above them."""
    across, high = size
    drawn = ShownFigure(
        figsize=(across, high + (0.3 if title else 0.0)), dpi=100, facecolor="white", layout="constrained"
    )
    if title:
        drawn.suptitle(_as_text(title), x=0.01, ha="left", fontsize=12, fontweight="bold", parse_math=False)
    return drawn, drawn.subplots(rows, columns, **layout)


def _alike(columns: Mapping[str, Num[Any, "H W"]]) -> dict[str, np.ndarray]:
    """The pictures as float32. **Raises:** `InputError` if there is none, or they are not of one size."""
    pictures = {name: np.asarray(image, np.float32) for name, image in columns.items()}
    shapes = {image.shape for image in pictures.values()}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        raise InputError(f"The pictures have shapes {sorted(shapes)}, but all must be (rows, columns) of one size.")
    return pictures


def _curves(solutions: Any) -> dict[str, tuple[Stage, ...]]:
    """Name → stages. **Raises:** `InputError` where a method has none."""
    named = solutions if isinstance(solutions, Mapping) else {"": solutions}
    curves = {str(name): tuple(getattr(given, "stages", given)) for name, given in named.items()}
    for name, stages in curves.items():
        if not stages or not all(isinstance(stage, Stage) for stage in stages):
            raise InputError(f"{name or 'The solution'} has no stages to draw: give Solutions, or lists of Stage.")
    return curves


def _lowest(name: str, stages: Sequence[Stage]) -> float:
    """The lowest objective of a method. **Raises:** `InputError` if it is not above 0."""
    found = min((stage.objective for stage in stages if math.isfinite(stage.objective)), default=math.nan)
    if not found > 0:
        raise InputError(
            f"The lowest objective of {name} is {found:g}, but several methods are drawn relative to it: it must be "
            f"above 0."
        )
    return found


def _line(axes: Axes, x: Sequence[float | int], y: Sequence[float | int], name: str, number: int) -> None:
    colour, dash = _LINES[number % len(_LINES)], _DASHES[number % len(_DASHES)]
    axes.plot(x, y, color=colour, linestyle=dash, linewidth=1.4, label=name, marker="." if len(x) == 1 else "")
