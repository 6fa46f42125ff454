"""Sweeps on a very small sequence: cells, rows, resuming and failures.

Some tests replace the tracker by a tracker that finds no drones, because they do not look at the tracks.
"""

import importlib
import itertools
import json
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest
from helpers import assert_refused, with_cameras
from small_sweeps import SETTINGS, all_rows, grid_file, small_sequence, stamps

from psotrack.errors import InputError
from psotrack.recordings.datasets import open_recording
from psotrack.support import Locks, register_plugin
from psotrack.sweeps import Inputs, Store, cell_key, inputs, plan, runner, sweep
from psotrack.sweeps import grid as grid_of

METHODS = """
[methods.usual]
[methods.calm]
swarm.inertia = 0.4
"""


#: A data folder with a small sequence, and a cache.
root = small_sequence


@pytest.fixture
def run(root, tmp_path):
    """Sweeps the small sequence into a folder of the test."""
    return partial(sweep, out=tmp_path / "out", data=root, cache=root / "cache", jobs=1)


@pytest.fixture(scope="module")
def swept(root, tmp_path_factory):
    """A folder with grids and results of four cells that finish and four cells that fail."""
    folder = tmp_path_factory.mktemp("sweep")
    whole = grid_file(folder, [3, 6], runs=2)
    whole.write_text(whole.read_text() + METHODS)
    (folder / "good.toml").write_text(whole.read_text())
    whole.write_text(whole.read_text().replace("[grid]", '[grid]\ncameras = [["nowhere"], "all"]'))
    (folder / "half.toml").write_text(whole.read_text())
    outcome = sweep(whole, folder / "results", data=root, cache=root / "cache", jobs=1)
    assert "4 cells finished now, 0 before, 4 failed" in f"{outcome}"
    return folder


class Tracker:
    """Replaces the tracker: finds no drones, and fails for some numbers of iterations."""

    def __init__(self, monkeypatch):
        self.runs = []
        self.failing = set()
        monkeypatch.setattr(runner, "track_runs", self)

    def __call__(self, sequence, silhouettes, settings):
        iterations = settings[0].swarm.iterations
        if iterations in self.failing:
            raise ZeroDivisionError("planted")
        self.runs.append((iterations, [each.seed for each in settings]))
        return [InputError("here", expected="drones", found="none") for _ in settings]


@pytest.fixture
def tracker(monkeypatch):
    return Tracker(monkeypatch)


def varied(*iterations, runs=1, **settings):
    grid = {"swarm.iterations": list(iterations)}
    return {"sequences": ["S01_D2_A"], "runs": runs, "settings": SETTINGS | settings, "grid": grid}


def seeds_of(outcome):
    """Iterations and seed of each row."""
    rows = outcome.rows()
    return rows[["settings.swarm.iterations", "seed"]].to_numpy().tolist()


@pytest.mark.slow
class TestTracked:
    """Cells that are tracked."""

    def test_one_row_per_cell_and_run(self, swept):
        order = ["method", "settings.swarm.iterations", "seed"]
        rows = all_rows(swept / "results").sort_values(order, ignore_index=True)
        found = rows[order].itertuples(index=False, name=None)
        assert list(found) == list(itertools.product(["calm", "usual"], [3, 6], [0, 1]))
        assert set(rows["settings.swarm.inertia"][:4]) == {0.4}
        assert (rows["mean_error_m"] < 0.2).all()
        assert (rows["drones"] == 2).all()
        assert (rows["num_cameras"] == 8).all()
        assert (rows["frames"] > 0).all()
        assert {"seconds.track", "versions.jax", "device.kind", "perturbation.flipped"} <= set(rows.columns)
        # Six frames at 25 frames per second, over the run's share of the seconds of all runs. The factor is stored with
        # three significant digits, so half a unit of the third one is at most 0.5 %; 0.1 % is for the rounded seconds.
        share_s = rows["seconds.batch"] / rows["runs_in_batch"]
        np.testing.assert_allclose(rows["real_time_factor"], 6 / 25 / share_s, rtol=0.006)
        assert (rows["real_time_factor_running"] >= rows["real_time_factor"]).all()
        # The folder is one Parquet data set, with failures and the grids that were run in it.
        # Files are in the order of digests, rows in that of the settings.
        data_set = pd.read_parquet(swept / "results").sort_values(order, ignore_index=True)
        pd.testing.assert_frame_equal(data_set, Store(swept / "results").rows(), check_dtype=False)

    def test_the_command_runs_no_finished_cell_again_and_failures_do_not_stop_it(
        self, root, swept, run_psotrack
    ):
        before = stamps(swept / "results")
        words = ("--data", root, "--out", swept / "results", "--cache", root / "cache", "--device", "cpu")
        half = run_psotrack("sweep", swept / "half.toml", *words).ended(2)
        assert "0 cells finished now, 4 before, 4 failed" in half.out
        status = run_psotrack("sweep", "--status", swept / "results")
        assert status.out.endswith("4 finished, 4 failed, 0 locked\n")
        assert status.out.count("nowhere") == 4
        good = run_psotrack("sweep", swept / "good.toml", *words).ended()
        assert "0 cells finished now, 4 before" in good.out
        assert stamps(swept / "results") == before
        # Both grids are noted, with the same origin as the rows.
        rows = all_rows(swept / "results")
        num_cells = []
        for path in (swept / "results" / "_runs").glob("*.json"):
            noted = json.loads(path.read_text())
            num_cells.append(noted["cells"])
            assert noted["grid"]["methods"] == {"usual": {}, "calm": {"swarm.inertia": 0.4}}
            assert {noted["device"]["processor"]} == set(rows["device.processor"])
            assert {noted["commit"]} == set(rows["commit"])
        assert sorted(num_cells) == [4, 8]
        # Tables of the results. If the rows are methods, the default columns are the sequences.
        report = partial(run_psotrack, "report", swept / "results", "--table")
        table = report("csv", "--rows", "iterations", "--columns", "method", "--value", "real_time_factor")
        head = table.out.partition("\n")[0]
        assert "usual" in head
        assert "calm" in head
        by_method = report("--rows", "method")
        assert "S01_D2_A" in by_method.out.splitlines()[2]

    def test_only_the_instants_of_a_run_count(self, run):
        """With fewer frames and another rate than the reference: drones are not missed where nothing was tracked."""
        varied = {"frames": [4], "rate_hz": [12.5]}
        rows = run({"sequences": ["S01_D2_A"], "settings": SETTINGS, "grid": varied}).rows()
        assert rows["missed_rate"].tolist() == [0.0]
        assert (rows["mean_error_m"] < 0.2).all()


