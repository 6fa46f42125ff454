"""Error messages, atomic writing of files and folders, digests, and progress bars."""

import errno
import functools
import hashlib
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers import ring_rig
from test_camera_path import example_path

from psotrack.errors import (
    LONGEST_MESSAGE,
    InputError,
    OutputError,
    PsotrackError,
    SettingsError,
    check_positive,
    errors_name,
)
from psotrack.evaluation.plots import save_overview
from psotrack.geometry.rig_files import (
    read_cameras,
    read_lenses,
    read_rig,
    write_calibration,
    write_rig,
)
from psotrack.inside_out import write_camera_path
from psotrack.recordings import Detections, VideoWriter, join_videos, probe, read_detections, write_detections
from psotrack.recordings.exchange import export_tracks
from psotrack.recordings.mocap import Markers, read_c3d, write_c3d
from psotrack.support import (
    atomic_write,
    digest_file,
    digest_record,
    no_progress,
    progress_bar,
    refuse_to_overwrite,
)
from psotrack.trajectories import Trajectories, read_trajectories, write_trajectories
from psotrack.trajectories.tum import read_tum, write_tum


def test_a_message_has_four_parts():
    error = InputError(Path("a/b.csv"), expected="8 columns", found="7", remedy="export it again")
    assert str(error) == f"{Path('a/b.csv')}: expected 8 columns, found 7; export it again"
    assert (
        str(SettingsError("drones", expected="at least 1", found="0"))
        == "drones: expected at least 1, found 0"
    )


def test_a_message_is_one_short_line(tmp_path):
    """What cannot be printed is escaped, the longest part is cut, and a remedy that fits stays whole."""
    command = f"psotrack init {tmp_path}/videos"
    error = InputError(tmp_path / "a\nb.csv", expected="text", found="\x00\x1b[31m\n" * 100, remedy=command)
    message = str(error)
    assert message.startswith(f"{tmp_path}/a b.csv: expected text, found \\x00\\x1b[31m \\x00")
    assert message.endswith(f" ...; {command}")
    assert message.isprintable()
    assert len(message.replace(str(tmp_path), "")) == LONGEST_MESSAGE


def test_errors_of_a_file_name_it(tmp_path):
    with pytest.raises(SettingsError, match=r"^tracks\.csv, frame: expected this, found that$"):
        fail_within("tracks.csv", SettingsError("frame", expected="this", found="that"))
    with pytest.raises(InputError, match=r"^tracks\.csv: expected this, found that$"):
        fail_within("tracks.csv", InputError("tracks.csv", expected="this", found="that"))
    with pytest.raises(OutputError, match=r"^out: expected this, found that$"):
        fail_within("tracks.csv", OutputError("out", expected="this", found="that"))


def fail_within(path, error):
    with errors_name(path):
        raise error


@pytest.mark.parametrize("error_class", [InputError, SettingsError, OutputError])
def test_errors_can_be_pickled(error_class):
    error = error_class("here", expected="this", found="that", remedy="do so")
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is error_class
    assert str(copy) == str(error)
    assert isinstance(copy, PsotrackError)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_check_positive_refuses(value):
    with pytest.raises(SettingsError, match=r"^fps: expected a number above 0, found \S+; say it$"):
        check_positive("fps", value, "say it")


def test_check_positive_accepts():
    check_positive("fps", 1e-9)


def file_names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("suffix", [".csv", ".avi", ""])
def test_atomic_write(tmp_path, suffix):
    """The file appears under its name when it is complete.

    The temporary file keeps the suffix, because writers choose the file format by the suffix.
    """
    path = tmp_path / "new" / f"out{suffix}"
    with atomic_write(path) as temporary:
        assert temporary.suffix == suffix or not suffix
        assert temporary.parent == path.parent
        temporary.write_text("whole")
        assert not path.exists()
    assert path.read_text() == "whole"
    assert file_names(path.parent) == [path.name]


def fail_half_way(path, error):
    with atomic_write(path) as temporary:
        temporary.write_text("half")
        raise error


@pytest.mark.parametrize("error", [ValueError("no"), KeyboardInterrupt(), SystemExit(1)])
def test_an_old_file_survives_a_failure(tmp_path, error):
    path = tmp_path / "out.csv"
    path.write_text("before")
    with pytest.raises(type(error)):
        fail_half_way(path, error)
    assert path.read_text() == "before"
    assert file_names(tmp_path) == ["out.csv"]


