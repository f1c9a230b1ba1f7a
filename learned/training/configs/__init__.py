"""Configurations of training, TOML files. Those in this folder are found by their names."""

import dataclasses
import math
import os
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from learned.training.data import LIGHTS, SCENES
from scsr_opt.errors import InputError

SCHEDULES = ("constant", "halving", "cosine")
PRECISIONS = ("float32", "bfloat16")

_FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class TrainingConfig:
    """One run of training.

    **Fields:**
    - `model`: name of the network in `learned.training.registry`; `network`: its sizes.
    - `scale`, `frames`, `patch`, `scenes`, `lights`, `seed`: see `learned.training.data.Examples`; `seed` is also that
      of the first weights.
    - `pictures`: folder of stills and clips (`learned.training.data.Pictures.folder`); None: those of scikit-image.
    - `drawings`, `defects`: every n-th example looks at drawings in the place of stills, or is of a sensor with faulty
      pixels (`learned.training.data.Examples`); 0: none.
    - `prepared`: how many examples are made before the first step and then drawn from, for a network that does not
      take the spikes themselves (`learned.training.prepared_cache`); None for the others, which see none twice.
    - `start`: names of shipped weights (`spikesr-small-x4`) or paths of .scsr files, put in the place of the random
      first weights one after the other; each may be of a part of the network only, or of a
      larger one, of which a part can be named: `spikesr-small-x4:velocity`, or of another scale
      (`learned.training.checkpoint.grafted`).
    - `batch`: examples per step; the paper's 6.
    - `steps`: of Adam (Kingma and Ba 2015).
    - `rate`: the greatest learning rate. `schedule`: `constant`; `halving` every `halve_every` steps; `cosine`, from 0
      up to `rate` over `warm_up` steps, then down to a hundredth of it along half a cosine.
    - `clip`: greatest norm of the gradient; longer ones are shortened to it.
    - `skip_limit`: steps in a row without a finite loss and gradient that end a run as failed.
    - `ema_decay`: of the moving average of the weights, which is what is validated and kept.
    - `precision`: `bfloat16` computes in it; weights, their updates and the loss stay float32.
    - `validate_every`, `save_every`: steps. Killed, a run loses what it did since it saved.
    - `workers`: processes that make examples; None: one less than there are cores, 8 at most.

    **Raises:** `InputError` that names the field, what it is and what is allowed.
    """

    model: str
    scale: int
    steps: int
    network: Mapping[str, Any] = field(default_factory=dict)
    frames: int = 41
    patch: int = 40
    scenes: tuple[str, ...] = SCENES
    lights: tuple[str, ...] = LIGHTS
    pictures: str | None = None
    batch: int = 6
    rate: float | int = 5e-4
    schedule: str = "cosine"
    warm_up: int = 0
    halve_every: int = 10_000
    clip: float | int = 1.0
    skip_limit: int = 20
    ema_decay: float | int = 0.999
    precision: str = "float32"
    seed: int = 0
    validate_every: int = 500
    save_every: int = 100
    workers: int | None = None
    prepared: int | None = None
    drawings: int = 0
    defects: int = 0
    start: tuple[str, ...] | None = None

    def __post_init__(self):
        _check(vars(self))

    @classmethod
    def of(cls, table: Mapping[str, Any], source: str = "The configuration") -> "TrainingConfig":
        """A configuration of the entries of a TOML file.

        **Raises:** `InputError` for an entry that is missing, unknown or wrong.
        """
        for name in table:
            if name not in _RULES:
                raise InputError(
                    f"{source} has an entry {name!r}, which is not known: allowed are {', '.join(_RULES)}."
                )
        for name in ("model", "scale", "steps"):
            if name not in table:
                raise InputError(f"{source} lacks the entry {name!r}: it must be {_RULES[name][1]}.")
        values: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in table.items()
        }
        _check(values)
        return cls(**values)

    @classmethod
    def read(cls, name: str | os.PathLike[str]) -> "TrainingConfig":
        """The configuration in a TOML file, or of a name that comes with the package (`names()`).

        **Raises:** `InputError` if there is none of that name, or it cannot be used.
        """
        path = _FOLDER / f"{name}.toml" if str(name) in names() else Path(name)
        try:
            table = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise InputError(
                f"There is no configuration {name}: give the path of a .toml file, or one of {', '.join(names())}."
            ) from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise InputError(f"{path} is not TOML: {error}.") from error
        return cls.of(table, str(path))

    def changed(self, **fields: Any) -> "TrainingConfig":
        """A copy with other values of some fields."""
        return self.of(self.plain() | fields)

    def plain(self) -> dict[str, Any]:
        """All fields, in types that JSON has too."""
        plain = {item.name: getattr(self, item.name) for item in dataclasses.fields(self)}
        return {name: list(value) if isinstance(value, tuple) else value for name, value in plain.items()} | {
            "network": dict(self.network)
        }


