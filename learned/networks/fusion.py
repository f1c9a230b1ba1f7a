"""Many moments into one: convolutional gated recurrent units (ConvGRU) forwards and backwards in time (Eq. 12)."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from learned.networks.deformable import Align
from learned.networks.layers import convolution, unfold


class ConvGRU(eqx.Module):
    """One direction of Eq. 12 (Tokmakov, Alahari, Schmid 2017). With gates between 0 and 1,

        Z_i = σ(Conv([H_{i−1}, G_i]))                    update: how much of the new is taken in
        C_i = σ(Conv([H_{i−1}, G_i]))                    reset: how much of the old is looked at
        Q_i = tanh(Conv([C_i ⊙ H_{i−1}, G_i]))
        H_i = (1 − Z_i) ⊙ H_{i−1} + Z_i ⊙ Q_i,           H_0 = 0.

    A convolution of a concatenation is the sum of two convolutions. The one of G does not wait for H and is made for
    all moments at once; `from_input` and `from_state` hold the two. Their channels are those of Z, C and Q in turn.
    """

    from_input: eqx.nn.Conv2d
    gates_from_state: eqx.nn.Conv2d
    new_from_state: eqx.nn.Conv2d

    def __init__(self, inputs: int, channels: int, *, key: PRNGKeyArray):
        given, gates, new = jax.random.split(key, 3)
        self.from_input = convolution(inputs, 3 * channels, key=given)
        # The bias is in `from_input`.
        self.gates_from_state = eqx.nn.Conv2d(channels, 2 * channels, 3, padding=1, use_bias=False, key=gates)
        self.new_from_state = eqx.nn.Conv2d(channels, channels, 3, padding=1, use_bias=False, key=new)

    def __call__(self, features: Float[Array, "n inputs h w"]) -> Float[Array, "c h w"]:
        """The state H_n after the last moment."""

        def step(state: Float[Array, "c h w"], given: Float[Array, "3*c h w"]) -> tuple[Float[Array, "c h w"], None]:
            update, reset, new = jnp.split(given, 3)
            from_update, from_reset = jnp.split(self.gates_from_state(state), 2)
            update = jax.nn.sigmoid(update + from_update)
            reset = jax.nn.sigmoid(reset + from_reset)
            new = jnp.tanh(new + self.new_from_state(reset * state))
            return (1 - update) * state + update * new, None

        given = jax.vmap(self.from_input)(features)
        start = jnp.zeros_like(given[0, : given.shape[1] // 3])
        # Unrolled: on a CPU a convolution within a loop takes 30 times as long as outside one.
        return jax.lax.scan(step, start, given, unroll=True)[0]


class BidirectionalFusion(eqx.Module):
    """[H_k, H'_k] of Eq. 13: what moments 1 … k say in this order, and what n … k say in that.

    (n, inputs, h, w) -> (2·channels, h, w). The states beyond k are not part of the result and are not calculated.
    """

    forward: ConvGRU
    backward: ConvGRU

    def __init__(self, inputs: int, channels: int, *, key: PRNGKeyArray):
        forward, backward = jax.random.split(key)
        self.forward = ConvGRU(inputs, channels, key=forward)
        self.backward = ConvGRU(inputs, channels, key=backward)

    def __call__(self, features: Float[Array, "n inputs h w"], middle: int) -> Float[Array, "d h w"]:
        """**Arguments:** `middle`: k, counted from 0; both directions end there."""
        return jnp.concatenate([self.forward(features[: middle + 1]), self.backward(features[middle:][::-1])])


class Initialisation(eqx.Module):
    """F, the motion-aligned fusion that starts the iteration (paper, "Initialization"): X^(0) less its base.

    Each Y_i is aligned to Y_k by deformable convolution, at the sensor's resolution; the bidirectional ConvGRU fuses
    them; a convolution and a pixel shuffle enlarge the result.
    """

    entry: eqx.nn.Conv2d
    align: Align
    fusion: BidirectionalFusion
    output: eqx.nn.Conv2d
    scale: int = eqx.field(static=True)

    def __init__(
        self,
        latent: int,
        channels: int,
        *,
        scale: int,
        groups: int,
        levels: int,
        deform: bool = True,
        key: PRNGKeyArray,
    ):
        entry, align, fusion, output = jax.random.split(key, 4)
        self.entry = convolution(latent, channels, key=entry)
        self.align = Align(2 * channels, channels, groups, levels, deform, key=align)
        self.fusion = BidirectionalFusion(channels, channels, key=fusion)
        self.output = convolution(2 * channels, scale**2, shrink=0.1, key=output)
        self.scale = scale

    def __call__(
        self, latent: Float[Array, "n C h w"], guides: Float[Array, "n 2 h w"] | None = None
    ) -> Float[Array, "H W"]:
        """**Arguments:** `guides`: where each moment shows what the key frame does (`Align`).

        **Returns:** what is to be added to the enlarged firing rate, intensity.
        """
        middle = latent.shape[0] // 2
        features = jax.vmap(self.entry)(latent)
        aligned = jax.vmap(lambda moment, guide: self.align(moment, features[middle], guide=guide))(features, guides)
        return unfold(self.output(self.fusion(aligned, middle)), self.scale)[0]
