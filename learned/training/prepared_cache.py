"""Examples that take longer to prepare than to learn from: made once, kept in a folder, drawn from at random.

What a network is given may need an estimate of the motion and a pass over all samples, seconds for each recording. The
number of examples is that of the configuration, and they are prepared before the first step. Files hold a few each,
written whole and renamed: a preparation that was killed resumes with the next file.

Pictures are kept in half precision: its rounding, 5·10⁻⁴ of a value at most, is a tenth of the noise of what it rounds,
and twice as many examples fit into memory.
"""

import itertools
import json
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from learned.training.checkpoint import check_same
from learned.training.data import Examples
from learned.training.data_loader import batches
from learned.training.registry import trainable
from scsr_opt._files import whole_file
from scsr_opt.errors import InputError
from scsr_opt.progress import NoProgress, Progress, check_progress

IN_A_FILE = 8
"""Examples."""

Prepared = Mapping[str, Shaped[np.ndarray, "..."]]
"""Arrays by name, of the same shapes for all examples of a kind."""


@dataclass(frozen=True)
class Preparing:
    """An endless list of prepared examples: `examples` as the network of this name and these sizes wants them.

    A process that makes some imports JAX, which it uses on the CPU.
    """

    examples: Examples
    model: str
    scale: int
    network: Mapping[str, Any]

    def __getitem__(self, number: int) -> Prepared:
        preparation = trainable(self.model, self.scale, self.network).preparation
        assert preparation is not None
        found = {name: np.asarray(value) for name, value in preparation.make(self.examples[number]).items()}
        return {name: v.astype(np.float16) if v.ndim and v.dtype == np.float32 else v for name, v in found.items()}


def prepare(
    preparing: Preparing,
    count: int,
    folder: Path,
    made_of: Mapping[str, Any],
    *,
    workers: int,
    progress: Progress | None = None,
) -> list[Prepared]:
    """Examples 0 to `count` − 1, from the files in `folder` as far as they are there.

    **Arguments:**
    - `made_of`: all that the examples depend on, plain enough for JSON; kept with them.
    - `workers`: processes that make examples; 0: here.

    **Raises:** `InputError` if the folder holds examples that were made of something else, or a file that is damaged.
    """
    check_progress(progress)
    folder.mkdir(parents=True, exist_ok=True)
    starts = range(0, count, IN_A_FILE)
    paths = [folder / f"{start:06d}.npz" for start in starts]
    there = 0
    while there < len(paths) and paths[there].exists():
        there += 1
    found = [example for path in paths[:there] for example in _read(path, made_of)]
    progress = NoProgress() if progress is None else progress
    progress.start(count, "Preparing examples")
    progress.advance(len(found))
    try:
        with closing(batches(preparing, 1, len(found), count, workers=workers)) as feed:
            for path in paths[there:]:
                several = _together(list(itertools.islice(feed, IN_A_FILE)))
                content: dict[str, Any] = {"made_of": np.array(json.dumps(made_of)), **several}
                with whole_file(path) as temporary, temporary.open("wb") as stream:
                    np.savez(stream, **content)
                more = _split(several)
                found += more
                progress.advance(len(more))
    finally:
        progress.finish()
    return found


def _together(examples: list[Prepared]) -> Prepared:
    return {name: np.concatenate([example[name] for example in examples]) for name in examples[0]}


def _split(several: Prepared) -> list[Prepared]:
    number = len(next(iter(several.values())))
    return [{name: values[n] for name, values in several.items()} for n in range(number)]


def _read(path: Path, made_of: Mapping[str, Any]) -> list[Prepared]:
    try:
        with np.load(path) as file:
            several = {name: file[name] for name in file.files}
        kept = json.loads(str(several.pop("made_of")))
    except Exception as error:  # zipfile, NumPy and JSON have many
        raise InputError(
            f"{path} is damaged or holds no prepared examples: remove it, and it is made again."
        ) from error
    check_same(path, kept, made_of)
    return _split(several)
