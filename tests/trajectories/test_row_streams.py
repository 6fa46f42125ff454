"""Tables that grow: a full disk, an error or a killed process costs no row that was written."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
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


def test_a_table_that_grew_is_the_one_that_is_written_at_once(tmp_path: Path) -> None:
    flight, path = _flight(), tmp_path / "rows.csv"
    write_trajectories(tmp_path / "once.csv", flight)
    with RowStream(path) as rows:
        for number, frame in enumerate(_frames(flight), 1):
            rows.write(frame)
            # What was written can be read at once.
            assert read_trajectories(path).num_frames == number
    assert path.read_bytes() == (tmp_path / "once.csv").read_bytes()


def test_a_table_that_exists_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").write_text("mine")
    with pytest.raises(OutputError, match=r"rows\.csv"):
        RowStream(tmp_path / "rows.csv")
    with pytest.raises(InputError, match=r"ends in \.csv, for rows .* `psotrack export`"):
        RowStream(tmp_path / "rows.parquet")
    assert (tmp_path / "rows.csv").read_text() == "mine"


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


def test_a_full_disk_costs_only_what_did_not_fit(tmp_path: Path) -> None:
    """A limit on the size of files stands for a full disk: both cut off a row in its middle."""
    path = tmp_path / "rows.csv"
    limited = "resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))"
    done = _write_in_a_process(path, limited, "pass")
    assert done.returncode == 1
    expected = "expected to write rows, found file too large; the rows that were written before stay in"
    assert done.stderr == f"{path}: {expected} rows.csv\n"
    assert list(tmp_path.iterdir()) == [path]
    frame = read_trajectories(path).frame
    assert frame.tolist() == list(range(len(frame)))
    # The next row would not have fitted: rows take at most 60 bytes here.
    assert 3940 < path.stat().st_size <= 4000


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full, which no disk is fuller than")
def test_a_disk_that_takes_nothing_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").symlink_to("/dev/full")
    with (
        pytest.raises(OutputError, match=r"rows.csv: expected to write rows, found no space left on device$"),
        RowStream(tmp_path / "rows.csv", force=True) as rows,
    ):
        rows.write(_frames(_flight())[0])


def test_an_older_file_stays_until_the_first_row(tmp_path: Path) -> None:
    path, flight = tmp_path / "rows.csv", _flight()
    record = tmp_path / "rows.json"
    record.write_text("about the older rows")
    write_trajectories(path, flight)
    older = path.read_bytes()
    with pytest.raises(KeyboardInterrupt), RowStream(path, force=True, record=record):
        raise KeyboardInterrupt
    assert path.read_bytes() == older
    assert {each.name for each in tmp_path.iterdir()} == {"rows.csv", "rows.json"}
    with RowStream(path, force=True, record=record) as rows:
        for frame in _frames(flight)[:2]:
            rows.write(frame)
    assert read_trajectories(path).num_frames == 2
    assert list(tmp_path.iterdir()) == [path]


def test_a_killed_process_leaves_all_its_rows(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    done = _write_in_a_process(path, "", "if index == 99: os.kill(os.getpid(), signal.SIGKILL)")
    assert done.returncode == -signal.SIGKILL
    assert read_trajectories(path).frame.tolist() == list(range(100))
