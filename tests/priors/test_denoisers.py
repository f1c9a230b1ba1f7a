"""Denoisers in the place of a prior: the σ they are given, NumPy functions called back, plug-and-play and RED."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import skimage.restoration

from scsr_opt.errors import InputError
from scsr_opt.priors import (
    RED,
    Bounded,
    Centred,
    NumpyDenoiser,
    PlugAndPlay,
    Prior,
    TotalVariation,
    bilateral,
    nl_means,
    tv_chambolle,
)

SHAPE = (16, 20)


@eqx.filter_jit
def step(prior: Prior, image: jax.Array, strength: jax.Array, state: Any):
    return prior.prox(image, strength, state)


def prox(prior: Prior, image: np.ndarray, strength: float, state: Any = None):
    given = jnp.asarray(image)
    state = prior.initial_state(given) if state is None else state
    return step(prior, given, jnp.asarray(strength, given.dtype), state)


def smooth(image: jax.Array, sigma: jax.Array) -> jax.Array:
    """[1 2 1]/4 along rows, mirrored at the ends: linear and symmetric, as RED wants it."""
    wide = jnp.pad(image, ((0, 0), (1, 1)), mode="symmetric")
    return (wide[:, :-2] + 2 * wide[:, 1:-1] + wide[:, 2:]) / 4


def smoother(columns: int) -> np.ndarray:
    """I − D of `smooth`, for a picture's rows from the right."""
    matrix = (2 * np.eye(columns) + np.eye(columns, k=1) + np.eye(columns, k=-1)) / 4
    matrix[0, 0] = matrix[-1, -1] = 0.75
    return np.eye(columns) - matrix


class Scaled(eqx.Module):
    """A denoiser with an array of its own, as a network has."""

    factor: jax.Array

    def __call__(self, image: jax.Array, sigma: jax.Array) -> jax.Array:
        return self.factor * image


# Plug and play


def test_the_denoiser_is_told_the_root_of_the_strength(oracle):
    f = oracle.picture(SHAPE).astype(np.float32)
    prior = PlugAndPlay(lambda image, sigma: image + sigma)
    x, state = prox(prior, f, 0.09)
    np.testing.assert_allclose(x, f + 0.3, rtol=0, atol=1e-6)
    assert state is None and prior.value(x) == 0 and not prior.smooth
    np.testing.assert_array_equal(prox(prior, f, 0.0)[0], f)


def test_with_total_variation_by_another_library_it_is_total_variation(double, oracle):
    f = oracle.picture(SHAPE)
    theirs, _ = prox(PlugAndPlay(tv_chambolle(3000)), f, 0.1)
    ours, _ = prox(TotalVariation(iterations=2000), f, 0.1)
    np.testing.assert_allclose(theirs, ours, rtol=0, atol=2e-3)


@pytest.mark.parametrize("make", [nl_means, bilateral, tv_chambolle])
def test_ready_made_denoisers_denoise(oracle, make):
    f = oracle.picture((32, 32)).astype(np.float32)
    clean = np.zeros((32, 32))
    clean[8:-8, 10:] = 1
    x, _ = prox(PlugAndPlay(make()), f, 0.04)
    assert x.dtype == jnp.float32
    assert np.mean((x - clean) ** 2) < 0.6 * np.mean((f - clean) ** 2)
    # The same settings are the same denoiser, which has been compiled for.
    assert make() == make()


def test_nl_means_is_scikit_images(oracle):
    f = oracle.picture(SHAPE).astype(np.float32)
    expected = skimage.restoration.denoise_nl_means(f, 3, 4, h=0.14, sigma=0.2)
    np.testing.assert_allclose(prox(PlugAndPlay(nl_means(3, 4, 0.7)), f, 0.04)[0], expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("make", [nl_means, bilateral, tv_chambolle])
@pytest.mark.parametrize("length", [1, 2, 5, 20])
@pytest.mark.parametrize("axis", [0, 1])
def test_plug_and_play_single_row_or_column_is_denoised_as_rows_that_are_all_alike(make, length, axis):
    """A picture of one row goes on beyond its border as the same row, and so is filtered as the middle of many."""
    row = np.random.default_rng(length).uniform(0.2, 0.8, length).astype(np.float32)
    thin = np.expand_dims(row, axis)
    wide = np.repeat(thin, 33, axis)
    x, wide = (prox(PlugAndPlay(make()), f, 0.01)[0] for f in (thin, wide))
    assert x.shape == thin.shape
    np.testing.assert_allclose(x, np.take(wide, [16], axis), rtol=0, atol=2e-4)


@pytest.mark.parametrize("make", [nl_means, bilateral, tv_chambolle])
@pytest.mark.parametrize("wrap", [lambda d: PlugAndPlay(d), lambda d: RED(d, 0.1)], ids=["pnp", "red"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 17), (3, 1), (2, 2), (3, 5)])
def test_denoisers_on_pictures_smaller_than_a_patch_keep_flat_ones_and_calm_others(make, wrap, shape):
    prior = wrap(make())
    flat = np.full(shape, 0.4, np.float32)
    np.testing.assert_allclose(prox(prior, flat, 0.02)[0], flat, rtol=0, atol=1e-5)
    rough = np.random.default_rng(7).uniform(0.3, 0.5, shape).astype(np.float32)
    x, _ = prox(prior, rough, 0.02)
    assert x.shape == shape and bool(jnp.isfinite(x).all())
    assert x.min() >= rough.min() - 1e-5 and x.max() <= rough.max() + 1e-5


