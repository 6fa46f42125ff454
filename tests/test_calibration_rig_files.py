"""Files of rigs: writing and reading every layout, files of other programs, and errors in a file."""

import cv2
import numpy as np
import pytest
from helpers import LENSES, assert_same, ring_rig

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.geometry import Rig, make_rig, project, read_lenses, read_rig, write_rig

#: File as anipose 1.1 writes it: tables cam_0 ..., lengths in the board's unit.
ANIPOSE = """[cam_0]
name = "A"
size = [ 1280, 720,]
matrix = [ [ 822.4, 0.0, 639.5,], [ 0.0, 822.4, 359.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.06, 0.0, 0.0, 0.0, 0.0,]
rotation = [ 0.5, 0.25, -0.125,]
translation = [ -94.5, 8.25, 500.0,]

[cam_1]
name = "B"
size = [ 1280, 720,]
matrix = [ [ 851.9, 0.0, 639.5,], [ 0.0, 851.9, 359.5,], [ 0.0, 0.0, 1.0,],]
distortions = [ -0.1, 0.0, 0.0, 0.0, 0.0,]
rotation = [ 0.0, -0.5, 0.0,]
translation = [ 318.0, 10.0, 400.0,]

[metadata]
adjusted = false
error = 0.26
"""

#: File as caliscope writes it: numbers as names, and ignored cameras. Older files have rotation matrices, as camera 0.
CALISCOPE = """[cameras.0]
cam_id = 0
size = [1280, 720]
rotation_count = 0
error = 0.541
matrix = [[903.5, 0.0, 618.25], [0.0, 907.75, 394.5], [0.0, 0.0, 1.0]]
distortions = [-0.33, 0.046, -0.0043, 0.0041, 0.066]
translation = [0.125, -0.25, 0.5]
rotation = [[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
exposure = -8
fisheye = false

[cameras.1]
port = 1
ignore = true
size = [640, 480]

[cameras.2]
port = 2
size = [640, 480]
error = "null"
matrix = [[650.0, 0.0, 320.0], [0.0, 654.0, 240.0], [0.0, 0.0, 1.0]]
distortions = [0.18, -0.25, 0.003, 0.002, 0.12]
translation = "null"
rotation = "null"
"""

