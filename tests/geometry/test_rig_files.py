"""Files of rigs, ours and those of other programs: each is projected by a formula of its own; and what is refused."""

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import assert_refused, assert_same, ring_rig
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from psotrack.errors import InputError
from psotrack.geometry import look_at, make_camera, make_rig, project, reconstruct
from psotrack.geometry.rig_files import KEYS, read_lenses, read_rig, write_rig
from psotrack.geometry.rig_files.xml_files import fit_distortion
from psotrack.recordings import CameraTable

#: Files of other programs, which have the cameras of `poses`, and those that each program reads with it.
SOUND = Path(__file__).parents[1] / "data" / "formats"
K = np.array([[900.0, 0.0, 650.5], [0.0, 905.0, 350.25], [0.0, 0.0, 1.0]])
SIZE_WH = (1280, 720)
RADTAN = (-0.12, 0.03, 0.0008, -0.0005)
#: Points in front of all cameras of `poses`, metres.
POINTS_M = np.array([[0.3, -0.2, 0.9], [-0.4, 0.5, 1.4], [0.0, 0.1, 0.2], [1.1, 0.8, 1.9]])
#: File as a user writes it by hand.
RIG_TOML = """[cameras.left]
size = [1920, 1080]
K = [[1160.2, 0, 961.0], [0, 1160.9, 541.2], [0, 0, 1]]
distortion = [-0.28, 0.09, 0, 0, 0.01]
rvec = [1.2, -0.4, 0.3]
tvec = [0.1, 0.2, 5.0]
"""
UNIT = {"metres_per_unit": 1.0}
SIZE = {"image_size_wh": SIZE_WH}


def poses():
    """Rotation and translation of each camera, world to camera, metres."""
    return [look_at(centre, (0.0, 0.0, 1.0)) for centre in ((4.0, 0.5, 2.0), (-3.5, 1.0, 2.4))]


SKEWED = K.copy()
SKEWED[0, 1] = 0.3


def copied(folder, file, *changes):
    """Path of a copy of a file of `SOUND`, and those beside it, with other texts in it, pairs of before and after."""
    shutil.copytree((SOUND / file).parent, folder, dirs_exist_ok=True)
    path = folder / Path(file).name
    text = path.read_text(encoding="utf-8")
    for before, after in changes:
        assert before in text, before
        text = text.replace(before, after)
    path.write_text(text, encoding="utf-8")
    return path


def by_opencv(R, t_m, K, dist, *, fisheye=False):
    function = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    turn, _ = cv2.Rodrigues(R)
    pixels, _ = function(POINTS_M[:, None], turn, t_m, K, np.array(dist))
    return pixels[:, 0]


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
    lenses = EVERY_LENS | {f"c{index}": (RADTAN, False) for index in range(4)}
    cameras = {}
    for pose, (name, (dist, fisheye)) in zip(ring_rig(11).cameras, lenses.items(), strict=True):
        lens = make_camera(
            R=np.eye(3), t_m=np.zeros(3), K=SKEWED, image_size_wh=SIZE_WH, dist=dist, fisheye=fisheye
        )
        cameras[name] = replace(lens, T_cam_world=pose.T_cam_world)
    return make_rig(cameras)


#: File -> the format that it is written in, where its name does not say it.
WRITTEN = {"rig.yml": None, "rig.toml": None, "camera_array.toml": None, "calibration.toml": "anipose"}


@pytest.mark.parametrize("file", WRITTEN)
def test_a_rig_is_read_as_it_was_written(tmp_path, file):
    for rig in (rig_of_every_lens(), ring_rig(2)):
        write_rig(tmp_path / file, rig, file_format=WRITTEN[file], force=True)
        back = read_rig(tmp_path / file)
        assert back.names == rig.names
        found, expected = back.cameras, rig.cameras
        # Exact, except rotations that are stored as Rodrigues vectors: some roundings of numbers up to 1.
        rounding = 2e-15 if file.endswith("toml") else 0.0
        np.testing.assert_allclose(found.T_cam_world, expected.T_cam_world, rtol=0, atol=rounding)
        np.testing.assert_array_equal(found.T_cam_world[:, :3, 3], expected.T_cam_world[:, :3, 3])
        np.testing.assert_array_equal(found.K, expected.K)
        np.testing.assert_array_equal(found.image_size_wh, expected.image_size_wh)
        np.testing.assert_array_equal(found.fisheye, expected.fisheye)
        stored = found.dist[:, : expected.dist.shape[1]]
        np.testing.assert_array_equal(stored, expected.dist)


