"""Rig files, cameras and calls that are refused: one line says what was expected, what was found, and where."""

import numpy as np
import pytest
from helpers import assert_refused, ring_rig
from rig_texts import ANIPOSE, CALISCOPE, RIG_TOML, SIZE_WH, kalibr_file, qualisys_file, vicon_file

from psotrack.geometry import make_camera, make_rig, reconstruct
from psotrack.geometry.rig_files import read_rig, write_rig

FISHEYE = ANIPOSE.replace('"A"', '"A"\nfisheye = true')
#: Sound text, what is replaced in it, by what, and a part of the message.
CHANGED = [
    (RIG_TOML, "size =", "szie =", "cameras.left.szie: expected one of size, "),
    (RIG_TOML, "size =", "szie =", "; did you mean size?"),
    (RIG_TOML, "[cameras.left]", "version = 2\n[cameras.left]", "version: expected 1, found 2; use a newer"),
    (RIG_TOML, "rvec", 'model = "omni"\nrvec', "left.model: expected opencv or fisheye, found omni"),
    (RIG_TOML, "K = [[1160.2, 0,", "K = [[1160.2,", "cameras.left.K: expected 3 x 3 numbers"),
    (RIG_TOML, "tvec = [0.1, 0.2, 5.0]", "", "cameras.left.tvec: expected 3 numbers, as for rvec"),
    (RIG_TOML, "distortion = [", "distortion = [1,", "left.distortion: expected 0, 4, 5, 8, 12, 14"),
    (RIG_TOML, "size = [1920, 1080]", "", "cameras.left.size or image_size: expected width and"),
    (RIG_TOML, "size = [1920, 1080]", "", "found none; pass --size"),
    (ANIPOSE, "matrix", "matrx", "cam_0.matrix or K or camera_matrix: expected 3 x 3 numbers, found none"),
    (ANIPOSE, "[ 0.0, 0.0, 1.0,],]", "]", "cam_0.matrix: expected 3 x 3 numbers, found 2 x 3"),
    (ANIPOSE, "[ 1280, 720,]", "[ 1280.5, 720,]", "cam_0.size: expected whole numbers"),
    (ANIPOSE, "size = [ 1280, 720,]\n", "", "cam_0.size or image_size: expected width and"),
    (ANIPOSE, "822.4", "-822.4", "cam_0.matrix: expected intrinsics"),
    (ANIPOSE, "822.4", "nan", "cam_0.matrix: expected finite numbers"),
    (ANIPOSE, "822.4", '"f"', "cam_0.matrix: expected 3 x 3 numbers"),
    (ANIPOSE, " -0.06, 0.0,", "", "cam_0.distortions: expected 0, 4, 5, 8, 12, 14 coefficients, found 3"),
    (ANIPOSE, "[ 0.5, 0.25,", "[ 0.5,", "cam_0.rotation: expected 3 numbers or 3 x 3 numbers"),
    (ANIPOSE, '"B"', '"A"', "cam_1: expected each camera once, found A again"),
    (FISHEYE, "-0.06, 0.0,", "-0.06, 0.1, 0.1, 0.1, 0.1,", "expected 4 coefficients of a fisheye, found 8"),
    (CALISCOPE, "[0.0, -1.0, 0.0]", "[0.0, 1.0, 0.0]", "cameras.0.rotation: expected a rotation matrix"),
    (CALISCOPE, "matrix = [[6", "m = [[6", "cameras.2.matrix or K or camera_matrix: expected 3 x 3 numbers"),
]
#: Name of a file, its text or a function that writes the file, and a part of the message.
BAD = [
    ("x.json", "{}", "camera.matrix or K or camera_matrix: expected 3 x 3 numbers, found none"),
    ("x.dat", "1 2", "x.dat: expected a rig file of a known format, found other content"),
    ("x.toml", "[cam_0\n", "x.toml, line 1: expected valid TOML"),
    ("x.toml", "", "at least one camera, found none"),
    ("x.yml", "cameras:\n   - a\n     b\n   K: {\n", "expected valid YAML or JSON, found an error"),
    ("x.yml", "cameras:\n   - { K: [1, 2] }\n", "cameras[0].name: expected a name, found none"),
    ("x.yml", "cameras:\n   - { name: c, K: [1, 2] }\n", "cameras[0].K: expected 3 x 3 numbers, found 2"),
    ("x.csv", "cam_name\n", "x.csv, line 1"),
    ("dlt.csv", "\n".join(["1,2"] * 10 + ["nan,1"]), "camera cam1.coefficients: expected finite numbers"),
    ("dlt.csv", "\n".join(["1,2"] * 11), "expected the coefficients of a camera, found a determinant of 0"),
    *(("x.toml", text.replace(old, new, 1), message) for text, old, new, message in CHANGED),
    *(
        ("session.qca.txt", lambda path, change=change: qualisys_file(path, change), message)
        for change, message in [
            (('r11="', 'r11="x'), "camera 26578, transform.r11: expected a number"),
            ((' r12="', ' r12="3" q="'), "camera 26578, transform.r11 to r33: expected a rotation matrix"),
            (('focalLengthU="', 'focalLengthU="-'), "camera 26578.K: expected intrinsics"),
            ((' x="', ' q="'), "camera 26578, transform.x: expected a number, found none"),
            (
                ('serial="26579"', 'serial="26578"'),
                "camera 26578: expected each camera once, found 26578 again",
            ),
            (
                ("</cameras>", ""),
                "session.qca.txt, line 2: expected valid XML, found an error (mismatched tag)",
            ),
            (("<calibration>", '<!DOCTYPE x [<!ENTITY a "b">]><calibration>'), "XML without document type"),
        ]
    ),
    *(
        (
            "camchain.yaml",
            lambda path, model=model: kalibr_file(path, camera_model=model),
            f"found {model}; calibrate again with pinhole-radtan",
        )
        for model in ("omni", "eucm", "ds")
    ),
    (
        "camchain.yaml",
        lambda path: kalibr_file(path, distortion_model="fov"),
        "cam0.distortion_model: expected radtan, equidistant or none, found fov",
    ),
    (
        "session.xcp",
        lambda path: vicon_file(path, 'VICON_RADIAL2="ViconRadial2 650.5 350.25 -1.5 0"'),
        "Camera 2121, KeyFrame.VICON_RADIAL2: expected a correction that keeps",
    ),
]


