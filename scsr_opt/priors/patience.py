"""More inner iterations, for a proximal step that starts anew and not from the state of the last one."""

import dataclasses

from scsr_opt.priors.bounded import Bounded
from scsr_opt.priors.prior import Prior


def patient(prior: Prior, iterations: int) -> Prior:
    """The prior with at least so many inner iterations, or what is enough for it; as it is if it has none."""
    if isinstance(prior, Bounded):
        return dataclasses.replace(prior, prior=patient(prior.prior, iterations))
    iterations = min(iterations, prior.enough or iterations)
    given = getattr(prior, "iterations", None)
    if isinstance(given, int) and given < iterations:
        return dataclasses.replace(prior, iterations=iterations)
    return prior
