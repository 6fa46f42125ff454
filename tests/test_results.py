"""Records of the experiments' results: their content, and when a result is older than its code."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
MODULE = ROOT / "experiments" / "_results.py"
REGISTRY = """
[code]
library = ["library/*"]
[results.speed]
says = "speed of the library"
folder = "experiments/results"
commands = ["python experiments/speed.py"]
code = ["library", "experiments/speed.py"]
minutes = 1
"""
SCRIPT = """
from pathlib import Path
import _results
run = _results.Run("speed")
run.save(Path("experiments/results"), figures={"answer": 42})
"""


def git(folder: Path, *words: str) -> None:
    identity = ["-c", "user.name=n", "-c", "user.email=e@example.org"]
    subprocess.run(["git", *identity, *words], cwd=folder, check=True, capture_output=True)


def run_results_script(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "experiments/_results.py", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A repository with one library, one experiment, and the experiment's result."""
    for name in ("library", "experiments"):
        (tmp_path / name).mkdir()
    shutil.copy(MODULE, tmp_path / "experiments")
    (tmp_path / "experiments" / "results.toml").write_text(REGISTRY)
    (tmp_path / "experiments" / "speed.py").write_text(SCRIPT)
    (tmp_path / "library" / "a.py").write_text('"""A module."""\nSIZE = 1\n')
    git(tmp_path, "init", "-q")
    commit(tmp_path)
    made = run_results_script(tmp_path, "make")
    assert made.returncode == 0, made.stderr
    commit(tmp_path)
    return tmp_path


def commit(folder: Path) -> None:
    git(folder, "add", "-A")
    git(folder, "commit", "-qm", "change")


def test_a_record_says_where_its_figures_come_from(project: Path) -> None:
    record = json.loads((project / "experiments" / "results" / "speed.json").read_text())
    assert record["figures"] == {"answer": 42}
    assert record["command"] == "python experiments/speed.py"
    assert len(record["commit"]) == 40
    assert record["dirty"] == []
    assert record["versions"]["python"] == sys.version.split()[0]
    assert record["machine"]["processors"] >= 1
    assert run_results_script(project, "check").returncode == 0


def test_changed_code_makes_a_result_older(project: Path) -> None:
    (project / "library" / "a.py").write_text('"""A module."""\nSIZE = 2\n')
    changed = run_results_script(project, "check")
    assert changed.returncode == 1
    assert "the working tree has changes in library/a.py" in changed.stdout
    commit(project)
    committed = run_results_script(project, "check", "speed")
    assert committed.returncode == 1
    assert "code changed since" in committed.stdout
    assert "library/a.py" in committed.stdout
    assert run_results_script(project, "make").returncode == 0
    commit(project)
    assert run_results_script(project, "check").returncode == 0


def test_docstrings_and_comments_do_not_make_a_result_older(project: Path) -> None:
    (project / "library" / "a.py").write_text('"""A module with better words."""\n\n# A reason.\nSIZE = 1\n')
    commit(project)
    assert run_results_script(project, "check").returncode == 0


def test_a_declared_new_name_does_not_make_a_result_older(project: Path) -> None:
    (project / "library" / "a.py").write_text('"""A module."""\nWIDTH = 1\n')
    commit(project)
    assert "library/a.py" in run_results_script(project, "check").stdout
    registry = project / "experiments" / "results.toml"
    registry.write_text(REGISTRY + '[renamed]\nSIZE = "WIDTH"\n')
    commit(project)
    assert run_results_script(project, "check").returncode == 0
    (project / "library" / "a.py").write_text('"""A module."""\nWIDTH = 2\n')
    commit(project)
    assert "library/a.py" in run_results_script(project, "check").stdout


def test_a_changed_working_tree_is_recorded_and_named(project: Path) -> None:
    (project / "library" / "b.py").write_text("SIZE = 3\n")
    assert run_results_script(project, "make").returncode == 0
    commit(project)
    named = run_results_script(project, "check")
    assert named.returncode == 1
    assert "made from a working tree with changes in library/b.py" in named.stdout


def test_a_file_that_was_edited_by_hand_is_named(project: Path) -> None:
    path = project / "experiments" / "results" / "speed.json"
    record = json.loads(path.read_text())
    (path.parent / "speed.csv").write_text("a\n1\n")
    path.write_text(json.dumps(record | {"files": {"speed.csv": "0" * 64}}))
    named = run_results_script(project, "check")
    assert named.returncode == 1
    assert "speed.csv is not the file that the record describes" in named.stdout


def test_a_failing_command_is_named_and_the_exit_code_is_1(project: Path) -> None:
    (project / "experiments" / "speed.py").write_text("raise SystemExit(3)\n")
    failed = run_results_script(project, "make")
    assert failed.returncode == 1
    assert "failed: speed" in failed.stderr


def test_variables_of_a_command_are_expanded_and_recorded_by_name(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    registry = project / "experiments" / "results.toml"
    registry.write_text(REGISTRY.replace('speed.py"]\ncode', 'speed.py $MY_DATA/room $MY_PYTHON"]\ncode'))
    (project / "experiments" / "speed.py").write_text(
        "import sys\nassert sys.argv[1:] == ['/a/my data/room', 'python3'], sys.argv\n" + SCRIPT
    )
    monkeypatch.setenv("MY_DATA", "/a/my data")
    unset = run_results_script(project, "make")
    assert unset.returncode == 1
    assert "speed: expected a value of MY_PYTHON in the environment, found none" in unset.stderr
    monkeypatch.setenv("MY_PYTHON", "python3")
    made = run_results_script(project, "make")
    assert made.returncode == 0, made.stderr
    record = json.loads((project / "experiments" / "results" / "speed.json").read_text())
    assert record["command"] == "python experiments/speed.py $MY_DATA/room $MY_PYTHON"


def test_an_unknown_result_is_one_line(project: Path) -> None:
    unknown = run_results_script(project, "check", "sped")
    assert unknown.returncode == 1
    assert "expected names of results.toml (speed), found sped" in unknown.stderr


def test_every_declared_result_names_files_that_exist() -> None:
    """Commands begin with Python and a script of the repository, and no pattern of the code is out of date."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    done = subprocess.run(
        [sys.executable, str(MODULE), "list"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    scripts = [
        word for word in done.stdout.split() if word.startswith("experiments/") and word.endswith(".py")
    ]
    assert scripts
    assert set(scripts) <= set(listed.splitlines())
    checked = subprocess.run(
        [sys.executable, str(MODULE), "check"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert "which matches no file" not in checked.stdout
