"""The notebooks: script and .ipynb hold the same; what is committed has been run and can be read; all of it runs."""

import ast
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jupytext
import nbformat
import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted((ROOT / "notebooks").glob("[a-z]*.py"))
#: So that people can read them where repositories are shown, and clone them.
MOST_BYTES = 1_000_000
#: What begins like this lies on somebody's machine; on this one, wherever the checkout is.
MACHINE = re.compile(rf"(?<![\w.])(/(home|root|tmp|Users)/|[A-Z]:\\|{re.escape(str(ROOT))})")

each = pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)


def committed(script):
    """The notebook that is paired with a script."""
    return nbformat.read(script.with_suffix(".ipynb"), as_version=4)


def cells(notebook):
    return [(cell.cell_type, cell.source) for cell in notebook.cells]


def has_picture(cell):
    kinds = [kind for output in cell.get("outputs", ()) for kind in output.get("data", {})]
    return any(kind.startswith("image/") for kind in kinds)


@each
def test_script_and_notebook_hold_the_same(script):
    assert cells(jupytext.read(script)) == cells(committed(script))


def test_every_notebook_has_a_script():
    assert [path.stem for path in sorted((ROOT / "notebooks").glob("*.ipynb"))] == [
        path.stem for path in SCRIPTS
    ]


@each
def test_committed_notebook_has_been_run_from_top_to_bottom(script):
    counts = [cell.execution_count for cell in committed(script).cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1))


@each
def test_every_picture_is_followed_by_what_to_see(script):
    notebook = committed(script)
    after = [
        following
        for cell, following in zip(notebook.cells, notebook.cells[1:], strict=False)
        if has_picture(cell)
    ]
    assert after
    # A photograph of the hall at the beginning needs it as much as the last curve.
    assert all(cell.cell_type == "markdown" and cell.source.startswith("*What to see") for cell in after)
    assert not has_picture(notebook.cells[-1])


@each
def test_committed_notebook_shows_no_trouble_and_no_machine(script):
    notebook = committed(script)
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", ())]
    assert not [
        output for output in outputs if output.output_type == "error" or output.get("name") == "stderr"
    ]
    texts = [output.get("text", "") for output in outputs]
    texts += [
        text for output in outputs for kind, text in output.get("data", {}).items() if "image" not in kind
    ]
    assert not [text for text in texts if MACHINE.search(text)]


@each
def test_committed_notebook_is_small_and_its_metadata_are_stable(script):
    path = script.with_suffix(".ipynb")
    assert path.stat().st_size < MOST_BYTES
    notebook = committed(script)
    assert notebook.metadata.kernelspec.name == "python3"
    assert "version" not in notebook.metadata.get("language_info", {})
    assert not [cell for cell in notebook.cells if "execution" in cell.metadata]


@each
def test_functions_are_in_the_package(script):
    # An animation has to be told how to draw a frame.
    assert sum(isinstance(node, ast.FunctionDef) for node in ast.walk(ast.parse(script.read_text()))) <= 1


@pytest.fixture(scope="module")
def copies(tmp_path_factory):
    """The notebooks in a folder of their own, beside the results that one of them reads."""
    root = tmp_path_factory.mktemp("checkout")
    (root / "experiments").symlink_to(ROOT / "experiments")
    folder = root / "notebooks"
    folder.mkdir()
    for script in SCRIPTS:
        shutil.copy(script.with_suffix(".ipynb"), folder)
    return folder


@pytest.mark.slow
@each
def test_notebook_runs_at_tiny_size(script, copies):
    """By nbmake, in a pytest of its own: this one makes errors of the warnings of Jupyter's machinery."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "--nbmake",
        # Five minutes for a cell, its default, are not enough for the compiler of any machine.
        "--nbmake-timeout=7200",
        f"{script.stem}.ipynb",
    ]
    # Most of the time is the compiler's, at this size.
    environment = os.environ | {"PSOTRACK_NOTEBOOKS": "tiny", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    ran = subprocess.run(command, cwd=copies, env=environment, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert (copies / "data" / "tiny").exists() or script.stem == "table_5"
