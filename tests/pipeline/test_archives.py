"""Archives: tracks are computed again, a damaged or malicious archive writes nothing, old archives stay readable."""

import json
import shutil
import stat
import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from archives_made import OLD
from helpers import assert_refused, files_up_to, made_once, make_once
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.foreground.silhouettes import SilhouetteSettings, compute
from psotrack.pipeline.archives import compare_with_archive, pack_tracks, read_manifest, unpack
from psotrack.recordings.datasets import open_recording
from psotrack.settings import TrackSettings
from psotrack.trajectories import Status, read_trajectories, write_trajectories

CONTENT = OLD.read_bytes()
#: Content of a small archive.
FILES = {"tracks.csv": b"frame,drone,x_m,y_m,z_m\n", "tracks.json": b"{}"}


#: The folder of the old archive; tests must not change it.
flight = made_once("old", lambda folder: unpack(OLD, folder / "S02_D4_A"), "S02_D4_A")


@pytest.fixture
def own_flight(flight, tmp_path):
    """A copy of the folder of the old archive, which a test may change."""
    return shutil.copytree(flight, tmp_path / "S02_D4_A")


# --- old archives


def test_the_old_archive_has_what_was_packed(flight):
    manifest, recording = read_manifest(flight), open_recording(flight)
    assert manifest.version == 1
    assert manifest.sequence == "S02_D4_A"
    assert manifest.frames == 10
    assert recording.rig.names == tuple(f"cam{number}" for number in range(1, 9))
    assert recording.num_frames == 10
    assert not recording.videos
    assert all(each.silhouettes and each.detections for each in recording.placed)
    assert recording.truth is not None
    assert recording.truth.drones == ("dron1", "dron2", "dron3", "dron4")
    for video in manifest.videos.values():
        assert video.frames == 10
        assert video.packed_as is None
    assert read_trajectories(flight / "tracks.csv").num_drones == 4
    record = json.loads((flight / "tracks.json").read_text())
    made = compute(recording, SilhouetteSettings(), cache=flight / "no cache is needed")
    assert dict(made.keys) == record["input_keys"]
    assert made.reduction == 2
    changes = {"swarm.particles": 20, "swarm.iterations": 15, "silhouettes.reduction": 2}
    assert manifest.track_settings() == TrackSettings().changed(changes)


def test_commands_take_the_archive_as_a_sequence(run_psotrack, flight, tmp_path):
    errors = json.loads(run_psotrack("evaluate", flight / "tracks.csv", OLD, "--json", "-").out)
    assert errors["drones"] == 4
    # A pixel is 2 to 3 cm at the drones.
    assert errors["mean_error_m"] < 0.15
    described = json.loads(run_psotrack("init", "--show", OLD, "--json", "-").out)
    assert described["name"] == "S02_D4_A"
    assert described["cameras"]["cam1"]["video"] is None
    assert described["cameras"]["cam1"]["silhouettes"].endswith("cam1")
    assert not Path(described["folder"]).exists(), "the archive is unpacked for the time of the command"


@pytest.mark.slow
def test_the_old_archive_is_tracked_again(run_psotrack, flight, tmp_path):
    """With its settings, but for the options that are given."""
    again = tmp_path / "again.csv"
    options = ("--particles", 25, "--frames", 6, "--cache", tmp_path)
    shown = run_psotrack("track", OLD, "--out", again, *options).out
    for words in ("swarm.particles 20 -> 25", "frames 10 -> 6", "other frames than in version_1.psotrack"):
        assert words in shown
    record = json.loads(again.with_suffix(".json").read_text())
    assert record["archive"]["unlike"] == "frames"
    assert (record["settings"]["swarm"]["particles"], record["settings"]["swarm"]["iterations"]) == (25, 15)
    # A later tracker numbers the drones otherwise, and its tracks differ by less than a cell of 4 to 6 cm.
    earlier = read_trajectories(flight / "tracks.csv")
    later = read_trajectories(again)
    apart_m = later.position_m[:, :, None] - earlier.position_m[:6, None]
    distance_m = np.linalg.norm(apart_m, axis=-1).max(axis=0)
    assert sorted(distance_m.argmin(axis=1)) == [0, 1, 2, 3]
    assert distance_m.min(axis=1).max() < 0.05


# --- damaged and malicious archives


