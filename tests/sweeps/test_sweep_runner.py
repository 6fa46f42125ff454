"""Sweeps on a very small sequence: cells, rows, resuming, failures and tables.

Some tests replace the tracker by a tracker that finds no drones, because they do not look at the tracks.
"""

import importlib
import json
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from helpers import with_cameras
from small_sweeps import SETTINGS, all_rows, grid_file, psotrack, small_sequence, stamps

from psotrack.cli import main
from psotrack.errors import InputError
from psotrack.recordings.datasets import open_recording
from psotrack.support import compiled, register_plugin
from psotrack.sweeps import Inputs, Store, cell_key, machine, plan, runner, sweep
from psotrack.sweeps import grid as grid_of
from psotrack.sweeps import inputs as inputs_of_cells
from psotrack.sweeps.locks import Locks

METHODS = """
[methods.usual]
[methods.calm]
swarm.inertia = 0.4
"""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with a small sequence, and a cache."""
    return small_sequence(tmp_path_factory)


@pytest.fixture(scope="module")
def swept(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with grids and results of four cells that finish and four cells that fail."""
    folder = tmp_path_factory.mktemp("sweep")
    whole = grid_file(folder, [3, 6], runs=2)
    whole.write_text(whole.read_text() + METHODS)
    (folder / "good.toml").write_text(whole.read_text())
    whole.write_text(whole.read_text().replace("[grid]", '[grid]\ncameras = [["nowhere"], "all"]'))
    done = psotrack(root, "sweep", whole, "--data", root, "--out", folder / "results")
    assert done.returncode == 2
    assert "4 cells finished now, 0 before, 4 failed" in done.stdout, done.stderr
    return folder


def called(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, list[str], str]:
    """Run `psotrack WORDS` in this process: exit code, lines on stdout, stderr. For commands that compute nothing."""
    code = 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["psotrack", *map(str, words)])
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
    out, err = capsys.readouterr()
    return code, out.splitlines(), err


class Tracker:
    """Replaces the tracker: finds no drones, and fails for some numbers of iterations."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.runs: list[tuple[int, list[int]]] = []
        self.failing: set[int] = set()
        monkeypatch.setattr(runner, "track_runs", self)

    def __call__(self, sequence: object, silhouettes: object, settings: list) -> list[InputError]:
        iterations = settings[0].swarm.iterations
        if iterations in self.failing:
            raise ZeroDivisionError("planted")
        self.runs.append((iterations, [each.seed for each in settings]))
        return [InputError("here", expected="drones", found="none") for _ in settings]


@pytest.fixture
def tracker(monkeypatch: pytest.MonkeyPatch) -> Tracker:
    return Tracker(monkeypatch)


def varied(*iterations: int, runs: int = 1, **settings: object) -> dict:
    grid = {"swarm.iterations": list(iterations)}
    return {"sequences": ["S01_D2_A"], "runs": runs, "settings": SETTINGS | settings, "grid": grid}


@pytest.mark.slow
@pytest.mark.skipif(not compiled._MAPS.exists(), reason="this system does not list memory maps")
def test_a_sweep_drops_the_programs_of_other_shapes(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a limit that is always exceeded, each cell begins without the compiled programs of the cells before."""
    programs, kept = [], []

    def compile_and_find_nothing(_: object, __: object, settings: list) -> list[InputError]:
        kept.append([program._cache_size() for program in programs])
        programs.append(jax.jit(lambda x: jnp.sin(x) @ x))
        programs[-1](jnp.ones(settings[0].swarm.iterations))
        return [InputError("here", expected="drones", found="none") for _ in settings]

    monkeypatch.setattr(runner, "track_runs", compile_and_find_nothing)
    (tmp_path / "limit").write_text("0")
    monkeypatch.setattr(compiled, "_MAP_LIMIT", tmp_path / "limit")
    sweep(varied(2, 3, 4), tmp_path / "out", data=root, cache=root / "cache").rows()
    assert kept == [[], [0], [0, 0]]
    assert programs[-1]._cache_size() == 1


