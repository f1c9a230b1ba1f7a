"""Light of each moment, where lamps flicker: what a pixel gathers is ∫ ℓ(t) u dt, not ∫ u dt.

With ℓ known, the clock of a pixel is changed from frames to accumulated light, L(t) = ∫ ℓ dt: between two spikes it
has gathered c·θ = ∫ ℓ u dt, so that Y = c·θ / (L(b) − L(a)) is the mean of u, the scene at the mean light, over the
light of the exposure. Places and times of samples stay in frames, as motion does not know of the light.

Several lamps, each with a course of its own, light each pixel in other shares: ℓ(p, t) = Σ_k share_k(p) course_k(t).
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, Shaped

from scsr_opt.camera.samples import Samples
from scsr_opt.camera.sparse import sparse_pixels

# Least relative light of a moment: what is gathered has to grow with time for an exposure to have a mean.
_DARKEST = 0.02
# Frames beyond the known course for which it stays as it is where it ends.
_FAR_FRAMES = 1e6


@dataclass(frozen=True, eq=False)
class Light:
    """Relative light of each pixel and moment of a clip, 1 in the mean.

    **Fields:**
    - `time`: (n,), frames counted from the clip's first one, increasing; they may reach beyond the clip.
    - `course`: (k, n), relative light at these times, one row for each part that differs; straight in between.
    - `share`: (k, h, w), by which the courses add up to the light of a pixel; (k, 1, 1) where it is the same for all.
    - `frequency`: cycles per frame; None where the light does not repeat within what was seen of it.
    - `depth`: swing of the light either way, relative to its mean.
    """

    time: Float[np.ndarray, " n"]
    course: Float[np.ndarray, "k n"]
    share: Float[np.ndarray, "k rows columns"]
    frequency: float | None = None
    depth: float = 0.0

    @property
    def uniform(self) -> bool:
        """Whether all pixels have the same light."""
        return self.share.shape[1:] == (1, 1)

    def at(self, time: Float[np.ndarray, " m"] | float) -> Float[np.ndarray, "m rows columns"]:
        """Relative light at these times, frames."""
        now = np.stack([np.interp(np.atleast_1d(time), self.time, course) for course in self.course])
        return np.maximum(np.einsum("km,kyx->myx", now, self.share), _DARKEST)

    def gathered(
        self, time: Shaped[np.ndarray, "*m"], pixel: Int[np.ndarray, "*m"] | slice = slice(None)
    ) -> Float[np.ndarray, "*m"]:
        """L, the light gathered from the clip's first frame to these times, frames, in frames of mean light.

        `pixel`: number of each entry's pixel, row by row; all of them in order by default.
        """
        grid, sums = self._table
        total = np.zeros(np.shape(time))
        for one, share in zip(sums, self._by_pixel, strict=True):  # one at a time: there are millions of entries
            now = np.interp(time, grid, one)
            now *= share if self.uniform else share[pixel]
            total += now
        return total.astype(np.float32)

    def over(self, edges: Float[np.ndarray, " edges"]) -> Float[np.ndarray, "n rows columns"]:
        """Mean light between neighbouring edges, frames."""
        grid, sums = self._table
        each = np.diff([np.interp(edges, grid, one) for one in sums], axis=1) / np.diff(edges)
        return np.einsum("km,kyx->myx", each, self.share).astype(np.float32)

    def corrected(self, samples: Samples, width: int) -> Samples:
        """Samples of the scene at the mean light, from samples of a clip of this width as the camera took them: their
        values over the mean light of their exposure, their weights in frames of mean light."""
        pixel = np.asarray(samples.row) * np.int32(width) + np.asarray(samples.column)
        begin, end = np.asarray(samples.start), np.asarray(samples.stop)
        light = (self.gathered(end, pixel) - self.gathered(begin, pixel)) / np.maximum(end - begin, np.float32(1e-3))
        light = np.where(end > begin, light, 1).astype(np.float32)
        return Samples(samples.row, samples.column, begin, end, samples.value / light, samples.weight * light)

    def part(self, rows: slice, columns: slice) -> "Light":
        """The light of a rectangle of the sensor."""
        return self if self.uniform else dataclasses.replace(self, share=self.share[:, rows, columns])

    def sparse(self, apart: int) -> "Light":
        """The light of `sparse_pixels`."""
        return self if self.uniform else dataclasses.replace(self, share=sparse_pixels(self.share, apart))

    def relative_to(self, frame: int) -> "Light":
        """This light in units of that of one frame: measured by it, the scene is that at the light of the frame."""
        return dataclasses.replace(self, share=self.share / self.at(float(frame)))

    @property
    def _by_pixel(self) -> Float[np.ndarray, "k hw"]:
        return self.share.reshape(len(self.share), -1)

    @property
    def _table(self) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "k m"]]:
        """Half frames over the clip and a time far before and after them, and what each course has gathered there since
        frame 0."""
        inner = np.arange(np.floor(2 * min(self.time[0], -1)), np.ceil(2 * max(self.time[-1], 1)) + 1) / 2
        grid = np.concatenate([[inner[0] - _FAR_FRAMES], inner, [inner[-1] + _FAR_FRAMES]])
        now = np.stack([np.interp(grid, self.time, course) for course in self.course])
        steps = (now[:, 1:] + now[:, :-1]) / 2 * np.diff(grid)
        sums = np.pad(np.cumsum(steps, axis=1), ((0, 0), (1, 0)))
        return grid, sums - sums[:, np.searchsorted(grid, 0)][:, None]
