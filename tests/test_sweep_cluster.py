"""Sweeps as tasks of a Dask cluster: workers die, cells run again, the results are those of any other sweep."""

import json
import os
import signal
import sys
import time

import pytest
from sweeps import all_rows, grid_file, psotrack, small_sequence, started

from psotrack.errors import SettingsError
from psotrack.sweep import load
from psotrack.sweep.cluster import run_on_cluster

pytest.importorskip("distributed")


@pytest.mark.slow
def test_a_worker_is_killed_and_its_cell_runs_again(tmp_path_factory, tmp_path):
    root, results = small_sequence(tmp_path_factory), tmp_path / "results"
    grid = grid_file(tmp_path, [2, 3, 4, 5])
    words = ("--data", root, "--out", results, "--cluster", "local")
    running = started(root, "sweep", grid, *words, "--workers", 2, "--json", "-")
    until, claims = time.monotonic() + 120, []
    while not claims:
        assert running.poll() is None, running.communicate()
        assert time.monotonic() < until, "no worker claims anything"
        time.sleep(0.01)
        claims = list((results / "cells").glob("*.claim"))
    owner = json.loads(claims[0].read_text())
    assert owner["process"] != running.pid
    os.kill(owner["process"], signal.SIGKILL)
    out, err = running.communicate(timeout=240)
    assert running.returncode == 0, err
    assert json.loads(out) == {"finished": 4, "failed": 0, "left": 0}
    assert sorted(all_rows(results)["settings.iterations"]) == [2, 3, 4, 5]
    manifest = json.loads((results / "manifest.json").read_text())
    assert [run["cells"] for run in manifest["runs"]] == [4]
    assert list(manifest["inputs"]) == all_rows(results)["input"].unique().tolist()
    # Nothing is left, so no cluster is needed, and none at this address is missed.
    again = psotrack(root, "sweep", grid, *words[:-1], "tcp://127.0.0.1:1", "--json", "-")
    assert json.loads(again.stdout) == {"finished": 0, "failed": 0, "left": 4}


def test_without_dask_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(
        SettingsError, match=r"expected Dask, found .*; install it with `pip install '\.\[dask\]'`"
    ):
        run_on_cluster(load(grid_file(tmp_path, [2])), tmp_path, data=tmp_path, cache=tmp_path)