#: File as OpenCV's sample program for calibration writes it.
SAMPLE = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 6.5e+02, 0., 320., 0., 6.5e+02, 240., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ 0.25, -0.5, 0., 0., 0.125 ]
"""


def with_names(rig, *names):
    return Rig((*names, *rig.names[len(names) :]), rig.cameras)


@pytest.mark.parametrize("coefficients", sorted(LENSES))
@pytest.mark.parametrize("file", ["rig.yml", "rig.yaml", "rig.toml", "camera_array.toml"])
def test_a_rig_is_read_as_it_was_written(tmp_path, file, coefficients):
    # Eleven cameras, whose tables must not be sorted as text. Three names that need care: a serial number, a word of
    # YAML, and characters that must be quoted.
    rig = with_names(ring_rig(11, coefficients=coefficients), "60881257", "true", 'a "b" \\ é: #')
    write_rig(tmp_path / file, rig)
    back = read_rig(tmp_path / file)
    assert back.names == rig.names
    # Exact, except rotations that are stored as Rodrigues vectors: some roundings of numbers up to 1.
    rounding = 2e-15 if file.endswith("toml") else 0.0
    np.testing.assert_allclose(back.cameras.T_cam_world, rig.cameras.T_cam_world, rtol=0, atol=rounding)
    np.testing.assert_array_equal(back.cameras.T_cam_world[:, :3, 3], rig.cameras.T_cam_world[:, :3, 3])
    np.testing.assert_array_equal(back.cameras.K, rig.cameras.K)
    np.testing.assert_array_equal(back.cameras.image_size_wh, rig.cameras.image_size_wh)
    if coefficients:
        np.testing.assert_array_equal(back.cameras.dist, rig.cameras.dist)
    else:
        assert not back.cameras.dist.any()


def test_a_rig_in_the_datasets_layout_is_read_as_it_was_written(tmp_path):
    K = np.array([[1157.0, 0, 960.5], [0, 1157.0, 540.25], [0, 0, 1]])
    rig = ring_rig(5, coefficients=4, image_size_wh=(1920, 1080))
    camera = rig.cameras[2]
    rig = make_rig({"cam1i": type(camera)(camera.T_cam_world, K, camera.dist, camera.image_size_wh)})
    write_rig(tmp_path / "rig.csv", rig)
    back = read_rig(tmp_path / "rig.csv", (1920, 1080))
    assert back.names == rig.names
    # Rotations are stored as Rodrigues vectors.
    assert_same(back.cameras, rig.cameras, atol=2e-15)
    with pytest.raises(InputError, match=r"rig\.csv: expected the size of the images.*pass --size"):
        read_rig(tmp_path / "rig.csv")


def test_a_rig_that_the_datasets_layout_cannot_hold_is_refused(tmp_path):
    with pytest.raises(SettingsError, match="one focal length per camera and no skew"):
        write_rig(tmp_path / "rig.csv", ring_rig(2))
    assert not list(tmp_path.iterdir())


def test_a_file_of_anipose(tmp_path):
    path = tmp_path / "calibration.toml"
    path.write_text(ANIPOSE)
    rig = read_rig(path, metres_per_unit=1e-3)
    assert rig.names == ("A", "B")
    K, dist = rig.cameras.K[0], rig.cameras.dist[0]
    assert (K[0, 0], K[0, 2], dist[0]) == (822.4, 639.5, -0.06)
    point_m = np.array([0.03, -0.02, 0.1])
    expected = cv2.projectPoints(
        1e3 * point_m[None], np.array([0.5, 0.25, -0.125]), np.array([-94.5, 8.25, 500.0]), K, dist
    )[0]
    # Both evaluate the same formula, in metres and in millimetres.
    np.testing.assert_allclose(project(rig.cameras[0], point_m)[0], expected[0, 0], atol=1e-9)


def test_a_file_of_caliscope(tmp_path):
    path = tmp_path / "camera_array.toml"
    path.write_text(CALISCOPE)
    with pytest.raises(
        InputError, match=r"camera_array\.toml, cameras\.2\.rotation or R or rvec: .*, found none"
    ):
        read_rig(path)
    lenses = read_lenses(path)
    assert lenses.names == ("0", "2")
    np.testing.assert_array_equal(lenses.cameras.T_cam_world, np.tile(np.eye(4), (2, 1, 1)))
    path.write_text(CALISCOPE.partition("[cameras.2]")[0])
    rig = read_rig(path)
    np.testing.assert_array_equal(
        rig.cameras.T_cam_world[0], [[0, -1, 0, 0.125], [0, 0, -1, -0.25], [1, 0, 0, 0.5], [0, 0, 0, 1]]
    )


def test_a_file_of_opencvs_sample(tmp_path):
    path = tmp_path / "left.yml"
    path.write_text(SAMPLE)
    lenses = read_lenses(path)
    assert lenses.names == ("left",)
    np.testing.assert_array_equal(lenses.cameras.K[0], [[650, 0, 320], [0, 650, 240], [0, 0, 1]])
    np.testing.assert_array_equal(lenses.cameras.dist[0], [0.25, -0.5, 0, 0, 0.125])
    np.testing.assert_array_equal(lenses.cameras.image_size_wh[0], [640, 480])
    with pytest.raises(InputError, match=r"left\.yml, camera\.rotation or R or rvec"):
        read_rig(path)


def test_opencv_reads_a_written_rig(tmp_path):
    rig = ring_rig(3, coefficients=5)
    write_rig(tmp_path / "rig.yml", rig)
    storage = cv2.FileStorage(str(tmp_path / "rig.yml"), cv2.FILE_STORAGE_READ)
    second = storage.getNode("cameras").at(1)
    assert second.getNode("name").string() == "c1"
    np.testing.assert_array_equal(second.getNode("K").mat(), rig.cameras.K[1])
    np.testing.assert_array_equal(second.getNode("t").mat().ravel(), rig.cameras.T_cam_world[1, :3, 3])


def test_an_existing_file_is_overwritten_only_by_force(tmp_path):
    path = tmp_path / "rig.toml"
    write_rig(path, ring_rig(2))
    before = path.read_bytes()
    with pytest.raises(OutputError, match="--force"):
        write_rig(path, ring_rig(3))
    assert path.read_bytes() == before
    write_rig(path, ring_rig(3), force=True)
    assert len(read_rig(path)) == 3
    assert [file.name for file in tmp_path.iterdir()] == ["rig.toml"]


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("x.json", "{}", "a file that ends in .csv, .toml, .yml, .yaml, found x.json"),
        ("x.toml", "[cam_0\n", "x.toml, line 1: expected valid TOML"),
        ("x.toml", "", "at least one camera, found none"),
        (
            "x.toml",
            ANIPOSE.replace("matrix", "matrx", 1),
            "x.toml, cam_0.matrix: expected 3 x 3 numbers, found none",
        ),
        (
            "x.toml",
            ANIPOSE.replace("[ 0.0, 0.0, 1.0,],]", "]", 1),
            "cam_0.matrix: expected 3 x 3 numbers, found 2 x 3",
        ),
        (
            "x.toml",
            ANIPOSE.replace("[ 1280, 720,]", "[ 1280.5, 720,]", 1),
            "cam_0.size: expected whole numbers",
        ),
        (
            "x.toml",
            ANIPOSE.replace("size = [ 1280, 720,]\n", "", 1),
            "cam_0.size or image_size: expected width and",
        ),
        ("x.toml", ANIPOSE.replace("822.4", "-822.4"), "cam_0.matrix: expected intrinsics"),
        ("x.toml", ANIPOSE.replace("822.4", "nan"), "cam_0.matrix: expected finite numbers"),
        ("x.toml", ANIPOSE.replace("822.4", '"f"'), "cam_0.matrix: expected 3 x 3 numbers"),
        (
            "x.toml",
            ANIPOSE.replace(" -0.06, 0.0,", ""),
            "cam_0.distortions: expected 0, 4, 5, 8 coefficients, found 3",
        ),
        (
            "x.toml",
            ANIPOSE.replace("[ 0.5, 0.25,", "[ 0.5,"),
            "cam_0.rotation: expected 3 numbers or 3 x 3 numbers",
        ),
        ("x.toml", ANIPOSE.replace('"B"', '"A"'), "cam_1.name: expected each camera once, found A again"),
        ("x.toml", ANIPOSE.replace('"A"', '"A"\nfisheye = true'), "cam_0.fisheye: expected a lens of"),
        (
            "x.toml",
            CALISCOPE.replace("[0.0, -1.0, 0.0]", "[0.0, 1.0, 0.0]"),
            "cameras.0.rotation: expected a rotation matrix",
        ),
        (
            "x.toml",
            CALISCOPE.replace("matrix = [[6", "m = [[6"),
            "cameras.2.matrix: expected 3 x 3 numbers, found none",
        ),
        ("x.yml", "", "camera.matrix or K or camera_matrix: expected 3 x 3 numbers, found none"),
        ("x.yml", "cameras:\n   - a\n     b\n   K: {\n", "expected OpenCV's YAML, found an error"),
        ("x.yml", "cameras:\n   - { K: [1, 2] }\n", "cameras[0].name: expected a name, found none"),
        ("x.yml", "cameras:\n   - { name: c, K: [1, 2] }\n", "cameras[0].K: expected 3 x 3 numbers, found 2"),
        ("x.csv", "cam_name\n", "x.csv, line 1"),
    ],
)
def test_an_invalid_file_gives_an_error_of_one_line(tmp_path, file, text, message, capfd):
    (tmp_path / file).write_text(text)
    with pytest.raises(InputError) as error:
        read_rig(tmp_path / file, (10, 10) if file.endswith("csv") else None)
    assert message in str(error.value)
    assert str(tmp_path / file) in str(error.value)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("file", ["no.toml", "no.yml", "no.csv"])
def test_a_missing_file_is_refused(tmp_path, file):
    with pytest.raises(InputError, match="expected a file to read"):
        read_rig(tmp_path / file, (10, 10))
