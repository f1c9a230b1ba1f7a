"""Pictures, and solutions of proximal problems by another method: dense matrices and ADMM."""

import sys
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
import pytest

Block = tuple[np.ndarray, Callable[[np.ndarray, float], np.ndarray]]


@pytest.fixture
def double():
    with jax.enable_x64(True):
        yield


def picture(shape: tuple[int, int] = (7, 9), seed: int = 0) -> np.ndarray:
    """A bright rectangle with noise."""
    rng = np.random.default_rng(seed)
    clean = np.zeros(shape)
    clean[shape[0] // 4 : -shape[0] // 4, shape[1] // 3 :] = 1
    return clean + 0.2 * rng.normal(size=shape)


def solve(target: np.ndarray, free: int, blocks: Sequence[Block], iterations: int = 4000) -> np.ndarray:
    """argmin over u of ½‖u₁ − target‖² + Σ_i φ_i(A_i u), by ADMM (Boyd et al., 2011) with over-relaxation.

    u is the target's size and `free` unknowns more; a block is A_i and the proximal step (v, t) → of t·φ_i.
    """
    relaxation = 1.7
    size = target.size + free
    a = np.vstack([matrix for matrix, _ in blocks])
    penalty = 40 / float(np.linalg.norm(a, 2)) ** 2
    ends = np.cumsum([0] + [len(matrix) for matrix, _ in blocks])
    data = np.concatenate([target.ravel(), np.zeros(free)])
    inverse = np.linalg.inv(np.diag((np.arange(size) < target.size) * 1.0) + penalty * a.T @ a)
    z = u = np.zeros(len(a))
    x = data
    for _ in range(iterations):
        x = inverse @ (data + penalty * a.T @ (z - u))
        ahead = relaxation * (a @ x) + (1 - relaxation) * z
        v = ahead + u
        parts = [
            step(v[begin:end], 1 / penalty) for (_, step), begin, end in zip(blocks, ends[:-1], ends[1:], strict=True)
        ]
        z = np.concatenate(parts)
        u = v - z
    return x


def soft(weight: float | np.ndarray) -> Callable[[np.ndarray, float], np.ndarray]:
    """The proximal step of weight·‖·‖₁."""
    return lambda v, t: np.sign(v) * np.maximum(np.abs(v) - t * weight, 0)


def soft_vectors(weight: float, parts: int) -> Callable[[np.ndarray, float], np.ndarray]:
    """The proximal step of weight·Σ of the lengths of vectors, whose components follow each other in `parts` blocks."""

    def step(v: np.ndarray, t: float) -> np.ndarray:
        rows = v.reshape(parts, -1)
        length = np.sqrt((rows**2).sum(axis=0))
        return (rows * np.maximum(0, 1 - t * weight / np.maximum(length, 1e-300))).ravel()

    return step


def differences(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Forward differences down and right, 0 past the last row and column, as matrices."""
    rows, columns = shape

    def along(size: int) -> np.ndarray:
        matrix = np.eye(size, k=1) - np.eye(size)
        matrix[-1] = 0
        return matrix

    return np.kron(along(rows), np.eye(columns)), np.kron(np.eye(rows), along(columns))


@pytest.fixture(scope="session")
def oracle() -> Any:
    """This module, which test modules cannot import, as they are in no package."""
    return sys.modules[__name__]
