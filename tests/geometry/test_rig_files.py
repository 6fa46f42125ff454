"""Files of rigs, ours and those of other programs: each is projected by a formula of its own; and what is refused."""

import contextlib
import re
from functools import partial

import cv2
import numpy as np
import pytest
from helpers import assert_refused, assert_same, ring_rig
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from rig_texts import (
    ANIPOSE,
    CALISCOPE,
    OLDER_CALISCOPE,
    RADTAN,
    RIG_TOML,
    SIZE_WH,
    K,
    dlt_columns,
    dlt_file,
    easymocap_files,
    handpose_files,
    json_file,
    kalibr_file,
    matrix,
    pose2sim_file,
    poses,
    qualisys_file,
    ros_text,
    sample_text,
    storage_files,
    vicon_file,
    with_skew,
)
from scipy.spatial.transform import Rotation

from psotrack.errors import InputError
from psotrack.geometry import look_at, make_camera, make_rig, project, reconstruct, undistort
from psotrack.geometry.rig_files import KEYS, RIG_FORMATS, read_lenses, read_rig, write_rig
from psotrack.geometry.rig_files.vicon import fit_distortion
from psotrack.recordings import CameraTable

#: Points in front of all cameras of `poses`, metres.
POINTS_M = np.array([[0.3, -0.2, 0.9], [-0.4, 0.5, 1.4], [0.0, 0.1, 0.2], [1.1, 0.8, 1.9]])
UNIT = {"metres_per_unit": 1.0}


def writes(text):
    """A function that writes this text to a path."""
    return lambda path: path.write_text(text, encoding="utf-8")


def fills(write, **options):
    """A function that writes the files of a program beside a path."""
    return lambda path: write(path.parent, **options)


def by_opencv(R, t_m, K, dist, *, fisheye=False):
    function = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    return function(POINTS_M[:, None], cv2.Rodrigues(R)[0], t_m, K, np.array(dist))[0][:, 0]


# Our own files.

THIN = (-0.1, 0.02, 1e-3, 2e-3, 0.01, 0.1, 0.0, 0.02, 1e-3, 2e-3, -1e-3, 5e-4)
#: Coefficients, and whether the lens is a fisheye.
EVERY_LENS = {
    # Three names that need care: a serial number, a word of YAML, and characters that must be quoted.
    "60881257": ((), False),
    "true": (RADTAN, False),
    'a "b" \\ é: # 🚁': ((*RADTAN, 0.004), False),
    "eight": ((*RADTAN, 0.004, 0.01, -0.006, 0.001), False),
    "thin": (THIN, False),
    "tilted": ((*THIN, 0.01, 0.02), False),
    "fisheye": ((0.05, -0.01, 0.003, -0.001), True),
}


def rig_of_every_lens():
    """Eleven cameras, whose tables must not be sorted as text."""
    ring = ring_rig(11).cameras
    lenses = [*EVERY_LENS.items(), *((f"c{index}", (RADTAN, False)) for index in range(4))]
    cameras = {}
    for T, (name, (dist, fisheye)) in zip(ring.T_cam_world, lenses, strict=True):
        cameras[name] = make_camera(
            R=T[:3, :3], t_m=T[:3, 3], K=with_skew(0.3), image_size_wh=SIZE_WH, dist=dist, fisheye=fisheye
        )
    return make_rig(cameras)


