"""Archives: tracks are computed again, a damaged or malicious archive writes nothing, old archives stay readable."""

import json
import shutil
import stat
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from archives_made import OLD
from helpers import assert_refused, make_once
from hypothesis import given
from hypothesis import strategies as st

from psotrack.errors import InputError
from psotrack.foreground.silhouettes import SilhouetteSettings, compute
from psotrack.pipeline.archives import compare_with_archive, pack_tracks, read_manifest, unpack
from psotrack.recordings.datasets import open_recording
from psotrack.settings import TrackSettings
from psotrack.trajectories import read_trajectories, write_trajectories

CONTENT = OLD.read_bytes()
#: Content of a small archive.
FILES = {"tracks.csv": b"frame,drone,x_m,y_m,z_m\n", "tracks.json": b"{}"}
WHOLE = tuple(FILES.items())


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """The folder of the old archive; tests must not change it."""
    return make_once(tmp_path_factory, "old", lambda folder: unpack(OLD, folder / "S02_D4_A")) / "S02_D4_A"


@pytest.fixture
def own_flight(flight, tmp_path):
    """A copy of the folder of the old archive, which a test may change."""
    return shutil.copytree(flight, tmp_path / "S02_D4_A")


# --- old archives


def test_the_old_archive_has_what_was_packed(flight):
    manifest, recording = read_manifest(flight), open_recording(flight)
    assert (manifest.version, manifest.sequence, manifest.frames) == (1, "S02_D4_A", 10)
    assert recording.rig.names == tuple(f"cam{number}" for number in range(1, 9))
    assert recording.num_frames == 10
    assert not recording.videos
    assert all(each.silhouettes and each.detections for each in recording.placed)
    assert recording.truth is not None
    assert recording.truth.drones == ("dron1", "dron2", "dron3", "dron4")
    assert {video.frames for video in manifest.videos.values()} == {10}
    assert {video.packed_as for video in manifest.videos.values()} == {None}
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
    earlier, later = (read_trajectories(path).position_m for path in (flight / "tracks.csv", again))
    distance_m = np.linalg.norm(later[:, :, None] - earlier[:6, None], axis=-1).max(axis=0)
    assert sorted(distance_m.argmin(axis=1).tolist()) == [0, 1, 2, 3]
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


def crafted(path, entries=WHOLE, **manifest):
    """Write an archive with some files, which is right but for what the arguments say."""
    names = [name if isinstance(name, str) else name.filename for name, _ in entries]
    described = {
        "format": "psotrack archive", "version": 1, "psotrack": "0.2.0", "sequence": "S", "tracks": "tracks.csv",
        "settings": {}, "files": names, **manifest,
    }  # fmt: skip
    with zipfile.ZipFile(path, "w") as zipped:
        zipped.writestr("psotrack.json", json.dumps(described))
        for name, content in entries:
            zipped.writestr(name, content)
    return path


def test_links_become_files(tmp_path):
    entry = zipfile.ZipInfo("out")
    entry.create_system, entry.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    unpack(crafted(tmp_path / "a.psotrack", [*WHOLE, (entry, b"/")]), tmp_path / "out")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {*FILES, "out", "psotrack.json"}
    unpacked = tmp_path / "out" / "out"
    assert (unpacked.is_symlink(), unpacked.read_bytes()) == (False, b"/")


def with_file(name):
    return lambda path: crafted(path, [*WHOLE, (name, b"2")])


def with_manifest(**changes):
    return lambda path: crafted(path, **changes)


def of_another_program(path):
    with zipfile.ZipFile(path, "w") as zipped:
        zipped.writestr("readme.txt", "of another program" * 10)


OUTSIDE = "names of files inside of the folder"
UNLIKE = "expected the files that psotrack.json lists, found a difference: "
DAMAGED = "expected a whole archive of psotrack, found another file, or one that was cut short or changed"


def test_an_unpacked_archive_is_replaced(own_flight):
    (own_flight / "later.csv").write_text("")
    unpack(OLD, own_flight, force=True)
    assert not (own_flight / "later.csv").exists()


# --- packing


def replace_text(folder, old, new):
    file = folder / "recording.toml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


def change_record(folder, **changes):
    record = json.loads((folder / "tracks.json").read_text())
    (folder / "tracks.json").write_text(json.dumps(record | changes))


def swap_silhouettes(folder):
    replace_text(folder, '"silhouettes/cam1"', '"silhouettes/cam0"')
    replace_text(folder, '"silhouettes/cam2"', '"silhouettes/cam1"')
    replace_text(folder, '"silhouettes/cam0"', '"silhouettes/cam2"')


