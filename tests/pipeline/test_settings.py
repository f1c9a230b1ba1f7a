"""Settings: values that are checked, and that reach the stage they are for."""

import ast
import inspect
from dataclasses import FrozenInstanceError, dataclass, field, fields, replace
from typing import Any

import numpy as np
import pytest

from scsr_opt import InputError, PipelineSettings, reconstruct
from scsr_opt._settings import Settings
from scsr_opt.pipeline import (
    GainSettings,
    OuterLoopSettings,
    SamplingSettings,
    SceneSummarySettings,
    StrengthSettings,
    TileSettings,
)


@dataclass(frozen=True, kw_only=True)
class Nested(Settings):
    share: float = 0.5


@dataclass(frozen=True, kw_only=True)
class Example(Settings):
    above_zero = frozenset({"parts", "sides"})

    share: float = 0.5
    frames: int = 8
    widths: tuple[float, float] = (1.0, 2.0)
    counts: tuple[int, int] = (2, 3)
    parts: int = 4
    sides: tuple[int, int] = (2, 3)
    nested: Nested = field(default_factory=Nested)


@pytest.mark.usefixtures("types_unchecked")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"share": "0.5x"}, "Example.share is '0.5x'; it must be a finite number"),
        ({"share": None}, "must be a finite number"),
        ({"share": True}, "must be a finite number"),
        ({"share": -0.1}, "not negative"),
        ({"share": float("nan")}, "must be a finite number"),
        ({"share": float("inf")}, "must be a finite number"),
        ({"share": (0.5,)}, "must be a finite number"),
        ({"frames": 2.5}, "Example.frames is 2.5; it must be a whole number"),
        ({"frames": True}, "must be a whole number"),
        ({"frames": -1}, "not negative"),
        ({"widths": (1.0,)}, "Example.widths is (1.0,); it must be a tuple of 2 numbers"),
        ({"widths": [1.0, 2.0]}, "must be a tuple of 2 numbers"),
        ({"widths": 1.0}, "must be a tuple of 2 numbers"),
        ({"widths": (1.0, -2.0)}, "not negative"),
        ({"counts": (2, 2.5)}, "must be a whole number"),
        ({"parts": 0}, "Example.parts is 0; it must be above 0, such as 4"),
        ({"sides": (2, 0)}, "it must be above 0"),
        ({"share": "0.5"}, "must be a finite number"),
        ({"share": b"1"}, "must be a finite number"),
        ({"share": 10**400}, "must be a finite number"),
        ({"nested": 0.5}, "Example.nested is 0.5; it must be a Nested"),
        ({"nested": Example()}, "must be a Nested"),
    ],
)
def test_settings_wrong_value_is_refused(change, message):
    with pytest.raises(InputError) as error:
        Example(**change)
    assert message in str(error.value)


@pytest.mark.usefixtures("types_unchecked")
def test_settings_values_become_the_types_of_their_defaults():
    given: dict[str, Any] = {"share": 1, "frames": np.int64(4), "widths": (np.float32(3), 4)}
    found: Any = Example(**given)
    assert found == Example(share=1.0, frames=4, widths=(3.0, 4.0)) and hash(found) == hash(replace(found))
    assert [type(v) for v in (found.share, found.frames, *found.widths)] == [float, int, float, float]
    with pytest.raises(FrozenInstanceError):
        found.share = 2.0


def of_all(settings: type[Settings]) -> list[type[Settings]]:
    """A class of settings and those that its fields are made of."""
    made = [getattr(settings(), one.name) for one in fields(settings)]
    return [settings, *(each for part in made if isinstance(part, Settings) for each in of_all(type(part)))]


@pytest.mark.parametrize("settings", of_all(PipelineSettings), ids=lambda s: s.__name__)
def test_settings_every_field_says_what_it_decides(settings):
    assert hash(settings()) == hash(settings())
    (body,) = ast.parse(inspect.getsource(settings)).body
    assert isinstance(body, ast.ClassDef)
    for before, after in zip(body.body, [*body.body[1:], None], strict=True):
        if isinstance(before, ast.AnnAssign):
            documented = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
            assert documented, f"{settings.__name__}.{ast.unparse(before.target)} has no sentence below it"


@pytest.fixture(scope="module")
def spikes() -> np.ndarray:
    """A texture that moves right by 0.1 sensor pixels a frame, with a tile in the dark."""
    rows, columns = np.mgrid[0:24, 0:24]
    light = np.stack([0.5 + 0.4 * np.sin(0.9 * (columns - 0.1 * t) + 0.5 * rows) for t in range(41)])
    charge = np.cumsum(0.6 * light, axis=0) + np.random.default_rng(0).random((24, 24))
    return np.diff(np.floor(charge), axis=0, prepend=0).astype(np.uint8)


def test_reconstruct_settings_reach_their_stages(spikes):
    usual = reconstruct(spikes, scale=2)
    assert usual.scene is not None and usual.scene.kind.shape == (2, 2)
    settings = PipelineSettings(
        scene_summary=SceneSummarySettings(tile_px=8),
        strength=StrengthSettings(raised_by=(2.8, 3.4), least_by_noise=(1.4, 0.8)),
        sampling=SamplingSettings(positions_motion_px=(9.0, 9.0, 9.0), steady_weight_change=9.0),
        gain=GainSettings(least_motion_px=1000.0),
        outer_loop=OuterLoopSettings(correction_tolerances=1e9),
        tiles=TileSettings(side_px=8),
        learned_prior_scale=1,
    )
    found = reconstruct(spikes, scale=2, settings=settings)
    assert found.scene is not None and found.scene.kind.shape == (3, 3)
    assert (usual.diagnostics.positions or 0) > 1 and found.diagnostics.positions == 1
    assert usual.diagnostics.gain_spread is not None and found.diagnostics.gain_spread is None
    # Huber-TV, which the learned prior is no longer, is solved by tiles.
    assert usual.tiles is None and found.tiles is not None and found.tiles.tile_side == 16


def test_reconstruct_strength_is_raised_by_its_settings(spikes):
    usual = reconstruct(spikes, scale=2, gain=None)
    twice = PipelineSettings(strength=StrengthSettings(raised_by=(2.8, 3.4), least_by_noise=(1.4, 0.8)))
    found = reconstruct(spikes, scale=2, gain=None, settings=twice)
    assert found.diagnostics.strength == pytest.approx(2 * (usual.diagnostics.strength or 0), rel=1e-6)


def _all_settings(settings: Settings) -> list[Settings]:
    parts = [getattr(settings, one.name) for one in fields(settings)]
    return [settings, *(found for part in parts if isinstance(part, Settings) for found in _all_settings(part))]


@pytest.mark.parametrize(
    ("settings", "name"),
    [(each, name) for each in _all_settings(PipelineSettings()) for name in sorted(each.above_zero)],
)
def test_settings_zero_where_something_is_divided_by_is_refused(settings, name):
    """Each of these made a solve raise, warn of values that are not numbers, or find no sample."""
    value = getattr(settings, name)
    with pytest.raises(InputError, match="must be above 0"):
        replace(settings, **{name: tuple(0 * part for part in value) if isinstance(value, tuple) else 0 * value})
