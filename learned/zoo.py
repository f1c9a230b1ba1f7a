"""All models by name: from ISTA with total variation to the full SpikeSR-Net.

To make pictures with a model of the package, `load_model(id)` is enough. `model(name, scale)` gives the `Optimizer` or
`Network` behind it, for comparisons and for networks in files of one's own; `model(…)(spikes, scale=…)` gives a
`Solution`, too. Its stages are recorded alike: those of an optimizer by its solver, those of a network by Eq. 4 at the
network's own iterates, with Huber-TV as the prior and the data term and strength that `reconstruct` would use with it.

| name | model |
|---|---|
| `ista-tv`, `fista-tv` | Eq. 5, plain and accelerated, with total variation |
| `fista-huber` | Huber-TV: the default of `reconstruct` above a scale of 3 |
| `ridge`, `ridge-weakly` | a learned prior (`RidgeRegulariser`), convex (the default up to 3) and weakly convex |
| `ridge-centred` | `ridge`, then once more, centred at a network's restoration of it: `quality="best"` |
| `unrolled`, `unrolled-pase` | ISTA unrolled, with learned steps; on spike intervals, or on encoded spikes |
| `spikesr-small`, `spikesr-full` | SpikeSR-Net |

A network needs weights: `checkpoints/<name>-x<scale>.scsr`, or the path of a `.scsr` file instead of a name. A name
with its scale, `spikesr-small-x4`, is the id of a model: of its weights, of the configuration that trains it
(`scsr train spikesr-small-x4`), and for `learned.load_model`.
"""

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
from learned.evaluation.reference_problem import PRIOR, ReferenceProblem, reference_problem, reference_task
from learned.evaluation.stages import stages_of
from learned.networks.restoration import NetworkRestoration, RestorationNet
from learned.training import checkpoint
from scsr_opt import reconstruct
from scsr_opt._arrays import as_array
from scsr_opt._kernels.programs import ready
from scsr_opt._validation import whole
from scsr_opt.camera.recording import Recording
from scsr_opt.errors import InputError
from scsr_opt.motion.trajectory import Motion
from scsr_opt.pipeline.solution import Diagnostics, Solution
from scsr_opt.pipeline.strength import relative_strength
from scsr_opt.pipeline.task import Task
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.ridge_regulariser import RidgeRegulariser
from scsr_opt.priors.total_variation import TotalVariation
from scsr_opt.progress import Progress, check_progress
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.proximal_gradient import FISTA, ISTA
from scsr_opt.solvers.record import Stage, Status
from scsr_opt.solvers.solver import Solver

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
# Models that need weights, among them the optimizer whose prior a network centres.
NETWORKS = (CENTRED, "unrolled", "unrolled-pase", "spikesr-small", "spikesr-full")