@pytest.mark.slow
class TestRunner:
    """What is run, waited for, stored and run again, whatever the tracker finds."""

    def test_rows_of_the_grid_and_plans(self, root, run, tracker, tmp_path):
        rows = run(varied(3, 4, runs=2)).rows()
        assert (rows["missed_rate"] == 1).all()
        assert seeds_of(run(varied(3, 4, runs=2))) == [[3, 0], [3, 1], [4, 0], [4, 1]]
        assert seeds_of(run(grid_of(varied(5, 4)))) == [[5, 0], [4, 0]]
        # More runs of a finished cell only add rows.
        assert seeds_of(run(grid_file(tmp_path, [3], runs=3))) == [[3, 0], [3, 1], [3, 2]]
        assert tracker.runs == [(3, [0, 1]), (4, [0, 1]), (5, [0]), (3, [2])]
        store, inputs = Store(tmp_path / "out"), Inputs(root, root / "cache")
        planned = plan(grid_of(varied(3, 30, runs=2)), inputs, store)
        assert f"{planned}".endswith("\n2 cells: 1 finished, 1 to run (2 runs)")
        assert planned.to_dict()["finished"] == 1
        assert planned.to_dict()["runs"] == 2

    def test_a_failure_is_removed_when_the_cell_is_finished(self, run, tracker, tmp_path, monkeypatch):
        dropped = []
        monkeypatch.setattr(runner, "drop_programs_if_many", lambda: dropped.append(1))
        tracker.failing = {3}
        words = "all failed: S01_D2_A swarm.iterations=3: ZeroDivisionError: planted"
        assert_refused(run(varied(3)).rows, words, unchanged=tmp_path)
        outcome = run(varied(3, 4))
        assert seeds_of(outcome) == [[4, 0]]
        assert outcome.rows().attrs["errors"] == ["S01_D2_A swarm.iterations=3: ZeroDivisionError: planted"]
        (kept,) = (tmp_path / "out/cells").glob("_*.error.json")
        assert "in __call__" in json.loads(kept.read_text())["where"]
        tracker.failing = set()
        assert len(run(varied(3, 4)).rows()) == 2
        assert Store(tmp_path / "out").status()["failed"] == 0
        assert tracker.runs == [(4, [0]), (3, [0])]
        # Cells of many shapes need many programs: before each of four attempts, old ones may go.
        assert len(dropped) == 4

    def test_a_runner_waits_for_locked_cells_and_runs_them_when_they_are_unlocked(
        self, root, run, tracker, tmp_path, monkeypatch
    ):
        attempts = []
        attempt = Locks.attempt

        def noted_attempt(locks, path):
            attempts.append(path)
            return attempt(locks, path)

        monkeypatch.setattr(Locks, "attempt", noted_attempt)
        first, _ = grid_of(varied(3, 4)).cells()
        key = cell_key(first, Inputs(root, root / "cache").keys_of(first))
        # If an assertion fails, the lock is released before the pool waits for its thread.
        with ThreadPoolExecutor(1) as threads:
            with Store(tmp_path / "out").lock(key):
                waiting = threads.submit(run, varied(3, 4))
                # The runner has asked for the locked cell again after the other cell.
                while not tracker.runs or len(set(attempts[-3:])) > 1:
                    assert not waiting.done(), waiting.result()
                    time.sleep(0.05)
                assert tracker.runs == [(4, [0])]
            assert waiting.result().count("finished") == 2
        assert tracker.runs == [(4, [0]), (3, [0])]

    def test_only_one_process_at_a_time_makes_the_silhouettes(self, root, tmp_path):
        cell = grid_of(varied(3)).cells()[0]
        inputs = Inputs(root, tmp_path / "cache", jobs=1)
        inputs.keys_of(cell)
        with Locks().attempt(inputs.silhouettes_lock(cell)):
            assert inputs.read(cell) is None
            assert not list((tmp_path / "cache").glob("*/zarr.json"))
        given = inputs.read(cell)
        assert given is not None
        assert given.silhouettes.num_frames == 6

    def test_everything_that_a_cell_reads_changes_its_key(self, root, tmp_path, monkeypatch):
        """Rates, times of rows, kinds of lenses, the room, plugins and code, without videos of other content."""
        usual = open_recording(root / "Simulated_Data" / "S01_D2_A")

        def key(recording, **settings):
            (cell,) = grid_of(varied(3, **settings)).cells()
            monkeypatch.setattr(inputs, "open_recording", lambda folder: recording)
            return cell_key(cell, Inputs(root, root / "cache").keys_of(cell))

        def with_cameras_of(**changes):
            return usual.with_rig(replace(usual.rig, cameras=replace(usual.rig.cameras, **changes)))

        slower = {name: replace(video, fps=20.0) for name, video in usual.videos.items()}
        # Without distortion, pinholes and fisheyes have the same coefficients.
        straight = np.zeros((len(usual.rig), 4))
        changed = [
            usual,
            with_cameras(usual, video=slower, times=dict.fromkeys(slower)),
            with_cameras_of(dist=straight, fisheye=None),
            with_cameras_of(dist=straight, fisheye=np.ones(len(usual.rig), bool)),
            with_cameras(usual, line_time_s=dict.fromkeys(usual.rig.names, 1e-5)),
            replace(usual, bounds_m=(-1.0, 1.0, -1.0, 1.0, 0.0, 2.0)),
        ]
        keys = [key(recording) for recording in changed]
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.setattr("psotrack.support.plugins._registered", {})
        file = tmp_path / "own_score.py"
        file.write_text("def make(settings): ...")
        register_plugin("score", "own", importlib.import_module("own_score").make)
        keys.append(key(usual, **{"score.kind": "own"}))
        file.write_text("def make(settings): return 1")
        keys.append(key(usual, **{"score.kind": "own"}))
        monkeypatch.setattr(inputs, "code_digest", lambda: "changed")
        keys.append(key(usual))
        assert len(set(keys)) == len(keys)


