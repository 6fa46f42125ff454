"""Files of other programs, made after the documents of their formats; each is projected by a formula of its own."""

import contextlib
import re

import cv2
import numpy as np
import pytest
from helpers import assert_same
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from rig_texts import (
    RADTAN,
    SIZE_WH,
    K,
    dlt_columns,
    dlt_file,
    easymocap_files,
    handpose_files,
    json_file,
    kalibr_file,
    lists,
    matrix,
    pose2sim_file,
    poses,
    qualisys_file,
    ros_text,
    storage_files,
    vicon_file,
    with_skew,
)
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.geometry import look_at, make_camera, make_rig, project, undistort
from psotrack.geometry.rig_files import RIG_FORMATS, read_lenses, read_rig, write_rig

#: Points in front of all cameras of this file, metres.
POINTS_M = np.array([[0.3, -0.2, 0.9], [-0.4, 0.5, 1.4], [0.0, 0.1, 0.2], [1.1, 0.8, 1.9]])


def by_opencv(R, t_m, K, dist, *, fisheye=False):
    function = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    return function(POINTS_M[:, None], cv2.Rodrigues(R)[0], t_m, K, np.array(dist))[0][:, 0]


def caliscopes_older_file(path):
    """Matrices of rotation, and tables of other content."""
    tables = [
        f"[cam_{index}]\ncam_id = {index}\nrotation_count = 0\nsize = [1280, 720]\nmatrix = {lists(K)}\n"
        f"distortions = {lists((*RADTAN, 0))}\ntranslation = {lists(t)}\nrotation = {lists(R)}\n"
        for index, (R, t) in enumerate(poses())
    ]
    other = '[charuco]\ncolumns = 4\nunits = "inch"\n'
    path.write_text(f"CreationDate = 2023-05-06T11:12:27\ncamera_count = 0\n{''.join(tables)}{other}")


UNIT = {"metres_per_unit": 1.0}
#: File to read, what writes it (or the files of its folder), arguments of the reader, names of the cameras.
FORMATS = [
    ("Calib_board.toml", pose2sim_file, {}, ("cam01", "int_cam02_img")),
    ("config.toml", caliscopes_older_file, {}, ("0", "1")),
    *(
        (name, lambda path: storage_files(path.parent), {"image_size_wh": SIZE_WH} | UNIT, ("cam1", "cam2"))
        for name in ("intrinsics.yml", "extrinsics.yml", "extrinsics.xml")
    ),
    ("rig.json", lambda path: json_file(path.parent), UNIT, ("6-0", "left")),
    ("session.qca.txt", qualisys_file, {}, ("26578", "26579")),
    ("intri.yml", lambda path: easymocap_files(path.parent), {}, ("1", "07")),
    (
        "extri.yml",
        lambda path: easymocap_files(path.parent, rodrigues=False, size=False),
        {"image_size_wh": SIZE_WH},
        ("1", "07"),
    ),
    ("camchain.yaml", kalibr_file, {}, ("cam0", "cam1")),
    ("fisheye.yaml", lambda path: kalibr_file(path, distortion_model="equidistant"), {}, ("cam0", "cam1")),
    *(
        (name, lambda path: handpose_files(path.parent), {"image_size_wh": SIZE_WH} | UNIT, ("cam0", "cam1"))
        for name in ("c0.dat", "rot_trans_c1.dat")
    ),
]


@pytest.mark.parametrize(("file", "write", "options", "names"), FORMATS)
def test_cameras_project_as_opencv_does(tmp_path, file, write, options, names):
    write(tmp_path / file)
    rig = read_rig(tmp_path / file, **options)
    assert rig.names == names
    assert rig.cameras.image_size_wh.tolist() == [[1280, 720]] * 2
    R1, t1 = poses()[0]
    # In some formats, the world is the first camera.
    is_first = names in (("cam1", "cam2"), ("cam0", "cam1")) and not file.endswith(".dat")
    points_m = POINTS_M @ R1.T + t1 if is_first else POINTS_M
    for index, (R, t) in enumerate(poses()):
        expected = by_opencv(R, t, K, RADTAN, fisheye=file == "fisheye.yaml")
        np.testing.assert_allclose(project(rig.cameras[index], points_m)[0], expected, rtol=0, atol=1e-6)