@dataclass(frozen=True)
class Optimizer:
    """Eq. 4 solved by `reconstruct` with this prior and solver; where a network restores the solution, solved once more
    with the prior centred at its picture (`Options.quality`).

    **Fields:** `name`; `prior`; `solver`; `restoration`, None for one solve; `path` of the restoring network's weights.
    """

    name: str
    prior: Prior
    solver: Solver
    restoration: NetworkRestoration | None = None
    path: Path | None = None

    @property
    def quality(self) -> Any:
        """`Options.quality`."""
        return "fast" if self.restoration is None else self.restoration

    def __call__(
        self,
        spikes: ArrayLike | Recording,
        *,
        scale: SupportsIndex,
        key: SupportsIndex | None = None,
        white_rate: SupportsFloat | None = None,
        start: Float[Array | np.ndarray, "H W"] | None = None,
        **options: Any,
    ) -> Solution:
        """The picture of a key frame.

        **Arguments:** as of `reconstruct` (`options`: `keep_images`, `progress`), and `start` (H, W), which replaces
        the initial image X^(0).

        **Raises:** `InputError` for an argument that cannot be used, or another scale than the network's.
        """
        self.check(whole(scale, "scale", 1))
        clip: dict[str, Any] = {"scale": scale, "key": key, "white_rate": white_rate}
        if start is None:
            return reconstruct(spikes, **clip, prior=self.prior, solver=self.solver, quality=self.quality, **options)
        return self.solve(reference_problem(reference_task(spikes, **clip), prior=self.prior), start=start, **options)

    def solve(
        self, posed: ReferenceProblem, *, start: Float[Array | np.ndarray, "H W"] | None = None, **options: Any
    ) -> Solution:
        """The picture with motion, gain and strength of the problem `posed`, and the model's own prior."""
        self.check(posed.task.scale)
        problem, state = self.problem(posed), None
        if start is not None and posed.usable:
            state = _state(self.solver, problem, _checked_start(posed.task, start))
        return reconstruct(
            posed.task.recording,
            **_clip_of(posed.task),
            motion=posed.motion,
            gain=posed.gain,
            prior=self.prior,
            strength=float(problem.strength),
            solver=self.solver,
            quality=self.quality,
            state=state,
            **options,
        )

    def check(self, scale: int) -> None:
        """**Raises:** `InputError` if a network that restores was trained for another scale; all else works at any."""
        if self.restoration is not None and self.path is not None:
            _check_scale(self.path, self.restoration.net.config.scale, scale)

    def problem(self, posed: ReferenceProblem) -> Problem:
        """The problem of the first iteration, with the model's own prior and its share of the strength."""
        share = relative_strength(self.prior) / relative_strength(posed.prior)
        data = posed.problem(posed.first).data
        return Problem(data, self.prior, posed.strength * np.float32(share))


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
        """Origin, sizes and scores of the network, as its file has them."""
        return self._loaded[1]

    def __call__(
        self,
        spikes: ArrayLike | Recording,
        *,
        scale: SupportsIndex,
        key: SupportsIndex | None = None,
        white_rate: SupportsFloat | None = None,
        start: Float[Array | np.ndarray, "H W"] | None = None,
        record: bool = True,
        **options: Any,
    ) -> Solution:
        """The picture of a key frame.

        **Arguments:** as of `Optimizer`, and `record`: whether the stages are measured by Eq. 4. That takes the motion,
        samples and strength that an optimizer would use, and several times as long as the network itself.

        **Returns:** `Solution` with the status `stages_done`.

        **Raises:** `InputError` for an argument that cannot be used, or another scale than the network's.
        """
        check_progress(options.get("progress"))
        task = reference_task(spikes, scale=scale, key=key, white_rate=white_rate)
        if record:
            return self.solve(reference_problem(task), start=start, **options)
        if not task.clip.spikes.any():
            return _solution(task)
        begin = time.perf_counter()
        found = self.run(task, start)
        return _solution(task, found, seconds=time.perf_counter() - begin)

    def solve(
        self,
        posed: ReferenceProblem,
        *,
        start: Float[Array | np.ndarray, "H W"] | None = None,
        keep_images: bool = False,
        progress: Progress | None = None,
    ) -> Solution:
        """The picture of the clip of `posed`, its stages measured by that problem."""
        check_progress(progress)
        if not posed.usable:
            return _solution(posed.task)
        if progress is not None:
            progress.start(None, self.name)
        try:
            begin = time.perf_counter()
            found = self.run(posed.task, start, posed.motion)
            seconds = time.perf_counter() - begin
            stages = stages_of(posed, found, seconds=seconds, keep_images=keep_images)
        finally:
            if progress is not None:
                progress.finish()
        return _solution(posed.task, found, stages, seconds, float(posed.strength))

    def run(
        self, task: Task, start: Float[Array | np.ndarray, "H W"] | None = None, motion: Motion | None = None
    ) -> Run:
        """R^(t) and X^(t) of all stages. **Arguments** and **Raises:** as `call`."""
        return run(self.call(task, start, motion))

    def call(
        self, task: Task, start: Float[Array | np.ndarray, "H W"] | None = None, motion: Motion | None = None
    ) -> Call:
        """The network and its arguments for the clip of a task; `motion` is for the networks that use one, if known.

        **Raises:** `InputError` if the network is for another scale, or `start` is no picture of this clip.
        """
        self.check(task.scale)
        return call(self.net, self.card, task, None if start is None else _checked_start(task, start), motion)

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

    def __call__(
        self, spikes: ArrayLike | Recording, *, scale: SupportsIndex | None = None, **options: Any
    ) -> Solution:
        """The picture of a key frame; `options` as of `Optimizer` or `Network` (`key`, `white_rate`, …).

        **Raises:** as these, and `InputError` if `scale` is given and is another one than the model's.
        """
        if scale is not None and whole(scale, "scale", 1) != self.scale:
            raise InputError(
                f"scale is {scale}, but {self.id} is a model for scale {self.scale}: take that, or load another model."
            )
        return self.model(spikes, scale=self.scale, **options)


def load_model(model_id: str) -> LoadedModel:
    """The model of an id, a name and a scale: `ridge-x2`, `spikesr-small-x4`. It is called with a recording alone; its
    field `model` is that of `model(name, scale)`.

    **Raises:** `InputError` if there is no such model, or no weights for its scale.
    """
    name, _, scale = model_id.rpartition("-x")
    if not scale.isdecimal() or int(scale) < 1:
        raise InputError(
            f"There is no model {model_id!r}: an id is a name and a scale, such as fista-huber-x4 or "
            f"{', '.join(sorted(file.stem for file in CHECKPOINTS.glob('*.scsr')))}."
        )
    return LoadedModel(model_id, model(name, int(scale)), int(scale))


