"""`Options`, the fields that say how, and `Shortcuts`, the work that is left out."""

import dataclasses
import re
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from scsr_opt import InputError, Options, Recording, Shortcuts
from scsr_opt.camera import Intervals, Windows
from scsr_opt.priors import HuberTotalVariation, PlugAndPlay, Prior, RidgeRegulariser, nl_means
from scsr_opt.solvers import FISTA

RECORDING = Recording.from_array(np.zeros((31, 8, 9), np.uint8))


@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("strenght", "strength"),
        ("Strength", "strength"),
        ("velocity", None),
        ("skip", None),
        ("frame", "frames"),
        ("whiterate", "white_rate"),
        ("bad_pixel", "bad_pixels"),
        ("gains", "gain"),
        ("lens", None),
        ("solvers", "solver"),
        ("shortcut", "shortcuts"),
        ("zzz", None),
    ],
)
def test_of_unknown_name_is_refused_with_the_near_one_and_all_there_are(name, near):
    with pytest.raises(InputError) as caught:
        Options.of(None, {"strength": 0.1, name: 1})
    said = str(caught.value)
    fields = [field.name for field in dataclasses.fields(Options)]
    assert said.startswith(f"There is no option {name!r}") and said.endswith(f"; there are {', '.join(fields)}.")
    assert ("did you mean" in said) == (near is not None)
    assert near is None or f"(did you mean {near}?)" in said


def test_of_changes_the_fields_that_are_named_and_no_other():
    given = Options(strength=0.1, frames=31, prior=HuberTotalVariation())
    changed = Options.of(given, {"strength": 0.2, "gain": None})
    assert changed.strength == 0.2 and changed.gain is None and changed.frames == 31 and changed.prior is given.prior
    assert given.strength == 0.1 and given.gain == "auto"  # as it was
    assert Options.of(None, {}).frames == Options().frames == 101


def test_validated_defaults_are_named():
    fine, coarse = (Options().validated(RECORDING, scale) for scale in (3, 4))
    assert isinstance(fine.samples, Intervals) and fine.refine == 0 and fine.strength is None and fine.gain == "auto"
    assert isinstance(fine.prior, RidgeRegulariser) and isinstance(coarse.prior, HuberTotalVariation)
    assert fine.solver is None  # found with the strength (`default_solver`)


def test_validated_numbers_are_python_s_and_arrays_float32():
    given = Options(
        strength=np.float32(0.5), refine=np.int64(2), keep_images=True, gain=np.full((8, 9), 2), samples=Windows(5)
    )
    found = given.validated(RECORDING, 2)
    assert type(found.strength) is float and found.strength == 0.5 and type(found.refine) is int and found.refine == 2
    assert found.keep_images is True and found.samples == Windows(5)
    assert isinstance(found.gain, np.ndarray) and found.gain.dtype == np.float32 and (found.gain == 2).all()
    assert found.known_gain is found.gain and not found.finds_gain and not found.selects_strength


def test_validated_prior_without_a_relative_strength_needs_one():
    prior = PlugAndPlay(nl_means())
    with pytest.raises(InputError, match="No strength is given"):
        Options(prior=prior).validated(RECORDING, 2)
    assert Options(prior=prior, strength=1e-3).validated(RECORDING, 2).prior is prior


class AMethod(Prior[None]):
    def value(self, image):
        return jnp.sum(image**2)

    def relative_strength(self):  # pyright: ignore[reportIncompatibleVariableOverride, reportIncompatibleMethodOverride]
        return 2.0


class Negative(AMethod):
    @property
    def relative_strength(self) -> float:  # pyright: ignore[reportIncompatibleMethodOverride]
        return -1.0


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (AMethod(), "AMethod.relative_strength is a method; put @property on the line above it"),
        (Negative(), "Negative.relative_strength is -1.0; it must be a finite number above 0"),
    ],
)
def test_validated_relative_strength_is_a_number_above_0(prior, message):
    with pytest.raises(InputError, match=message):
        Options(prior=prior).validated(RECORDING, 2)


def test_validated_a_path_in_the_place_of_spikes_is_named():
    with pytest.raises(InputError, match=r"The array is 'car.dat', but it must be an array.*read_recording"):
        Recording.from_array("car.dat")


@pytest.mark.parametrize("gain", ["auto", "blind"])
def test_known_gain_is_none_where_gains_are_to_be_found(gain):
    options = Options(gain=gain).validated(RECORDING, 2)
    assert options.finds_gain and options.known_gain is None and options.gain == gain


def test_estimates_optics_only_by_its_word():
    assert Options(optics="estimate").estimates_optics and Options(optics="estimate").lens is None
    assert not Options().estimates_optics and Options().lens is None


def test_shortcuts_none_leaves_out_no_work():
    names = [field.name for field in dataclasses.fields(Shortcuts)]
    assert len(names) == 6 and all(getattr(Shortcuts(), name) for name in names) and Shortcuts().any
    assert not any(getattr(Shortcuts.none(), name) for name in names) and not Shortcuts.none().any
    for name in names:
        assert dataclasses.replace(Shortcuts.none(), **{name: True}).any


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(Shortcuts)])
def test_shortcuts_are_yes_or_no(types_unchecked, name):
    no, false = ({name: value} for value in (np.False_, False))
    assert Shortcuts(**no) == Shortcuts(**false) != Shortcuts()  # type: ignore[arg-type]
    values: tuple[Any, ...] = ("no", 1, None, np.array([True, False]))
    for value in values:
        with pytest.raises(InputError, match=re.escape(f"Shortcuts.{name} is ") + ".*; it must be True or False"):
            Shortcuts(**{name: value})


def test_options_are_compared_by_what_they_are():
    """Not by value: arrays and priors have no equality that is one bit."""
    one = Options(gain=np.ones((8, 9)), solver=FISTA())
    assert one == one and one != Options(gain=np.ones((8, 9)), solver=FISTA())
