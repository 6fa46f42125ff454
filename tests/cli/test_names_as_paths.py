"""Names in files of strangers never lead out of the folder that a command writes to."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import worlds
from hypothesis import assume, given
from hypothesis import strategies as st
from test_bad_input_limits import check_line

from psotrack.errors import InputError, PsotrackError
from psotrack.foreground.detection import LabelSettings, write_data_set
from psotrack.foreground.silhouettes import masks_out
from psotrack.live import recording_folder
from psotrack.pipeline.archives import Manifest
from psotrack.pipeline.archives.zip_file import write_archive
from psotrack.recordings import Recording
from psotrack.recordings.exchange import Footage, export_tracks
from psotrack.show.flights import TrackedFlight
from psotrack.show.overlay import OverlayOptions, write_overlays
from psotrack.support import check_file_name, no_progress
from psotrack.trajectories import read_trajectories, write_trajectories

#: Names that lead elsewhere, that are no names of files, or that are too long.
EVIL = [
    "../evil",
    "../../x",
    "/tmp/evil",
    "a/b",
    "..",
    ".",
    "",
    "a\0b",
    "a\nb",
    "C:evil",
    "..\\evil",
    "a" * 300,
]


@pytest.mark.parametrize("name", [*EVIL, " a", "a ", "...", "a*", "a?b", '"', "a|b", "ä" * 100])
def test_a_name_that_is_none_of_a_file(name):
    with pytest.raises(InputError, match="here: expected names that can be names of files"):
        check_file_name(name, "here")


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


def everything_in(folder: Path) -> set[Path]:
    return set(folder.rglob("*"))


@pytest.mark.parametrize("name", EVIL[:-1])
@pytest.mark.parametrize("to", ["tum", "kitti"])
def test_names_of_drones_in_exports(to, name, tmp_path):
    """A drone is read from a file of tracks, and is a file of the export."""
    tracks = replace(worlds.make_tracks(), drones=(name, "b"))
    before = everything_in(tmp_path)
    with pytest.raises(PsotrackError):
        export_tracks(tracks, to, tmp_path / "in" / "out")
    assert not [path for path in everything_in(tmp_path) - before if path.is_file()]


def test_a_file_of_tracks_with_evil_names(tmp_path, run_psotrack):
    path = tmp_path / "t.csv"
    write_trajectories(path, replace(worlds.make_tracks(), drones=("../../evil", "b")))
    assert read_trajectories(path).drones == ("../../evil", "b")
    check_line(run_psotrack("export", path, "--to", "tum", "--out", tmp_path / "in" / "out"), path)
    assert not list(tmp_path.rglob("*evil*"))


@pytest.fixture
def evil_recording(tmp_path):
    """A recording whose first camera is called ../evil, as Python may build it; files have names that are checked."""
    from psotrack.recordings.datasets import open_recording

    recording = open_recording(worlds.make_sequence(tmp_path / "flight"))
    return _renamed(recording, "../evil")


def _renamed(recording: Recording, name: str) -> Recording:
    first, *others = recording.cameras
    return replace(recording, cameras=(replace(first, name=name), *others))


def test_names_of_cameras_in_overlays(evil_recording, tmp_path):
    flight = TrackedFlight("flight", (), evil_recording)
    with pytest.raises(InputError, match=r"found '\.\./evil'"):
        write_overlays(tmp_path / "in" / "out", flight, OverlayOptions())
    assert not list(tmp_path.rglob("*evil*"))


def test_names_of_cameras_in_masks(tmp_path):
    with pytest.raises(InputError, match=r"found '\.\./evil'"):
        masks_out(tmp_path / "in" / "out", ("a", "../evil"))


@pytest.mark.parametrize("name", ["../evil", "/evil", "a/b", ".."])
def test_a_camera_of_a_recording_file(name, tmp_path, run_psotrack):
    """What --blobs --out writes is named like the camera."""
    folder = worlds.make_sequence(tmp_path / "flight")
    text = (folder / "recording.toml").read_text().replace("[cameras.c0]", f'[cameras."{name}"]')
    (folder / "recording.toml").write_text(text)
    output = run_psotrack(
        "detect", folder, "--blobs", "--out", tmp_path / "in" / "out", "--cache", tmp_path / "c"
    )
    assert output.code == 2
    check_line(output, folder)
    assert not list(tmp_path.rglob("*evil*"))


@pytest.mark.parametrize("name", ["../evil", ".."])
@pytest.mark.parametrize(
    "words",
    [
        ("detect", "{flight}", "--masks", "{out}"),
        ("detect", "{flight}", "--blobs", "--out", "{out}"),
        ("overlay", "{tracks}", "{flight}", "--out", "{out}"),
        ("export", "{tracks}", "{flight}", "--to", "mot", "--drone-size", "0.3,0.3,0.1", "--out", "{out}"),
        ("simulate", "labels", "{flight}", "{other}", "--drone-size", "0.3,0.3,0.1", "--out", "{out}"),
        ("live", "{flight}", "--replay", "--lines", "--record", "{out}"),
        ("track", "{flight}", "--out", "{out}.csv"),
    ],
    ids=lambda words: words[0],
)
def test_commands_that_name_files_like_cameras(words, name, tmp_path, run_psotrack):
    """Refused in one line, in which the recording is named, and nothing is written."""
    folder = worlds.make_sequence(tmp_path / "flight")
    for file in (folder / "recording.toml", folder / "rig.toml"):
        file.write_text(file.read_text().replace("[cameras.c0]", f"[cameras.{json.dumps(name)}]"))
    other = worlds.make_sequence(tmp_path / "other")
    tracks = worlds.make_tracks_file(tmp_path / "tracks.csv")
    before = everything_in(tmp_path)
    places = {"flight": folder, "other": other, "tracks": tracks, "out": tmp_path / "in" / "out"}
    check_line(run_psotrack(*(word.format(**places) for word in words)), folder, name)
    assert everything_in(tmp_path) == before


def test_names_of_cameras_in_labels(evil_recording, tmp_path):
    other = replace(evil_recording, name="other")
    with pytest.raises(InputError, match=r"found 'flight_\.\./evil'"):
        write_data_set([evil_recording, other], tmp_path / "in" / "out", LabelSettings((0.3, 0.3, 0.1)))
    assert not list(tmp_path.rglob("*evil*"))


def test_names_of_cameras_in_boxes_of_motchallenge(evil_recording, tmp_path):
    footage = Footage(evil_recording, np.full((2, 3), 0.3))
    with pytest.raises(InputError, match=r"found 'flight-\.\./evil'"):
        export_tracks(worlds.make_tracks(), "mot", tmp_path / "in" / "out", footage=footage)
    assert not [path for path in (tmp_path / "in").rglob("*") if path.is_file()]


def test_names_of_cameras_in_a_recording_of_a_live_session(evil_recording, tmp_path):
    out, names = tmp_path / "in" / "out", evil_recording.rig.names
    with pytest.raises(InputError, match=r"found '\.\./evil'"), recording_folder(out, evil_recording, names):
        pass
    assert not list(tmp_path.rglob("*evil*"))


def test_names_of_files_in_an_archive(tmp_path):
    """An archive that nobody can unpack is not written; cameras give names to files in archives."""
    manifest = Manifest(psotrack="0.2.0", sequence="flight", tracks="tracks.csv", settings={})
    for name in ("detections/../evil.csv", "silhouettes/..", "/evil", "a\\b"):
        with pytest.raises(InputError, match=r"a\.psotrack: expected names of files inside of the folder"):
            write_archive(tmp_path / "a.psotrack", manifest, {name: b"x"}, force=False, report=no_progress)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["../evil", "/tmp/evil", "a/b", "..", "a\\b"])
def test_the_name_of_a_scenario(name, tmp_path, run_psotrack):
    """It becomes the name of the folder of the sequence."""
    from psotrack.simulation import preset_text

    path = tmp_path / "scenario.toml"
    text = preset_text("S02_D4_A")
    line = next(line for line in text.splitlines() if line.startswith("name"))
    path.write_text(text.replace(line, f"name = {name!r}"))
    check_line(run_psotrack("simulate", path, "--out", tmp_path / "in" / "out"), path, "name")
    assert not list(tmp_path.rglob("*evil*"))