def names() -> tuple[str, ...]:
    """The configurations that come with the package."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.toml")))


def _check(values: Mapping[str, Any]) -> None:
    for name, value in values.items():
        good, allowed = _RULES[name]
        if not good(value):
            raise InputError(f"{name} is {value!r}, but it must be {allowed}.")


_Rule = tuple[Callable[[Any], bool], str]


def _whole(least: int, what: str, *, or_none: bool = False) -> _Rule:
    def good(value: Any) -> bool:
        return (or_none and value is None) or (type(value) is int and value >= least)

    return good, f"a whole number of at least {least}, {what}"


def _number(good: Callable[[float], bool], allowed: str) -> _Rule:
    return lambda value: type(value) in (int, float) and math.isfinite(value) and good(value), f"a number {allowed}"


def _one_of(choices: tuple[str, ...]) -> _Rule:
    return lambda value: value in choices, f"one of {', '.join(choices)}"


def _some_of(choices: tuple[str, ...]) -> _Rule:
    return (
        lambda value: isinstance(value, tuple) and len(value) > 0 and all(entry in choices for entry in value),
        f"a list of at least one of {', '.join(choices)}",
    )


_RULES: dict[str, _Rule] = {
    "model": (lambda value: isinstance(value, str), "the name of a network, for example spikesr"),
    "scale": _whole(1, "pixels of the picture per sensor pixel"),
    "steps": _whole(1, "steps of training"),
    "network": (lambda value: isinstance(value, Mapping), "a table of sizes"),
    "frames": _whole(3, "spike frames"),
    # Validation leaves a quarter of the patch out at the border, and the structural similarity's window is 7 wide.
    "patch": _whole(16, "sensor pixels"),
    "scenes": _some_of(SCENES),
    "lights": _some_of(LIGHTS),
    "pictures": (lambda value: value is None or isinstance(value, str), "the path of a folder"),
    "batch": _whole(1, "examples per step"),
    "rate": _number(lambda value: value > 0, "above 0"),
    "schedule": _one_of(SCHEDULES),
    "warm_up": _whole(0, "steps"),
    "halve_every": _whole(1, "steps"),
    "clip": _number(lambda value: value > 0, "above 0"),
    "skip_limit": _whole(1, "steps"),
    "ema_decay": _number(lambda value: 0 <= value < 1, "from 0 to below 1"),
    "precision": _one_of(PRECISIONS),
    "seed": _whole(0, "from which everything random follows"),
    "validate_every": _whole(1, "steps"),
    "save_every": _whole(1, "steps"),
    "workers": _whole(0, "processes", or_none=True),
    "prepared": _whole(1, "examples", or_none=True),
    "drawings": _whole(0, "examples from one drawing to the next, or 0 for none"),
    "defects": _whole(0, "examples from one faulty sensor to the next, or 0 for none"),
    "start": (
        lambda value: (
            value is None or (isinstance(value, tuple) and len(value) > 0 and all(type(v) is str for v in value))
        ),
        "a list of names of shipped weights or paths of .scsr files",
    ),
}
