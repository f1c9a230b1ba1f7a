"""More inner iterations, for a proximal step that starts anew and not from the state of the last one."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp

from scsr_opt.priors.bounded import Bounded
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.ridge_regulariser import RidgeRegulariser

# What is left of the distance to the optimum where a prior is told of an accuracy, not of a number.
_LEFT = 1e-6


def patient(prior: Prior, iterations: int) -> Prior:
    """The prior with at least so many inner iterations, or an accurate one; as it is if its proximal step has none."""
    if isinstance(prior, Bounded):
        return dataclasses.replace(prior, prior=patient(prior.prior, iterations))
    if isinstance(prior, RidgeRegulariser):
        return eqx.tree_at(lambda ridge: ridge.accuracy, prior, jnp.full_like(prior.accuracy, _LEFT))
    given = getattr(prior, "iterations", None)
    if isinstance(given, int) and given < iterations:
        return dataclasses.replace(prior, iterations=iterations)
    return prior