def test_a_full_disk(tmp_path):
    path = tmp_path / "out.csv"
    path.write_text("before")
    message = r"out\.csv: expected a path that can be written, found No space left .* unchanged"
    with pytest.raises(OutputError, match=message) as error_info:
        fail_half_way(path, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    assert error_info.value.__cause__.errno == errno.ENOSPC
    assert path.read_text() == "before"
    assert file_names(tmp_path) == ["out.csv"]


def test_a_folder_that_cannot_be_created(tmp_path):
    """The parent of the folder is a file."""
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(OutputError, match="earlier results are unchanged"),
        atomic_write(tmp_path / "file" / "out"),
    ):
        raise AssertionError("never entered")


def test_nothing_written_is_an_error(tmp_path):
    path = tmp_path / "out.csv"
    path.write_text("before")
    with pytest.raises(OutputError, match="No such file"), atomic_write(path):
        pass
    assert path.read_text() == "before"


def test_a_folder_replaces_a_folder(tmp_path):
    path = tmp_path / "sequence"
    path.mkdir()
    (path / "old").write_text("old")
    with atomic_write(path) as temporary:
        temporary.mkdir()
        (temporary / "new").write_text("new")
        assert file_names(path) == ["old"]
    assert file_names(path) == ["new"]
    assert file_names(tmp_path) == ["sequence"]


def fail_half_way_in_a_folder(path):
    with atomic_write(path) as temporary:
        temporary.mkdir()
        (temporary / "new").write_text("half")
        raise KeyboardInterrupt


def test_a_failed_write_of_a_folder_leaves_the_old_folder(tmp_path):
    path = tmp_path / "sequence"
    path.mkdir()
    (path / "old").write_text("old")
    with pytest.raises(KeyboardInterrupt):
        fail_half_way_in_a_folder(path)
    assert file_names(path) == ["old"]
    assert file_names(tmp_path) == ["sequence"]


def test_a_block_that_writes_nothing_keeps_the_old_folder(tmp_path):
    path = tmp_path / "sequence"
    path.mkdir()
    (path / "old").write_text("old")
    with pytest.raises(OutputError), atomic_write(path):
        pass
    assert file_names(path) == ["old"]
    assert file_names(tmp_path) == ["sequence"]


def test_two_writers_at_once(tmp_path):
    """Two writers have different temporary files; the file of the last writer remains, complete."""
    path = tmp_path / "out.csv"
    with atomic_write(path) as first, atomic_write(path) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"
    assert file_names(tmp_path) == ["out.csv"]


def test_refuse_to_overwrite(tmp_path):
    path = tmp_path / "out.csv"
    refuse_to_overwrite(path, force=False)
    path.write_text("")
    refuse_to_overwrite(path, force=True)
    with pytest.raises(
        OutputError,
        match=r"out\.csv: expected a path that does not exist yet, found an existing file; pass --force",
    ):
        refuse_to_overwrite(path, force=False)


def flight():
    return Trajectories(np.arange(2), np.arange(2) / 25, ("dron1",), np.ones((2, 1, 3)))


#: Functions that write a file, by the name of the file.
WRITERS = {
    "rig.toml": lambda path, force: write_rig(path, ring_rig(2), force=force),
    "lenses.toml": lambda path, force: write_rig(path, ring_rig(2), force=force, placed=False),
    "tracks.csv": lambda path, force: write_trajectories(path, flight(), force=force),
    "tracks.parquet": lambda path, force: write_trajectories(path, flight(), force=force),
    "dron1.tum": lambda path, force: write_tum(path.parent, flight(), force=force),
    "tracks.json": lambda path, force: export_tracks(flight(), "json", path, force=force),
    "picture.png": lambda path, force: save_overview(path, flight(), flight(), force=force),
    "path.csv": lambda path, force: write_camera_path(path, example_path(), "dron1", force=force),
}


@pytest.mark.parametrize("name", WRITERS)
def test_an_existing_file_is_replaced_only_by_force(tmp_path, name):
    path = tmp_path / name
    path.write_text("precious")
    with pytest.raises(OutputError, match=rf"{name}: expected a path .* pass --force to replace it"):
        WRITERS[name](path, False)
    assert path.read_text() == "precious"
    WRITERS[name](path, True)
    assert path.read_bytes() != b"precious"
    assert file_names(tmp_path) == [name]