def test_a_file_of_pose2sim_is_no_file_of_another_program(tmp_path):
    path = tmp_path / "Calib_board.toml"
    pose2sim_file(path)
    readable = set()
    for entry in RIG_FORMATS:
        with contextlib.suppress(InputError):
            read_rig(path, SIZE_WH, metres_per_unit=1.0, file_format=entry)
            readable.add(entry)
    assert readable == {"anipose", "caliscope", "pose2sim"}


def test_lenses_of_a_stereo_pair_need_no_second_file(tmp_path):
    storage_files(tmp_path)
    (tmp_path / "extrinsics.yml").unlink()
    assert read_lenses(tmp_path / "intrinsics.yml", SIZE_WH).names == ("cam1", "cam2")
    with pytest.raises(InputError, match="expected the poses of cameras, found none"):
        read_rig(tmp_path / "intrinsics.yml", SIZE_WH)


@pytest.mark.parametrize(("model", "fisheye"), [("plumb_bob", False), ("equidistant", True)])
def test_the_camera_info_of_ros(tmp_path, model, fisheye):
    path = tmp_path / "head.yaml"
    path.write_text(ros_text(model))
    lenses = read_lenses(path)
    assert lenses.names == ("head_camera",)
    np.testing.assert_array_equal(lenses.cameras.K[0], K)
    np.testing.assert_array_equal(lenses.cameras.dist[0], RADTAN)
    assert (lenses.cameras.fisheye is not None) == fisheye


def test_a_camera_that_qualisys_did_not_calibrate_is_left_out(tmp_path, caplog):
    path = tmp_path / "session.qca.txt"
    qualisys_file(path, ('serial="26578"', 'calibrated="false" serial="26578"'))
    assert read_rig(path).names == ("26579",)
    assert "no pose: camera 26578" in caplog.text
    assert read_lenses(path).names == ("26578", "26579")


@pytest.mark.parametrize(
    ("radial", "centre_px", "per_focal"),
    [
        # Per square pixel; Vicon's principal point is the centre.
        (f'VICON_RADIAL="{0.11 / 900**2!r} {-0.02 / 900**4!r}"', K[:2, 2], (0.11, -0.02)),
        ('VICON_RADIAL2="ViconRadial2 650.5 350.25 0.11 -0.02 0.004"', K[:2, 2], (0.11, -0.02, 0.004)),
        ('VICON_RADIAL2="ViconRadial2 653.5 349.25 0.06 -0.01"', np.array([653.5, 349.25]), (0.06, -0.01)),
    ],
)
def test_a_calibration_of_vicon(tmp_path, radial, centre_px, per_focal):
    path = tmp_path / "session.xcp"
    vicon_file(path, radial)
    rig = read_rig(path)
    assert rig.names == ("2121", "2122")
    for index, (R, t) in enumerate(poses()):
        pixels = project(rig.cameras[index], POINTS_M)[0]
        # Vicon's formula, from the distorted to the undistorted point. Distances along y are in pixels of x.
        scale = K[[0, 1], [0, 1]]
        arm = (pixels - centre_px) / scale
        r2 = (arm**2).sum(-1, keepdims=True)
        gain = 1 + sum(k * r2 ** (power + 1) for power, k in enumerate(per_focal))
        straight = by_opencv(R, t, K, np.zeros(4))
        # The fit's error is at most a tenth of a pixel, or there is a warning.
        np.testing.assert_allclose(centre_px + arm * gain * scale, straight, rtol=0, atol=0.1)


def test_cameras_of_vicon_that_record_no_video_or_were_not_calibrated(tmp_path, caplog):
    path = tmp_path / "session.xcp"
    vicon_file(path, 'VICON_RADIAL="0 0"')
    text = path.read_text().replace('TYPE="VideoInputDevice:Blackfly"', 'TYPE="VantageV5"', 1)
    path.write_text(text)
    assert read_rig(path).names == ("2122",)
    assert "1 cameras that record no video are left out" in caplog.text
    lone = '<Camera DEVICEID="9" SENSOR_SIZE="1280 720"/></Cameras>'
    path.write_text(text.replace('TYPE="VideoInputDevice:Blackfly"', 'TYPE=""').replace("</Cameras>", lone))
    assert read_rig(path).names == ("2121", "2122")
    assert "no lens: camera 9" in caplog.text


