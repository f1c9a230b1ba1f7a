"""A function called outside `jit` compiles at its first call, and nothing at the calls that follow."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt._kernels.programs import compiled
from scsr_opt.camera.samples import Samples
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.operators import (
    Blur,
    Downsample,
    Huber,
    Observation,
    Warp,
    Welsch,
    accumulate,
    dot_test,
    norm_bound,
    place,
    robust_factors,
    spectral_norm,
    with_exposure,
)
from scsr_opt.priors import (
    RED,
    Analysis,
    BilateralTotalVariation,
    Bounded,
    Centred,
    HuberTotalVariation,
    PlugAndPlay,
    Prior,
    RidgeRegulariser,
    TotalGeneralizedVariation,
    TotalVariation,
    WaveletL1,
    bilateral,
    nl_means,
)
from scsr_opt.solvers import (
    ADMM,
    FISTA,
    ISTA,
    LBFGS,
    Backtracking,
    ChambollePock,
    CondatVu,
    DataProximal,
    DualityGap,
    Fixed,
    JaxoptADMM,
    JaxoptFISTA,
    JaxoptISTA,
    NonlinearCG,
    NormBound,
    Problem,
    Separable,
    Solver,
    SpectralNorm,
    implicit_minimiser,
    lipschitz_bound,
    run,
    with_bound,
)

pytestmark = pytest.mark.usefixtures("programs_stay")

SHAPE, SCALE, FRAMES = (12, 16), 2, 12
PICTURE = jnp.asarray(np.random.default_rng(0).uniform(0.1, 1, SHAPE), jnp.float32)


def compiles_once(heard: list[str], call: Callable[[int], Any]) -> None:
    """`call(number)` of numbers that are values, not shapes: two may compile, two more may not."""
    # The second call of a loop outside `jit` may still meet the state of the first, of another weak type.
    for number in range(2):
        call(number)
    heard.clear()
    for number in range(2, 4):
        call(number)
    assert not heard


def softer(image: jax.Array, sigma: jax.Array) -> jax.Array:
    return image / (1 + sigma)


PRIORS: dict[str, Callable[[], Prior]] = {
    "total variation": TotalVariation,
    "total variation, anisotropic, many steps": lambda: TotalVariation(isotropic=False, iterations=40),
    "huber": HuberTotalVariation,
    "wavelets": WaveletL1,
    "bilateral total variation": BilateralTotalVariation,
    "total generalised variation": lambda: TotalGeneralizedVariation(iterations=5, value_iterations=5),
    "ridge, weakly convex": lambda: RidgeRegulariser.load("weakly_convex"),
    "centred": lambda: Centred(TotalVariation(), PICTURE),
    "bounded": lambda: Bounded(TotalVariation(), 0, 1),
    "bounded by Dykstra's algorithm": lambda: Bounded(RidgeRegulariser.load(), 0, 1),
    "plug and play": lambda: PlugAndPlay(softer),
    "plug and play, non-local means": lambda: PlugAndPlay(nl_means()),
    "regularisation by denoising": lambda: RED(softer),
    "regularisation by denoising, bilateral": lambda: RED(bilateral()),
}


def grown(prior: Prior, n: int) -> Any:
    """A proximal step of another strength at each call, a Python number, as most write it."""
    return prior.prox(PICTURE, 0.1 + 0.01 * n, prior.initial_state(PICTURE))


PRIOR_CALLS: dict[str, Callable[[Prior, int], Any]] = {
    "value": lambda prior, n: prior.value(PICTURE + n),
    "prox, and value after it": lambda prior, n: prior.value_after(*grown(prior, n)),
    "prox of several": lambda prior, n: jax.vmap(lambda f: prior.prox(f, 0.1, prior.initial_state(f))[0])(
        jnp.stack([PICTURE, PICTURE + n])
    ),
}


# Each kind of program: dual steps, a closed form, filters, a prior in a prior, a function of the host. The others are
# tried by `make test-slow`; their value and proximal step here, too.
KINDS = ("huber", "bilateral total variation", "bounded by Dykstra's algorithm", "plug and play, non-local means")


def slow_unless(name: str, quick: bool) -> Any:
    return name if quick else pytest.param(name, marks=pytest.mark.slow)


@pytest.mark.parametrize("call", [slow_unless(call, "several" not in call) for call in PRIOR_CALLS])
@pytest.mark.parametrize("name", PRIORS)
def test_prior_called_outside_jit_compiles_once(heard, name, call):
    compiles_once(heard, lambda n: PRIOR_CALLS[call](PRIORS[name](), n))


DIFFERENTIABLE = [name for name in PRIORS if "means" not in name and "bilateral" != name[-9:]]


@pytest.mark.parametrize("name", [slow_unless(name, name in KINDS) for name in DIFFERENTIABLE])
def test_gradient_of_a_prior_outside_jit_compiles_once(heard, name):
    compiles_once(heard, lambda n: jax.grad(PRIORS[name]().value)(PICTURE + n))


@pytest.mark.parametrize(
    "name",
    [slow_unless(name, name in KINDS) for name in DIFFERENTIABLE if "ridge" not in name and "Dykstra" not in name],
)
def test_gradient_of_a_proximal_step_outside_jit_compiles_once(heard, name):
    """Backwards, too. The number of steps of the ridge regulariser is known at run time only, which JAX refuses."""
    prior = PRIORS[name]()
    state = prior.initial_state(PICTURE)
    compiles_once(heard, lambda n: jax.grad(lambda f: jnp.sum(PRIORS[name]().prox(f, 0.1 + n, state)[0]))(PICTURE))


@pytest.mark.parametrize("name", PRIORS)
def test_parts_of_a_prior_outside_jit_compile_once(heard, name):
    prior = PRIORS[name]()

    def parts(n: int) -> Any:
        made = PRIORS[name]()
        if made.smooth:
            made.gradient(PICTURE)
        if made.separable:
            made.prox(PICTURE, jnp.full(SHAPE, 0.1 + n), made.initial_state(PICTURE))
        if isinstance(made, Analysis):
            field = made.analysis(PICTURE + n)
            made.adjoint(field)
            made.shrink(field, jnp.asarray(0.1 + n, jnp.float32))
            made.conjugates(made.conjugate_prox(field, jnp.asarray(0.1 + n, jnp.float32)))
            made.gap(PICTURE, 0.1 + n, made.initial_state(PICTURE))

    if not (prior.smooth or prior.separable or isinstance(prior, Analysis)):
        pytest.skip("it has no others")
    compiles_once(heard, parts)


def motions() -> np.ndarray:
    return np.random.default_rng(7).uniform(0, 0.5, (3, 2, *SHAPE)).astype(np.float32)


OPERATORS: dict[str, Callable[[], Any]] = {
    "warp": lambda: Warp(motions()[0]),
    "blur": lambda: Blur.gaussian(SHAPE, (0.7, 1.2)),
    "downsample": lambda: Downsample(SHAPE, 2),
    "composition": lambda: Downsample(SHAPE, 2) @ Blur.gaussian(SHAPE, 1.0) @ Warp(motions()[0]),
    "observation": lambda: Observation(motions(), Downsample(SHAPE, 2) @ Blur.gaussian(SHAPE, 0.4)),
}


@pytest.mark.parametrize("name", OPERATORS)
def test_operator_outside_jit_compiles_once(heard, name):
    def use(n: int) -> None:
        operator = OPERATORS[name]()
        operator.adjoint(operator(PICTURE + n))
        operator.normal(PICTURE + n)
        jax.grad(lambda x: jnp.sum(operator(x) ** 2))(PICTURE + n)
        dot_test(operator)
        norm_bound(operator, iterations=n + 1)
        spectral_norm(operator, iterations=n + 1)

    compiles_once(heard, use)


def test_norms_of_a_function_outside_jit_compile_once(heard):
    blur = Blur.gaussian(SHAPE, 1.0)

    def use(n: int) -> None:
        norm_bound(blur.normal, SHAPE, iterations=n + 1, symmetric=True)
        norm_bound(blur.normal, SHAPE, iterations=n + 1)
        spectral_norm(blur.normal, SHAPE, iterations=n + 1)

    compiles_once(heard, use)


@pytest.fixture(scope="module")
def placed() -> Any:
    rng = np.random.default_rng(0)
    number, sensor = 300, tuple(n // SCALE for n in SHAPE)
    begin = rng.uniform(0, FRAMES - 3, number).astype(np.float32)
    row, column = (rng.integers(0, size, number).astype(np.int32) for size in sensor)
    value, weight = rng.uniform(0.1, 1, number).astype(np.float32), np.full(number, 0.5, np.float32)
    samples = Samples(row, column, begin, begin + 2, value, weight)
    velocity = np.broadcast_to(np.array((0.4, -0.3), np.float32)[:, None, None], (2, *sensor))
    path = trajectory_of(Motion.of_velocity(velocity), key=FRAMES // 2, start=0, stop=FRAMES)
    return place(jax.tree.map(jnp.asarray, samples), path, scale=SCALE, shape=SHAPE)


def test_samples_outside_jit_compile_once(heard, placed):
    term = accumulate(placed)

    def use(n: int) -> None:
        placed.spread(placed.read(PICTURE + n))
        placed.seen()
        placed.rows()
        placed.only(np.arange(5))
        accumulate(placed, robust=jnp.full_like(placed.weight, 0.5 + n))
        with_exposure(term, placed, PICTURE + n)
        for loss in (Huber(), Welsch()):
            robust_factors(loss, placed, PICTURE + n)
        jax.grad(term.value)(PICTURE + n)
        term.normal(PICTURE + n)
        term.gradient(PICTURE + n)

    compiles_once(heard, use)


SOLVERS: dict[str, Callable[[], Solver]] = {
    "ista": ISTA,
    "fista": FISTA,
    "fista, backtracking": lambda: FISTA(step_size=Backtracking()),
    "fista, fixed": lambda: FISTA(step_size=Fixed(0.1)),
    "fista, bound": lambda: FISTA(step_size=NormBound()),
    "fista, power iteration": lambda: FISTA(step_size=SpectralNorm()),
    "fista, separable, gap": lambda: FISTA(step_size=Separable(), stopping=DualityGap()),
    "admm": ADMM,
    "condat-vu": CondatVu,
    "chambolle-pock": ChambollePock,
    "conjugate gradients": NonlinearCG,
    "l-bfgs": LBFGS,
    "jaxopt ista": JaxoptISTA,
    "jaxopt fista": JaxoptFISTA,
    "jaxopt admm": JaxoptADMM,
}


@pytest.mark.filterwarnings("ignore:JAXopt is no longer maintained:DeprecationWarning")
@pytest.mark.parametrize(
    "name", [slow_unless(name, name in ("fista", "fista, power iteration", "admm", "l-bfgs")) for name in SOLVERS]
)
def test_solver_outside_jit_compiles_once(heard, placed, name):
    term = accumulate(placed)

    def use(n: int) -> None:
        solver, problem = SOLVERS[name](), Problem(term, HuberTotalVariation(), jnp.asarray(0.01 + n, jnp.float32))
        problem = solver.prepared(problem)
        state = solver.init(problem, PICTURE + n)
        state, _ = solver.step(problem, state)
        state, _ = solver.step(problem, state)
        solver.gradient_step(problem, solver.warm(problem, state))
        outcome = run(eqx.tree_at(lambda s: s.iterations, solver, 3 + n), problem, PICTURE, tolerance=1e-9)
        run(solver, problem, PICTURE, similar=outcome.state, tolerance=1.0)

    compiles_once(heard, use)


def test_data_proximal_outside_jit_compiles_once(heard):
    term = accumulate_at_rest()

    def use(n: int) -> None:
        solver, problem = DataProximal(), Problem(term, HuberTotalVariation(), jnp.asarray(0.01 + n, jnp.float32))
        solver.step(problem, solver.init(problem, PICTURE + n))

    compiles_once(heard, use)


def accumulate_at_rest() -> Any:
    rng = np.random.default_rng(1)
    rows, columns = (n // SCALE for n in SHAPE)
    row, column = (index.reshape(-1).astype(np.int32) for index in np.indices((rows, columns)))
    begin = np.zeros(row.size, np.float32)
    value = rng.uniform(0.1, 1, row.size).astype(np.float32)
    samples = Samples(row, column, begin, begin + FRAMES, value, np.ones(row.size, np.float32))
    path = trajectory_of(Motion.none(rows, columns), key=FRAMES // 2, start=0, stop=FRAMES)
    return accumulate(place(jax.tree.map(jnp.asarray, samples), path, scale=SCALE, shape=SHAPE, on_sensor=True))


def test_solution_and_bounds_outside_jit_compile_once(heard, placed):
    term = accumulate(placed)

    def use(n: int) -> None:
        lipschitz_bound(term)
        with_bound(term)
        for prior in (HuberTotalVariation(), RidgeRegulariser.load()):
            problem = Problem(term, prior, jnp.asarray(0.01 + n, jnp.float32))
            jax.grad(
                lambda λ, p=problem: jnp.sum(
                    implicit_minimiser(
                        eqx.tree_at(lambda q: q.strength, p, λ), PICTURE, iterations=3, adjoint_iterations=3
                    )
                )
            )(problem.strength)

    compiles_once(heard, use)


def test_compiled_traces_python_numbers_and_keeps_the_dtype(heard):
    @compiled
    def scaled(image: jax.Array, by: Any) -> jax.Array:
        return jax.lax.fori_loop(0, 3, lambda _, x: x * by, image)

    compiles_once(heard, lambda n: scaled(PICTURE, 1.5 + n))
    assert scaled(PICTURE, 2).dtype == jnp.float32
    np.testing.assert_allclose(scaled(PICTURE, by=2), 8 * PICTURE)
    with jax.enable_x64(True):
        assert scaled(jnp.ones(SHAPE, jnp.float64), 0.1).dtype == jnp.float64
