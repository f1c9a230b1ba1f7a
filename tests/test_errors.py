"""Bad arguments are refused by an `InputError` of one sentence."""

import ast
import math
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from learned.training.data import Examples, Pictures
from scsr_opt.camera.scenes import Affine, Box, MovingObject, Static, Translation, TurningDisc
from scsr_opt.errors import InputError
from scsr_opt.priors import BilateralTotalVariation, Bounded, HuberTotalVariation, TotalVariation, WaveletL1
from scsr_opt.solvers import Backtracking, Balance, Fixed, SpectralNorm

PROJECT = Path(__file__).resolve().parents[1]
# Another sentence begins after a full stop and a space; what abbreviations there are end in none of these.
ANOTHER = re.compile(r"[.!?]\s+\S")


def _text(message: ast.expr) -> str | None:
    """A message as it is written, x for each value that is put in; None if it is not written there."""
    match message:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(str(part.value) if isinstance(part, ast.Constant) else "x" for part in parts)
    return None


def _messages(package: str) -> Iterator[tuple[str, str]]:
    """Where each message of an `InputError` stands, and its text."""
    for path in sorted((PROJECT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] == "InputError" and node.args:
                text = _text(node.args[0])
                if text is not None:
                    yield f"{path.relative_to(PROJECT)}:{node.lineno}", text


@pytest.mark.parametrize(("package", "least"), [("scsr_opt", 150), ("learned", 40)])
def test_an_input_error_is_one_sentence(package, least):
    found = list(_messages(package))
    assert len(found) >= least  # the walk sees them
    wrong = [f"{where}: {text}" for where, text in found if ANOTHER.search(text) or not text.endswith(".")]
    assert not wrong, "\n".join(wrong)


PICTURE = np.linspace(0.1, 0.9, 48).reshape(6, 8)
REFUSED: list[tuple[Callable[[], Any], str]] = [
    (lambda: Static(np.zeros((3, 4, 2))), r"The picture has shape \(3, 4, 2\), but a picture is \(rows, columns\)"),
    (lambda: Static(np.zeros((0, 4))), r"shape \(0, 4\)"),
    (lambda: Static(np.zeros((3, 4), np.int32)), "values of type int32, but a picture is floating-point"),
    (lambda: Static(np.full((3, 4), 255.0)), "values from 255 to 255, but intensity is from 0"),
    (lambda: Static(np.full((3, 4), np.nan)), "values from nan to nan"),
    (lambda: Static(PICTURE, key=np.inf), "key is inf; it must be a finite number from .*, a time in spike frames"),
    (lambda: Translation(PICTURE, 3.0), r"velocity is 3.0, but it must be two finite numbers \(rows, columns\)"),
    (lambda: Translation(PICTURE, (1.0, np.nan)), "velocity is .* two finite numbers .*in HR pixels per frame"),
    (
        lambda: Affine(PICTURE, rotation=np.nan),
        "rotation is nan; it must be a finite number from -6.28 to 6.28, radians",
    ),
    (lambda: Affine(PICTURE, zoom=np.inf), "zoom is inf"),
    (lambda: Affine(PICTURE, zoom=1e200), r"zoom is 1e\+200; it must be a finite number from -1 to 1"),
    (lambda: Translation(PICTURE, (0.0, -1e300)), r"velocity is .* of 1e\+06 at most either way"),
    (lambda: Affine(PICTURE, shear=np.inf), "shear is inf"),
    (lambda: Affine(PICTURE, drift=(1.0,)), "drift is"),
    (lambda: Affine(PICTURE, centre="here"), "centre is 'here'"),
    (lambda: MovingObject(PICTURE * 9, PICTURE, (0.0, 1.0)), "The background holds values"),
    (
        lambda: MovingObject(PICTURE, PICTURE, (0.0, 1.0), shape="star"),
        "shape is 'star', but it must be an Ellipse",
    ),
    (lambda: MovingObject(PICTURE, PICTURE, (0.0, 1.0), position=4), "position is 4"),
    (lambda: TurningDisc(PICTURE, PICTURE, 0.1, radius=0.0), "semi_rows=0.0.* is empty, but its extents must be"),
    (lambda: Box(np.nan, 3.0), "the extent of Box is nan; it must be a finite number from .*, HR pixels"),
    (lambda: Box(3.0, -1.0), r"Box\(half_rows=3.0, half_columns=-1.0\) is empty"),
    (lambda: Pictures.folder("nowhere"), "nowhere is not a folder"),
    (lambda: Pictures.folder(str(PROJECT / "tests" / "benchmarks")), "holds no pictures"),
    (lambda: Examples(2, 5, 16, scenes=("flight",))[0], "no kind of scene 'flight'"),
    (lambda: Examples(2, 5, 16, lights=("night",))[0], "no light 'night'"),
    (lambda: HuberTotalVariation(0), "knee"),
    (lambda: HuberTotalVariation(float("inf")), "knee"),
    (lambda: HuberTotalVariation(0.1, 0), "at least 1"),
    (lambda: BilateralTotalVariation(0), "radius"),
    (lambda: BilateralTotalVariation(2, 1.5), "at most 1"),
    (lambda: BilateralTotalVariation(iterations=0), "iterations"),
    (lambda: WaveletL1(0), "levels"),
    (lambda: WaveletL1(iterations=0), "iterations"),
    (lambda: Bounded(TotalVariation(), 1, 1), "below the upper"),
    (lambda: Bounded(TotalVariation(), float("nan")), "below the upper"),
    (lambda: Bounded(TotalVariation(), rounds=0), "rounds"),
    (lambda: Bounded(Bounded(TotalVariation()), 0, 1), "Bounded itself"),
    (lambda: Fixed(0), "step size 0"),
    (lambda: Fixed(math.inf), "inf"),
    (lambda: SpectralNorm(0), "0 iterations"),
    (lambda: Backtracking(growth=0.9), "growth=0.9"),
    (lambda: Backtracking(shrink=1), "shrink=1"),
    (lambda: Balance(0), "ratio 0"),
    (lambda: Balance(math.nan), "nan"),
]
"""Calls with a bad argument, each with a part of the sentence that refuses it, as a regular expression."""


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_bad_argument_raises_input_error(call, message):
    with pytest.raises(InputError, match=message):
        call()
