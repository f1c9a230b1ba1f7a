"""The ladder of models with one face: from ISTA with total variation to the full SpikeSR-Net.

`model(name, scale)` gives a rung; `rung(spikes, scale=…)` gives a `Solution`, whose stages are recorded alike: those of
an optimizer as its solver records them, those of a network by Eq. 4 at its own iterates, with Huber-TV for a prior and
the data term and strength that `reconstruct` would use with it.

| name | what it is |
|---|---|
| `ista-tv`, `fista-tv` | Eq. 5, plain and accelerated, with total variation |
| `fista-huber` | with Huber-TV: what `reconstruct` does by default above a scale of 3 |
| `ridge`, `ridge-weakly` | with a learned prior (`RidgeRegulariser`), convex and weakly convex: by default up to 3 |
| `ridge-centred` | `ridge`, then once more, centred at a network's restoration of it (`learned.networks.restoration`) |
| `unrolled`, `unrolled-pase` | ISTA unrolled, with learned steps; on spike intervals, or on encoded spikes |
| `spikesr-small`, `spikesr-full` | SpikeSR-Net |

A network needs weights: `checkpoints/<name>-x<scale>.scsr`, or the path of a `.scsr` file in the place of a name. A
name with its scale, `spikesr-small-x4`, is the id of a model: of its weights, of the configuration that trains it
(`scsr train spikesr-small-x4`), and for `learned.load_model`.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, SupportsFloat, SupportsIndex

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import ArrayLike

from learned.evaluation.inference import Call, Run, call, check_stages, run
from learned.evaluation.reference_problem import (
    PRIOR,
    ReferenceClip,
    ReferenceProblem,
    reference_clip,
    reference_problem,
)
from learned.evaluation.stages import stages_of
from learned.networks.restoration import RestorationNet, first_prior, restored
from learned.training import checkpoint
from scsr_opt import reconstruct
from scsr_opt._arrays import as_array
from scsr_opt._kernels.device import check_device
from scsr_opt._validation import whole
from scsr_opt.camera.recording import Recording
from scsr_opt.errors import InputError
from scsr_opt.motion.trajectory import Motion
from scsr_opt.pipeline.solution import Diagnostics, Solution
from scsr_opt.pipeline.strength import relative_strength
from scsr_opt.priors.centred import Centred
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.ridge_regulariser import RidgeRegulariser
from scsr_opt.priors.total_variation import TotalVariation
from scsr_opt.progress import Progress, check_progress
from scsr_opt.solvers.loop import Solver
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.proximal_gradient import FISTA, ISTA
from scsr_opt.solvers.record import Stage, Status

CHECKPOINTS = checkpoint.SHIPPED
"""Where the shipped weights are."""

OPTIMIZERS: dict[str, Callable[[], tuple[Prior, Solver]]] = {
    "ista-tv": lambda: (TotalVariation(), ISTA()),
    "fista-tv": lambda: (TotalVariation(), FISTA()),
    "fista-huber": lambda: (PRIOR, FISTA()),
    "ridge": lambda: (RidgeRegulariser.load("convex"), FISTA()),
    "ridge-weakly": lambda: (RidgeRegulariser.load("weakly_convex"), FISTA()),
}
CENTRED = "ridge-centred"
# All that needs weights of its own, the optimizer among them whose prior a network centres.
NETWORKS = (CENTRED, "unrolled", "unrolled-pase", "spikesr-small", "spikesr-full")


@dataclass(frozen=True)
class Optimizer:
    """Eq. 4 solved by `reconstruct` with this prior and solver."""

    name: str
    prior: Prior
    solver: Solver

    def __call__(
        self,
        spikes: ArrayLike | Recording,
        *,
        scale: SupportsIndex,
        key: SupportsIndex | None = None,
        white_rate: SupportsFloat | None = None,
        start: Float[Array | np.ndarray, "H W"] | None = None,
        keep_images: bool = False,
        progress: Progress | None = None,
    ) -> Solution:
        """The picture of a moment (`reconstruct`); `start` (H, W) stands in for the first picture X^(0).

        **Raises:** `InputError` if something handed in cannot be used.
        """
        check_progress(progress)
        if start is not None:
            posed = reference_problem(
                reference_clip(spikes, scale=scale, key=key, white_rate=white_rate), prior=self.prior
            )
            return self.solve(posed, start=start, keep_images=keep_images, progress=progress)
        return reconstruct(
            spikes,
            scale=scale,
            key=key,
            white_rate=white_rate,
            prior=self.prior,
            solver=self.solver,
            keep_images=keep_images,
            progress=progress,
        )

    def solve(
        self,
        posed: ReferenceProblem,
        *,
        start: Float[Array | np.ndarray, "H W"] | None = None,
        keep_images: bool = False,
        progress: Progress | None = None,
    ) -> Solution:
        """The same with motion, gain and strength as they are posed, and the model's own prior."""
        problem = self.problem(posed)
        state = None
        if start is not None and posed.usable:
            state = _state(self.solver, problem, _picture(posed.clip, start))
        return reconstruct(
            posed.clip.recording,
            scale=posed.clip.scale,
            key=posed.clip.key,
            white_rate=posed.clip.clip.white_rate,
            motion=posed.motion,
            gain=posed.gain,
            prior=self.prior,
            strength=float(problem.strength),
            solver=self.solver,
            state=state,
            keep_images=keep_images,
            progress=progress,
        )

    def check(self, scale: int) -> None:
        """Raises nothing: it can be used at every scale."""

    def problem(self, posed: ReferenceProblem) -> Problem:
        """The problem of the first iteration: with the model's own prior, and as much of it as is posed."""
        share = relative_strength(self.prior) / relative_strength(posed.prior)
        data = posed.problem(posed.first).data
        return Problem(data, self.prior, posed.strength * np.float32(share))


