"""Files of rigs: writing and reading every layout, files of other programs, and errors in a file."""

import cv2
import numpy as np
import pytest
from helpers import LENSES, assert_same, ring_rig
from rig_texts import ANIPOSE, CALISCOPE, RIG_TOML, SAMPLE

from psotrack.errors import InputError
from psotrack.geometry import Rig, make_rig, project
from psotrack.geometry.rig_files import KEYS, read_lenses, read_rig, write_rig
from psotrack.recordings import CameraTable


def with_names(rig, *names):
    return Rig((*names, *rig.names[len(names) :]), rig.cameras)


@pytest.mark.parametrize("coefficients", sorted(LENSES))
@pytest.mark.parametrize("file", ["rig.yml", "rig.yaml", "rig.toml", "camera_array.toml", "anipose"])
def test_a_rig_is_read_as_it_was_written(tmp_path, file, coefficients):
    # Eleven cameras, whose tables must not be sorted as text. Three names that need care: a serial number, a word of
    # YAML, and characters that must be quoted.
    rig = with_names(ring_rig(11, coefficients=coefficients), "60881257", "true", 'a "b" \\ é: # 🚁')
    file, file_format = ("calibration.toml", "anipose") if file == "anipose" else (file, None)
    write_rig(tmp_path / file, rig, file_format=file_format)
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
    with pytest.raises(
        InputError,
        match=r"rig\.csv, camera cam1i\.size .*: expected width and height.*pass --size",
    ):
        read_rig(tmp_path / "rig.csv")


@pytest.mark.parametrize(
    ("text", "names", "unit_m", "dist", "rvec", "tvec"),
    [
        (ANIPOSE, ("A", "B"), 1e-3, (-0.06, 0, 0, 0, 0), (0.5, 0.25, -0.125), (-94.5, 8.25, 500.0)),
        (RIG_TOML, ("left",), 1.0, (-0.28, 0.09, 0, 0, 0.01), (1.2, -0.4, 0.3), (0.1, 0.2, 5.0)),
    ],
)
def test_a_file_projects_as_opencv_does(tmp_path, text, names, unit_m, dist, rvec, tvec):
    path = tmp_path / "calibration.toml"
    path.write_text(text)
    rig = read_rig(path, metres_per_unit=unit_m)
    assert rig.names == names
    K, point_m = rig.cameras.K[0], np.array([0.03, -0.02, 0.1])
    assert f"{K[0, 0]}, 0" in text
    assert f"{K[0, 2]}" in text
    expected = cv2.projectPoints(point_m[None] / unit_m, np.array(rvec), np.array(tvec), K, np.array(dist))[0]
    # Both evaluate the same formula, in metres and in the file's unit.
    np.testing.assert_allclose(project(rig.cameras[0], point_m)[0], expected[0, 0], atol=1e-9)


def test_a_file_of_caliscope(tmp_path, caplog):
    path = tmp_path / "camera_array.toml"
    path.write_text(CALISCOPE)
    with caplog.at_level("WARNING"):
        assert read_rig(path).names == ("0",)
    assert "no pose: camera 2" in caplog.text
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
    with pytest.raises(
        InputError, match=r"left\.yml: expected the poses of cameras, found none; .*calibrate rig"
    ):
        read_rig(path)


def test_a_camera_of_a_rig_toml_without_a_place_is_left_out(tmp_path, caplog):
    path = tmp_path / "rig.toml"
    path.write_text(RIG_TOML + RIG_TOML.replace("left", "right").partition("rvec")[0])
    assert read_rig(path).names == ("left",)
    assert "no pose: camera right" in caplog.text
    assert read_lenses(path).names == ("left", "right")


def test_lenses_are_written_without_poses(tmp_path):
    rig = ring_rig(2, coefficients=5)
    write_rig(tmp_path / "lenses.toml", rig, placed=False)
    np.testing.assert_array_equal(read_lenses(tmp_path / "lenses.toml").cameras.K, rig.cameras.K)
    with pytest.raises(InputError, match="expected the poses of cameras, found none"):
        read_rig(tmp_path / "lenses.toml")


def test_the_cameras_of_a_recording_are_a_rig(tmp_path):
    """The keys that a recording has beside a rig's are left alone, and none counts as a misspelt one."""
    values = {"frames": 3, "fps": 25.0, "time_offset_s": 0.1, "line_time_s": 1e-5}
    keys = [key for key in CameraTable.__struct_fields__ if key not in KEYS]
    lines = [f"{key} = {values.get(key, repr('a'))}\n" for key in keys]
    (tmp_path / "recording.toml").write_text("version = 1\n" + RIG_TOML + "".join(lines))
    assert read_rig(tmp_path / "recording.toml").names == ("left",)


def test_a_unit_that_a_format_leaves_open_must_be_stated(tmp_path, caplog):
    path = tmp_path / "calibration.toml"
    path.write_text(ANIPOSE)
    with pytest.raises(
        InputError, match=r"expected a unit of lengths, found none, .* state m or cm or mm: --units"
    ):
        read_rig(path)
    path.write_text(ANIPOSE.replace("adjusted", 'unit = "cm"\nadjusted'))
    stated = read_rig(path).cameras.T_cam_world[:, :3, 3]
    np.testing.assert_allclose(stated[0], [-0.945, 0.0825, 5.0], atol=1e-15)
    other = read_rig(path, metres_per_unit=1e-3).cameras.T_cam_world[:, :3, 3]
    np.testing.assert_allclose(other, 0.1 * stated, atol=1e-15)
    assert "in units of 0.01 m by the file, and are read in units of 0.001 m" in caplog.text
    path.write_text(ANIPOSE.replace("adjusted", 'unit = "furlong"\nadjusted'))
    with pytest.raises(InputError, match=r"metadata\.unit: expected one of m, cm, mm, found furlong"):
        read_rig(path)


def test_opencv_reads_a_written_rig(tmp_path):
    rig = ring_rig(3, coefficients=5)
    write_rig(tmp_path / "rig.yml", rig)
    storage = cv2.FileStorage(str(tmp_path / "rig.yml"), cv2.FILE_STORAGE_READ)
    second = storage.getNode("cameras").at(1)
    assert second.getNode("name").string() == "c1"
    np.testing.assert_array_equal(second.getNode("K").mat(), rig.cameras.K[1])
    np.testing.assert_array_equal(second.getNode("t").mat().ravel(), rig.cameras.T_cam_world[1, :3, 3])