@given(place=st.integers(0, len(CONTENT) - 1), bit=st.integers(0, 7))
def test_a_changed_bit_changes_no_file(tmp_path_factory, place, bit):
    """It is refused, or it is in a date or an attribute of the zip file, which nothing reads."""
    folder = tmp_path_factory.mktemp("changed")
    changed = bytearray(CONTENT)
    changed[place] ^= 1 << bit
    (folder / "flight.psotrack").write_bytes(changed)
    try:
        unpack(folder / "flight.psotrack", folder / "out")
    except InputError:
        assert [path.name for path in folder.iterdir()] == ["flight.psotrack"]
    else:
        with zipfile.ZipFile(OLD) as zipped:
            for name in zipped.namelist():
                assert (folder / "out" / name).read_bytes() == zipped.read(name)


def crafted(path, more=None, **manifest):
    """Write a small archive, with one more file if it is given, and with changes of its manifest."""
    names = [*FILES]
    if more is not None:
        names.append(more.filename if isinstance(more, zipfile.ZipInfo) else more)
    described = {
        "format": "psotrack archive",
        "version": 1,
        "psotrack": "0.2.0",
        "sequence": "S",
        "tracks": "tracks.csv",
        "settings": {},
        "files": names,
    }
    with zipfile.ZipFile(path, "w") as zipped:
        zipped.writestr("psotrack.json", json.dumps(described | manifest))
        for name, content in FILES.items():
            zipped.writestr(name, content)
        if more is not None:
            zipped.writestr(more, b"/")
    return path


def assert_not_unpacked(archive, *words):
    out = archive.with_name("out")
    assert_refused(lambda: unpack(archive, out), archive, *words, unchanged=archive.parent)


def test_links_become_files(tmp_path):
    link = zipfile.ZipInfo("link")
    link.create_system = 3
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    unpack(crafted(tmp_path / "a.psotrack", link), tmp_path / "out")
    unpacked = tmp_path / "out" / "link"
    assert not unpacked.is_symlink()
    assert unpacked.read_bytes() == b"/"


UNLIKE = "expected the files that psotrack.json lists, found a difference: "
#: Names that lead out of the folder, or to no file.
OUTSIDE = ("../x", "a/../../x", "/x", "a//x", "./x", "..", "C:x", "a\\..\\x", "a/", "a\nx")
TWICE = ("tracks.csv", "Tracks.CSV", "psotrack.json")
#: Name of one more file, or changes of a manifest, and words of the line.
CRAFTED = [
    *(({"more": name}, "names of files inside of the folder") for name in OUTSIDE),
    *(({"more": name}, f"expected each file once, found {name} twice") for name in TWICE),
    ({"files": [*FILES, "more"]}, f"{UNLIKE}more"),
    ({"files": ["tracks.csv"]}, f"{UNLIKE}tracks.json"),
    ({"tracks": "t.csv"}, f"{UNLIKE}t.csv"),
    (
        {"version": 7, "psotrack": "3.1.4", "tracks": {"new": "form"}},
        "version 1 or older, found version 7, written by psotrack 3.1.4; install a newer psotrack",
    ),
    ({"format": "cakes"}, "psotrack.json: expected the manifest of an archive"),
]


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(("changes", "words"), CRAFTED)
def test_names_stay_in_the_folder_no_file_is_there_twice_and_a_manifest_is_that_of_the_archive(
    changes, words, tmp_path
):
    assert_not_unpacked(crafted(tmp_path / "a.psotrack", **changes), words)


def test_other_files_are_no_archives(tmp_path):
    path = tmp_path / "a.psotrack"
    assert_not_unpacked(path, "expected an archive of psotrack, found no such file")
    with zipfile.ZipFile(path, "w") as zipped:
        zipped.writestr("readme.txt", "of another program" * 10)
    assert_not_unpacked(path, "psotrack.json: expected a file to read, found no such file")


def test_an_unpacked_archive_is_replaced_and_no_other_folder(own_flight):
    (own_flight / "later.csv").write_text("")
    unpack(OLD, own_flight, force=True)
    assert not (own_flight / "later.csv").exists()
    (own_flight / "psotrack.json").unlink()
    words = "S02_D4_A: expected a folder into which"
    assert_refused(lambda: unpack(OLD, own_flight, force=True), words, unchanged=own_flight)


# --- packing


def replace_text(folder, old, new):
    file = folder / "recording.toml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


