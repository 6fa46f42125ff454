"""Headline figures: their records, how they are made again, and which are of another version of tracking."""

import json
import runpy
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

MODULE = Path(__file__).parents[2] / "experiments" / "_results.py"
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


def git(folder, *words):
    identity = ["-c", "user.name=n", "-c", "user.email=e@example.org"]
    subprocess.run(["git", *identity, *words], cwd=folder, check=True, capture_output=True)


@pytest.fixture
def results(run_program, tmp_path, monkeypatch):
    """Runs the program of the figures in a repository with one experiment, whose figure is made."""
    experiments = tmp_path / "experiments"
    experiments.mkdir()
    shutil.copy(MODULE, experiments)
    (experiments / "results.toml").write_text(REGISTRY)
    (experiments / "speed.py").write_text(SCRIPT)
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", "-A")
    git(tmp_path, "commit", "-qm", "first")
    monkeypatch.setenv("MY_DATA", "/a/my data")
    results = partial(run_program, experiments / "_results.py")
    results("make").ended()
    return results


def record_of(project):
    return json.loads((project / "experiments" / "results" / "speed.json").read_text())


def outdated(project):
    return runpy.run_path(str(project / "experiments" / "_results.py"))["outdated"]()


def test_a_record_says_where_its_figures_come_from(results, tmp_path):
    record = record_of(tmp_path)
    assert record["figures"] == {"answer": 42}
    assert record["command"] == "python experiments/speed.py $MY_DATA/room"
    assert (len(record["commit"]), record["dirty"], record["tracking"]) == (40, [], 3)
    assert record["versions"]["python"] == sys.version.split()[0]
    shown = results("list").out
    assert f"made {record['date'][:10]}, commit {record['commit'][:7]}, version 3 of tracking" in shown
    git(tmp_path, "add", "-A")
    git(tmp_path, "commit", "-qm", "figures")
    for changed in ("speed.py", "results/speed.json"):
        with (tmp_path / "experiments" / changed).open("a") as file:
            file.write("\n")
    assert results("make").code == 0
    assert record_of(tmp_path)["dirty"] == ["experiments/speed.py"]


def test_a_figure_of_another_version_is_one_line(results, tmp_path, monkeypatch):
    """A figure whose recordings are not there stays with its date, and one without a record never does."""
    assert outdated(tmp_path) == []
    registry = tmp_path / "experiments" / "results.toml"
    registry.write_text(REGISTRY.replace("version = 3", "version = 4"))
    date = record_of(tmp_path)["date"][:10]
    expected = f"figure speed: expected version 4 of tracking, found version 3 ({date}); "
    remedy = "run `make results ONLY=speed`, about 1 minutes"
    assert outdated(tmp_path) == [expected + remedy]
    monkeypatch.delenv("MY_DATA")
    assert outdated(tmp_path) == []
    (tmp_path / "experiments" / "results" / "speed.json").unlink()
    assert outdated(tmp_path) == [f"figure speed: expected version 4 of tracking, found no record; {remedy}"]
