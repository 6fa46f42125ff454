"""The folder of a sweep's results: whole cells or none, one runner per cell, nothing run twice."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

from psotrack.errors import InputError
from psotrack.sweep.store import STALE_S, Store

KEY = "0" * 40


def rows(*seeds: int, error_m: float = 0.01) -> pd.DataFrame:
    return pd.DataFrame({"seed": list(seeds), "mean_error_m": [error_m + seed for seed in seeds]})


def claim_of(store: Store) -> Path:
    return store.folder / "cells" / f"{KEY}.claim"


def test_rows_of_more_seeds_are_added(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.seeds_of(KEY) == set()
    store.add(KEY, rows(2, 0))
    store.add(KEY, rows(1))
    assert store.seeds_of(KEY) == {0, 1, 2}
    pd.testing.assert_frame_equal(store.rows(), rows(0, 1, 2))


def test_a_seed_that_is_run_again_replaces_its_row(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.add(KEY, rows(0, 1))
    store.add(KEY, rows(1, error_m=5.0))
    assert store.rows()["mean_error_m"].tolist() == [0.01, 6.0]


def test_a_failure_is_kept_until_the_cell_is_finished(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.fail(KEY, "no such camera", {"sequence": "S01", "method": "ours"})
    assert store.error_of(KEY) == "no such camera"
    assert store.status() == {
        "finished": 0,
        "failed": 1,
        "claimed": 0,
        "errors": ["S01 ours: no such camera"],
    }
    store.add(KEY, rows(0))
    assert store.error_of(KEY) is None
    assert store.status()["finished"] == 1
    assert store.status()["failed"] == 0


def test_one_runner_alone_has_a_cell(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with store.claim(KEY) as first:
        assert first
        assert store.is_claimed(KEY)
        with store.claim(KEY) as second:
            assert not second
        assert store.is_claimed(KEY)
    assert not store.is_claimed(KEY)
    with store.claim(KEY) as third:
        assert third


def test_a_claim_is_given_up_when_the_work_fails(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="work"), Store(tmp_path).claim(KEY):
        raise ValueError("work")
    assert not claim_of(Store(tmp_path)).exists()


def test_the_claim_of_a_killed_runner_lapses(tmp_path: Path) -> None:
    code = "import sys, time; from pathlib import Path; from psotrack.sweep.store import Store\n"
    code += f"with Store(Path(sys.argv[1])).claim('{KEY}'):\n    time.sleep(600)"
    runner = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)])
    store = Store(tmp_path)
    until = time.monotonic() + 60
    while not claim_of(store).exists():
        assert time.monotonic() < until, "the runner has claimed nothing"
        time.sleep(0.05)
    runner.kill()
    runner.wait()
    with store.claim(KEY) as at_once:
        assert not at_once
    # As if it had been a while.
    past = time.time() - STALE_S - 1
    os.utime(claim_of(store), (past, past))
    with store.claim(KEY) as later:
        assert later
        assert json.loads(claim_of(store).read_text())["process"] == os.getpid()


def test_no_results_are_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected results of a sweep, found none"):
        Store(tmp_path).status()
    with pytest.raises(InputError, match="no finished cell"):
        Store(tmp_path).rows()
