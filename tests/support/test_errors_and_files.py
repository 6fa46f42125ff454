"""Error messages, atomic writing of files and folders, and digests."""

import errno
import hashlib
import os
import pickle
from functools import partial
from pathlib import Path

import pytest
from helpers import assert_refused, content_of

from psotrack.errors import (
    LONGEST_MESSAGE,
    InputError,
    OutputError,
    PsotrackError,
    SettingsError,
    errors_name,
)
from psotrack.support import atomic_write, atomic_write_all, digest_file, digest_record, refuse_to_overwrite

# --- messages


def test_a_message_is_one_short_line(tmp_path):
    """What cannot be printed is escaped, the longest part is cut, and a remedy that fits stays whole."""
    command = f"psotrack init {tmp_path}/videos"
    error = InputError(tmp_path / "a\nb.csv", expected="text", found="\x00\x1b[31m\n" * 100, remedy=command)
    message = str(error)
    assert message.startswith(f"{tmp_path}/a b.csv: expected text, found \\x00\\x1b[31m \\x00")
    assert message.endswith(f" ...; {command}")
    assert message.isprintable()
    assert len(message.replace(str(tmp_path), "")) == LONGEST_MESSAGE


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (SettingsError("frame", expected="a", found="b"), "tracks.csv, frame: expected a, found b"),
        (InputError("tracks.csv", expected="a", found="b"), "tracks.csv: expected a, found b"),
        (OutputError("out", expected="a", found="b"), "out: expected a, found b"),
    ],
)
def test_errors_of_a_file_name_it_and_can_be_pickled(error, message):
    with pytest.raises(type(error)) as caught, errors_name("tracks.csv"):
        raise error
    assert str(caught.value) == message
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (type(copy), str(copy)) == (type(error), message)
    assert isinstance(copy, PsotrackError)


# --- files


@pytest.mark.parametrize("name", ["out.csv", "out"])
def test_a_file_appears_when_it_is_complete(tmp_path, name):
    """The temporary file keeps the suffix, because writers choose the file format by the suffix.

    Two writers have different temporary files; the file of the last writer remains.
    """
    path = tmp_path / "new" / name
    with atomic_write(path) as first, atomic_write(path) as second:
        assert first != second
        assert (first.parent, first.suffix) == (path.parent, path.suffix or ".partial")
        first.write_text("first")
        second.write_text("second")
        assert not path.exists()
    assert content_of(path.parent) == {name: b"first"}


def fail_half_way(path, error):
    with atomic_write(path) as temporary:
        if path.is_dir():
            temporary.mkdir()
            temporary /= "new"
        temporary.write_text("half")
        raise error


@pytest.mark.parametrize("error", [ValueError("no"), KeyboardInterrupt(), SystemExit(1)])
@pytest.mark.parametrize("name", ["out.csv", "folder"])
def test_the_old_content_survives_a_failure(tmp_path, error, name):
    (tmp_path / "out.csv").write_text("before")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine").write_text("before")
    before = content_of(tmp_path)
    with pytest.raises(type(error)):
        fail_half_way(tmp_path / name, error)
    assert content_of(tmp_path) == before


def write_text_over(path):
    with atomic_write(path) as temporary:
        temporary.write_text("a,b")


#: Name of the case -> what is done with a file in a folder with the file out.csv and the folder `mine`, the file's
#: name, and words of the line.
BAD = {
    "a full disk": (
        partial(fail_half_way, error=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))),
        "out.csv",
        "out.csv: expected a path that can be written, found No space left",
    ),
    "a file for a folder": (write_text_over, "out.csv/out", "earlier results are unchanged"),
    # Otherwise a user who passes --force and the path of a folder would lose the folder's content.
    "a folder for a file": (write_text_over, "mine", "mine: expected the path of a file, found a folder"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_done_is_one_line(tmp_path, name):
    (tmp_path / "out.csv").write_text("before")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "frame.png").write_text("mine")
    fail, file, words = BAD[name]
    assert_refused(lambda: fail(tmp_path / file), words, unchanged=tmp_path)


def test_a_folder_replaces_a_folder(tmp_path):
    path = tmp_path / "sequence"
    path.mkdir()
    (path / "old").write_text("old")
    with atomic_write(path) as temporary:
        temporary.mkdir()
        (temporary / "new").write_text("new")
        assert [each.name for each in path.iterdir()] == ["old"]
    assert content_of(tmp_path) == {"sequence": None, "sequence/new": b"new"}


def test_files_that_belong_together_are_replaced_together(tmp_path):
    paths = tmp_path / "tracks.csv", tmp_path / "tracks.json"
    for path in paths:
        path.write_text("older")

    def write_both(text):
        with atomic_write_all(paths[1], paths[0]) as (record, tracks):
            # What writes files by itself writes these as they are.
            refuse_to_overwrite(tracks, force=False)
            with atomic_write(tracks) as same:
                assert same == tracks
                same.write_text("newer")
            record.write_text(text)

    with pytest.raises(TypeError):
        write_both(None)
    assert content_of(tmp_path) == {"tracks.csv": b"older", "tracks.json": b"older"}
    paths[1].unlink()
    paths[1].mkdir()
    refusal = "tracks.json: expected the path of a file, found a folder"
    assert_refused(lambda: write_both("newer"), refusal, unchanged=tmp_path)
    paths[1].rmdir()
    write_both("newer")
    assert content_of(tmp_path) == {"tracks.csv": b"newer", "tracks.json": b"newer"}


def test_a_folder_is_not_listed_for_each_file(tmp_path, monkeypatch):
    """A sweep adds files to a folder of 10,000 files."""
    listed = []

    def noted(function, place):
        listed.append(Path(place))
        return function(place)

    for name in ("listdir", "scandir"):
        monkeypatch.setattr(os, name, partial(noted, getattr(os, name)))
    for number in range(20):
        with atomic_write(tmp_path / f"{number}.txt") as temporary:
            temporary.write_text("text")
    monkeypatch.undo()
    assert listed.count(tmp_path) == 1


# --- digests


def test_digests(tmp_path):
    """Of a file by three algorithms; of a record whatever the order of its keys."""
    path = tmp_path / "a"
    path.write_bytes(bytes(range(256)) * 4096)
    content = path.read_bytes()
    assert digest_file(path, algorithm="blake2b") == hashlib.blake2b(content).hexdigest()
    short = hashlib.blake2b(content, digest_size=20).hexdigest()
    assert digest_file(path, algorithm="blake2b-160") == short
    assert digest_file(path, algorithm="sha256") == hashlib.sha256(content).hexdigest()
    assert digest_record({"a": 1, "b": [2.5]}) == digest_record({"b": [2.5], "a": 1})
    assert digest_record({"a": 1}) != digest_record({"a": 2})
    assert len(digest_record({})) == 40