def test_opencv_reads_a_written_rig(tmp_path):
    rig = ring_rig(3, coefficients=5)
    write_rig(tmp_path / "rig.yml", rig)
    storage = cv2.FileStorage(str(tmp_path / "rig.yml"), cv2.FILE_STORAGE_READ)
    second = storage.getNode("cameras").at(1)
    assert second.getNode("name").string() == "c1"
    K = second.getNode("K").mat()
    t_m = second.getNode("t").mat().ravel()
    np.testing.assert_array_equal(K, rig.cameras.K[1])
    np.testing.assert_array_equal(t_m, rig.cameras.T_cam_world[1, :3, 3])


def test_the_cameras_of_a_recording_are_a_rig(tmp_path):
    """The keys that a recording has beside a rig's are left alone, and none counts as a misspelt one."""
    values = {"frames": 3, "fps": 25.0, "time_offset_s": 0.1, "line_time_s": 1e-5}
    keys = [key for key in CameraTable.__struct_fields__ if key not in KEYS]
    lines = [f"{key} = {values.get(key, repr('a'))}\n" for key in keys]
    (tmp_path / "recording.toml").write_text("version = 1\n" + RIG_TOML + "".join(lines))
    assert read_rig(tmp_path / "recording.toml").names == ("left",)


# Files of other programs.

#: File to read, a change of it, arguments of the reader, names of the cameras.
FORMATS = [
    ("rigs/calibration.toml", (), UNIT, ("c0", "c1")),
    ("rigs/camera_array.toml", (), {}, ("0", "1")),
    ("pose2sim/calib.toml", (), {}, ("cam01", "int_cam02_img")),
    ("opencv-stereo/extrinsics.yml", (), SIZE | UNIT, ("cam1", "cam2")),
    ("opencv-stereo/extrinsics.xml", (), SIZE | UNIT, ("cam1", "cam2")),
    ("opencv-json/rig.json", (), UNIT, ("6-0", "left")),
    ("qualisys/a.qca.txt", (), {}, ("26578", "26579")),
    ("easymocap/intri.yml", (), {}, ("1", "07")),
    ("easymocap-matrices/extri.yml", (), SIZE, ("1", "07")),
    ("kalibr/camchain.yaml", (), {}, ("cam0", "cam1")),
    ("kalibr/camchain.yaml", (("radtan", "equidistant"),), {}, ("cam0", "cam1")),
    ("handpose/rot_trans_c1.dat", (), SIZE | UNIT, ("cam0", "cam1")),
]


@pytest.mark.parametrize(("file", "changes", "options", "names"), FORMATS)
def test_cameras_project_as_opencv_does(tmp_path, file, changes, options, names):
    rig = read_rig(copied(tmp_path, file, *changes), **options)
    assert rig.names == names
    assert rig.cameras.image_size_wh.tolist() == [[1280, 720]] * 2
    points_m = POINTS_M
    if file.startswith(("opencv-stereo", "kalibr")):
        # The world is the first camera.
        R, t_m = poses()[0]
        points_m = POINTS_M @ R.T + t_m
    pixels, _ = project(rig.cameras, points_m[:, None])
    for index, (R, t_m) in enumerate(poses()):
        expected = by_opencv(R, t_m, K, RADTAN, fisheye=bool(changes))
        np.testing.assert_allclose(pixels[:, index], expected, rtol=0, atol=1e-6)


ARGUS = f"900 1280 720 650.5 350.25 {905 / 900!r} -0.12 0.03 0.0008 -0.0005 0\n"
ROS = (SOUND / "ros/head.yaml").read_text()
#: File of lenses alone, its text, and the names of the cameras.
LENSES = [
    ("left.yml", (SOUND / "rigs/left.yml").read_text(), ("left",)),
    ("head.yaml", ROS, ("head_camera",)),
    ("wide.yaml", ROS.replace("plumb_bob", "equidistant"), ("head_camera",)),
    ("cameras-profile.txt", f"1 {ARGUS}2 {ARGUS}", ("cam1", "cam2")),
    ("intrinsics.yml", (SOUND / "opencv-stereo/intrinsics.yml").read_text(), ("cam1", "cam2")),
]


