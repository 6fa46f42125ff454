"""Outputs of all commands: kept without --force, whole or as they were on a full disk, no files, and their names.

Names in files of strangers never lead out of the folder that a command writes to.

A limit on the size of files stands for a full disk.
"""

import json
import os
import re
import shutil
import stat
import subprocess
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import worlds
from helpers import assert_refused, content_of, files_up_to
from hypothesis import assume, given
from hypothesis import strategies as st
from small_sweeps import grid_file, small_sequence, stamps

from psotrack.errors import InputError
from psotrack.recordings.exchange import export_tracks
from psotrack.support import check_file_name

#: What is there before -> words of the command that would replace it.
OUTPUTS = {
    "rig.toml": "calibrate convert {flight}/rig.toml rig.toml",
    "lens.toml": "calibrate rig {flight}/c0.avi --squares 7x5 --square 0.04 --out lens.toml",
    "lens.png": "calibrate rig {flight}/c0.avi --squares 7x5 --square 0.04 --out x.toml --plot lens.png",
    "recording.toml": "init {flight} --out recording.toml",
    "info.json": "init --show {flight} --json info.json",
    "tracks.csv": "track {flight} --out tracks.csv",
    "tracks.json": "track {flight} --out tracks.csv",
    "tracks.ambiguity.csv": "track {flight} --out tracks.csv",
    "run.toml": "track {flight} --out x.csv --save-config run.toml",
    "run.json": "track {flight} --out x.csv --json run.json",
    "live.csv": "live {flight} --replay --out live.csv",
    "live.toml": "live {flight} --replay --out x.csv --save-config live.toml",
    "filmed/mine": "live {flight} --replay --lines --record filmed",
    "errors.png": "evaluate {tracks} {flight} --json x.json --plot errors.png",
    "export.csv": "export {tracks} --to csv --out export.csv",
    "tum/mine": "export {tracks} --to tum --out tum",
    "page.html": "report {tracks} {flight} --out page.html",
    "flight.rrd": "view {tracks} --save flight.rrd",
    "videos/c1.mp4": "overlay {tracks} {flight} --out videos",
    "flight.psotrack": "archive {tracks} {flight} --out flight.psotrack",
    "unpacked/mine": "archive {data}/version_1.psotrack --out unpacked",
    "masks.mp4": "detect {flight} --cameras c0 --masks masks.mp4",
    "masks/c1/mine": "detect {flight} --masks masks",
    "boxes/c1.csv": "detect {flight} --blobs --out boxes",
    "yolo/mine": "simulate labels {flight} {second} --drone-size 0.3,0.3,0.15 --out yolo",
    "data/Simulated_Data/S01_D2_A/mine": "simulate S01_D2_A --out data",
    "sticks.csv": "simulate fly --device keyboard --out sticks.csv",
    "demo/tracks.csv": "demo --out demo",
    "board.pdf": "board --out board.pdf",
    "markers.csv": "onboard detect {flight}/c0.avi --out markers.csv",
    "map.csv": "onboard map {flight}/c0.avi --known 1 --side 0.2 --fov 70,55 --out map.csv",
    "camera.csv": "onboard localise {flight}/c0.avi --markers none.csv --fov 70,55 --out camera.csv",
    "fused.csv": "onboard fuse {tracks} {tracks} --out fused.csv",
    "cache.json": "cache --json cache.json",
}
#: Content of the file that a command is to replace.
OLDER = b"older"


def words_of(command, world):
    places = {"flight": world / "flight", "second": world / "second", "tracks": world / "tracks.csv"}
    return command.format(**places, data=Path(__file__).parents[1] / "data").split()


@pytest.fixture
def place(tmp_path, monkeypatch):
    """The current folder, which is empty."""
    monkeypatch.setenv("PSOTRACK_CACHE", str(tmp_path / "cache"))
    folder = tmp_path / "place"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.parametrize("name", OUTPUTS)
