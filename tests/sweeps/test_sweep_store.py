"""The folder of a sweep's results: whole cells or none, one runner per cell, no run twice."""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest
from helpers import assert_refused
from hypothesis import given
from hypothesis import strategies as st
from small_sweeps import wait_until

from psotrack.errors import InputError
from psotrack.sweeps import Store

KEY, OTHER = "0" * 40, "1" * 40
#: A run.
RUN = {"grid": {"settings": {}, "methods": {}, "axes": {}}}
#: Reads a cell, locks it, prints how many threads the reading started, and waits until its standard input is closed.
HOLDER = """
import os, sys
import pandas, pyarrow.parquet
from psotrack.sweeps import Store
store, before = Store(sys.argv[1]), len(os.listdir("/proc/self/task"))
assert store.finished_seeds(sys.argv[2]) == {0, 2}
started = len(os.listdir("/proc/self/task")) - before
with store.lock(sys.argv[2]):
    print("locked,", started, "threads", flush=True)
    sys.stdin.read()
"""


def rows(*seeds, error_m=0.01):
    return pd.DataFrame({"seed": list(seeds), "mean_error_m": [error_m + seed for seed in seeds]})


def cell_path(store):
    return store.folder / "cells" / f"{KEY}.parquet"


def lock_path(store):
    return store.folder / "cells" / f".{KEY}.lock"


def is_free(store):
    """Whether another runner gets the lock of the cell."""
    with store.lock(KEY) as locked:
        return locked


@pytest.fixture
def store(tmp_path):
    return Store(tmp_path)


def test_rows_of_more_seeds_are_added_and_a_seed_that_is_run_again_replaces_its_row(store):
    assert store.finished_seeds(KEY) == set()
    store.add(KEY, rows(2, 0))
    store.add(KEY, rows(1))
    assert store.finished_seeds(KEY) == {0, 1, 2}
    pd.testing.assert_frame_equal(store.rows(), rows(0, 1, 2))
    store.add(KEY, rows(1, error_m=5.0))
    assert store.rows()["mean_error_m"].tolist() == [0.01, 6.0, 2.01]
    # Rows of some cells and seeds.
    store.add(OTHER, rows(0, error_m=5.0))
    assert store.rows({KEY: range(1, 3)})["seed"].tolist() == [1, 2]
    assert store.rows({OTHER: [0], KEY: [0], "2" * 40: [0]})["mean_error_m"].tolist() == [5.0, 0.01]


def test_only_the_input_that_was_used_last_counts(store):
    """Rows of an older tracker, or of another recording, stay in the folder and are not mixed with the others."""
    for age_s, key, error_m in ((0, "a-new", 2.0), (1, "a-old", 1.0), (2, "b-old", 3.0)):
        store.add(key, rows(0, error_m=error_m))
        used_s = 1000 - age_s
        os.utime(store.folder / "cells" / f"{key}.parquet", (used_s, used_s))
    assert store.rows()["mean_error_m"].tolist() == [2.0, 3.0]
    assert store.status()["finished"] == 2
    # The older tracker is used again.
    store.use("a-old")
    assert store.rows()["mean_error_m"].tolist() == [1.0, 3.0]
    assert store.rows({"a-new": [0]})["mean_error_m"].tolist() == [2.0]


def test_the_folder_is_a_parquet_data_set_of_the_rows(store):
    """Also with a failure, grids that were run, a locked cell and a half-written file in the folder."""
    assert_refused(store.status, "expected results of a sweep, found none", unchanged=store.folder)
    assert_refused(store.rows, "no finished cell", unchanged=store.folder)
    store.add(KEY, rows(0, 1))
    store.add(OTHER, rows(2))
    store.add_failure("2" * 40, "no such camera", {"sequence": "S01", "method": "ours"})
    for run in (RUN, RUN, RUN | {"commit": "1"}):
        store.add_run(run)
    # Each grid and version is noted once.
    noted = [json.loads(path.read_text()) for path in (store.folder / "_runs").iterdir()]
    assert sorted(noted, key=len) == [RUN, RUN | {"commit": "1"}]
    # A runner that is killed while it writes leaves a temporary file.
    left = store.folder / "cells" / f".{KEY}.0a1b2c3d.partial.parquet"
    left.write_bytes(b"PAR1")
    with store.lock("3" * 40):
        pd.testing.assert_frame_equal(pd.read_parquet(store.folder), store.rows())
    found = {"finished": 2, "failed": 1, "claimed": 0, "errors": ["S01 ours: no such camera"], "at_work": []}
    assert store.status() == found
    for _ in range(2):
        store.remove_failure("2" * 40)
        assert store.status()["failed"] == 0
    store.tidy()
    assert left.exists(), "another process may be writing the file"
    os.utime(left, (0, 0))
    store.tidy()
    assert not left.exists()


# --- locks


