"""Change of PSNR and time when a number of `PipelineSettings` is half as large, and half as large again.

    python -m benchmarks.sensitivity [--fields 'motion.*'] [--recordings 10] [--rounds 3] [--json FILE] [--data FOLDER]

Recordings are simulated from training pictures: five scenes (static, translate, affine, object, fan) by day and in dim
light, 64×80 sensor pixels, ×2. For each numeric field `reconstruct` runs with the setting unchanged, at −50 % and at
+50 % (whole numbers rounded, all numbers of a tuple at once), in turns after a first run of each that compiles.

The table gives for both directions the change of PSNR (mean over the recordings, and the worst) and the ratio of the
seconds to the unchanged ones. Candidates to delete, derive or merge stand below: they change the PSNR of no recording
by more than 0.02 dB, and the time by no more than 2 %. With `--json` a second call measures only what is missing.
"""

import argparse
import dataclasses
import itertools
import json
import math
import os
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path
from statistics import mean, median
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from benchmarks.command import finite, machine, table
from benchmarks.recordings import LIGHTS, SCENES, quality
from benchmarks.timing import in_turns
from scsr_opt import Recording, reconstruct
from scsr_opt._files import whole_file
from scsr_opt._settings import Settings
from scsr_opt.camera.simulator import simulate
from scsr_opt.errors import InputError
from scsr_opt.pipeline.settings import PipelineSettings
from scsr_opt.report.pictures import read_picture

SCALE, SENSOR, FRAMES, SEED = 2, (64, 80), 101, 5
FACTORS = {"-50 %": 0.5, "+50 %": 1.5}
LEAST_DECIBELS, LEAST_TIME = 0.02, 0.02  # a candidate changes neither PSNR (dB) nor time (share) by more than this


class Case(NamedTuple):
    """A recording and the true picture of its key frame."""

    name: str
    recording: Recording
    truth: Float[np.ndarray, "H W"]