def test_nothing_is_overwritten_without_force(run_psotrack, world, place, name):
    """It is refused before the work: no silhouettes are stored either."""
    Path(name).parent.mkdir(parents=True, exist_ok=True)
    Path(name).write_bytes(OLDER)
    words = words_of(OUTPUTS[name], world)
    assert_refused(lambda: run_psotrack(*words), Path(name).parts[0], "pass --force", unchanged=place.parent)


# --- full disks

#: Name of the output -> words of a command, one for each library that writes files.
FILES = {
    "rig.toml": "calibrate convert {flight}/rig.toml rig.toml",
    "errors.png": "evaluate {tracks} {flight} --plot errors.png --quiet",
    "export.parquet": "export {tracks} --to parquet --out export.parquet",
    "export.c3d": "export {tracks} --to c3d --out export.c3d",
    "export.mcap": "export {tracks} {flight} --to mcap --images --out export.mcap",
    "page.html": "report {tracks} {flight} --out page.html --jobs 1",
    "masks.mp4": "detect {flight} --cameras c0 --masks masks.mp4 --jobs 1",
}
#: Commands whose outputs are folders.
FOLDERS = {
    "tum": "export {tracks} --to tum --out tum",
    "mot": "export {tracks} {flight} --to mot --out mot",
    "videos": "overlay {tracks} {flight} --out videos --jobs 1",
    "masks": "detect {flight} --masks masks --jobs 1",
    "yolo": "simulate labels {flight} {second} --drone-size 0.3,0.3,0.15 --out yolo --jobs 1",
}
#: Smallest limit, bytes. What pytest captures is a file too, and must take a line.
LEAST = 500