@pytest.mark.parametrize("report", [no_progress, progress_bar])
def test_progress_is_quiet_where_there_is_no_terminal(report, capfd):
    with report("track", 10) as advance:
        advance(4)
        advance(6)
    out, err = capfd.readouterr()
    assert out == ""
    assert err.strip() == ""


def test_a_file_never_replaces_a_folder(tmp_path):
    """Otherwise a user who passes --force and the path of a folder would lose the folder's content."""
    folder = tmp_path / "frames.csv"
    folder.mkdir()
    (folder / "mine.png").write_bytes(b"mine")
    with (
        pytest.raises(OutputError, match=r"expected the path of a file, found a folder"),
        atomic_write(folder) as temporary,
    ):
        temporary.write_text("a,b")
    assert [path.name for path in tmp_path.rglob("*")] == ["frames.csv", "mine.png"]


@pytest.mark.parametrize(
    ("algorithm", "new"),
    [
        ("blake2b", hashlib.blake2b),
        ("blake2b-160", functools.partial(hashlib.blake2b, digest_size=20)),
        ("sha256", hashlib.sha256),
    ],
)
def test_digest_file(tmp_path, algorithm, new):
    path = tmp_path / "a"
    path.write_bytes(bytes(range(256)) * 4096)
    assert digest_file(path, algorithm=algorithm) == new(path.read_bytes()).hexdigest()
    with pytest.raises(InputError, match=r"b: expected a readable video, found No such file"):
        digest_file(tmp_path / "b", expected="a readable video")


def test_digest_record_ignores_the_order_of_the_keys():
    assert digest_record({"a": 1, "b": [2.5]}) == digest_record({"b": [2.5], "a": 1})
    assert digest_record({"a": 1}) != digest_record({"a": 2})
    assert len(digest_record({})) == 40


def test_paths_may_be_strings(tmp_path):
    """Every reader and writer of files takes `str` as well as `Path`; the annotations are checked at each call."""

    def path(name):
        return f"{tmp_path}/{name}"

    rig = ring_rig(3)
    write_rig(path("rig.toml"), rig)
    assert read_rig(path("rig.toml")).names == read_lenses(path("rig.toml")).names == rig.names
    rig.cameras.K[:, 1, 1], rig.cameras.K[:, 0, 1] = rig.cameras.K[:, 0, 0], 0.0
    write_calibration(path("rig.csv"), rig)
    assert tuple(read_cameras(path("rig.csv"))) == rig.names
    write_detections(path("a.csv"), Detections(np.array([0]), np.array([[0.0, 0, 2, 2]]), np.array([0.5])))
    assert len(read_detections(path("a.csv"))) == 1
    write_trajectories(path("tracks.csv"), flight())
    assert read_trajectories(path("tracks.csv")).drones == flight().drones
    assert write_tum(path("tum"), flight()) == [tmp_path / "tum" / "dron1.tum"]
    assert read_tum(path("tum/dron1.tum")).num_frames == 2
    write_c3d(path("a.c3d"), Markers(("A",), np.ones((2, 1, 3)), 100.0))
    assert read_c3d(path("a.c3d")).labels == ("A",)
    with VideoWriter(path("a.avi"), 25.0, (64, 48)) as writer:
        writer.write(np.zeros((48, 64, 3), np.uint8))
    join_videos(path("b.avi"), [path("a.avi"), path("a.avi")])
    assert probe(path("b.avi")).num_frames == 2
    assert digest_file(path("a.avi")) != digest_file(path("b.avi"))


def test_a_folder_is_not_listed_for_each_file(tmp_path):
    """A sweep adds files to a folder of 10,000 files."""
    program = """
import sys
from pathlib import Path
from psotrack.support import atomic_write
folder, listed = Path(sys.argv[1]), []
sys.addaudithook(lambda event, arguments: event in ("os.listdir", "os.scandir") and listed.append(arguments[0]))
for number in range(20):
    with atomic_write(folder / f"{number}.txt") as temporary:
        temporary.write_text("text")
print(sum(Path(place) == folder for place in listed if isinstance(place, (str, Path))))
"""
    done = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)], capture_output=True, text=True, check=True
    )
    assert int(done.stdout) <= 1
    assert len(list(tmp_path.iterdir())) == 20
