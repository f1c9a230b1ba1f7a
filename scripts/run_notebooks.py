"""Runs notebooks/*.ipynb from top to bottom and saves them with their pictures."""

from pathlib import Path

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).resolve().parent.parent / "notebooks"


def main() -> None:
    for path in sorted(FOLDER.glob("*.ipynb")):
        print(path.name, flush=True)
        notebook = nbformat.read(path, as_version=4)
        # Without a record of the times, so that a run which changes nothing leaves the file as it was.
        client = NotebookClient(notebook, timeout=600, resources={"metadata": {"path": FOLDER}}, record_timing=False)
        client.execute()
        notebook.metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
        nbformat.write(notebook, path)


if __name__ == "__main__":
    main()
