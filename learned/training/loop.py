"""Training of a network on simulated recordings: one loop for all of them, on a CPU or a GPU.

A run lives in a folder:

- `state`: weights, their average, the optimiser, the step, all losses and scores. Written whole and renamed, so a run
  that is killed at any moment goes on from the last one. What follows is then what would have followed: the examples of
  a step depend on the seed and the step alone (see `learned.training.data`), and the program of a step is the same. On
  a CPU the result is the same to the last bit; on a GPU with
  `XLA_FLAGS=--xla_gpu_deterministic_ops=true`. A run may be resumed for more steps; a cosine's learning rate
  then follows the longer plan from there.
- `last.scsr`, `best.scsr`: the averaged weights, with their card (see `learned.training.checkpoint`); best in mean
  PSNR.
- `loss.csv`, `validation.csv`, `curves.png`, `samples/STEP.png`: for people.
- `examples/`: those that were prepared before the first step, for networks that need that
  (`learned.training.prepared_cache`).
"""

import enum
import functools
import math
import os
import time
from collections.abc import Callable, Generator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PyTree

from learned.training import checkpoint, validation
from learned.training.configs import TrainingConfig
from learned.training.data import Examples, Pictures
from learned.training.data_loader import batches, stacked
from learned.training.prepared_cache import Preparing, prepare
from learned.training.registry import Trainable, trainable
from scsr_opt._kernels.programs import ready
from scsr_opt.errors import InputError
from scsr_opt.progress import NoProgress, Progress, check_progress

_READ_EVERY = 10  # steps between readings of the losses; reading at every step would make an accelerator wait
# Fields in which a configuration may differ from that of the run that it resumes.
_FREE = ("steps", "validate_every", "save_every", "workers", "skip_limit")


class TrainingStatus(enum.Enum):
    """End of a run; `message` is a sentence about it."""

    finished = "All steps are done."
    diverged = (
        "Training failed: too many steps in a row (skip_limit) had a loss or a gradient that is not a finite number; "
        "start again in another folder with a lower rate or a smaller clip."
    )

    @property
    def message(self) -> str:
        """A sentence for people."""
        return self.value

    @property
    def usable(self) -> bool:
        """True if the weights can be used."""
        return self is TrainingStatus.finished


@dataclass(frozen=True)
class Training:
    """The result of a run.

    **Fields:**
    - `status`: how it ended.
    - `model`: with the averaged weights.
    - `steps`: done in all; `skipped`: those that changed nothing, because their loss or gradient was not finite.
    - `losses`: (steps,) float32, of every step; not finite where it was skipped for that.
    - `validated`: one dictionary per validation: `step`, and what `learned.training.validation.scores` gives.
    - `playback`: the scores of bicubic playback on the same recordings.
    - `seconds`: since this call; `waited`: the part of them in which no example was ready.
    """

    status: TrainingStatus
    model: Any
    steps: int
    skipped: int
    losses: Float[np.ndarray, " steps"]
    validated: list[dict[str, Any]]
    playback: dict[str, float]
    seconds: float
    waited: float

    def lines(self) -> list[str]:
        """A summary to print."""
        lines = [
            f"{self.steps} steps, {self.skipped} of them skipped; {self.seconds:.0f} s, of which {self.waited:.0f} s "
            f"were spent waiting for examples."
        ]
        if self.validated:
            last = self.validated[-1]
            lines.append(
                f"Validation: {last['psnr']:.2f} dB, structural similarity {last['ssim']:.3f}; playback enlarged "
                f"{self.playback['psnr']:.2f} dB and {self.playback['ssim']:.3f}."
            )
        return lines


class _State(NamedTuple):
    weights: PyTree
    average: PyTree
    optimiser: PyTree
    done: Int[Array, ""]
    skipped: Int[Array, ""]
    in_a_row: Int[Array, ""]


