"""More inner iterations, for a proximal step that starts anew and not from the state of the last one."""

import dataclasses

from scsr_opt.priors.bounded import Bounded
from scsr_opt.priors.prior import Prior


def patient(prior: Prior, iterations: int) -> Prior:
    """The prior with at least so many inner iterations; as it is if its proximal step has none."""
    if isinstance(prior, Bounded):
        return dataclasses.replace(prior, prior=patient(prior.prior, iterations))
    given = getattr(prior, "iterations", None)
    if isinstance(given, int) and given < iterations:
        return dataclasses.replace(prior, iterations=iterations)
    return prior
