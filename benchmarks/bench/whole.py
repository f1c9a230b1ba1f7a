"""Whole reconstructions: time against accuracy, for `reconstruct` and its variants, learned models and baselines."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.bench.size import Size
from benchmarks.recordings import quality, recorded, recording_of
from benchmarks.timing import Peak, in_turns, ratios
from learned.zoo import Network, model, names
from scsr_opt import Shortcuts, priors, reconstruct, solvers
from scsr_opt.baselines import BASELINES
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.sampling_rules import Windows
from scsr_opt.camera.simulator import Simulation
from scsr_opt.motion import Dense, Global, Still
from scsr_opt.pipeline.defaults import default_prior
from scsr_opt.priors import HuberTotalVariation, RidgeRegulariser

DEFAULT = "reconstruct"
AGAIN, TWICE = "reconstruct, again", "default again"
"""The default measured a second time, as if it were another method, and its kind: how far two times of the same lie
apart."""


class Method(NamedTuple):
    """**Fields:** `kind`: "default", "variant", "learned" or "baseline"; `picture(recording)` (H, W)."""

    name: str
    kind: str
    picture: Callable[[Recording], Any]


# The model that is `reconstruct` by its defaults, by the default prior of a scale.
_DEFAULT_MODEL = {RidgeRegulariser: "ridge", HuberTotalVariation: "fista-huber"}


def default_model(scale: int) -> str:
    """The name of the learned model that is `reconstruct` by its defaults."""
    return _DEFAULT_MODEL[type(default_prior(scale))]


def picture_by_model(name: str, scale: int) -> Callable[[Recording], Any]:
    """The picture of a recording by a learned model; without the record of its stages, which takes several times as
    long as a network."""
    found = model(name, scale)
    options: dict[str, Any] = {"record": False} if isinstance(found, Network) else {}
    return lambda recording: found(recording, scale=scale, **options).image


def methods(scale: int, chosen: tuple[str, ...] | None = None) -> list[Method]:
    """All methods that make a picture of a recording at this scale, or those of the names."""

    def variant(name: str, kind: str = "variant", **options: Any) -> Method:
        return Method(name, kind, lambda recording: reconstruct(recording, scale=scale, **options).image)

    def baseline(name: str) -> Method:
        return Method(name, "baseline", lambda recording: BASELINES[name](recording, scale=scale))

    learned = [name for name in names(scale) if name != default_model(scale)]
    found = [
        variant(DEFAULT, "default"),
        variant(AGAIN, TWICE),
        variant("reconstruct, Still motion", motion=Still()),
        variant("reconstruct, Global motion", motion=Global()),
        variant("reconstruct, Dense motion", motion=Dense()),
        variant("reconstruct, refine=1", refine=1),
        variant("reconstruct, windows of 8 frames", samples=Windows(8)),
        variant("reconstruct, gain None", gain=None),
        variant("reconstruct, nothing skipped", shortcuts=Shortcuts.none()),
        variant("reconstruct, LBFGS", solver=solvers.LBFGS()),
        variant("reconstruct, ADMM", solver=solvers.ADMM()),
        variant("reconstruct, TGV", prior=priors.TotalGeneralizedVariation()),
        *(Method(name, "learned", picture_by_model(name, scale)) for name in learned),
        *(baseline(name) for name in BASELINES),
    ]
    return [one for one in found if chosen is None or one.name in chosen]


def chance(rows: list[dict[str, Any]]) -> float:
    """The ratio of two times that may be chance: of the default's second times over its first ones, round by round, the
    quartile farther from 1, as a ratio below 1; 1 where it was not measured twice."""
    seconds = {row["kind"]: row["seconds"] for row in rows}
    if TWICE not in seconds:
        return 1.0
    over = ratios(seconds[TWICE], seconds["default"])
    return min(over.low, 1 / over.high, 1.0)


def beats(one: dict[str, Any], other: dict[str, Any], by_chance: float = 1.0) -> bool:
    """True if one row's method is at least as accurate and as fast as another's, and better in one of both, as far as
    was measured. Mean PSNR counts to 0.01 dB. Times are compared round by round, of the same recording: as fast is what
    took no longer in half of them, faster what took less in three quarters, by more than `chance` makes of the same."""
    own, others = (round(float(np.mean(row["psnr"])), 2) for row in (one, other))
    over = ratios(one["seconds"], other["seconds"])
    return (own >= others and over.high < by_chance) or (own > others and over.middle <= 1)


def front(rows: list[dict[str, Any]]) -> list[bool]:
    """Marks the rows that no other `beats`."""
    by_chance, others = chance(rows), [row for row in rows if row["kind"] != TWICE]
    return [not any(beats(other, row, by_chance) for other in others if other is not row) for row in rows]


def measure(size: Size, seed: int, advance: Callable[[int], None]) -> dict[str, list[dict[str, Any]]]:
    """Rows by scale and light ("×2, day"), one for each method, ready for JSON: `psnr` (dB) and `ssim` of each
    recording, `seconds` of each round of each recording, the `peak` of memory that one call adds (bytes),
    `front`."""
    found: dict[str, list[dict[str, Any]]] = {}
    for scale in size.scales:
        chosen = methods(scale, size.methods)
        for light in size.lights:
            found[f"×{scale}, {light}"] = rows = [
                {"method": one.name, "kind": one.kind, "recordings": [], "psnr": [], "ssim": [], "seconds": [],
                 "peak": None}
                for one in chosen
            ]  # fmt: skip
            for still, motion in size.recordings:
                made = recorded(still, scale=scale, sensor=size.sensor, motion=motion, light=light, seed=seed)
                _add_recording(rows, chosen, f"{still}, {motion}", made, size.repeats)
                advance(1)
            for row, on_it in zip(rows, front(rows), strict=True):
                row["front"] = on_it
    return found


def _add_recording(rows: list[dict[str, Any]], chosen: list[Method], name: str, made: Simulation, repeats: int) -> None:
    """Puts what each method makes of a recording, and its seconds in turns, into the row of the method."""
    truth, recording, peak = made.truth(len(made.spikes) // 2), recording_of(made), Peak()
    calls = {
        number: lambda one=one, recording=recording: np.asarray(one.picture(recording))
        for number, one in enumerate(chosen)
    }
    for number, row in enumerate(rows):
        psnr, ssim = quality(truth, calls[number](), made.scale)  # compiles, too
        row["recordings"].append(name)
        row["psnr"].append(psnr)
        row["ssim"].append(ssim)
        if row["peak"] is None:
            peak.reset()
            calls[number]()
            row["peak"] = peak.read()
    for number, seconds in in_turns(calls, repeats).items():
        rows[number]["seconds"].append(seconds)