def change_record(folder, **changes):
    record = json.loads((folder / "tracks.json").read_text())
    (folder / "tracks.json").write_text(json.dumps(record | changes))


def swap_silhouettes(folder):
    stored = folder / "silhouettes"
    (stored / "cam1").rename(stored / "cam0")
    (stored / "cam2").rename(stored / "cam1")
    (stored / "cam0").rename(stored / "cam2")


def drop_last_frame(folder):
    rows = (folder / "tracks.csv").read_text().splitlines(keepends=True)
    (folder / "tracks.csv").write_text("".join(row for row in rows if not row.startswith("9,")))


def test_the_same_input_gives_the_same_bytes(run_psotrack, flight, own_flight, tmp_path):
    """From two folders, and from the archive itself: every file is that of the old archive, but the manifest."""
    made = set()
    for number, folder in enumerate((flight, own_flight, OLD)):
        path = tmp_path / f"{number}.psotrack"
        assert run_psotrack("archive", flight / "tracks.csv", folder, "--out", path).code == 0
        made.add(path.read_bytes())
    assert len(made) == 1
    with zipfile.ZipFile(OLD) as old, zipfile.ZipFile(path) as new:
        assert new.testzip() is None
        assert new.namelist() == old.namelist()
        for name in set(old.namelist()) - {"psotrack.json"}:
            assert new.read(name) == old.read(name), name


def test_calibrations_and_listed_times_keep_every_bit(own_flight, tmp_path):
    """With a rig whose rotations a Rodrigues vector would change, and with a fisheye beside other lenses.

    The record is not that of this recording: its rate differs by less than a record can show.
    """
    time_s = np.arange(10) / 25 + 1e-13 * np.arange(10) ** 2
    rows = "".join(f"{frame},{value!r}\n" for frame, value in enumerate(time_s.tolist()))
    (own_flight / "times.csv").write_text(f"frame,time_s\n{rows}")
    replace_text(own_flight, "fps = 25.0\n", 'timestamps = "times.csv"\n')
    recording = open_recording(own_flight)
    rng = np.random.default_rng(1)
    T_cam_world = np.tile(np.eye(4), (8, 1, 1))
    T_cam_world[:, :3, :3] = Rotation.random(8, rng=rng).as_matrix()
    T_cam_world[:, :3, 3] = rng.normal(size=(8, 3))
    dist = rng.normal(scale=1e-3, size=(8, 5))
    dist[3, 4:] = 0
    is_fisheye = np.arange(8) == 3
    cameras = replace(recording.rig.cameras, T_cam_world=T_cam_world, dist=dist, fisheye=is_fisheye)
    turned = recording.with_rig(replace(recording.rig, cameras=cameras))
    turned = replace(turned, bounds_m=(-1.0, 2.0, 0.0, 1.0, 0.0, 1 / 3))
    pack_tracks(own_flight / "tracks.csv", turned, tmp_path / "a.psotrack", cache=tmp_path)
    unpack(tmp_path / "a.psotrack", tmp_path / "out")
    packed = open_recording(tmp_path / "out")
    for name in ("T_cam_world", "K", "dist", "image_size_wh", "fisheye"):
        np.testing.assert_array_equal(getattr(packed.rig.cameras, name), getattr(cameras, name), name)
    assert packed.bounds_m == turned.bounds_m
    assert packed.exposed == recording.exposed
    assert packed.exposed["cam1"].listed_s == tuple(time_s.tolist())


def test_corrected_clocks_may_end_an_instant_earlier(own_flight, tmp_path):
    """Found: 299 instants were taken for the first 299 frames of 300, and other tracks were computed again."""
    change_record(own_flight, frames=9)
    drop_last_frame(own_flight)
    tracks, recording = own_flight / "tracks.csv", open_recording(own_flight)
    manifest = pack_tracks(tracks, recording, tmp_path / "a.psotrack", cache=tmp_path)
    assert manifest.frames == 10


