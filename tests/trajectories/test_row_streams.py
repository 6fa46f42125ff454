"""Tables that grow: a full disk, an error or a killed process costs no row that was written."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import files_up_to
from worlds import make_tracks

from psotrack.errors import InputError, OutputError
from psotrack.trajectories import RowStream, read_trajectories, write_trajectories

#: Names that CSV must quote.
FLIGHT = replace(make_tracks(), drones=('a "b", c', "NA"))
FRAMES = [FLIGHT.at_frames(np.array([frame])) for frame in FLIGHT.frame]


def test_a_table_that_grew_is_the_one_that_is_written_at_once(tmp_path):
    path = tmp_path / "rows.csv"
    write_trajectories(tmp_path / "once.csv", FLIGHT)
    with RowStream(path) as rows:
        for number, frame in enumerate(FRAMES, 1):
            rows.write(frame)
            # What was written can be read at once, so that a killed process leaves all its rows.
            assert read_trajectories(path).num_frames == number
    assert path.read_bytes() == (tmp_path / "once.csv").read_bytes()


def test_a_table_that_exists_is_not_replaced(tmp_path):
    (tmp_path / "rows.csv").write_text("mine")
    with pytest.raises(OutputError, match=r"rows\.csv"):
        RowStream(tmp_path / "rows.csv")
    with pytest.raises(InputError, match=r"ends in \.csv, for rows .* `psotrack export`"):
        RowStream(tmp_path / "rows.parquet")
    assert (tmp_path / "rows.csv").read_text() == "mine"


def test_a_full_disk_costs_only_what_did_not_fit(tmp_path):
    """A limit on the size of files stands for a full disk: both cut off a row in its middle."""
    path, written = tmp_path / "rows.csv", []

    def write(num_bytes):
        with files_up_to(num_bytes), RowStream(path, force=True) as rows:
            for frame in FRAMES:
                rows.write(frame)
                written.append(frame)

    kept = "; the rows that were written before stay in rows.csv"
    for num_bytes, remedy in ((50, ""), (2000, kept)):
        with pytest.raises(OutputError) as error:
            write(num_bytes)
        assert str(error.value) == f"{path}: expected to write rows, found file too large{remedy}"
    assert list(tmp_path.iterdir()) == [path]
    assert 0 < read_trajectories(path).num_frames == len(written) < len(FRAMES)


def test_an_older_file_stays_until_the_first_row(tmp_path):
    path = tmp_path / "rows.csv"
    record = tmp_path / "rows.json"
    record.write_text("about the older rows")
    write_trajectories(path, FLIGHT)
    older = path.read_bytes()
    with pytest.raises(KeyboardInterrupt), RowStream(path, force=True, record=record):
        raise KeyboardInterrupt
    assert path.read_bytes() == older
    assert {each.name for each in tmp_path.iterdir()} == {"rows.csv", "rows.json"}
    with RowStream(path, force=True, record=record) as rows:
        for frame in FRAMES[:2]:
            rows.write(frame)
    assert read_trajectories(path).num_frames == 2
    assert list(tmp_path.iterdir()) == [path]
