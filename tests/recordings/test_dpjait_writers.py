"""Round trips through the writers and readers of the dataset's file layout: rigs, poses, markers."""

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.geometry import Rig, make_camera, make_rig, project
from psotrack.geometry.rig_files import read_rig, write_calibration
from psotrack.recordings.datasets import (
    MARKER_CORNERS,
    pose_file,
    read_marker_corners,
    read_poses,
    write_marker_corners,
    write_poses,
)

finite = st.floats(-50, 50)
triples = st.tuples(finite, finite, finite)
#: All rotations, and rotations near half a turn, where the Rodrigues vector is nearly ambiguous.
rotations = st.one_of(
    st.tuples(*[st.floats(-4, 4)] * 3).map(Rotation.from_rotvec),
    st.tuples(*[st.floats(-1e-9, 1e-9)] * 3).map(
        lambda small: Rotation.from_rotvec(np.array([np.pi, 0, 0]) + small)
    ),
)
SIZE_WH = (1920, 1080)


def make_test_rig(poses, dist=(), focal_length_px=1156.3) -> Rig:
    cameras = {}
    for index, (rotation, t_m) in enumerate(poses):
        f = focal_length_px + 10 * index
        cameras[f"cam{index + 1}i"] = make_camera(
            R=rotation.as_matrix(),
            t_m=np.array(t_m),
            K=np.array([[f, 0, 960.25], [0, f, 540 + index], [0, 0, 1]]),
            image_size_wh=SIZE_WH,
            dist=dist,
        )
    return make_rig(cameras)


def read_back(path: Path, rig: Rig) -> Rig:
    return read_rig(path, SIZE_WH)


