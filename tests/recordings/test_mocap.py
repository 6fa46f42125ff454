"""Motion capture: C3D files, markers that appear and disappear, and the rates of recordings and videos."""

import re
import subprocess
import sys
import textwrap
from pathlib import Path

import ezc3d
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.recordings.mocap import Markers, NoDronesError, marker_bodies, read_c3d, write_c3d
from psotrack.trajectories import Status, Trajectories, resample

#: Positions of the markers of an asymmetric cross in the body's frame, metres.
CROSS_M = np.array([[0.2, 0, 0.05], [-0.15, 0, 0.05], [0, 0.18, 0.05], [0, -0.12, 0.05], [0.05, 0.05, 0.09]])
WHERE = Path("R01_D2.c3d")


def at_frames(markers, fps=25.0, num_frames=9, named=None, offset_s=0.0) -> Trajectories:
    """The drones of a recording at the frames of a video."""
    frame = np.arange(num_frames)
    return resample(marker_bodies(markers, WHERE, named), frame, frame / fps, later_s=offset_s)


def make_markers(num_frames=41, drones=("Dron2", "Dron10"), rate_hz=100.0) -> tuple[Markers, np.ndarray]:
    """Make markers of drones on curved paths, and the centroids of each drone's markers, (frames, drones, 3)."""
    t = np.arange(num_frames)[:, None] / rate_hz
    paths = [np.hstack([i + np.sin(t + i), np.cos(2 * t), 1 + 0.3 * t]) for i in range(len(drones))]
    position_m = np.concatenate([path[:, None] + CROSS_M for path in paths], axis=1)
    labels = tuple(f"{drone}:{drone}{i + 1}" for drone in drones for i in range(len(CROSS_M)))
    return Markers(labels, position_m, rate_hz), np.stack(paths, axis=1) + CROSS_M.mean(axis=0)


def test_round_trip_checked_by_ezc3d(tmp_path):
    markers, _ = make_markers()
    markers.position_m[3, 1] = np.nan
    write_c3d(tmp_path / "a.c3d", markers)
    again = read_c3d(tmp_path / "a.c3d")
    assert again.labels == markers.labels
    assert again.rate_hz == 100.0
    # The file stores float32 millimetres: half of 2^-23 times 4 m is 0.24 micrometres.
    np.testing.assert_allclose(again.position_m, markers.position_m, rtol=0, atol=3e-7)
    independent = ezc3d.c3d(str(tmp_path / "a.c3d"))
    assert independent["parameters"]["POINT"]["UNITS"]["value"] == ["mm"]
    # ezc3d gives NaN for a point whose residual is -1: the format's mark of an unseen point.
    assert np.isnan(independent["data"]["points"][:3, 1, 3]).all()
    assert np.argwhere(independent["data"]["meta_points"]["residuals"][0] < 0).tolist() == [[1, 3]]
    np.testing.assert_allclose(
        independent["data"]["points"][:3, 2, 5], 1e3 * markers.position_m[5, 2], rtol=1e-6
    )


def rewrite(path: Path, **parameters) -> Path:
    """Change parameters of a C3D file by ezc3d; `unseen` marks (frame, marker) by a residual of -1."""
    content = ezc3d.c3d(str(path))
    residuals = content["data"]["meta_points"]["residuals"]
    for name, value in parameters.items():
        if name == "unseen":
            residuals[0, value[1], value[0]] = -1
        else:
            content["parameters"]["POINT"][name]["value"] = value
    content.write(str(path))
    return path


def test_a_residual_of_minus_one_means_unseen(tmp_path):
    markers, _ = make_markers()
    write_c3d(tmp_path / "a.c3d", markers)
    again = read_c3d(rewrite(tmp_path / "a.c3d", unseen=(7, 2)))
    unseen = np.isnan(again.position_m).all(axis=-1)
    assert np.argwhere(unseen).tolist() == [[7, 2]]


@pytest.mark.parametrize(
    ("unit", "metres"),
    [("m", 1), ("M", 1), ("dm", 0.1), ("cm", 0.01), ("um", 1e-6), ("in", 0.0254), ("ft", 0.3048)],
)
def test_units(tmp_path, unit, metres):
    markers, _ = make_markers()
    write_c3d(tmp_path / "a.c3d", markers)
    again = read_c3d(rewrite(tmp_path / "a.c3d", UNITS=[unit]))
    np.testing.assert_allclose(again.position_m, 1e3 * metres * markers.position_m, rtol=1e-6)


