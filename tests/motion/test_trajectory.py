import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.ndimage import gaussian_filter, map_coordinates

from scsr_opt.motion import Motion, trajectory_of
from scsr_opt.motion.inversion import _iterated_inverse, inverse
from scsr_opt.motion.settings import DEFAULTS
from scsr_opt.motion.trajectory import Layers, key_frame_positions

H, W, KEY, FRAMES = 40, 60, 50, 101
ROWS, COLUMNS = np.mgrid[0:H, 0:W]


def at(path, time: float) -> np.ndarray:
    row, column, _ = path.at(
        jnp.asarray(ROWS.ravel(), jnp.int32),
        jnp.asarray(COLUMNS.ravel(), jnp.int32),
        jnp.full(H * W, time, jnp.float32),
    )
    return np.stack([row, column]).reshape(2, H, W)


def still_inside(position: np.ndarray, margin: float = 1.0) -> np.ndarray:
    row, column = position
    return (row >= margin) & (column >= margin) & (row <= H - 1 - margin) & (column <= W - 1 - margin)


@pytest.fixture(scope="module")
def smooth() -> Motion:
    noise = gaussian_filter(np.random.default_rng(0).standard_normal((4, H, W)), 8, axes=(1, 2), mode="reflect")
    noise /= noise.std((1, 2), keepdims=True)
    velocity = 0.02 * noise[:2] + np.array([0.1, -0.15])[:, None, None]
    return Motion(velocity.astype(np.float32), (2e-4 * noise[2:]).astype(np.float32), np.ones((H, W), np.float32))


@pytest.mark.parametrize("time", [2.0, 30.0, 50.0, 66.0, 98.0])
def test_a_key_frame_point_moved_on_comes_to_lie_on_its_pixel(smooth, time):
    position = at(trajectory_of(smooth, key=KEY, start=0, stop=FRAMES), time - time % 4)
    tau = time - time % 4 - KEY
    field = np.concatenate([smooth.velocity, smooth.acceleration])
    v = np.stack([map_coordinates(part, position, order=1, mode="nearest") for part in field])
    arrived = position + v[:2] * tau + v[2:] * tau**2 / 2
    # 1e-3 px is far below what a picture shows at ×8.
    assert np.abs(arrived - [ROWS, COLUMNS])[:, still_inside(position)].max() < 1e-3


def by_iteration(velocity, acceleration, after) -> np.ndarray:
    """The inverse of every row and column, whether the motion is affine or not."""
    return np.stack([_iterated_inverse(velocity, acceleration, tau, 1, DEFAULTS.trajectory) for tau in after])


def test_an_affine_motion_is_found_at_once_as_by_iteration():
    """A turn by 0.004 rad per frame that grows, about a point in the picture: where both ends lie in view."""
    rows, columns = np.mgrid[0:H, 0:W].astype(np.float32)
    away = np.stack([rows - 0.4 * H, columns - 0.6 * W])
    velocity = np.stack([0.002 * away[0] - 0.004 * away[1], 0.004 * away[0] + 0.001 * away[1]])
    acceleration = (1e-5 * away[::-1]).astype(np.float32)
    after = jnp.asarray([-40.0, -3.0, 0.0, 25.0, 48.0])
    found = np.asarray(inverse(velocity, acceleration, after))
    slowly = by_iteration(jnp.asarray(velocity), jnp.asarray(acceleration), after)
    # Eight iterations, each to a quarter of the error of the one before, from ten pixels: 2e-4.
    inner = np.stack([still_inside(one) for one in found])
    assert inner.mean() > 0.5
    np.testing.assert_allclose(np.moveaxis(found, 1, 0)[:, inner], np.moveaxis(slowly, 1, 0)[:, inner], atol=1e-3)


def test_what_moves_all_alike_is_found_at_once_as_by_iteration():
    velocity, acceleration = (np.broadcast_to(np.array(v, np.float32)[:, None, None], (2, H, W)) for v in
                              ((0.2, -0.13), (1e-3, 2e-3)))  # fmt: skip
    path = trajectory_of(Motion(velocity, acceleration, np.ones((H, W), np.float32)), key=KEY, start=0, stop=FRAMES)
    after = jnp.arange(path.position.shape[0], dtype=jnp.float32) * 4 - KEY
    slowly = by_iteration(jnp.asarray(velocity), jnp.asarray(acceleration), after)
    np.testing.assert_allclose(path.position, slowly, atol=1e-5)  # rounding of positions up to 100
    assert (np.asarray(path.visible) == 1).all()


def test_without_an_acceleration_the_inverse_is_that_of_one_of_zero(smooth):
    velocity, after = jnp.asarray(smooth.velocity), jnp.asarray([-30.0, 7.0])
    slowly = by_iteration(velocity, jnp.zeros_like(velocity), after)
    # Each ends within 1e-4 of the next iteration.
    np.testing.assert_allclose(inverse(velocity, jnp.zeros_like(velocity), after), slowly, atol=2e-4)


def test_at_the_key_frame_every_pixel_sees_itself(smooth):
    np.testing.assert_allclose(
        at(trajectory_of(smooth, key=48, start=0, stop=FRAMES), 48.0), [ROWS, COLUMNS], atol=1e-5
    )