@dataclass(frozen=True)
class CentredOptimizer(Optimizer):
    """Eq. 4 solved as by `Optimizer`, the solution restored by a network, and Eq. 4 solved again with the prior centred
    there, λ twice as large (`learned.networks.restoration`).

    Of the `Solution`, `stages` are those of both solves, the first `diagnostics.first_iterations` of them of the first;
    the objective is that of the solve that a stage belongs to. Among the seconds are those of the `first solve` and of
    `restoring`. Where the first solve fails, or there is nothing to solve for, or what the network makes is not finite
    (`Status.non_finite`), the first solution is returned. Where gains of pixels are not handed in, each solve finds its
    own.

    **Fields:** as of `Optimizer`; `path` of the network's weights; `strength_ratio`, λ of the second solve over that of
    the first: 1 to 4 differ by 0.01 dB, as the restored picture agrees with the data.
    """

    path: Path
    strength_ratio: float = 2.0

    @cached_property
    def net(self) -> RestorationNet:
        """The network. **Raises:** `InputError` if the file cannot be used, or holds another one."""
        net, card = checkpoint.load(self.path)
        if not isinstance(net, RestorationNet):
            raise InputError(f"{self.path.name} holds the network {card.model}, but restoration is wanted.")
        return net

    def __call__(
        self,
        spikes: ArrayLike | Recording,
        *,
        scale: SupportsIndex,
        key: SupportsIndex | None = None,
        white_rate: SupportsFloat | None = None,
        start: Float[Array | np.ndarray, "H W"] | None = None,
        keep_images: bool = False,
        progress: Progress | None = None,
    ) -> Solution:
        """As of `Optimizer`; `start` is for the first solve.

        **Raises:** `InputError` if something handed in cannot be used, or the network is for another scale.
        """
        self.check(whole(scale, "scale", 1))
        first = super().__call__(
            spikes,
            scale=scale,
            key=key,
            white_rate=white_rate,
            start=start,
            keep_images=keep_images,
            progress=progress,
        )
        if start is not None:  # posed, and solved twice
            return first
        again = functools.partial(reconstruct, spikes, scale=scale, key=key, white_rate=white_rate)
        return self._again(first, again, keep_images=keep_images, progress=progress)

    def solve(
        self,
        posed: ReferenceProblem,
        *,
        start: Float[Array | np.ndarray, "H W"] | None = None,
        keep_images: bool = False,
        progress: Progress | None = None,
    ) -> Solution:
        """As of `Optimizer`, both solves with motion and gain as they are posed."""
        here = posed.clip
        self.check(here.scale)
        first = super().solve(posed, start=start, keep_images=keep_images, progress=progress)
        again = functools.partial(
            reconstruct,
            here.recording,
            scale=here.scale,
            key=here.key,
            white_rate=here.clip.white_rate,
            gain=posed.gain,
        )
        return self._again(first, again, keep_images=keep_images, progress=progress)

    def check(self, scale: int) -> None:
        """**Raises:** `InputError` if the network is for another scale, or its file cannot be used."""
        _check_scale(self.path, self.net.config.scale, scale)

    def _again(self, first: Solution, again: Callable[..., Solution], **options: Any) -> Solution:
        if not first.status.usable or first.state is None or first.motion is None:
            return first
        begin = time.perf_counter()
        strength = first.diagnostics.strength
        assert strength is not None  # a solve that was usable had one
        centre = restored(self.net, jnp.asarray(first.image), np.float32(strength))
        if not bool(jnp.isfinite(centre).all()):
            return dataclasses.replace(first, status=Status.non_finite)
        prior = Centred(self.prior, centre)
        restoring = time.perf_counter() - begin
        solution = again(
            prior=prior,
            strength=self.strength_ratio * strength,
            solver=self.solver,
            motion=first.motion,
            state=first.state._replace(image=centre, prior=prior.initial_state(centre)),
            **options,
        )
        stages = first.stages + solution.stages
        seconds = {"first solve": sum(first.diagnostics.seconds.values()), "restoring": restoring}
        diagnostics = dataclasses.replace(
            solution.diagnostics,
            iterations=len(stages),
            first_iterations=len(first.stages),
            seconds=seconds | solution.diagnostics.seconds,
        )
        stages = tuple(dataclasses.replace(stage, number=n) for n, stage in enumerate(stages, 1))
        return dataclasses.replace(solution, stages=stages, diagnostics=diagnostics)


