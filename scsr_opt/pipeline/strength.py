"""The strength λ of the prior in Eq. 4, from the recording itself.

Two things are known. The noise between neighbouring intervals of a pixel is a measure of how far the gradient of f is
moved by chance (`strength_of_noise`); on that scale the best strength of stills and clips by day lies within a factor
of 2 of 1. In dim light it does not: the noise of photons stays where that of counting in whole frames averages out, and
smooth scenes want several times as much. So λ is validated (`StrengthSearch`): part of the samples is held out, and the
picture made from the others has to predict them.
"""

import dataclasses
import math
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from scsr_opt._kernels.device import on_device
from scsr_opt._threads import in_threads
from scsr_opt._validation import number
from scsr_opt.camera.samples import Samples, padded_length, spike_intervals
from scsr_opt.camera.sampling_rules import Intervals, SamplingRule
from scsr_opt.camera.saturation import spike_counts
from scsr_opt.camera.sparse import sparse_pixels
from scsr_opt.errors import InputError
from scsr_opt.motion.trajectory import Motion, Trajectory
from scsr_opt.operators.data_term import DataTerm, blurred
from scsr_opt.operators.exposure import with_exposure
from scsr_opt.operators.operator import LinearOperator
from scsr_opt.operators.sampling import PlacedSamples, accumulate, place
from scsr_opt.pipeline.clip import Clip
from scsr_opt.pipeline.folds import held_out, light_at_rest
from scsr_opt.pipeline.measurement import Measurements, measure
from scsr_opt.pipeline.restoration import Restoration, solved
from scsr_opt.pipeline.settings import SamplingSettings, StrengthSettings
from scsr_opt.priors.centred import Centred
from scsr_opt.priors.huber_total_variation import HuberTotalVariation
from scsr_opt.priors.prior import Prior
from scsr_opt.priors.ridge_regulariser import RidgeRegulariser
from scsr_opt.solvers.loop import run
from scsr_opt.solvers.problem import Problem
from scsr_opt.solvers.proximal_gradient import FISTA
from scsr_opt.solvers.solver import Solver


def strength_of_noise(noise: float, scale: int, prior: Prior, settings: StrengthSettings = StrengthSettings()) -> float:
    """λ from how much neighbouring intervals differ (`noise_of_mean`). **Raises:** as `relative_strength`."""
    return settings.noise_factor * noise * 2 / scale * relative_strength(prior)


def relative_strength(prior: Prior) -> float:
    """`Prior.relative_strength`. **Raises:** `InputError` where the prior has none, or it is no number above 0."""
    found, name = prior.relative_strength, type(prior).__name__
    if found is None:
        raise InputError(
            f"No strength is given, and {name} has no relative_strength by which it could be found from the recording: "
            "give strength (docs/howto.md says how to choose one; for PlugAndPlay about the variance of the noise to "
            "be taken away at sensor resolution, such as 1e-3)."
        )
    if callable(found):
        raise InputError(f"{name}.relative_strength is a method; put @property on the line above it.")
    return number(found, f"{name}.relative_strength", lambda value: 0 < value < math.inf, "above 0")


def noise_of_mean(clip: Clip, settings: StrengthSettings = StrengthSettings()) -> float:
    """Standard deviation of a pixel's mean over the recording, intensity, as neighbouring intervals differ by it; from
    a sample of the pixels (`sparse_pixels`), every second row and column or fewer.

    Where most pixels fire less than twice, there are hardly any intervals to tell. A mean is then known to a spike of
    chance phase: the variance of a count ⌊x + u⌋, u uniform, is 1/6 in the mean over x.
    """
    apart = max(2, round((clip.spikes[0].size / settings.noise_pixels) ** 0.5))
    few = sparse_pixels(clip.spikes, apart)
    bad = None if clip.bad_pixels is None else sparse_pixels(clip.bad_pixels, apart)
    samples = spike_intervals(few, white_rate=clip.white_rate, bad_pixels=bad, ends=0)
    if clip.light is not None:
        samples = clip.light.sparse(apart).corrected(samples, few.shape[2])
    follows = (samples.row[1:] == samples.row[:-1]) & (samples.column[1:] == samples.column[:-1])
    difference = (samples.value[1:] - samples.value[:-1])[follows]
    duration = ((samples.weight[1:] + samples.weight[:-1]) / 2)[follows]
    if difference.size:
        noise = difference**2 * duration / 2  # variance of an interval of one frame
        noise = float(np.minimum(noise, np.quantile(noise, 0.9)).mean())  # passing edges are not noise
    else:
        noise = 0.0
    noise = max(noise, 1e-3)  # spikes are counted in whole frames: never free of it
    frames = len(clip.spikes)
    fired = np.count_nonzero(few, axis=0)[... if bad is None else ~bad]
    if fired.size and np.median(fired) < 2:
        noise = max(noise, 1 / (6 * clip.white_rate**2 * frames))
    return (noise / frames) ** 0.5