def test_numpy_denoiser_that_drops_axes_of_length_1_gives_a_picture():
    f = np.arange(5, dtype=np.float32)[:, None]
    prior = PlugAndPlay(NumpyDenoiser(lambda image, sigma: np.squeeze(image) / 2))
    np.testing.assert_allclose(prox(prior, f, 0.1)[0], f / 2, rtol=1e-6)


def test_called_back_from_a_loop_and_for_several_pictures(oracle):
    shapes = []

    def half(image: np.ndarray, sigma: float) -> np.ndarray:
        shapes.append(image.shape)
        return (image.astype(float) / 2) * (sigma > 0)  # double: cast back

    prior = PlugAndPlay(NumpyDenoiser(half))
    f = jnp.asarray(oracle.picture(SHAPE).astype(np.float32))

    @jax.jit
    def three(image):
        return jax.lax.fori_loop(0, 3, lambda _, x: prior.prox(x, jnp.float32(0.1), None)[0], image)

    three(f).block_until_ready()  # compiles, and tries the function once
    shapes.clear()
    np.testing.assert_allclose(three(f), f / 8, rtol=1e-6)
    assert shapes == [SHAPE] * 3
    both = jax.jit(jax.vmap(lambda x: prior.prox(x, jnp.float32(0.1), None)[0]))(jnp.stack([f, 2 * f]))
    np.testing.assert_allclose(both, jnp.stack([f / 2, f]), rtol=1e-6)


def test_called_back_in_the_precision_of_the_picture(double, oracle):
    """The call-back has a thread of its own, which knows nothing of the context that made the picture float64.

    It has one where a program's input is still being computed: here a product of matrices, some ten milliseconds.
    """
    prior = PlugAndPlay(NumpyDenoiser(lambda image, sigma: image * sigma))
    f = jnp.asarray(oracle.picture(SHAPE))

    @jax.jit
    def twice(image, late):
        return jax.lax.fori_loop(0, 2, lambda _, x: prior.prox(x, jnp.asarray(0.1), None)[0], image + 0 * late)

    ones = jnp.ones((1000, 1000))
    product = jax.jit(lambda m: (m @ m @ m)[0, 0])
    twice(f, product(ones)).block_until_ready()  # compiles, which takes longer than the product
    result = twice(f, product(ones))
    assert result.dtype == f.dtype == jnp.float64
    np.testing.assert_allclose(result, f * 0.1, rtol=1e-15)


def test_arrays_of_a_denoiser_may_change_without_compiling(oracle):
    f, traces = jnp.asarray(oracle.picture(SHAPE).astype(np.float32)), []

    @eqx.filter_jit
    def run(prior, image):
        traces.append(None)
        return prior.prox(image, jnp.float32(0.1), None)[0]

    for factor in (0.5, 0.25):
        np.testing.assert_allclose(run(PlugAndPlay(Scaled(jnp.float32(factor))), f), factor * f, rtol=1e-6)
    assert len(traces) == 1


# RED


def test_red_against_its_closed_form(double, oracle):
    f, rough = oracle.picture(SHAPE), smoother(SHAPE[1])
    prior = RED(smooth, 0.02)
    assert float(prior.value(jnp.asarray(f))) == pytest.approx(0.5 * np.sum(f * (f @ rough)), rel=1e-12)
    # Under the conditions of the paper the gradient is what the denoiser takes away.
    np.testing.assert_allclose(jax.grad(prior.value)(jnp.asarray(f)), f @ rough, rtol=0, atol=1e-14)
    for strength in (0.1, 2.0):
        exact = f @ np.linalg.inv(np.eye(SHAPE[1]) + strength * rough)
        shrinkage = strength / (1 + strength)
        for iterations in (1, 5):
            x, _ = prox(RED(smooth, 0.02, iterations), f, strength)
            assert np.linalg.norm(x - exact) <= shrinkage**iterations * np.linalg.norm(f - exact) * (1 + 1e-9)
        state = None
        for _ in range(50):
            x, state = prox(prior, f, strength, state)
        np.testing.assert_allclose(x, exact, rtol=0, atol=1e-9)  # (2/3)^100


def test_red_gives_its_sigma_and_keeps_the_dtype(oracle):
    f = oracle.picture(SHAPE).astype(np.float32)
    x, state = prox(RED(lambda image, sigma: image + sigma, 0.5, 1), f, 1.0)
    np.testing.assert_allclose(x, f + 0.25, rtol=0, atol=1e-6)
    assert x.dtype == state.dtype == jnp.float32
    np.testing.assert_array_equal(prox(RED(smooth), f, 0.0)[0], f)
    x, _ = prox(RED(nl_means(), 0.2), f, 0.5)
    assert np.all(np.isfinite(x)) and np.isfinite(RED(nl_means(), 0.2).value(x))


