"""Records of the experiments' results: their content, and how they are made again."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MODULE = ROOT / "experiments" / "_results.py"
REGISTRY = """
[speed]
says = "speed of the library"
folder = "experiments/results"
commands = ["python experiments/speed.py"]
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


def test_a_changed_working_tree_is_recorded(project: Path) -> None:
    (project / "library" / "a.py").write_text("SIZE = 3\n")
    assert run_results_script(project, "make").returncode == 0
    record = json.loads((project / "experiments" / "results" / "speed.json").read_text())
    assert "library/a.py" in record["dirty"]


def test_the_list_says_when_each_result_was_made(project: Path) -> None:
    record = json.loads((project / "experiments" / "results" / "speed.json").read_text())
    assert (
        f"made {record['date'][:10]}, commit {record['commit'][:7]}"
        in run_results_script(project, "list").stdout
    )


def test_a_failing_command_is_named_and_the_exit_code_is_1(project: Path) -> None:
    (project / "experiments" / "speed.py").write_text("raise SystemExit(3)\n")
    failed = run_results_script(project, "make")
    assert failed.returncode == 1
    assert "failed: speed" in failed.stderr


def test_variables_of_a_command_are_expanded_and_recorded_by_name(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    registry = project / "experiments" / "results.toml"
    registry.write_text(REGISTRY.replace('speed.py"]', 'speed.py $MY_DATA/room $MY_PYTHON"]'))
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
    unknown = run_results_script(project, "list", "sped")
    assert unknown.returncode == 1
    assert "expected names of results.toml (speed), found sped" in unknown.stderr


def test_every_declared_result_names_files_that_exist() -> None:
    """Commands begin with Python and a script of the repository."""
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    done = subprocess.run(
        [sys.executable, str(MODULE), "list"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    scripts = [
        word for word in done.stdout.split() if word.startswith("experiments/") and word.endswith(".py")
    ]
    assert scripts
    assert set(scripts) <= set(listed.splitlines())
