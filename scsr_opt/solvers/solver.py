"""`Solver`, the base class of all methods for `Problem`, and the numbers that it records of an iteration."""

import abc
from typing import ClassVar, Generic, NamedTuple, TypeVar

import equinox as eqx
from jaxtyping import Array, Float

from scsr_opt._validation import checked_tolerance, iteration_count
from scsr_opt.errors import InputError
from scsr_opt.priors.prior import Prior
from scsr_opt.solvers.linear_solve import LinearSolve
from scsr_opt.solvers.problem import Problem, with_bound
from scsr_opt.solvers.step_size import Balance, StepSize
from scsr_opt.solvers.stopping import Stopping

State = TypeVar("State")


class Record(NamedTuple):
    """The numbers of a `Stage`, as arrays; `UNMEASURED` where a gap is not measured."""

    data: Float[Array, "..."]
    prior: Float[Array, "..."]
    residual: Float[Array, "..."]
    gap: Float[Array, "..."]
    step_size: Float[Array, "..."]


# Parts that a solver may have, their type, and an example of each.
_PARTS: dict[str, tuple[type, str]] = {
    "stopping": (Stopping, "FixedPoint()"), "step_size": (StepSize, "Separable() or Fixed(value)"),
    "balance": (Balance, "Balance(ratio)"), "linear_solve": (LinearSolve, "ConjugateGradients()"),
}  # fmt: skip


class Solver(eqx.Module, Generic[State]):
    """A method for `Problem`. It is a value; what changes from iteration to iteration is in its state.

    **Fields:**
    - `iterations`: the most that are done.
    - `stopping`: what is measured: `FixedPoint`, the relative residual ‖X − G(X)‖ / ‖X‖, G one proximal-gradient step
      (or a bound on it), or `DualityGap`.
    - `tolerance`: it ends when this is not above it.
    - `state_type`: the type of its states; `uses_prox`: whether it takes proximal steps of the prior.
    """

    state_type: eqx.AbstractClassVar[type]
    uses_prox: ClassVar[bool] = True
    iterations: eqx.AbstractVar[int]
    tolerance: eqx.AbstractVar[float | int]
    stopping: eqx.AbstractVar[Stopping]

    def __check_init__(self):
        name = type(self).__name__
        iteration_count(name, self.iterations, "iterations")
        for part, (kind, example) in _PARTS.items():
            given = getattr(self, part, None)
            if given is not None and not isinstance(given, kind):
                raise InputError(f"{name} was given {part}={given!r}; it must be a {kind.__name__}, such as {example}.")
        checked_tolerance(name, self.tolerance)

    def check(self, prior: Prior) -> None:
        """Raises `InputError` for a prior that it cannot use."""
        if self.uses_prox and not prior.has_prox:
            raise InputError(
                f"{type(self).__name__} was given {type(prior).__name__}, which has no proximal step; use LBFGS or "
                f"NonlinearCG, or define {type(prior).__name__}.prox."
            )
        self.stopping.check(prior)

    def prepared(self, problem: Problem) -> Problem:
        """The problem with the numbers that each solve with the same M needs, such as the bound of ‖BᵀMB‖."""
        return eqx.tree_at(lambda p: p.data, problem, with_bound(problem.data))

    @abc.abstractmethod
    def init(self, problem: Problem, image: Float[Array, "H W"]) -> State:
        """The state before the first iteration, from an initial image."""

    def warm(self, problem: Problem, state: State) -> State:
        """The state before the first iteration, from that of a run on a similar problem."""
        return self.init(problem, self.image(state))

    def retargeted(self, problem: Problem, before: Problem, state: State) -> State:
        """The state before the next iteration where c and e have become those of `problem`; nothing else has changed
        since `before`, the problem of the last iteration."""
        return self.warm(problem, state)

    def kept(self, state: State) -> State:
        """The state with the picture in the place of every field that `warm` does not read, to save memory."""
        return state

    @abc.abstractmethod
    def step(self, problem: Problem, state: State) -> tuple[State, Record]:
        """One iteration."""

    @abc.abstractmethod
    def image(self, state: State) -> Float[Array, "H W"]:
        """X^(t)."""

    @abc.abstractmethod
    def gradient_step(self, problem: Problem, state: State) -> Float[Array, "H W"]:
        """R^(t) of Eq. 5: the picture whose proximal step X^(t) is, or tends to be where the two are found together."""
