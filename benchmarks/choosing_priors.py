"""Priors compared for docs/choosing.md, each at the strength that is best for it."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from skimage.metrics import structural_similarity

from benchmarks.choosing_cases import Case, Size, case_of, seconds_of
from scsr_opt import priors, solvers
from scsr_opt.cli.demo_scene import psnr
from scsr_opt.priors.prior import Prior
from scsr_opt.solvers import Problem, Solver, run


class Best(NamedTuple):
    """The picture at the strength of the highest PSNR; `psnr` in dB."""

    strength: float
    psnr: float
    ssim: float
    image: Float[np.ndarray, "H W"]


def tried() -> list[tuple[str, Prior, float, Solver]]:
    """The rows of the table of priors: each with a strength to begin with, relative to that of total variation, and
    the solver; what denoises on the host is stopped by number."""
    tv, few = priors.TotalVariation(), solvers.FISTA(iterations=15)
    fista = solvers.FISTA(iterations=60, tolerance=3e-4)
    alike = priors.nl_means()
    return [
        ("TV", tv, 1, fista),
        ("TV, anisotropic", priors.TotalVariation(isotropic=False), 1, fista),
        ("TV, bounded 0 … 1", priors.Bounded(tv, 0, 1), 1, fista),
        ("Huber-TV", priors.HuberTotalVariation(), 1, fista),
        ("ridge", priors.RidgeRegulariser.load(), 1, fista),
        ("TGV", priors.TotalGeneralizedVariation(), 1, fista),
        ("bilateral TV", priors.BilateralTotalVariation(), 0.25, fista),
        ("wavelet L1", priors.WaveletL1(), 4, fista),
        ("RED, NLM", priors.RED(alike), 128, few),
        ("plug-and-play, NLM", priors.PlugAndPlay(alike), 0.1, few),
        ("plug-and-play, bilateral", priors.PlugAndPlay(priors.bilateral()), 0.006, few),
    ]


def best(case: Case, prior: Prior, strength: float, solver: Solver | None = None) -> Best:
    """From `strength`, by factors of 2 for as long as the PSNR grows."""
    solver = solvers.FISTA(tolerance=3e-4) if solver is None else solver

    def at(strength: float) -> Best:
        image = run(solver, Problem(case.term, prior, jnp.asarray(strength, jnp.float32)), case.start).image
        border = 8 * case.scale
        inner = (slice(border, -border),) * 2
        likeness: Any = structural_similarity(case.truth[inner], np.clip(image, 0, 1)[inner], data_range=1.0)
        return Best(strength, psnr(case.truth, image, border), float(likeness), image)

    top = at(strength)
    for factor in (2.0, 0.5):
        begun = top.strength
        while (next_one := at(top.strength * factor)).psnr > top.psnr:
            top = next_one
        if top.strength != begun:
            break
    return top


def compare(size: Size, rounds: int) -> tuple[dict[str, Any], dict[str, Float[np.ndarray, "H W"]]]:
    """All priors on all recordings; and the pictures of the first still at ×4."""
    rows: dict[str, Any] = {name: {"scores": {}, "seconds": []} for name, *_ in tried()}
    shown: dict[str, Float[np.ndarray, "H W"]] = {}
    for scale, light in size.conditions:
        for picture in size.pictures:
            case = case_of(picture, scale=scale, sensor=size.side // scale, light=light)
            found = {name: best(case, prior, factor * case.strength, solver) for name, prior, factor, solver in tried()}
            for name, one in found.items():
                rows[name]["scores"][f"×{scale}, {light}, {picture}"] = {
                    "psnr": one.psnr, "ssim": one.ssim, "strength": one.strength / case.strength
                }  # fmt: skip
            if scale == size.conditions[-1][0] and not shown:
                labelled = {f"{name} {one.psnr:.2f}": one.image for name, one in found.items()}
                shown = {"enlarged": np.asarray(case.start), "truth": case.truth} | labelled
                for _ in range(rounds):
                    for name, prior, factor, solver in tried():
                        problem = Problem(case.term, prior, jnp.asarray(factor * case.strength, jnp.float32))
                        rows[name]["seconds"].append(seconds_of(solver, problem, case.start, 20) / 20)
    return rows, shown