def drop_last_frame(folder):
    rows = (folder / "tracks.csv").read_text().splitlines(keepends=True)
    (folder / "tracks.csv").write_text("".join(row for row in rows if not row.startswith("9,")))


def test_the_same_input_gives_the_same_bytes(run_psotrack, flight, own_flight, tmp_path):
    """From two folders, and from the archive itself: every file is that of the old archive, but the manifest."""
    first, *others = (tmp_path / f"{name}.psotrack" for name in "abc")
    for path, folder in zip((first, *others), (flight, own_flight, OLD), strict=True):
        assert run_psotrack("archive", flight / "tracks.csv", folder, "--out", path).code == 0
    assert {path.read_bytes() for path in others} == {first.read_bytes()}
    with zipfile.ZipFile(OLD) as old, zipfile.ZipFile(first) as new:
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
    cams = recording.rig.cameras
    R, _ = np.linalg.qr(cams.T_cam_world[:, :3, :3] + 1e-3 * rng.normal(size=(8, 3, 3)))
    R *= np.sign(np.einsum("nij,nij->nj", R, cams.T_cam_world[:, :3, :3]))[:, None]
    T = cams.T_cam_world.copy()
    T[:, :3, :3], T[:, :3, 3] = R, rng.normal(size=(8, 3))
    dist = rng.normal(scale=1e-3, size=(8, 5))
    dist[3, 4:] = 0
    cameras = replace(cams, T_cam_world=T, dist=dist, fisheye=np.arange(8) == 3)
    turned = replace(
        recording.with_rig(replace(recording.rig, cameras=cameras)),
        bounds_m=(-1.0, 2.0, 0.0, 1.0, 0.0, 1 / 3),
    )
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
    manifest = pack_tracks(
        own_flight / "tracks.csv", open_recording(own_flight), tmp_path / "a.psotrack", cache=tmp_path
    )
    assert manifest.frames == 10


def test_tracks_without_the_future_are_computed_again_without_it(run_psotrack, own_flight, tmp_path):
    """The silhouettes of the old archive need the future, so that a run without the future refuses them."""
    change_record(own_flight, causal=True, most_drones=6)
    archive = tmp_path / "a.psotrack"
    assert run_psotrack("archive", own_flight / "tracks.csv", own_flight, "--out", archive).code == 0
    again = ("track", archive, "--out", tmp_path / "t.csv", "--cache", tmp_path)
    assert_refused(lambda: run_psotrack(*again), "first_look: expected True", unchanged=tmp_path)
    unpack(archive, tmp_path / "out")
    manifest = read_manifest(tmp_path / "out")
    assert (manifest.causal, manifest.most_drones) == (True, 6)


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

#: Name of the case -> what makes the archive at a path, words of the line.
ARCHIVES = {
    **{
        f"named {name!r}": (with_file(name), OUTSIDE)
        for name in ("../x", "a/../../x", "/x", "a//x", "./x", "..", "C:x", "a\\..\\x", "a/", "a\nx")
    },
    **{
        f"{name} twice": (with_file(name), f"expected each file once, found {name} twice")
        for name in ("tracks.csv", "Tracks.CSV", "psotrack.json")
    },
    "one more listed": (with_manifest(files=[*FILES, "more"]), f"{UNLIKE}more"),
    "one not listed": (with_manifest(files=["tracks.csv"]), f"{UNLIKE}tracks.json"),
    "no such tracks": (with_manifest(tracks="t.csv"), f"{UNLIKE}t.csv"),
    "a newer version": (
        with_manifest(version=7, psotrack="3.1.4", tracks={"new": "form"}),
        "version 1 or older, found version 7, written by psotrack 3.1.4; install a newer psotrack",
    ),
    "another format": (with_manifest(format="cakes"), "psotrack.json: expected the manifest of an archive"),
    "another zip": (of_another_program, "psotrack.json: expected a file to read, found no such file"),
    "cut short": (lambda path: path.write_bytes(CONTENT[:-100]), DAMAGED),
    "nothing": (lambda path: None, "expected an archive of psotrack, found no such file"),
}


CAM3, NO_SETTINGS = "silhouettes/cam3", '{"shape": [10, 2, 2], "attributes": {}}'


def pack(folder):
    pack_tracks(folder / "tracks.csv", open_recording(folder), folder / "a.psotrack", cache=folder / "none")