@pytest.mark.parametrize("file", ["rig.yml", "rig.toml", "camera_array.toml", "anipose"])
def test_a_rig_is_read_as_it_was_written(tmp_path, file):
    file, file_format = ("calibration.toml", "anipose") if file == "anipose" else (file, None)
    for rig in (rig_of_every_lens(), ring_rig(2)):
        write_rig(tmp_path / file, rig, file_format=file_format, force=True)
        back = read_rig(tmp_path / file)
        assert back.names == rig.names
        # Exact, except rotations that are stored as Rodrigues vectors: some roundings of numbers up to 1.
        rounding = 2e-15 if file.endswith("toml") else 0.0
        np.testing.assert_allclose(back.cameras.T_cam_world, rig.cameras.T_cam_world, rtol=0, atol=rounding)
        np.testing.assert_array_equal(back.cameras.T_cam_world[:, :3, 3], rig.cameras.T_cam_world[:, :3, 3])
        np.testing.assert_array_equal(back.cameras.K, rig.cameras.K)
        np.testing.assert_array_equal(back.cameras.image_size_wh, rig.cameras.image_size_wh)
        np.testing.assert_array_equal(back.cameras.fisheye, rig.cameras.fisheye)
        stored = back.cameras.dist[:, : rig.cameras.dist.shape[1]]
        np.testing.assert_array_equal(stored, rig.cameras.dist)


def test_a_rig_in_the_datasets_layout_is_read_as_it_was_written(tmp_path):
    one_focal = K * [[1.0, 1.0, 1.0], [1.0, 900.0 / 905.0, 1.0], [1.0, 1.0, 1.0]]
    R, t_m = poses()[0]
    rig = make_rig({"cam1i": make_camera(R=R, t_m=t_m, K=one_focal, image_size_wh=SIZE_WH, dist=RADTAN)})
    write_rig(tmp_path / "rig.csv", rig)
    back = read_rig(tmp_path / "rig.csv", SIZE_WH)
    assert back.names == rig.names
    # Rotations are stored as Rodrigues vectors.
    assert_same(back.cameras, rig.cameras, atol=2e-15)


def test_opencv_reads_a_written_rig(tmp_path):
    rig = ring_rig(3, coefficients=5)
    write_rig(tmp_path / "rig.yml", rig)
    storage = cv2.FileStorage(str(tmp_path / "rig.yml"), cv2.FILE_STORAGE_READ)
    second = storage.getNode("cameras").at(1)
    assert second.getNode("name").string() == "c1"
    np.testing.assert_array_equal(second.getNode("K").mat(), rig.cameras.K[1])
    np.testing.assert_array_equal(second.getNode("t").mat().ravel(), rig.cameras.T_cam_world[1, :3, 3])


def test_the_cameras_of_a_recording_are_a_rig(tmp_path):
    """The keys that a recording has beside a rig's are left alone, and none counts as a misspelt one."""
    values = {"frames": 3, "fps": 25.0, "time_offset_s": 0.1, "line_time_s": 1e-5}
    keys = [key for key in CameraTable.__struct_fields__ if key not in KEYS]
    lines = [f"{key} = {values.get(key, repr('a'))}\n" for key in keys]
    (tmp_path / "recording.toml").write_text("version = 1\n" + RIG_TOML + "".join(lines))
    assert read_rig(tmp_path / "recording.toml").names == ("left",)


# Files of other programs.