def cases(folder: Path, number: int) -> list[Case]:
    """`number` recordings, each of other pictures: all scenes by day, then all in dim light, and so on.

    **Raises:** `InputError` if the folder does not hold enough pictures.
    """
    files = sorted(folder.glob("*.png")) if folder.is_dir() else []
    if number < 1 or len(files) < 2 * number:
        raise InputError(
            f"{folder} holds {len(files)} PNG pictures, of which {number} recordings take {2 * number}: name a folder "
            f"of training pictures by --data (or SCSR_SHARED_DATA), or a smaller number of at least 1."
        )
    height, width = (SCALE * side for side in SENSOR)
    found = []
    files = files[:: len(files) // (2 * number)]  # of all kinds
    for n, (light, kind) in zip(range(number), itertools.cycle(itertools.product(LIGHTS, SCENES)), strict=False):
        still, texture = (read_picture(file) for file in files[2 * n : 2 * n + 2])
        scene = SCENES[kind](still[:height, :width], texture[: height // 2, : height // 2])
        made = simulate(scene, scale=SCALE, frames=FRAMES, sensor=LIGHTS[light], seed=SEED + n)
        recording = Recording.from_array(made.spikes, white_rate=made.white_rate)
        found.append(Case(f"{kind}, {light}, {files[2 * n].stem}", recording, made.truth(FRAMES // 2)))
    return found


def numbers(settings: Settings, above: str = "") -> dict[str, Any]:
    """Each number, or tuple of numbers, of nested settings by its dotted name (`motion.dense.radius`)."""
    found: dict[str, Any] = {}
    for one in dataclasses.fields(settings):
        value = getattr(settings, one.name)
        found |= numbers(value, f"{above}{one.name}.") if isinstance(value, Settings) else {above + one.name: value}
    return found


def scaled(value: Any, factor: float) -> Any:
    """`value` times `factor`; whole numbers are rounded, halves up, so that 1 does not become 0."""
    if isinstance(value, tuple):
        return tuple(scaled(one, factor) for one in value)
    return math.floor(value * factor + 0.5) if isinstance(value, int) else value * factor


def changed(settings: Any, name: str, value: Any) -> Any:
    """`settings` with another value of the field of this dotted name."""
    first, _, rest = name.partition(".")
    return dataclasses.replace(settings, **{first: changed(getattr(settings, first), rest, value) if rest else value})


def measured(
    field: str, made: list[Case], rounds: int, usual: Settings, solve: Callable[..., Any] = reconstruct
) -> dict[str, Any]:
    """A row of the result, ready for JSON.

    **Arguments:** `usual`: the settings of which `field` is changed. `solve`: called as `reconstruct`, with `settings`.
    **Returns:** `value`, and for each of `FACTORS` the new `value` with `psnr` (change in dB) and `time` (ratio) of
    each recording, or with `failed`, the reason why there are none.
    """
    value = numbers(usual)[field]
    row: dict[str, Any] = {"value": value}
    for name, factor in FACTORS.items():
        new = scaled(value, factor)
        row[name] = {"value": new, "psnr": [], "time": []} | ({"failed": "the same value"} if new == value else {})
    for case in made:

        def picture(name: str | None, case: Case = case) -> Any:
            settings = usual if name is None else changed(usual, field, row[name]["value"])
            return solve(case.recording, scale=SCALE, settings=settings).image

        ways = [name for name in FACTORS if "failed" not in row[name]]
        before, calls = quality(case.truth, picture(None), SCALE)[0], dict[Any, Any]({None: lambda: picture(None)})
        for name in ways:
            try:
                row[name]["psnr"].append(quality(case.truth, picture(name), SCALE)[0] - before)
                calls[name] = lambda name=name: picture(name)
            except Exception as error:  # a threshold that far from its default may be refused, or lead to anything
                row[name]["failed"] = f"{case.name}: {type(error).__name__}: {error}"
        seconds = {name: median(taken) for name, taken in in_turns(calls, rounds).items()}
        for name in set(calls) - {None}:
            row[name]["time"].append(seconds[name] / seconds[None])
    return row


def candidate(row: dict[str, Any]) -> bool:
    """True if a field changes neither PSNR nor time in the directions that could be measured."""
    moved = [row[name] for name in FACTORS if "failed" not in row[name]]
    return bool(moved) and all(
        max(map(abs, one["psnr"])) <= LEAST_DECIBELS and abs(mean(one["time"]) - 1) <= LEAST_TIME for one in moved
    )


def page(rows: dict[str, dict[str, Any]]) -> str:
    """The table, the candidates, and the directions that could not be measured."""
    head = ["field", "value", *(f"{way}: {what}" for way in FACTORS for what in ("mean, dB", "worst, dB", "time"))]
    lines, same, failed = [], [], []
    for name, row in rows.items():
        line, good = [f"`{name}`", str(row["value"])], [row[way] for way in FACTORS if "failed" not in row[way]]
        for way in FACTORS:
            psnr, time, shown = row[way]["psnr"], row[way]["time"], row[way] in good
            line += [f"{mean(psnr):+.3f}", f"{min(psnr):+.3f}", f"{mean(time):.3f}"] if shown else ["–"] * 3
            failed += [] if shown else [f"- `{name}`, {way} ({row[way]['value']}): {row[way]['failed']}"]
        lines.append(line)
        if candidate(row):
            equal = not any(change for one in good for change in one["psnr"])
            same.append(f"- `{name}`" + (", no picture changes at all" if equal else ""))
    parts = [table(head, lines), "Candidates to delete, derive or merge:", "\n".join(same or ["- none"])]
    return "\n\n".join(parts + (["Not measured:", "\n".join(failed)] if failed else []))


def main() -> None:
    data = os.environ.get("SCSR_SHARED_DATA", Path(__file__).parents[2] / "shared" / "data")
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fields", default="*", help="glob of the fields' dotted names")
    parser.add_argument("--recordings", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=3, help="turns that are timed, at least 1")
    parser.add_argument("--json", type=Path, help="file to keep results in and to resume from")
    parser.add_argument("--data", type=Path, default=Path(data) / "train", help="folder of PNG pictures")
    chosen = parser.parse_args()
    usual = PipelineSettings()
    known = {name: value for name, value in numbers(usual).items() if fnmatch(name, chosen.fields)}
    try:
        made = cases(chosen.data, chosen.recordings)
        kept = json.loads(chosen.json.read_text(encoding="utf-8")) if chosen.json and chosen.json.exists() else {}
    except (InputError, ValueError) as error:
        parser.error(str(error))
    recordings = [case.name for case in made]
    rows: dict[str, Any] = kept.get("fields", {}) if kept.get("recordings") == recordings else {}
    for number, (field, value) in enumerate(known.items(), 1):
        if rows.get(field, {}).get("value") != finite(value):
            print(f"[{number}/{len(known)}] {field} = {value}", flush=True)
            rows[field] = finite(measured(field, made, max(chosen.rounds, 1), usual))
            found = {"about": machine(), "recordings": recordings, "fields": rows}
            if chosen.json:
                with whole_file(chosen.json) as temporary:
                    temporary.write_text(json.dumps(found, indent=1), encoding="utf-8")
    print(page({field: rows[field] for field in known}))


if __name__ == "__main__":
    main()
