"""The notebooks are saved with what they show, and run from top to bottom (all of them by `make test-slow`)."""

import ast
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).resolve().parent.parent / "notebooks").glob("*.ipynb"))
# The one that `make test` runs: it compiles least.
SMOKE = "04_spike_intervals"


def _by_name(path: Path) -> str:
    return path.stem


def _runs(path: Path, folder: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": folder}}).execute()
    # What goes to standard error would stand in the reader's notebook too: warnings, mostly.
    streams = [out for cell in notebook.cells for out in cell.get("outputs", []) if out.output_type == "stream"]
    assert not [out.text for out in streams if out.name == "stderr"]


@pytest.mark.parametrize("path", [path for path in NOTEBOOKS if path.stem == SMOKE], ids=_by_name)
def test_one_runs(path, tmp_path):
    _runs(path, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("path", [path for path in NOTEBOOKS if path.stem != SMOKE], ids=_by_name)
def test_runs(path, tmp_path):
    _runs(path, tmp_path)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=_by_name)
def test_is_saved_with_its_pictures(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), "run it once: make notebooks"
    outputs = [out for cell in code for out in cell.outputs]
    assert not [out for out in outputs if out.output_type == "error"]
    assert sum("image/png" in out.get("data", {}) for out in outputs) >= 3
    assert path.stat().st_size < 700_000


@pytest.mark.parametrize("path", NOTEBOOKS, ids=_by_name)
def test_pictures_have_alternative_texts(path):
    """A cell that draws says in its metadata what there is to see; the site shows it (MyST-NB's option `image`)."""
    for cell in nbformat.read(path, as_version=4).cells:
        if any("image/png" in out.get("data", {}) for out in cell.get("outputs", [])):
            text = cell.metadata.get("mystnb", {}).get("image", {}).get("alt", "")
            assert len(text) > 40, f"{cell.id} draws, but its metadata lack mystnb.image.alt"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=_by_name)
def test_imports_what_there_is(path):
    """Every name that a notebook imports from the packages exists, without running it."""
    source = "\n".join(cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code")
    tree = ast.parse(source.replace("%matplotlib inline", ""))
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(("scsr_opt", "learned")):
            exec(compile(ast.Module([node], []), path.name, "exec"), {})


@pytest.mark.parametrize("path", NOTEBOOKS, ids=_by_name)
def test_needs_nothing_outside_the_repository(path):
    notebook = nbformat.read(path, as_version=4)
    assert not [cell.source for cell in notebook.cells if "shared" in cell.source or "/work" in cell.source]
