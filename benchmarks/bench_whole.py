"""Whole reconstructions: time against accuracy, for `reconstruct` and its variants, learned models and baselines."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from benchmarks.bench_cases import Size, quality, recorded, recording_of
from benchmarks.bench_timing import Peak, in_turns, ratios
from benchmarks.ladder import USUAL
from learned.zoo import Network, model, names
from scsr_opt import priors, reconstruct, solvers
from scsr_opt.baselines import BASELINES
from scsr_opt.camera.recording import Recording
from scsr_opt.camera.sampling_rules import Windows
from scsr_opt.motion import Dense, Global, Still
from scsr_opt.pipeline.defaults import default_prior
from scsr_opt.progress import Progress

DEFAULT = "reconstruct"
AGAIN, TWICE = "reconstruct, again", "default again"
"""The default measured a second time, as if it were another method, and its kind: how far two times of the same lie
apart."""


class Method(NamedTuple):
    """**Fields:** `kind`: "default", "variant", "learned" or "baseline"; `picture(recording)` (H, W)."""

    name: str
    kind: str
    picture: Callable[[Recording], Any]


def methods(scale: int, chosen: tuple[str, ...] | None = None) -> list[Method]:
    """All that makes a picture of a recording at this scale, or those of the names."""
    same = USUAL[type(default_prior(scale))]

    def variant(name: str, **options: Any) -> Method:
        def picture(recording: Recording) -> Any:
            return reconstruct(recording, scale=scale, **options).image

        return Method(name, "variant", picture)

    def learned(name: str) -> Method:
        found = model(name, scale)
        if isinstance(found, Network):
            # Its stages are not measured: that would take several times as long as the network.
            return Method(name, "learned", lambda recording: found(recording, scale=scale, record=False).image)
        return Method(name, "learned", lambda recording: found(recording, scale=scale).image)

    def baseline(name: str) -> Method:
        return Method(name, "baseline", lambda recording: BASELINES[name](recording, scale=scale))

    found = [
        variant(DEFAULT)._replace(kind="default"),
        variant(AGAIN)._replace(kind=TWICE),
        variant("reconstruct, Still motion", velocity=Still()),
        variant("reconstruct, Global motion", velocity=Global()),
        variant("reconstruct, Dense motion", velocity=Dense()),
        variant("reconstruct, refine=1", refine=1),
        variant("reconstruct, windows of 8 frames", samples=Windows(8)),
        variant("reconstruct, gain None", gain=None),
        variant("reconstruct, nothing skipped", skip=False),
        variant("reconstruct, LBFGS", solver=solvers.LBFGS()),
        variant("reconstruct, ADMM", solver=solvers.ADMM()),
        variant("reconstruct, TGV", prior=priors.TotalGeneralizedVariation()),
        *(learned(name) for name in names(scale) if name != same),
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
    """Is one row's method at least as accurate and as fast as another's, and better in one of both, as far as was
    measured? Mean PSNR counts to 0.01 dB. Times are compared round by round, of the same recording: as fast is what
    took no longer in half of them, faster what took less in three quarters, by more than `chance` makes of the same."""
    own, others = (round(float(np.mean(row["psnr"])), 2) for row in (one, other))
    over = ratios(one["seconds"], other["seconds"])
    return (own >= others and over.high < by_chance) or (own > others and over.middle <= 1)


def front(rows: list[dict[str, Any]]) -> list[bool]:
    """For each row: whether no other `beats` it."""
    by_chance, others = chance(rows), [row for row in rows if row["kind"] != TWICE]
    return [not any(beats(other, row, by_chance) for other in others if other is not row) for row in rows]


def measure(size: Size, seed: int, progress: Progress) -> dict[str, list[dict[str, Any]]]:
    """For each scale and light ("×2, day") a row for each method, ready for JSON: `psnr` (dB) and `ssim` of each
    recording, `seconds` of each round of each recording, the `peak` of memory that one call adds (bytes),
    `front`."""
    found: dict[str, list[dict[str, Any]]] = {}
    peak = Peak()
    for scale in size.scales:
        chosen = methods(scale, size.methods)
        each = len(size.recordings) * len(size.lights)
        progress.start(len(chosen) * each, f"whole reconstructions, ×{scale}")
        try:
            for light in size.lights:
                found[f"×{scale}, {light}"] = rows = [_row(one) for one in chosen]
                for picture, motion in size.recordings:
                    made = recorded(picture, scale=scale, sensor=size.sensor, motion=motion, light=light, seed=seed)
                    truth, recording, calls = made.truth(len(made.spikes) // 2), recording_of(made), {}
                    for number, (row, one) in enumerate(zip(rows, chosen, strict=True)):
                        ratio, likeness = quality(truth, one.picture(recording), scale)  # compiles, too
                        row["recordings"].append(f"{picture}, {motion}")
                        row["psnr"].append(ratio)
                        row["ssim"].append(likeness)
                        calls[number] = lambda one=one, recording=recording: np.asarray(one.picture(recording))
                        if row["peak"] is None:
                            peak.reset()
                            calls[number]()
                            row["peak"] = peak.read()
                        progress.advance(1)
                    for number, seconds in in_turns(calls, size.repeats).items():
                        rows[number]["seconds"].append(seconds)
                for row, on_it in zip(rows, front(rows), strict=True):
                    row["front"] = on_it
        finally:
            progress.finish()
    return found


def _row(of: Method) -> dict[str, Any]:
    return {
        "method": of.name, "kind": of.kind, "recordings": [], "psnr": [], "ssim": [], "seconds": [], "peak": None,
    }  # fmt: skip
