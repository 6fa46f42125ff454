"""Full disks: a write that fails anywhere leaves one line, earlier results and no half-written file.

A limit on the size of files stands for a full disk, because it needs no rights: every write beyond it fails, those of
OpenCV, PyArrow and ezc3d included. `test_viewer.py` has the same of Rerun's files.
"""

import contextlib
import shutil
from pathlib import Path

import pytest
from helpers import make_once
from worlds import make_sequence, make_tracks_file

resource = pytest.importorskip("resource", reason="limits on the size of files are a matter of Unix")

#: Content of the file that every command is to replace.
OLDER = b"older"
#: Smallest limit, bytes. What pytest captures is a file too, and must take a line.
LEAST = 320
#: Number of limits that are tried between no byte and the whole file; more for small and quick outputs.
TRIES = 4


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """A small recording with tracks and a packed archive, which no test changes."""

    def make(folder):
        make_sequence(folder / "flight")
        make_sequence(folder / "second")
        make_tracks_file(folder / "tracks.csv")
        (folder / "tracks.ambiguity.csv").write_text("frame,time_s,drone,other,ambiguity\n", encoding="utf-8")

    return make_once(tmp_path_factory, "flight_of_disks", make)


@contextlib.contextmanager
def files_up_to(num_bytes):
    """No file gets longer than a number of bytes. Python ignores the signal that else ends the process."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def content_of(folder):
    """Path of every file, hidden ones included, -> bytes; of a folder -> None."""
    paths = sorted(folder.rglob("*"))
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in paths}


#: Name of the output -> words of the command. `{flight}` is the folder of the recording and tracks, `{out}` the output.
COMMANDS = {
    "rig.toml": "calibrate convert {flight}/flight/rig.toml {out} --force",
    "rig.yaml": "calibrate convert {flight}/flight/rig.toml {out} --force",
    "recording.toml": "init {flight}/flight --out {out} --force --quiet",
    "info.json": "init --show {flight}/flight --json {out} --force",
    "errors.json": "evaluate {flight}/tracks.csv {flight}/flight --json {out} --force",
    "errors.png": "evaluate {flight}/tracks.csv {flight}/flight --plot {out} --force --quiet",
    "export.csv": "export {flight}/tracks.csv --to csv --out {out} --force",
    "export.parquet": "export {flight}/tracks.csv --to parquet --out {out} --force",
    "export.json": "export {flight}/tracks.csv --to json --out {out} --force",
    "export.c3d": "export {flight}/tracks.csv --to c3d --out {out} --force",
    "export.mcap": "export {flight}/tracks.csv {flight}/flight --to mcap --images --out {out} --force",
    "page.html": "report {flight}/tracks.csv {flight}/flight --out {out} --force --jobs 1",
    "masks.mp4": "detect {flight}/flight --cameras c0 --masks {out} --force --jobs 1",
    "masks.avi": "detect {flight}/flight --cameras c0 --masks {out} --force --jobs 1",
}
#: Commands whose outputs are folders; an earlier folder holds one file.
FOLDERS = {
    "tum": "export {flight}/tracks.csv --to tum --out {out} --force",
    "kitti": "export {flight}/tracks.csv --to kitti --out {out} --force",
    "mot": "export {flight}/tracks.csv {flight}/flight --to mot --out {out} --force",
    "videos": "overlay {flight}/tracks.csv {flight}/flight --out {out} --force --jobs 1",
    "masks": "detect {flight}/flight --masks {out} --force --jobs 1",
    "boxes": "detect {flight}/flight --blobs --out {out} --force --jobs 1",
    "yolo": "simulate labels {flight}/flight {flight}/second --drone-size 0.3,0.3,0.15 --out {out} --force --jobs 1",
}


def words_of(command, flight, out):
    return command.format(flight=flight, out=out).split()


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The current folder, which is empty."""
    monkeypatch.setenv("PSOTRACK_CACHE", str(tmp_path / "cache"))
    folder = tmp_path / "place"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


def limits_up_to(num_bytes):
    """Limits from `LEAST` to one byte too few."""
    spread = (
        {LEAST + (num_bytes - LEAST) * step // TRIES for step in range(TRIES)} if num_bytes > LEAST else set()
    )
    return sorted(spread | {num_bytes - 1})


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMANDS)
def test_a_file_is_whole_or_as_it_was(run_psotrack, flight, place, name):
    out = Path(name)
    words = words_of(COMMANDS[name], flight, out)
    undisturbed = run_psotrack(*words)
    assert undisturbed.code == 0, undisturbed.err
    whole = out.read_bytes()
    for limit in limits_up_to(len(whole)):
        out.write_bytes(OLDER)
        with files_up_to(limit):
            result = run_psotrack(*words)
        assert result.code == 2, (limit, result)
        assert result.err.count("\n") == 1, (limit, result.err)
        assert name in result.err, (limit, result.err)
        left = content_of(place)
        # `init` keeps the older file under this name.
        left.pop(f"{name}.bak", None)
        assert left == {name: OLDER}, limit
    assert run_psotrack(*words).code == 0
    assert out.read_bytes() == whole


@pytest.mark.slow
@pytest.mark.parametrize("name", FOLDERS)
def test_a_folder_has_whole_files_only(run_psotrack, flight, place, name):
    out = Path(name)
    words = words_of(FOLDERS[name], flight, out)
    undisturbed = run_psotrack(*words)
    assert undisturbed.code == 0, undisturbed.err
    whole = content_of(place)
    longest = max(len(content) for content in whole.values() if content is not None)
    for limit in limits_up_to(longest):
        shutil.rmtree(out, ignore_errors=True)
        with files_up_to(limit):
            result = run_psotrack(*words)
        left = content_of(place)
        if result.code == 0:
            assert {name: bool(content) for name, content in left.items()} == {
                name: bool(content) for name, content in whole.items()
            }, limit
        else:
            assert result.code == 2, (limit, result)
            assert result.err.count("\n") == 1, (limit, result.err)
            # `overlay` tries codecs in the folder of temporary files, which a full disk may hold too.
            assert name in result.err or "videos were tried there" in result.err, (limit, result.err)
        for file, content in left.items():
            assert file in whole, (limit, file)
            assert content == whole[file], (limit, file)
    assert run_psotrack(*words).code == 0
    assert content_of(place) == whole