def train(config: TrainingConfig, out: str | os.PathLike[str], *, progress: Progress | None = None) -> Training:
    """Trains a network from the start, or resumes the run in the folder `out`.

    A step takes the mean loss over a batch, its gradient cut to the length `clip`, and one step of Adam. The average of
    the weights follows with min(`ema_decay`, (1 + n)/(10 + n)) after n steps, so that a short run is not held back by
    its first weights.

    **Raises:** `InputError` if the folder cannot be written, holds the run of another configuration, or the pictures
    cannot be used.
    """
    ready()
    check_progress(progress)
    started, folder = time.perf_counter(), Path(out)
    task = trainable(config.model, config.scale, config.network)
    examples = _examples(config)
    _make_folder(folder)
    # A resumed run has its own weights, and those it once started from may be gone.
    model, origins = (task.build(jax.random.key(config.seed)), []) if _begun(folder) else _built(config, task)
    state, static, optimiser = _first(config, model)
    history = _History(folder, config, static, task, origins)
    state = history.resume(state)
    step = _step(static, task, optimiser, config)
    progress = NoProgress() if progress is None else progress
    start, waited, unread = int(state.done), 0.0, []
    feed = _feed(config, task, examples, start, folder, progress)
    progress.start(config.steps, "Training")
    progress.advance(start)
    try:
        with closing(feed):
            for done in range(start + 1, config.steps + 1):
                asked = time.perf_counter()
                batch = next(feed)
                waited += time.perf_counter() - asked
                state, loss = step(state, batch)
                unread.append(loss)
                last = done == config.steps
                validate = last or done % config.validate_every == 0
                save = last or done % config.save_every == 0
                if validate or save or done % _READ_EVERY == 0:
                    history.losses += [float(value) for value in unread]
                    unread.clear()
                    if int(state.in_a_row) >= config.skip_limit:
                        break
                if validate:
                    history.validate(state)
                if save:
                    history.save(state)
                progress.advance(1)
    finally:
        progress.finish()
    diverged = int(state.in_a_row) >= config.skip_limit
    return Training(
        TrainingStatus.diverged if diverged else TrainingStatus.finished,
        eqx.combine(state.average, static),
        int(state.done),
        int(state.skipped),
        np.array(history.losses, np.float32),
        history.validated,
        history.playback,
        time.perf_counter() - started,
        waited,
    )


def learning_rate(config: TrainingConfig) -> Callable[[Any], Any]:
    """The learning rate as a function of the step, from 0."""
    rate = float(config.rate)
    match config.schedule:
        case "constant":
            return optax.constant_schedule(rate)
        case "halving":
            return optax.exponential_decay(rate, config.halve_every, 0.5, staircase=True)
        case _:
            # A warm-up as long as the run would leave no steps to come down in.
            warm_up = min(config.warm_up, config.steps - 1)
            first = 0.0 if warm_up else rate
            return optax.warmup_cosine_decay_schedule(first, rate, warm_up, config.steps, 0.01 * rate)


def _examples(config: TrainingConfig) -> Examples:
    pictures = Pictures.samples() if config.pictures is None else Pictures.folder(config.pictures)
    return Examples(
        config.scale,
        config.frames,
        config.patch,
        config.seed,
        config.scenes,
        config.lights,
        pictures,
        drawings=config.drawings,
        defects=config.defects,
    )


def _feed(
    config: TrainingConfig, task: Trainable, examples: Examples, start: int, folder: Path, progress: Progress
) -> Generator[Any, None, None]:
    """The batches from step `start` on: each example new, or drawn from those that are prepared now."""
    cores = os.cpu_count() or 1
    if task.preparation is None:
        workers = max(1, min(8, cores - 1)) if config.workers is None else config.workers
        return batches(examples, config.batch, start, config.steps, workers=workers)
    if config.prepared is None:
        raise InputError(
            f"The network {config.model!r} learns from examples that are prepared before the first step, but the "
            f"configuration does not say how many: add an entry prepared, for example prepared = 800."
        )
    fields = ("scale", "frames", "patch", "scenes", "lights", "pictures", "seed", "prepared", "drawings", "defects")
    made_of = {"model": config.model, "network": dict(task.preparation.made_of)}
    made_of |= {name: value for name, value in config.plain().items() if name in fields}
    preparing = Preparing(examples, config.model, config.scale, config.network)
    workers = min(8, cores) if config.workers is None else config.workers
    drawn = prepare(preparing, config.prepared, folder / "examples", made_of, workers=workers, progress=progress)
    return _drawn(drawn, config, start, task.preparation.varied)


