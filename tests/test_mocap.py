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
from psotrack.recordings import Markers, body_trajectories, read_c3d, write_c3d
from psotrack.trajectories import Status

#: An asymmetric cross, metres, in the body.
CROSS_M = np.array([[0.2, 0, 0.05], [-0.15, 0, 0.05], [0, 0.18, 0.05], [0, -0.12, 0.05], [0.05, 0.05, 0.09]])
WHERE = Path("R01_D2.c3d")


def recording(num_frames=41, drones=("Dron2", "Dron10"), rate_hz=100.0) -> tuple[Markers, np.ndarray]:
    """Markers of drones on curved paths, and the centroids of their markers, (frames, drones, 3)."""
    t = np.arange(num_frames)[:, None] / rate_hz
    paths = [np.hstack([i + np.sin(t + i), np.cos(2 * t), 1 + 0.3 * t]) for i in range(len(drones))]
    position_m = np.concatenate([path[:, None] + CROSS_M for path in paths], axis=1)
    labels = tuple(f"{drone}:{drone}{i + 1}" for drone in drones for i in range(len(CROSS_M)))
    return Markers(labels, position_m, rate_hz), np.stack(paths, axis=1) + CROSS_M.mean(axis=0)


def test_round_trip_checked_by_ezc3d(tmp_path):
    markers, _ = recording()
    markers.position_m[3, 1] = np.nan
    write_c3d(tmp_path / "a.c3d", markers)
    again = read_c3d(tmp_path / "a.c3d")
    assert again.labels == markers.labels
    assert again.rate_hz == 100.0
    # float32 of millimetres: half of 2^-23 of up to 4 m is 0.24 micrometres.
    np.testing.assert_allclose(again.position_m, markers.position_m, rtol=0, atol=3e-7)
    witness = ezc3d.c3d(str(tmp_path / "a.c3d"))
    assert witness["parameters"]["POINT"]["UNITS"]["value"] == ["mm"]
    assert witness["data"]["points"][:3, 1, 3].tolist() == [0, 0, 0]
    np.testing.assert_allclose(witness["data"]["points"][:3, 2, 5], 1e3 * markers.position_m[5, 2], rtol=1e-6)


def rewrite(path: Path, **parameters) -> Path:
    """Write a C3D file as other programs write it."""
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
    markers, _ = recording()
    write_c3d(tmp_path / "a.c3d", markers)
    again = read_c3d(rewrite(tmp_path / "a.c3d", unseen=(7, 2)))
    unseen = np.isnan(again.position_m).all(axis=-1)
    assert np.argwhere(unseen).tolist() == [[7, 2]]


@pytest.mark.parametrize(
    ("unit", "metres"),
    [("m", 1), ("M", 1), ("dm", 0.1), ("cm", 0.01), ("um", 1e-6), ("in", 0.0254), ("ft", 0.3048)],
)
def test_units(tmp_path, unit, metres):
    markers, _ = recording()
    write_c3d(tmp_path / "a.c3d", markers)
    again = read_c3d(rewrite(tmp_path / "a.c3d", UNITS=[unit]))
    np.testing.assert_allclose(again.position_m, 1e3 * metres * markers.position_m, rtol=1e-6)


def test_an_unknown_unit(tmp_path):
    write_c3d(tmp_path / "a.c3d", recording()[0])
    with pytest.raises(InputError, match=r"a\.c3d: expected a unit of um, mm, cm, .*, found 'furlong'"):
        read_c3d(rewrite(tmp_path / "a.c3d", UNITS=["furlong"]))


def test_more_markers_than_one_parameter_holds(tmp_path):
    """A parameter holds 255 labels; further labels are in LABELS2. Recordings have many unlabelled reflections."""
    labels = (*recording()[0].labels, *(f"*{number}" for number in range(300)))
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


@pytest.mark.parametrize("part", [0.01, 0.5, 0.9])
def test_a_truncated_file(tmp_path, part):
    """ezc3d reads a truncated file without an error."""
    path = tmp_path / "a.c3d"
    write_c3d(path, recording(num_frames=400)[0])
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(InputError, match=r"a\.c3d: expected (a C3D file|400 frames)"):
        read_c3d(path)


def test_the_largest_number_of_frames_in_the_header(tmp_path):
    """16 bits end at 65,535, which is 11 minutes at 100 Hz; ezc3d drops further frames without an error."""
    markers = Markers(("Dron1:1",), np.ones((65_535, 1, 3)), 100.0)
    write_c3d(tmp_path / "a.c3d", markers)
    assert len(read_c3d(tmp_path / "a.c3d").position_m) == 65_535
    more = Markers(("Dron1:1",), np.ones((65_536, 1, 3)), 100.0)
    with pytest.raises(SettingsError, match="expected at most 65535 frames in a C3D file, found 65536"):
        write_c3d(tmp_path / "a.c3d", more)


