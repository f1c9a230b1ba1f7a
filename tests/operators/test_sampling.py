"""The sampled form against rows written out one by one."""

import itertools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt.camera.samples import Samples
from scsr_opt.errors import InputError
from scsr_opt.motion.trajectory import SPACING, Motion, Trajectory, trajectory_of
from scsr_opt.operators import (
    Aperture,
    Blur,
    DataTerm,
    Downsample,
    PlacedSamples,
    Stencil,
    accumulate,
    dot_test,
    place,
    with_exposure,
)
from scsr_opt.operators.sampling import moments
from scsr_opt.solvers import lipschitz_bound

SENSOR = (4, 5)
MOMENTS = 4


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


def random(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


def some_samples(number: int = 60, exposure: float = 3.0, seed: int = 0) -> Samples:
    rng = np.random.default_rng(seed)
    start = rng.uniform(0, (MOMENTS - 1) * SPACING - exposure, number)
    return Samples(
        row=rng.integers(0, SENSOR[0], number).astype(np.int32),
        column=rng.integers(0, SENSOR[1], number).astype(np.int32),
        start=start,
        stop=start + exposure * rng.random(number),
        value=rng.random(number),
        weight=rng.uniform(0.1, 1, number),
    )


def wandering(spread: float = 0.7, seed: int = 1) -> Trajectory:
    """Every pixel sees places around it, some of them outside the picture, some hidden."""
    rng = np.random.default_rng(seed)
    position = np.indices(SENSOR) + rng.normal(scale=spread, size=(MOMENTS, 2, *SENSOR))
    visible = rng.uniform(0.3, 1, (MOMENTS, *SENSOR))
    visible[:, 1, 2] = 0
    return Trajectory(jnp.asarray(0.0), jnp.asarray(position), jnp.asarray(visible))


def placed_samples(
    samples: Samples | None = None,
    path: Trajectory | None = None,
    scale: int = 2,
    positions: int = 1,
    each: np.ndarray | None = None,
) -> PlacedSamples:
    samples, path = some_samples() if samples is None else samples, wandering() if path is None else path
    shape = (SENSOR[0] * scale, SENSOR[1] * scale)
    wanted = None if each is None else jnp.asarray(each)
    on_device = jax.tree.map(jnp.asarray, samples)
    return place(on_device, path, scale=scale, shape=shape, positions=wanted, finest=positions)


def nodes(positions: int) -> np.ndarray:
    """On [−1, 1], from the middle outwards: of five evenly spread, else Chebyshev's, the roots of polynomials."""
    if positions == 5:
        return np.array([0, -0.4, 0.4, -0.8, 0.8])
    roots = np.sort(np.roots([[1, 0], [1, 0, -1 / 3], [1, 0, -1 / 2, 0]][positions - 1]).real)
    return roots[np.argsort(np.abs(roots).round(6), kind="stable")]


def rows_one_by_one(samples: Samples, path: Trajectory, scale: int, positions: int) -> tuple[np.ndarray, np.ndarray]:
    """(K, n, H·W) bilinear rows and (n,) weights."""
    height, width = SENSOR[0] * scale, SENSOR[1] * scale
    places, visible = np.asarray(path.position), np.asarray(path.visible)
    rows = np.zeros((positions, samples.row.size, height, width))
    weight = np.array(samples.weight)
    for j, k in itertools.product(range(samples.row.size), range(positions)):
        r, c = samples.row[j], samples.column[j]
        time = (samples.start[j] + samples.stop[j] + (samples.stop[j] - samples.start[j]) * nodes(positions)[k]) / 2
        before = min(int(time // SPACING), MOMENTS - 2)
        part = time / SPACING - before
        y, x = scale * ((1 - part) * places[before, :, r, c] + part * places[before + 1, :, r, c])
        seen = (1 - part) * visible[before, r, c] + part * visible[before + 1, r, c]
        if not (-1e-3 <= y <= height - scale + 1e-3 and -1e-3 <= x <= width - scale + 1e-3):
            weight[j] = 0
            continue
        y, x = min(max(y, 0), height - scale), min(max(x, 0), width - scale)
        weight[j] = min(weight[j], samples.weight[j] * seen)
        for corner_y, corner_x in itertools.product(*((math.floor(v), math.floor(v) + 1) for v in (y, x))):
            share = (1 - abs(y - corner_y)) * (1 - abs(x - corner_x))
            if share > 0:
                rows[k, j, corner_y, corner_x] += share
    return rows.reshape(positions, -1, height * width), weight


def in_double_precision(path: Trajectory) -> Trajectory:
    return jax.tree.map(lambda a: a.astype(jnp.float64), path)


def dense(function, shape: tuple[int, int]) -> np.ndarray:
    size = math.prod(shape)
    columns = jax.jit(jax.vmap(lambda e: function(e.reshape(shape)).reshape(-1)))(jnp.eye(size))
    return np.asarray(columns).T


def apertures(shape: tuple[int, int], scale: int) -> np.ndarray:
    """The matrix of a sliding mean."""
    matrix = np.zeros((*shape, *shape))
    for i, j in itertools.product(range(shape[0] - scale + 1), range(shape[1] - scale + 1)):
        matrix[i, j, i : i + scale, j : j + scale] = 1 / scale**2
    return matrix.reshape(math.prod(shape), -1)


def written_out(samples: Samples, path: Trajectory, scale: int, positions: int, optics: Blur | None = None):
    """f(x) = ½ Σ ω (A x − y)² as A, ω, y, from loops."""
    rows, weight = rows_one_by_one(samples, path, scale, positions)
    shape = (SENSOR[0] * scale, SENSOR[1] * scale)
    blur = apertures(shape, scale)
    if optics is not None:
        blur = blur @ dense(optics, shape)
    return rows.mean(0) @ blur, weight, np.asarray(samples.value)


SCALES = [1, 2, 3, 8]


@pytest.mark.parametrize("scale", SCALES)
def test_aperture(scale):
    shape = (3 * scale, 2 * scale)
    aperture = Aperture(shape, scale)
    assert dot_test(aperture, dtype=jnp.float64).passed
    image = random(shape)
    np.testing.assert_allclose(aperture(image)[::scale, ::scale], Downsample(shape, scale)(image), atol=1e-14)
    np.testing.assert_allclose(dense(aperture, shape), apertures(shape, scale), atol=1e-15)


def test_stencil_is_symmetric_and_couples_neighbours_only():
    matrix = dense(Stencil(jnp.asarray(random((5, 4, 6)))), (4, 6))
    inside = np.ones((4, 6))
    inside[:, 0] = inside[:, -1] = inside[-1] = 0
    # Couplings that leave the picture exist in random planes, not in accumulated ones.
    stencil = Stencil(jnp.asarray(random((5, 4, 6)) * inside))
    matrix = dense(stencil, (4, 6))
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-15)
    place_of = np.stack(np.unravel_index(np.arange(24), (4, 6)), 1)
    apart = np.abs(place_of[:, None] - place_of[None]).max(-1)
    assert not matrix[apart > 1].any() and (matrix[apart <= 1] != 0).sum() > 24


@pytest.mark.parametrize("scale", SCALES)
def test_stencil_is_the_sum_over_samples(scale):
    samples, path = some_samples(), wandering()
    rows, weight = rows_one_by_one(samples, path, scale, 3)
    assert 0 < np.count_nonzero(weight) < weight.size  # some are outside, some are hidden
    placed = placed_samples(samples, path, scale, 3)
    np.testing.assert_allclose(placed.weight, weight, atol=1e-12)
    term = accumulate(placed)
    expected = np.einsum("n,kni,knj->ij", weight, rows, rows) / 3
    np.testing.assert_allclose(dense(term.stencil, placed.shape), expected, atol=1e-12)
    target = (weight * samples.value) @ rows.mean(0)
    np.testing.assert_allclose(term.target.reshape(-1), target, atol=1e-12)
    np.testing.assert_allclose(term.energy, weight @ samples.value**2, rtol=1e-12)


@pytest.mark.parametrize("positions", [1, 2, 3, 5])
def test_reading_is_the_rows_and_spreading_its_adjoint(positions):
    samples, path = some_samples(), wandering(0.1)
    rows, weight = rows_one_by_one(samples, path, 2, positions)
    placed = placed_samples(samples, path, positions=positions)
    u, values = random(placed.shape), random((60,), 1)
    used = weight > 0
    np.testing.assert_allclose(np.asarray(placed.read(jnp.asarray(u)))[used], (rows.mean(0) @ u.ravel())[used])
    there = float(jnp.vdot(placed.read(jnp.asarray(u)), values))
    back = float(jnp.vdot(u, placed.spread(jnp.asarray(values))))
    assert there == pytest.approx(back, rel=1e-12)


@pytest.mark.parametrize(("scale", "blurred"), [(1, False), (2, True), (3, False)])
def test_value_and_gradient_are_those_of_the_sum_over_samples(scale, blurred):
    samples, path = some_samples(), wandering()
    placed = placed_samples(samples, path, scale)
    optics = Blur.gaussian(placed.shape, 0.8) if blurred else None
    matrix, weight, value = written_out(samples, path, scale, 1, optics)
    image = random(placed.shape)
    off = matrix @ image.ravel() - value
    term = accumulate(placed, optics=optics)
    found, gradient = value_and_gradient(term, jnp.asarray(image))
    assert float(found) == pytest.approx(0.5 * weight @ off**2, rel=1e-12)
    np.testing.assert_allclose(gradient.reshape(-1), matrix.T @ (weight * off), atol=1e-12)
    np.testing.assert_allclose(gradient, gradient_by_jax(term, jnp.asarray(image)), atol=1e-12)
    normal = (matrix.T * weight) @ (matrix @ image.ravel())
    np.testing.assert_allclose(eqx.filter_jit(term.normal)(jnp.asarray(image)).reshape(-1), normal, atol=1e-12)


def test_robust_factors_multiply_the_weights():
    samples, factor = some_samples(), np.random.default_rng(2).random(60)
    lighter = eqx.tree_at(lambda s: s.weight, samples, samples.weight * factor)
    found = accumulate(placed_samples(samples), robust=jnp.asarray(factor))
    assert_same(found, accumulate(placed_samples(lighter)))


def assert_same(first: DataTerm, second: DataTerm):
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


@eqx.filter_jit
def value_and_gradient(term: DataTerm, image: jax.Array) -> tuple[jax.Array, jax.Array]:
    return term.value_and_gradient(image)


@eqx.filter_jit
def gradient_by_jax(term: DataTerm, image: jax.Array) -> jax.Array:
    return jax.grad(term.value)(image)


def subset(samples: Samples, keep: np.ndarray) -> Samples:
    return jax.tree.map(lambda values: values[keep], samples)


def test_padding_has_no_influence():
    samples = some_samples(37)
    padded = samples.padded()
    assert padded.row.size > 37
    assert_same(accumulate(placed_samples(padded, positions=3)), accumulate(placed_samples(samples, positions=3)))


@pytest.mark.parametrize("how", ["hidden", "outside", "nowhere"])
def test_what_the_key_frame_does_not_show_has_no_influence(how):
    samples, path = some_samples(), wandering(0.1)
    pixel = (slice(None), 2, 3)
    if how == "hidden":
        path = eqx.tree_at(lambda p: p.visible, path, path.visible.at[pixel].set(0))
    else:
        beyond = -3.0 if how == "outside" else jnp.nan
        path = eqx.tree_at(lambda p: p.position, path, path.position.at[:, 0, 2, 3].set(beyond))
    there = np.asarray((samples.row == 2) & (samples.column == 3))
    assert there.any()
    assert_same(
        accumulate(placed_samples(samples, path, positions=3)),
        accumulate(placed_samples(subset(samples, ~there), path, positions=3)),
    )


# ---- exposures ----


def exact(samples: Samples, path: Trajectory):
    matrix, weight, value = written_out(samples, path, 2, 3)

    def exactly(image: np.ndarray) -> tuple[float, np.ndarray]:
        off = matrix @ image.ravel() - value
        return 0.5 * float(weight @ off**2), (matrix.T @ (weight * off)).reshape(image.shape)

    return exactly


def test_exposure_term_touches_the_exact_one_from_above():
    samples, path = some_samples(exposure=5), wandering(0.4)
    placed = placed_samples(samples, path, positions=3)
    exactly = exact(samples, path)
    image = random(placed.shape)
    term = with_exposure(accumulate(placed), placed, jnp.asarray(image))
    value, gradient = exactly(image)
    found, found_gradient = value_and_gradient(term, jnp.asarray(image))
    assert float(found) == pytest.approx(value, rel=1e-12)
    np.testing.assert_allclose(found_gradient, gradient, atol=1e-12)
    for seed in range(20):
        other = image + random(placed.shape, seed + 1) * 10.0 ** (seed % 5 - 3)
        assert float(value_and_gradient(term, jnp.asarray(other))[0]) >= exactly(other)[0] - 1e-12
    far = random(placed.shape, 99)  # and it is not just the same
    assert float(value_and_gradient(term, jnp.asarray(far))[0]) > 1.001 * exactly(far)[0]


def test_a_correction_goes_on_from_another_where_pictures_differ():
    """Pieces of samples, three of them sorted by row, are visited where they see the rows that have changed."""
    samples, path = some_samples(768, exposure=5), wandering(0.4)
    samples = subset(samples, np.argsort(samples.row, kind="stable"))
    placed = placed_samples(samples, path, positions=3)
    first, last = np.asarray(placed.rows())
    read = np.asarray(placed.taps.index).reshape(3, 3, 256) // placed.shape[1]
    counts = np.broadcast_to((np.asarray(placed.weight) > 0).reshape(3, 256), read.shape)
    np.testing.assert_array_equal(first, read.min((0, 2), where=counts, initial=99))
    np.testing.assert_array_equal(last, read.max((0, 2), where=counts, initial=-1))
    term, image = accumulate(placed), random(placed.shape)
    other = image.copy()
    other[:2] += 1  # 1 is what the blur, of two pixels, and what a place is read from reach further
    seen = first < 2
    assert seen.any() and not seen.all()
    image, other = jnp.asarray(image), jnp.asarray(other)
    found = with_exposure(term, placed, other, since=(with_exposure(term, placed, image), image, seen))
    expected = with_exposure(term, placed, other)
    np.testing.assert_allclose(found.target, expected.target, atol=1e-12)
    np.testing.assert_allclose(found.energy, expected.energy, rtol=1e-12)
    # And no others: without the pieces that see the change nothing changes.
    none = with_exposure(term, placed, other, since=(with_exposure(term, placed, image), image, ~seen & False))
    np.testing.assert_allclose(none.target, with_exposure(term, placed, image).target, atol=1e-12)
    assert float(jnp.abs(none.target - expected.target).max()) > 1e-3


def test_correcting_again_and_again_lowers_the_exact_objective_to_its_minimum():
    samples, path = some_samples(500, exposure=5), wandering(0.4)
    placed = placed_samples(samples, path, positions=3)
    exactly = exact(samples, path)
    uncorrected = accumulate(placed)
    step = 1 / lipschitz_bound(uncorrected)

    @eqx.filter_jit
    def descend(term: DataTerm, image: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, 50, lambda _, x: x - step * term.gradient(x), image)

    @eqx.filter_jit
    def rounds(image: jax.Array, number: int) -> jax.Array:
        return jax.lax.fori_loop(0, number, lambda _, x: descend(with_exposure(uncorrected, placed, x), x), image)

    matrix, weight, value = written_out(samples, path, 2, 3)
    root = np.sqrt(weight)
    best = np.linalg.lstsq(root[:, None] * matrix, root * value, rcond=None)[0]
    least = exactly(best.reshape(placed.shape))[0]
    image = jnp.zeros(placed.shape)
    values = []
    for _ in range(10):
        values.append(exactly(np.asarray(image))[0] - least)
        image = rounds(image, 1)
    assert np.all(np.diff(values) < 0)
    # What the motion blurs away altogether comes back slowly; all else is there at once.
    assert values[1] < 0.1 * values[0]
    last = exactly(np.asarray(rounds(image, 1000)))[0] - least
    assert 0 <= last < 2e-2 * values[0]


def test_sums_are_differentiated_by_values():
    samples, path = some_samples(exposure=5), wandering(0.4)
    placed = placed_samples(samples, path, positions=3)
    toward, values = jnp.asarray(random(placed.shape)), jnp.asarray(random((60,), 1))
    seen = placed.read(toward)
    by_target = jax.grad(
        lambda value: jnp.sum(toward * accumulate(eqx.tree_at(lambda p: p.value, placed, value)).target)
    )(values)
    np.testing.assert_allclose(by_target, placed.weight * seen, rtol=1e-12)
    by_spread = jax.grad(lambda value: jnp.sum(toward * placed.spread(value)))(values)
    np.testing.assert_allclose(by_spread, seen, rtol=1e-12)
    with pytest.raises(RuntimeError, match="cannot be autodifferentiated"):
        jax.grad(lambda w: accumulate(eqx.tree_at(lambda p: p.weight, placed, w)).target.sum())(placed.weight)


def test_samples_with_several_numbers_of_positions_are_those_of_each_number_together():
    samples, path = some_samples(exposure=5), wandering(0.4)
    number = np.random.default_rng(5).permutation(np.repeat([1, 3, 5], 20))  # of each as many, for few shapes
    together = placed_samples(samples, path, positions=5, each=number)
    apart = {k: placed_samples(subset(samples, number == k), path, positions=int(k)) for k in (1, 3, 5)}
    u, values = jnp.asarray(random(together.shape)), jnp.asarray(random((60,), 1))
    terms = {k: accumulate(placed) for k, placed in apart.items()}
    for k, placed in apart.items():
        np.testing.assert_allclose(together.weight[number == k], placed.weight)
        np.testing.assert_allclose(together.read(u)[number == k], placed.read(u), rtol=1e-12)
    spread = sum(placed.spread(values[number == k]) for k, placed in apart.items())
    np.testing.assert_allclose(together.spread(values), spread, atol=1e-12)
    few = np.arange(number.size)[::-3]  # in any order
    np.testing.assert_array_equal(together.only(few).read(u), np.asarray(together.read(u))[few])
    assert_sum(accumulate(together), list(terms.values()))
    corrected = [with_exposure(terms[k], apart[k], u) for k in apart]
    assert_sum(with_exposure(accumulate(together), together, u), corrected)


@pytest.mark.parametrize(("positions", "degree"), [(1, 1), (2, 3), (3, 3), (5, 1)])
def test_positions_integrate_polynomials_over_an_exposure(positions, degree):
    """To this degree and no further: the highest that there is for weights that are equal, but for five."""
    start, stop, number = jnp.asarray([3.0]), jnp.asarray([5.0]), jnp.asarray([positions])
    at = [float(moments(start, stop, number, k)[0]) - 4 for k in range(positions)]
    for power in range(degree + 1):
        assert np.mean(np.power(at, power)) == pytest.approx((power % 2 == 0) / (power + 1), abs=1e-12)
    assert abs(np.mean(np.power(at, degree + 1)) - 1 / (degree + 2)) > 1e-3


@pytest.mark.parametrize("positions", [0, 4])
def test_a_number_of_positions_that_there_is_no_rule_for(positions):
    with pytest.raises(InputError, match=f"finest is {positions}, .* 1, 2, 3 or 5"):
        placed_samples(positions=positions)


def assert_sum(found: DataTerm, of: list[DataTerm]):
    for field in ("target", "energy"):
        np.testing.assert_allclose(getattr(found, field), sum(getattr(term, field) for term in of), atol=1e-12)
    np.testing.assert_allclose(found.stencil.planes, sum(term.stencil.planes for term in of), atol=1e-12)


@pytest.mark.parametrize("number", [512, 1536, 600])
def test_pieces_that_are_passed_over_are_as_if_they_had_been_visited(number):
    """512 and 1536 samples are visited 512 at a time, 600 at once. All but a few have one position; the last ones have
    no weight."""
    samples, path = some_samples(number), wandering(0.4)
    samples = eqx.tree_at(lambda s: s.weight, samples, np.where(np.arange(number) < number - 20, samples.weight, 0))
    each = np.where(np.arange(number) < 5, 3, 1)
    placed = placed_samples(samples, path, positions=3, each=each)
    singly = [rows_one_by_one(samples, path, 2, k) for k in (1, 3)]
    rows = np.where((each == 3)[:, None], singly[1][0].mean(0), singly[0][0][0])
    weight = np.where(each == 3, singly[1][1], singly[0][1])
    np.testing.assert_allclose(placed.weight, weight, atol=1e-12)
    u, used = random(placed.shape), weight > 0
    np.testing.assert_allclose(np.asarray(placed.read(jnp.asarray(u)))[used], (rows @ u.ravel())[used], atol=1e-12)
    target = accumulate(placed).target
    np.testing.assert_allclose(target.reshape(-1), (weight * np.asarray(samples.value)) @ rows, atol=1e-12)


# ---- step size, and sensors that are hardly pictures ----


@pytest.mark.parametrize("scale", [1, 3])
def test_lipschitz_bound_is_above_the_largest_eigenvalue_and_not_far(scale):
    time, row, column = (index.reshape(-1).astype(np.int32) for index in np.indices((17, 5, 6)))
    at = time.astype(float)
    samples = Samples(row, column, at, at, np.zeros(at.size), np.ones(at.size))
    motion = Motion.of_velocity(np.broadcast_to(np.reshape([0.13, -0.21], (2, 1, 1)), (2, 5, 6)))
    path = in_double_precision(trajectory_of(motion, key=8, start=0, stop=17))
    placed = place(jax.tree.map(jnp.asarray, samples), path, scale=scale, shape=(5 * scale, 6 * scale))
    term = accumulate(placed)
    largest = np.linalg.eigvalsh(dense(term.normal, placed.shape)).max()
    bound = float(lipschitz_bound(term))
    assert largest * (1 - 1e-6) <= bound <= 1.5 * largest


@pytest.mark.parametrize("blurred", [False, True])
@pytest.mark.parametrize("scale", [1, 2, 3])
def test_at_rest_the_grid_of_the_sensor_is_enough(scale, blurred):
    """f, its gradient and its bound do not depend on whether U is taken everywhere or only where samples lie."""
    shape, samples = (4 * scale, 5 * scale), some_samples()
    path = in_double_precision(trajectory_of(Motion.none(4, 5), key=0, start=0, stop=9))
    optics = Blur.gaussian(shape, 0.8) if blurred else None
    everywhere, on_sensor = (place(samples, path, scale=scale, shape=shape, on_sensor=which) for which in (False, True))
    assert on_sensor.shape == (4, 5) and np.count_nonzero(on_sensor.weight) == samples.row.size
    wide, narrow = (accumulate(placed, optics=optics) for placed in (everywhere, on_sensor))
    assert wide.shape == narrow.shape == shape and narrow.target.shape == (4, 5)
    image = jnp.asarray(random(shape))
    for one, other in zip(narrow.value_and_gradient(image), wide.value_and_gradient(image), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    np.testing.assert_allclose(on_sensor.read(narrow.blurred(image)), everywhere.read(wide.blurred(image)), atol=1e-12)
    largest = np.linalg.eigvalsh(dense(narrow.normal, shape))[-1]
    assert largest <= float(lipschitz_bound(narrow)) * (1 + 1e-9)
    if not blurred:
        assert float(lipschitz_bound(narrow)) == pytest.approx(largest)


@pytest.mark.parametrize("scale", [1, 2, 3])
@pytest.mark.parametrize("sensor", [(1, 1), (1, 6), (5, 1)])
def test_narrow_sensors(sensor, scale):
    """At rest each sample is the mean of its block, so the gradient at 0 spreads −Y evenly over it."""
    row, column = (index.reshape(-1).astype(np.int32) for index in np.indices(sensor))
    time, value = np.zeros(row.size), np.random.default_rng(0).random(row.size)
    samples = jax.tree.map(jnp.asarray, Samples(row, column, time, time, value, np.ones(row.size)))
    shape = (sensor[0] * scale, sensor[1] * scale)
    path = in_double_precision(trajectory_of(Motion.none(*sensor), key=0, start=0, stop=1))
    placed = place(samples, path, scale=scale, shape=shape)
    term = accumulate(placed)
    expected = np.kron(value.reshape(sensor), np.full((scale, scale), -1 / scale**2))
    np.testing.assert_allclose(value_and_gradient(term, jnp.zeros(shape))[1], expected, atol=1e-14)
    assert float(lipschitz_bound(term)) == pytest.approx(1 / scale**2)
