"""Solvers and priors by name, for `benchmarks.bench` and `benchmarks.stress`."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from scsr_opt import priors, solvers
from scsr_opt.priors import Prior
from scsr_opt.solvers import Solver


def weighted_mean(image: Float[Array, "H W"], sigma: Float[Array, ""]) -> Float[Array, "H W"]:
    """A denoiser in JAX, symmetric and non-expansive: between each pixel and the mean of its neighbours, by σ²."""
    wide = jnp.pad(image, 1, mode="edge")
    around = (wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:]) / 4
    share = sigma**2 / (sigma**2 + jnp.asarray(0.01, sigma.dtype))
    return image + 0.5 * share * (around - image)


SOLVERS: dict[str, Solver] = {
    "ISTA": solvers.ISTA(),
    "FISTA": solvers.FISTA(),
    "FISTA, norm bound": solvers.FISTA(step_size=solvers.NormBound()),
    "FISTA, backtracking": solvers.FISTA(step_size=solvers.Backtracking()),
    "FISTA, spectral norm": solvers.FISTA(step_size=solvers.SpectralNorm()),
    "FISTA, duality gap": solvers.FISTA(stopping=solvers.DualityGap()),
    "ADMM": solvers.ADMM(),
    "CondatVu": solvers.CondatVu(),
    "CondatVu, balance 0.01": solvers.CondatVu(balance=solvers.Balance(0.01)),
    "CondatVu, balance 100": solvers.CondatVu(balance=solvers.Balance(100)),
    "ChambollePock": solvers.ChambollePock(),
    "ChambollePock, balance 0.01": solvers.ChambollePock(balance=solvers.Balance(0.01)),
    "ChambollePock, balance 100": solvers.ChambollePock(balance=solvers.Balance(100)),
    "JaxoptISTA": solvers.JaxoptISTA(),
    "JaxoptFISTA": solvers.JaxoptFISTA(),
    "JaxoptADMM": solvers.JaxoptADMM(),
    "NonlinearCG": solvers.NonlinearCG(),
    "LBFGS": solvers.LBFGS(),
}
SMOOTH = ("NonlinearCG", "LBFGS")
# Whose β may be above its bound; the others' steps follow from what bounds them.
BOUNDED_STEPS = ("ISTA", "FISTA")
PRIORS: dict[str, Prior] = {
    "TV": priors.TotalVariation(),
    "anisotropic TV": priors.TotalVariation(isotropic=False),
    "Huber-TV": priors.HuberTotalVariation(),
    "ridge": priors.RidgeRegulariser.load(),
    "bilateral TV": priors.BilateralTotalVariation(),
    "wavelet": priors.WaveletL1(),
    "bounded TV": priors.Bounded(priors.TotalVariation(), 0, 1),
    "TGV": priors.TotalGeneralizedVariation(),
    "bounded TGV": priors.Bounded(priors.TotalGeneralizedVariation(iterations=10), 0, 1),
    "plug-and-play": priors.PlugAndPlay(weighted_mean),
    "RED": priors.RED(weighted_mean),
    "plug-and-play, NLM": priors.PlugAndPlay(priors.nl_means()),
}
ANALYSIS = ("TV", "anisotropic TV", "Huber-TV", "bilateral TV", "wavelet")
# Denoised on the host, a millisecond or more a time.
SLOW = ("plug-and-play, NLM",)
