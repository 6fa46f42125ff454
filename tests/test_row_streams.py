"""Tables that grow: a full disk, an error or a killed process costs no row that was written."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from psotrack.errors import InputError, OutputError
from psotrack.trajectories import RowStream, Trajectories, read_trajectories, write_trajectories

NUM_FRAMES = 40


def _flight() -> Trajectories:
    """Names that CSV must quote, unknown positions and rates with many digits."""
    rng = np.random.default_rng(3)
    position_m = rng.normal(size=(NUM_FRAMES, 3, 3)).astype(np.float32)
    position_m[5:9, 1] = np.nan
    return Trajectories(
        frame=np.arange(NUM_FRAMES),
        time_s=np.arange(NUM_FRAMES) / 29.97,
        drones=("1", 'a "b", c', "NA"),
        position_m=position_m,
        velocity_m_s=1e-9 * position_m,
        num_cameras=rng.integers(-1, 5, (NUM_FRAMES, 3)),
        status=rng.integers(0, 3, (NUM_FRAMES, 3)),
        covariance_m2=np.broadcast_to(1e-7 * np.eye(3, dtype=np.float32), (NUM_FRAMES, 3, 3, 3)),
    )


def _frames(flight: Trajectories) -> list[Trajectories]:
    parts = {name: value for name, value in vars(flight).items() if isinstance(value, np.ndarray)}
    return [
        Trajectories(drones=flight.drones, **{name: value[i : i + 1] for name, value in parts.items()})
        for i in range(NUM_FRAMES)
    ]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_table_that_grew_is_the_one_that_is_written_at_once(tmp_path: Path, suffix: str) -> None:
    flight, path = _flight(), tmp_path / f"rows{suffix}"
    write_trajectories(tmp_path / f"once{suffix}", flight)
    with RowStream(path) as rows:
        for number, frame in enumerate(_frames(flight), 1):
            rows.write(frame)
            # What was written to a CSV file can be read at once.
            assert path.exists() == (suffix == ".csv")
            assert suffix == ".parquet" or read_trajectories(path).num_frames == number
    if suffix == ".csv":
        assert path.read_bytes() == (tmp_path / "once.csv").read_bytes()
    else:
        once, grown = (pq.read_table(tmp_path / f"{name}.parquet") for name in ("once", "rows"))
        assert grown.schema.equals(once.schema, check_metadata=True)
        assert grown.equals(once)


def test_a_table_that_exists_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").write_text("mine")
    with pytest.raises(OutputError, match=r"rows\.csv"):
        RowStream(tmp_path / "rows.csv")
    with pytest.raises(InputError, match=r"\.csv or \.parquet"):
        RowStream(tmp_path / "rows.txt")
    assert (tmp_path / "rows.csv").read_text() == "mine"


def test_an_error_leaves_the_rows_and_no_parquet_table(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    frames = _frames(_flight())

    def fail() -> None:
        with RowStream(tmp_path / "rows.parquet") as rows:
            for frame in frames[:7]:
                rows.write(frame)
            raise RuntimeError("the session has failed")

    with caplog.at_level(logging.WARNING, "psotrack"), pytest.raises(RuntimeError, match="the session"):
        fail()
    kept = tmp_path / "rows.rows.csv"
    assert [each.name for each in tmp_path.iterdir()] == [kept.name]
    assert caplog.messages == [f"{tmp_path / 'rows.parquet'} is not written; the rows so far are in {kept}"]
    assert read_trajectories(kept).frame.tolist() == list(range(7))
    # The next session does not replace them unasked.
    with pytest.raises(OutputError, match=r"rows\.rows\.csv: .* found an existing file; pass --force"):
        RowStream(tmp_path / "rows.parquet")
    with RowStream(tmp_path / "rows.parquet", force=True) as rows:
        rows.write(frames[0])
    assert [each.name for each in tmp_path.iterdir()] == ["rows.parquet"]


def test_without_rows_there_is_no_parquet_table(tmp_path: Path) -> None:
    with RowStream(tmp_path / "rows.parquet"):
        pass
    assert not list(tmp_path.iterdir())


def _write_in_a_process(path: Path, before: str, after: str) -> subprocess.CompletedProcess[str]:
    """Write frames with a drone until something ends the process; `before` and `after` run around each."""
    script = f"""
        import os, resource, signal, sys
        import numpy as np
        from psotrack.errors import PsotrackError
        from psotrack.trajectories import RowStream, Trajectories
        {before}
        try:
            with RowStream(sys.argv[1]) as rows:
                for index in range(1000):
                    place = np.full((1, 1, 3), index / 3, np.float32)
                    rows.write(Trajectories(np.array([index]), np.array([index / 25]), ("1",), place))
                    {after}
        except PsotrackError as error:
            sys.exit(str(error))
    """
    return subprocess.run(
        [sys.executable, "-B", "-c", textwrap.dedent(script), f"{path}"],
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(("name", "kept"), [("rows.csv", "rows.csv"), ("rows.parquet", "rows.rows.csv")])
def test_a_full_disk_costs_only_what_did_not_fit(tmp_path: Path, name: str, kept: str) -> None:
    """A limit on the size of files stands for a full disk: both cut off a row in its middle."""
    limited = "resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))"
    done = _write_in_a_process(tmp_path / name, limited, "pass")
    assert done.returncode == 1
    *more, line = done.stderr.splitlines()
    expected = "expected to write rows, found file too large; the rows that were written before stay in"
    assert line == f"{tmp_path / name}: {expected} {kept}"
    assert more == (
        []
        if name == kept
        else [f"{tmp_path / name} is not written; the rows so far are in {tmp_path / kept}"]
    )
    assert [each.name for each in tmp_path.iterdir()] == [kept]
    frame = read_trajectories(tmp_path / kept).frame
    assert frame.tolist() == list(range(len(frame)))
    # The next row would not have fitted: rows take at most 60 bytes here.
    assert 3940 < (tmp_path / kept).stat().st_size <= 4000


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full, which no disk is fuller than")
def test_a_disk_that_takes_nothing_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").symlink_to("/dev/full")
    with (
        pytest.raises(OutputError, match=r"rows.csv: expected to write rows, found no space left on device$"),
        RowStream(tmp_path / "rows.csv", force=True) as rows,
    ):
        rows.write(_frames(_flight())[0])


@pytest.mark.parametrize("name", ["rows.csv", "rows.parquet"])
def test_an_older_file_stays_until_the_first_row(tmp_path: Path, name: str) -> None:
    path, flight = tmp_path / name, _flight()
    record = tmp_path / "rows.json"
    record.write_text("about the older rows")
    write_trajectories(path, flight)
    older = path.read_bytes()
    with pytest.raises(KeyboardInterrupt), RowStream(path, force=True, record=record):
        raise KeyboardInterrupt
    assert path.read_bytes() == older
    assert {each.name for each in tmp_path.iterdir()} == {name, "rows.json"}
    with RowStream(path, force=True, record=record) as rows:
        for frame in _frames(flight)[:2]:
            rows.write(frame)
    assert read_trajectories(path).num_frames == 2
    assert [each.name for each in tmp_path.iterdir()] == [name]


def test_a_session_without_rows_leaves_no_older_rows(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").write_text("older")
    with RowStream(tmp_path / "rows.csv", force=True):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("name", "kept"), [("rows.csv", "rows.csv"), ("rows.parquet", "rows.rows.csv")])
def test_a_killed_process_leaves_all_its_rows(tmp_path: Path, name: str, kept: str) -> None:
    done = _write_in_a_process(tmp_path / name, "", "if index == 99: os.kill(os.getpid(), signal.SIGKILL)")
    assert done.returncode == -signal.SIGKILL
    assert read_trajectories(tmp_path / kept).frame.tolist() == list(range(100))