def test_an_unknown_unit(tmp_path):
    write_c3d(tmp_path / "a.c3d", make_markers()[0])
    with pytest.raises(InputError, match=r"a\.c3d: expected a unit of um, mm, cm, .*, found 'furlong'"):
        read_c3d(rewrite(tmp_path / "a.c3d", UNITS=["furlong"]))


def test_more_than_255_markers(tmp_path):
    """LABELS holds 255 labels, and LABELS2 holds the rest. Recordings have many unlabelled reflections."""
    labels = (*make_markers()[0].labels, *(f"*{number}" for number in range(300)))
    markers = Markers(labels, np.random.default_rng(0).uniform(1, 2, (5, len(labels), 3)), 100.0)
    write_c3d(tmp_path / "a.c3d", markers)
    assert read_c3d(tmp_path / "a.c3d").labels == labels


@pytest.mark.parametrize(
    ("content", "found"), [(None, "no such file"), (b"", "empty"), (b"hello " * 400, "valid c3d")]
)
def test_a_file_that_is_not_c3d(tmp_path, content, found):
    if content is not None:
        (tmp_path / "a.c3d").write_bytes(content)
    with pytest.raises(InputError, match=rf"a\.c3d: expected a C3D file, found .*{found}"):
        read_c3d(tmp_path / "a.c3d")


@pytest.mark.parametrize("fraction", [0.01, 0.5, 0.9])
def test_a_truncated_file(tmp_path, fraction):
    """ezc3d reads a truncated file without an error."""
    path = tmp_path / "a.c3d"
    write_c3d(path, make_markers(num_frames=400)[0])
    content = path.read_bytes()
    path.write_bytes(content[: int(fraction * len(content))])
    with pytest.raises(InputError, match=r"a\.c3d: expected (a C3D file|400 frames)"):
        read_c3d(path)


def test_the_largest_number_of_frames_of_a_c3d_file(tmp_path):
    """The header counts frames in 16 bits: at most 65,535 (11 minutes at 100 Hz). ezc3d silently drops the rest."""
    markers = Markers(("Dron1:1",), np.ones((65_535, 1, 3)), 100.0)
    write_c3d(tmp_path / "a.c3d", markers)
    assert len(read_c3d(tmp_path / "a.c3d").position_m) == 65_535
    too_long = Markers(("Dron1:1",), np.ones((65_536, 1, 3)), 100.0)
    with pytest.raises(SettingsError, match="expected at most 65535 frames in a C3D file, found 65536"):
        write_c3d(tmp_path / "a.c3d", too_long)


def test_a_video_frame_takes_every_fourth_mocap_frame():
    markers, centroid_m = make_markers()
    truth = at_frames(markers)
    assert truth.drones == ("dron2", "dron10")  # sorted by number; as text, `dron10` would come first
    # Sums of 5 doubles in different orders differ by rounding.
    np.testing.assert_allclose(truth.position_m, centroid_m[0:36:4], rtol=0, atol=1e-12)
    np.testing.assert_allclose(truth.time_s, np.arange(9) / 25)


def test_a_shorter_recording_leaves_nan():
    markers, _ = make_markers(num_frames=17)
    truth = at_frames(markers)
    assert truth.seen[:, 0].tolist() == [True] * 5 + [False] * 4


def test_an_unseen_marker_does_not_move_the_position():
    """The centroid of the visible markers would have an error of centimetres."""
    markers, centroid_m = make_markers()
    markers.position_m[5:20, 6] = np.nan
    truth = at_frames(markers)
    # The tolerance covers the rounding of fits in double precision.
    np.testing.assert_allclose(truth.position_m, centroid_m[0:36:4], rtol=0, atol=1e-9)
    assert truth.seen.all()


def test_the_cross_turns_with_its_body():
    """The drones of `make_markers` do not turn, so the orientations of their crosses are constant."""
    truth = at_frames(make_markers()[0])
    turn = Rotation.from_quat(truth.orientation_wxyz.reshape(-1, 4), scalar_first=True)
    # An angle of 1e-8 has the cosine 1 in double precision.
    assert (turn[0].inv() * turn).magnitude().max() < 1e-7