def _check_scale(path: Path, trained: int, scale: int) -> None:
    if trained != scale:
        raise InputError(
            f"{path.name} was trained for scale {trained}, but scale {scale} is wanted: take another network."
        )


Model = Optimizer | Network


def model(name: str, scale: int) -> Model:
    """The model of this name for a scale; the name may be the path of a `.scsr` file. Those who only want pictures by a
    model of the package take `load_model`.

    **Raises:** `InputError` if there is no such model, no weights for it, or no device for JAX to run on.
    """
    ready()  # priors and weights are arrays of JAX's
    if name in OPTIMIZERS:
        prior, solver = OPTIMIZERS[name]()
        return Optimizer(name, prior, solver)
    if name.endswith(".scsr"):
        network = Network(name, Path(name))
        if isinstance(network.net, RestorationNet):
            return _centred(name, network)
        check_stages(network.net, network.card)  # reads the file, too
        return network
    if name not in NETWORKS:
        short, _, scale_of_id = name.rpartition("-x")
        id_of = scale_of_id.isdecimal() and short in (*OPTIMIZERS, *NETWORKS)
        hint = f"leave -x{scale_of_id} out, as the scale is given apart" if id_of else ""
        raise InputError(
            f"There is no model {name!r}: "
            + (hint or f"take one of {', '.join((*OPTIMIZERS, *NETWORKS))}, or the path of a .scsr file")
            + "."
        )
    path = _weights(name, scale)
    if not path.is_file():
        shipped = ", ".join(sorted(file.stem for file in CHECKPOINTS.glob("*.scsr"))) or "none"
        raise InputError(
            f"There are no weights of {name} for scale {scale} (shipped are: {shipped}); `scsr train` makes some, and "
            f"the path of its .scsr file can be given in the place of a name."
        )
    network = Network(name, path)
    return _centred(name, network) if name == CENTRED else network


def _centred(name: str, network: Network) -> Optimizer:
    """**Raises:** `InputError` if the file cannot be used, or holds another network."""
    if not isinstance(network.net, RestorationNet):
        raise InputError(f"{network.path.name} holds the network {network.card.model}, but restoration is wanted.")
    return Optimizer(name, *OPTIMIZERS["ridge"](), NetworkRestoration(network.net), network.path)


@functools.cache
def best(scale: int) -> NetworkRestoration:
    """The restoration of `reconstruct(…, quality="best")`: the network of the scale or the next smaller one that has
    one (×1 has), whose weights are read once."""
    scales = (int(file.stem.rpartition("-x")[2]) for file in CHECKPOINTS.glob(f"{CENTRED}-x*.scsr"))
    found = model(CENTRED, max(one for one in scales if one <= scale))
    assert isinstance(found, Optimizer) and found.restoration is not None
    return found.restoration


def names(scale: int) -> list[str]:
    """The models for this scale: optimizers, and networks whose weights exist."""
    return [*OPTIMIZERS, *(name for name in NETWORKS if _weights(name, scale).is_file())]


def _weights(name: str, scale: int) -> Path:
    return CHECKPOINTS / f"{name}-x{scale}.scsr"


def _checked_start(task: Task, start: Float[Array | np.ndarray, "H W"]) -> Float[Array, "H W"]:
    """`start` as a picture of this clip. **Raises:** `InputError` if it is none."""
    image = as_array(start, "start").astype(np.float32)  # a copy
    if image.shape != task.shape or not np.isfinite(image).all():
        raise InputError(
            f"start has shape {image.shape} and {int((~np.isfinite(image)).sum())} values that are not finite; a "
            f"picture of this recording at scale {task.scale} has shape {task.shape} and none."
        )
    return jnp.asarray(image)


def _clip_of(task: Task) -> dict[str, Any]:
    """Arguments of `reconstruct` that name this clip."""
    return {"scale": task.scale, "key": task.clip.key_frame, "white_rate": task.clip.white_rate}


def _solution(
    task: Task,
    found: Run | None = None,
    stages: tuple[Stage, ...] = (),
    seconds: float = 0.0,
    strength: float | None = None,
) -> Solution:
    """The result of a network; without `found`, that of a clip without a spike."""
    known = {"recording": task.recording, **_clip_of(task)}
    if found is None:
        return Solution(image=np.zeros(task.shape, np.float32), status=Status.no_samples, **known)
    images = np.array(found.images)
    finite = [image for image in images if np.isfinite(image).all()]
    return Solution(
        image=np.array(finite[-1]) if finite else np.zeros(task.shape, np.float32),
        status=Status.stages_done if len(finite) == len(images) else Status.non_finite,
        stages=stages,
        diagnostics=Diagnostics(
            iterations=len(images),
            strength=strength,
            objective=stages[-1].objective if stages else None,
            seconds={"network": seconds},
        ),
        **known,
    )
