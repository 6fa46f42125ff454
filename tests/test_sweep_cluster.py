"""Sweeps as tasks of a Dask cluster: when a worker is killed, its cell runs again, and the results are complete."""

import json
import sys

import pytest
from sweeps import all_rows, grid_file, psotrack, small_sequence

from psotrack.errors import SettingsError
from psotrack.sweep import read_grid, run_on_cluster

pytest.importorskip("distributed")

#: Code that every worker runs first: one worker kills itself just before it moves its cell's file to its place.
DYING = """
import contextlib, os, signal, sys
from pathlib import Path

def die_once(event, arguments):
    if event == "os.rename" and Path(arguments[1]).match("cells/*.parquet"):
        with contextlib.suppress(FileExistsError):
            Path(os.environ["DIED"]).open("x").close()
            os.kill(os.getpid(), signal.SIGKILL)

sys.addaudithook(die_once)
"""


@pytest.mark.slow
def test_a_worker_is_killed_and_its_cell_runs_again(tmp_path_factory, tmp_path):
    root, results, died = small_sequence(tmp_path_factory), tmp_path / "results", tmp_path / "died"
    (tmp_path / "dying.py").write_text(DYING)
    dask = {"WORKER__PRELOAD": str(tmp_path / "dying.py")}
    # The test must not fail on a slow machine: Dask's default timeout is half a minute.
    dask |= {"COMM__TIMEOUTS__CONNECT": "600s", "COMM__TIMEOUTS__TCP": "600s"}
    more = {f"DASK_DISTRIBUTED__{name}": value for name, value in dask.items()} | {"DIED": str(died)}
    grid = grid_file(tmp_path, [2, 3, 4, 5])
    words = ("sweep", grid, "--data", root, "--out", results, "--json", "-", "--cluster")
    done = psotrack(root, *words, "local", "--workers", 2, **more)
    assert done.returncode == 0, done.stderr
    assert died.exists()
    assert json.loads(done.stdout) == {"finished": 4, "failed": 0, "left": 0}
    assert sorted(all_rows(results)["settings.swarm.iterations"]) == [2, 3, 4, 5]
    manifest = json.loads((results / "_manifest.json").read_text())
    assert [run["cells"] for run in manifest["runs"]] == [4]
    assert list(manifest["inputs"]) == all_rows(results)["input"].unique().tolist()
    # All cells are finished, so no cluster is needed, and the address without a cluster is no error.
    again = psotrack(root, *words, "tcp://127.0.0.1:1")
    assert json.loads(again.stdout) == {"finished": 0, "failed": 0, "left": 4}


def test_without_dask_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(
        SettingsError, match=r"expected Dask, found .*; install it with `pip install 'psotrack\[dask\]'`"
    ):
        run_on_cluster(read_grid(grid_file(tmp_path, [2])), tmp_path, data=tmp_path, cache=tmp_path)