def test_short_gaps_are_bridged_and_flagged_and_long_gaps_remain():
    """dron2 has a gap of 0.3 s; dron10 has a gap of 0.6 s, because two of its five markers determine no pose."""
    markers, centroid_m = make_markers(num_frames=141)
    markers.position_m[40:70, :5] = np.nan
    markers.position_m[40:100, 5:8] = np.nan
    status = marker_bodies(markers, WHERE).status
    assert np.flatnonzero(status[:, 0] == Status.COASTING).tolist() == [*range(40, 70)]
    assert np.flatnonzero(status[:, 1] == Status.LOST).tolist() == [*range(40, 100)]
    assert (status == Status.TRACKED).sum() == 2 * 141 - 30 - 60
    truth = at_frames(markers, num_frames=36)
    assert truth.seen[:, 0].all()
    assert np.flatnonzero(~truth.seen[:, 1]).tolist() == [*range(10, 25)]
    assert np.isnan(truth.orientation_wxyz[10:25, 1]).all()
    # The error of a cubic is T^4 / 384 times 16 m/s^4 plus T / 8 times the error of its slopes, 0.01 s^2 / 10 times
    # 8 m/s^3: 0.6 mm in total.
    np.testing.assert_allclose(truth.position_m[:, 0], centroid_m[::4, 0], rtol=0, atol=1e-3)


def test_swapped_labels():
    markers, centroid_m = make_markers()
    markers.position_m[8, [0, 1]] = markers.position_m[8, [1, 0]]
    markers.position_m[12:20, [5, 6, 7]] = markers.position_m[12:20, [7, 5, 6]]
    truth = marker_bodies(markers, WHERE)
    np.testing.assert_allclose(truth.position_m, centroid_m, rtol=0, atol=1e-9)
    assert (truth.status == Status.TRACKED).all()


def test_a_drone_whose_markers_are_never_seen_together_is_lost(caplog):
    markers, centroid_m = make_markers()
    markers.position_m[:20, 0] = np.nan
    markers.position_m[20:, 1:5] = np.nan
    truth = at_frames(markers)
    assert (
        "R01_D2.c3d: no reference for dron2: cross dron2: expected every two markers seen together"
        in caplog.text
    )
    assert np.isnan(truth.position_m[:, 0]).all()
    np.testing.assert_allclose(truth.position_m[:, 1], centroid_m[0:36:4, 1], rtol=0, atol=1e-9)


def test_a_marker_that_was_never_seen_does_not_count():
    markers, _ = make_markers()
    markers.position_m[:, 4] = np.nan
    truth = at_frames(markers)
    assert truth.seen.all()
    np.testing.assert_allclose(
        truth.position_m[:, 0], markers.position_m[0:36:4, :4].mean(axis=1), rtol=0, atol=1e-12
    )


def test_labels_without_a_colon_are_one_drone():
    markers, centroid_m = make_markers(drones=("Dron2",))
    stray = np.full((41, 1, 3), 9.0)
    unlabelled = Markers(
        ("A", "B", "C", "D", "E", "*7"), np.concatenate([markers.position_m, stray], axis=1), 100.0
    )
    truth = at_frames(unlabelled)
    assert truth.drones == ("dron1",)
    np.testing.assert_allclose(truth.position_m[:, 0], centroid_m[0:36:4, 0], rtol=0, atol=1e-12)


def test_bodies_that_are_no_drones_are_left_out():
    markers, _ = make_markers(drones=("Dron1", "Wand"))
    stray = Markers((*markers.labels, "*12"), np.pad(markers.position_m, ((0, 0), (0, 1), (0, 0))), 100.0)
    truth = at_frames(stray)
    assert truth.drones == ("dron1",)


def walking(num_markers=12, num_frames=400) -> np.ndarray:
    """(frames, markers, 3): markers of a person, which swing by 5 to 25 cm relative to each other."""
    rng = np.random.default_rng(3)
    t = np.arange(num_frames)[:, None, None] / 100
    place_m = rng.uniform([-0.4, -0.4, 0.5], [0.4, 0.4, 1.3], (num_markers, 3))
    swing_m = rng.uniform(0.05, 0.25, (num_markers, 3)) * np.sin(6 * t + rng.uniform(0, 6, (num_markers, 1)))
    return place_m + swing_m + t * [1.2, 0, 0]


def test_a_walking_person_is_no_drone():
    """Found: a person's C3D in a sequence's folder became drones without a word."""
    labels = tuple(f"M{number}" for number in range(12))
    with pytest.raises(
        NoDronesError, match=r"dron1, not rigid, distances vary by \d+ mm \(M0, M1, .* and 6 more\)"
    ):
        at_frames(Markers(labels, walking(), 100.0))


