"""The path of a moving camera: its angles are compared with SciPy's, and its table is written and read."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.inside_out import CameraPath, Flag, read_camera_path, write_camera_path
from psotrack.trajectories import Status, read_trajectories, roll_pitch_yaw_deg

#: (3, 3), columns are the axes (right, down, ahead) of a camera that looks along the world's x axis.
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def example_path(with_velocity: bool = True) -> CameraPath:
    """Path of six frames with random poses and all kinds of status and flags; frame 5 has no pose."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6, 6))
    covariance = root @ root.swapaxes(-1, -2)
    path = CameraPath(
        frame=np.array([0, 1, 2, 4, 5, 6]),
        time_s=np.array([0.0, 0.04, 0.08, 0.16, 0.2, 0.24]),
        position_m=rng.normal(size=(6, 3)),
        orientation_wxyz=Rotation.random(6, rng=rng).as_quat(scalar_first=True),
        covariance=(covariance + covariance.swapaxes(-1, -2)) / 2,
        num_markers=np.array([4, 5, 1, 0, 0, 7]),
        reprojection_px=np.array([0.1, 0.2, 0.3, np.nan, np.nan, 0.4]),
        ambiguity=np.array([0.0, 0.0, 0.3, np.nan, np.nan, 0.0]),
        status=np.array([Status.TRACKED] * 3 + [Status.COASTING, Status.LOST, Status.TRACKED]),
        flags=np.array([0, 0, Flag.FEW_MARKERS | Flag.AMBIGUOUS, Flag.GATED, 0, 0]),
        velocity_m_s=rng.normal(size=(6, 3)) if with_velocity else None,
    )
    for values in (path.position_m, path.orientation_wxyz, path.covariance):
        values[4] = np.nan
    return path


@pytest.mark.parametrize(
    ("turn", "expected_deg"),
    [
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
        # About the world's z axis, counterclockwise as seen from above.
        ([0.0, 0.0, 30.0], [0.0, 0.0, 30.0]),
        # About the world's y axis, which points to the body's left: the nose goes down.
        ([0.0, 20.0, 0.0], [0.0, 20.0, 0.0]),
        # About the world's x axis, which points ahead: the right side goes down.
        ([10.0, 0.0, 0.0], [10.0, 0.0, 0.0]),
        ([0.0, 0.0, 180.0], [0.0, 0.0, 180.0]),
    ],
)
def test_angles_of_a_camera_turned_from_the_x_axis(turn, expected_deg) -> None:
    turned = Rotation.from_rotvec(turn, degrees=True).as_matrix() @ AHEAD
    found = roll_pitch_yaw_deg(Rotation.from_matrix(turned).as_quat(scalar_first=True))
    # Rounding of angles below 180 degrees; 180 and -180 degrees are the same angle.
    np.testing.assert_allclose((found - expected_deg + 180) % 360 - 180, 0, atol=1e-12)


def test_angles_equal_those_of_scipy() -> None:
    rng = np.random.default_rng(5)
    orientation = Rotation.random(200, rng=rng)
    found = roll_pitch_yaw_deg(orientation.as_quat(scalar_first=True).reshape(50, 4, 4)).reshape(-1, 3)
    body = Rotation.from_matrix(orientation.as_matrix() @ AHEAD.T)
    # Near a pitch of 90 degrees, angles lose half of their digits.
    np.testing.assert_allclose(found, body.as_euler("ZYX", degrees=True)[:, ::-1], atol=1e-6)


def test_angles_straight_down_and_without_a_pose() -> None:
    down = Rotation.from_rotvec([0.0, 90.0, 0.0], degrees=True).as_matrix() @ AHEAD
    wxyz = np.stack([Rotation.from_matrix(down).as_quat(scalar_first=True), np.full(4, np.nan)])
    found = roll_pitch_yaw_deg(wxyz)
    # arcsin near 1 loses half of the digits.
    assert found[0, 1] == pytest.approx(90, abs=1e-5)
    assert np.isnan(found[1]).all()


@pytest.mark.parametrize("with_velocity", [True, False])
def test_a_table_is_read_as_it_was_written(tmp_path: Path, with_velocity: bool) -> None:
    written = example_path(with_velocity)
    write_camera_path(tmp_path / "path.csv", written, "dron2")
    read, name = read_camera_path(tmp_path / "path.csv")
    assert name == "dron2"
    for field in CameraPath.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(read, field), getattr(written, field), err_msg=field)


def test_the_reader_of_tracks_reads_the_table(tmp_path: Path) -> None:
    written = example_path()
    write_camera_path(tmp_path / "path.csv", written, "dron2")
    tracks, own = read_trajectories(tmp_path / "path.csv"), written.trajectories("dron2")
    assert tracks.drones == ("dron2",)
    np.testing.assert_array_equal(tracks.position_m, own.position_m)
    np.testing.assert_array_equal(tracks.seen, own.seen)
    np.testing.assert_array_equal(tracks.seen[:, 0], written.seen)
    np.testing.assert_array_equal(tracks.covariance_m2, own.covariance_m2)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("few_markers+ambiguous", "few", r"line 4, column flags: .*few_markers"),
        ("coasting", "gone", r"line 5: expected one of .*coasting.* in status"),
        ("qw", "w", r"path.csv: .*orientations"),
        ("dron2", "dron3", r"path.csv: .*one drone"),
    ],
)
def test_invalid_values_are_refused_with_their_line(
    tmp_path: Path, before: str, after: str, message: str
) -> None:
    path = tmp_path / "path.csv"
    write_camera_path(path, example_path(), "dron2")
    path.write_text(path.read_text().replace(before, after, 1))
    with pytest.raises(InputError, match=message):
        read_camera_path(path)


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("qw", "1e-320", r"line 2: expected a unit quaternion in qw, qx, qy, qz, found length 0"),
        ("qx", "3", r"line 2: expected a unit quaternion in qw, qx, qy, qz, found length 3"),
        (
            "cov_zz",
            "-9e8",
            r"line 2: expected a covariance in cov_xx, cov_xy, .* found a matrix",
        ),
        (
            "cov_xa",
            "1e9",
            r"line 2, column cov_xx: expected a covariance in cov_xx to cov_cc, found a matrix",
        ),
        ("time_s", "", r"line 2: expected a time_s"),
        ("time_s", "0.04", r"line 3: expected a time after 0.04 s"),
    ],
)
def test_poses_that_cannot_be_are_refused(tmp_path: Path, column: str, value: str, message: str) -> None:
    path = tmp_path / "path.csv"
    write_camera_path(path, example_path(), "dron2")
    table = pd.read_csv(path, dtype=str)
    if column.startswith("q"):
        table.loc[0, ["qw", "qx", "qy", "qz"]] = "0"
    table.loc[0, column] = value
    table.to_csv(path, index=False)
    with pytest.raises(InputError, match=message):
        read_camera_path(path)
