"""The folder of a sweep's results: whole cells or none, one runner per cell, nothing run twice."""

import json
import os
import subprocess
import sys
import threading
import time
from dataclasses import asdict, replace
from pathlib import Path

import pandas as pd
import pytest

from psotrack.errors import InputError
from psotrack.sweep import Store, locks
from psotrack.sweep.locks import STALE_S, Owner, owner_of

KEY = "0" * 40


def rows(*seeds: int, error_m: float = 0.01) -> pd.DataFrame:
    return pd.DataFrame({"seed": list(seeds), "mean_error_m": [error_m + seed for seed in seeds]})


def add(store: Store, key: str, new: pd.DataFrame) -> None:
    """Rows, and two frames of errors for each."""
    frames = pd.concat([new.assign(frame=frame, error_m=new["mean_error_m"]) for frame in (0, 1)])
    store.add(key, new, frames[["seed", "frame", "error_m"]])


def claim_of(store: Store) -> Path:
    return store.folder / "cells" / f"{KEY}.claim"


def grown_old(path: Path) -> None:
    past = time.time() - 2 * STALE_S
    os.utime(path, (past, past))


def test_rows_of_more_seeds_are_added(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.seeds_of(KEY) == set()
    add(store, KEY, rows(2, 0))
    add(store, KEY, rows(1))
    assert store.seeds_of(KEY) == {0, 1, 2}
    pd.testing.assert_frame_equal(store.rows(), rows(0, 1, 2))
    assert store.errors(KEY, [0, 2])[["seed", "frame"]].to_numpy().tolist() == [
        [0, 0],
        [0, 1],
        [2, 0],
        [2, 1],
    ]


def test_a_seed_that_is_run_again_replaces_its_row(tmp_path: Path) -> None:
    store = Store(tmp_path)
    add(store, KEY, rows(0, 1))
    add(store, KEY, rows(1, error_m=5.0))
    assert store.rows()["mean_error_m"].tolist() == [0.01, 6.0]
    assert store.errors(KEY, range(2))["error_m"].tolist() == [0.01, 0.01, 6.0, 6.0]


def test_rows_of_some_cells_and_seeds(tmp_path: Path) -> None:
    store, other = Store(tmp_path), "1" * 40
    add(store, KEY, rows(0, 1, 2))
    add(store, other, rows(0, error_m=5.0))
    pd.testing.assert_frame_equal(store.rows({KEY: range(1, 3)}), rows(1, 2))
    assert store.rows({other: [0], KEY: [0], "2" * 40: [0]})["mean_error_m"].tolist() == [5.0, 0.01]


def test_what_is_half_written_is_no_result(tmp_path: Path) -> None:
    """A runner that is killed while it writes leaves a file beside the others."""
    store = Store(tmp_path)
    add(store, KEY, rows(0))
    left = tmp_path / "cells" / f".{KEY}.0a1b2c3d.partial.parquet"
    left.write_bytes(b"PAR1")
    assert len(store.rows()) == 1
    assert store.status()["finished"] == 1
    store.tidy()
    assert left.exists(), "somebody may be writing it"
    os.utime(left, (0, 0))
    store.tidy()
    assert not left.exists()


def test_a_failure_is_kept_until_it_is_forgiven(tmp_path: Path) -> None:
    store = Store(tmp_path)
    store.fail(KEY, "no such camera", {"sequence": "S01", "method": "ours"})
    assert store.error_of(KEY) == "no such camera"
    assert store.status() == {
        "finished": 0,
        "failed": 1,
        "claimed": 0,
        "errors": ["S01 ours: no such camera"],
        "at_work": [],
    }
    store.forgive(KEY)
    store.forgive(KEY)
    assert store.error_of(KEY) is None
    assert store.status()["failed"] == 0


def test_one_runner_alone_has_a_cell(tmp_path: Path) -> None:
    store = Store(tmp_path)
    with store.claim(KEY, "S01 ours") as first:
        assert first
        with store.claim(KEY) as second:
            assert not second
        status = store.status()
        assert status["claimed"] == 1
        assert f"process {os.getpid()} on " in status["at_work"][0]
        assert status["at_work"][0].endswith(": S01 ours")
    assert store.status()["claimed"] == 0
    with store.claim(KEY) as third:
        assert third


def test_a_claim_is_given_up_when_the_work_fails(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="work"), Store(tmp_path).claim(KEY):
        raise ValueError("work")
    assert not claim_of(Store(tmp_path)).exists()


@pytest.mark.skipif(not Path("/proc/self/ns/pid").exists(), reason="processes of this machine cannot be seen")
def test_the_claim_of_a_killed_process_of_this_machine_lapses_at_once(tmp_path: Path) -> None:
    code = "import sys; from pathlib import Path; from psotrack.sweep.locks import claimed\n"
    code += "with claimed(Path(sys.argv[1])):\n    print('claimed', flush=True)\n    sys.stdin.read()"
    store = Store(tmp_path)
    command = [sys.executable, "-c", code, str(claim_of(store))]
    # What it waits for comes with the end of the block at the latest, however that is reached.
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as runner:
        assert runner.stdout is not None
        assert runner.stdout.readline() == "claimed\n"
        with store.claim(KEY) as while_it_lives:
            assert not while_it_lives
        runner.kill()
        # Before its parent takes note of it, too: it is a zombie then.
        os.waitid(os.P_PID, runner.pid, os.WEXITED | os.WNOWAIT)
        assert owner_of(claim_of(store)) is None
    with store.claim(KEY) as after:
        assert after
        assert json.loads(claim_of(store).read_text())["process"] == os.getpid()


def planted(store: Store, **changed: object) -> Path:
    """A claim as this process would make it, but for what is changed."""
    path = claim_of(store)
    with locks.claimed(path):
        owner = Owner(**json.loads(path.read_text()))
    path.write_text(json.dumps(asdict(replace(owner, **changed))))
    return path


def test_a_number_that_another_process_has_now_is_not_its_owner(tmp_path: Path) -> None:
    assert owner_of(planted(Store(tmp_path))) is not None
    assert owner_of(planted(Store(tmp_path), started=1)) is None


def test_claims_of_other_machines_lapse_when_they_are_not_touched(tmp_path: Path) -> None:
    store = Store(tmp_path)
    # No process of this machine has this number; of another one may.
    path = planted(store, machine="another", host="node7", process=2**30)
    with store.claim(KEY) as early:
        assert not early
    assert "on node7" in store.status()["at_work"][0]
    grown_old(path)
    with store.claim(KEY) as late:
        assert late


def test_a_claim_that_was_cut_off_lapses(tmp_path: Path) -> None:
    path = claim_of(Store(tmp_path))
    path.parent.mkdir()
    path.write_text("")
    assert owner_of(path) is not None
    grown_old(path)
    assert owner_of(path) is None
    with Store(tmp_path).claim(KEY) as ours:
        assert ours


def test_of_many_who_see_that_a_claim_is_nobodys_one_has_it(tmp_path: Path) -> None:
    """Each holds what it got until all have tried; in the end one of them has it, not one that was replaced."""
    store, threads = Store(tmp_path), 8
    for _ in range(20):
        grown_old(planted(store, machine="another"))
        # One that fails leaves the others waiting: not for ever.
        begin, tried = (threading.Barrier(threads, timeout=300) for _ in range(2))
        got: list[bool] = []

        def compete(begin=begin, tried=tried, got=got) -> None:
            begin.wait()
            with store.claim(KEY) as ours:
                tried.wait()
                got.append(ours)

        competitors = [threading.Thread(target=compete) for _ in range(threads)]
        for competitor in competitors:
            competitor.start()
        for competitor in competitors:
            competitor.join()
        assert sum(got) == 1
        assert not claim_of(store).exists()


def test_who_lost_a_claim_does_not_remove_its_successors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after a machine was asleep: its owner, too, so it does not touch the claim meanwhile."""
    monkeypatch.setattr(locks, "HEARTBEAT_S", 3600.0)
    store = Store(tmp_path)
    with store.claim(KEY):
        grown_old(claim_of(store))
        with store.claim(KEY) as taken_over:
            assert taken_over
            successor = claim_of(store).read_text()
            claim_of(store).unlink()
            claim_of(store).write_text(successor.replace('"token": "', '"token": "another'))
        assert claim_of(store).exists()
    assert claim_of(store).exists()


def test_claims_are_kept_alive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locks, "HEARTBEAT_S", 0.01)
    with Store(tmp_path).claim(KEY):
        grown_old(claim_of(Store(tmp_path)))
        until = time.monotonic() + 300
        while owner_of(claim_of(Store(tmp_path))) is None:
            assert time.monotonic() < until
            time.sleep(0.01)


def test_the_manifest_is_changed_by_one_at_a_time(tmp_path: Path) -> None:
    store = Store(tmp_path)
    assert store.manifest() == {"runs": [], "inputs": {}}

    def count() -> None:
        for _ in range(5):
            store.change_manifest(lambda manifest: manifest["runs"].append(1))

    threads = [threading.Thread(target=count) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.manifest()["runs"] == [1] * 20


def test_no_results_are_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected results of a sweep, found none"):
        Store(tmp_path).status()
    with pytest.raises(InputError, match="no finished cell"):
        Store(tmp_path).rows()
    with pytest.raises(InputError, match="expected errors of a finished cell"):
        Store(tmp_path).errors(KEY, [0])