def test_video_frames_are_every_fourth():
    markers, centroid_m = recording()
    truth = body_trajectories(markers, fps=25.0, num_frames=9, where=WHERE)
    assert truth.drones == ("dron2", "dron10")  # by number, though `dron10` sorts first as text
    # Sums of 5 doubles in two orders.
    np.testing.assert_allclose(truth.position_m, centroid_m[0:36:4], rtol=0, atol=1e-12)
    np.testing.assert_allclose(truth.time_s, np.arange(9) / 25)


def test_a_shorter_recording_leaves_nan():
    markers, _ = recording(num_frames=17)
    truth = body_trajectories(markers, fps=25.0, num_frames=9, where=WHERE)
    assert truth.seen[:, 0].tolist() == [True] * 5 + [False] * 4


def test_an_unseen_marker_does_not_move_the_position():
    """The centroid of the seen markers would be centimetres off."""
    markers, centroid_m = recording()
    markers.position_m[5:20, 6] = np.nan
    truth = body_trajectories(markers, fps=25.0, num_frames=9, where=WHERE)
    # Rounding of fits in double precision.
    np.testing.assert_allclose(truth.position_m, centroid_m[0:36:4], rtol=0, atol=1e-9)
    assert (truth.status == Status.TRACKED).all()


def test_the_cross_turns_with_its_body():
    """The drones of `recording` do not turn, so that the orientations of their crosses are constant and upright."""
    truth = body_trajectories(recording()[0], fps=25.0, num_frames=9, where=WHERE)
    turn = Rotation.from_quat(truth.orientation_wxyz.reshape(-1, 4), scalar_first=True)
    # An angle of 1e-8 has the cosine 1 in double precision.
    assert (turn[0].inv() * turn).magnitude().max() < 1e-7


def test_gaps_are_bridged_and_flagged_or_stay():
    """dron2 has a gap of 0.3 s; dron10 has a gap of 0.6 s, because two of its five markers determine no pose."""
    markers, centroid_m = recording(num_frames=141)
    markers.position_m[40:70, :5] = np.nan
    markers.position_m[40:100, 5:8] = np.nan
    truth = body_trajectories(markers, fps=25.0, num_frames=36, where=WHERE)
    assert np.flatnonzero(truth.status[:, 0] == Status.COASTING).tolist() == [*range(10, 18)]
    assert np.flatnonzero(~truth.seen[:, 1]).tolist() == [*range(10, 25)]
    assert np.isnan(truth.position_m[10:25, 1]).all()
    assert np.isnan(truth.orientation_wxyz[10:25, 1]).all()
    assert (truth.status[10:25, 1] == Status.LOST).all()
    assert (truth.status == Status.TRACKED).sum() == 2 * 36 - 8 - 15
    # A cubic has the error T^4 / 384 times 16 m/s^4, and T / 8 times the error of its slopes, 0.01 s^2 / 10 times
    # 8 m/s^3: 0.6 mm in total.
    np.testing.assert_allclose(truth.position_m[:, 0], centroid_m[::4, 0], rtol=0, atol=1e-3)


def test_swapped_and_lost_labels():
    markers, centroid_m = recording()
    lost = Markers((*markers.labels, "*3", "Dron10:*4"), np.full((41, 12, 3), np.nan), 100.0)
    lost.position_m[:, :10] = markers.position_m
    lost.position_m[8, [0, 1]] = markers.position_m[8, [1, 0]]
    lost.position_m[12:20, [5, 6, 7]] = np.nan
    lost.position_m[12:20, [10, 11]] = markers.position_m[12:20, [7, 5]]
    truth = body_trajectories(lost, fps=25.0, num_frames=9, where=WHERE)
    assert truth.drones == ("dron2", "dron10")
    np.testing.assert_allclose(truth.position_m, centroid_m[0:36:4], rtol=0, atol=1e-9)
    assert (truth.status == Status.TRACKED).all()


def test_a_drone_whose_markers_are_never_seen_together_is_lost(caplog):
    markers, centroid_m = recording()
    markers.position_m[:20, 0] = np.nan
    markers.position_m[20:, 1:5] = np.nan
    truth = body_trajectories(markers, fps=25.0, num_frames=9, where=WHERE)
    assert (
        "R01_D2.c3d: no reference for dron2: cross dron2: expected every two markers seen together"
        in caplog.text
    )
    assert np.isnan(truth.position_m[:, 0]).all()
    np.testing.assert_allclose(truth.position_m[:, 1], centroid_m[0:36:4, 1], rtol=0, atol=1e-9)