@eqx.filter_jit
def _state(solver: Solver, problem: Problem, image: Float[Array, "H W"]) -> Any:
    return solver.init(problem, image)


@dataclass(frozen=True)
class Network:
    """A trained network in a file."""

    name: str
    path: Path

    @cached_property
    def _loaded(self) -> tuple[Any, checkpoint.Card]:
        return checkpoint.load(self.path)

    @property
    def net(self) -> Any:
        """The network itself, an `equinox.Module`. **Raises:** `InputError` if the file cannot be used."""
        return self._loaded[0]

    @property
    def card(self) -> checkpoint.Card:
        """What the file says of it."""
        return self._loaded[1]

    def __call__(
        self,
        spikes: ArrayLike | Recording,
        *,
        scale: SupportsIndex,
        key: SupportsIndex | None = None,
        white_rate: SupportsFloat | None = None,
        start: Float[Array | np.ndarray, "H W"] | None = None,
        keep_images: bool = False,
        record: bool = True,
        progress: Progress | None = None,
    ) -> Solution:
        """The picture of a moment.

        **Arguments:** as of `reconstruct`, and
        - `start`: (H, W), in the place of the network's own X^(0).
        - `record`: whether the stages are measured by Eq. 4. That takes the motion, the samples and the strength that
          an optimizer would use, and several times as long as the network itself.

        **Returns:** `Solution`; its `status` is `stages_done`.

        **Raises:** `InputError` if something handed in cannot be used, or the network is for another scale.
        """
        check_progress(progress)
        here = reference_clip(spikes, scale=scale, key=key, white_rate=white_rate)
        if record:
            return self.solve(reference_problem(here), start=start, keep_images=keep_images, progress=progress)
        if not here.clip.spikes.any():
            return _nothing(here)
        begin = time.perf_counter()
        found = self.run(here, start)
        return _solution(here, found, (), time.perf_counter() - begin)

    def solve(
        self,
        posed: ReferenceProblem,
        *,
        start: Float[Array | np.ndarray, "H W"] | None = None,
        keep_images: bool = False,
        progress: Progress | None = None,
    ) -> Solution:
        """The same, measured by the problem that is posed."""
        check_progress(progress)
        if not posed.usable:
            return _nothing(posed.clip)
        if progress is not None:
            progress.start(None, self.name)
        try:
            begin = time.perf_counter()
            found = self.run(posed.clip, start, posed.motion)
            seconds = time.perf_counter() - begin
            stages = stages_of(posed, found, seconds=seconds, keep_images=keep_images)
        finally:
            if progress is not None:
                progress.finish()
        return _solution(posed.clip, found, stages, seconds, float(posed.strength))

    def run(
        self, here: ReferenceClip, start: Float[Array | np.ndarray, "H W"] | None = None, motion: Motion | None = None
    ) -> Run:
        """R^(t) and X^(t) of all stages. **Arguments** and **Raises:** as `call`."""
        return run(self.call(here, start, motion))

    def call(
        self, here: ReferenceClip, start: Float[Array | np.ndarray, "H W"] | None = None, motion: Motion | None = None
    ) -> Call:
        """How the network is called for this moment; `motion` is for the networks that use one, if it is known.

        **Raises:** `InputError` if the network is for another scale, or `start` is no picture of this moment.
        """
        self.check(here.scale)
        return call(self.net, self.card, here, None if start is None else _picture(here, start), motion)

    def check(self, scale: int) -> None:
        """**Raises:** `InputError` if the network is for another scale."""
        _check_scale(self.path, self.card.configuration["scale"], scale)


