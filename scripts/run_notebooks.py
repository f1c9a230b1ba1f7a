"""Runs notebooks from top to bottom and saves them with their pictures: all of notebooks/, or those that are named.

python scripts/run_notebooks.py 03_priors_and_solvers 06_skipping
"""

import resource
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parent.parent / "notebooks"


def main(names: list[str]) -> None:
    for path in [FOLDER / f"{name}.ipynb" for name in names] or sorted(FOLDER.glob("*.ipynb")):
        began, busy = time.perf_counter(), _busy()
        notebook = nbformat.read(path, as_version=4)
        # Without a record of the times, and all that a cell prints in one piece, so that a run which changes nothing
        # leaves the file as it was.
        client = NotebookClient(
            notebook,
            timeout=600,
            resources={"metadata": {"path": FOLDER}},
            record_timing=False,
            coalesce_streams=True,
        )
        client.execute()
        notebook.metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
        nbformat.write(notebook, path)
        seconds, size = time.perf_counter() - began, path.stat().st_size / 1000
        print(f"{path.name}: {seconds:.0f} s, {_busy() - busy:.0f} of a core, {size:.0f} kB", flush=True)


def _busy() -> float:
    """Seconds of processor time of the kernels that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main(sys.argv[1:])