def person_and_box(num_markers=12) -> Markers:
    box_m = make_markers(400, drones=("Dron1",))[0].position_m
    of_anna = (f"Anna:M{number}" for number in range(num_markers))
    labels = (*(f"boite:b{number}" for number in range(5)), *of_anna)
    return Markers(labels, np.concatenate([box_m, walking(num_markers)], axis=1), 100.0)


@pytest.mark.parametrize(("num_markers", "fault"), [(12, "not rigid"), (43, "43 markers")])
def test_a_box_beside_a_person_is_not_taken_for_a_drone(num_markers, fault):
    message = rf"boite, rigid .*anna, {fault}.*--body NAME=LABEL,LABEL"
    with pytest.raises(NoDronesError, match=message) as caught:
        at_frames(person_and_box(num_markers))
    assert "\n" not in str(caught.value)


def test_a_single_marker_beside_rigid_bodies_is_left_out():
    """A flash for synchronisation, say."""
    markers = make_markers(400, drones=("cf1",))[0]
    position_m = np.pad(markers.position_m, ((0, 0), (0, 1), (0, 0)))
    flash = Markers((*markers.labels, "Sync:Sync"), position_m, 100.0)
    assert at_frames(flash).drones == ("cf1",)


def test_unidentified_markers_are_named():
    """A file without labels: the user learns what `--body` may name."""
    markers, _ = make_markers(drones=("cf1",))
    unnamed = Markers(("*1", "*2", "*3", "*4", "*5"), markers.position_m, 100.0)
    with pytest.raises(
        NoDronesError, match=r"found unidentified markers only \(\*1, \*2, .*\*5\); say which"
    ):
        at_frames(unnamed)


def test_a_single_frame_shows_no_rigid_body():
    markers = make_markers(1, drones=("cf1",))[0]
    with pytest.raises(NoDronesError, match="cf1, seen together in one frame at most"):
        at_frames(markers)


@pytest.mark.parametrize("named", [["boite:"], ["boite:b0", "b1", "b2", "b3", "b4"]])
def test_the_user_says_which_markers_are_a_drone(named, caplog):
    truth = at_frames(person_and_box(), named={"cf1": named})
    assert truth.drones == ("cf1",)
    _, centroid_m = make_markers(400, drones=("Dron1",))
    np.testing.assert_allclose(truth.position_m[:, 0], centroid_m[0:36:4, 0], rtol=0, atol=1e-9)
    assert not caplog.records


def test_named_markers_must_exist_and_are_said_not_to_be_rigid(caplog):
    with pytest.raises(SettingsError, match=r"body cf1, .*: expected labels of boite:b0, .*, found 'b9'"):
        at_frames(person_and_box(), named={"cf1": ["b9"]})
    at_frames(person_and_box(), named={"Anna": ["Anna:"]})
    assert "body Anna is not rigid" in caplog.text


def test_rigid_bodies_with_names_of_their_own_are_taken_with_a_line(caplog):
    markers, _ = make_markers(400, drones=("cf1", "cf2"))
    # Noise of a motion-capture system and swapped labels leave a body rigid.
    markers.position_m[:] += np.random.default_rng(0).normal(0, 5e-4, markers.position_m.shape)
    markers.position_m[:80, [0, 1]] = markers.position_m[:80, [1, 0]]
    truth = at_frames(markers)
    assert truth.drones == ("cf1", "cf2")
    assert "taken for drones, because their markers are rigid: cf1 (cf1:cf11, " in caplog.text


def test_a_person_who_stands_still_is_no_drone():
    """Rigid, but larger than a drone, or with more markers."""
    still = np.repeat(np.random.default_rng(0).uniform(0, [0.5, 0.4, 1.8], (12, 3))[None], 50, axis=0)
    labels = tuple(f"M{number}" for number in range(40))
    for position_m in (still, np.repeat(still, 4, axis=1)[:, :40]):
        markers = Markers(labels[: position_m.shape[1]], position_m, 100.0)
        with pytest.raises(NoDronesError, match=r"dron1, (\d\.\d m large|40 markers)"):
            at_frames(markers)