@pytest.mark.parametrize(("file", "text", "message"), BAD)
def test_a_bad_file_is_refused(tmp_path, file, text, message, capfd):
    path = tmp_path / file
    if callable(text):
        text(path)
    else:
        path.write_text(text)
    size_wh = SIZE_WH if file.endswith("csv") else None
    assert_refused(
        lambda: read_rig(path, size_wh, metres_per_unit=1.0 if "dlt" in file else None),
        *(path, message),
        unchanged=tmp_path,
    )
    assert capfd.readouterr() == ("", "")


CAMERA = {"R": np.eye(3), "t_m": np.zeros(3), "K": np.diag([100.0, 100.0, 1.0]), "image_size_wh": (100, 80)}
#: Fields of a camera, and the message.
BAD_CAMERAS = [
    ({"R": np.diag([1.0, 1.0, -1.0])}, "camera.R: expected a rotation matrix"),
    ({"R": 1.001 * np.eye(3)}, "camera.R: expected a rotation matrix"),
    ({"K": np.diag([0.0, 100.0, 1.0])}, "camera.K: expected focal lengths above 0, found 0 and 100"),
    ({"K": np.diag([100.0, -5.0, 1.0])}, "camera.K: expected focal lengths above 0, found 100 and -5"),
    ({"t_m": np.array([0.0, np.nan, 0.0])}, "expected finite numbers, found NaN or infinity"),
    ({"dist": (0.1, np.nan, 0.0, 0.0)}, "expected finite numbers"),
    ({"dist": (0.1, np.nan, 0.0, 0.0), "fisheye": True}, "expected finite numbers, found NaN"),
    ({"dist": (0.1,) * 5, "fisheye": True}, "expected 0 or 4 coefficients of a fisheye, found 5"),
    ({"image_size_wh": (0, 480)}, "camera.image_size_wh: expected sides of at least 1"),
    ({"dist": (0.1, 0.2, 0.3)}, "camera.dist: expected 0, 4, 5, 8, 12 or 14 coefficients, found 3"),
]
PIXELS = np.full((2, 3, 2), 100.0)
#: What is asked of a rig of three cameras and a folder, and the message.
BAD_CALLS = [
    (lambda rig, _: make_rig({}), "expected at least one camera, found none"),
    (lambda rig, _: rig.select(["c0", "c7", "x"]), "expected some of c0, c1, c2, found c7, x"),
    (lambda rig, _: rig.select([]), "found none"),
    *(
        (
            lambda rig, _, noise=noise: reconstruct(rig.cameras, PIXELS, noise_px=noise),
            "noise_px: expected numbers above 0",
        )
        for noise in (0.0, -1.0, np.nan)
    ),
    *(
        (
            lambda rig, _, rate=rate: reconstruct(rig.cameras, PIXELS, false_alarm=rate),
            "false_alarm: expected a probability",
        )
        for rate in (0.0, 1.0, np.nan)
    ),
    (lambda rig, folder: read_rig(folder / "no.toml"), "expected a file to read"),
    (lambda rig, folder: read_rig(folder / "no.csv", (10, 10)), "expected a file to read"),
    (
        lambda rig, folder: write_rig(folder / "rig.csv", rig),
        "camera c0: expected one focal length, found fx",
    ),
    (
        lambda rig, folder: write_rig(folder / "rig.toml", rig, file_format="pose2sim"),
        "format: expected one of rig, ",
    ),
    (
        lambda rig, folder: write_rig(folder / "lenses.yml", rig, placed=False),
        "ends in .toml, for lenses without poses",
    ),
]


@pytest.mark.parametrize(("fields", "message"), BAD_CAMERAS)
def test_an_impossible_camera_is_refused(tmp_path, fields, message):
    assert_refused(lambda: make_camera(**(CAMERA | fields)), message, unchanged=tmp_path)


@pytest.mark.parametrize(("call", "message"), BAD_CALLS)
def test_a_bad_call_is_refused(tmp_path, call, message):
    assert_refused(lambda: call(ring_rig(3), tmp_path), message, unchanged=tmp_path)
