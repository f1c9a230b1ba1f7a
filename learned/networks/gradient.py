"""The gradient descent module G (GDM) of SpikeSR-Net: the first line of Eq. 5 with learned operators (Eq. 8-11, 13)."""

import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray

from learned.networks.deformable import Align
from learned.networks.fusion import BidirectionalFusion
from learned.networks.layers import ResidualBlocks, convolution, fold, scale_down, scale_up, unfold


class GradientModule(eqx.Module):
    """R^(t) = X^(t−1) − Conv([H_k, H'_k]) of Eq. 13: a gradient step whose operators are learned.

    For each moment i, with [,] the concatenation,

        E_i = T_{k→i}([X, D_s⁻¹(Y_i)])         aligned to moment i by deformable convolution      (Eq. 8)
        L_i = D_s(H_i(E_i))                    degraded and scaled down: what the sensor would see (Eq. 9)
        F_i = H_i⁻¹(D_s⁻¹(L_i − Y_i))          the residual, scaled up and refined                (Eq. 10)
        G_i = T_{i→k}([F_i, X])                aligned back                                       (Eq. 11)

    and a bidirectional ConvGRU fuses G_1 … G_n to [H_k, H'_k].

    All moments share their weights (the paper's index i of H_i says whose features they work on; motion is in the
    offsets). The features live at `working_scale` times the sensor's resolution: at the full scale s as in the paper,
    or, cheaper, below it. The picture is then folded, s/working_scale pixels each way into channels, so that nothing of
    it is lost.

    **Arguments:**
    - `latent`: C, channels of Y_i.
    - `channels`: of all features.
    - `scale`, `working_scale`: s, and a divisor of it.
    - `degradation`, `refinement`: residual blocks in H_i and H_i⁻¹.
    - `groups`, `levels`, `deform`: as in `Align`.
    """

    up: eqx.nn.ConvTranspose2d
    forth: Align
    degradation: ResidualBlocks
    down: eqx.nn.Conv2d
    residual_up: eqx.nn.ConvTranspose2d
    refinement: ResidualBlocks
    back: Align
    fusion: BidirectionalFusion
    output: eqx.nn.Conv2d
    folding: int = eqx.field(static=True)

    def __init__(
        self,
        latent: int,
        channels: int,
        *,
        scale: int,
        working_scale: int,
        degradation: int,
        refinement: int,
        groups: int,
        levels: int,
        deform: bool = True,
        key: PRNGKeyArray,
    ):
        keys = jax.random.split(key, 9)
        self.folding = scale // working_scale
        picture = self.folding**2
        self.up = scale_up(latent, channels, working_scale, key=keys[0])
        self.forth = Align(picture + channels, channels, groups, levels, deform, key=keys[1])
        self.degradation = ResidualBlocks(channels, degradation, key=keys[2])
        self.down = scale_down(channels, latent, working_scale, key=keys[3])
        self.residual_up = scale_up(latent, channels, working_scale, key=keys[4])
        self.refinement = ResidualBlocks(channels, refinement, key=keys[5])
        self.back = Align(channels + picture, channels, groups, levels, deform, key=keys[6])
        self.fusion = BidirectionalFusion(channels, channels, key=keys[7])
        self.output = convolution(2 * channels, picture, shrink=0.1, key=keys[8])

    def __call__(
        self,
        image: Float[Array, "H W"],
        latent: Float[Array, "n C h w"],
        guides: Float[Array, "n 2 H_w W_w"] | None = None,
    ) -> Float[Array, "H W"]:
        """**Arguments:**
        - `image`: X^(t−1), intensity.
        - `latent`: Y_1 … Y_n, the middle one of the key frame.
        - `guides`: where each moment shows what the key frame does, in pixels of the features (`Align`). The way forth
          is the way back reversed, as what is near moves alike.

        **Returns:** R^(t), intensity.
        """
        folded = fold(image[None].astype(latent.dtype), self.folding)

        def gradient(
            measured: Float[Array, "C h w"], guide: Float[Array, "2 H_w W_w"] | None
        ) -> Float[Array, "c H_w W_w"]:
            aligned = self.forth(folded, self.up(measured), guide=None if guide is None else -guide)
            seen = self.down(self.degradation(aligned))
            residual = self.refinement(self.residual_up(seen - measured))
            return self.back(residual, folded, guide=guide)

        fused = self.fusion(jax.vmap(gradient)(latent, guides), latent.shape[0] // 2)
        return image - unfold(self.output(fused), self.folding)[0].astype(image.dtype)