#: File to read, what writes it, arguments of the reader, names of the cameras.
FORMATS = [
    ("calibration.toml", writes(ANIPOSE), UNIT, ("c0", "c1")),
    ("camera_array.toml", writes(CALISCOPE), {}, ("0", "1")),
    ("config.toml", writes(OLDER_CALISCOPE), {}, ("0", "1")),
    ("Calib_board.toml", pose2sim_file, {}, ("cam01", "int_cam02_img")),
    *(
        (name, fills(storage_files), {"image_size_wh": SIZE_WH} | UNIT, ("cam1", "cam2"))
        for name in ("intrinsics.yml", "extrinsics.yml", "extrinsics.xml")
    ),
    ("rig.json", fills(json_file), UNIT, ("6-0", "left")),
    ("session.qca.txt", qualisys_file, {}, ("26578", "26579")),
    ("intri.yml", fills(easymocap_files), {}, ("1", "07")),
    (
        "extri.yml",
        fills(easymocap_files, rodrigues=False, size=False),
        {"image_size_wh": SIZE_WH},
        ("1", "07"),
    ),
    ("camchain.yaml", kalibr_file, {}, ("cam0", "cam1")),
    ("fisheye.yaml", partial(kalibr_file, distortion_model="equidistant"), {}, ("cam0", "cam1")),
    *(
        (name, fills(handpose_files), {"image_size_wh": SIZE_WH} | UNIT, ("cam0", "cam1"))
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


def write_unplaced(path):
    R, t_m = np.eye(3), np.zeros(3)
    lens = make_camera(R=R, t_m=t_m, K=K, image_size_wh=SIZE_WH, dist=RADTAN)
    write_rig(path, make_rig({"a": lens, "b": lens}), placed=False)


def write_stereo_lenses(path):
    storage_files(path.parent)
    (path.parent / "extrinsics.yml").unlink()


ARGUS = f"900 1280 720 650.5 350.25 {905 / 900!r} -0.12 0.03 0.0008 -0.0005 0\n"
#: File of lenses alone, what writes it, and the names of the cameras.
LENSES = [
    ("lenses.toml", write_unplaced, ("a", "b")),
    ("left.yml", writes(sample_text()), ("left",)),
    ("head.yaml", writes(ros_text()), ("head_camera",)),
    ("wide.yaml", writes(ros_text("equidistant")), ("head_camera",)),
    ("cameras-profile.txt", writes(f"1 {ARGUS}2 {ARGUS}"), ("cam1", "cam2")),
    ("intrinsics.yml", write_stereo_lenses, ("cam1", "cam2")),
]


@pytest.mark.parametrize(("file", "write", "names"), LENSES)
def test_files_of_lenses_without_poses(tmp_path, file, write, names):
    write(tmp_path / file)
    size_wh = SIZE_WH if file == "intrinsics.yml" else None
    lenses = read_lenses(tmp_path / file, size_wh)
    assert lenses.names == names
    for index in range(len(names)):
        one = lenses.cameras[index]
        # Argus writes the ratio of the focal lengths.
        np.testing.assert_allclose(one.K, K, rtol=1e-15)
        np.testing.assert_array_equal(one.dist[:4], RADTAN)
        np.testing.assert_array_equal(one.image_size_wh, SIZE_WH)
        np.testing.assert_array_equal(one.T_cam_world, np.eye(4))
        assert (one.fisheye is not None) == (file == "wide.yaml")
    with pytest.raises(InputError, match=r"expected the poses of cameras, found none; .*calibrate rig"):
        read_rig(tmp_path / file, size_wh)


VIDEO = 'TYPE="VideoInputDevice:Blackfly"'
LONE = '<Camera DEVICEID="9" SENSOR_SIZE="1280 720"/></Cameras>'
UNPLACED = RIG_TOML.replace("left", "right").partition("rvec")[0]
IGNORED = "[cameras.2]\nport = 2\nignore = true\nsize = [640, 480]\n"
NULL_POSE = """[cameras.3]
size = [640, 480]
error = "null"
matrix = [[650.0, 0.0, 320.0], [0.0, 654.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.18, -0.25, 0.003, 0.002, 0.12]
translation = "null"
rotation = "null"
"""


def without_video(path, *, first, second=VIDEO, more="</Cameras>"):
    """Vicon's file, with other types of its two cameras, and more cameras."""
    vicon_file(path, 'VICON_RADIAL="0 0"')
    types = iter((first, second))
    text = re.sub(VIDEO, lambda _: next(types), path.read_text())
    path.write_text(text.replace("</Cameras>", more))


UNCALIBRATED = {"change": ('serial="26578"', 'calibrated="false" serial="26578"')}
VANTAGE = partial(without_video, first='TYPE="VantageV5"')
UNTYPED = partial(without_video, first='TYPE=""', second='TYPE=""', more=LONE)
#: File, what writes it, the cameras of the rig, those with a lens but no pose, and words of the warning.
LEFT_OUT = [
    ("rig.toml", writes(RIG_TOML + UNPLACED), {"left"}, {"right"}, "no pose: camera right"),
    ("camera_array.toml", writes(CALISCOPE + IGNORED + NULL_POSE), {"0", "1"}, {"3"}, "no pose: camera 3"),
    ("a.qca.txt", partial(qualisys_file, **UNCALIBRATED), {"26579"}, {"26578"}, "no pose: camera 26578"),
    ("extri.yml", fills(easymocap_files), {"1", "07"}, {"9"}, "no pose: camera 9"),
    ("camchain.yaml", partial(kalibr_file, chain=False), {"cam0"}, {"cam1"}, "no pose: camera cam1"),
    ("session.xcp", VANTAGE, {"2122"}, set(), "1 cameras that record no video are left out"),
    ("session.xcp", UNTYPED, {"2121", "2122"}, set(), "no lens: camera 9"),
]


@pytest.mark.parametrize(("file", "write", "placed", "others", "words"), LEFT_OUT)
def test_cameras_without_a_pose_or_a_lens_are_left_out(tmp_path, caplog, file, write, placed, others, words):
    write(tmp_path / file)
    with caplog.at_level("WARNING"):
        assert set(read_rig(tmp_path / file).names) == placed
    assert words in caplog.text
    assert set(read_lenses(tmp_path / file).names) == placed | others


def test_a_file_of_pose2sim_is_no_file_of_another_program(tmp_path):
    path = tmp_path / "Calib_board.toml"
    pose2sim_file(path)
    readable = set()
    for entry in RIG_FORMATS:
        with contextlib.suppress(InputError):
            read_rig(path, SIZE_WH, metres_per_unit=1.0, file_format=entry)
            readable.add(entry)
    assert readable == {"anipose", "caliscope", "pose2sim"}


def test_a_unit_that_a_format_leaves_open_may_be_in_the_file(tmp_path, caplog):
    path = tmp_path / "calibration.toml"
    path.write_text(ANIPOSE.replace("adjusted", 'unit = "cm"\nadjusted'))
    stated = read_rig(path).cameras.T_cam_world[:, :3, 3]
    np.testing.assert_allclose(stated, [0.01 * t for _, t in poses()], atol=1e-15)
    other = read_rig(path, metres_per_unit=1e-3).cameras.T_cam_world[:, :3, 3]
    np.testing.assert_allclose(other, 0.1 * stated, atol=1e-15)
    assert "in units of 0.01 m by the file, and are read in units of 0.001 m" in caplog.text


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


def with_quaternion(path, turn):
    """Vicon's file, in which both cameras have this quaternion."""
    vicon_file(path, 'VICON_RADIAL="0 0"')
    stated = f'ORIENTATION="{" ".join(map(str, turn))}"'
    path.write_text(re.sub('ORIENTATION="[^"]*"', stated, path.read_text()))


def test_a_quaternion_that_was_rounded_is_one(tmp_path):
    """One tolerance for all files: two decimals change the length by up to 1 %."""
    # The length is 0.9983.
    turn = [0.34, 0.35, 0.72, 0.49]
    with_quaternion(tmp_path / "session.xcp", turn)
    expected = Rotation.from_quat(turn).as_matrix()
    found = read_rig(tmp_path / "session.xcp").cameras.T_cam_world[0, :3, :3]
    np.testing.assert_allclose(found, expected, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(k1=st.floats(-0.1, 0.25), k2=st.floats(-0.03, 0.03), shift=st.floats(-2, 2))
def test_the_fit_to_vicons_lens_reaches_the_error_that_it_states(k1, k2, shift):
    """OpenCV's own undistortion of the corners and edges agrees with the formula within the stated error."""
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
    inside, outside = tmp_path / "intri.yml", tmp_path / "extri.yml"
    wrong = "".join(matrix(f"Rot_{name}", np.eye(3)) for name in ("1", "07"))
    outside.write_text(outside.read_text() + wrong)
    expected = read_rig(outside).cameras
    np.testing.assert_allclose(expected.T_cam_world[1, :3, :3], poses()[1][0], rtol=0, atol=1e-12)
    inside.write_text(inside.read_text().replace(": 720", ": -1").replace(": 1280", ": -1"))
    assert_same(read_rig(outside, SIZE_WH).cameras, expected)


@pytest.mark.parametrize("upwards", [False, True])
@pytest.mark.parametrize("separator", [",", "\t", "  "])
def test_dlt_coefficients(tmp_path, upwards, separator):
    """The third camera has the world's origin behind it, and is turned round; a table may have a header."""
    behind = look_at((1.0, 0.0, 0.5), (3.0, 0.2, 0.7))
    columns = dlt_columns([*poses(), behind], upwards=upwards, skew=0.5)
    path = tmp_path / "dltcoefs.csv"
    dlt_file(path, columns, separator)
    rig = read_rig(path, SIZE_WH, metres_per_unit=1.0)
    assert rig.names == ("cam1", "cam2", "cam3")
    np.testing.assert_allclose(rig.cameras.K, [with_skew(0.5)] * 3, rtol=0, atol=1e-7)
    for index, column in enumerate(columns[:2]):
        # The formula of the format.
        below = POINTS_M @ column[8:] + 1
        u, v = (POINTS_M @ column[:3] + column[3]) / below, (POINTS_M @ column[4:7] + column[7]) / below
        expected = np.stack([u, SIZE_WH[1] - v if upwards else v], axis=-1)
        np.testing.assert_allclose(project(rig.cameras[index], POINTS_M)[0], expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(rig.cameras.T_cam_world[2, :3], np.column_stack(behind), atol=1e-9)
    if separator == ",":
        path.write_text("a,b,c\n" + path.read_text())
        assert read_rig(path, SIZE_WH, metres_per_unit=1.0).names == ("a", "b", "c")


# What is refused.


def reads(file, write, size_wh=None, **options):
    """A file, of this text or of a function that writes it, is read."""

    def prepare(folder):
        (writes(write) if isinstance(write, str) else write)(folder / file)
        return partial(read_rig, folder / file, size_wh, **options)

    return prepare


def changed(text, before, after):
    return reads("x.toml", text.replace(before, after, 1))


def qualisys(before, after):
    return reads("session.qca.txt", partial(qualisys_file, change=(before, after)))


def kalibr(**models):
    return reads("camchain.yaml", partial(kalibr_file, **models))


def dlt(rows=None, size_wh=SIZE_WH, unit_m=None):
    text = "\n".join(rows) if rows else partial(dlt_file, columns=dlt_columns())
    return reads("dlt.csv", text, size_wh, metres_per_unit=unit_m)


def makes(**fields):
    """A camera of these fields is made."""
    sound = {"R": np.eye(3), "t_m": np.zeros(3), "K": np.diag([100.0, 100, 1]), "image_size_wh": (100, 80)}
    return calls(make_camera, **(sound | fields))


def calls(function, *arguments, **options):
    return lambda folder: partial(function, *arguments, **options)


def writes_rig(file, **options):
    return lambda folder: partial(write_rig, folder / file, RIG, **options)


def reads_without_lenses(folder):
    easymocap_files(folder)
    (folder / "intri.yml").unlink()
    return partial(read_rig, folder / "extri.yml")


RIG, PIXELS = ring_rig(3), np.full((2, 3, 2), 100.0)
FISHEYE = ANIPOSE.replace('"c0"', '"c0"\nfisheye = true')
BENT = partial(vicon_file, radial='VICON_RADIAL2="ViconRadial2 650.5 350.25 -1.5 0"')
LONG = partial(with_quaternion, turn=(0.44, 0.35, 0.72, 0.49))
CUT_YAML = "cameras:\n   - a\n     b\n   K: {\n"
NO_NAME, TWO_OF_K = "cameras:\n   - { K: [1, 2] }\n", "cameras:\n   - { name: c, K: [1, 2] }\n"
ENTITY = '<!DOCTYPE x [<!ENTITY a "b">]><calibration>'
#: Name of the case -> how the bad input is made, and words of the line.
BAD = {
    # Our own files.
    "misspelt": (changed(RIG_TOML, "size", "szie"), "x.toml", "left.szie: expected one of", "mean size?"),
    "version": (changed(RIG_TOML, "[cam", "version = 2\n[cam"), "version: expected 1, found 2; use a newer"),
    "model": (changed(RIG_TOML, "rv", 'model = "omni"\nrv'), "left.model: expected opencv or", "found omni"),
    "no tvec": (changed(RIG_TOML, "tvec = [0.1, 0.2, 5.0]", ""), "left.tvec: expected 3 numbers, as for rve"),
    "no size": (changed(RIG_TOML, "size = [1920, 1080]", ""), "left.size or image_size: ", "pass --size"),
    "gone": (lambda folder: partial(read_rig, folder / "no.toml"), "no.toml: expected a file to read"),
    "csv gone": (lambda folder: partial(read_rig, folder / "no.csv", (9, 9)), "expected a file to read"),
    # Texts of other programs.
    "no matrix": (changed(ANIPOSE, "matrix", "matrx"), "cam_0.matrix or K or camera_matrix", "found none"),
    "two rows": (changed(ANIPOSE, ", [0.0, 0.0, 1.0]]", "]"), "expected 3 x 3 numbers, found 2 x 3"),
    "half a pixel": (changed(ANIPOSE, "1280,", "1280.5,"), "cam_0.size: expected whole numbers"),
    "below 0": (changed(ANIPOSE, "[[900.0", "[[-900.0"), "cam_0.matrix: expected intrinsics"),
    "nan": (changed(ANIPOSE, "[[900.0", "[[nan"), "cam_0.matrix: expected finite numbers"),
    "a word": (changed(ANIPOSE, "[[900.0", '[["f"'), "cam_0.matrix: expected 3 x 3 numbers"),
    "lens of 3": (changed(ANIPOSE, "[-0.12,", "["), "distortions: expected 0, 4, 5, 8, 12, 14", "found 3"),
    "rotation": (changed(ANIPOSE, "rotation = [", "rotation = [1.0, "), "expected 3 numbers or 3 x 3 numb"),
    "name twice": (changed(ANIPOSE, '"c1"', '"c0"'), "cam_1: expected each camera once, found c0 again"),
    "lens of 8": (changed(FISHEYE, "[-0.12", "[1, 1, 1, 1, -0.12"), "4 coefficients of a fisheye, found 8"),
    "no unit": (reads("x.toml", ANIPOSE), "unit of lengths, found none", "leaves it open", "mm: --units"),
    "unit": (changed(ANIPOSE, "adj", 'unit = "ft"\nadj'), "metadata.unit: expected one of m, cm, mm, found"),
    "TOML": (reads("x.toml", "[cam_0\n"), "x.toml, line 1: expected valid TOML"),
    "no camera": (reads("x.toml", ""), "at least one camera, found none"),
    "JSON": (
        reads("x.json", "{}"),
        "camera.matrix or K or camera_matrix: expected 3 x 3 numbers, found none",
    ),
    "YAML": (reads("x.yml", CUT_YAML), "line ", "expected valid YAML or JSON, found an error"),
    "no name": (reads("x.yml", NO_NAME), "cameras[0].name: expected a name, found none"),
    "two of nine": (reads("x.yml", TWO_OF_K), "cameras[0].K: expected 3 x 3 numbers, found 2"),
    "unknown": (reads("x.dat", "1 2"), "x.dat: expected a rig file of a known format, found other content"),
    "CSV": (reads("x.csv", "cam_name\n", SIZE_WH), "x.csv, line 1"),
    "size of DLT": (dlt(size_wh=None), "camera cam1", "pass --size"),
    "unit of DLT": (dlt(), "because the file leaves it open; state m or cm or mm"),
    "nan in DLT": (dlt(["1,2"] * 10 + ["nan,1"], unit_m=1.0), "cam1.coefficients: expected finite numbers"),
    "no DLT": (dlt(["1,2"] * 11, unit_m=1.0), "the coefficients of a camera, found a determinant of 0"),
    "r12": (qualisys(' r12="', ' r12="3" q="'), "camera 26578, transform.r11 to r33: expected a rotation"),
    "no x": (qualisys(' x="', ' q="'), "camera 26578, transform.x: expected a number, found none"),
    "XML": (qualisys("</cameras>", ""), "a.txt, line 2: expected valid XML, found an error (mismatched tag)"),
    "document type": (qualisys("<calibration>", ENTITY), "XML without document type"),
    "omni": (kalibr(camera_model="omni"), "found omni; calibrate again with pinhole-radtan"),
    "fov": (kalibr(distortion_model="fov"), "cam0.distortion_model: expected radtan, ", "or none, found fov"),
    "bent": (reads("a.xcp", BENT), "Camera 2121, KeyFrame.VICON_RADIAL2: expected a correction that keeps"),
    "quaternion": (reads("a.xcp", LONG), "ORIENTATION: expected a quaternion of length 1"),
    "no intri.yml": (reads_without_lenses, "expected intri.yml with the lenses beside it"),
    # Cameras and calls.
    "mirrored": (makes(R=np.diag([1.0, 1.0, -1.0])), "camera.R: expected a rotation matrix"),
    "scaled": (makes(R=1.001 * np.eye(3)), "camera.R: expected a rotation matrix"),
    "focal 0": (makes(K=np.diag([0.0, 100, 1])), "camera.K: expected focal lengths above 0, found 0 and 100"),
    "nowhere": (makes(t_m=np.array([0.0, np.nan, 0.0])), "expected finite numbers, found NaN or infinity"),
    "fisheye of nan": (makes(dist=(np.nan,) * 4, fisheye=True), "expected finite numbers, found NaN"),
    "fisheye of 5": (makes(dist=(0.1,) * 5, fisheye=True), "0 or 4 coefficients of a fisheye, found 5"),
    "pinhole of 3": (makes(dist=(0.1,) * 3), "expected 0, 4, 5, 8, 12 or 14 coefficients, found 3"),
    "no width": (makes(image_size_wh=(0, 480)), "camera.image_size_wh: expected sides of at least 1"),
    "no cameras": (calls(make_rig, {}), "expected at least one camera, found none"),
    "others": (calls(RIG.select, ["c0", "c7", "x"]), "expected some of c0, c1, c2, found c7, x"),
    "none of them": (calls(RIG.select, []), "found none"),
    "noise": (calls(reconstruct, RIG.cameras, PIXELS, noise_px=0.0), "noise_px: expected numbers above 0"),
    "no noise": (calls(reconstruct, RIG.cameras, PIXELS, noise_px=np.nan), "noise_px: expected numbers"),
    "rate": (calls(reconstruct, RIG.cameras, PIXELS, false_alarm=1.0), "false_alarm: expected a probability"),
    "two focal lengths": (writes_rig("rig.csv"), "camera c0: expected one focal length, found fx"),
    "never written": (writes_rig("rig.toml", file_format="pose2sim"), "format: expected one of rig, "),
    "lenses in YAML": (writes_rig("lenses.yml", placed=False), "ends in .toml, for lenses without poses"),
}


@pytest.mark.parametrize(("prepare", "words"), [(one, words) for one, *words in BAD.values()], ids=BAD)
def test_bad_input_is_refused_in_one_line(prepare, words, tmp_path, capfd):
    assert_refused(prepare(tmp_path), *words, unchanged=tmp_path)
    assert capfd.readouterr() == ("", "")