@given(
    poses=st.lists(st.tuples(rotations, triples), min_size=1, max_size=5),
    dist=st.one_of(st.just(()), st.tuples(*[st.floats(-0.5, 0.5)] * 4)),
    unit=st.sampled_from(["m", "mm"]),
)
def test_a_written_rig_is_read_back(tmp_path_factory, poses, dist, unit):
    path = tmp_path_factory.getbasetemp() / "cameras_calibration.csv"
    rig = make_test_rig(poses, dist)
    write_calibration(path, rig, unit)
    again = read_back(path, rig)
    assert again.names == rig.names
    # Rotations are converted to vectors and back, lengths to millimetres and back, which rounds doubles up to 50.
    np.testing.assert_allclose(again.cameras.T_cam_world, rig.cameras.T_cam_world, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(again.cameras.K, rig.cameras.K)
    coefficients = again.cameras.dist.shape[-1]
    assert coefficients == (4 if any(dist) else 0)
    np.testing.assert_array_equal(again.cameras.dist, rig.cameras.dist[:, :coefficients])


@given(poses=st.lists(st.tuples(rotations, triples), min_size=1, max_size=3), point=triples)
def test_a_rig_that_is_read_back_projects_to_the_same_pixels(tmp_path_factory, poses, point):
    path = tmp_path_factory.getbasetemp() / "cameras_calibration.csv"
    rig = make_test_rig(poses, (-0.1, 0.02, 0.001, -0.002))
    write_calibration(path, rig, "mm")
    points_m = np.tile(point, (len(rig), 1))
    pixels_before, depth_m = project(rig.cameras, points_m)
    pixels_after, _ = project(read_back(path, rig).cameras, points_m)
    # Points far outside the image are left out, because the lens polynomial is not valid there.
    compared = (depth_m > 0.5) & (np.abs(pixels_before) < 1e4).all(axis=-1)
    np.testing.assert_allclose(pixels_after[compared], pixels_before[compared], rtol=0, atol=1e-6)


def test_the_header_is_the_published_one(tmp_path):
    path = tmp_path / "cameras_calibration.csv"
    poses = [(Rotation.identity(), (1.0, 2.0, 3.0))]
    write_calibration(path, make_test_rig(poses))
    assert path.read_text().splitlines() == [
        "cam_name;cam_x[m];cam_y[m];cam_z[m];cam_or_x[rad];cam_or_y[rad];cam_or_z[rad];focal_length;cx;cy",
        "cam1i;1.0;2.0;3.0;0.0;0.0;0.0;1156.3;960.25;540.0",
    ]
    write_calibration(path, make_test_rig(poses, (0.1, 0.0, 0.0, 0.0)), "mm")
    assert path.read_text().splitlines() == [
        "cam_name;cam_x[mm];cam_y[mm];cam_z[mm];cam_or_x[rad];cam_or_y[rad];cam_or_z[rad];focal_length;cx;cy"
        ";coeff_1;coeff_2;coeff_3;coeff_4",
        "cam1i;1000.0;2000.0;3000.0;0.0;0.0;0.0;1156.3;960.25;540.0;0.1;0.0;0.0;0.0",
    ]


def test_rigs_that_the_file_format_cannot_hold_are_refused(tmp_path):
    """The message names the camera, not the first one but the one that the file cannot hold."""
    path = tmp_path / "cameras_calibration.csv"

    def lens(K, dist=(), fisheye=False):
        return make_camera(
            R=np.eye(3), t_m=np.zeros(3), K=K, image_size_wh=SIZE_WH, dist=dist, fisheye=fisheye
        )

    plain = np.array([[1000, 0, 960], [0, 1000, 540], [0, 0, 1.0]])
    sound = lens(plain, (0.1, 0.0, 0.0, 0.0, 0.0))
    # A fifth coefficient of zero can be left out.
    write_calibration(path, make_rig({"a": sound}))
    for other, message in (
        (lens(plain, (0.1, 0.0, 0.0, 0.0, 0.01)), "distortion by k1, k2, p1, p2 alone, found 5 coefficients"),
        (lens(plain + np.diag([0, 1.0, 0])), "one focal length, found fx 1000 and fy 1001"),
        (lens(plain + np.eye(3, k=1) * [0, 2.5, 0]), "no skew, found 2.5"),
        (lens(plain, fisheye=True), "OpenCV's pinhole model, found a fisheye"),
    ):
        with pytest.raises(SettingsError, match=rf"^camera GoPro 3: expected {message}; .*rig\.toml"):
            write_calibration(path, make_rig({"a": sound, "GoPro 3": other, "z": other}))


def test_a_failed_write_leaves_the_file(tmp_path):
    path = tmp_path / "file" / "cameras_calibration.csv"
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cameras_calibration"):
        write_calibration(path, make_test_rig([(Rotation.identity(), (0.0, 0.0, 5.0))]))


@given(poses=st.lists(st.tuples(triples, rotations), min_size=2, max_size=9))
def test_written_poses_are_read_back(tmp_path_factory, poses):
    path = tmp_path_factory.getbasetemp() / pose_file(1)
    position_m = np.array([position for position, _ in poses])
    rotation = Rotation.concatenate([rotation for _, rotation in poses])
    write_poses(path, position_m, rotation.as_quat(scalar_first=True))
    position_again_m, orientation_again_wxyz = read_poses(path)
    assert np.isnan(position_again_m[0]).all()
    assert np.isnan(orientation_again_wxyz[0]).all()
    np.testing.assert_array_equal(position_again_m[1:], position_m[1:])
    again = Rotation.from_quat(orientation_again_wxyz[1:], scalar_first=True)
    # The reader normalises the quaternion, which rounds it.
    assert (again * rotation[1:].inv()).magnitude().max() < 1e-12
    # The Euler angles in the file are the same rotation: R = Rz Ry Rx.
    with path.open() as file:
        rows = list(csv.DictReader(file, delimiter=";"))[1:]
    angles_rad = np.array([[float(row[f"rot_{axis}[rad]"]) for axis in "xyz"] for row in rows])
    Rx, Ry, Rz = (Rotation.from_rotvec(np.eye(3)[axis] * angles_rad[:, axis : axis + 1]) for axis in range(3))
    # Near gimbal lock, Euler angles lose half of their digits: the error is up to 1e-7 rad.
    assert ((Rz * Ry * Rx) * rotation[1:].inv()).magnitude().max() < 1e-6


def test_the_first_row_is_the_placeholder(tmp_path):
    path = tmp_path / "dron1_pos_25.csv"
    write_poses(path, np.ones((2, 3)), np.tile([1.0, 0, 0, 0], (2, 1)))
    assert path.read_text().splitlines() == [
        "id;pos_x[m];pos_y[m];pos_z[m];rot_x[rad];rot_y[rad];rot_z[rad];q_w;q_x;q_y;q_z",
        "0;0.0;0.0;-0.0;0.0;0.0;0.0;1.0;0.0;0.0;0.0",
        "1;1.0;1.0;1.0;0.0;0.0;0.0;1.0;0.0;0.0;0.0",
    ]


def test_poses_that_cannot_be_written(tmp_path):
    path = tmp_path / "dron1_pos_25.csv"
    upright = np.tile([1.0, 0, 0, 0], (3, 1))
    position_m = np.ones((3, 3))
    position_m[2, 1] = np.nan
    with pytest.raises(
        SettingsError, match="poses: expected finite numbers, found NaN or infinity at frame 2"
    ):
        write_poses(path, position_m, upright)
    with pytest.raises(SettingsError, match="expected equal numbers of positions and orientations"):
        write_poses(path, np.ones((0, 3)), np.ones((0, 4)))
    assert not path.exists()


def test_a_first_row_with_a_pose_is_a_pose(tmp_path):
    path = tmp_path / "dron1_pos_25.csv"
    path.write_text("id;pos_x[m];pos_y[m];pos_z[m]\n0;1;2;3\n1;1;2;3\n")
    position_m, orientation_wxyz = read_poses(path)
    assert position_m.tolist() == [[1, 2, 3]] * 2
    assert orientation_wxyz is None


@given(
    corners=st.dictionaries(
        st.integers(0, 999), st.lists(triples, min_size=4, max_size=4).map(np.array), min_size=1, max_size=5
    )
)
def test_written_marker_corners_are_read_back(tmp_path_factory, corners):
    path = tmp_path_factory.getbasetemp() / MARKER_CORNERS
    write_marker_corners(path, corners)
    again = read_marker_corners(path)
    assert set(again) == set(corners)
    for marker, corners_m in corners.items():
        np.testing.assert_array_equal(again[marker], corners_m)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("7;", "5;", "line 3, column id: expected each marker once, found 5 again"),
        ("z4[m]", "z5[m]", "expected a column z4"),
        ("7;0.5", "7;nan", r"line 3, column x1\[m\]: expected a finite number"),
    ],
)
def test_broken_marker_corners(tmp_path, old, new, message):
    path = tmp_path / MARKER_CORNERS
    write_marker_corners(path, {5: np.zeros((4, 3)), 7: np.full((4, 3), 0.5)})
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        read_marker_corners(path)
