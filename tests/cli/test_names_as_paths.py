"""Names in files of strangers never lead out of the folder that a command writes to."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import worlds
from helpers import assert_refused
from hypothesis import assume, given
from hypothesis import strategies as st

from psotrack.errors import InputError
from psotrack.foreground.detection import LabelSettings, write_data_set
from psotrack.foreground.silhouettes import masks_out
from psotrack.live import recording_folder
from psotrack.recordings.datasets import open_recording
from psotrack.recordings.exchange import Footage, export_tracks
from psotrack.show.flights import TrackedFlight
from psotrack.show.overlay import write_overlays
from psotrack.support import check_file_name

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


@pytest.mark.parametrize("name", ["../evil", "/evil", ".."])
@pytest.mark.parametrize(
    "words",
    [
        "detect {lab} --masks {out}",
        "detect {lab} --blobs --out {out}",
        "overlay {tracks} {lab} --out {out}",
        "export {tracks} {lab} --to mot --drone-size 0.3,0.3,0.1 --out {out}",
        "simulate labels {lab} {other} --drone-size 0.3,0.3,0.1 --out {out}",
        "live {lab} --replay --lines --record {out}",
        "track {lab} --out {out}.csv",
    ],
)
def test_commands_that_name_files_like_cameras(words, name, world, tmp_path, run_psotrack):
    lab = shutil.copytree(world / "flight", tmp_path / "lab")
    for file in (lab / "recording.toml", lab / "rig.toml"):
        file.write_text(file.read_text().replace("[cameras.c0]", f"[cameras.{json.dumps(name)}]"))
    places = {"lab": lab, "other": world / "second", "tracks": world / "tracks.csv"}
    words = words.format(**places, out=tmp_path / "in" / "out").split()
    assert_refused(lambda: run_psotrack(*words), lab, name, unchanged=tmp_path)


def test_names_of_cameras_that_python_built(flight, tmp_path):
    """Files have names that are checked; Python may build a recording with any."""
    recording = open_recording(flight)
    first, *others = recording.cameras
    recording = replace(recording, cameras=(replace(first, name="../evil"), *others))
    out = tmp_path / "in" / "out"
    other, footage = replace(recording, name="other"), Footage(recording, np.full((2, 3), 0.3))
    labels = LabelSettings((0.3, 0.3, 0.1))
    for write in (
        lambda: write_overlays(out, TrackedFlight("flight", (), recording)),
        lambda: masks_out(out, ("a", "../evil")),
        lambda: write_data_set([recording, other], out, labels),
        lambda: export_tracks(worlds.make_tracks(), "mot", out, footage=footage),
        lambda: recording_folder(out, recording, recording.rig.names).__enter__(),
    ):
        with pytest.raises(InputError, match=r"found '(flight[-_])?\.\./evil'"):
            write()
        assert not [path for path in tmp_path.rglob("*") if path.is_file()]
