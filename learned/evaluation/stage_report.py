"""A comparison of models stage by stage as a table, as JSON, and as a figure."""

import json
import math
import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from scsr_opt._files import made_folder, whole_file
from scsr_opt.camera.recording import Recording
from scsr_opt.report.figures import detailed_part
from scsr_opt.report.shown import ShownFigure
from scsr_opt.report.summary import plain, versions
from scsr_opt.solvers.record import Status

_ACCENT, _FAINT = "#c8102e", "#777777"
_COLUMN, _GAP, _CAPTION, _MARGIN = 2.1, 0.1, 0.24, 0.15


@dataclass(frozen=True)
class StageMeasures:
    """Stage t of one model, measured by the problem that all share. What is not known is NaN.

    **Fields:**
    - `number`: t.
    - `objective`, `data`, `prior`: Eq. 4, halved, at X^(t); its data part f, and λΨ.
    - `own`: what the model itself makes small, at X^(t): with its own prior.
    - `misfit`: root of the weighted mean square by which X^(t) misses the samples, intensity.
    - `distance`: ‖X^(t) − X*‖ / ‖X*‖, X* the optimizer's converged solution.
    - `change`: ‖X^(t) − X^(t−1)‖ / ‖X^(t−1)‖.
    - `downhill_r`, `downhill_x`: cosines of R^(t) − X^(t−1), and of X^(t) − X^(t−1), with −∇f(X^(t−1)).
    - `psnr` (dB), `ssim`: against the truth, 8 sensor pixels at the border left out; `ssim` of the stages shown only.
    - `seconds`, `flops`: from the start of the iteration to this stage, compiled; without what comes before it.
    """

    number: int
    objective: float
    own: float
    data: float
    prior: float
    misfit: float
    distance: float
    change: float
    downhill_r: float
    downhill_x: float
    psnr: float
    ssim: float
    seconds: float
    flops: float


@dataclass(frozen=True)
class ModelStages:
    """One model.

    **Fields:** `name`; `status`, how it ended; `seconds_before` the first stage (motion, samples, strength, inputs;
    compiled), None where not measured; `stages`, all; `pictures`: t → (R^(t), X^(t)) of the stages shown; `prior`: of
    the objective that the model minimises, `SHARED` if that is the one by which all are compared, None for a network;
    `strength`: its λ, None for a network.
    """

    name: str
    status: Status
    seconds_before: float | None
    stages: tuple[StageMeasures, ...]
    pictures: dict[int, tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]]
    prior: str | None = None
    strength: float | None = None

    @property
    def minimises(self) -> str:
        """A clause that names the objective which the model minimises, as the table's columns are called."""
        if self.prior is None:
            return "trained towards true pictures, makes no column small"
        if self.prior == SHARED:
            return "minimises the objective"
        of = "" if self.strength is None else f" and lambda {self.strength:.3g}"
        return f"minimises 'own', with the prior {self.prior}{of}"


@dataclass(frozen=True)
class Hybrid:
    """Optimizer and network started at each other's picture.

    **Fields:**
    - `network`, `optimizer`: their names.
    - `iterations_from_scratch`, `objective_from_scratch`: of the optimizer, to its tolerance, from its own X^(0).
    - `iterations`, `objective`: of the optimizer from the network's X^(T).
    - `stages`: of the network from X*.
    """

    network: str
    optimizer: str
    iterations_from_scratch: int
    objective_from_scratch: float
    iterations: int
    objective: float
    stages: tuple[StageMeasures, ...]


