"""The two problems that all peers are given, as plain numbers: NumPy and SciPy only, so that every environment can read
them.

Both are Eq. 4, halved, on a picture of 128×128 pixels from frames of 64×64:

    minimise over X   F(X) = ½ Σ_j (r_j·(B X) − Y_j)² + λ Σ_p |∇X(p)|

B is the mean over 3×3 pixels, with zeros around the picture, and r_j reads the blurred picture, which is one pixel
larger on every side, at the position of sample j with bilinear weights. ∇ are forward differences, zero past the last
row and column; |·| is the Euclidean norm. The optimisation problem is therefore one and the same sparse matrix for all,
in whatever form a peer likes it best.

- `shifts`: 9 frames, each moved as a whole by up to a pixel. A frame is then a convolution with a 5×5 kernel, every
  second pixel of it (`kernels`).
- `flow`: 64 frames, each moved pixel by pixel along a smooth velocity field. Samples that leave the picture are left
  out.
"""

from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float

SIZE = 128
SCALE = 2


@dataclass(frozen=True)
class Case:
    """One problem.

    **Fields:**
    - `truth`: the picture that the samples were made from, for the PSNR only.
    - `row`, `column`: positions of the samples, in pixels of the picture, −1 ≤ · ≤ `SIZE`.
    - `value`: Y.
    - `strength`: λ, an array without axes.
    - `kernels`: what each frame is convolved with; no kernels where the frames are more than shifted. Where there are,
      the samples are in the order frame, row, column.
    """

    truth: Float[np.ndarray, "H W"]
    row: Float[np.ndarray, " J"]
    column: Float[np.ndarray, " J"]
    value: Float[np.ndarray, " J"]
    strength: Float[np.ndarray, ""]
    kernels: Float[np.ndarray, "N 5 5"]

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of the picture."""
        return self.truth.shape

    @cached_property
    def reading(self) -> sp.csr_array:
        """R: the rows r_j on the blurred picture, (J, (H+2)·(W+2)), four values each."""
        height, width = self.shape
        top = np.clip(np.floor(self.row).astype(int), -1, height - 1)
        left = np.clip(np.floor(self.column).astype(int), -1, width - 1)
        down, right = self.row - top, self.column - left
        first = (top + 1) * (width + 2) + left + 1
        index = first[:, None] + np.array([0, 1, width + 2, width + 3])
        taps = np.stack([(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right], axis=1)
        starts = np.arange(0, index.size + 1, 4)
        return sp.csr_array((taps.ravel(), index.ravel(), starts), shape=(len(top), (height + 2) * (width + 2)))

    @cached_property
    def blur(self) -> sp.csr_array:
        """B, ((H+2)·(W+2), H·W)."""
        return sp.csr_array(sp.kron(*(_box(size) for size in self.shape)))

    @cached_property
    def matrix(self) -> sp.csr_array:
        """R B, (J, H·W), up to 16 values in a row."""
        return sp.csr_array(self.reading @ self.blur)

    @cached_property
    def lipschitz(self) -> float:
        """‖R B‖², the Lipschitz constant of the data part's gradient, by power iteration."""
        matrix, norm = self.matrix, 0.0
        v = np.random.default_rng(3).normal(size=self.truth.size)
        for _ in range(300):
            v = matrix.T @ (matrix @ v)
            norm = float(np.linalg.norm(v))
            v = v / norm
        return norm

    @cached_property
    def start(self) -> Float[np.ndarray, "H W"]:
        """The picture that every solver starts from: the samples back where they came from, as many as there are for
        each pixel on average."""
        back = self.matrix.T @ self.value
        return (back * (back.size / self.value.size)).reshape(self.shape)

    def objective(self, image: Float[np.ndarray, "..."]) -> float:
        """F, in float64."""
        picture = np.asarray(image, np.float64).reshape(self.shape)
        gap = self.matrix @ picture.ravel() - self.value
        return float(0.5 * (gap @ gap) + self.strength * total_variation(picture))

    def psnr(self, image: Float[np.ndarray, "..."]) -> float:
        """Against the truth, in dB."""
        error = np.asarray(image, np.float64).reshape(self.shape) - self.truth
        return float(-10 * np.log10(np.mean(error**2)))

    def save(self, path: Path) -> None:
        np.savez(path, **{field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: Path) -> "Case":
        with np.load(path) as stored:
            return cls(**{field.name: stored[field.name] for field in fields(cls)})


def total_variation(image: Float[np.ndarray, "H W"]) -> float:
    """Σ_p |∇X(p)|."""
    down, right = np.zeros_like(image), np.zeros_like(image)
    down[:-1], right[:, :-1] = np.diff(image, axis=0), np.diff(image, axis=1)
    return float(np.sum(np.hypot(down, right)))


def shifts(truth: Float[np.ndarray, "H W"]) -> Case:
    """9 frames, moved by up to a pixel each; noise of 0.02, λ 0.01."""
    moved = np.random.default_rng(1).uniform(-1, 1, (9, 2))
    moved[0] = 0
    row, column = (SCALE * axis for axis in np.indices((SIZE // SCALE, SIZE // SCALE)))
    # A convolution with a kernel that is moved down reads what lies above.
    rows = row - moved[:, 0, None, None]
    columns = column - moved[:, 1, None, None]
    kernels = np.stack([_kernel(*shift) for shift in moved])
    return _observed(truth, rows, columns, kernels, noise=0.02, strength=0.01)


def flow(truth: Float[np.ndarray, "H W"]) -> Case:
    """64 frames along a velocity field, an affine one and waves of a few dozen pixels, up to 0.1 pixels a frame; noise
    of 0.05, λ 0.07, the strength of the best PSNR."""
    row, column = (SCALE * axis for axis in np.indices((SIZE // SCALE, SIZE // SCALE)))
    y, x = 2 * row / SIZE - 1, 2 * column / SIZE - 1
    down = 0.02 + 0.03 * y - 0.02 * x + 0.02 * np.sin(7 * x + 2 * y)
    right = -0.01 + 0.02 * y + 0.03 * x + 0.02 * np.cos(3 * x - 6 * y)
    time = (np.arange(64) - 32)[:, None, None]
    return _observed(truth, row + time * down, column + time * right, np.zeros((0, 5, 5)), noise=0.05, strength=0.07)


def camera() -> Float[np.ndarray, "H W"]:
    """Scikit-image's photographer, a part of 256×256 pixels at half the size, in [0, 1]."""
    from skimage import data

    part = data.camera()[60:316, 140:396] / 255
    return part.reshape(SIZE, 2, SIZE, 2).mean(axis=(1, 3))


CASES = {"shifts": shifts, "flow": flow}
"""The problems by name, each made from a picture."""


def _observed(
    truth: Float[np.ndarray, "H W"],
    row: Float[np.ndarray, "..."],
    column: Float[np.ndarray, "..."],
    kernels: Float[np.ndarray, "N 5 5"],
    *,
    noise: float,
    strength: float,
) -> Case:
    height, width = truth.shape
    noises = np.random.default_rng(2).normal(size=row.shape)
    # A shifted frame reads up to a pixel beyond the picture, where the blur still sees some of it.
    inside = (row >= -1) & (row <= height) & (column >= -1) & (column <= width)
    row, column, noises = row[inside], column[inside], noises[inside]
    empty = Case(truth, row, column, np.zeros_like(row), np.asarray(strength), kernels)
    value = empty.matrix @ truth.ravel() + noise * noises
    return Case(truth, row, column, value, np.asarray(strength), kernels)


def _kernel(down: float, right: float) -> Float[np.ndarray, "5 5"]:
    """The 3×3 mean moved by a fraction of a pixel."""

    def moved(distance: float) -> Float[np.ndarray, " 5"]:
        tap = np.zeros(3)
        tap[1] = 1 - abs(distance)
        tap[1 + int(np.sign(distance))] += abs(distance)
        return np.convolve(tap, np.full(3, 1 / 3))

    return np.outer(moved(down), moved(right))


def _box(size: int) -> sp.csr_array:
    """The mean of three along an axis, from `size` pixels to those and one more at either end."""
    return sp.csr_array(sum(sp.eye_array(size + 2, size, k=-k) for k in range(3)) / 3)
