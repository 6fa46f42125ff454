"""The path of a moving camera: its angles are compared with SciPy's, and its table is written and read."""

import numpy as np
import pytest
from camera_paths import example_path
from scipy.spatial.transform import Rotation

from psotrack.inside_out import CameraPath, read_camera_path, write_camera_path
from psotrack.trajectories import read_trajectories, roll_pitch_yaw_deg

#: (3, 3), columns are the axes (right, down, ahead) of a camera that looks along the world's x axis.
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def test_angles_equal_those_of_scipy_straight_down_too() -> None:
    orientation = Rotation.random(200, rng=np.random.default_rng(5))
    found = roll_pitch_yaw_deg(orientation.as_quat(scalar_first=True).reshape(50, 4, 4)).reshape(-1, 3)
    body = Rotation.from_matrix(orientation.as_matrix() @ AHEAD.T)
    # Near a pitch of 90 degrees, angles lose half of their digits.
    np.testing.assert_allclose(found, body.as_euler("ZYX", degrees=True)[:, ::-1], atol=1e-6)
    down = Rotation.from_matrix(Rotation.from_rotvec([0, 90.0, 0], degrees=True).as_matrix() @ AHEAD)
    found = roll_pitch_yaw_deg(np.stack([down.as_quat(scalar_first=True), np.full(4, np.nan)]))
    # arcsin near 1 loses half of the digits.
    assert found[0, 1] == pytest.approx(90, abs=1e-5)
    assert np.isnan(found[1]).all()


@pytest.mark.parametrize("with_velocity", [True, False])
def test_a_table_is_read_as_it_was_written_also_by_the_reader_of_tracks(tmp_path, with_velocity) -> None:
    written = example_path(with_velocity)
    write_camera_path(tmp_path / "path.csv", written, "dron2")
    read, name = read_camera_path(tmp_path / "path.csv")
    assert name == "dron2"
    for field in CameraPath.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(read, field), getattr(written, field), err_msg=field)
    tracks, own = read_trajectories(tmp_path / "path.csv"), written.trajectories("dron2")
    assert tracks.drones == ("dron2",)
    for field in ("position_m", "seen", "covariance_m2"):
        np.testing.assert_array_equal(getattr(tracks, field), getattr(own, field), err_msg=field)
    np.testing.assert_array_equal(tracks.seen[:, 0], written.seen)