@dataclass(frozen=True)
class Comparison:
    """Models side by side, stage by stage, on one moment of one recording.

    **Fields:** `recording`, `scale`, `key`, `frames` (how many were used); `strength` λ; the optimizer's converged
    solution `reference` X* with its objective, status and iterations; `truth`, where known; `models`; `hybrids`.
    """

    recording: Recording
    scale: int
    key: int
    frames: int
    strength: float
    reference: Float[np.ndarray, "H W"]
    reference_objective: float
    reference_status: Status
    reference_iterations: int
    truth: Float[np.ndarray, "H W"] | None
    models: tuple[ModelStages, ...]
    hybrids: tuple[Hybrid, ...]

    def table(self) -> str:
        """For a reader: a block for each model with the stages shown, then the hybrids."""
        height, width = self.reference.shape
        lines = [
            f"{self.recording.name}: {self.frames} frames of {self.recording.width}x{self.recording.height}, key frame "
            f"{self.key} -> {width}x{height} (x{self.scale}), strength of the prior (lambda) {self.strength:.3g}",
            f"Converged solution of fista-huber: objective {self.reference_objective:.6g} after "
            f"{self.reference_iterations} iterations ({self.reference_status.name.replace('_', ' ')}).",
        ]
        blocks = [one.stages for one in (*self.models, *self.hybrids)]
        columns = [one for one in _COLUMNS if any(math.isfinite(getattr(s, one.field)) for b in blocks for s in b)]
        for model in self.models:
            before = "" if model.seconds_before is None else f"; {model.seconds_before:.2g} s before the first"
            lines += ["", f"{model.name}: {_counted(model.stages)}; {model.minimises}{before}"]
            lines += _rows(model.stages, columns)
        for hybrid in self.hybrids:
            lines += [
                "",
                f"{hybrid.optimizer} started at the last picture of {hybrid.network}: {hybrid.iterations} iterations "
                f"to objective {hybrid.objective:.6g}; at enlarged playback: {hybrid.iterations_from_scratch} to "
                f"{hybrid.objective_from_scratch:.6g}.",
                f"{hybrid.network} started at the converged solution:",
                *_rows(hybrid.stages, columns),
            ]
        lines += ["", 'Columns ("-": the model has none, or it is not known):']
        for one in columns:
            lines += [f"  {one.name:<10}  " + one.meaning.replace("\n", "\n" + 14 * " ")]
        return "\n".join(lines) + "\n"

    def json(self) -> str:
        """All stages of all models; what is not a finite number is null."""
        content = {
            "recording": {
                "name": self.recording.name,
                "frames": self.recording.frames,
                "width": self.recording.width,
                "height": self.recording.height,
            },
            "scale": self.scale,
            "key": self.key,
            "frames": self.frames,
            "strength": self.strength,
            "reference": {
                "objective": self.reference_objective,
                "result": self.reference_status.name,
                "iterations": self.reference_iterations,
            },
            "models": [
                {
                    "name": model.name,
                    "result": model.status.name,
                    "minimises": model.minimises,
                    "strength": model.strength,
                    "seconds_before": model.seconds_before,
                    "shown": list(model.pictures),
                    "stages": [asdict(stage) for stage in model.stages],
                }
                for model in self.models
            ],
            "hybrids": [asdict(hybrid) for hybrid in self.hybrids],
            "versions": versions(),
        }
        return json.dumps(plain(content), indent=1, allow_nan=False, ensure_ascii=False) + "\n"

    def figure(self) -> ShownFigure:
        """A row a model, a column a stage: X^(t), the part where there is most to see; before them the last one whole.

        A last row has the optimizer's converged solution and, where it is known, the truth.
        """
        height, width = self.reference.shape
        top, left, tall, wide = detailed_part(self.reference if self.truth is None else self.truth, scale=self.scale)
        white = max(float(np.percentile(self.reference, 99.7)), 1e-3)
        down = _COLUMN * tall / wide
        first = down * width / height  # as high as the parts beside it
        columns = max(len(model.pictures) for model in self.models)
        columns = max(columns, 1 if self.truth is None else 2)
        page = 2 * _MARGIN + first + columns * (_COLUMN + _GAP)
        each = down + _CAPTION + 2 * _GAP + _CAPTION
        end = 2 * _MARGIN + (len(self.models) + 1) * each
        part = np.s_[top : top + tall, left : left + wide]

        def row(number: int, name: str, whole: np.ndarray, tiles: Sequence[tuple[str, np.ndarray]]) -> None:
            y = _MARGIN + number * each
            drawn.text(_MARGIN / page, 1 - y / end, name, va="top", fontsize=10, fontweight="bold")
            y += 2 * _CAPTION
            axes = _axes(drawn, _MARGIN, y, first, down)
            _tile(axes, whole, white, "whole")
            axes.add_patch(Rectangle((left - 0.5, top - 0.5), wide, tall, fill=False, color=_ACCENT, linewidth=0.8))
            for place, (caption, image) in enumerate(tiles):
                x = _MARGIN + first + _GAP + place * (_COLUMN + _GAP)
                _tile(_axes(drawn, x, y, _COLUMN, down), image[part], white, caption)

        with matplotlib.rc_context({"font.family": "sans-serif", "text.color": "#222222"}):
            drawn = ShownFigure(figsize=(page, end), dpi=120, facecolor="white")
            for number, model in enumerate(self.models):
                tiles = [(self._caption(model.stages[t - 1]), image) for t, (_, image) in model.pictures.items()]
                row(number, model.name, model.pictures[max(model.pictures)][1], tiles)
            ends = [("converged", self.reference)] + ([] if self.truth is None else [("truth", self.truth)])
            row(len(self.models), "To compare with", self.reference if self.truth is None else self.truth, ends)
        return drawn

    def write(self, folder: str | os.PathLike[str]) -> list[Path]:
        """Writes `stages.txt`, `stages.json` and `stages.png` into a folder, which is made if it is not there; returns
        their paths.

        **Raises:** `InputError` if one cannot be written.
        """
        paths = [made_folder(folder) / name for name in FILES]
        with ExitStack() as stack:  # all three, or none
            table, numbers, figure = (stack.enter_context(whole_file(path)) for path in paths)
            table.write_text(self.table(), encoding="utf-8")
            numbers.write_text(self.json(), encoding="utf-8")
            self.figure().savefig(figure)
        return paths

    def _caption(self, stage: StageMeasures) -> str:
        judged = f"objective {stage.objective:.5g}" if self.truth is None else f"{stage.psnr:.2f} dB"
        return f"stage {stage.number}: {judged}"


