"""Paths of outputs that are no plain files: links are written through; devices and pipes are never replaced."""

import json
import os
import stat
import threading
from pathlib import Path

import pytest
from helpers import make_once
from worlds import make_sequence, make_tracks_file

from psotrack.errors import OutputError
from psotrack.support import atomic_write, atomic_write_all, refuse_to_overwrite


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A small recording, which no test changes."""
    return (
        make_once(tmp_path_factory, "recording_of_outputs", lambda folder: make_sequence(folder / "flight"))
        / "flight"
    )


@pytest.fixture
def convert(flight, run_psotrack):
    """Runs `calibrate convert`, whose output is a rig file, with a path of the output and options."""
    return lambda *words: run_psotrack("calibrate", "convert", flight / "rig.toml", *words)


def is_device(path):
    return stat.S_ISCHR(os.stat(path, follow_symlinks=False).st_mode)


@pytest.mark.parametrize("force", [[], ["--force"]])
def test_json_for_the_null_device_needs_no_force(run_psotrack, flight, force):
    result = run_psotrack("init", "--show", flight, "--json", "/dev/null", *force)
    assert result.code == 0, result.err
    assert is_device("/dev/null")


@pytest.mark.parametrize(("name", "force"), [("older.json", []), ("folder", ["--force"])])
def test_json_that_cannot_be_written_is_refused_before_the_work(
    run_psotrack, flight, tmp_path, monkeypatch, name, force
):
    monkeypatch.setenv("PSOTRACK_CACHE", str(tmp_path / "cache"))
    (tmp_path / "older.json").write_text("older")
    (tmp_path / "folder").mkdir()
    result = run_psotrack("track", flight, "--out", tmp_path / "t.csv", "--json", tmp_path / name, *force)
    assert result.code == 2
    assert f"{name}: expected" in result.err
    assert result.err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "older.json"]


@pytest.mark.parametrize("force", [[], ["--force"]])
def test_a_full_device_is_named_and_not_replaced(run_psotrack, flight, force):
    result = run_psotrack("init", "--show", flight, "--json", "/dev/full", *force)
    assert result.code == 2
    assert result.err.count("\n") == 1
    assert "/dev/full: expected a path that can be written, found No space left on device" in result.err
    assert is_device("/dev/full")


@pytest.mark.parametrize("name", ["-", "/dev/stdout"])
def test_stdout_gets_the_json_only(run_psotrack, flight, name):
    result = run_psotrack("init", "--show", flight, "--json", name)
    assert result.code == 0, result.err
    assert isinstance(json.loads(result.out), dict)


def test_a_pipe_gets_the_bytes(run_psotrack, flight, tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    got = []
    reader = threading.Thread(target=lambda: got.append(pipe.read_text(encoding="utf-8")), daemon=True)
    reader.start()
    assert run_psotrack("init", "--show", flight, "--json", pipe).code == 0
    reader.join(10)
    assert isinstance(json.loads(got[0]), dict)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_link_is_written_through(convert, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    target, link = tmp_path / "elsewhere" / "mine.txt", tmp_path / "link.toml"
    target.write_text("older", encoding="utf-8")
    link.symlink_to(target)
    refused = convert(link)
    assert refused.code == 2
    assert "--force" in refused.err
    assert target.read_text(encoding="utf-8") == "older"
    assert convert(link, "--force").code == 0
    assert link.is_symlink()
    assert "c0" in target.read_text(encoding="utf-8")
    assert [path.name for path in target.parent.iterdir()] == ["mine.txt"]


def test_a_link_to_nothing_makes_the_file(convert, tmp_path):
    link = tmp_path / "link.toml"
    link.symlink_to(tmp_path / "new" / "rig.toml")
    assert convert(link).code == 0
    assert link.is_symlink()
    assert (tmp_path / "new" / "rig.toml").is_file()


def test_links_in_a_circle_are_named(convert, tmp_path):
    (tmp_path / "a.toml").symlink_to(tmp_path / "b.toml")
    (tmp_path / "b.toml").symlink_to(tmp_path / "a.toml")
    result = convert(tmp_path / "a.toml", "--force")
    assert result.code == 2
    assert result.err.count("\n") == 1
    assert "a.toml: expected a link that leads to a file, found a link that leads to itself" in result.err


def test_a_link_to_a_folder_keeps_the_folder(convert, tmp_path):
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "folder.toml" / "mine").touch()
    (tmp_path / "link.toml").symlink_to(tmp_path / "folder.toml")
    result = convert(tmp_path / "link.toml", "--force")
    assert result.code == 2
    assert "link.toml: expected the path of a file, found a folder" in result.err
    assert (tmp_path / "folder.toml" / "mine").exists()


def test_files_that_belong_together_are_replaced_together(tmp_path):
    paths = tmp_path / "tracks.csv", tmp_path / "tracks.json"
    for path in paths:
        path.write_text("older", encoding="utf-8")

    def write():
        with atomic_write_all(paths[1], paths[0]) as (record, tracks):
            # What writes files by itself writes these as they are.
            refuse_to_overwrite(tracks, force=False)
            with atomic_write(tracks) as same:
                assert same == tracks
                same.write_text("newer", encoding="utf-8")
            record.mkdir()
            record.write_text("a folder takes no text", encoding="utf-8")

    with pytest.raises(OutputError, match="expected a path that can be written"):
        write()
    assert {path.read_text(encoding="utf-8") for path in paths} == {"older"}
    assert len(list(tmp_path.iterdir())) == 2
    with atomic_write_all(*paths) as temporary:
        for path in temporary:
            path.write_text("newer", encoding="utf-8")
    assert {path.read_text(encoding="utf-8") for path in paths} == {"newer"}


def test_a_file_is_replaced_after_those_without_which_it_must_not_be(tmp_path):
    """The second path is a folder: the first must not be replaced either, because the two belong together."""
    tracks, record = tmp_path / "tracks.csv", tmp_path / "tracks.json"
    tracks.write_text("older", encoding="utf-8")
    record.mkdir()

    def write():
        with atomic_write_all(tracks, record) as temporary:
            for path in temporary:
                path.write_text("newer", encoding="utf-8")

    with pytest.raises(OutputError, match=r"tracks\.json: expected the path of a file, found a folder"):
        write()
    assert tracks.read_text(encoding="utf-8") == "older"


def test_the_file_of_a_set_that_fails_is_named(tmp_path):
    def write():
        with (
            atomic_write_all(tmp_path / "a.json", tmp_path / "b.csv") as (first, _),
            atomic_write(first) as file,
        ):
            file.mkdir()
            file.write_text("a folder takes no text", encoding="utf-8")

    with pytest.raises(OutputError, match=r"[\\/]a\.json: expected a path that can be written"):
        write()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["tracks.csv", "tracks.json", "tracks.ambiguity.csv"])
def test_track_refuses_a_folder_before_it_tracks(run_psotrack, flight, tmp_path, name):
    (tmp_path / name).mkdir()
    result = run_psotrack(
        "track", flight, "--out", tmp_path / "tracks.csv", "--force", "--cache", tmp_path / "c"
    )
    assert result.code == 2
    assert result.err.count("\n") == 1
    assert f"{name}: expected the path of a file, found a folder" in result.err
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    "words",
    [
        ["calibrate", "convert", "{flight}/rig.toml", "-"],
        ["init", "{flight}", "--out", "-"],
        ["simulate", "S02_D4_A", "--frames", "2", "--log", "-"],
    ],
)
def test_a_dash_makes_no_file_of_this_name(run_psotrack, flight, tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    result = run_psotrack(*(word.format(flight=flight) for word in words))
    assert result.code == 2
    assert result.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words", [["detect", "{flight}", "--masks"], ["overlay", "{tracks}", "{flight}", "--out"]]
)
def test_a_link_to_a_folder_is_followed(run_psotrack, flight, tmp_path, words):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere", target_is_directory=True)
    tracks = make_tracks_file(tmp_path / "tracks.csv")
    words = [word.format(flight=flight, tracks=tracks) for word in words]
    result = run_psotrack(*words, tmp_path / "link", "--force", "--jobs", 1)
    assert result.code == 0, result.err
    assert (tmp_path / "link").is_symlink()
    assert {path.name.partition(".")[0] for path in (tmp_path / "elsewhere").iterdir()} >= {"c0", "c1", "c2"}


def test_a_folder_that_cannot_be_written_is_named_before_the_work(tmp_path, monkeypatch):
    # Rights do not bind root, who may run the tests.
    monkeypatch.setattr(os, "access", lambda path, _: Path(path) != tmp_path)
    with pytest.raises(OutputError, match=r"tracks\.csv: expected a path in a folder that can be written"):
        refuse_to_overwrite(tmp_path / "new" / "tracks.csv", force=True)
    assert list(tmp_path.iterdir()) == []