@dataclass(frozen=True)
class LoadedModel:
    """A model for one scale: `load_model("spikesr-small-x4")(recording, key=100)`.

    **Fields:** `id`; `model`, an `Optimizer` or a `Network`; `scale` s.
    """

    id: str
    model: "Model"
    scale: int

    def __call__(self, spikes: ArrayLike | Recording, **options: Any) -> Solution:
        """The picture of a moment; `options` as of `Optimizer` or `Network` (`key`, `white_rate`, …)."""
        return self.model(spikes, scale=self.scale, **options)


def load_model(model_id: str) -> LoadedModel:
    """The model of an id: a name of the ladder and a scale, `ridge-x2`, `spikesr-small-x4`.

    **Raises:** `InputError` if there is no such model, or no weights for its scale.
    """
    name, _, scale = model_id.rpartition("-x")
    if not scale.isdecimal() or int(scale) < 1:
        raise InputError(
            f"There is no model {model_id!r}: an id is a name and a scale, such as fista-huber-x4 or "
            f"{', '.join(sorted(file.stem for file in CHECKPOINTS.glob('*.scsr')))}."
        )
    return LoadedModel(model_id, model(name, int(scale)), int(scale))


def _check_scale(path: Path, trained: int, asked: int) -> None:
    if trained != asked:
        raise InputError(
            f"{path.name} was trained for scale {trained}, but scale {asked} was asked for; take that, or another "
            f"network."
        )


Model = Optimizer | Network


def model(name: str, scale: int) -> Model:
    """The rung of this name for a scale; a path that ends in `.scsr` is a network of its own.

    **Raises:** `InputError` if there is no such rung, no weights for it, or no device for JAX to run on.
    """
    check_device()  # priors and weights are arrays of JAX's
    if name in OPTIMIZERS:
        prior, solver = OPTIMIZERS[name]()
        return Optimizer(name, prior, solver)
    if name.endswith(".scsr"):
        network = Network(name, Path(name))
        if isinstance(network.net, RestorationNet):
            return _centred(name, network.path)
        check_stages(network.net, network.card)  # and a file that cannot be read is found out here
        return network
    if name not in NETWORKS:
        raise InputError(
            f"There is no model {name!r}: take one of {', '.join((*OPTIMIZERS, *NETWORKS))}, or the path of a .scsr "
            f"file."
        )
    path = _weights(name, scale)
    if not path.is_file():
        shipped = ", ".join(sorted(file.stem for file in CHECKPOINTS.glob("*.scsr"))) or "none"
        raise InputError(
            f"There are no weights of {name} for scale {scale} (shipped are: {shipped}); `scsr train` makes some, and "
            f"the path of its .scsr file can be given in the place of a name."
        )
    return _centred(name, path) if name == CENTRED else Network(name, path)


def _centred(name: str, path: Path) -> CentredOptimizer:
    return CentredOptimizer(name, first_prior(), FISTA(), path)


def names(scale: int) -> list[str]:
    """The models that can be used at this scale as things are: optimizers, and networks whose weights are there."""
    return [*OPTIMIZERS, *(name for name in NETWORKS if _weights(name, scale).is_file())]


def _weights(name: str, scale: int) -> Path:
    return CHECKPOINTS / f"{name}-x{scale}.scsr"


def _picture(here: ReferenceClip, start: Float[Array | np.ndarray, "H W"]) -> Float[Array, "H W"]:
    """`start` as a picture of this moment. **Raises:** `InputError` if it is none."""
    image = as_array(start, "start").astype(np.float32)  # a copy
    if image.shape != here.shape or not np.isfinite(image).all():
        raise InputError(
            f"start has shape {image.shape} and {int((~np.isfinite(image)).sum())} values that are not finite; a "
            f"picture of this recording at scale {here.scale} has shape {here.shape} and none."
        )
    return jnp.asarray(image)


def _known(here: ReferenceClip) -> dict[str, Any]:
    """Fields that every `Solution` of this clip has."""
    known = {"recording": here.recording, "scale": here.scale, "key": here.key}
    return known | {"white_rate": here.clip.white_rate}


def _nothing(here: ReferenceClip) -> Solution:
    return Solution(image=np.zeros(here.shape, np.float32), status=Status.no_samples, **_known(here))


def _solution(
    here: ReferenceClip, found: Run, stages: tuple[Stage, ...], seconds: float, strength: float | None = None
) -> Solution:
    images = np.array(found.images)
    finite = [image for image in images if np.isfinite(image).all()]
    diagnostics = Diagnostics(
        iterations=len(images),
        strength=strength,
        objective=stages[-1].objective if stages else None,
        seconds={"network": seconds},
    )
    return Solution(
        image=np.array(finite[-1]) if finite else np.zeros(images.shape[1:], np.float32),
        status=Status.stages_done if len(finite) == len(images) else Status.non_finite,
        stages=stages,
        diagnostics=diagnostics,
        **_known(here),
    )