@pytest.mark.parametrize(
    "make",
    [
        lambda: RED(smooth, 0.0),
        lambda: RED(smooth, 0.1, 0),
        lambda: nl_means(0),
        lambda: nl_means(cut_off=-1.0),
        lambda: bilateral(0.0),
        lambda: tv_chambolle(0),
    ],
)
def test_refuses_what_makes_no_sense(make):
    with pytest.raises(InputError, match="was given"):
        make()


@pytest.mark.parametrize("prior", [PlugAndPlay, RED])
@pytest.mark.parametrize(
    ("denoiser", "message"),
    [
        (lambda image, σ: image[:1], r"gave float32 of shape \(1, 5\) for a picture of shape \(4, 5\)"),
        (lambda image, σ: jnp.zeros(()), r"gave float32 of shape \(\)"),
        (lambda image, σ: image > 0, "gave bool"),
        (lambda image, σ: [image], "gave list"),
        (lambda image: image, r"cannot be called as denoiser\(image, sigma\)"),
        (lambda image, σ: np.asarray(image), r"cannot be called .*NumpyDenoiser\(function\)"),
    ],
)
def test_a_denoiser_that_gives_no_picture_is_refused(prior, denoiser, message):
    image = jnp.zeros((4, 5))
    made = prior(denoiser)
    with pytest.raises(InputError, match=message):
        jax.jit(lambda f: made.prox(f, 0.1, made.initial_state(f))[0])(image)


WRONG = [
    (lambda image, sigma: image[:1], r"gave float32 of shape \(1, 5\) for a picture of shape \(4, 5\)"),
    (lambda image, sigma: image.T, r"gave float32 of shape \(5, 4\) for a picture"),
    (lambda image, sigma: image.mean(), r"gave float32 of shape \(\) for a picture"),
    (lambda image, sigma: image[None], r"gave float32 of shape \(1, 4, 5\) for a picture"),
    (lambda image, sigma: image > 0, r"gave bool of shape \(4, 5\)"),
    (lambda image, sigma: image.astype(int), r"gave int\d\d of shape \(4, 5\)"),
    (lambda image, sigma: image.astype("complex64"), r"gave complex\d+ of shape \(4, 5\)"),
    (lambda image, sigma: None, "gave (object of shape|NoneType)"),
    (lambda image, sigma: "picture", "gave (<U7 of shape|str)"),
    (lambda image, sigma: 1 / 0, r"raised ZeroDivisionError for a picture of shape \(4, 5\) \(division by zero\)"),
    (lambda image: image, r"(raised TypeError|cannot be called) .*takes 1 positional argument"),
]


@pytest.mark.parametrize("hold", [lambda d: d, NumpyDenoiser], ids=["jax", "numpy"])
@pytest.mark.parametrize(
    "wrap",
    [PlugAndPlay, RED, lambda d: Bounded(PlugAndPlay(d)), lambda d: Centred(RED(d), np.zeros((4, 5), np.float32))],
    ids=["pnp", "red", "bounded", "centred"],
)
@pytest.mark.parametrize(("denoiser", "message"), WRONG)
def test_check_refuses_a_denoiser_that_gives_no_picture(denoiser, message, wrap, hold):
    with pytest.raises(InputError, match=message):
        wrap(hold(denoiser)).check((4, 5))


class Sharper(eqx.Module):
    """A denoiser within a denoiser."""

    inner: Any

    def __call__(self, image, sigma):
        return 2 * image - self.inner(image, sigma)


@pytest.mark.parametrize(
    "nest",
    [
        Sharper,
        lambda d: Sharper(Sharper(d)),
        lambda d: lambda image, sigma: d(image, 2 * sigma),
        lambda d: lambda image, sigma: d(image[::2], sigma),
        lambda d: eqx.filter_jit(Sharper(d)),
    ],
    ids=["module", "twice", "closure", "other_shape", "jitted"],
)
@pytest.mark.parametrize("wrap", [PlugAndPlay, RED, lambda d: Bounded(PlugAndPlay(d))], ids=["pnp", "red", "bounded"])
@pytest.mark.parametrize(
    ("denoiser", "message"), [(WRONG[n][0], WRONG[n][1].split(" for a picture")[0]) for n in (4, 9)]
)
def test_check_refuses_a_nested_numpy_denoiser_that_gives_no_picture(denoiser, message, wrap, nest):
    message = message.replace(r"\(4, 5\)", r"\(\d, 5\)")
    with pytest.raises(InputError, match=message):
        wrap(nest(NumpyDenoiser(denoiser))).check((4, 5))


@pytest.mark.parametrize(
    "denoiser", [nl_means(), bilateral(), tv_chambolle(5), smooth, Scaled(jnp.float32(0.5)), Sharper(nl_means())]
)
@pytest.mark.parametrize("shape", [(4, 5), (1, 1), (1, 7), (33, 2)])
def test_check_accepts_a_denoiser(denoiser, shape):
    for prior in (PlugAndPlay(denoiser), RED(denoiser), Bounded(PlugAndPlay(denoiser)), TotalVariation()):
        prior.check(shape)