def test_evaluate_says_a_warning_of_the_reference_once(tmp_path):
    """Found: with `--offset`, the reference was read twice."""
    markers, _ = make_markers(200, drones=("cf1", "cf2"))
    write_c3d(tmp_path / "flight.c3d", markers)
    (tmp_path / "recording.toml").write_text(
        "version = 1\n[cameras.left]\nfps = 25.0\nsize = [64, 48]\n"
        "K = [[50, 0, 32], [0, 50, 24], [0, 0, 1]]\nrvec = [1.5, 0, 0]\ntvec = [0, 0, 5]\n"
        'detections = "left.csv"\n[reference]\nfiles = ["flight.c3d"]\n'
    )
    (tmp_path / "left.csv").write_text("".join(f"{frame},10,10,14,14,12,12,0.9\n" for frame in range(50)))
    truth = at_frames(markers, 25.0, 50)
    rows = [
        f"{frame},{frame / 25},{drone},{x},{y},{z}\n"
        for frame, places in enumerate(truth.position_m)
        for drone, (x, y, z) in enumerate(places)
    ]
    (tmp_path / "tracks.csv").write_text("frame,time_s,drone,x_m,y_m,z_m\n" + "".join(rows))
    command = [
        sys.executable,
        "-m",
        "psotrack",
        "evaluate",
        tmp_path / "tracks.csv",
        tmp_path,
        "--offset",
        "0",
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("taken for drones, because their markers are rigid") == 1


@pytest.mark.parametrize("rate_hz", [100.0, 25.0, 119.88, 120.0, 240.0, 59.94])
@pytest.mark.parametrize("fps", [25.0, 29.97, 30.0])
def test_any_combination_of_mocap_rate_and_frame_rate(rate_hz, fps):
    markers, _ = make_markers(num_frames=200, rate_hz=rate_hz)
    truth = at_frames(markers, fps, 20)
    t = np.arange(20)[:, None] / fps
    path = np.hstack([np.sin(t), np.cos(2 * t), 1 + 0.3 * t]) + CROSS_M.mean(axis=0)
    # The error of a cubic spline: 5/384 dt^4 times 16 m/s^4, larger at its ends; a straight line has 0.8 mm at 25 Hz.
    np.testing.assert_allclose(truth.position_m[:, 0], path, rtol=0, atol=3e-5 * (25 / rate_hz) ** 2)


@pytest.mark.parametrize(("offset_s", "first"), [(0.0, 0), (0.2, 0), (-0.1, 3), (-0.08, 2)])
def test_an_offset_of_the_recording_shifts_the_reference(offset_s, first):
    markers, _ = make_markers(num_frames=100)
    truth = at_frames(markers, offset_s=offset_s)
    assert np.flatnonzero(truth.seen[:, 0])[0] == first
    t = np.arange(first, 9)[:, None] / 25 + offset_s
    path = np.hstack([np.sin(t), np.cos(2 * t), 1 + 0.3 * t]) + CROSS_M.mean(axis=0)
    # The offsets are whole mocap frames, so there is no interpolation error.
    np.testing.assert_allclose(truth.position_m[first:, 0], path, rtol=0, atol=1e-9)


def test_a_recording_without_visible_markers_is_an_error():
    markers, _ = make_markers()
    markers.position_m[:] = np.nan
    with pytest.raises(InputError, match="expected three markers of a drone in some frame, found none"):
        at_frames(markers)


def test_labels_must_match_the_markers():
    with pytest.raises(SettingsError, match=re.escape("expected positions of shape (frames, 1, 3)")):
        Markers(("a",), np.zeros((3, 2, 3)), 100.0)


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"a\.c3d"):
        write_c3d(tmp_path / "file" / "a.c3d", make_markers()[0])


def test_a_full_disk_is_an_error(tmp_path):
    """A limit on the file size stands for a full disk; ezc3d reports an error in neither case."""
    script = textwrap.dedent(
        """
        import resource, sys
        from pathlib import Path
        import numpy as np
        from psotrack.errors import OutputError
        from psotrack.recordings.mocap.c3d import Markers, write_c3d
        sys.dont_write_bytecode = True  # the limit would truncate the bytecode of other processes too
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
        try:
            write_c3d(Path(sys.argv[1]), Markers(("Dron1:1",), np.ones((5_000, 1, 3)), 100.0))
        except OutputError as error:
            print(error)
        """
    )
    path = tmp_path / "a.c3d"
    done = subprocess.run([sys.executable, "-c", script, path], capture_output=True, text=True)
    assert "a.c3d: expected a path that can be written" in done.stdout, done.stderr
    assert list(tmp_path.iterdir()) == []