def test_a_marker_that_was_never_seen_does_not_count():
    markers, _ = recording()
    markers.position_m[:, 4] = np.nan
    truth = body_trajectories(markers, fps=25.0, num_frames=9, where=WHERE)
    assert truth.seen.all()
    np.testing.assert_allclose(
        truth.position_m[:, 0], markers.position_m[0:36:4, :4].mean(axis=1), rtol=0, atol=1e-12
    )


def test_labels_without_a_colon_are_one_drone():
    markers, centroid_m = recording(drones=("Dron2",))
    stray = np.full((41, 1, 3), 9.0)
    plain = Markers(
        ("A", "B", "C", "D", "E", "*7"), np.concatenate([markers.position_m, stray], axis=1), 100.0
    )
    truth = body_trajectories(plain, fps=25.0, num_frames=9, where=WHERE)
    assert truth.drones == ("dron1",)
    np.testing.assert_allclose(truth.position_m[:, 0], centroid_m[0:36:4, 0], rtol=0, atol=1e-12)


def test_bodies_beside_the_drones_are_left_out():
    markers, _ = recording(drones=("Dron1", "Wand"))
    stray = Markers((*markers.labels, "*12"), np.pad(markers.position_m, ((0, 0), (0, 1), (0, 0))), 100.0)
    truth = body_trajectories(stray, fps=25.0, num_frames=9, where=WHERE)
    assert truth.drones == ("dron1",)


@pytest.mark.parametrize("rate_hz", [100.0, 25.0, 119.88, 120.0, 240.0, 59.94])
@pytest.mark.parametrize("fps", [25.0, 29.97, 30.0])
def test_any_rate(rate_hz, fps):
    markers, _ = recording(num_frames=200, rate_hz=rate_hz)
    truth = body_trajectories(markers, fps=fps, num_frames=20, where=WHERE)
    t = np.arange(20)[:, None] / fps
    path = np.hstack([np.sin(t), np.cos(2 * t), 1 + 0.3 * t]) + CROSS_M.mean(axis=0)
    # The interpolation error is dt^2 / 8 times 4 m/s^2, at 25 Hz 0.8 mm; these rates have no rounding.
    np.testing.assert_allclose(truth.position_m[:, 0], path, rtol=0, atol=1e-3 * (25 / rate_hz) ** 2 + 1e-9)


def test_rates_that_were_rounded_stay_in_step():
    """A rate of 25.001 Hz would be a frame ahead after 17 minutes; as every fourth frame it stays in step."""
    markers, centroid_m = recording(num_frames=400)
    truth = body_trajectories(markers, fps=25.001, num_frames=100, where=WHERE)
    np.testing.assert_allclose(truth.position_m, centroid_m[::4], rtol=0, atol=1e-9)


@pytest.mark.parametrize(("offset_s", "first"), [(0.0, 0), (0.2, 0), (-0.1, 3), (-0.08, 2)])
def test_a_recording_that_began_at_another_time(offset_s, first):
    markers, _ = recording(num_frames=100)
    truth = body_trajectories(markers, fps=25.0, num_frames=9, where=WHERE, offset_s=offset_s)
    assert np.flatnonzero(truth.seen[:, 0])[0] == first
    t = np.arange(first, 9)[:, None] / 25 + offset_s
    path = np.hstack([np.sin(t), np.cos(2 * t), 1 + 0.3 * t]) + CROSS_M.mean(axis=0)
    # Offsets of whole frames: no interpolation.
    np.testing.assert_allclose(truth.position_m[first:, 0], path, rtol=0, atol=1e-9)


def test_nothing_seen_is_an_error():
    markers, _ = recording()
    markers.position_m[:] = np.nan
    with pytest.raises(
        InputError, match="expected three markers of a drone in some frame of the video, found none"
    ):
        body_trajectories(markers, fps=25.0, num_frames=9, where=WHERE)


def test_labels_must_match_the_markers():
    with pytest.raises(SettingsError, match=re.escape("expected positions of shape (frames, 1, 3)")):
        Markers(("a",), np.zeros((3, 2, 3)), 100.0)


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"a\.c3d"):
        write_c3d(tmp_path / "file" / "a.c3d", recording()[0])


def test_a_full_disk_is_an_error(tmp_path):
    """A limit of the file size simulates the full disk; ezc3d reports no error in either case."""
    script = textwrap.dedent(
        """
        import resource, sys
        from pathlib import Path
        import numpy as np
        from psotrack.errors import OutputError
        from psotrack.recordings.c3d import Markers, write_c3d
        sys.dont_write_bytecode = True  # a cached module would be cut off too, for everybody
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