@pytest.mark.parametrize(("file", "text", "names"), LENSES)
def test_files_of_lenses_without_poses(tmp_path, file, text, names):
    (tmp_path / file).write_text(text)
    size_wh = SIZE_WH if file == "intrinsics.yml" else None
    lenses = read_lenses(tmp_path / file, size_wh)
    assert lenses.names == names
    for index in range(len(names)):
        one = lenses.cameras[index]
        # Argus writes the ratio of the focal lengths.
        np.testing.assert_allclose(one.K, K, rtol=1e-15)
        np.testing.assert_array_equal(one.dist[:4], RADTAN)
        np.testing.assert_array_equal(one.image_size_wh, SIZE_WH)
        assert (one.fisheye is not None) == (file == "wide.yaml")
    with pytest.raises(InputError, match=r"expected the poses of cameras, found none; .*calibrate rig"):
        read_rig(tmp_path / file, size_wh)


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


VANTAGE = ("</Cameras>", '<Camera DEVICEID="9" TYPE="VantageV5" SENSOR_SIZE="1280 720"/></Cameras>')
UNCALIBRATED = ('serial="26578"', 'calibrated="false" serial="26578"')
NO_CHAIN = ("T_cn_cnm1", "T_other")
MORE = ("[cameras.1]", IGNORED + NULL_POSE + "[cameras.1]")
BESIDE = ("[cameras.c0]", UNPLACED + "[cameras.c0]")
#: File, changes of it, the cameras of the rig, those with a lens but no pose, and words of the warning.
LEFT_OUT = [
    ("rig.toml/rig.toml", [BESIDE], {"c0", "c1"}, {"right"}, "no pose: camera right"),
    ("rigs/camera_array.toml", [MORE], {"0", "1"}, {"3"}, "no pose: camera 3"),
    ("qualisys/a.qca.txt", [UNCALIBRATED], {"26579"}, {"26578"}, "no pose: camera 26578"),
    ("easymocap/extri.yml", [], {"1", "07"}, {"9"}, "no pose: camera 9"),
    ("kalibr/camchain.yaml", [NO_CHAIN], {"cam0"}, {"cam1"}, "no pose: camera cam1"),
    ("vicon/a.xcp", [VANTAGE], {"2121", "2122"}, set(), "1 cameras that record no video are left out"),
]


@pytest.mark.parametrize(("file", "changes", "placed", "others", "words"), LEFT_OUT)
def test_cameras_without_a_pose_or_a_lens_are_left_out(
    tmp_path, caplog, file, changes, placed, others, words
):
    path = copied(tmp_path, file, *changes)
    with caplog.at_level("WARNING"):
        assert set(read_rig(path).names) == placed
    assert words in caplog.text
    assert set(read_lenses(path).names) == placed | others


def test_a_unit_that_a_format_leaves_open_may_be_in_the_file(tmp_path, caplog):
    path = copied(tmp_path, "rigs/calibration.toml", ("adjusted", 'unit = "cm"\nadjusted'))
    stated = read_rig(path).cameras.T_cam_world[:, :3, 3]
    np.testing.assert_allclose(stated, [0.01 * t for _, t in poses()], atol=1e-15)
    other = read_rig(path, metres_per_unit=1e-3).cameras.T_cam_world[:, :3, 3]
    np.testing.assert_allclose(other, 0.1 * stated, atol=1e-15)
    assert "in units of 0.01 m by the file, and are read in units of 0.001 m" in caplog.text


VICON_RADIAL = 'VICON_RADIAL2="ViconRadial2 650.5 350.25 0.06 -0.01"'
VICON_TURN = "0.5212659870236002 0.5904808412286389 -0.46189797946789407 0.4077553230525724"