def _drawn(
    examples: list[Any], config: TrainingConfig, start: int, varied: Callable[[Any, Any], Any] | None = None
) -> Generator[Any, None, None]:
    """Batches of examples, all of them once in an order of chance, then again in another; by seed and step alone."""

    @functools.lru_cache(maxsize=2)
    def order(turn: int) -> Int[np.ndarray, " n"]:
        return np.random.default_rng([config.seed, turn]).permutation(len(examples))

    for step in range(start, config.steps):
        numbers = (divmod(n, len(examples)) for n in range(step * config.batch, (step + 1) * config.batch))
        several = [examples[order(turn)[place]] for turn, place in numbers]
        if varied is not None:
            rng = np.random.default_rng([config.seed, step, 1])
            several = [varied(example, rng) for example in several]
        yield stacked(several)


def _make_folder(folder: Path) -> None:
    try:
        (folder / "samples").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"The folder {folder} cannot be made: {(error.strerror or str(error)).lower()}.") from error


def _begun(folder: Path) -> bool:
    return (folder / "state").exists()


def _built(config: TrainingConfig, task: Trainable) -> tuple[Any, list[dict[str, Any]]]:
    """The network before the first step, and what its card is to say of the files that its weights are from."""
    model, origins = task.build(jax.random.key(config.seed)), []
    for name in config.start or ():
        model, card = checkpoint.grafted(model, name)
        origins.append({"file": Path(name).name, "model": card.model, "steps": card.steps, "data": card.data})
    return model, origins


def _first(config: TrainingConfig, model: Any) -> tuple[_State, PyTree, optax.GradientTransformation]:
    weights, static = eqx.partition(model, eqx.is_inexact_array)
    optimiser = optax.chain(optax.clip_by_global_norm(float(config.clip)), optax.adam(learning_rate(config)))
    average = jax.tree.map(jnp.copy, weights)  # a buffer may be donated only once
    none = [jnp.zeros((), jnp.int32) for _ in range(3)]
    return _State(weights, average, optimiser.init(weights), *none), static, optimiser


def _step(static: PyTree, task: Trainable, optimiser: optax.GradientTransformation, config: TrainingConfig) -> Any:
    """The compiled step: (state, batch) → (state, loss). The old state's memory is used for the new one."""
    compute = jnp.dtype(config.precision)

    def mean_loss(weights: PyTree, batch: Any) -> Float[Array, ""]:
        model = eqx.combine(jax.tree.map(lambda leaf: leaf.astype(compute), weights), static)
        return jnp.mean(jax.vmap(lambda example: task.loss(model, example))(batch).astype(jnp.float32))

    def step(state: _State, batch: Any) -> tuple[_State, Float[Array, ""]]:
        loss, gradient = jax.value_and_grad(mean_loss)(state.weights, batch)
        good = jnp.isfinite(loss) & jnp.isfinite(optax.tree.norm(gradient))
        with jax.numpy_dtype_promotion("standard"):  # optax counts steps in int32 and multiplies by them
            changes, after = optimiser.update(gradient, state.optimiser, state.weights)
        weights = _chosen(good, optax.apply_updates(state.weights, changes), state.weights)
        n = (state.done - state.skipped).astype(jnp.float32)
        keep = jnp.minimum(config.ema_decay, (1.0 + n) / (10.0 + n))
        average = jax.tree.map(lambda old, new: keep * old + (1.0 - keep) * new, state.average, weights)
        bad = jnp.where(good, 0, 1)
        return _State(
            weights,
            _chosen(good, average, state.average),
            _chosen(good, after, state.optimiser),
            state.done + 1,
            state.skipped + bad,
            bad * (state.in_a_row + 1),
        ), loss

    return jax.jit(step, donate_argnums=0)


def _chosen(first: Bool[Array, ""], yes: PyTree, no: PyTree) -> PyTree:
    return jax.tree.map(lambda a, b: jnp.where(first, a, b), yes, no)