SHARED = "shared"
"""`ModelStages.prior` of a model that minimises the objective by which all are compared."""
FILES = ("stages.txt", "stages.json", "stages.png")
"""Names of the files that `Comparison.write` writes."""


def shown_stages(count: int, most: int = 6) -> tuple[int, ...]:
    """The stages, of `count`, in the table and the figure: all, or `most` of 1, 2, 4, 8, … and the last."""
    if count <= most:
        return tuple(range(1, count + 1))
    doubled = [2**power for power in range(count.bit_length()) if 2**power <= 0.75 * count] + [count]
    places = np.linspace(0, len(doubled) - 1, min(len(doubled), most)).round().astype(int)
    return tuple(doubled[place] for place in places)


class _Column(NamedTuple):
    """A column of the table: its name, the field of `StageMeasures`, how it is written, its unit, and what it means,
    a line or several."""

    name: str
    field: str
    form: str
    unit: float
    meaning: str


_COLUMNS = (
    _Column("stage", "number", "d", 1.0, "an iteration of an optimizer, or a stage of a network"),
    _Column("objective", "objective", ".6g", 1.0, "data + lambda times Huber total variation; compares all models"),
    _Column("own", "own", ".6g", 1.0, "what the model's iterations minimise: with its own prior and, where "
            "the scene moves during\na measurement, with an approximation of data that is renewed now and then"),
    _Column("data", "data", ".6g", 1.0, "half the weighted sum of squares by which the picture misses measurements"),
    _Column("misfit", "misfit", ".4f", 1.0, "root mean square of these misses, intensity (1 = white)"),
    _Column("distance", "distance", ".4f", 1.0, "of the picture from the converged solution, relative to its norm"),
    _Column("change", "change", ".1e", 1.0, "of the picture by this stage, relative to its norm"),
    _Column("downhill-R", "downhill_r", ".3f", 1.0, "cosine between the stage's gradient step alone and the "
            "steepest descent of data; 1: straight down"),
    _Column("downhill-X", "downhill_x", ".3f", 1.0, "the same of the whole stage, after the step of prior or network"),
    _Column("PSNR", "psnr", ".2f", 1.0, "against the truth, dB, without 8 sensor pixels at the border"),
    _Column("SSIM", "ssim", ".4f", 1.0, "structural similarity to the truth, at most 1, without that border"),
    _Column("seconds", "seconds", ".3g", 1.0, "since the first stage began, compiled"),
    _Column("GFLOP", "flops", ".3g", 1e9, "billions of operations since the first stage began"),
)  # fmt: skip


def _counted(stages: Sequence[StageMeasures]) -> str:
    return f"{len(stages)} stage" + ("" if len(stages) == 1 else "s")


def _rows(stages: Sequence[StageMeasures], columns: Sequence[_Column]) -> list[str]:
    cells = [[one.name for one in columns]]
    for number in shown_stages(len(stages)):
        stage = stages[number - 1]
        values = [(getattr(stage, field), form, unit) for _, field, form, unit, _ in columns]
        cells.append([
            format(value / unit if unit != 1 else value, form) if math.isfinite(value) else "-"
            for value, form, unit in values
        ])  # fmt: skip
    widths = [max(len(row[place]) for row in cells) for place in range(len(columns))]
    return ["  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in cells]


def _axes(drawn: Figure, x: float, y: float, wide: float, tall: float) -> Axes:
    """Axes whose top left corner is at (x, y), in inches from that of the figure."""
    page, end = drawn.get_size_inches()
    return drawn.add_axes((x / page, 1 - (y + tall) / end, wide / page, tall / end))


def _tile(axes: Axes, image: Any, white: float, caption: str) -> None:
    axes.imshow(np.nan_to_num(image), cmap="gray", vmin=0.0, vmax=white, interpolation="nearest", aspect="auto")
    axes.set_axis_off()
    axes.set_title(caption, loc="left", fontsize=8, color=_FAINT, pad=3)