def limits(whole):
    """Three limits up to one byte less than the longest file of an output."""
    longest = max(len(content) for content in whole.values() if content is not None)
    if longest <= LEAST:
        return {longest - 1}
    return {LEAST, (LEAST + longest) // 2, longest - 1}


@pytest.mark.slow
@pytest.mark.parametrize("name", FILES)
def test_a_file_is_whole_or_as_it_was(run_psotrack, world, place, name):
    words = [*words_of(FILES[name], world), "--force"]
    assert run_psotrack(*words).code == 0
    whole = content_of(place)
    for limit in limits(whole):
        Path(name).write_bytes(OLDER)
        with files_up_to(limit):
            result = run_psotrack(*words)
        assert content_of(place) == {name: OLDER}, limit
        assert_refused(lambda result=result: result, name, unchanged=place)
    assert run_psotrack(*words).code == 0
    assert Path(name).read_bytes() == whole[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", FOLDERS)
def test_a_folder_has_whole_files_only(run_psotrack, world, place, name):
    words = words_of(FOLDERS[name], world)
    assert run_psotrack(*words).code == 0
    whole = content_of(place)
    for limit in limits(whole):
        Path(name).rename(place.parent / f"made {limit}")
        with files_up_to(limit):
            result = run_psotrack(*words)
        # `overlay` may have written no video, because it tries codecs in the folder of temporary files.
        assert result.code == 2, (limit, result)
        assert result.err.count("\n") == 1, (limit, result.err)
        assert name in result.err or "videos were tried there" in result.err, (limit, result.err)
        assert content_of(place).items() <= whole.items(), limit
        assert run_psotrack(*words, "--force").code == 0
        assert content_of(place) == whole, limit


# --- paths that are no plain files


@pytest.fixture
def convert(world, run_psotrack):
    """Runs `calibrate convert`, whose output is a rig file, with a path of the output and options."""
    return lambda *words: run_psotrack("calibrate", "convert", world / "flight" / "rig.toml", *words)


@pytest.fixture
def show(world, run_psotrack):
    """Runs `init --show`, whose output is JSON at a path."""
    return lambda path, *words: run_psotrack("init", "--show", world / "flight", "--json", path, *words)


def is_device(path):
    return stat.S_ISCHR(os.stat(path, follow_symlinks=False).st_mode)


@pytest.mark.parametrize("force", [[], ["--force"]])
def test_devices_are_never_replaced(show, tmp_path, force):
    assert show("/dev/null", *force).code == 0
    full = "/dev/full: expected a path that can be written, found No space left on device"
    assert_refused(lambda: show("/dev/full", *force), full, unchanged=tmp_path)
    assert is_device("/dev/null")
    assert is_device("/dev/full")


def test_stdout_and_a_pipe_get_the_json_only(show, tmp_path):
    for path in ("-", "/dev/stdout"):
        assert isinstance(json.loads(show(path).out), dict)
    pipe, got = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: got.append(pipe.read_text(encoding="utf-8")), daemon=True)
    reader.start()
    assert show(pipe).code == 0
    reader.join(60)
    assert isinstance(json.loads(got[0]), dict)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_link_is_written_through(convert, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    target, link = tmp_path / "elsewhere" / "mine.txt", tmp_path / "link.toml"
    target.write_bytes(OLDER)
    link.symlink_to(target)
    assert_refused(lambda: convert(link), "--force", unchanged=tmp_path)
    assert convert(link, "--force").code == 0
    assert "c0" in target.read_text(encoding="utf-8")
    assert [*target.parent.iterdir()] == [target]
    # A link to nothing makes the file.
    new = tmp_path / "new.toml"
    new.symlink_to(tmp_path / "new" / "rig.toml")
    assert convert(new).code == 0
    assert link.is_symlink()
    assert new.is_symlink()
    assert (tmp_path / "new" / "rig.toml").is_file()


def test_links_in_a_circle_and_to_a_folder_are_refused(convert, tmp_path):
    (tmp_path / "a.toml").symlink_to(tmp_path / "b.toml")
    (tmp_path / "b.toml").symlink_to(tmp_path / "a.toml")
    circle = "a.toml: expected a link that leads to a file, found a link that leads to itself"
    assert_refused(lambda: convert(tmp_path / "a.toml", "--force"), circle, unchanged=tmp_path)
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "folder.toml" / "mine").touch()
    (tmp_path / "link.toml").symlink_to(tmp_path / "folder.toml")
    folder = "link.toml: expected the path of a file, found a folder"
    assert_refused(lambda: convert(tmp_path / "link.toml", "--force"), folder, unchanged=tmp_path)


@pytest.mark.parametrize("words", ["detect {flight} --masks link", "overlay {tracks} {flight} --out link"])
def test_a_link_to_a_folder_is_followed(run_psotrack, world, place, words):
    Path("elsewhere").mkdir()
    Path("link").symlink_to("elsewhere", target_is_directory=True)
    assert run_psotrack(*words_of(words, world), "--force", "--jobs", 1).code == 0
    assert Path("link").is_symlink()
    made = {path.stem for path in Path("elsewhere").iterdir()}
    assert made >= {"c0", "c1", "c2"}


@pytest.mark.parametrize("name", ["tracks.csv", "tracks.json", "tracks.ambiguity.csv", "other.json"])
def test_track_refuses_a_folder_before_it_tracks(run_psotrack, world, place, name):
    Path(name).mkdir()
    words = ("track", world / "flight", "--out", "tracks.csv", "--force", "--json", "other.json")
    refusal = f"{name}: expected the path of a file, found a folder"
    assert_refused(lambda: run_psotrack(*words), refusal, unchanged=place.parent)


@pytest.mark.parametrize(
    "words",
    [
        "calibrate convert {flight}/rig.toml -",
        "init {flight} --out -",
        "simulate S02_D4_A --frames 2 --log -",
    ],
)
def test_a_dash_makes_no_file_of_this_name(run_psotrack, world, place, words):
    assert_refused(lambda: run_psotrack(*words_of(words, world)), unchanged=place.parent)


# --- names in files of strangers

#: Names that lead elsewhere, that are no names of files, or that are too long.
EVIL = [
    *("../evil", "../../x", "/tmp/evil", "a/b", "..", ".", "", "a\0b", "a\nb", "C:evil", "..\\evil"),
    *(" a", "a ", "...", "a*", "a?b", '"', "a|b", "ä" * 100, "a" * 300),
]


@pytest.mark.parametrize("name", EVIL)
def test_a_name_that_is_none_of_a_file(name, tmp_path):
    """A drone is read from a file of tracks, and is a file of the export."""
    refusal = "here: expected names that can be names of files"
    assert_refused(lambda: check_file_name(name, "here"), refusal, unchanged=tmp_path)
    tracks = replace(worlds.make_tracks(), drones=(name, "b"))
    for to in ("tum", "kitti"):
        assert_refused(lambda to=to: export_tracks(tracks, to, tmp_path / "out"), unchanged=tmp_path)


@pytest.mark.parametrize("name", ["0", "cam1i_s", "dron1", "GoPro 3.left", "ä", "a" * 180, ".hidden", "a..b"])
def test_a_name_that_is_one(name):
    assert check_file_name(name, "here") == name


@given(st.text(max_size=40))
def test_a_name_that_is_taken_stays_in_its_folder(name):
    folder = Path("/data/out")
    try:
        path = folder / f"{check_file_name(name, 'here')}.csv"
    except InputError:
        assume(False)
    assert path.parent == folder
    assert path.resolve().parent == folder


@pytest.mark.parametrize("words", ["detect {lab} --masks out", "live {lab} --replay --lines --record out"])
def test_commands_that_name_files_like_cameras(words, flight, place, run_psotrack):
    lab = shutil.copytree(flight, place / "lab")
    for file in (lab / "recording.toml", lab / "rig.toml"):
        file.write_text(file.read_text().replace("[cameras.c0]", '[cameras."../evil"]'))
    words = words.format(lab=lab).split()
    assert_refused(lambda: run_psotrack(*words), lab, "../evil", unchanged=place)


# --- results that are made of several files, and disks that cannot be written

#: The small sequence with little effort; the program is the one that `small_sequence` compiles.
TRACK = (
    "track {root}/Simulated_Data/S01_D2_A --particles 8 --iterations 2 --swarm joint --score hard --init truth "
    "--drone-size 0.5,0.5,0.2 --reduction 2 --jobs 1 --force --quiet"
)


root = small_sequence


@pytest.mark.slow
def test_files_of_one_run_are_replaced_together(run_psotrack, root, place, monkeypatch):
    monkeypatch.setenv("PSOTRACK_CACHE", str(root / "cache"))
    words = [*TRACK.format(root=root).split(), "--out", "tracks.csv"]
    assert run_psotrack(*words).code == 0
    whole = content_of(place)
    older = dict.fromkeys(("tracks.csv", "tracks.ambiguity.csv", "tracks.json"), OLDER)
    assert whole.keys() == older.keys()
    for content in whole.values():
        for name in older:
            Path(name).write_bytes(OLDER)
        # The digits of a record's seconds differ from run to run.
        with files_up_to(max(LEAST, len(content) - 100)):
            result = run_psotrack(*words)
        assert_refused(lambda result=result: result, "tracks.", unchanged=place)
        assert content_of(place) == older


#: Output folders of commands that go on where the last call has ended -> words of the command.
GO_ON = {
    "data": "simulate S01_D2_A --out data --frames 3 --scale 0.1 --jobs 1 --no-onboard --quiet",
    "cache": "detect --silhouettes {flight} --cache cache --jobs 1 --quiet",
    "videos": "overlay {tracks} {flight} --out videos --jobs 1 --quiet",
    # Found: the next call refused the sequence that the first one had simulated.
    "demo": "demo --out demo --jobs 1 --quiet",
}
#: Seconds of stages and of the whole run, which differ from run to run.
TIMES = re.compile(rb'("seconds": )\{[^}]*\}|("(?:real_time_factor\w*|start_s)": )[-+.e0-9]+')


def files_in(folder):
    """Path of each file -> its content without times."""
    found = content_of(folder)
    return {name: TIMES.sub(rb"\1\2", content) for name, content in found.items() if content is not None}


@pytest.mark.nightly
@pytest.mark.parametrize("name", GO_ON)
def test_the_next_run_goes_on(run_psotrack, place, world, name, monkeypatch):
    """The disk grows from call to call, and is never emptied."""
    monkeypatch.setattr("psotrack.cli.start.NUM_FRAMES", 6)
    monkeypatch.setattr("psotrack.cli.start.SCALE", 0.25)
    words = words_of(GO_ON[name], world)
    assert run_psotrack(*words).code == 0
    whole = files_in(place)
    shutil.rmtree(place / name)
    for limit in sorted(limits(whole)):
        with files_up_to(limit):
            result = run_psotrack(*words)
        assert result.code == 2, limit
        assert result.err.count("\n") == 1, result.err
        left = files_in(place)
        assert not [path for path in left if ".partial" in path], limit
        # Hidden files and folders are no results.
        finished = {path: content for path, content in left.items() if "/." not in path}
        assert finished.items() <= whole.items(), limit
    assert run_psotrack(*words).code == 0
    assert files_in(place) == whole


@pytest.mark.slow
def test_a_sweep_goes_on(run_psotrack, root, place, tmp_path, monkeypatch):
    monkeypatch.setenv("PSOTRACK_CACHE", str(root / "cache"))
    words = ["sweep", grid_file(tmp_path, [2, 3]), "--data", root, "--quiet", "--out", "results"]
    with files_up_to(LEAST):
        result = run_psotrack(*words).ended(2)
    assert "results" in result.err
    # No cell has failed: the disk has.
    assert not list(place.glob("results/cells/*.error.json"))
    assert not list(place.rglob("*.partial*"))
    assert run_psotrack(*words).code == 0
    assert len(stamps(place / "results")) == 2


@pytest.fixture
def make_read_only():
    """Makes a folder read-only until the test ends, also for root, whom no permission stops."""
    mounted = []

    def make(folder):
        command = ["mount", "-o", "bind,ro", folder, folder]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            pytest.skip(f"a file system cannot be mounted here: {done.stderr.strip()}")
        mounted.append(folder)

    yield make
    for folder in mounted:
        subprocess.run(["umount", "--lazy", folder], check=True)


#: More commands that write: what is in the current folder cannot be written.
WRITING = [
    "track {flight} --out tracks.csv --causal",
    "track {flight} --out ../tracks.csv --log steps.log",
    "track {flight} --out ../tracks.csv --cache cache",
    "detect --silhouettes {flight} --cache cache",
]


@pytest.mark.nightly
def test_a_disk_that_cannot_be_written_is_named_before_the_work(
    run_psotrack, place, world, monkeypatch, make_read_only
):
    """Neither silhouettes nor tracks are computed."""
    make_read_only(place)
    monkeypatch.chdir(place)
    for command in (*OUTPUTS.values(), *WRITING):
        words = words_of(command, world)
        assert_refused(lambda words=words: run_psotrack(*words), "can be written", unchanged=place.parent)


@pytest.mark.nightly
def test_a_cache_that_cannot_be_written_is_read(run_psotrack, root, tmp_path, monkeypatch, make_read_only):
    read_only = shutil.copytree(root / "cache", tmp_path / "cache")
    make_read_only(read_only)
    words = TRACK.format(root=root).split()
    for cache, name in ((read_only, "tracks.csv"), (root / "cache", "again.csv")):
        monkeypatch.setenv("PSOTRACK_CACHE", str(cache))
        result = run_psotrack(*words, "--out", tmp_path / name).ended()
        assert result.err == ""
    assert (tmp_path / "tracks.csv").read_bytes() == (tmp_path / "again.csv").read_bytes()
