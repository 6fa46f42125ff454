"""Motion capture: C3D files, markers that come and go, and the rates of recordings and videos."""

import re
import subprocess
import sys
import textwrap
from pathlib import Path

import ezc3d
import numpy as np
import pytest

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.mocap import Markers, body_trajectories, read_c3d, write_c3d

#: An asymmetric cross, metres, in the body.
CROSS_M = np.array([[0.2, 0, 0.05], [-0.15, 0, 0.05], [0, 0.18, 0.05], [0, -0.12, 0.05], [0.05, 0.05, 0.09]])
WHERE = Path("R01_D2.c3d")


def recording(num_frames=41, drones=("Dron2", "Dron10"), rate_hz=100.0) -> tuple[Markers, np.ndarray]:
    """Markers of drones on curves, and the centroids, (frames, drones, 3)."""
    t = np.arange(num_frames)[:, None] / rate_hz
    paths = [np.hstack([i + np.sin(t + i), np.cos(2 * t), 1 + 0.3 * t]) for i in range(len(drones))]
    position_m = np.concatenate([path[:, None] + CROSS_M for path in paths], axis=1)
    labels = tuple(f"{drone}:{drone}{i + 1}" for drone in drones for i in range(len(CROSS_M)))
    return Markers(labels, position_m, rate_hz), np.stack(paths, axis=1) + CROSS_M.mean(axis=0)


def test_round_trip_with_ezc3d_as_witness(tmp_path):
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
    """A C3D file as another program may have written it."""
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


def test_metres(tmp_path):
    markers, _ = recording()
    write_c3d(tmp_path / "a.c3d", markers)
    again = read_c3d(rewrite(tmp_path / "a.c3d", UNITS=["m"]))
    np.testing.assert_allclose(again.position_m, 1e3 * markers.position_m, rtol=1e-6)


def test_an_unknown_unit(tmp_path):
    write_c3d(tmp_path / "a.c3d", recording()[0])
    with pytest.raises(InputError, match=r"a\.c3d: expected a unit of mm, cm, m, found 'inch'"):
        read_c3d(rewrite(tmp_path / "a.c3d", UNITS=["inch"]))


@pytest.mark.parametrize(
    ("content", "found"), [(None, "no such file"), (b"", "empty"), (b"hello " * 400, "valid c3d")]
)
def test_no_c3d(tmp_path, content, found):
    if content is not None:
        (tmp_path / "a.c3d").write_bytes(content)
    with pytest.raises(InputError, match=rf"a\.c3d: expected a C3D file, found .*{found}"):
        read_c3d(tmp_path / "a.c3d")


@pytest.mark.parametrize("part", [0.01, 0.5, 0.9])
def test_a_truncated_file(tmp_path, part):
    """ezc3d reads what is there, and says nothing."""
    path = tmp_path / "a.c3d"
    write_c3d(path, recording(num_frames=400)[0])
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with pytest.raises(InputError, match=r"a\.c3d: expected (a C3D file|400 frames)"):
        read_c3d(path)


def test_as_many_frames_as_the_header_can_count(tmp_path):
    """Its two bytes end at 65,535, 11 minutes at 100 Hz; ezc3d drops the rest and says nothing."""
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
    # The sums of 5 doubles, in two orders.
    np.testing.assert_allclose(truth.position_m, centroid_m[0:36:4], rtol=0, atol=1e-12)
    np.testing.assert_allclose(truth.time_s, np.arange(9) / 25)


def test_a_shorter_recording_leaves_nan():
    markers, _ = recording(num_frames=17)
    truth = body_trajectories(markers, fps=25.0, num_frames=9, where=WHERE)
    assert truth.seen[:, 0].tolist() == [True] * 5 + [False] * 4


def test_a_marker_unseen_takes_the_position():
    """The centroid of the others would lie centimetres off."""
    markers, centroid_m = recording()
    markers.position_m[8, 6] = np.nan
    truth = body_trajectories(markers, fps=25.0, num_frames=9, where=WHERE)
    assert np.argwhere(~truth.seen).tolist() == [[2, 1]]
    np.testing.assert_allclose(truth.position_m[2, 0], centroid_m[8, 0], rtol=0, atol=1e-12)


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


@pytest.mark.parametrize(
    ("rate_hz", "fps", "fits"),
    [
        (100.0, 25.0, True),
        (25.0, 25.0, True),
        (119.88, 29.97, True),
        (120.0, 29.97, False),
        (100.0, 30.0, False),
        (10.0, 25.0, False),
    ],
)
def test_rates_must_fit(rate_hz, fps, fits):
    markers, _ = recording(rate_hz=rate_hz)
    if fits:
        assert body_trajectories(markers, fps=fps, num_frames=5, where=WHERE).num_frames == 5
        return
    message = rf"R01_D2\.c3d: expected a rate that is a whole multiple .* found {rate_hz:g} Hz"
    with pytest.raises(InputError, match=message):
        body_trajectories(markers, fps=fps, num_frames=5, where=WHERE)


def test_nothing_seen_is_an_error():
    markers, _ = recording()
    markers.position_m[:] = np.nan
    with pytest.raises(InputError, match="expected frames that see all markers of a drone, found none"):
        body_trajectories(markers, fps=25.0, num_frames=9, where=WHERE)


def test_labels_must_match_the_markers():
    with pytest.raises(SettingsError, match=re.escape("expected positions of shape (frames, 1, 3)")):
        Markers(("a",), np.zeros((3, 2, 3)), 100.0)


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"a\.c3d"):
        write_c3d(tmp_path / "file" / "a.c3d", recording()[0])


def test_a_full_disk_is_an_error(tmp_path):
    """A file size limit stands for the full disk; ezc3d says nothing of either."""
    script = textwrap.dedent(
        """
        import resource, sys
        from pathlib import Path
        import numpy as np
        from psotrack.errors import OutputError
        from psotrack.mocap import Markers, write_c3d
        sys.dont_write_bytecode = True  # a cached module would be cut off too, for everybody
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
        try:
            write_c3d(Path(sys.argv[1]), Markers(("Dron1:1",), np.ones((5_000, 1, 3)), 100.0))
        except OutputError as error:
            print(error)
        """
    )
    path = tmp_path / "a.c3d"
    done = subprocess.run([sys.executable, "-c", script, path], capture_output=True, text=True, timeout=60)
    assert "a.c3d: expected to write it" in done.stdout, done.stderr
    assert list(tmp_path.iterdir()) == []
