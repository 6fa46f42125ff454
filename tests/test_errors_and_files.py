"""Error messages, files that are written completely or not at all, and progress bars."""

import errno
import os
import pickle
from pathlib import Path

import pytest

from psotrack.errors import InputError, OutputError, PsotrackError, SettingsError, check_positive
from psotrack.support import atomic_write, no_progress, progress_bar, refuse_to_overwrite


def test_a_message_has_four_parts():
    error = InputError(Path("a/b.csv"), expected="8 columns", found="7", remedy="export it again")
    assert str(error) == f"{Path('a/b.csv')}: expected 8 columns, found 7; export it again"
    assert (
        str(SettingsError("drones", expected="at least 1", found="0"))
        == "drones: expected at least 1, found 0"
    )


@pytest.mark.parametrize("kind", [InputError, SettingsError, OutputError])
def test_errors_can_be_pickled(kind):
    error = kind("here", expected="this", found="that", remedy="do so")
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is kind
    assert str(copy) == str(error)
    assert isinstance(copy, PsotrackError)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
def test_check_positive_refuses(value):
    with pytest.raises(SettingsError, match=r"^fps: expected a number above 0, found \S+; say it$"):
        check_positive("fps", value, "say it")


def test_check_positive_accepts():
    check_positive("fps", 1e-9)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("suffix", [".csv", ".avi", ""])
def test_atomic_write(tmp_path, suffix):
    """The file gets its name when it is complete; the temporary file has the suffix, which writers need."""
    path = tmp_path / "new" / f"out{suffix}"
    with atomic_write(path) as temporary:
        assert temporary.suffix == suffix or not suffix
        assert temporary.parent == path.parent
        temporary.write_text("whole")
        assert not path.exists()
    assert path.read_text() == "whole"
    assert names(path.parent) == [path.name]


def fail_half_way(path, fault):
    with atomic_write(path) as temporary:
        temporary.write_text("half")
        raise fault


@pytest.mark.parametrize("fault", [ValueError("no"), KeyboardInterrupt(), SystemExit(1)])
def test_an_old_file_survives_a_failure(tmp_path, fault):
    path = tmp_path / "out.csv"
    path.write_text("before")
    with pytest.raises(type(fault)):
        fail_half_way(path, fault)
    assert path.read_text() == "before"
    assert names(tmp_path) == ["out.csv"]


def test_a_full_disk(tmp_path):
    path = tmp_path / "out.csv"
    path.write_text("before")
    message = r"out\.csv: expected a path that can be written, found No space left .* unchanged"
    with pytest.raises(OutputError, match=message) as caught:
        fail_half_way(path, OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)))
    assert caught.value.__cause__.errno == errno.ENOSPC
    assert path.read_text() == "before"
    assert names(tmp_path) == ["out.csv"]


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
        assert names(path) == ["old"]
    assert names(path) == ["new"]
    assert names(tmp_path) == ["sequence"]


def fail_half_way_in_a_folder(path):
    with atomic_write(path) as temporary:
        temporary.mkdir()
        (temporary / "new").write_text("half")
        raise KeyboardInterrupt


def test_a_folder_that_fails_leaves_the_old_one(tmp_path):
    path = tmp_path / "sequence"
    path.mkdir()
    (path / "old").write_text("old")
    with pytest.raises(KeyboardInterrupt):
        fail_half_way_in_a_folder(path)
    assert names(path) == ["old"]
    assert names(tmp_path) == ["sequence"]


def test_a_block_that_writes_nothing_keeps_the_old_folder(tmp_path):
    path = tmp_path / "sequence"
    path.mkdir()
    (path / "old").write_text("old")
    with pytest.raises(OutputError), atomic_write(path):
        pass
    assert names(path) == ["old"]
    assert names(tmp_path) == ["sequence"]


def test_two_writers_at_once(tmp_path):
    """Two writers have different temporary files; the file of the last writer remains, complete."""
    path = tmp_path / "out.csv"
    with atomic_write(path) as first, atomic_write(path) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"
    assert names(tmp_path) == ["out.csv"]


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


@pytest.mark.parametrize("report", [no_progress, progress_bar])
def test_progress_is_quiet_where_there_is_no_terminal(report, capfd):
    with report("track", 10) as advance:
        advance(4)
        advance(6)
    out, err = capfd.readouterr()
    assert out == ""
    assert err.strip() == ""


def test_a_file_never_replaces_a_folder(tmp_path):
    """Otherwise a user who names a folder with --force would lose its content."""
    folder = tmp_path / "frames.csv"
    folder.mkdir()
    (folder / "mine.png").write_bytes(b"mine")
    with (
        pytest.raises(OutputError, match=r"expected the path of a file, found a folder"),
        atomic_write(folder) as temporary,
    ):
        temporary.write_text("a,b")
    assert [path.name for path in tmp_path.rglob("*")] == ["frames.csv", "mine.png"]