def undistorted_by_vicon(pixels, centre_px, coefficients):
    """Vicon's formula, from the distorted to the undistorted point; distances along y are in pixels of x."""
    scale = np.diag(K)[:2]
    arm = (pixels - centre_px) / scale
    r2 = (arm**2).sum(axis=-1, keepdims=True)
    gain = 1 + sum(k * r2 ** (power + 1) for power, k in enumerate(coefficients))
    return centre_px + arm * gain * scale


@pytest.mark.parametrize(
    ("radial", "centre_px", "per_focal"),
    [
        # Per square pixel; Vicon's principal point is the centre.
        (f'VICON_RADIAL="{0.11 / 900**2!r} {-0.02 / 900**4!r}"', (650.5, 350.25), (0.11, -0.02)),
        ('VICON_RADIAL2="ViconRadial2 650.5 350.25 0.11 -0.02 0.004"', (650.5, 350.25), (0.11, -0.02, 0.004)),
        ('VICON_RADIAL2="ViconRadial2 653.5 349.25 0.06 -0.01"', (653.5, 349.25), (0.06, -0.01)),
    ],
)
def test_a_calibration_of_vicon(tmp_path, radial, centre_px, per_focal):
    rig = read_rig(copied(tmp_path, "vicon/a.xcp", (VICON_RADIAL, radial)))
    assert rig.names == ("2121", "2122")
    for index, (R, t_m) in enumerate(poses()):
        pixels, _ = project(rig.cameras[index], POINTS_M)
        straight = undistorted_by_vicon(pixels, np.array(centre_px), per_focal)
        # The fit's error is at most a tenth of a pixel, or there is a warning.
        np.testing.assert_allclose(straight, by_opencv(R, t_m, K, np.zeros(4)), rtol=0, atol=0.1)


@settings(max_examples=20, deadline=None)
@given(k1=st.floats(-0.1, 0.25), k2=st.floats(-0.03, 0.03), shift=st.floats(-2, 2))
def test_the_fit_to_vicons_lens_reaches_the_error_that_it_states(k1, k2, shift):
    """OpenCV's own distortion of the corners and edges agrees with the formula within the stated error."""
    centre_px = K[:2, 2] + shift
    fit = fit_distortion(K, SIZE_WH, centre_px, np.array([k1, k2]))
    assume(fit is not None)
    coefficients, error_px = fit
    pixels = np.array([[0.0, 0.0], [1279, 719], [640, 0], [0, 360], [300, 500], [1279, 0]])
    straight = undistorted_by_vicon(pixels, centre_px, (k1, k2))
    rays = cv2.convertPointsToHomogeneous((straight - K[:2, 2]) / np.diag(K)[:2])
    bent, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, coefficients)
    # Points between those of the fit's grid may be a little worse.
    assert np.abs(bent[:, 0] - pixels).max() <= 1.2 * error_px + 1e-6


def test_easymocaps_rodrigues_vectors_count_and_sizes_of_zero_are_not_known(tmp_path):
    outside = copied(tmp_path, "easymocap/extri.yml")
    inside = tmp_path / "intri.yml"
    wrong = "Rot_07: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n  data: [1.0, 0, 0, 0, 1, 0, 0, 0, 1]\n"
    outside.write_text(outside.read_text() + wrong)
    expected = read_rig(outside).cameras
    _, (R, _) = poses()
    np.testing.assert_allclose(expected.T_cam_world[1, :3, :3], R, rtol=0, atol=1e-12)
    inside.write_text(inside.read_text().replace(": 720", ": -1").replace(": 1280", ": -1"))
    assert_same(read_rig(outside, SIZE_WH).cameras, expected)