def test_an_older_archive_stays_where_a_disk_is_full(flight, tmp_path):
    archive = shutil.copy(OLD, tmp_path)
    tracks, recording = flight / "tracks.csv", open_recording(flight)
    pack = partial(pack_tracks, tracks, recording, archive, cache=tmp_path, force=True)
    with files_up_to(len(CONTENT) // 2):
        assert_refused(pack, archive, unchanged=tmp_path)


def test_tracks_without_the_future_are_computed_again_without_it(run_psotrack, own_flight, tmp_path):
    """The silhouettes of the old archive need the future, so that a run without the future refuses them."""
    change_record(own_flight, causal=True, most_drones=6)
    archive = tmp_path / "a.psotrack"
    assert run_psotrack("archive", own_flight / "tracks.csv", own_flight, "--out", archive).code == 0
    again = ("track", archive, "--out", tmp_path / "t.csv", "--cache", tmp_path)
    assert_refused(lambda: run_psotrack(*again), "first_look: expected True", unchanged=tmp_path)
    unpack(archive, tmp_path / "out")
    manifest = read_manifest(tmp_path / "out")
    assert manifest.causal
    assert manifest.most_drones == 6


# --- stored silhouettes


def test_some_frames_and_some_cameras_have_the_silhouettes_of_all(flight):
    recording = open_recording(flight)
    every = compute(recording, cache=flight / "none")
    # The settings with which they were made are accepted.
    assert compute(recording, SilhouetteSettings(reduction=2), cache=flight / "none").keys == every.keys
    first = compute(recording.usable(num_frames=4, silhouettes=True), cache=flight / "none")
    assert first.num_frames == 4
    np.testing.assert_array_equal(first.read(0, 4), every.read(0, 4))
    assert set(first.keys.values()).isdisjoint(every.keys.values())
    some = compute(recording.usable(["cam2", "cam5"], silhouettes=True), cache=flight / "none")
    np.testing.assert_array_equal(some.read(0, 10), every.read(0, 10)[:, [1, 4]])


# --- what is refused


#: What happens to a folder, and words of the line.
UNFIT = [
    (swap_silhouettes, "other content of cam1"),
    (partial(replace_text, old="[cameras.cam8]", new="[cameras.other]"), "no camera cam8"),
    (partial(replace_text, old="fps = 25.0", new="fps = 30.0"), "10 frames at 30 Hz"),
    (lambda folder: (folder / "tracks.json").unlink(), "expected the record of the tracks"),
    (drop_last_frame, "tracks.csv: expected 10 frames, as tracks.json says, found 9"),
]


@pytest.mark.parametrize(("change", "words"), UNFIT)
def test_tracks_of_another_recording_are_not_packed(change, words, own_flight, tmp_path):
    change(own_flight)
    tracks, recording = own_flight / "tracks.csv", open_recording(own_flight)
    pack = partial(pack_tracks, tracks, recording, own_flight / "a.psotrack", cache=tmp_path)
    assert_refused(pack, words, unchanged=own_flight)


#: A setting of silhouettes, its value, and words of the line.
OTHER_SETTINGS = [
    ("reduction", 4, "silhouettes.reduction: expected 2, as in "),
    ("drone_px", 80.0, "silhouettes.working_reduction: expected 1, "),
    ("background", "mog2", "Living, as in "),
]


@pytest.mark.parametrize(("name", "value", "words"), OTHER_SETTINGS)
def test_without_videos_there_are_no_other_silhouettes(name, value, words, flight, tmp_path):
    settings = SilhouetteSettings(**{name: value})
    recording = open_recording(flight)
    assert_refused(lambda: compute(recording, settings, cache=tmp_path), words, unchanged=tmp_path)
    images = "stored silhouettes do not show the images"
    assert_refused(recording.usable, images, unchanged=tmp_path)


# --- comparison


@pytest.fixture
def compare(flight, tmp_path):
    """Compare changed tracks with those of the archive."""
    manifest, tracks = read_manifest(flight), read_trajectories(flight / "tracks.csv")

    def call(suffix=".csv", settings=(), versions=(), archived=flight, **changes):
        record = json.loads((flight / "tracks.json").read_text())
        record["versions"].update(versions)
        again = tmp_path / f"again{suffix}"
        write_trajectories(again, replace(tracks, **changes), force=True)
        used = manifest.track_settings().changed(dict(settings))
        return compare_with_archive(archived, manifest, again, record, used)

    return call


def test_the_same_tracks(compare):
    """Parquet and CSV are compared in the precision of the tracker."""
    comparison = compare()
    assert comparison.same
    assert comparison.differences == {}
    assert compare(".parquet").same


def test_a_lost_drone_is_no_difference(compare, own_flight):
    tracks = read_trajectories(own_flight / "tracks.csv")
    lost = {"position_m": tracks.position_m.copy(), "status": tracks.status.copy()}
    lost["position_m"][4, 1], lost["status"][4, 1] = np.nan, Status.LOST
    write_trajectories(own_flight / "tracks.csv", replace(tracks, **lost), force=True)
    assert compare(archived=own_flight, **lost).same


def test_other_tracks_in_words(compare, flight):
    position_m = read_trajectories(flight / "tracks.csv").position_m.copy()
    position_m[7, 2] += [0.003, 0.0, 0.004]
    position_m[9, 1] += [0.0, 0.001, 0.0]
    settings = {"swarm.particles": 50, "smooth": True}
    comparison = compare(position_m=position_m, versions={"jax": "0.0.1"}, settings=settings)
    assert not comparison.same
    assert comparison.from_frame == 7
    assert comparison.from_s == 0.28
    assert comparison.max_distance_m == pytest.approx(0.005, rel=1e-6)
    sentence = comparison.sentence("a.psotrack")
    assert "other tracks from frame 7 (0.280 s) on, by at most 5 mm, than in a.psotrack" in sentence
    assert "swarm.particles 20 -> 50" in sentence
    assert comparison.to_dict()["differences"]["jax"]["now"] == "0.0.1"


def test_tracks_that_differ_in_something_else(compare, flight):
    fitness = np.array(read_trajectories(flight / "tracks.csv").fitness)
    fitness[3, 0] += 1e-3
    comparison = compare(fitness=fitness)
    assert not comparison.same
    assert comparison.from_frame == 3
    assert comparison.max_distance_m == 0.0
    assert "nothing that is recorded" in comparison.sentence("a.psotrack")
    renamed = compare(drones=("a", "b", "c", "d"))
    assert "other drones than in a" in renamed.sentence("a")
    assert compare(frame=np.arange(10) + 5).unlike == "frames"


# --- computed again


#: Runs whose archives must give the same bytes again: options of `track`.
RUNS = {
    "lines": "--method projection-lines --rate 40 --frames 9 --cameras cam1,cam2,cam3,cam4",
    "fused": "--method fused --frames 8 --max-speed 5",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_tracks_are_computed_again_bit_by_bit(run_psotrack, tmp_path_factory, tmp_path, name):
    """The archive alone gives the same bytes: with an empty store, and with the sequence out of the way."""

    def simulate(root):
        options = ("--scale", 0.35, "--frames", 12, "--no-onboard", "--quiet")
        assert run_psotrack("simulate", "S02_D4_A", "--out", root, *options).code == 0

    place = tmp_path / "place"
    tracks = place / "tracks.csv"
    archive = tmp_path / "flight.psotrack"
    simulated = make_once(tmp_path_factory, "small_flight", simulate) / "Simulated_Data" / "S02_D4_A"
    sequence = shutil.copytree(simulated, place / "S02_D4_A")
    # Detections of a folder of its own, and first positions of a file.
    shutil.move(sequence / "dl_data", place / "boxes")
    write_trajectories(place / "start.csv", open_recording(simulated).truth)
    track = ["track", sequence, "--out", tracks, "--cache", place / "cache", "--detections", place / "boxes"]
    pack = ["archive", tracks, sequence, "--out", archive, "--cache", place / "cache"]
    if name == "fused":
        track += ["--init", "truth"]
        pack += ["--videos"]
    else:
        track += ["--init", place / "start.csv"]
    options = RUNS[name].split()
    run_psotrack(*track, *options, "--particles", 15, "--iterations", 10, "--quiet").ended()
    assert run_psotrack(*pack).code == 0
    tracks = place.rename(tmp_path / "moved") / "tracks.csv"

    again = tmp_path / "again.csv"
    shown = run_psotrack("track", archive, "--out", again, "--cache", tmp_path / "empty").out
    assert again.read_bytes() == tracks.read_bytes()
    assert shown.splitlines()[0].endswith("; the same tracks as in flight.psotrack")
    was = json.loads(tracks.with_suffix(".json").read_text())
    now = json.loads(again.with_suffix(".json").read_text())
    assert now["archive"]["same"]
    assert now["archive"]["differences"] == {}
    for key in ("sequence", "frames", "cameras", "rate_hz", "input_keys", "volume", "seed"):
        assert now[key] == was[key], key
    assert list((tmp_path / "empty").glob("*/zarr.json")) == [], "the stored silhouettes are used"