def test_a_dry_run_shows_the_cells(tmp_path, run_psotrack):
    result = run_psotrack("sweep", grid_file(tmp_path, [3, 6], runs=2), "--dry-run")
    _, second, unread, last = result.out.splitlines()
    shown = " ".join(second.split())
    assert shown.endswith(" sequence=S01_D2_A method= cameras=all runs=2 swarm.iterations=6")
    assert unread.endswith("expected the sequence S01_D2_A, found none; name the data's root with --data")
    assert last == "2 cells: 0 finished, 2 cannot be read, 0 to run (0 runs)"


def test_wrong_calls_are_one_line(tmp_path, run_psotrack):
    command = partial(run_psotrack, "sweep", grid_file(tmp_path, [3]), "--out", tmp_path)
    alone = partial(command, "--workers", 2)
    assert_refused(alone, "--workers: expected --cluster local", unchanged=tmp_path)
    if shutil.which("nvidia-smi") is None:
        missing = partial(command, "--device", "gpu")
        assert_refused(missing, "--device: expected a gpu", "pip install '.[cuda]'", unchanged=tmp_path)


@pytest.mark.slow
def test_the_code_of_a_cell_is_everything_that_can_compute_a_row(tmp_path, monkeypatch):
    """A change of the tracker changes the digest, one of the command line does not; no row needs what is left out."""

    def digest_after(changed):
        path = tmp_path / changed
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as file:
            file.write("# another line")
        inputs.code_digest.cache_clear()
        return inputs.code_digest()

    with monkeypatch.context() as small:
        small.setattr(inputs, "_PACKAGE", tmp_path)
        before = digest_after("tracking/swarm/tracker.py")
        assert digest_after("cli/sweep.py") == before
        assert digest_after("tracking/swarm/tracker.py") != before
    inputs.code_digest.cache_clear()
    program = "import sys; from psotrack.sweeps import runner; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    # Tables are imported, and compute no row.
    left_out = tuple(f"psotrack/{name}" for name in inputs.COMPUTES_NO_ROW if name != "sweeps/tables")
    for module in done.stdout.split():
        path = module.replace(".", "/")
        assert not f"{path}/".startswith(left_out)


def test_a_package_in_the_checkout_of_another_project_has_not_its_commit(tmp_path, monkeypatch):
    # Variables that a git hook sets must not decide the result.
    for name in ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE"):
        monkeypatch.delenv(name, raising=False)
    git = ["git", "-c", "user.name=a", "-c", "user.email=a@b", "-C", str(tmp_path)]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "a"], check=True)
    (tmp_path / "__init__.py").touch()
    inputs.commit.cache_clear()
    assert inputs.commit(tmp_path) == ""