def silhouettes(**settings):
    return lambda folder: compute(
        open_recording(folder), SilhouetteSettings(**settings), cache=folder / "none"
    )


def nothing(folder):
    return None


def with_text(old, new):
    return lambda folder: replace_text(folder, old, new)


#: Name of the case -> what happens to the folder of an archive, what is called, words of the line.
FLIGHTS = {
    "the silhouettes of another camera": (swap_silhouettes, pack, "other content of cam1"),
    "another camera": (with_text("[cameras.cam8]", "[cameras.other]"), pack, "no camera cam8"),
    "another rate": (with_text("fps = 25.0", "fps = 30.0"), pack, "10 frames at 30 Hz"),
    "no record": (lambda folder: (folder / "tracks.json").unlink(), pack, "expected the record of the tracks"),
    "another record": (lambda folder: (folder / "tracks.json").write_text("{}"), pack, "which `track` writes"),
    "fewer rows": (drop_last_frame, pack, "tracks.csv: expected 10 frames, as tracks.json says, found 9"),
    "another folder": (lambda folder: (folder / "psotrack.json").unlink(),
                       lambda folder: unpack(OLD, folder, force=True), "S02_D4_A: expected a folder into which"),
    "no chunk": (lambda folder: (folder / CAM3 / "c/0/0/0").unlink(), silhouettes(), "of camera cam3: 10 frames"),
    "no settings": (lambda folder: (folder / CAM3 / "zarr.json").write_text(NO_SETTINGS), silhouettes(),
                    "say what they were made of"),
    "no folder": (lambda folder: shutil.rmtree(folder / CAM3), silhouettes(), "cam3.silhouettes: expected a file that"),
    "the images": (nothing, lambda folder: open_recording(folder).usable(),
                   "expected a video for each of the cameras ", "stored silhouettes do not show the images"),
    "another reduction": (nothing, silhouettes(reduction=4), "silhouettes.reduction: expected 2, as in ",
                          "silhouettes/cam1, found 4; other silhouettes need the video of camera cam1"),
    "a small drone": (nothing, silhouettes(drone_px=80.0), "silhouettes.working_reduction: expected 1, ", "found 4"),
    "another background": (nothing, silhouettes(background="mog2"), "silhouettes.background: expected ", "Living, "),
}  # fmt: skip


#: Name of the case, what happens to the folder of an archive, what is called, words of the line.
BAD = [
    *(
        (
            name,
            lambda folder, make=make: make(folder / "a.psotrack"),
            lambda folder: unpack(folder / "a.psotrack", folder / "out"),
            ("a.psotrack", words),
        )
        for name, (make, words) in ARCHIVES.items()
    ),
    *((name, change, call, words) for name, (change, call, *words) in FLIGHTS.items()),
]


@pytest.mark.filterwarnings("ignore:Duplicate name")
@pytest.mark.parametrize(("change", "call", "words"), [row[1:] for row in BAD], ids=[row[0] for row in BAD])
def test_bad_archives_and_other_recordings_are_refused(own_flight, change, call, words):
    change(own_flight)
    assert_refused(lambda: call(own_flight), *words, unchanged=own_flight)


# --- comparison


@pytest.fixture
def compare(flight, tmp_path):
    """Compare changed tracks with those of the archive."""
    manifest, tracks = read_manifest(flight), read_trajectories(flight / "tracks.csv")

    def call(suffix=".csv", settings=None, **changes):
        record = json.loads((flight / "tracks.json").read_text())
        versions = changes.pop("versions", {})
        write_trajectories(tmp_path / f"again{suffix}", replace(tracks, **changes), force=True)
        return compare_with_archive(
            flight,
            manifest,
            tmp_path / f"again{suffix}",
            {**record, "versions": {**record["versions"], **versions}},
            manifest.track_settings().changed(settings or {}),
        )

    return call


def test_the_same_tracks(compare):
    """Parquet and CSV are compared in the precision of the tracker."""
    comparison = compare()
    assert comparison.same
    assert comparison.differences == {}
    assert comparison.sentence("a.psotrack") == "the same tracks as in a.psotrack"
    assert compare(".parquet").same


