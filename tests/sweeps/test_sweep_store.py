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
from hypothesis import given, settings
from hypothesis import strategies as st

from psotrack.errors import InputError
from psotrack.sweeps import Store, locks

KEY = "0" * 40
#: A run.
RUN = {"grid": {"settings": {}, "methods": {}, "axes": {}}}


@pytest.fixture
def short_leases(monkeypatch: pytest.MonkeyPatch) -> None:
    """Locks that lapse after half a second, and whose holders never touch them."""
    monkeypatch.setattr(locks, "LEASE_S", 0.5)
    monkeypatch.setattr(locks, "HEARTBEAT_S", 0.49)


def rows(*seeds: int, error_m: float = 0.01) -> pd.DataFrame:
    return pd.DataFrame({"seed": list(seeds), "mean_error_m": [error_m + seed for seed in seeds]})


def lock_path(store: Store) -> Path:
    return store.folder / "cells" / f".{KEY}.lock"


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="the threads of a process are listed there")
def test_reading_starts_no_threads(tmp_path: Path) -> None:
    """A thread of Arrow's that still had the content when a sweep ended aborted the sweep, once in fifty times."""
    Store(tmp_path).add(KEY, rows(2, 0))
    program = """
import os, sys
import pandas, pyarrow.parquet
from psotrack.sweeps import Store
store, before = Store(sys.argv[1]), len(os.listdir("/proc/self/task"))
assert store.finished_seeds(sys.argv[2]) == {0, 2}
print(len(os.listdir("/proc/self/task")) - before)
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path), KEY], capture_output=True, text=True, check=True
    )
    assert done.stdout == "0\n"


def test_rows_of_more_seeds_are_added(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.finished_seeds(KEY) == set()
    store.add(KEY, rows(2, 0))
    store.add(KEY, rows(1))
    assert store.finished_seeds(KEY) == {0, 1, 2}
    pd.testing.assert_frame_equal(store.rows(), rows(0, 1, 2))


def test_a_seed_that_is_run_again_replaces_its_row(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.add(KEY, rows(0, 1))
    store.add(KEY, rows(1, error_m=5.0))
    assert store.rows()["mean_error_m"].tolist() == [0.01, 6.0]


def test_only_the_input_that_was_used_last_counts(tmp_path: Path) -> None:
    """Rows of an older tracker, or of another recording, stay in the folder and are not mixed with the others."""
    store = Store(tmp_path)
    for age, (key, error_m) in enumerate((("a-new", 2.0), ("a-old", 1.0), ("b-old", 3.0))):
        store.add(key, rows(0, error_m=error_m))
        os.utime(tmp_path / "cells" / f"{key}.parquet", (1000 - age, 1000 - age))
    assert store.rows()["mean_error_m"].tolist() == [2.0, 3.0]
    assert store.status()["finished"] == 2
    # The older tracker is used again.
    store.use("a-old")
    assert store.rows()["mean_error_m"].tolist() == [1.0, 3.0]
    assert store.rows({"a-new": [0]})["mean_error_m"].tolist() == [2.0]


def test_cells_are_sorted_by_their_settings(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for key, particles in (("c", 20), ("a", 100), ("b", 3)):
        store.add(key, rows(0).assign(sequence="S01", **{"settings.swarm.particles": particles}))
    assert store.rows()["settings.swarm.particles"].tolist() == [3, 20, 100]


def test_rows_of_some_cells_and_seeds(tmp_path: Path) -> None:
    store, other = Store(tmp_path), "1" * 40
    store.add(KEY, rows(0, 1, 2))
    store.add(other, rows(0, error_m=5.0))
    pd.testing.assert_frame_equal(store.rows({KEY: range(1, 3)}), rows(1, 2))
    assert store.rows({other: [0], KEY: [0], "2" * 40: [0]})["mean_error_m"].tolist() == [5.0, 0.01]


def test_a_half_written_file_is_no_result(tmp_path: Path) -> None:
    """A runner that is killed while it writes leaves a temporary file."""
    store = Store(tmp_path)
    store.add(KEY, rows(0))
    left = tmp_path / "cells" / f".{KEY}.0a1b2c3d.partial.parquet"
    left.write_bytes(b"PAR1")
    assert len(store.rows()) == 1
    assert store.status()["finished"] == 1
    store.tidy()
    assert left.exists(), "another process may be writing the file"
    os.utime(left, (0, 0))
    store.tidy()
    assert not left.exists()


def test_a_failure_is_stored_until_it_is_removed(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.add_failure(KEY, "no such camera", {"sequence": "S01", "method": "ours"})
    assert store.status() == {
        "finished": 0,
        "failed": 1,
        "claimed": 0,
        "errors": ["S01 ours: no such camera"],
        "at_work": [],
    }
    store.remove_failure(KEY)
    store.remove_failure(KEY)
    assert store.status()["failed"] == 0


def test_the_folder_is_a_parquet_data_set_of_the_rows(tmp_path: Path) -> None:
    """Also with failures, grids that were run and a locked cell in the folder."""
    store = Store(str(tmp_path))
    store.add(KEY, rows(0, 1))
    store.add("1" * 40, rows(2))
    store.add_failure("2" * 40, "no such camera", {"sequence": "S01", "method": "ours"})
    store.add_run(RUN)
    with store.lock("3" * 40):
        pd.testing.assert_frame_equal(pd.read_parquet(tmp_path), store.rows())


def test_one_runner_at_a_time_locks_a_cell(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with store.lock(KEY) as first:
        assert first
        for other in (store, Store(tmp_path)):
            with other.lock(KEY) as second:
                assert not second
        for reader in (store, Store(tmp_path)):
            status = reader.status()
            assert status["claimed"] == 1
            assert f"process {os.getpid()} on " in status["at_work"][0]
    assert store.status()["claimed"] == 0
    with store.lock(KEY) as third:
        assert third


def test_a_lock_is_released_when_the_work_fails(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="work"), Store(tmp_path).lock(KEY):
        raise ValueError("work")
    assert list((tmp_path / "cells").iterdir()) == []


@pytest.mark.skipif(not Path("/proc/self/ns/pid").exists(), reason="process start times are read from /proc")
def test_the_lock_of_a_killed_process_of_this_machine_lapses_at_once(tmp_path: Path) -> None:
    code = "import sys; from pathlib import Path; from psotrack.sweeps import Store\n"
    code += "with Store(Path(sys.argv[1])).lock(sys.argv[2]):\n"
    code += "    print('locked', flush=True)\n    sys.stdin.read()"
    store = Store(tmp_path)
    command = [sys.executable, "-c", code, str(tmp_path), KEY]
    # The process ends at the end of this block at the latest, because its standard input is closed.
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as runner:
        assert runner.stdout is not None
        assert runner.stdout.readline() == "locked\n"
        with store.lock(KEY) as while_it_lives:
            assert not while_it_lives
        runner.kill()
        runner.wait()
        assert Store(tmp_path).status()["at_work"] == []
    with store.lock(KEY) as after:
        assert after


def test_a_lock_of_another_machine_lapses_when_it_is_not_touched(tmp_path: Path, short_leases: None) -> None:
    store, path = Store(tmp_path), tmp_path / "cells" / f".{KEY}.lock"
    with store.lock(KEY):
        own = path.read_text()
    # No process of this machine has this number.
    path.write_text(re.sub("pid=.*", f"pid={2**30}", re.sub("host=.*", "host=node7", own)))
    assert "process 1073741824 on node7" in store.status()["at_work"][0]
    with store.lock(KEY) as early:
        assert not early
    os.utime(path)
    with store.lock(KEY) as touched:
        assert not touched
    time.sleep(0.6)
    assert store.status()["at_work"] == []
    with store.lock(KEY) as late:
        assert late


def test_an_empty_lock_lapses(tmp_path: Path) -> None:
    """A machine that fails while it makes a lock leaves an empty file."""
    store = Store(tmp_path)
    path = lock_path(store)
    path.parent.mkdir()
    path.touch()
    assert store.status()["claimed"] == 1
    os.utime(path, (time.time() - 2 * locks.LEASE_S,) * 2)
    assert store.status()["claimed"] == 0
    with store.lock(KEY) as locked:
        assert locked


def test_a_runner_that_lost_its_lock_leaves_its_successors_lock(
    tmp_path: Path, short_leases: None, caplog: pytest.LogCaptureFixture
) -> None:
    """As after a machine was asleep; the first runner logs that it has lost the lock."""
    store = Store(tmp_path)
    with store.lock(KEY):
        successor = lock_path(store).read_text().replace("host=", "host=node7.")
        lock_path(store).unlink()
        lock_path(store).write_text(successor)
        until = time.monotonic() + 300
        while not caplog.records:
            assert time.monotonic() < until
            time.sleep(0.01)
    assert "has lost the lock" in caplog.text
    assert lock_path(store).read_text() == successor


def test_a_holder_keeps_its_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locks, "HEARTBEAT_S", 0.01)
    store = Store(tmp_path)
    with store.lock(KEY):
        os.utime(lock_path(store), (0, 0))
        until = time.monotonic() + 300
        while lock_path(store).stat().st_mtime == 0:
            assert time.monotonic() < until
            time.sleep(0.01)


def test_each_grid_and_version_is_noted_once(tmp_path: Path) -> None:
    store = Store(tmp_path)
    for run in (RUN, RUN, RUN | {"commit": "1"}):
        store.add_run(run)
    noted = [json.loads(path.read_text()) for path in (tmp_path / "_runs").iterdir()]
    assert sorted(noted, key=len) == [RUN, RUN | {"commit": "1"}]


def test_missing_results_are_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected results of a sweep, found none"):
        Store(tmp_path).status()
    with pytest.raises(InputError, match="no finished cell"):
        Store(tmp_path).rows()


@pytest.fixture(scope="module")
def one_cell(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A folder with a finished cell."""
    store = Store(tmp_path_factory.mktemp("one_cell"))
    store.add(KEY, rows(0, 1, 2))
    return store