@pytest.mark.slow
def test_one_row_per_cell_and_run(swept: Path) -> None:
    rows = all_rows(swept / "results")
    combinations = set(zip(rows["method"], rows["settings.swarm.iterations"], rows["seed"], strict=True))
    assert combinations == {(m, i, s) for m in ("usual", "calm") for i in (3, 6) for s in (0, 1)}
    assert len(rows) == 8
    assert set(rows["settings.swarm.inertia"][rows["method"] == "calm"]) == {0.4}
    assert (rows["mean_error_m"] < 0.2).all()
    assert (rows["drones"] == 2).all()
    assert (rows["num_cameras"] == 8).all()
    assert (rows["frames"] > 0).all()
    assert {"seconds.track", "versions.jax", "device.kind", "device.processor", "commit"} <= set(rows.columns)
    assert {"perturbation.flipped", "runs_in_batch", "seconds.compile"} <= set(rows.columns)
    # Six frames at 25 frames per second, over the run's share of the seconds of all runs. The factor is stored with
    # three significant digits, so half a unit of the third one is at most 0.5 %; 0.1 % is for the rounded seconds.
    share_s = rows["seconds.batch"] / rows["runs_in_batch"]
    np.testing.assert_allclose(rows["real_time_factor"], 6 / 25 / share_s, rtol=0.006)
    # The cells that need a new program wait for its compilation; the others use a program that was compiled before.
    compiled = rows["seconds.compile"] > 0.05 * rows["seconds.batch"]
    assert (rows["real_time_factor_running"] >= rows["real_time_factor"]).all()
    assert (rows["real_time_factor_running"] > rows["real_time_factor"])[compiled].all()
    # The folder is one Parquet data set, with failures and the grids that were run in it.
    # Files are in the order of digests, rows in that of the settings.
    order = ["method", "settings.swarm.iterations", "seed"]
    data_set = pd.read_parquet(swept / "results").sort_values(order, ignore_index=True)
    pd.testing.assert_frame_equal(data_set, Store(swept / "results").rows(), check_dtype=False)