def test_nothing_moves_needs_one_moment():
    path = trajectory_of(Motion.none(H, W), key=KEY, start=0, stop=FRAMES)
    assert path.position.shape == (1, 2, H, W)
    for time in (0.0, 13.7, 100.0):
        np.testing.assert_array_equal(at(path, time), [ROWS, COLUMNS])


def test_acceleration_counts_by_half_the_square_of_the_time():
    a = np.zeros((2, H, W), np.float32)
    a[1] = 2e-3
    motion = Motion(np.zeros((2, H, W), np.float32), a, np.ones((H, W), np.float32))
    position = at(trajectory_of(motion, key=48, start=0, stop=FRAMES), 88.0)
    np.testing.assert_allclose(position[1], COLUMNS - 2e-3 * 40**2 / 2, atol=1e-4)
    np.testing.assert_allclose(position[0], ROWS, atol=1e-5)


def test_between_moments_the_path_is_straight_to_within_its_curvature():
    a = 4e-3
    acceleration = np.zeros((2, H, W), np.float32)
    acceleration[0] = a
    motion = Motion(np.full((2, H, W), 0.1, np.float32), acceleration, np.ones((H, W), np.float32))
    path = trajectory_of(motion, key=KEY, start=0, stop=FRAMES)
    for time in np.linspace(40, 60, 21):
        tau = time - KEY
        assert np.abs(at(path, time)[0] - (ROWS - 0.1 * tau - a * tau**2 / 2)).max() < a * 4**2 / 8 + 1e-4


def test_the_inverse_of_a_rotation():
    # Velocity L q about the middle, and the acceleration L² q that goes with it: the path of q is exp(Lτ) q to third
    # order in τ, and what is seen at p was at exp(−Lτ) p.
    gradient = np.array([[1e-3, 3e-3], [-3e-3, 1e-3]])
    middle = np.array([(H - 1) / 2, (W - 1) / 2])[:, None, None]
    from_middle = np.stack([ROWS, COLUMNS]) - middle
    velocity = np.einsum("ij,jhw->ihw", gradient, from_middle)
    acceleration = np.einsum("ij,jhw->ihw", gradient @ gradient, from_middle)
    motion = Motion(velocity.astype(np.float32), acceleration.astype(np.float32), np.ones((H, W), np.float32))
    path = trajectory_of(motion, key=48, start=0, stop=FRAMES)
    for time in (8.0, 72.0, 96.0):
        tau = time - 48
        exact = np.einsum("ij,jhw->ihw", expm(-gradient * tau), from_middle) + middle
        inside = still_inside(exact)
        third_order = np.linalg.norm(gradient * tau, 2) ** 3 / 6 * np.hypot(H, W) / 2
        assert np.abs(at(path, time) - exact)[:, inside].max() < third_order + 1e-3


def test_straight_affine_motion_against_its_closed_form():
    gradient = np.array([[2e-3, 1e-3], [-1e-3, -2e-3]])
    drift = np.array([0.05, -0.1])
    velocity = np.einsum("ij,jhw->ihw", gradient, np.stack([ROWS, COLUMNS])) + drift[:, None, None]
    path = trajectory_of(Motion.of_velocity(velocity), key=48, start=0, stop=FRAMES)
    for time in (0.0, 28.0, 100.0):
        tau = time - 48
        pixels = np.stack([ROWS, COLUMNS]) - (drift * tau)[:, None, None]
        exact = np.einsum("ij,jhw->ihw", np.linalg.inv(np.eye(2) + gradient * tau), pixels)  # p = q + (L q + d) τ
        inside = still_inside(exact)
        assert np.abs(at(path, time) - exact)[:, inside].max() < 1e-3


def test_that_of_a_part_is_what_its_pixels_see_counted_from_its_corner(smooth):
    rows, columns = slice(8, 30), slice(20, 57)
    path = trajectory_of(smooth, key=KEY, start=0, stop=FRAMES)
    part = path.part(rows, columns)
    expected = np.asarray(path.position)[..., rows, columns] - np.array([8, 20])[:, None, None]
    np.testing.assert_allclose(part.position, expected, atol=1e-5)
    np.testing.assert_array_equal(part.visible, np.asarray(path.visible)[:, rows, columns])
    assert part.first == path.first
    assert path.part(slice(0, H), slice(0, W)) is path


@pytest.mark.parametrize("layers", [False, True])
def test_a_sparse_grid_sees_what_all_pixels_see(smooth, layers):
    motion, after = smooth, jnp.asarray([-30.0, 7.0, 45.0])
    if layers:
        label = ((ROWS > 10) & (ROWS < 30) & (COLUMNS > 15) & (COLUMNS < 45)).astype(np.int32)
        each = np.stack([np.zeros_like(smooth.velocity), smooth.velocity])
        motion = Motion.of_layers(Layers(each, np.zeros_like(each), label, np.array([0, 1], np.int32)),
                                  smooth.confidence)  # fmt: skip
    position, visible = key_frame_positions(motion, after)
    few, seen = key_frame_positions(motion, after, every=2)
    assert few.shape == (3, 2, H // 2, W // 2)
    # Iterations end when no pixel that takes part moves by 1e-4 any more: fewer pixels may end one earlier.
    np.testing.assert_allclose(few, position[..., ::2, ::2], atol=2e-4)
    # From pixel to pixel a layer's share of a point changes by 1 at most each way, and 0.4 of it are all of visibility.
    np.testing.assert_allclose(seen, visible[..., ::2, ::2], atol=2 * 2e-4 / 0.4)