class _History:
    """Losses and scores of a run, and its folder."""

    def __init__(
        self, folder: Path, config: TrainingConfig, static: PyTree, task: Trainable, origins: list[dict[str, Any]]
    ):
        self.losses: list[float] = []
        self.validated: list[dict[str, Any]] = []
        self._folder, self._config, self._static, self._origins = folder, config, static, origins
        self._cases = validation.validation_set(config.scale, config.frames, config.patch)
        images = [validation.playback(case, config.scale) for _, case in self._cases]
        self.playback = validation.scores(self._cases, images, config.scale)
        picture: Callable[..., Any] = task.picture
        self._given: list[tuple[Any, ...]] = [(case.spikes, case.white_rate) for _, case in self._cases]
        if task.preparation is not None:
            picture = task.preparation.picture
            self._given = [(dict(task.preparation.make(case)),) for _, case in self._cases]
        self._picture = jax.jit(lambda weights, *given: picture(eqx.combine(weights, static), *given))

    def resume(self, first: _State) -> _State:
        """The state in the folder, or `first` if there is none."""
        path = self._folder / "state"
        if not _begun(self._folder):
            return first
        header, payload = checkpoint.read(path)
        if "run" not in header:
            raise InputError(f"{path} is not the state of a run: train into another folder.")
        fixed = [{k: v for k, v in run.items() if k not in _FREE} for run in (header["run"], self._config.plain())]
        checkpoint.check_same(path, fixed[0], fixed[1])
        if header["steps"] > self._config.steps:
            raise InputError(
                f"{path} has {header['steps']} steps behind it, but the configuration has {self._config.steps}: raise "
                f"that, or train into another folder."
            )
        state, losses = checkpoint.unpacked(path, payload, (first, np.zeros(header["steps"], np.float32)))
        self.losses, self.validated = [float(loss) for loss in losses], header["validated"]
        self._origins = header.get("origins", [])
        return state

    def validate(self, state: _State) -> None:
        """Scores the averaged weights, writes samples, and keeps the weights if they are the best."""
        scale = self._config.scale
        images = [np.asarray(self._picture(state.average, *given)) for given in self._given]
        found = validation.scores(self._cases, images, scale)
        best = all(not found["psnr"] <= row["psnr"] for row in self.validated)
        self.validated.append({"step": int(state.done)} | found)
        validation.write_samples(self._folder / "samples" / f"{int(state.done):06d}.png", self._cases, images, scale)
        if best and math.isfinite(found["psnr"]):
            self._keep("best.scsr", state)

    def save(self, state: _State) -> None:
        """Writes everything; the state comes last, as its presence means that the rest is complete."""
        losses, folder = np.array(self.losses, np.float32), self._folder
        self._keep("last.scsr", state)
        with jax.numpy_dtype_promotion("standard"):
            planned = np.asarray(learning_rate(self._config)(jnp.arange(losses.size)))
        rates = np.broadcast_to(planned, losses.shape)  # a constant one is a single number
        rows = [(n + 1, float(loss), float(rate)) for n, (loss, rate) in enumerate(zip(losses, rates, strict=True))]
        validation.write_table(folder / "loss.csv", ("step", "loss", "rate"), rows)
        if self.validated:
            columns = list(self.validated[0])
            rows = [tuple(row[name] for name in columns) for row in self.validated]
            validation.write_table(folder / "validation.csv", columns, rows)
        validation.draw_curves(folder / "curves.png", losses, self.validated, self.playback["psnr"])
        header = {"run": self._config.plain(), "steps": int(state.done), "validated": self.validated}
        header |= {"origins": self._origins} if self._origins else {}
        checkpoint.write(folder / "state", checkpoint.packed(header, (state, losses)))

    def _keep(self, name: str, state: _State) -> None:
        config = self._config
        training = {k: v for k, v in config.plain().items() if k not in ("model", "scale", "network", "pictures")}
        looked_at = "scikit-image's own" if config.pictures is None else Path(config.pictures).name
        card = checkpoint.Card(
            model=config.model,
            configuration={"scale": config.scale, "network": dict(config.network)},
            data=f"simulated recordings of pictures ({looked_at})",
            steps=int(state.done),
            hardware=f"{jax.devices()[0].device_kind}, {jax.default_backend()}",
            scores={k: v for k, v in (self.validated[-1] if self.validated else {}).items()},
            training=training | ({"start": self._origins} if self._origins else {}),
        )
        checkpoint.save(self._folder / name, eqx.combine(state.average, self._static), card)


__all__ = ["Training", "TrainingConfig", "TrainingStatus", "learning_rate", "train"]