@pytest.mark.parametrize("upwards", [False, True])
@pytest.mark.parametrize("separator", [",", "\t", "  "])
def test_dlt_coefficients(tmp_path, run_psotrack, upwards, separator):
    """The third camera has the world's origin behind it, and is turned round."""
    behind = look_at((1.0, 0.0, 0.5), (3.0, 0.2, 0.7))
    to_file = np.array([[1.0, 0, 0], [0, -1, 720], [0, 0, 1]]) if upwards else np.eye(3)
    matrices = [to_file @ SKEWED @ np.column_stack(pose) for pose in (*poses(), behind)]
    columns = [(matrix / matrix[2, 3]).ravel()[:11] for matrix in matrices]
    lines = [separator.join(map(repr, row)) for row in np.transpose(columns).tolist()]
    path = tmp_path / "dltcoefs.csv"
    path.write_text("\n".join(lines))
    rig = read_rig(path, SIZE_WH, metres_per_unit=1.0)
    assert rig.names == ("cam1", "cam2", "cam3")
    np.testing.assert_allclose(rig.cameras.K, [SKEWED] * 3, rtol=0, atol=1e-7)
    for index, a in enumerate(columns[:2]):
        # The formula of the format.
        below = POINTS_M @ a[8:] + 1
        u = (POINTS_M @ a[:3] + a[3]) / below
        v = (POINTS_M @ a[4:7] + a[7]) / below
        if upwards:
            v = 720 - v
        pixels, _ = project(rig.cameras[index], POINTS_M)
        np.testing.assert_allclose(pixels, np.stack([u, v], axis=-1), rtol=0, atol=1e-6)
    np.testing.assert_allclose(rig.cameras.T_cam_world[2, :3], np.column_stack(behind), atol=1e-9)
    if separator == ",":
        # With the lenses of another file the rig is that of the pixels before they were undistorted.
        argus = "".join(
            f"{number} 900 1280 720 640 360 1 -0.1 0.02 0 0 {0.01 * number}\n" for number in (3, 2, 1)
        )
        (tmp_path / "argus.txt").write_text(argus)
        words = ("calibrate", "convert", path, tmp_path / "rig.toml", "--units", "m", "--size", "1280,720")
        assert run_psotrack(*words, "--distortion", tmp_path / "argus.txt", "--force").code == 0
        lenses = read_rig(tmp_path / "rig.toml").cameras
        np.testing.assert_allclose(lenses.K, rig.cameras.K, atol=1e-9)
        np.testing.assert_allclose(
            lenses.dist, [[-0.1, 0.02, 0, 0, 0.01 * number] for number in (1, 2, 3)], atol=1e-12
        )
        (tmp_path / "argus.txt").write_text(argus[: argus.index("1 900")])
        refused = partial(run_psotrack, *words, "--force", "--distortion", tmp_path / "argus.txt")
        assert_refused(refused, "argus.txt", "cam1", unchanged=tmp_path)
        path.write_text("a,b,c\n" + path.read_text())
        with_header = read_rig(path, SIZE_WH, metres_per_unit=1.0)
        assert with_header.names == ("a", "b", "c")


# What is refused.


def reads(file, text, size_wh=None, **options):
    """A file of this text is read."""

    def prepare(folder):
        (folder / file).write_text(text)
        return partial(read_rig, folder / file, size_wh, **options)

    return prepare


def changed(file, before="", after="", **options):
    """A sound file, with another text in it or as it is, is read."""
    return lambda folder: partial(read_rig, copied(folder, file, (before, after)), **options)


own = partial(changed, "rig.toml/rig.toml")
anipose = partial(changed, "rigs/calibration.toml")
qualisys = partial(changed, "qualisys/a.qca.txt")
kalibr = partial(changed, "kalibr/camchain.yaml")
vicon = partial(changed, "vicon/a.xcp")
dlt = partial(changed, "dlt/dlt.csv")


def makes(**fields):
    """A camera of these fields is made."""
    sound = {"R": np.eye(3), "t_m": np.zeros(3), "K": np.diag([100.0, 100, 1]), "image_size_wh": (100, 80)}
    return calls(make_camera, **(sound | fields))


def calls(function, *arguments, **options):
    return lambda folder: partial(function, *arguments, **options)


def writes_rig(file, **options):
    return lambda folder: partial(write_rig, folder / file, RIG, **options)