class ValidatedStrength(NamedTuple):
    """A strength λ, and what finding it left behind where the whole picture was one part.

    **Fields:**
    - `strength`: λ, of `prior` Ψ.
    - `restored`: false where the picture about a restored one predicts held-out samples worse than that of `prior`,
      which is the default one then.
    - `deviations`: standard deviations by which the picture about a restored one predicts held-out samples worse than
      the usual one (negative: better); None where nothing is restored.
    - `image`: (H, W), intensity, the picture of the tried strength nearest to it (before a prior that stood in is
      accounted for): a start much nearer to the solution than playback. None if it is not finite.
    - `term`: M, c and e of all samples, those that were held out added to the others; None where these sums are not
      used again, or strengths were tried on other samples than those of the picture.
    """

    strength: float
    prior: Prior
    restored: bool = True
    deviations: float | None = None
    image: Float[Array, "H W"] | None = None
    term: DataTerm | None = None


class _Split(NamedTuple):
    """Samples of a part of the picture, split in two.

    **Fields:** `kept`, those that a picture is made from; `held`, those that it has to predict; `image`, X^(0) of the
    part; `reused`: whether M and c of both are wanted by the solve that follows.
    """

    kept: PlacedSamples
    held: PlacedSamples
    image: Float[Array, "H W"]
    reused: bool = False


