"""The iteration of `scsr_opt` unrolled: its explicit operators, learned step sizes and weights, and a small network in
the place of the proximal step.

Stage t of T is Eq. 5 of the paper, with momentum,

    R^(t) = Z − β_t ∇f_t(Z),    X^(t) = N_t(R^(t)),    Z = X^(t−1) + γ_t (X^(t−1) − X^(t−2)),

with f the data term of Eq. 4 in sampled form (`scsr_opt.operators.sampling`). Learned are β_t = b_t / L (b_t > 0 starts
at 1, L is a certain bound on the Lipschitz constant of ∇f); the momentum γ_t, which starts as FISTA's (γ_1 = 0); how
much samples from long before or after the key frame count in f_t, whose motion is known less well; and N_t. With
b_t = 1, γ_t = 0, weights of 1 and the proximal step of a prior as N_t this is ISTA of `scsr_opt` to the last bit;
trained, it is that in a few stages (Gregor and LeCun, 2010, "Learning fast approximations of sparse coding").
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from learned.networks.inputs import Inputs
from learned.networks.layers import ResidualBlocks, check_sizes, convolution, fold, leaky, unfold
from learned.networks.spikesr import Iterates
from scsr_opt.errors import InputError
from scsr_opt.operators.data_term import DataTerm
from scsr_opt.priors.prior import Prior


@dataclasses.dataclass(frozen=True)
class UnrolledConfig:
    """All sizes of an `UnrolledISTA`.

    **Fields:**
    - `scale`: s ≥ 1.
    - `stages`: T ≥ 1.
    - `channels`, `blocks`: features and residual blocks of each stage's network.
    - `folding`: a block of `folding` × `folding` pixels becomes channels of one; a divisor of `scale`, so that the
      picture of any sensor can be folded.
    - `boundaries`: frames from the key frame, rising, at which groups of samples with a weight of their own begin.
    - `proximal`: False leaves the networks out, X^(t) = R^(t).
    - `fill`: weight of the picture so far beside that of a sample (1) in `Context.gathered`; it fills unseen pixels.
    - `noise_scale`: factor on the noise, 0.01 by day, that brings it to the order of a network's other inputs.

    **Raises:** `InputError` for a value that is not allowed, with the name of its field.
    """

    scale: int = 2
    stages: int = 8
    channels: int = 32
    blocks: int = 1
    folding: int = 2
    boundaries: tuple[int, ...] = (12, 30)
    proximal: bool = True
    fill: float = 1e-3
    noise_scale: float = 20.0

    def __post_init__(self):
        check_sizes(self, scale=1, stages=1, channels=1, blocks=0, folding=1)
        if self.scale % self.folding:
            raise InputError(f"folding is {self.folding}; it must divide the scale, {self.scale}.")
        if any(later <= earlier for earlier, later in zip((0, *self.boundaries), self.boundaries, strict=False)):
            raise InputError(f"boundaries is {self.boundaries}; they must be above 0, each above the one before it.")


class Context(NamedTuple):
    """Inputs of a stage's network beside R^(t).

    **Fields:**
    - `first`: X^(0); it used fewer frames than the data term, and no motion that could be wrong.
    - `before`: Z, where the gradient step began.
    - `gathered`: the samples' mean c / M1 on the grid of U = B X, where there are none filled from the picture so far.
    - `coverage`: M1, the weight of the samples there, times s²: 1 in the mean if all are seen.
    - `noise`: standard deviation of a pixel's mean over the recording.
    - `step_size`: β_t.
    """

    first: Float[Array, "H W"]
    before: Float[Array, "H W"]
    gathered: Float[Array, "H W"]
    coverage: Float[Array, "H W"]
    noise: Float[Array, ""]
    step_size: Float[Array, ""]


Network = Callable[[Float[Array, "H W"], Context], Float[Array, "H W"]]
"""N_t: R^(t) and what else is known to X^(t). Any module of this face can be put into an `UnrolledISTA`."""


def identity(image: Float[Array, "H W"], context: Context) -> Float[Array, "H W"]:
    """N_t of a stage without one."""
    return image


class ProxOf(eqx.Module):
    """The proximal step of a prior Ψ in the place of a network, argmin ½‖X − R‖² + β_t λ Ψ(X): ISTA's stage.

    **Fields:** `prior` Ψ, `strength` λ.
    """

    prior: Prior
    strength: Float[Array, ""]

    def __call__(self, image: Float[Array, "H W"], context: Context) -> Float[Array, "H W"]:
        return self.prior.prox(image, context.step_size * self.strength, self.prior.initial_state(image))[0]


class ProximalNetwork(eqx.Module):
    """N_t: R^(t) plus what a convolution, residual blocks and a convolution make of it and of its context.

    All pictures are folded, so that the convolutions are cheap and see far. It starts near the identity.
    """

    entry: eqx.nn.Conv2d
    body: ResidualBlocks
    output: eqx.nn.Conv2d
    config: UnrolledConfig = eqx.field(static=True)

    def __init__(self, config: UnrolledConfig, *, key: PRNGKeyArray):
        entry, body, output = jax.random.split(key, 3)
        pixels = config.folding**2
        self.entry = convolution(5 * pixels + 1, config.channels, key=entry)  # five pictures and the noise
        self.body = ResidualBlocks(config.channels, config.blocks, key=body)
        self.output = convolution(config.channels, pixels, shrink=0.1, key=output)
        self.config = config

    def __call__(self, image: Float[Array, "H W"], context: Context) -> Float[Array, "H W"]:
        pictures = (
            image,
            image - context.before,
            context.first - image,
            context.gathered - image,
            context.coverage / (1 + context.coverage),
        )
        folded = fold(jnp.stack(pictures), self.config.folding)
        noise = jnp.full_like(folded[:1], self.config.noise_scale) * context.noise
        known = jnp.concatenate([folded, noise]).astype(self.entry.weight.dtype)
        change = self.output(leaky(self.body(leaky(self.entry(known)))))
        return image + unfold(change, self.config.folding)[0].astype(image.dtype)


class UnrolledISTA(eqx.Module):
    """T stages of ISTA with learned step sizes, weights of samples, and networks as proximal steps.

    `net(inputs)` gives the `Iterates`; the inputs are made by `learned.networks.inputs.make_inputs`, with the
    boundaries of the configuration.

    **Arguments:**
    - `config`: the sizes.
    - `key`: of the random first weights.
    """

    networks: tuple[Network, ...]
    log_factors: Float[Array, " stages"]
    """ln b_t, β_t = b_t / L."""
    momenta: Float[Array, " later"]
    """γ_t of all stages but the first, which has none."""
    log_weights: Float[Array, "stages groups"]
    """ln of the weight of the samples in each group but the first, whose weight is 1: one for all is β_t's already."""
    config: UnrolledConfig = eqx.field(static=True)

    def __init__(self, config: UnrolledConfig, *, key: PRNGKeyArray):
        keys = jax.random.split(key, config.stages)
        self.networks = tuple(ProximalNetwork(config, key=k) if config.proximal else identity for k in keys)
        self.log_factors = jnp.zeros(config.stages)
        self.momenta = jnp.asarray(_momenta(config.stages), jnp.float32)
        self.log_weights = jnp.zeros((config.stages, len(config.boundaries)))
        self.config = config

    def __call__(self, inputs: Inputs, start: Float[Array, "H W"] | None = None) -> Iterates:
        """R^(t) and X^(t) of all stages.

        **Arguments:** `start`: X^(0), if it is to be another picture than that of the inputs.

        **Raises:** `InputError` if the inputs were made with other groups, or `start` has another shape.
        """
        groups, wanted = inputs.planes.shape[0] + 1, len(self.config.boundaries) + 1
        if groups != wanted:
            raise InputError(
                f"The inputs have their samples in {groups} groups, but this network has weights for {wanted}: make "
                f"them with its config.boundaries, {self.config.boundaries}."
            )
        image = inputs.image if start is None else start
        if image.shape != inputs.term.shape:
            raise InputError(f"The start has shape {image.shape}; for these inputs it must be {inputs.term.shape}.")
        steps, images = [], [image]
        # The data term keeps float32 whatever the networks compute in.
        factors, weights = (jnp.exp(log.astype(image.dtype)) for log in (self.log_factors, self.log_weights))
        momenta = self.momenta.astype(image.dtype)
        for stage, network in enumerate(self.networks):
            term, step_size = inputs.weighted(weights[stage]), factors[stage] * inputs.step_size
            before = images[-1]
            if stage:
                before = before + momenta[stage - 1] * (before - images[-2])
            step = before - step_size * term.gradient(before)
            gathered, coverage = _gathered(term, step, self.config.fill)
            image = network(step, Context(images[0], before, gathered, coverage, inputs.noise, step_size))
            steps.append(step)
            images.append(image)
        return Iterates(jnp.stack(steps), jnp.stack(images[1:]))


def _momenta(stages: int) -> list[float]:
    """(t_k − 1) / t_{k+1} of Beck and Teboulle (2009) for k = 2 … T; it is 0 for k = 1."""
    t, found = 1.0, []
    for _ in range(stages):
        following = (1 + (1 + 4 * t**2) ** 0.5) / 2
        found.append((t - 1) / following)
        t = following
    return found[1:]


def _gathered(
    term: DataTerm, image: Float[Array, "H W"], fill: float
) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
    """`Context.gathered` and `Context.coverage`."""
    pixels = term.aperture.scale**2
    coverage = term.stencil(jnp.ones_like(image)) * pixels
    return (term.target * pixels + fill * term.blurred(image)) / (coverage + fill), coverage


@eqx.filter_jit
def iterate(model: Any, inputs: Any, start: Float[Array, "H W"] | None = None) -> Iterates:
    """`model(inputs, start)`, compiled."""
    return model(inputs, start)
