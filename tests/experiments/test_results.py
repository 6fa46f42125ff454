"""Headline figures: their records, how they are made again, and which are of another version of tracking."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MODULE = ROOT / "experiments" / "_results.py"
REGISTRY = """
version = 3
[figures.speed]
says = "speed of the library"
command = "python experiments/speed.py $MY_DATA/room"
minutes = 1
"""
SCRIPT = """
import sys
import _results
assert sys.argv[1:] == ["/a/my data/room"], sys.argv
_results.Run("speed").save(_results.FOLDER, figures={"answer": 42})
"""


def git(folder: Path, *words: str) -> None:
    identity = ["-c", "user.name=n", "-c", "user.email=e@example.org"]
    subprocess.run(["git", *identity, *words], cwd=folder, check=True, capture_output=True)


def run_python(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *words], cwd=folder, capture_output=True, text=True, check=False)


def results(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return run_python(folder, "experiments/_results.py", *words)


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with one experiment, and its figure."""
    experiments = tmp_path / "experiments"
    experiments.mkdir()
    shutil.copy(MODULE, experiments)
    (experiments / "results.toml").write_text(REGISTRY)
    (experiments / "speed.py").write_text(SCRIPT)
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "-A")
    git(tmp_path, "commit", "-qm", "first")
    monkeypatch.setenv("MY_DATA", "/a/my data")
    made = results(tmp_path, "make")
    assert made.returncode == 0, made.stderr
    return tmp_path


def record_of(project: Path) -> dict:
    return json.loads((project / "experiments" / "results" / "speed.json").read_text())


def outdated(project: Path) -> list[str]:
    words = "import sys; sys.path.insert(0, 'experiments'); import _results; print(*_results.outdated(), sep='\\n')"
    return run_python(project, "-c", words).stdout.split("\n")[:-1]


def test_a_record_says_where_its_figures_come_from(project: Path) -> None:
    record = record_of(project)
    assert record["figures"] == {"answer": 42}
    assert record["command"] == "python experiments/speed.py $MY_DATA/room"
    assert (len(record["commit"]), record["dirty"], record["tracking"]) == (40, [], 3)
    assert record["versions"]["python"] == sys.version.split()[0]
    assert record["machine"]["processors"] >= 1
    shown = results(project, "list").stdout
    assert f"made {record['date'][:10]}, commit {record['commit'][:7]}, version 3 of tracking" in shown
    script = project / "experiments" / "speed.py"
    script.write_text(script.read_text() + "\n# changed\n")
    assert results(project, "make").returncode == 0
    assert record_of(project)["dirty"] == ["experiments/speed.py"]


def test_a_figure_of_another_version_is_one_line(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A figure whose recordings are not there stays with its date, and one without a record never does."""
    assert outdated(project) == [""]
    registry = project / "experiments" / "results.toml"
    registry.write_text(REGISTRY.replace("version = 3", "version = 4"))
    date = record_of(project)["date"][:10]
    expected = f"figure speed: expected version 4 of tracking, found version 3 ({date}); "
    remedy = "run `make results ONLY=speed`, about 1 minutes"
    assert outdated(project) == [expected + remedy]
    monkeypatch.delenv("MY_DATA")
    assert outdated(project) == [""]
    (project / "experiments" / "results" / "speed.json").unlink()
    assert outdated(project) == [f"figure speed: expected version 4 of tracking, found no record; {remedy}"]


def test_what_cannot_be_made_is_named(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    unknown = results(project, "list", "sped")
    assert unknown.returncode == 1
    assert "expected names of results.toml (speed), found sped" in unknown.stderr
    (project / "experiments" / "speed.py").write_text("raise SystemExit(3)\n")
    failed = results(project, "make")
    assert (failed.returncode, failed.stderr) == (1, "failed: speed\n")
    monkeypatch.delenv("MY_DATA")
    left = results(project, "make")
    stays = "speed: expected a value of MY_DATA in the environment, found none: the stored figure stays\n"
    assert (left.returncode, left.stderr) == (0, stays)
    assert results(project, "make", "speed").returncode == 1


def test_the_declared_figures() -> None:
    """At most ten, in less than two hours; commands begin with Python and a script of the repository."""
    shown = run_python(ROOT, str(MODULE), "list").stdout
    scripts = [word for word in shown.split() if word.startswith("experiments/") and word.endswith(".py")]
    assert 5 < len(scripts) <= 10
    assert all((ROOT / script).is_file() for script in scripts)
    minutes = [float(line.split()[1]) for line in shown.splitlines() if not line.startswith(" ")]
    assert sum(minutes) <= 120