class _Fold:
    """A part of the picture on which strengths are tried: pictures of the kept samples have to predict the others.

    **Attributes:** `image`, the last picture, (H, W).
    """

    def __init__(self, split: _Split, optics: LinearOperator | None, solver: Solver, prior: Prior, strength: float):
        """The motion during exposures, if they are long, is corrected for by pictures of this strength."""
        self.image, self._split, self._solver, self._prior = split.image, split, solver, prior
        summed = [split.kept, split.held] if split.reused else [split.kept]
        self._sums = in_threads(partial(accumulate, optics=optics), summed)
        plain = Problem(self._sums[0], prior, on_device(np.float32(strength)))
        self._plain = self._term = solver.prepared(plain).data
        self._states: dict[float, Any] = {}
        for _ in range(2 if split.kept.finest > 1 else 0):
            self._solve(strength)
            self._term = with_exposure(self._plain, split.kept, self.image)

    def _solve(self, strength: float) -> None:
        """Makes the picture of this strength; it starts at the duals of the nearest one so far."""
        problem = Problem(self._term, self._prior, on_device(np.float32(strength)))
        nearest = min(self._states, key=lambda other: abs(math.log(other / strength)), default=None)
        similar = None if nearest is None else self._states[nearest]
        state = run(self._solver, problem, self._split.image, similar=similar).state
        self._states[strength], self.image = self._solver.kept(state), self._solver.image(state)

    @property
    def begun(self) -> bool:
        """True once there is a picture that others can start from."""
        return bool(self._states)

    def error(self, strength: float) -> Float[np.ndarray, "2"]:
        """Weighted sum of squares by which the picture of this strength misses the held-out samples, and of weights."""
        self._solve(strength)
        missed, weight = self._missed(self.image)
        return np.array([weight @ missed**2, weight.sum()])

    def difference(
        self, restoration: Restoration, prior: Prior, strength: float, usual: float | None
    ) -> Float[np.ndarray, "2"]:
        """By how much the picture with the prior centred at a restoration misses held-out samples more than the usual
        picture: weighted sum of the differences of squares, and of their squares; NaN where it is not finite.

        **Arguments:** `prior`, `strength` of the picture that is restored, which is the usual one, too, unless `usual`
        is given: that strength of the fold's own prior.
        """
        λ = on_device(np.float32(strength))
        first = run(self._solver, Problem(self._term, prior, λ), self.image).image
        centre = jnp.asarray(restoration(solved(self._term, first, λ)))
        if not bool(jnp.isfinite(centre).all()):
            return np.full(2, np.nan)
        stronger = on_device(np.float32(restoration.strength_ratio * strength))
        second = run(self._solver, Problem(self._term, Centred(prior, centre), stronger), centre).image
        if usual is not None:
            self._solve(usual)
        without, weight = self._missed(on_device(first) if usual is None else self.image)
        differences = weight * (self._missed(on_device(second))[0] ** 2 - without**2)
        return np.array([differences.sum(), (differences**2).sum()])

    def _missed(self, image: Float[Array, "H W"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """By how much a picture misses each held-out sample, and their weights."""
        held = self._split.held
        missed = np.asarray(held.read(blurred(self._plain, image))) - np.asarray(held.value)
        return missed.astype(float), np.asarray(held.weight, float)  # sums of hundreds of thousands

    def term(self) -> DataTerm | None:
        """M, c and e of all its samples; None where those of the held-out ones were not summed."""
        return _added(*self._sums) if len(self._sums) == 2 else None


@dataclass(frozen=True, kw_only=True)
class StrengthSearch:
    """Search for the λ that predicts held-out samples.

    **Fields:**
    - `scale` s; `prior`, `solver`, `sampling`, `gain` and `optics` as for the reconstruction. `FISTA` stands in for
      solvers that use the prior's proximal step, as it does, and `HuberTotalVariation` for a `RidgeRegulariser`.
    - `restoration`: what restores the solution, if anything; about its picture held-out samples must not be predicted
      worse, beyond chance, than by the solution itself, or, with `by_stand_in`, than by that of the stand-in.
    - `noise`: standard deviation of a pixel's mean (`noise_of_mean`), intensity; found if None.
    - `merged_intervals`: whether intervals are merged where nothing moves; `reused_sums`: whether M and c of kept and
      held-out samples are added up for the solve that follows (`Shortcuts`).
    - `sampling_settings`: how parts of the picture are measured; `settings`: which samples are held out, which
      strengths are tried, and how much stronger than these the prior becomes.
    """

    scale: int
    prior: Prior
    solver: Solver
    sampling: SamplingRule
    gain: Float[np.ndarray, "h w"] | None = None
    optics: LinearOperator | None = None
    restoration: Restoration | None = None
    by_stand_in: bool = False
    noise: float | None = None
    merged_intervals: bool = True
    reused_sums: bool = True
    sampling_settings: SamplingSettings = field(default_factory=SamplingSettings)
    settings: StrengthSettings = field(default_factory=StrengthSettings)

    def find(
        self, clip: Clip, motion: Motion, measurements: Measurements | Trajectory, image: Float[Array, "H W"]
    ) -> "ValidatedStrength":
        """λ by holding out a fifth of the samples: the strength that predicts them best, and somewhat more.

        Strengths a factor of 2 apart around that of the noise are tried, the best is interpolated. Up to three parts of
        the picture serve, of 256 high-resolution pixels a side, so that the cost does not grow with the sensor: a plain
        one, one of middling contrast and a rich one, as one part alone may ask for a quarter or for four times of what
        the whole does. A lens makes the whole picture one part, as its blur is made for one size.

        **Arguments:** `measurements` of the clip along the motion, or where parts of the picture serve (`in_parts`),
        which are measured anew, its trajectory alone; `image`, X^(0).

        **Raises:** as `relative_strength`.
        """
        settings = self.settings
        noise = noise_of_mean(clip, settings) if self.noise is None else self.noise
        least = strength_of_noise(noise, self.scale, self.prior, settings)
        parts = self._splits(clip, motion, measurements, image)
        if not parts:
            return ValidatedStrength(least, self.prior)
        # A prior that is used by its gradient need not have a proximal step.
        kind = FISTA() if self.solver.uses_prox else self.solver
        solver = dataclasses.replace(kind, iterations=settings.iterations, tolerance=settings.tolerance)
        ridge = isinstance(self.prior, RidgeRegulariser)
        stand_in = HuberTotalVariation() if ridge else self.prior
        share = relative_strength(self.prior) / relative_strength(stand_in)
        folds = in_threads(lambda part: _Fold(part[1], self.optics, solver, stand_in, least / share), parts)
        whole = folds[0].image.shape == image.shape
        errors: dict[float, float] = {}
        pictures: dict[float, Float[Array, "H W"]] = {}

        def error(factor: float) -> float:
            """Mean square by which held-out samples are missed at `factor` times the strength by noise."""
            if factor not in errors:
                sums = in_threads(lambda fold: fold.error(least * factor / share), folds)
                squares, weights = np.sum(sums, 0)
                errors[factor] = float(squares / weights)
                if whole:
                    pictures[factor] = folds[0].image
            return errors[factor]

        intervals = isinstance(self.sampling, Intervals)
        best, highest = 1.0, settings.most_tried if intervals else settings.most_tried_windows
        if not any(part.begun for part in folds):
            error(2.0)  # from nothing a smoother picture is found sooner, and is a start for others
        while error(best) > error(2 * best) and 2 * best < highest:
            best *= 2
        while best <= 1 and error(best / 2) < error(best) and best / 2 >= settings.least_tried:
            best /= 2
        best *= 2 ** _vertex(error(best / 2), error(best), error(2 * best))
        moved = motion.moved(len(clip.spikes))
        by_pixel = float(np.mean([(moved[area] >= settings.held_out_motion_px).mean() for area, _ in parts]))
        raised_by, at_least = (
            of_time ** (1 - by_pixel) * of_pixels**by_pixel
            for of_time, of_pixels in (settings.raised_by, settings.least_by_noise)
        )
        times, near, term = max(at_least, raised_by * best), None, None
        if whole:
            term = folds[0].term()
            near = pictures[min(pictures, key=lambda factor: abs(math.log(factor / times)))]
            near = near if np.isfinite(near).all() else None
        unrestored = ValidatedStrength(least * times / share, stand_in, False, image=near, term=term)
        if ridge:
            times = max(at_least, raised_by * settings.ridge_factor * best**settings.ridge_exponent)
        found = ValidatedStrength(least * times, self.prior, image=near, term=term)
        if self.restoration is None:
            return found
        usual = unrestored.strength if self.by_stand_in else None
        difference = partial(_Fold.difference, restoration=self.restoration, prior=self.prior)
        sums = in_threads(lambda fold: difference(fold, strength=found.strength, usual=usual), folds)
        worse, squares = np.sum(sums, 0)
        deviations = float(worse / squares**0.5) if squares != 0 else 0.0
        # Not where it is NaN: the solve reports what is not finite.
        if not deviations > settings.restoration_deviations:
            return found._replace(deviations=deviations)
        return (unrestored if self.by_stand_in else found)._replace(restored=False, deviations=deviations)

    def _splits(
        self, clip: Clip, motion: Motion, measurements: Measurements | Trajectory, image: Float[Array, "H W"]
    ) -> list[tuple[tuple[slice, slice], _Split]]:
        """Rows and columns, sensor pixels, of parts of the picture, with their samples split; none where too few
        samples are held out."""
        settings, side = self.settings, _side_of_parts(clip, self.scale, self.optics, self.settings)
        good = np.ones(clip.shape, bool) if clip.bad_pixels is None else ~clip.bad_pixels
        moved = motion.moved(len(clip.spikes))
        known, path = (
            (None, measurements) if isinstance(measurements, Trajectory) else (measurements, measurements.path)
        )
        on_sensor = len(path.position) == 1 if known is None else known.placed.on_sensor
        # Held-out intervals must not be merged with others.
        unmerged = None if known is None or (known.merged_for > 1).any() else known
        areas = _chosen_areas(image, self.scale, side, good, settings.most_parts)
        # One length for all parts, so that one program serves them: a pixel has one sample more than spikes at most.
        most = max(int(spike_counts(clip.spikes[:, *area]).sum()) + good[area].size for area in areas)

        def made(area: tuple[slice, slice]) -> _Split | None:
            # Sums of few pixels are too few to tell.
            merge = self.merged_intervals and int(good[area].sum()) >= settings.least_samples
            pieces, part, merged = unmerged, clip.part(*area), False
            first = on_device(np.asarray(image)[_scaled(area, self.scale)])
            gain = None if self.gain is None else self.gain[area]
            if pieces is None or good[area].shape != good.shape:
                # No more is merged than what is held out as a whole, if that holds intervals enough.
                if merge and isinstance(self.sampling, Intervals):
                    if on_sensor and self.sampling.noise is None and clip.light is None:
                        return self._split_at_rest(part, path.part(*area), first, gain)
                    frames_each = len(part.spikes) / np.maximum(spike_counts(part.spikes), 1)
                    merged = bool(frames_each.mean() <= settings.held_out_frames / 2)
                pieces = measure(
                    part,
                    path.part(*area),
                    scale=self.scale,
                    sampling=self.sampling,
                    gain=gain,
                    merged_intervals=merge,
                    longest=settings.held_out_frames if merged else 1,
                    on_sensor=self.merged_intervals,
                    least_padded=most if len(areas) > 1 else 0,
                    settings=self.sampling_settings,
                )
            reused = self.reused_sums and pieces is unmerged
            return _split(pieces, moved[area], merged, first, settings, reused=reused)

        return [(area, part) for area, part in zip(areas, in_threads(made, areas), strict=True) if part is not None]

    def _split_at_rest(
        self, part: Clip, path: Trajectory, first: Float[Array, "H W"], gain: Float[np.ndarray, "h w"] | None
    ) -> _Split | None:
        """The part of a scene at rest, where all intervals of a pixel that are kept make one sample, and all that are
        held out another; None where there are too few. The error differs from that of single intervals by a number that
        is the same for all pictures."""
        assert isinstance(self.sampling, Intervals)
        scale, (frames, height, width) = self.scale, part.spikes.shape
        rows, columns = (of.reshape(-1) for of in np.indices((height, width), np.int32))
        good = np.float32(1) if part.bad_pixels is None else ~part.bad_pixels
        over = np.float32(1) if gain is None else gain
        dark = np.float32(0) if part.dark is None else part.dark

        def placed(sums: Float[np.ndarray, "2 h w"]) -> PlacedSamples:
            light, time = sums
            samples = Samples(
                row=rows,
                column=columns,
                start=np.zeros(rows.size, np.float32),
                stop=np.full(rows.size, frames - 1, np.float32),
                value=((light / np.where(time > 0, time, 1) / np.float32(part.white_rate) - dark) / over)
                .reshape(-1)
                .astype(np.float32),
                weight=(time * good / np.float32(frames)).reshape(-1).astype(np.float32),
            ).padded()
            shape = (scale * height, scale * width)
            return place(jax.tree.map(on_device, samples), path, scale=scale, shape=shape, on_sensor=True)

        kept, held = map(placed, light_at_rest(part.spikes, ends=self.sampling.ends, settings=self.settings))
        if min(np.count_nonzero(some.weight) for some in (kept, held)) < self.settings.least_samples:
            return None
        return _Split(kept, held, first)


def _chosen_areas(
    image: Float[Array, "H W"], scale: int, side: int, good: Bool[np.ndarray, "h w"], most: int
) -> list[tuple[slice, slice]]:
    """Rows and columns, sensor pixels, of the parts that strengths are tried on.

    Parts are up to `side` a side. All that overlap by up to half are sorted by their mean contrast in `image` into
    groups, one for each part that fits beside the others, `most` at most; of each group the one nearest to its mean is
    taken, of equals that nearest to the middle. Only `good` pixels count, and parts with less than half their share of
    them are left out.
    """
    height, width = good.shape
    contrast = good * _contrast(np.asarray(image), scale)
    begins = [np.linspace(0, max(n - side, 0), 2 * -(-n // side) - 1).round() for n in good.shape]
    places = np.stack(np.meshgrid(*begins, indexing="ij"), -1).reshape(-1, 2).astype(int)
    places = places[np.argsort(np.hypot(*(places - places.mean(0)).T), kind="stable")]
    parts = [(slice(row, min(row + side, height)), slice(column, min(column + side, width)))
             for row, column in places.tolist()]  # fmt: skip
    enough = good.mean() / 2
    parts = [part for part in parts if good[part].mean() >= enough] or parts
    rich = np.array([contrast[part].sum() / max(good[part].sum(), 1) for part in parts])
    fitting = max(1, good.size // (min(side, height) * min(side, width)))
    groups = np.array_split(np.argsort(rich, kind="stable"), min(fitting, len(parts), most))
    return [parts[group[np.abs(rich[group] - rich[group].mean()).argmin()]] for group in groups]


def _contrast(image: Float[np.ndarray, "H W"], scale: int) -> Float[np.ndarray, "h w"]:
    """Mean of the differences from pixel to pixel in each sensor pixel."""
    differences = np.abs(np.diff(image, axis=0, prepend=image[:1])) + np.abs(
        np.diff(image, axis=1, prepend=image[:, :1])
    )
    height, width = (length // scale for length in image.shape)
    return differences.reshape(height, scale, width, scale).mean((1, 3))


def _scaled(area: tuple[slice, slice], scale: int) -> tuple[slice, slice]:
    """The high-resolution pixels of sensor pixels."""
    rows, columns = area
    return slice(scale * rows.start, scale * rows.stop), slice(scale * columns.start, scale * columns.stop)


def _split(
    taken: Measurements,
    moved: Float[np.ndarray, "h w"],
    merged: bool,
    first: Float[Array, "H W"],
    settings: StrengthSettings,
    *,
    reused: bool,
) -> _Split | None:
    """The samples, a fifth of them held out; None if there are too few to do so. `merged`: as of `held_out`; `reused`:
    as of `_Split`."""
    held = held_out(taken.padded, moved, merged=merged, settings=settings)
    weight = np.asarray(taken.placed.weight)
    counted = np.flatnonzero(held & (weight > 0))
    if min(counted.size, np.count_nonzero(weight) - counted.size) < settings.least_samples:
        return None
    kept, held_weight = (on_device(of) for of in (weight * ~held, weight * held))
    split = eqx.tree_at(lambda p: p.weight, taken.placed, kept)
    if reused:  # as many samples as are kept, so that one program sums both
        return _Split(split, eqx.tree_at(lambda p: p.weight, taken.placed, held_weight), first, reused)
    # Padded to one of few lengths, so that compiled code is used again; hardly ever are more than a quarter held out.
    filling = (0, padded_length(max(counted.size, weight.size // 4)) - counted.size)
    chosen = taken.placed.only(np.pad(counted, filling))
    return _Split(split, eqx.tree_at(lambda p: p.weight, chosen, on_device(np.pad(weight[counted], filling))), first)


def longest_merged(
    clip: Clip,
    motion: Motion,
    scale: int,
    optics: LinearOperator | None = None,
    settings: StrengthSettings = StrengthSettings(),
) -> int | None:
    """Frames over which intervals may be merged so that the same samples serve the picture and the validation: 1 where
    something moves and the whole picture is one part, as what is held out has to be in pieces; None for any."""
    return 1 if motion.speed.any() and not in_parts(clip, scale, optics, settings) else None


def in_parts(
    clip: Clip, scale: int, optics: LinearOperator | None = None, settings: StrengthSettings = StrengthSettings()
) -> bool:
    """True where strengths are tried on parts of the picture, false where on the whole."""
    return max(clip.spikes.shape[1:]) > _side_of_parts(clip, scale, optics, settings)


def _side_of_parts(clip: Clip, scale: int, optics: LinearOperator | None, settings: StrengthSettings) -> int:
    """Sensor pixels, at most, of a side of the parts that strengths are tried on: the whole picture's where it has no
    more pixels than the parts have together."""
    height, width = clip.shape
    small = scale**2 * height * width <= settings.most_parts * settings.part_px**2
    return max(height, width) if small or optics is not None else max(settings.part_px // scale, 1)


def _added(some: DataTerm, others: DataTerm) -> DataTerm:
    """The term of some samples and of others."""

    def sums(of: DataTerm) -> Any:
        return of.stencil.planes, of.target, of.energy

    total = [on_device(np.add(*both)) for both in zip(sums(some), sums(others), strict=True)]
    return eqx.tree_at(sums, some, tuple(total))


def _vertex(before: float, at: float, after: float) -> float:
    """The minimum of the parabola through three values at −1, 0 and 1, from −1 to 1."""
    curvature = before - 2 * at + after
    return float(np.clip((before - after) / (2 * curvature), -1, 1)) if curvature > 0 else 0.0
