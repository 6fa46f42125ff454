"""Execute notebooks and write them, with what they show, as .ipynb beside their scripts.

python notebooks/_refresh.py [NAME ...]     # all without a name; `make notebooks` does so too
"""

from __future__ import annotations

import sys
from pathlib import Path

import jupytext
import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent


def main(names: list[str]) -> None:
    """Refresh the notebooks of these names."""
    for name in names or sorted(path.stem for path in HERE.glob("[a-z]*.py")):
        notebook = jupytext.read(HERE / f"{name}.py")
        NotebookClient(
            notebook,
            kernel_name="python3",
            timeout=None,
            record_timing=False,
            resources={"metadata": {"path": str(HERE)}},
        ).execute()
        # Nothing that differs from one refresh to the next but what the notebook shows.
        notebook.metadata["language_info"] = {"name": "python"}
        for number, cell in enumerate(notebook.cells):
            cell["id"] = f"cell-{number:02d}"
        nbformat.write(notebook, HERE / f"{name}.ipynb")
        print(f"{name}.ipynb")


if __name__ == "__main__":
    main(sys.argv[1:])
