"""`Prior`: the base class of image priors Ψ (paper, Eq. 4)."""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, ClassVar, Generic, TypeVar

import equinox as eqx
import jax
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from scsr_opt.errors import InputError

State = TypeVar("State")


class Prior(eqx.Module, Generic[State]):
    """An image prior Ψ (paper, Eq. 4), used through its value and its proximal step (paper, Eq. 5, second line).

    A prior of one's own defines `value`, and either `prox` (with `initial_state`, if it remembers something) or
    `smooth = True`; then its gradient is taken of `value`, and the solvers are `LBFGS` and `NonlinearCG`.

    Priors are values: whatever a proximal step wants to remember from one call to the next (the dual variable of total
    variation, say) travels through `state`, so that a solver can warm-start it and nothing is hidden.

    **Class variable:** `smooth`: whether Ψ has a Lipschitz-continuous gradient, that of `value`, so that methods
    without a proximal step can be used.
    """

    smooth: ClassVar[bool] = False

    @property
    def relative_strength(self) -> float | None:
        """The λ with which this prior does about as much as total variation with λ = 1: what an edge costs there over
        what it costs here. Where nobody gives λ, it is looked for around the one by noise times this. None where such
        a number does not exist; λ has to be given then."""
        return 1.0

    @property
    def separable(self) -> bool:
        """True where `prox` takes a strength w(p) for each pixel p, too: argmin over X of
        ½ Σ_p (X(p) − image(p))² / w(p) + Ψ(X)."""
        return False

    @property
    def lipschitz(self) -> float | None:
        """A Lipschitz constant of ∇Ψ, where Ψ is convex and smooth and one is known; None elsewhere."""
        return None

    @abc.abstractmethod
    def value(self, image: Float[Array, "H W"]) -> Float[Array, ""]:
        """Ψ(image)."""

    def gradient(self, image: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """∇Ψ(image), for priors that are `smooth`."""
        return jax.grad(self.value)(image)

    def value_after(self, image: Float[Array, "H W"], state: State) -> Float[Array, ""]:
        """Ψ(image), `image` and `state` being what a proximal step gave: for priors that know it by then."""
        return self.value(image)

    def clip(self, image: Float[Array, "H W"]) -> Float[Array, "H W"]:
        """The nearest picture at which Ψ is finite: the picture itself, for priors that are finite everywhere."""
        return image

    @property
    def has_prox(self) -> bool:
        """True where there is a proximal step. A smooth prior can do without (`LBFGS`, `NonlinearCG`)."""
        return type(self).prox is not Prior.prox

    def check(self, shape: tuple[int, int]) -> None:
        """Looks whether the prior can be used with pictures of this shape, before anything is computed.

        A prior of one's own is tried on shapes alone. Those of this package accept any shape, but for those that call
        a function of the user, which they try.

        **Raises:** `InputError` if it cannot be used.
        """
        if type(self).__module__.partition(".")[0] in ("scsr_opt", "learned"):
            return
        image, number = jax.ShapeDtypeStruct(shape, np.float32), jax.ShapeDtypeStruct((), np.float32)
        found = _tried(self, "value", shape, self.value, image)
        if jax.tree.leaves(jax.tree.map(np.shape, found)) or getattr(found, "dtype", None) is None:
            raise InputError(f"{type(self).__name__}.value must return one number, but it returns {_shapes(found)}.")
        if not self.has_prox:
            return
        state = _tried(self, "initial_state", shape, self.initial_state, image)
        found = _tried(self, "prox", shape, self.prox, image, number, state)
        if _types(found) != _types((image, state)) and _shapes(found) == _shapes((image, state)):
            raise InputError(
                f"{type(self).__name__}.prox must return numbers of the types that it was given, "
                f"{_types((image, state))}, but it returns {_types(found)}."
            )
        if _shapes(found) != _shapes((image, state)):
            raise InputError(
                f"{type(self).__name__}.prox must return a picture of the shape {shape} that it was given and a state "
                f"like that of initial_state, {_shapes((image, state))}, but it returns {_shapes(found)}."
            )

    def with_inner_iterations(self, iterations: int) -> "Prior":
        """This prior with at least `iterations` inner iterations of its proximal step, for a step that starts anew and
        not from the state of the last one; itself where the step has none."""
        given = getattr(self, "iterations", None)
        if isinstance(given, int) and given < iterations:
            return dataclasses.replace(self, iterations=iterations)  # pyright: ignore[reportCallIssue]
        return self

    def initial_state(self, image: Float[Array, "H W"]) -> State:
        """The state from which a first proximal step on a picture like `image` starts; none by default."""
        return ()  # type: ignore[return-value]

    def prox(
        self, image: Float[Array, "H W"], strength: Float[ArrayLike, "*pixels"], state: State
    ) -> tuple[Float[Array, "H W"], State]:
        """argmin over X of ½‖X − image‖² + strength · Ψ(X), and the state for the next call; with a strength for each
        pixel where the prior is `separable`."""
        raise InputError(f"{type(self).__name__} has no proximal step; use LBFGS or NonlinearCG, or define prox.")


def _tried(prior: Prior[Any], name: str, shape: tuple[int, int], method: Callable[..., Any], *arguments: Any) -> Any:
    """What a method gives, shapes alone. **Raises:** `InputError` for whatever error the method of a user raises."""
    try:
        return jax.eval_shape(method, *arguments)
    except InputError:
        raise
    except Exception as error:
        said = str(error).strip().split("\n")[0].rstrip(".")
        raise InputError(
            f"{type(prior).__name__}.{name} raised {type(error).__name__} for a picture of shape {shape}: {said}."
        ) from error


def _types(tree: Any) -> str:
    """The types of the numbers in nested tuples, for a message: `(float32, ())`."""
    return str(jax.tree.map(lambda leaf: str(jax.dtypes.result_type(leaf)), tree)).replace("'", "")


def _shapes(tree: Any) -> str:
    """The shapes of the arrays in nested tuples, for a message: `((24, 32), ())`."""
    return str(jax.tree.map(lambda leaf: tuple(np.shape(leaf)), tree)).replace("'", "")