@pytest.mark.slow
def test_a_cell_that_fails_does_not_stop_the_other_cells(
    swept: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, status, _ = called(capsys, "sweep", "--status", swept / "results")
    assert status[-1].endswith("4 finished, 4 failed, 0 locked")
    assert len(status) == 5
    assert all("nowhere" in line for line in status[:-1])


@pytest.mark.slow
def test_finished_cells_are_not_run_again(root: Path, swept: Path) -> None:
    before = stamps(swept / "results")
    words = ("--data", root, "--out", swept / "results", "--device", "cpu")
    again = psotrack(root, "sweep", swept / "good.toml", *words)
    assert again.returncode == 0, again.stderr
    assert "0 cells finished now, 4 before" in again.stdout
    assert stamps(swept / "results") == before
    # Both grids are noted, with the same origin as the rows.
    runs = [json.loads(path.read_text()) for path in (swept / "results" / "_runs").glob("*.json")]
    assert sorted(run["cells"] for run in runs) == [4, 8]
    assert all(run["grid"]["methods"] == {"usual": {}, "calm": {"swarm.inertia": 0.4}} for run in runs)
    rows = all_rows(swept / "results")
    assert {run["device"]["processor"] for run in runs} == set(rows["device.processor"])
    assert {run["commit"] for run in runs} == set(rows["commit"])
    assert len(sweep(swept / "good.toml", swept / "results", data=root, cache=root / "cache").rows()) == 8
    assert stamps(swept / "results") == before


@pytest.mark.slow
def test_a_table_of_the_results(swept: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("report", swept / "results", "--rows", "iterations", "--columns", "method", "--table", "csv")
    code, lines, _ = called(capsys, *words)
    assert code == 0
    assert "usual" in lines[0]
    assert "calm" in lines[0]
    code, lines, _ = called(capsys, *words[:-1], "--value", "real_time_factor")
    assert code == 0
    assert lines[0].startswith("real_time_factor: mean")
    # If the rows are methods, the default columns are the sequences.
    code, lines, _ = called(capsys, "report", swept / "results", "--table", "--rows", "method")
    assert code == 0
    assert "S01_D2_A" in lines[2]
    code, _, wrong = called(capsys, "report", swept / "results", "--table", "--value", "mean_eror_m")
    assert code == 2
    assert wrong.count("\n") == 1
    assert "mean_error_m" in wrong


@pytest.mark.slow
def test_a_plan_counts_the_cells_and_runs(root: Path, tracker: Tracker, tmp_path: Path) -> None:
    store, inputs, grid = Store(tmp_path), Inputs(root, root / "cache"), grid_of(varied(3, 30, runs=2))
    assert f"{plan(grid, inputs, store)}".endswith("\n2 cells: 0 finished, 2 to run (4 runs)")
    sweep(varied(3, runs=2), tmp_path, data=root, cache=root / "cache")
    after = plan(grid, inputs, store)
    assert f"{after}".endswith("\n2 cells: 1 finished, 1 to run (2 runs)")
    assert (after.to_dict()["finished"], after.to_dict()["runs"]) == (1, 2)


def test_a_dry_run_shows_the_cells(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = grid_file(tmp_path, [3, 6], runs=2)
    code, lines, _ = called(capsys, "sweep", path, "--dry-run")
    assert code == 0
    assert lines[1].split()[1:] == [
        "sequence=S01_D2_A",
        "method=",
        "cameras=all",
        "runs=2",
        "swarm.iterations=6",
    ]
    assert lines[2:] == [
        "cannot be read: data: expected the sequence S01_D2_A, found none; name the data's root with --data",
        "2 cells: 0 finished, 2 cannot be read, 0 to run (0 runs)",
    ]


def test_an_error_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = grid_file(tmp_path, [3])
    code, _, err = called(capsys, "sweep", path, "--out", tmp_path, "--workers", 2)
    assert (code, err.count("\n")) == (2, 1)
    assert "--cluster local" in err
    path.write_text(path.read_text().replace("iterations", "iteratons"))
    code, _, err = called(capsys, "sweep", path, "--out", tmp_path)
    assert (code, err.count("\n")) == (2, 1)
    assert "iterations" in err


@pytest.mark.skipif(shutil.which("nvidia-smi") is not None, reason="there may be a GPU")
@pytest.mark.slow
def test_a_missing_gpu_is_one_line(tmp_path: Path) -> None:
    result = psotrack(tmp_path, "sweep", grid_file(tmp_path, [3]), "--out", tmp_path, "--device", "gpu")
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert "pip install '.[cuda]'" in result.stderr


@pytest.mark.slow
def test_in_python_the_rows_are_the_rows_of_the_grid(root: Path, tracker: Tracker, tmp_path: Path) -> None:
    out, folders = tmp_path / "out", {"data": root, "cache": root / "cache"}
    rows = sweep(varied(3, 4, runs=2), out, **folders).rows()
    assert rows[["settings.swarm.iterations", "seed"]].to_numpy().tolist() == [[3, 0], [3, 1], [4, 0], [4, 1]]
    assert (rows["missed_rate"] == 1).all()
    rows = sweep(grid_of(varied(5, 4)), out, **folders).rows()
    assert rows[["settings.swarm.iterations", "seed"]].to_numpy().tolist() == [[5, 0], [4, 0]]
    # More runs of a finished cell only add rows.
    (tmp_path / "grid.toml").write_text(grid_file(tmp_path, [3], runs=3).read_text())
    assert sweep(tmp_path / "grid.toml", out, **folders).rows()["seed"].tolist() == [0, 1, 2]
    assert tracker.runs == [(3, [0, 1]), (4, [0, 1]), (5, [0]), (3, [2])]


@pytest.mark.slow
def test_a_failure_is_removed_when_the_cell_is_finished(root: Path, tracker: Tracker, tmp_path: Path) -> None:
    out, folders = tmp_path / "out", {"data": root, "cache": root / "cache"}
    tracker.failing = {3}
    rows = sweep(varied(3, 4), out, **folders).rows()
    assert rows["settings.swarm.iterations"].tolist() == [4]
    assert rows.attrs["errors"] == ["S01_D2_A swarm.iterations=3: ZeroDivisionError: planted"]
    (kept,) = (json.loads(path.read_text()) for path in (out / "cells").glob("_*.error.json"))
    assert "in __call__" in kept["where"]
    tracker.failing = set()
    assert len(sweep(varied(3, 4), out, **folders).rows()) == 2
    assert Store(out).status()["failed"] == 0
    assert tracker.runs == [(4, [0]), (3, [0])]


@pytest.mark.slow
def test_a_failure_to_read_is_removed_when_the_cell_is_finished(
    root: Path, tracker: Tracker, tmp_path: Path
) -> None:
    data = tmp_path / "data"
    shutil.copytree(root / "Simulated_Data" / "S01_D2_A", data / "S01_D2_A")
    calibration = data / "S01_D2_A" / "cameras_calibration.csv"
    calibration.rename(tmp_path / calibration.name)
    with pytest.raises(
        InputError, match=r"all failed: S01_D2_A swarm.iterations=3: .*found neither recording.toml nor"
    ):
        sweep(varied(3), tmp_path / "out", data=data, cache=root / "cache").rows()
    assert Store(tmp_path / "out").status()["failed"] == 1
    (tmp_path / calibration.name).rename(calibration)
    rows = sweep(varied(3), tmp_path / "out", data=data, cache=root / "cache").rows()
    assert Store(tmp_path / "out").status()["failed"] == 0
    assert rows.attrs["errors"] == []


@pytest.mark.slow
def test_a_runner_waits_for_locked_cells_and_runs_them_when_they_are_unlocked(
    root: Path, tracker: Tracker, tmp_path: Path
) -> None:
    grid, out = grid_of(varied(3, 4)), tmp_path / "out"
    inputs = Inputs(root, root / "cache")
    first = grid.cells()[0]
    # If an assertion fails, the lock is released before the pool waits for its thread.
    with ThreadPoolExecutor(1) as threads:
        with Store(out).lock(cell_key(first, inputs.keys_of(first))):
            waiting = threads.submit(sweep, grid, out, data=root, cache=root / "cache")
            while not tracker.runs:
                assert not waiting.done(), waiting.result()
                time.sleep(0.05)
            time.sleep(0.5)
            assert not waiting.done()
            assert tracker.runs == [(4, [0])]
        assert waiting.result().count("finished") == 2
    assert tracker.runs == [(4, [0]), (3, [0])]


@pytest.mark.slow
def test_only_one_process_at_a_time_makes_the_silhouettes(root: Path, tmp_path: Path) -> None:
    cell = grid_of(varied(3)).cells()[0]
    inputs = Inputs(root, tmp_path / "cache", jobs=1)
    inputs.keys_of(cell)
    with Locks().attempt(inputs.silhouettes_lock(cell)):
        assert inputs.read(cell) is None
        assert not list((tmp_path / "cache").glob("*/zarr.json"))
    given = inputs.read(cell)
    assert given is not None
    assert given.silhouettes.num_frames == 6


@pytest.mark.slow
def test_a_changed_tracker_runs_every_cell_again(
    root: Path, tracker: Tracker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of the older code stay in the folder, and no table mixes them with the new ones."""
    out, folders = tmp_path / "out", {"data": root, "cache": root / "cache"}
    older = sweep(varied(3), out, **folders).rows()
    monkeypatch.setattr(inputs_of_cells, "code_digest", lambda: "changed")
    newer = sweep(varied(3), out, **folders).rows()
    assert tracker.runs == [(3, [0]), (3, [0])]
    assert older["cell"][0] != newer["cell"][0]
    assert Store(out).rows()["cell"].tolist() == newer["cell"].tolist()
    monkeypatch.undo()
    Tracker(monkeypatch)
    assert sweep(varied(3), out, **folders).rows()["cell"].tolist() == older["cell"].tolist()
    assert Store(out).rows()["cell"].tolist() == older["cell"].tolist()


@pytest.mark.slow
def test_a_changed_plugin_runs_every_cell_again(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "own_score.py"
    file.write_text("def make(settings): ...")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("psotrack.support.plugins._registered", {})
    register_plugin("score", "own", importlib.import_module("own_score").make)
    (cell,) = grid_of(varied(3, **{"score.kind": "own"})).cells()
    before = Inputs(root, root / "cache").keys_of(cell)
    file.write_text("def make(settings): return 1")
    assert Inputs(root, root / "cache").keys_of(cell) != before


def test_the_code_of_a_cell_is_everything_that_can_compute_a_row(tmp_path: Path, monkeypatch) -> None:
    """A change of the tracker changes the digest, one of the command line does not; no row needs what is left out."""

    def digest(package: Path) -> str:
        monkeypatch.setattr(machine, "_PACKAGE", package)
        machine.code_digest.cache_clear()
        return machine.code_digest()

    package = shutil.copytree(machine._PACKAGE, tmp_path / "psotrack")
    before = digest(package)
    with (package / "cli" / "sweep.py").open("a") as file:
        file.write("# another line")
    assert digest(package) == before
    with (package / "tracking" / "swarm" / "tracker.py").open("a") as file:
        file.write("# another line")
    assert digest(package) != before
    monkeypatch.undo()
    machine.code_digest.cache_clear()
    program = "import sys; from psotrack.sweeps import runner, perturbations; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    names = [name.replace(".", "/") for name in done.stdout.split() if name.startswith("psotrack.")]
    needless = ("sweeps/locks", "sweeps/tables")
    left_out = tuple(f"psotrack/{name}" for name in machine.COMPUTES_NO_ROW if name not in needless)
    assert [name for name in names if f"{name}/".startswith(left_out)] == []


@pytest.mark.slow
def test_only_the_instants_of_a_run_count(root: Path, tmp_path: Path) -> None:
    """With fewer frames, or another rate, than the reference: drones are not missed where nothing was tracked."""
    folders = {"data": root, "cache": root / "cache"}
    grid = {"sequences": ["S01_D2_A"], "settings": SETTINGS, "grid": {"frames": [4], "rate_hz": [25.0, 12.5]}}
    rows = sweep(grid, tmp_path / "out", **folders).rows()
    assert rows["missed_rate"].tolist() == [0.0, 0.0]
    assert (rows["mean_error_m"] < 0.2).all()
    known = open_recording(root / "Simulated_Data" / "S01_D2_A").truth.seen.any(axis=1)
    for rate_hz, kept in ((None, known[:4]), (12.5, known[:4:2])):
        (cell,) = grid_of({**grid, "grid": {"frames": [4]}}).cells()
        given = Inputs(root, root / "cache").read(cell)
        assert given.reference(rate_hz).seen.any(axis=1).sum() == kept.sum()


@pytest.mark.slow
def test_everything_that_a_cell_reads_changes_its_key(root: Path, tmp_path: Path) -> None:
    """Rates, times of frames and rows, kinds of lenses and names of cameras, without videos of other content."""
    (cell,) = grid_of(varied(3)).cells()

    def key(change) -> str:
        inputs = Inputs(root, root / "cache")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(inputs_of_cells, "open_recording", lambda folder: change(open_recording(folder)))
            return cell_key(cell, inputs.keys_of(cell))

    def slower(recording):
        videos = {name: replace(video, fps=20.0) for name, video in recording.videos.items()}
        return with_cameras(recording, video=videos, times=dict.fromkeys(videos))

    def with_lens(recording, *, fisheye):
        cameras = recording.rig.cameras
        count = len(recording.rig)
        # Without distortion, pinholes and fisheyes have the same coefficients.
        changed = replace(cameras, dist=np.zeros((count, 4)), fisheye=fisheye and np.ones(count, bool))
        return recording.with_rig(replace(recording.rig, cameras=changed))

    changes = [
        lambda recording: recording,
        slower,
        partial(with_lens, fisheye=None),
        partial(with_lens, fisheye=True),
        lambda recording: with_cameras(recording, line_time_s=dict.fromkeys(recording.rig.names, 1e-5)),
        lambda recording: with_cameras(recording, line_time_s=dict.fromkeys(recording.rig.names, 2e-5)),
        lambda recording: replace(recording, bounds_m=(-1.0, 1.0, -1.0, 1.0, 0.0, 2.0)),
    ]
    keys = [key(change) for change in changes]
    assert len(set(keys)) == len(keys)


def test_a_commit_is_empty_outside_of_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package that is installed inside the checkout of another project does not have that project's commit."""

    def commit(folder: Path) -> str:
        machine.commit.cache_clear()
        return machine.commit(folder)

    # The result must not depend on the settings of the user's git, or on variables that a git hook sets.
    monkeypatch.setenv("GIT_CONFIG_GLOBAL", os.devnull)
    for name in ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE"):
        monkeypatch.delenv(name, raising=False)
    for folder, expected in ((tmp_path, False), (tmp_path / "tracked", True)):
        folder.mkdir(exist_ok=True)
        (folder / "__init__.py").touch()
        git = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-C", str(folder)]
        if expected:
            for words in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "a"]):
                subprocess.run([*git, *words], check=True)
        assert bool(commit(folder)) == expected
    (tmp_path / "tracked" / "__init__.py").write_text("changed")
    assert commit(tmp_path / "tracked").endswith("-dirty")
    installed = tmp_path / "tracked" / "site-packages"
    installed.mkdir()
    (installed / "__init__.py").touch()
    assert commit(installed) == ""