def test_other_tracks_in_words(compare, flight):
    tracks = read_trajectories(flight / "tracks.csv")
    position_m = tracks.position_m.copy()
    position_m[7, 2] += [0.003, 0.0, 0.004]
    position_m[9, 1] += [0.0, 0.001, 0.0]
    comparison = compare(
        position_m=position_m, versions={"jax": "0.0.1"}, settings={"swarm.particles": 50, "smooth": True}
    )
    assert not comparison.same
    assert (comparison.from_frame, comparison.from_s) == (7, 0.28)
    assert comparison.max_distance_m == pytest.approx(0.005, rel=1e-6)
    sentence = comparison.sentence("a.psotrack")
    assert "other tracks from frame 7 (0.280 s) on, by at most 5 mm, than in a.psotrack" in sentence
    assert "swarm.particles 20 -> 50" in sentence
    assert "smooth False -> True" in sentence
    assert sentence.endswith("-> 0.0.1")
    assert json.loads(json.dumps(comparison.to_dict()))["differences"]["jax"]["now"] == "0.0.1"
    fitness = np.array(tracks.fitness)
    fitness[3, 0] += 1e-3
    comparison = compare(fitness=fitness)
    assert (comparison.same, comparison.from_frame, comparison.max_distance_m) == (False, 3, 0.0)
    assert "nothing that is recorded" in comparison.sentence("a.psotrack")
    assert "other drones than in a" in compare(drones=("a", "b", "c", "d")).sentence("a")
    assert compare(frame=np.arange(10) + 5).unlike == "frames"


# --- computed again


#: Runs whose archives must give the same bytes again: options of `track`, and options of `archive`.
RUNS = {
    "lines": (
        ["--method", "projection-lines", "--rate", "40", "--frames", "9", "--cameras", "cam1,cam2,cam3,cam4"],
        [],
    ),
    "fused": (["--method", "fused", "--frames", "8", "--max-speed", "5", "--init", "truth"], ["--videos"]),
}
USUAL = ["--particles", "15", "--iterations", "10", "--quiet"]


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_tracks_are_computed_again_bit_by_bit(run_psotrack, tmp_path_factory, tmp_path, name):
    """The archive alone gives the same bytes: with an empty store, and with the sequence out of the way."""

    def simulate(root):
        options = ("--scale", 0.35, "--frames", 12, "--no-onboard", "--quiet")
        assert run_psotrack("simulate", "S02_D4_A", "--out", root, *options).code == 0

    options, pack_options = RUNS[name]
    place = tmp_path / "place"
    tracks, archive, again = place / "tracks.csv", tmp_path / "flight.psotrack", tmp_path / "again.csv"
    simulated = make_once(tmp_path_factory, "small_flight", simulate) / "Simulated_Data" / "S02_D4_A"
    sequence = shutil.copytree(simulated, place / "S02_D4_A")
    # Detections of a folder of its own, and first positions of a file.
    shutil.move(sequence / "dl_data", place / "boxes")
    options = [*options, "--detections", str(place / "boxes")]
    if "--init" not in options:
        truth = open_recording(simulated).truth
        first_m = truth.position_m[int(truth.seen.all(axis=1).argmax())]
        rows = (f"0,{i},{x},{y},{z}\n" for i, (x, y, z) in enumerate(first_m))
        (place / "start.csv").write_text("frame,drone,x_m,y_m,z_m\n" + "".join(rows))
        options += ["--init", str(place / "start.csv")]
    cache = ("--cache", place / "cache")
    assert run_psotrack("track", sequence, "--out", tracks, *cache, *USUAL, *options).code == 0
    assert run_psotrack("archive", tracks, sequence, "--out", archive, *cache, *pack_options).code == 0
    errors = json.loads(run_psotrack("evaluate", tracks, sequence, "--json", "-").out)
    tracks = place.rename(tmp_path / "moved") / "tracks.csv"

    shown = run_psotrack("track", archive, "--out", again, "--cache", tmp_path / "empty").out
    assert again.read_bytes() == tracks.read_bytes()
    assert shown.splitlines()[0].endswith("; the same tracks as in flight.psotrack")
    was, now = (json.loads(path.with_suffix(".json").read_text()) for path in (tracks, again))
    assert (now["archive"]["same"], now["archive"]["differences"]) == (True, {})
    for key in ("sequence", "frames", "cameras", "rate_hz", "input_keys", "volume", "seed"):
        assert now[key] == was[key], key
    assert list((tmp_path / "empty").glob("*/zarr.json")) == [], "the stored silhouettes are used"
    # The reference of the archive is interpolated at the instants, which changes last digits.
    shown_again = json.loads(run_psotrack("evaluate", again, archive, "--json", "-").out)
    assert shown_again["mean_error_m"] == pytest.approx(errors["mean_error_m"], rel=1e-9)
