"""The notebooks: script and .ipynb have the same cells; committed notebooks have been run, and all notebooks run."""

import re
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[2]
SCRIPTS = sorted((ROOT / "notebooks").glob("[a-z]*.py"))
#: Largest size of a notebook, bytes: repository pages show larger files slowly or not at all.
MAX_BYTES = 1_000_000
#: Beginnings of paths on a particular machine, including the folder of this checkout.
MACHINE_PATH = re.compile(rf"(?<![\w.])(/(home|root|tmp|Users)/|[A-Z]:\\|{re.escape(str(ROOT))})")

each_script = pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)


def committed_notebook(script):
    """The committed notebook of a script."""
    return nbformat.read(script.with_suffix(".ipynb"), as_version=4)


def cells(notebook):
    return [(cell.cell_type, cell.source) for cell in notebook.cells]


def test_every_notebook_has_a_script():
    assert sorted((ROOT / "notebooks").glob("*.ipynb")) == [path.with_suffix(".ipynb") for path in SCRIPTS]


@each_script
def test_the_committed_notebook_is_small_and_was_run_from_top_to_bottom_on_no_particular_machine(script):
    notebook = committed_notebook(script)
    assert cells(jupytext.read(script)) == cells(notebook)
    counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1))
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert [each for each in outputs if each.output_type == "error" or each.get("name") == "stderr"] == []
    texts = [output.get("text", "") for output in outputs]
    for output in outputs:
        texts += [text for kind, text in output.get("data", {}).items() if "image" not in kind]
    assert [text for text in texts if MACHINE_PATH.search(text)] == []
    assert script.with_suffix(".ipynb").stat().st_size < MAX_BYTES
    assert notebook.metadata.kernelspec.name == "python3"
    assert "version" not in notebook.metadata.get("language_info", {})
    assert [cell for cell in notebook.cells if "execution" in cell.metadata] == []


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A separate folder in which notebooks run, with a link to the results that one notebook reads."""
    root = tmp_path_factory.mktemp("checkout")
    (root / "experiments").symlink_to(ROOT / "experiments")
    (root / "notebooks").mkdir()
    return root / "notebooks"


@pytest.mark.nightly
# The machinery of Jupyter leaves sockets to the garbage collector.
@pytest.mark.filterwarnings("ignore")
@each_script
def test_notebook_runs_at_tiny_size(script, folder, monkeypatch):
    monkeypatch.setenv("PSOTRACK_NOTEBOOKS", "tiny")
    # No limit for a cell, which may wait for the compiler.
    place = {"metadata": {"path": folder}}
    NotebookClient(committed_notebook(script), timeout=None, resources=place).execute()
    assert list((folder / "data").glob("tiny*")) or script.stem == "table_5"
