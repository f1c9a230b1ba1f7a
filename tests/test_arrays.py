"""Arrays that users hand in: what cannot be read, or would be misread, is refused at every door."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt import InputError, Recording, reconstruct, reconstruct_sequence
from scsr_opt._arrays import as_array, own
from scsr_opt.baselines import tfp_bicubic
from scsr_opt.calibration import flat_gain, gain_at_rest, with_gain
from scsr_opt.camera import (
    Static,
    interval_rates,
    spike_intervals,
    stp,
    tfi,
    tfp,
    windows,
)
from scsr_opt.motion import Motion, estimate_motion
from scsr_opt.motion.validation import validate_motion
from scsr_opt.operators import Blur, Observation, Warp
from scsr_opt.priors import Centred, TotalVariation

SPIKES = (np.random.default_rng(0).random((24, 6, 8)) < 0.3).astype(np.uint8)
SENSOR, PICTURE = np.zeros((6, 8), bool), np.full((6, 8), 0.5)


class Tensor:
    """An array of another library, as NumPy sees it: it knows its shape, and hands out its values or raises."""

    def __init__(self, values: np.ndarray, error: Exception | None = None):
        self.shape, self.ndim, self.dtype, self._values, self._error = (
            values.shape,
            values.ndim,
            values.dtype,
            values,
            error,
        )

    def __len__(self) -> int:
        return len(self._values)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if self._error is not None:
            raise self._error
        return self._values if dtype is None else self._values.astype(dtype)


# Every function that takes an array: the argument's name in its errors, a good value, and the call.
DOORS: dict[str, tuple[str, np.ndarray, Callable[[Any], Any]]] = {
    "Recording.from_array": ("The array", SPIKES, Recording.from_array),
    "Recording.from_array bad_pixels": ("bad_pixels", SENSOR, lambda a: Recording.from_array(SPIKES, bad_pixels=a)),
    "reconstruct": ("The array", SPIKES, lambda a: reconstruct(a, scale=0)),
    "reconstruct bad_pixels": (
        "bad_pixels", SENSOR, lambda a: reconstruct(SPIKES, scale=2, bad_pixels=a, refine=-1)
    ),
    "reconstruct gain": ("gain", PICTURE, lambda a: reconstruct(SPIKES, scale=2, gain=a, refine=-1)),
    "reconstruct_sequence": ("The array", SPIKES, lambda a: reconstruct_sequence(a, [12], scale=2)),
    "reconstruct_sequence bad_pixels": (
        "bad_pixels", SENSOR, lambda a: reconstruct_sequence(SPIKES, [12], scale=2, bad_pixels=a)
    ),
    "reconstruct_sequence gain": ("gain", PICTURE, lambda a: reconstruct_sequence(SPIKES, [12], scale=2, gain=a)),
    "velocity": ("velocity", np.zeros((2, 6, 8)), Motion.of_velocity),
    "velocity of a Motion": (
        "A field of motion", np.zeros((2, 6, 8)),
        lambda a: validate_motion(Motion(a, np.zeros((2, 6, 8)), np.ones((6, 8))), 6, 8),
    ),
    "estimate_motion": ("The array of spikes", SPIKES[:2], lambda a: estimate_motion(a, key=1)),
    "estimate_motion bad_pixels": (
        "bad_pixels", SENSOR, lambda a: estimate_motion(SPIKES[:2], key=1, bad_pixels=a)
    ),
    "tfp": ("The array of spikes", SPIKES, lambda a: tfp(a, 12)),
    "tfi": ("The array of spikes", SPIKES, lambda a: tfi(a, 12)),
    "stp": ("The array of spikes", SPIKES, lambda a: stp(a, 12)),
    "tfp_bicubic": ("The array", SPIKES, lambda a: tfp_bicubic(a, scale=2)),
    "spike_intervals": ("The array of spikes", SPIKES, spike_intervals),
    "spike_intervals bad_pixels": ("bad_pixels", SENSOR, lambda a: spike_intervals(SPIKES, bad_pixels=a)),
    "windows": ("The array of spikes", SPIKES, lambda a: windows(a, length=4)),
    "interval_rates": ("The array of spikes", SPIKES, lambda a: interval_rates(a, np.array([2.0, 20.0]))),
    "flat_gain": ("The array of spikes", SPIKES, flat_gain),
    "gain_at_rest bad_pixels": ("bad_pixels", SENSOR, lambda a: gain_at_rest(SPIKES[:1], white_rate=0.6, bad_pixels=a)),
    "with_gain": ("gain", PICTURE, lambda a: with_gain(spike_intervals(SPIKES), a)),
    "Static": ("The picture", PICTURE, Static),
    "Blur": ("The PSF", np.ones((3, 3)), lambda a: Blur((6, 8), a)),
    "an operator": ("What Blur was given", PICTURE, lambda a: Blur.gaussian((6, 8), 1.0)(a)),
    "Warp": ("Warp's displacement", np.zeros((2, 6, 8)), Warp),
    "Observation": (
        "Observation's displacement", np.zeros((1, 2, 6, 8)), lambda a: Observation(a, Blur.gaussian((6, 8), 1.0))
    ),
    "Centred": ("The centre", PICTURE, lambda a: Centred(TotalVariation(), a)),
}  # fmt: skip
# Those that say in their types that they take nothing but NumPy's and JAX's arrays, which tests insist on.
_TYPED = {
    "velocity of a Motion", "estimate_motion", "estimate_motion bad_pixels", "spike_intervals",
    "spike_intervals bad_pixels", "windows", "interval_rates", "flat_gain", "with_gain", "an operator", "Warp",
    "Observation", "Centred",
}  # fmt: skip
_ANY = sorted(DOORS.keys() - _TYPED)
# Those whose work begins beyond what is tested here end there with another complaint.
_LATER = {"reconstruct", "reconstruct bad_pixels", "reconstruct gain"}


@pytest.mark.parametrize("door", DOORS)
def test_door_masked_array_is_refused(door):
    """The values under a mask are anything at all, and were taken for measurements."""
    name, good, call = DOORS[door]
    masked = np.ma.masked_array(good, mask=np.zeros(good.shape, bool))
    with pytest.raises(InputError, match=rf"{name}.* masked array, whose mask would be ignored; give"):
        call(masked)


@pytest.mark.parametrize("door", _ANY)
@pytest.mark.parametrize(
    "error",
    [
        TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy it first."),
        RuntimeError("Can't call numpy() on Tensor that requires grad. Use tensor.detach().numpy() instead."),
        ValueError("no array for you"),
        NotImplementedError(),
    ],
    ids=lambda error: type(error).__name__,
)
def test_door_unreadable_tensor_is_refused_with_the_way_out(door, error):
    name, good, call = DOORS[door]
    with pytest.raises(
        InputError, match=rf"{name}.* is a Tensor that NumPy cannot read \({type(error).__name__}.*detach\(\).cpu\(\)"
    ):
        call(Tensor(good, error))


@pytest.mark.parametrize("door", _ANY)
def test_door_readable_tensor_works_as_the_array(door):
    _, good, call = DOORS[door]
    if door in _LATER:
        with pytest.raises(InputError, match="scale|refine"):
            call(Tensor(good))
    else:
        call(Tensor(good))


@pytest.mark.parametrize(
    "value",
    [
        [np.ma.masked_array([1, 2], mask=[False, True])],
        (np.ma.masked_array([1, 2], mask=False),),
        [[[1, 2]], (np.ma.masked_array([1, 2], mask=[False, True]),)],
        [[1, np.ma.masked], [3, 4]],
        np.ma.masked_array([1, 2]),
        np.ma.masked_less(np.arange(3), 1),
        np.ma.masked_all((2, 2)),
        np.ma.array([], dtype=bool),
    ],
)
def test_as_array_masked_in_any_way_is_refused(value):
    with pytest.raises(InputError, match="^x is a masked array"):
        as_array(value, "x")


def test_as_array_list_of_unequal_parts_is_refused_as_such():
    with pytest.raises(InputError, match="^x is a list whose parts differ in length; every row"):
        as_array([[1, 2], [3]], "x")


@pytest.mark.parametrize("value", [np.arange(4.0), jnp.arange(4.0), [0.0, 1.0, 2.0, 3.0], Tensor(np.arange(4.0))])
def test_own_is_a_copy_that_can_be_written_to(value):
    copy = own(value, "x")
    copy *= 2
    np.testing.assert_array_equal(copy, [0, 2, 4, 6])
    np.testing.assert_array_equal(as_array(value, "x"), [0, 1, 2, 3])
