"""One small problem for all solvers, with its dense matrix and an independent float64 solution."""

import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.sparse

from scsr_opt.camera.samples import Samples
from scsr_opt.motion.trajectory import Motion, trajectory_of
from scsr_opt.operators import accumulate, place
from scsr_opt.priors import TotalVariation
from scsr_opt.solvers import Problem

SENSOR, SCALE, KEY = (12, 16), 2, 12
SHAPE = (24, 32)
VELOCITY = (0.13, -0.21)
STRENGTH = 0.02


class Case(NamedTuple):
    """½ Σ ω (A x − y)² + λ TV(x), with its dense matrix in float64, and the same as a `Problem`, and where to start."""

    matrix: np.ndarray
    weight: np.ndarray
    value: np.ndarray
    problem: Problem
    start: jax.Array

    def objective(self, image: np.ndarray) -> float:
        off = self.matrix @ np.asarray(image, float).ravel() - self.value
        return 0.5 * float(self.weight @ off**2) + self.penalty(image)

    def penalty(self, image: np.ndarray) -> float:
        image = np.asarray(image, float)
        down = np.diff(image, axis=0, append=image[-1:])
        right = np.diff(image, axis=1, append=image[:, -1:])
        return STRENGTH * float(np.hypot(down, right).sum())


@pytest.fixture(scope="session")
def case() -> Case:
    """Blocks of four pixels, seen by 2,000 noisy samples at as many sub-pixel shifts."""
    rng = np.random.default_rng(0)
    number = 2000
    time = rng.uniform(0, 2 * KEY - 1, number).astype(np.float32)
    row, column = (rng.integers(0, size, number) for size in SENSOR)
    truth = np.kron(rng.uniform(0.1, 1, (SHAPE[0] // 4, SHAPE[1] // 4)), np.ones((4, 4)))
    weight = rng.uniform(0.5, 1.5, number) * math.prod(SENSOR) / number
    matrix = np.zeros((number, *SHAPE))
    for j in range(number):
        after = float(time[j]) - KEY
        y, x = SCALE * (row[j] - VELOCITY[0] * after), SCALE * (column[j] - VELOCITY[1] * after)
        if not (0 <= y <= SHAPE[0] - SCALE and 0 <= x <= SHAPE[1] - SCALE):
            weight[j] = 0
            continue
        top, left = math.floor(y), math.floor(x)
        for i, k in itertools.product((0, 1), (0, 1)):
            share = (y - top if i else 1 - y + top) * (x - left if k else 1 - x + left)
            matrix[j, top + i : top + i + SCALE, left + k : left + k + SCALE] += share / SCALE**2
    matrix = matrix.reshape(number, -1)
    value = (matrix @ truth.ravel() + 0.05 * rng.normal(size=number)).astype(np.float32)
    weight = weight.astype(np.float32)
    samples = Samples(row.astype(np.int32), column.astype(np.int32), time, time, value, weight)
    velocity = np.broadcast_to(np.array(VELOCITY, np.float32)[:, None, None], (2, *SENSOR))
    path = trajectory_of(Motion.of_velocity(velocity), key=KEY, start=0, stop=2 * KEY)
    term = accumulate(place(jax.tree.map(jnp.asarray, samples), path, scale=SCALE, shape=SHAPE))
    # What is proven of a method holds for exact proximal steps. In float64 ISTA's objective rises by up to 4e-5 where
    # each has ten dual steps, by 8e-9 where it has forty: less than by the rounding of float32.
    problem = Problem(term, TotalVariation(iterations=40), jnp.float32(STRENGTH))
    return Case(matrix, weight.astype(float), value.astype(float), problem, jnp.full(SHAPE, 0.5))


@pytest.fixture(scope="session")
def minimum(case: Case) -> np.ndarray:
    """By ADMM on z = ∇x, with a factorised dense matrix: shares nothing with what is tested."""
    height, width = SHAPE
    steps = [np.eye(n, k=1) - np.diag(np.r_[np.ones(n - 1), 0.0]) for n in SHAPE]
    down = scipy.sparse.csr_array(np.kron(steps[0], np.eye(width)))
    right = scipy.sparse.csr_array(np.kron(np.eye(height), steps[1]))
    rho = 2.0
    normal = (case.matrix.T * case.weight) @ case.matrix
    factor = scipy.linalg.cho_factor(normal + rho * (down.T @ down + right.T @ right).toarray())
    constant = case.matrix.T @ (case.weight * case.value)
    z, u = np.zeros((2, 2, height * width))
    x, before = np.zeros(height * width), np.ones(height * width)
    for _ in range(5000):
        x = scipy.linalg.cho_solve(factor, constant + rho * (down.T @ (z[0] - u[0]) + right.T @ (z[1] - u[1])))
        slope = np.stack([down @ x, right @ x])
        length = np.maximum(np.hypot(*(slope + u)), 1e-30)
        z = (slope + u) * np.maximum(0, 1 - STRENGTH / rho / length)
        u = u + slope - z
        # Ten times stricter changes the objective by 5e-9.
        if np.abs(x - before).max() < 1e-7 and np.abs(slope - z).max() < 1e-7:
            break
        before = x
    else:
        pytest.fail("the reference solution did not converge")
    return x.reshape(SHAPE)