def test_one_runner_at_a_time_locks_a_cell(store):
    with store.lock(KEY) as first:
        assert first
        for other in (store, Store(store.folder)):
            assert not is_free(other)
            assert other.status()["claimed"] == 1
            assert f"process {os.getpid()} on " in other.status()["at_work"][0]
    assert store.status()["claimed"] == 0
    with pytest.raises(ValueError, match="work"), store.lock(KEY):
        raise ValueError("work")
    assert list((store.folder / "cells").iterdir()) == [], "a lock is released when the work fails"
    assert is_free(store)


@pytest.mark.skipif(not Path("/proc/self/ns/pid").exists(), reason="process start times are read from /proc")
def test_the_lock_of_a_killed_process_of_this_machine_lapses_at_once_and_reading_starts_no_threads(store):
    """A thread of Arrow's that still had the content when a sweep ended aborted the sweep, once in fifty times."""
    store.add(KEY, rows(2, 0))
    command = [sys.executable, "-c", HOLDER, str(store.folder), KEY]
    # The process ends at the end of this block at the latest, because its standard input is closed.
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as runner:
        assert runner.stdout is not None
        assert runner.stdout.readline() == "locked, 0 threads\n"
        assert not is_free(store)
        runner.kill()
        runner.wait()
        assert Store(store.folder).status()["at_work"] == []
    assert is_free(store)


def test_a_lock_of_another_machine_lapses_when_it_is_not_touched(store, monkeypatch):
    """A process watches the file for the whole lease, because the clocks of two machines differ."""
    monkeypatch.setattr("psotrack.support.locks.LEASE_S", 1.0)
    monkeypatch.setattr("psotrack.support.locks.HEARTBEAT_S", 0.9)
    with store.lock(KEY):
        own = lock_path(store).read_text()
    # No process of this machine has this number.
    lock_path(store).write_text(re.sub("pid=.*", f"pid={2**30}", re.sub("host=.*", "host=node7", own)))
    assert "process 1073741824 on node7" in store.status()["at_work"][0]
    assert not is_free(store)
    os.utime(lock_path(store), (time.time() - 60,) * 2)
    assert store.status()["at_work"] == []
    assert not is_free(store)
    wait_until(lambda: is_free(store))


def test_an_empty_lock_lapses(store):
    """A machine that fails while it makes a lock leaves an empty file."""
    lock_path(store).parent.mkdir()
    lock_path(store).touch()
    assert store.status()["claimed"] == 1
    os.utime(lock_path(store), (time.time() - 60,) * 2)
    assert store.status()["claimed"] == 0
    assert is_free(store)


def test_a_holder_keeps_its_lock_and_leaves_that_of_its_successor(store, monkeypatch, caplog):
    """It loses the lock as after a machine was asleep, and logs it."""
    monkeypatch.setattr("psotrack.support.locks.HEARTBEAT_S", 0.01)
    with store.lock(KEY):
        os.utime(lock_path(store), (0, 0))
        wait_until(lambda: lock_path(store).stat().st_mtime > 0)
        successor = lock_path(store).with_name("successor")
        successor.write_text(lock_path(store).read_text().replace("host=", "host=node7."))
        content = successor.read_text()
        successor.replace(lock_path(store))
        wait_until(lambda: "has lost the lock" in caplog.text)
    assert lock_path(store).read_text() == content


# --- damage


@given(data=st.data())
def test_damage_is_an_error_that_names_the_file_and_never_another_result(tmp_path_factory, data):
    """One changed bit, or a file cut short: the same content as before, or an error of one line."""
    one_cell = Store(tmp_path_factory.mktemp("one_cell"))
    one_cell.add(KEY, rows(0, 1, 2))
    whole, file = one_cell.rows().to_csv(), cell_path(one_cell)
    content = file.read_bytes()
    damaged, place = bytearray(content), data.draw(st.integers(0, len(content) - 1))
    if data.draw(st.booleans()):
        del damaged[place:]
    else:
        damaged[place] ^= 1 << data.draw(st.integers(0, 7))
    try:
        file.write_bytes(damaged)
        found = one_cell.rows().to_csv()
    except InputError as error:
        found = f"{error}"
    finally:
        file.write_bytes(content)
    # The same rows where the bit belongs to the name of the digest.
    error = f"{re.escape(str(file))}: expected .*; run the same `psotrack sweep` again"
    assert found == whole or re.match(error, found)


def test_a_damaged_cell_is_run_again(store, caplog):
    store.add(KEY, rows(0, 1))
    content = bytearray(cell_path(store).read_bytes())
    content[len(content) // 3] ^= 1
    cell_path(store).write_bytes(content)
    assert store.finished_seeds(KEY) == set()
    assert f"{cell_path(store)}: damaged rows of a cell" in caplog.text
    store.add(KEY, rows(0, 1))
    pd.testing.assert_frame_equal(store.rows(), rows(0, 1))
