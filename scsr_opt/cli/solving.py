"""How `scsr solve` is to solve: options, and what they mean as arguments of `reconstruct`."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, nan
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter

from scsr_opt.cli.options import Whole
from scsr_opt.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    import scsr_opt.camera

Prior = Literal["ridge", "huber", "tv", "tv-anisotropic", "tgv", "bilateral", "wavelet", "nl-means", "red"]
Solver = Literal[
    "auto",
    "fista",
    "data-proximal",
    "ista",
    "admm",
    "condat-vu",
    "chambolle-pock",
    "nonlinear-cg",
    "lbfgs",
    "jaxopt-fista",
    "jaxopt-ista",
    "jaxopt-admm",
]
Robust = Literal["huber", "welsch"]


@Parameter(name="*", group=Group("Solving", sort_key=1))
@dataclass(frozen=True, kw_only=True)
class Solving:
    """Options of a solve; None where the default of `reconstruct` holds."""

    motion: Annotated[
        str,
        Parameter(
            allow_leading_hyphen=True,
            help="auto: the simplest motion that explains the recording (none, global, layers with occlusion, dense); "
            "none: nothing moves; phase: one translation; global: one translation, affine or perspective motion for "
            "the whole scene; dense: velocity and acceleration of each pixel; ilk, tvl1: a velocity for each pixel; "
            "DOWN,RIGHT: this velocity, sensor pixels per frame; FILE.npy: velocities of shape (2, height, width).",
        ),
    ] = "auto"
    refine: Annotated[
        Whole,
        Parameter(
            help="How many times the motion is fitted again to the solved picture, which is then solved for again."
        ),
    ] = 0
    light: Annotated[
        Literal["mean", "key", "constant"],
        Parameter(
            help="Where lamps flicker, show the scene at its mean light, or at that of the key frame; constant: do not "
            "search for flicker."
        ),
    ] = "mean"
    samples: Annotated[
        str,
        Parameter(
            help="How intensity is measured: intervals between spikes, or windows:N, counts of spikes over N frames."
        ),
    ] = "intervals"
    robust: Annotated[
        Robust | None, Parameter(help="Down-weight measurements that disagree with the picture. Default: do not.")
    ] = None
    gain: Annotated[
        str,
        Parameter(
            help="Gains of the pixels. FILE.npy: (height, width) numbers around 1, of the sensor or the crop; blind: "
            "estimated from the recording; auto: likewise, but used only if a fixed pattern is found; none: all 1."
        ),
    ] = "auto"
    optics: Annotated[
        str | None,
        Parameter(
            help="Blur of the lens: a standard deviation in sensor pixels; estimate: from the recording, if the scene "
            "moves. Default: no blur."
        ),
    ] = None
    quality: Annotated[
        Literal["fast", "best"],
        Parameter(
            help="best: a network improves the picture, and a second solve, with a prior around the network's picture, "
            "makes it agree with the data. Most scenes become better, in one to four times the time of fast; small "
            "letters and fine patterns may become worse."
        ),
    ] = "fast"
    prior: Annotated[
        Prior | None,
        Parameter(
            help="Which pictures are taken to be likely. ridge: those like photographs (learned); huber: flat parts, "
            "edges and soft shading; tv: flat parts and edges; tgv: slopes and edges; bilateral, wavelet: smooth at "
            "several scales; nl-means, red: texture that repeats (slow). Default: ridge up to --scale 3, above it "
            "huber."
        ),
    ] = None
    bounds: Annotated[
        str | None,
        Parameter(
            allow_leading_hyphen=True, help="Range of the intensities: LOW,HIGH or non-negative. Default: no bounds."
        ),
    ] = None
    strength: Annotated[
        float | None,
        Parameter(
            help="Strength of the prior (lambda). Default: by cross-validation on held-out measurements; with "
            "--robust, from their noise."
        ),
    ] = None
    solver: Annotated[
        Solver,
        Parameter(
            help="All solvers find the same picture if the prior is convex. auto: fista, or data-proximal if nothing "
            "moves, the prior is weak enough and --iterations is not given; ista: Eq. 5 of the paper. data-proximal, "
            "nonlinear-cg and lbfgs are for --prior ridge and huber."
        ),
    ] = "auto"
    iterations: Annotated[
        Whole | None,
        Parameter(
            help="Largest number of iterations of each solve. Default: 200, for condat-vu and chambolle-pock 400, for "
            "jaxopt-ista and jaxopt-fista 100."
        ),
    ] = None

    skip: Annotated[
        bool,
        Parameter(
            help="Leave out the work that this scene does not need; --no-skip does all of it, to compare. --explain "
            "says what was left out."
        ),
    ] = True

    def check(self) -> None:
        """**Raises:** `InputError` for what is wrong whatever the recording."""
        if self.iterations is not None and self.iterations < 1:
            raise InputError(f"--iterations is {self.iterations}, but it must be at least 1.")
        if self.refine < 0:
            raise InputError(f"--refine is {self.refine}, but it must be at least 0.")
        if self.strength is not None:
            from scsr_opt._validation import prior_strength

            prior_strength(self.strength, "--strength")

    def arguments(
        self, recording: "scsr_opt.camera.Recording", scale: int, crop: tuple[int, int, int, int] | None
    ) -> dict[str, Any]:
        """Arguments of `reconstruct`; options that were not given are left to its defaults.

        `recording`: of the whole sensor.

        **Raises:** `InputError` for what does not go together, or with this recording.
        """
        from scsr_opt import Shortcuts
        from scsr_opt._kernels.programs import ready

        ready()  # priors and blurs below are made of JAX's arrays
        part = recording if crop is None else recording.crop(*crop)
        shapes = sorted({(known.height, known.width) for known in (recording, part)}, reverse=True)
        given = {
            "motion": motion_of((recording.height, recording.width), crop, self.motion),
            "samples": self._samples(recording),
            "robust": self._robust(),
            "gain": self._gain(shapes),
            "optics": self._optics(part, scale),
            "quality": None if self.quality == "fast" else self.quality,
            "prior": self._prior(scale),
            "strength": self.strength,
            "solver": self._solver(),
            "refine": self.refine or None,
            "light": None if self.light == "mean" else self.light,
            "shortcuts": None if self.skip else Shortcuts.none(),
            "crop": crop,
        }
        return {name: value for name, value in given.items() if value is not None}

    def several(
        self, recording: "scsr_opt.camera.Recording", scale: int, crop: tuple[int, int, int, int] | None
    ) -> dict[str, Any]:
        """Arguments of `reconstruct_sequence`, as `arguments` gives those of `reconstruct`.

        **Raises:** `InputError` as well for a motion that holds at one moment.
        """
        from scsr_opt.motion import Estimator

        found = self.arguments(recording, scale, crop)
        if not isinstance(found.get("motion"), Estimator | None):
            raise InputError(
                f"--motion {self.motion} is the velocity at one moment, but a sequence has many: give auto, none, "
                f"phase, global, dense, ilk or tvl1."
            )
        return found

    def _samples(self, recording: "scsr_opt.camera.Recording") -> Any:
        if self.samples == "intervals":
            return None
        kind, _, length = self.samples.partition(":")
        if kind != "windows" or not 1 <= _number(length) <= recording.frames or not length.isdecimal():
            raise InputError(
                f"--samples is {self.samples}, but it must be intervals or windows:N, N from 1 to {recording.frames} "
                f"frames."
            )
        from scsr_opt.camera import Windows

        return Windows(int(length))

    def _robust(self) -> Any:
        from scsr_opt import operators

        return None if self.robust is None else {"huber": operators.Huber, "welsch": operators.Welsch}[self.robust]()

    def _gain(self, shapes: list[tuple[int, int]]) -> Any:
        if self.gain in ("auto", "blind"):
            return None if self.gain == "auto" else self.gain
        if self.gain == "none":
            import numpy as np

            return np.ones(shapes[0], np.float32)
        if not self.gain.endswith(".npy"):
            raise InputError(f"--gain is {self.gain}, but it must be auto, blind, none or the name of a .npy file.")
        gain = load_npy("gain", self.gain)
        if gain.shape not in shapes or gain.dtype.kind not in "fiu" or not ((gain > 0) & (gain < inf)).all():
            raise InputError(
                f"--gain {self.gain} holds {gain.dtype} of shape {gain.shape}, but gains are {_either(shapes)}, "
                f"finite and above 0."
            )
        return gain

    def _optics(self, recording: "scsr_opt.camera.Recording", scale: int) -> Any:
        if self.optics is None or self.optics == "estimate":
            return self.optics
        longer = max(recording.height, recording.width)
        if not 0 <= _number(self.optics) <= longer:
            raise InputError(
                f"--optics is {self.optics}, but it must be estimate or a standard deviation from 0 to {longer} sensor "
                f"pixels, the longer side of the recording."
            )
        from scsr_opt.operators import Blur

        return Blur.gaussian((scale * recording.height, scale * recording.width), float(self.optics) * scale)

    def _prior(self, scale: int) -> Any:
        if self.prior is None and self.bounds is None:
            return None
        from scsr_opt import priors
        from scsr_opt.pipeline.defaults import default_prior

        prior = {
            None: lambda: default_prior(scale),
            "ridge": priors.RidgeRegulariser.load,
            "huber": priors.HuberTotalVariation,
            "tv": priors.TotalVariation,
            "tv-anisotropic": lambda: priors.TotalVariation(isotropic=False),
            "tgv": priors.TotalGeneralizedVariation,
            "bilateral": priors.BilateralTotalVariation,
            "wavelet": priors.WaveletL1,
            "nl-means": lambda: priors.PlugAndPlay(priors.nl_means()),
            "red": lambda: priors.RED(priors.nl_means()),
        }[self.prior]()
        if self.bounds is None:
            return prior
        if self.bounds == "non-negative":
            return priors.Bounded(prior)
        low, _, high = self.bounds.partition(",")
        if not -inf < _number(low) < _number(high) < inf:
            raise InputError(
                f"--bounds is {self.bounds}, but it must be LOW,HIGH with LOW below HIGH, such as 0,1, or non-negative."
            )
        return priors.Bounded(prior, float(low), float(high))

    def _solver(self) -> Any:
        if self.solver == "auto" and self.iterations is None:
            return None
        from scsr_opt import solvers

        method = {
            "auto": solvers.FISTA,
            "fista": solvers.FISTA,
            "data-proximal": solvers.DataProximal,
            "ista": solvers.ISTA,
            "admm": solvers.ADMM,
            "condat-vu": solvers.CondatVu,
            "chambolle-pock": solvers.ChambollePock,
            "nonlinear-cg": solvers.NonlinearCG,
            "lbfgs": solvers.LBFGS,
            "jaxopt-fista": solvers.JaxoptFISTA,
            "jaxopt-ista": solvers.JaxoptISTA,
            "jaxopt-admm": solvers.JaxoptADMM,
        }[self.solver]
        return method() if self.iterations is None else method(iterations=self.iterations)


def motion_of(shape: tuple[int, int], crop: tuple[int, int, int, int] | None, motion: str) -> Any:
    """An estimator or a motion; None where `reconstruct` is to choose.

    **Arguments:** `shape`: (h, w) of the sensor; `crop`: the part of it that is solved for, whose motion it is. A file
    may hold the velocities of either.

    **Raises:** `InputError` if `motion` is none of what the option allows.
    """
    import numpy as np

    from scsr_opt import motion as known
    from scsr_opt.motion.validation import FASTEST
    from scsr_opt.pipeline.options import cut_out

    named = {
        "none": known.Still,
        "phase": known.PhaseCorrelation,
        "global": known.Global,
        "dense": known.Dense,
        "ilk": known.ILK,
        "tvl1": known.TVL1,
    }
    if motion == "auto":
        return None
    if motion in named:
        return named[motion]()
    fields = [(2, *shape), *([] if crop is None else [(2, *crop[2:])])]
    if motion.endswith(".npy"):
        field = load_npy("motion", motion)
        if field.shape not in fields or field.dtype.kind not in "fiu" or not (np.abs(field) <= FASTEST).all():
            raise InputError(
                f"--motion {motion} holds {field.dtype} of shape {field.shape}, but a velocity is {_either(fields)}, "
                f"finite, in sensor pixels per frame, of {FASTEST:g} at most either way."
            )
        return known.Motion.of_velocity(cut_out(field, shape, crop).astype(np.float32))
    down, _, right = motion.partition(",")
    try:
        velocity = np.array([float(down), float(right)])
    except ValueError:
        raise InputError(
            f"--motion {motion} is not known: give auto, none, phase, global, dense, ilk, tvl1, DOWN,RIGHT in sensor "
            f"pixels per frame, or the name of a .npy file."
        ) from None
    if not (np.abs(velocity) <= FASTEST).all():
        raise InputError(
            f"--motion is {motion}, but DOWN,RIGHT must be two finite numbers of sensor pixels per frame, of "
            f"{FASTEST:g} at most either way."
        )
    return known.Motion.constant(velocity, shape if crop is None else crop[2:])


def _either(shapes: Sequence[tuple[int, ...]]) -> str:
    return " or, of the crop, ".join(str(shape) for shape in shapes)


def load_npy(option: str, path: str) -> "np.ndarray":
    """The array in a .npy file. **Raises:** `InputError` if it cannot be read."""
    import numpy as np

    try:
        return np.load(path, allow_pickle=False)
    except FileNotFoundError as error:
        raise InputError(f"There is no file {path} for --{option}: check the path.") from error
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"--{option} {path} cannot be read as a .npy file.") from error


def _number(text: str | None) -> float:
    try:
        return float(text or "")
    except ValueError:
        return nan
