"""Total variation: its value by hand; its proximal step by optimality conditions, closed forms and other solvers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skimage.restoration
from jax.flatten_util import ravel_pytree

from scsr_opt.errors import InputError
from scsr_opt.priors.huber_total_variation import HuberTotalVariation
from scsr_opt.priors.total_variation import Dual, TotalVariation, gradient, gradient_adjoint, gradient_bounds

SHAPE = (11, 14)
STRENGTH = 0.15
FEW, MANY = 5, 3000  # each number of iterations is compiled once; few tests need another


@pytest.fixture
def double():
    with jax.enable_x64(True):
        yield


def picture(seed: int = 0, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """A bright rectangle with noise."""
    rng = np.random.default_rng(seed)
    clean = np.zeros(shape)
    clean[shape[0] // 4 : -shape[0] // 4, shape[1] // 3 :] = 1
    return clean + 0.2 * rng.normal(size=shape)


@eqx.filter_jit
def step(prior: TotalVariation, image: jax.Array, strength: jax.Array, state: Dual):
    """The proximal step, its new state, and the gap there."""
    result, state = prior.prox(image, strength, state)
    return result, state, prior.gap(image, strength, state)


def prox(prior: TotalVariation, image: np.ndarray, strength: float, state: Dual | None = None):
    given = jnp.asarray(image)
    return step(
        prior, given, jnp.asarray(strength, given.dtype), prior.initial_state(given) if state is None else state
    )


# An independent solution: dense difference matrices, and ADMM instead of a dual method.


def differences(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = shape

    def along(size: int) -> np.ndarray:
        matrix = np.eye(size, k=1) - np.eye(size)
        matrix[-1] = 0
        return matrix

    return np.kron(along(rows), np.eye(columns)), np.kron(np.eye(rows), along(columns))


def total_variation(image: np.ndarray, isotropic: bool) -> float:
    down, right = (d @ image.ravel() for d in differences(image.shape))
    return float(np.sum(np.hypot(down, right) if isotropic else np.abs(down) + np.abs(right)))


def admm(image: np.ndarray, strength: float, isotropic: bool, iterations: int = 3000) -> np.ndarray:
    """min ½‖x − image‖² + strength Σ|z|, z = Dx, by ADMM (Boyd et al. 2011)."""
    penalty = 10.0  # converges for all strengths here; 1 leaves 3e-4 at the strongest
    d = np.vstack(differences(image.shape))
    solve = np.linalg.inv(np.eye(image.size) + penalty * d.T @ d)
    z = u = np.zeros(len(d))
    x = image.ravel()
    for _ in range(iterations):
        x = solve @ (image.ravel() + penalty * d.T @ (z - u))
        v = (d @ x + u).reshape(2, -1)
        length = np.hypot(*v) if isotropic else np.abs(v)
        z = (v * np.maximum(0, 1 - strength / penalty / np.maximum(length, 1e-300))).ravel()
        u = v.ravel() - z
    return x.reshape(image.shape)


# Value


def test_value_by_hand(double):
    image = jnp.asarray([[0.0, 3.0], [4.0, 0.0]])
    # Differences down and right: (4, 3), (−3, 0) in the first row; (0, −4), (0, 0) in the last.
    assert TotalVariation().value(image) == 5 + 3 + 4
    assert TotalVariation(isotropic=False).value(image) == 4 + 3 + 3 + 4


@pytest.mark.parametrize("isotropic", [True, False])
def test_value_is_a_seminorm(double, isotropic):
    value = jax.jit(TotalVariation(isotropic).value)
    f, g = picture(1), picture(2)
    assert float(value(f)) == pytest.approx(total_variation(f, isotropic), rel=1e-12)
    assert float(value(-2.5 * f + 7)) == pytest.approx(2.5 * float(value(f)), rel=1e-12)
    assert value(f + g) <= value(f) + value(g)
    assert value(np.full(SHAPE, 3.0)) == 0


def test_value_of_a_large_picture_in_single_precision():
    image = np.random.default_rng(0).random((1000, 1000), np.float32)
    exact = sum(np.abs(np.diff(image.astype(np.float64), axis=axis)).sum() for axis in (0, 1))
    assert float(TotalVariation(isotropic=False).value(jnp.asarray(image))) == pytest.approx(exact, rel=1e-6)


# Optimality


@pytest.mark.parametrize("isotropic", [True, False])
def test_prox_meets_the_optimality_conditions(double, isotropic):
    f = picture()
    x, state, gap = (np.asarray(v) for v in prox(TotalVariation(isotropic, MANY), f, STRENGTH))
    down, right = differences(SHAPE)
    p = state.reshape(2, -1)
    slope = np.stack([down @ x.ravel(), right @ x.ravel()])
    np.testing.assert_allclose(f.ravel() - x.ravel(), STRENGTH * (down.T @ p[0] + right.T @ p[1]), rtol=0, atol=1e-13)
    length, steepness = (np.hypot(*p), np.hypot(*slope)) if isotropic else (np.abs(p), np.abs(slope))
    assert length.max() <= 1 + 1e-12
    np.testing.assert_allclose((p * slope).sum(), steepness.sum(), rtol=1e-6)
    steep = steepness > 0.02
    assert 5 < steep.sum() < 100
    if isotropic:
        np.testing.assert_allclose(p[:, steep], (slope / np.maximum(steepness, 1e-9))[:, steep], rtol=0, atol=1e-3)
    else:
        np.testing.assert_allclose(p[steep], np.sign(slope)[steep], rtol=0, atol=1e-9)
    # The gap as it is defined: primal objective minus dual objective.
    primal = 0.5 * ((x - f) ** 2).sum() + STRENGTH * total_variation(x, isotropic)
    dual = 0.5 * (f**2).sum() - 0.5 * (x**2).sum()
    assert 0 <= gap < 1e-6
    assert float(gap) == pytest.approx(primal - dual, abs=1e-11)


@pytest.mark.parametrize("isotropic", [True, False])
def test_gap_bounds_the_distance_and_the_dual_converges_at_its_rate(double, isotropic):
    f = picture()
    exact = admm(f, STRENGTH, isotropic)
    gaps = {}
    for iterations in (FEW, MANY):
        x, state, gap = prox(TotalVariation(isotropic, iterations), f, STRENGTH)
        gaps[iterations] = float(gap)
        assert 0.5 * np.sum((x - exact) ** 2) <= gap
        # Beck and Teboulle's rate, for the dual objective.
        value = 0.5 * np.sum(np.asarray(x) ** 2) - 0.5 * np.sum(exact**2)
        assert value <= 16 * STRENGTH**2 * np.sum(np.asarray(state) ** 2 + 1) / (iterations + 1) ** 2
    assert gaps[FEW] > 1e4 * gaps[MANY]


@pytest.mark.parametrize("isotropic", [True, False])
@pytest.mark.parametrize("strength", [0.02, 0.15, 0.6])
def test_prox_against_an_independent_solver(double, isotropic, strength):
    f = picture()
    exact = admm(f, strength, isotropic)

    def objective(x):
        return 0.5 * np.sum((x - f) ** 2) + strength * total_variation(x, isotropic)

    x, _, gap = prox(TotalVariation(isotropic, MANY), f, strength)
    np.testing.assert_allclose(x, exact, rtol=0, atol=2e-6)
    assert objective(np.asarray(x)) == pytest.approx(objective(exact), rel=1e-6)
    assert gap < 1e-5


def test_prox_against_scikit_image(double):
    # The same discretisation: forward differences, Neumann border, Euclidean norm; `weight` is λ.
    f = picture()
    theirs = skimage.restoration.denoise_tv_chambolle(f, weight=STRENGTH, eps=0, max_num_iter=5000)
    ours, _, _ = prox(TotalVariation(iterations=MANY), f, STRENGTH)
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-3)
    assert np.sqrt(np.mean((ours - theirs) ** 2)) < 2e-4


def test_prox_of_a_step_is_a_lower_step(double):
    # Every row (or column) is a step a | b of n and m pixels: a + λ/n | b − λ/m until the two meet at the mean.
    rows, columns = SHAPE
    step_right = np.broadcast_to(np.repeat([1.0, 3.0], [4, columns - 4]), SHAPE)
    step_down = np.repeat([1.0, 3.0], [4, rows - 4])[:, None] * np.ones(columns)
    for isotropic in (True, False):
        prior = TotalVariation(isotropic, MANY)
        for f, size in ((step_right, columns), (step_down, rows)):
            x, _, gap = prox(prior, f, 1.2)
            expected = np.where(f == 1, 1 + 1.2 / 4, 3 - 1.2 / (size - 4))
            np.testing.assert_allclose(x, expected, rtol=0, atol=1e-5)
            assert gap < 1e-5
            met, _, _ = prox(prior, f, 8.0)
            np.testing.assert_allclose(met, f.mean(), rtol=0, atol=1e-3)


def test_anisotropic_prox_of_a_corner_is_known(double):
    # A square of n×n pixels in the corner of a flat picture has one side of n edges down and one right, so 2nλ in all
    # pull on n² pixels: it sinks by 2λ/n, the L around it rises by 2nλ over its pixels, as long as both stay flat.
    f = np.zeros(SHAPE)
    f[:4, :4] = 1
    x, _, gap = prox(TotalVariation(isotropic=False, iterations=MANY), f, 0.2)
    expected = np.where(f > 0, 1 - 2 * 0.2 / 4, 2 * 4 * 0.2 / (f.size - 16))
    np.testing.assert_allclose(x, expected, rtol=0, atol=1e-5)
    assert gap < 1e-5


@pytest.mark.parametrize("isotropic", [True, False])
def test_strong_prox_is_the_mean(double, isotropic):
    f = picture()
    for strength in (1e2, 1e6):
        x, state, _ = prox(TotalVariation(isotropic, MANY), f, strength)
        np.testing.assert_allclose(x, f.mean(), rtol=0, atol=1e-4)
        assert np.max(np.abs(np.asarray(state))) < 1
    flat, _, _ = prox(TotalVariation(isotropic, MANY), np.full(SHAPE, 0.3), 0.7)
    np.testing.assert_array_equal(flat, 0.3)


@pytest.mark.parametrize("isotropic", [True, False])
def test_what_the_prox_takes_away_is_a_projection(double, isotropic):
    # Moreau: f − prox(f) is the point nearest to f of the set {g : ⟨g, z⟩ ≤ λΨ(z) for all z}.
    prior = TotalVariation(isotropic, MANY)
    f = picture()
    x = np.asarray(prox(prior, f, STRENGTH)[0])
    g = f - x
    assert np.vdot(g, x) == pytest.approx(STRENGTH * total_variation(x, isotropic), rel=1e-6)
    rng = np.random.default_rng(1)
    for _ in range(50):
        z = rng.normal(size=SHAPE)
        assert np.vdot(g, z) <= STRENGTH * total_variation(z, isotropic)
    twice = np.asarray(prox(prior, g, STRENGTH)[0])
    np.testing.assert_allclose(twice, 0, rtol=0, atol=1e-3)  # it lies in the set itself


@pytest.mark.parametrize("isotropic", [True, False])
def test_prox_is_firmly_non_expansive(double, isotropic):
    prior = TotalVariation(isotropic, MANY)
    for seed in range(3):
        f, g = picture(seed), picture(seed + 10)
        x, y = (np.asarray(prox(prior, image, STRENGTH)[0]) for image in (f, g))
        assert np.sum((x - y) ** 2) <= np.vdot(x - y, f - g) + 1e-6


# Warm start


@pytest.mark.parametrize("isotropic", [True, False])
def test_warm_start_gets_to_the_same_point_sooner(double, isotropic):
    few, many = TotalVariation(isotropic, FEW), TotalVariation(isotropic, MANY)
    f = picture()
    exact, _, _ = prox(many, f, STRENGTH)
    nearby = f + 0.01 * np.random.default_rng(5).normal(size=SHAPE)
    _, state, _ = prox(many, nearby, STRENGTH * 1.1)
    cold, _, cold_gap = prox(few, f, STRENGTH)
    warm, _, warm_gap = prox(few, f, STRENGTH, state)
    _, _, longer_gap = prox(TotalVariation(isotropic, 2 * FEW), f, STRENGTH)
    assert warm_gap < longer_gap < cold_gap
    assert np.linalg.norm(warm - exact) < 0.3 * np.linalg.norm(cold - exact)
    # Five steps at a time from the state they left end where one long run ends.
    state = None
    for _ in range(200):
        again, state, gap = prox(few, f, STRENGTH, state)
    np.testing.assert_allclose(again, exact, rtol=0, atol=1e-3)
    assert gap < 1e-3


def test_initial_state_is_zero_and_stays_out_of_the_way():
    prior, f = TotalVariation(iterations=FEW), picture().astype(np.float32)
    state = prior.initial_state(jnp.asarray(f))
    assert [v.shape for v in state] == [SHAPE, SHAPE] and not np.any(np.asarray(state))
    _, state, _ = prox(prior, f, 0.1)
    np.testing.assert_array_equal(state.down[-1], 0)
    np.testing.assert_array_equal(state.right[:, -1], 0)


# Where things could break


@pytest.mark.parametrize(("shape", "isotropic"), [((1, 1), True), ((1, 7), True), ((7, 1), False)])
def test_small_pictures(isotropic, shape):
    f = np.random.default_rng(0).random(shape).astype(np.float32)
    prior = TotalVariation(isotropic, 100)
    x, _, gap = prox(prior, f, 0.05)
    assert x.shape == shape and x.dtype == jnp.float32
    assert abs(gap) < 1e-5 and np.isfinite(prior.value(x))
    np.testing.assert_allclose(np.mean(x), np.mean(f), rtol=1e-5)
    assert np.array_equal(x, f) == (shape == (1, 1))


@pytest.mark.parametrize("isotropic", [True, False])
def test_without_strength_nothing_changes(isotropic):
    prior = TotalVariation(isotropic, FEW)
    f = picture().astype(np.float32)
    _, state, _ = prox(prior, f, 0.1)
    for strength in (0.0, 1e-30):
        x, kept, gap = prox(prior, f, strength, state)
        np.testing.assert_array_equal(x, f)
        # A vector of length 1 is divided by its length again: a rounding in each of the steps.
        for one, other in zip(kept, state, strict=True):
            np.testing.assert_allclose(one, other, atol=FEW * 2**-23)
        assert gap < 1e-20


@pytest.mark.parametrize("isotropic", [True, False])
def test_derivatives_are_finite_where_the_norm_has_a_kink(isotropic):
    prior = TotalVariation(isotropic, 3)

    @jax.jit
    def slopes(image, strength):
        def loss(image, strength):
            x, _ = prior.prox(image, strength, prior.initial_state(image))
            return jnp.sum(x**2)

        return jax.grad(prior.value)(image), *jax.grad(loss, argnums=(0, 1))(image, strength)

    flat = np.zeros(SHAPE, np.float32)
    flat[:3] = 1
    for image in (flat, flat * 0, picture().astype(np.float32)):
        for strength in (0.0, 1e-30, 0.1, 100.0):
            of_value, of_image, of_strength = slopes(image, jnp.asarray(strength, jnp.float32))
            assert np.all(np.isfinite(of_value)) and np.all(np.isfinite(of_image)) and np.isfinite(of_strength)
            if strength == 0:
                np.testing.assert_array_equal(of_image, 2 * image)


@pytest.mark.parametrize("isotropic", [True, False])
def test_derivatives_against_differences(double, isotropic):
    prior = TotalVariation(isotropic, 3)

    @jax.jit
    @jax.value_and_grad
    def loss(arguments):
        f, strength = arguments
        x, _ = prior.prox(f, strength, prior.initial_state(f))
        return jnp.sum(jnp.sin(3 * x)) + 0.1 * prior.value(f)

    f, direction, h = picture(), np.random.default_rng(1).normal(size=SHAPE), 1e-7

    def at(t: float, u: float):
        return loss((jnp.asarray(f + t * direction), jnp.asarray(STRENGTH + u)))

    of_image, of_strength = at(0, 0)[1]
    along = (at(h, 0)[0] - at(-h, 0)[0]) / (2 * h)
    np.testing.assert_allclose(np.vdot(of_image, direction), along, rtol=1e-5)
    stronger = (at(0, h)[0] - at(0, -h)[0]) / (2 * h)
    np.testing.assert_allclose(of_strength, stronger, rtol=1e-5)


def test_what_is_not_a_number_shows_in_the_result():
    f = picture().astype(np.float32)
    assert np.all(np.isnan(prox(TotalVariation(iterations=FEW), f, np.nan)[0]))
    f[3, 4] = np.nan
    assert np.isnan(prox(TotalVariation(iterations=FEW), f, 0.1)[0][3, 4])


@pytest.mark.parametrize("isotropic", [True, False])
def test_dtype_follows_the_picture_and_precisions_agree(isotropic):
    prior, results = TotalVariation(isotropic, FEW), {}
    for dtype, name in ((np.float32, "single"), (np.float64, "double")):
        with jax.enable_x64(name == "double"):
            x, state, gap = prox(prior, picture().astype(dtype), STRENGTH)
            assert {v.dtype for v in (x, *state, gap)} == {np.dtype(dtype)}
            results[name] = np.asarray(x, np.float64)
    np.testing.assert_allclose(results["single"], results["double"], rtol=0, atol=1e-5)
    with jax.enable_x64(True):  # where single precision could be promoted unnoticed
        f, strength = jax.ShapeDtypeStruct(SHAPE, jnp.float32), jax.ShapeDtypeStruct((), jnp.float32)
        found = jax.eval_shape(lambda f, s: (*prior.prox(f, s, prior.initial_state(f)), prior.value(f)), f, strength)
        assert {v.dtype for v in jax.tree.leaves(found)} == {np.dtype(np.float32)}


def test_many_pictures_at_once():
    prior = TotalVariation(iterations=FEW)
    images = jnp.asarray(np.stack([picture(seed) for seed in range(3)]).astype(np.float32))
    strengths = jnp.asarray([0.05, 0.1, 0.2], jnp.float32)
    together = jax.vmap(lambda f, strength: prior.prox(f, strength, prior.initial_state(f))[0])(images, strengths)
    for f, strength, x in zip(images, strengths, together, strict=True):
        np.testing.assert_allclose(x, prox(prior, np.asarray(f), float(strength))[0], rtol=0, atol=1e-6)


def test_strength_may_be_a_plain_number():
    prior, image = TotalVariation(iterations=3), jnp.asarray(picture().astype(np.float32))
    x, _ = jax.eval_shape(lambda image: prior.prox(image, 0.1, prior.initial_state(image)), image)
    assert x == jax.ShapeDtypeStruct(SHAPE, jnp.float32)


def test_refuses_no_iterations():
    with pytest.raises(InputError, match="at least 1"):
        TotalVariation(iterations=0)


@pytest.mark.parametrize("prior", [TotalVariation(iterations=400), HuberTotalVariation(iterations=400)])
@pytest.mark.parametrize("rows", [slice(0), slice(3, 6)])
def test_a_strength_for_each_pixel(double, prior, rows):
    """The minimiser of ½ Σ (X − f)²/w + Ψ(X), X = f where w is 0: its dual variable closes the gap, term by term."""
    rng = np.random.default_rng(5)
    f, strengths = jnp.asarray(rng.random((9, 11))), rng.uniform(0.02, 0.3, (9, 11))
    strengths[rows, 4:8] = 0
    w = jnp.asarray(strengths)
    found, dual = jax.jit(lambda f, w: prior.prox(f, w, prior.initial_state(f)))(f, w)
    np.testing.assert_allclose(found, f - w * prior.adjoint(dual), atol=1e-14)
    np.testing.assert_array_equal(found[rows, 4:8], f[rows, 4:8])
    field = prior.analysis(found)
    products = sum(jnp.sum(z * p) for z, p in zip(field, dual, strict=True))
    gap = float(jnp.sum(prior.penalties(field) + prior.conjugates(dual)) - products)
    assert 0 <= gap < 1e-4 * float(prior.value(found))
    flat, _ = prior.prox(f, jnp.full_like(f, 0.1), prior.initial_state(f))
    np.testing.assert_allclose(flat, prior.prox(f, 0.1, prior.initial_state(f))[0], atol=1e-6)


def test_bounds_of_a_strength_for_each_pixel(double):
    """diag(b) − ∇ diag(w) ∇* has no negative eigenvalue, and b is no more than twice as large as it has to be."""
    w = jnp.asarray(np.random.default_rng(6).uniform(0.1, 1, (5, 6)))
    zero = Dual(jnp.zeros_like(w), jnp.zeros_like(w))
    flat, back = ravel_pytree(zero)
    matrix = jax.jacobian(lambda v: ravel_pytree(gradient(w * gradient_adjoint(back(v))))[0])(flat)
    b = np.tile(np.asarray(gradient_bounds(w)).ravel(), 2)
    inside = np.abs(np.asarray(matrix)).sum(1) > 0
    # The last row of `down` and column of `right`, which a dual variable has nothing in, are not differences.
    kept = np.concatenate([np.arange(30) < 25, np.arange(30) % 6 < 5]) & inside
    of_field = np.asarray(matrix)[np.ix_(kept, kept)]
    scaled = of_field / np.sqrt(np.outer(b[kept], b[kept]))
    assert 0.5 < np.linalg.eigvalsh(scaled)[-1] <= 1 + 1e-12
    assert float(gradient_bounds(jnp.asarray(0.5))) == 4