def test_a_quaternion_that_was_rounded_is_one_everywhere(tmp_path):
    """One tolerance for all files: two decimals change the length by up to 1 %."""
    path = tmp_path / "session.xcp"
    vicon_file(path, 'VICON_RADIAL="0 0"')
    turn = [0.34, 0.35, 0.72, 0.49]  # its length is 0.9983
    text = re.sub('ORIENTATION="[^"]*"', f'ORIENTATION="{" ".join(map(str, turn))}"', path.read_text())
    path.write_text(text)
    expected = Rotation.from_quat(turn).as_matrix()
    np.testing.assert_allclose(read_rig(path).cameras.T_cam_world[0, :3, :3], expected, atol=1e-12)
    path.write_text(text.replace(f"{turn[0]}", f"{turn[0] + 0.1}"))
    with pytest.raises(InputError, match="ORIENTATION: expected a quaternion of length 1"):
        read_rig(path)


@settings(max_examples=20, deadline=None)
@given(k1=st.floats(-0.1, 0.25), k2=st.floats(-0.03, 0.03), shift=st.floats(-2, 2))
def test_the_fit_reaches_the_error_that_it_states(k1, k2, shift):
    """OpenCV's own undistortion of the corners and edges agrees with the formula within the stated error."""
    from psotrack.geometry.rig_files.vicon import fit_distortion

    centre = K[:2, 2] + shift
    fit = fit_distortion(K, SIZE_WH, centre, np.array([k1, k2]))
    assume(fit is not None)
    coefficients, error_px = fit
    camera = make_camera(R=np.eye(3), t_m=np.zeros(3), K=K, dist=coefficients.tolist(), image_size_wh=SIZE_WH)
    pixels = np.array([[0.0, 0.0], [1279, 719], [640, 0], [0, 360], [300, 500], [1279, 0]])
    arm = (pixels - centre) / K[[0, 1], [0, 1]]
    r2 = (arm**2).sum(-1, keepdims=True)
    offset = (centre - K[:2, 2]) / K[[0, 1], [0, 1]]
    straight = offset + arm * (1 + k1 * r2 + k2 * r2**2)
    bent = cv2.projectPoints(np.c_[straight, np.ones(6)], np.zeros(3), np.zeros(3), K, coefficients)[0][:, 0]
    # Points between those of the fit's grid may be a little worse.
    assert np.abs(bent - pixels).max() <= 1.2 * error_px + 1e-6
    np.testing.assert_allclose(undistort(camera, bent), straight, atol=1e-6)


def test_easymocaps_rodrigues_vectors_count_and_sizes_of_zero_are_not_known(tmp_path):
    easymocap_files(tmp_path)
    outside = tmp_path / "extri.yml"
    outside.write_text(
        outside.read_text() + "".join(matrix(f"Rot_{name}", np.eye(3)) for name in ("1", "07"))
    )
    expected = read_rig(outside).cameras
    np.testing.assert_allclose(expected.T_cam_world[1, :3, :3], poses()[1][0], rtol=0, atol=1e-12)
    inside = tmp_path / "intri.yml"
    inside.write_text(inside.read_text().replace(": 720", ": -1").replace(": 1280", ": -1"))
    assert_same(read_rig(outside, SIZE_WH).cameras, expected)


def test_easymocap_without_the_other_file_or_the_size(tmp_path):
    easymocap_files(tmp_path, size=False)
    with pytest.raises(InputError, match=r"camera 1\.size or image_size: .* found none; pass --size"):
        read_rig(tmp_path / "extri.yml")
    (tmp_path / "intri.yml").unlink()
    with pytest.raises(InputError, match=r"expected intri\.yml with the lenses beside it"):
        read_rig(tmp_path / "extri.yml")


def test_a_gap_in_the_chain_leaves_the_camera_out(tmp_path, caplog):
    path = tmp_path / "camchain.yaml"
    kalibr_file(path, chain=False)
    assert read_rig(path).names == ("cam0",)
    assert "no pose: camera cam1" in caplog.text
    path.write_text(path.read_text() + "  : {")
    with pytest.raises(InputError, match=r"camchain\.yaml, line \d+: expected valid YAML or JSON"):
        read_rig(path)