RIG, PIXELS = ring_rig(3), np.full((2, 3, 2), 100.0)
FISHEYES = ("distort", "fisheye = true\ndistort")
CUT_YAML = "cameras:\n   - a\n     b\n   K: {\n"
EXTRI = (SOUND / "easymocap/extri.yml").read_text()
ENTITY = '<!DOCTYPE x [<!ENTITY a "b">]><calibration>'
#: Name of the case -> how the bad input is made, and words of the line.
BAD = {
    # Our own files.
    "misspelt": (own("size", "szie"), "rig.toml", "c0.szie: expected one of", "mean size?"),
    "version": (own("version = 1", "version = 2"), "version: expected 1, found 2; use a newer"),
    "no tvec": (reads("x.toml", RIG_TOML.partition("tvec")[0]), "left.tvec: expected 3 numbers, as for rve"),
    "no size": (own("size = [320, 240]", ""), "c0.size or image_size: ", "pass --size"),
    # Texts of other programs.
    "no matrix": (anipose("matrix", "matrx"), "cam_0.matrix or K or camera_matrix", "found none"),
    "nan": (anipose("[[900.0", "[[nan"), "cam_0.matrix: expected finite numbers"),
    "lens of 3": (anipose("[-0.12,", "["), "distortions: expected 0, 4, 5, 8, 12, 14", "found 3"),
    "name twice": (anipose('"c1"', '"c0"'), "cam_1: expected each camera once, found c0 again"),
    "no unit": (anipose(*FISHEYES), "unit of lengths, found none", "leaves it open", "mm: --units"),
    "unit": (anipose("adj", 'unit = "ft"\nadj'), "metadata.unit: expected one of m, cm, mm, found"),
    "TOML": (reads("x.toml", "[cam_0\n"), "x.toml, line 1: expected valid TOML"),
    "no camera": (reads("x.toml", ""), "at least one camera, found none"),
    "YAML": (reads("x.yml", CUT_YAML), "line ", "expected valid YAML or JSON, found an error"),
    "unknown": (reads("x.dat", "1 2"), "x.dat: expected a rig file of a known format, found other content"),
    "size of DLT": (dlt(), "camera cam1", "pass --size"),
    "r12": (qualisys(' r12="', ' r12="3" q="'), "camera 26578, transform.r11 to r33: expected a rotation"),
    "XML": (qualisys("</cameras>", ""), "a.txt, line 2: expected valid XML, found an error (mismatched tag)"),
    "document type": (qualisys("<calibration>", ENTITY), "XML without document type"),
    "omni": (kalibr("pinhole", "omni"), "found omni; calibrate again with pinhole-radtan"),
    "bent": (
        vicon("0.06 -0.01", "-1.5 0"),
        "Camera 2121, KeyFrame.VICON_RADIAL2: expected a correction that",
    ),
    "quaternion": (
        vicon(VICON_TURN, "0.44 0.35 0.72 0.49"),
        "ORIENTATION: expected a quaternion of length 1",
    ),
    "no intri.yml": (reads("extri.yml", EXTRI), "expected intri.yml with the lenses beside it"),
    # Cameras and calls.
    "mirrored": (makes(R=np.diag([1.0, 1.0, -1.0])), "camera.R: expected a rotation matrix"),
    "focal 0": (makes(K=np.diag([0.0, 100, 1])), "camera.K: expected focal lengths above 0, found 0 and 100"),
    "pinhole of 3": (makes(dist=(0.1,) * 3), "expected 0, 4, 5, 8, 12 or 14 coefficients, found 3"),
    "no width": (makes(image_size_wh=(0, 480)), "camera.image_size_wh: expected sides of at least 1"),
    "no cameras": (calls(make_rig, {}), "expected at least one camera, found none"),
    "others": (calls(RIG.select, ["c0", "c7", "x"]), "expected some of c0, c1, c2, found c7, x"),
    "noise": (calls(reconstruct, RIG.cameras, PIXELS, noise_px=0.0), "noise_px: expected numbers above 0"),
    "never written": (writes_rig("rig.toml", file_format="pose2sim"), "format: expected one of rig, "),
    "lenses in YAML": (writes_rig("lenses.yml", placed=False), "ends in .toml, for lenses without poses"),
}


@pytest.mark.parametrize(("prepare", "words"), [(one, words) for one, *words in BAD.values()], ids=BAD)
def test_bad_input_is_refused_in_one_line(prepare, words, tmp_path, capfd):
    assert_refused(prepare(tmp_path), *words, unchanged=tmp_path)
    assert capfd.readouterr() == ("", "")