@settings(max_examples=60)
@given(data=st.data())
def test_damage_is_an_error_that_names_the_file_and_never_another_result(
    one_cell: Store, data: st.DataObject
) -> None:
    """One changed bit, or a file cut short: the same content as before, or an error of one line."""
    whole, file = one_cell.rows().to_csv(), one_cell.folder / "cells" / f"{KEY}.parquet"
    content = file.read_bytes()
    damaged, cut = bytearray(content), data.draw(st.booleans())
    place = data.draw(st.integers(0, len(content) - 1))
    if cut:
        del damaged[place:]
    else:
        damaged[place] ^= 1 << data.draw(st.integers(0, 7))
    found: object = None
    try:
        file.write_bytes(damaged)
        found = one_cell.rows().to_csv()
    except InputError as error:
        found = error
    finally:
        file.write_bytes(content)
    if isinstance(found, InputError):
        assert f"{found}".startswith(f"{file}: expected ")
        assert "run the same `psotrack sweep` again" in f"{found}"
    else:
        # A bit of the digest's own key.
        assert found == whole


def test_a_damaged_cell_is_run_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store, path = Store(tmp_path), tmp_path / "cells" / f"{KEY}.parquet"
    store.add(KEY, rows(0, 1))
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="run the same `psotrack sweep` again"):
        store.rows()
    assert store.finished_seeds(KEY) == set()
    assert f"{path}: damaged rows of a cell" in caplog.text
    store.add(KEY, rows(0, 1))
    pd.testing.assert_frame_equal(store.rows(), rows(0, 1))