@pytest.mark.parametrize("upwards", [False, True])
@pytest.mark.parametrize("separator", [",", "\t", "  "])
def test_dlt_coefficients(tmp_path, upwards, separator):
    columns = dlt_columns(upwards=upwards, skew=0.5)
    path = tmp_path / "dltcoefs.csv"
    dlt_file(path, columns, separator)
    with pytest.raises(InputError, match="pass --size"):
        read_rig(path)
    with pytest.raises(InputError, match=r"because the file leaves it open; state m or cm or mm"):
        read_rig(path, SIZE_WH)
    rig = read_rig(path, SIZE_WH, metres_per_unit=1.0)
    assert rig.names == ("cam1", "cam2")
    skewed = with_skew(0.5)
    np.testing.assert_allclose(rig.cameras.K, [skewed] * 2, rtol=0, atol=1e-7)
    for index, column in enumerate(columns):
        # The formula of the format.
        below = POINTS_M @ column[8:] + 1
        u, v = (POINTS_M @ column[:3] + column[3]) / below, (POINTS_M @ column[4:7] + column[7]) / below
        expected = np.stack([u, SIZE_WH[1] - v if upwards else v], axis=-1)
        np.testing.assert_allclose(project(rig.cameras[index], POINTS_M)[0], expected, rtol=0, atol=1e-6)


def test_a_camera_with_the_origin_behind_it_is_turned_round(tmp_path):
    columns = [*dlt_columns(upwards=False)]
    R, t = look_at((1.0, 0.0, 0.5), (3.0, 0.2, 0.7))
    P = K @ np.column_stack([R, t])
    columns.append((P / P[2, 3]).ravel()[:11])
    path = tmp_path / "dlt.csv"
    dlt_file(path, columns)
    path.write_text("a,b,c\n" + path.read_text())
    rig = read_rig(path, SIZE_WH, metres_per_unit=1.0)
    assert rig.names == ("a", "b", "c")
    np.testing.assert_allclose(rig.cameras.T_cam_world[2, :3], np.column_stack([R, t]), atol=1e-9)


def test_the_lenses_of_argus(tmp_path):
    path = tmp_path / "cameras-profile.txt"
    path.write_text(
        "1 1165.5 1920 1080 960 540 1 -0.2 0.05 0.001 0.002 0.01\n2 800 1280 720 640 360 1.01 0 0 0 0 0\n"
    )
    lenses = read_lenses(path)
    assert lenses.names == ("cam1", "cam2")
    np.testing.assert_array_equal(lenses.cameras.K[0], [[1165.5, 0, 960], [0, 1165.5, 540], [0, 0, 1]])
    assert lenses.cameras.K[1, 1, 1] == 808
    np.testing.assert_array_equal(lenses.cameras.dist[0], [-0.2, 0.05, 0.001, 0.002, 0.01])
    np.testing.assert_array_equal(lenses.cameras.image_size_wh, [[1920, 1080], [1280, 720]])
    with pytest.raises(InputError, match="expected the poses of cameras, found none"):
        read_rig(path)


@pytest.mark.parametrize("file", ["rig.toml", "rig.yml", "camera_array.toml", "anipose"])
def test_every_lens_of_opencv_is_read_as_it_was_written(tmp_path, file):
    lenses = {
        "pinhole": ((), False),
        "thin": ((-0.1, 0.02, 1e-3, 2e-3, 0.01, 0.1, 0.0, 0.02, 1e-3, 2e-3, -1e-3, 5e-4), False),
        "tilted": (
            (-0.1, 0.02, 1e-3, 2e-3, 0.01, 0.1, 0.0, 0.02, 1e-3, 2e-3, -1e-3, 5e-4, 0.01, 0.02),
            False,
        ),
        "fisheye": ((0.05, -0.01, 0.003, -0.001), True),
    }
    R, t = poses()[0]
    rig = make_rig(
        {
            name: make_camera(R=R, t_m=t, K=with_skew(0.3), image_size_wh=SIZE_WH, dist=dist, fisheye=fisheye)
            for name, (dist, fisheye) in lenses.items()
        }
    )
    file, file_format = ("calibration.toml", "anipose") if file == "anipose" else (file, None)
    write_rig(tmp_path / file, rig, file_format=file_format)
    back = read_rig(tmp_path / file)
    np.testing.assert_array_equal(back.cameras.K, rig.cameras.K)
    np.testing.assert_array_equal(back.cameras.dist, rig.cameras.dist)
    np.testing.assert_array_equal(back.cameras.fisheye, rig.cameras.fisheye)
