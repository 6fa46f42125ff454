"""Labels, compared with boxes computed by hand and by OpenCV; data sets as trainers read them."""

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import yaml
from helpers import assert_refused, far_camera, ring_rig, with_cameras
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from worlds import CAMERAS, NUM_FRAMES, two_flights

from psotrack.foreground.detection import LabelSettings, box_corners, label_boxes, write_data_set
from psotrack.geometry import look_at, make_camera, project
from psotrack.recordings import FrameTimes, Reference, read_frames
from psotrack.recordings.datasets import open_recording
from psotrack.trajectories import Trajectories

#: A distant camera at y = -1000 m with 100 x 80 pixels and 10 pixels per metre; x is to the right, z is up.
FAR = far_camera(image_size_wh=(100, 80), pixels_per_m=10.0)


CUBE = LabelSettings(drone_size_m=(2.0, 2.0, 2.0))


SIZE_M = (0.6, 0.4, 0.3)


def make_reference(position_m, orientation_wxyz=None):
    """Make a reference from positions (frames, drones, 3) in metres and orientations (frames, drones, 4)."""
    position_m = np.asarray(position_m, np.float64)
    frame = np.arange(len(position_m))
    names = tuple(f"dron{number + 1}" for number in range(position_m.shape[1]))
    if orientation_wxyz is not None:
        orientation_wxyz = np.asarray(orientation_wxyz, np.float64)
    return Trajectories(frame, frame / 25, names, position_m, orientation_wxyz=orientation_wxyz)


def compute_labels(*position_m, camera=FAR, settings=CUBE, orientation_wxyz=None):
    """Return the label boxes in an image, (drones, 4), pixels."""
    truth = make_reference([position_m], None if orientation_wxyz is None else [orientation_wxyz])
    return label_boxes(camera, box_corners(truth, settings), settings)[0]


def labels_in_rig(rig, truth, settings):
    """Return the label boxes of all cameras, (frames, drones, cameras, 4), pixels."""
    corners_m = box_corners(truth, settings)
    boxes = [label_boxes(rig.cameras[index], corners_m, settings) for index in range(len(rig))]
    return np.stack(boxes, axis=2)


# --- boxes in one image, computed by hand


def test_missing_orientations():
    """A drone without any orientation has a level box; a drone with gaps has no box in the gaps."""
    truth = make_reference(np.zeros((2, 2, 3)), np.full((2, 2, 4), np.nan))
    truth.orientation_wxyz[0, 1] = (1, 0, 0, 0)
    corners_m = box_corners(truth, CUBE)
    assert np.isfinite(corners_m[:, 0]).all()
    assert np.isfinite(corners_m[0, 1]).all()
    assert np.isnan(corners_m[1, 1]).all()


NONE = [np.nan] * 4
#: Of the nearer drone of two, half a metre beside the farther one: it covers three quarters.
NEAR = [45, 30, 65, 50]


@pytest.mark.parametrize(
    ("places_m", "change", "expected"),
    [
        # Three quarters of a box from 85 to 105 are in an image of 100 pixels.
        ([(4.5, 0, 0)], {"min_inside": 0.7}, [[85, 30, 100, 50]]),
        ([(4.5, 0, 0)], {"min_inside": 0.8}, [NONE]),
        ([(7, 0, 0), (0, 0, -6)], {"min_inside": 0.0}, [NONE, NONE]),
        # Behind the camera, around the camera, and with one corner behind the camera.
        ([(0, -2000, 0), (0, -1000, 0), (0, -999.5, 0)], {"min_inside": 0.0}, [NONE, NONE, NONE]),
        ([(0, 5, 0), (0.5, 0, 0)], {"max_hidden": 0.74}, [NONE, NEAR]),
        ([(0, 5, 0), (0.5, 0, 0)], {"max_hidden": 0.76}, [[40, 30, 60, 50], NEAR]),
        # Drones without an image or a pose hide no other drone.
        ([(0, 0, 0), (0, -1500, 0), (math.nan,) * 3], {"max_hidden": 0.0}, [[40, 30, 60, 50], NONE, NONE]),
    ],
)
def test_drones_at_the_border_behind_the_camera_and_behind_each_other(places_m, change, expected):
    found = compute_labels(*places_m, settings=msgspec.structs.replace(CUBE, **change))
    np.testing.assert_allclose(found, expected, atol=0.06)


@pytest.mark.parametrize("coefficients", [0, 8])
def test_boxes_agree_with_corners_projected_by_opencv(coefficients):
    rig = ring_rig(3, coefficients=coefficients)
    rng = np.random.default_rng(0)
    position_m = rng.uniform((-1, -1, 0.8), (1, 1, 1.8), (7, 1, 3))
    wxyz = Rotation.random(7, rng=1).as_quat(scalar_first=True)[:, None]
    size_m, offset_m = np.array([0.5, 0.3, 0.2]), np.array([0.05, -0.1, 0.02])
    chosen = LabelSettings(tuple(size_m.tolist()), tuple(offset_m.tolist()))
    found = labels_in_rig(rig, make_reference(position_m, wxyz), chosen)
    signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    for f in range(7):
        turn = Rotation.from_quat(wxyz[f, 0], scalar_first=True)
        corners_m = position_m[f, 0] + turn.apply(offset_m + signs * size_m / 2)
        for c in range(3):
            camera, (R, t_m) = rig.cameras[c], np.split(rig.cameras[c].T_cam_world[:3], [3], axis=1)
            dist = camera.dist if coefficients else None
            pixels = cv2.projectPoints(corners_m, cv2.Rodrigues(R)[0], t_m, camera.K, dist)[0][:, 0]
            expected = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)]) + 0.5
            expected = np.clip(expected, 0, [320, 240, 320, 240])
            np.testing.assert_allclose(found[f, 0, c], expected, atol=1e-9)


def test_points_far_outside_are_not_mapped_into_the_image():
    """The lens polynomial decreases far from the axis: it maps 65 degrees to the radius of 28 degrees."""
    R, t_m = look_at((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    K = np.array([[1158.0, 0, 962], [0, 1158, 541], [0, 0, 1]])
    bent = make_camera(R=R, t_m=t_m, K=K, image_size_wh=(1924, 1082), dist=(-0.17, 0.0, 0.0, 0.0))
    far_outside_m = (2.0, -2.0 * math.tan(math.radians(65)), 0.0)
    pixel, _ = project(bent, np.array(far_outside_m))
    assert (pixel > 0).all()
    assert (pixel < (1924, 1082)).all()
    small = LabelSettings(drone_size_m=(0.3, 0.3, 0.2))
    assert np.isnan(compute_labels(far_outside_m, camera=bent, settings=small)).all()
    # A drone in the corner of the image has a label.
    corner = np.array([1.0, -0.8, 0.4]) * 4
    assert np.isfinite(compute_labels(tuple(corner), camera=bent, settings=small)).all()


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_labels_are_inside_the_image_and_do_not_depend_on_the_order(seed):
    rng = np.random.default_rng(seed)
    rig = ring_rig(3, coefficients=4)
    position_m = rng.uniform((-6, -6, -1), (6, 6, 4), (2, 5, 3))
    chosen = LabelSettings((0.8, 0.6, 0.4), min_inside=rng.uniform(), max_hidden=rng.uniform())
    order = rng.permutation(5)

    def compute_boxes(position_m):
        return labels_in_rig(rig, make_reference(position_m), chosen)

    found = compute_boxes(position_m)
    np.testing.assert_array_equal(compute_boxes(position_m[:, order]), found[:, order])
    visible_boxes = found[np.isfinite(found).all(axis=-1)]
    assert np.isfinite(found).all(axis=-1).sum() == np.isfinite(found).any(axis=-1).sum()
    assert ((visible_boxes >= 0) & (visible_boxes <= (320, 240, 320, 240))).all()
    assert (visible_boxes[:, 2:] > visible_boxes[:, :2]).all()


# --- data sets


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    """Folder with the sequences `flight` and `second`."""
    return two_flights(tmp_path_factory)


@pytest.fixture
def run_labels(flights, run_psotrack):
    """Runs `simulate labels` for some of the sequences."""

    def run(names, *words):
        sequences = [flights / name for name in names]
        size = ("--drone-size", "0.6,0.4,0.3")
        return run_psotrack("simulate", "labels", *sequences, *size, "--jobs", 1, "--quiet", *words)

    return run


def load_data_set(out):
    """Read the data set like a trainer: (part, path of the image) -> rows of labels.

    A trainer reads the image folders from `data.yaml` by PyYAML's `safe_load`, and finds the labels of an image by
    replacing the last /images/ by /labels/ and the suffix by .txt. A row has five numbers from 0 to 1, and no row is
    repeated.
    """
    content = yaml.safe_load((out / "data.yaml").read_text(encoding="utf-8"))
    assert set(content) == {"path", "train", "val", "nc", "names"}
    assert content["nc"] == len(content["names"]) == 1
    found = {}
    for part in ("train", "val"):
        folder = Path(content["path"]) / content[part]
        assert folder.is_dir()
        for image in sorted(folder.iterdir()):
            assert image.suffix == ".jpg"
            before, after = str(image).rsplit("/images/", 1)
            text = Path(f"{before}/labels/{after}").with_suffix(".txt").read_text()
            rows = np.array([line.split() for line in text.splitlines()], float).reshape(-1, 5)
            assert (rows[:, 0] == 0).all()
            assert ((rows[:, 1:] >= 0) & (rows[:, 1:] <= 1)).all()
            assert len(np.unique(rows, axis=0)) == len(rows)
            found[part, image] = rows
    return found


def corners_px(rows):
    """The boxes (labels, 4) of rows of a file of labels, pixels."""
    middle, size = rows[:, 1:3], rows[:, 3:]
    return np.hstack([middle - size / 2, middle + size / 2]) * [320, 240, 320, 240]


def test_the_data_set_can_be_loaded_by_a_trainer(flights, run_labels, tmp_path):
    out = tmp_path / "set"
    result = run_labels(("flight", "second"), "--out", out, "--json", "-")
    assert result.code == 0
    counts, found = json.loads(result.out), load_data_set(out)
    assert len(list((out / "labels").glob("*/*.txt"))) == len(found)
    for part, name in (("train", "flight"), ("val", "second")):
        recording = open_recording(flights / name)
        rows = [value for (part_of_image, _), value in found.items() if part_of_image == part]
        assert counts[part] == {"images": len(rows), "labels": sum(map(len, rows))}
        assert len(rows) == NUM_FRAMES * len(CAMERAS)
        boxes = labels_in_rig(recording.rig, recording.truth, LabelSettings(SIZE_M))
        for index, camera in enumerate(recording.rig.names):
            for frame, shown in enumerate(read_frames(recording.videos[camera])):
                image = out / "images" / part / f"{name}_{camera}_{frame:06d}.jpg"
                expected = boxes[frame, :, index]
                expected = expected[np.isfinite(expected).all(axis=-1)]
                # The file holds shares of 320 pixels with six decimals.
                np.testing.assert_allclose(corners_px(found[part, image]), expected, atol=5e-4)
                # The limit is above the error of JPEG at quality 95; the noise of another frame differs more.
                assert np.abs(cv2.imread(str(image)).astype(int) - shown).mean() < 2.0
    # An offset of one kilometre moves all drones out of all images: their label files are empty.
    options = ["--every", 2, "--validation", "flight", "--offset", "0,0,-1000", "--force"]
    assert run_labels(("flight", "second"), "--out", out, *options) == (0, "", "")
    found = load_data_set(out)
    parts = {(part, image.stem.partition("_")[0], int(image.stem[-6:])) for part, image in found}
    even = range(0, NUM_FRAMES, 2)
    assert parts == {(*which, k) for which in (("val", "flight"), ("train", "second")) for k in even}
    assert not any(map(len, found.values()))


#: Name of the case -> sequences, options, and words of the line.
BAD = {
    "one sequence": (["flight"], [], "found flight, of which flight for validation"),
    "the same sequence": (["flight"] * 2, [], "found flight, flight, of which flight for validation"),
    "all for validation": (["flight", "second"], ["--validation", "second,flight"],
        "found flight, second, of which flight, second for"),
    "a folder of other files": (["flight", "second"], ["--force", "--out", "home"],
        "only a folder with a data.yaml can be replaced"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_data_sets_that_cannot_be_written(name, run_labels, tmp_path, monkeypatch):
    sequences, options, words = BAD[name]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("x")
    assert_refused(lambda: run_labels(sequences, "--out", "set", *options), words, unchanged=tmp_path)


def test_recordings_without_poses_or_frames_leave_nothing_behind(flights, tmp_path):
    first, second = (open_recording(flights / name) for name in ("flight", "second"))
    no_pose = replace(first.truth, position_m=np.full_like(first.truth.position_m, np.nan))
    longer = make_reference(np.repeat(first.truth.position_m[:1], 2 * NUM_FRAMES, axis=0))
    short = {name: replace(video, num_frames=2 * NUM_FRAMES) for name, video in first.videos.items()}
    for recording, words in (
        (replace(first, reference=None), "flight: expected a reference "),
        (replace(first, reference=Reference(no_pose)), "a frame in which the poses of all drones are known"),
        (replace(with_cameras(first, video=short), reference=Reference(longer)), "only 14 can be decoded"),
    ):
        both = [recording, second]
        assert_refused(
            partial(write_data_set, both, tmp_path / "set", LabelSettings(SIZE_M), jobs=1),
            words,
            unchanged=tmp_path,
        )


def test_frames_of_cameras_with_rates_and_starts_of_their_own(flights, tmp_path):
    """Drones fly at 1 m/s along y, and frames are between the instants of the reference.

    Frames before the first instant, whose pose is not known, are left out.
    """
    first, second = (open_recording(flights / name) for name in ("flight", "second"))
    times = {"c0": FrameTimes(NUM_FRAMES, 25.0, -0.05), "c1": FrameTimes(NUM_FRAMES, 50.0, 0.013)}
    chosen = LabelSettings(SIZE_M)
    write_data_set([with_cameras(first, times=times), second], tmp_path / "set", chosen, jobs=1)
    found = {image.stem: rows for (_, image), rows in load_data_set(tmp_path / "set").items()}
    for index, (name, own) in enumerate(times.items()):
        time_s = own.time_offset_s + np.arange(NUM_FRAMES) / own.fps
        known = np.flatnonzero(time_s > 0)
        stems = [f"flight_{name}_{frame:06d}" for frame in known]
        assert sorted(stem for stem in found if stem.startswith(f"flight_{name}_")) == stems
        position_m = first.truth.position_m[0] + time_s[known, None, None] * [0.0, 1.0, 0.0]
        boxes = labels_in_rig(first.rig, make_reference(position_m), chosen)[:, :, index]
        for stem, expected in zip(stems, boxes, strict=True):
            expected = expected[np.isfinite(expected).all(axis=-1)]
            # The file holds shares of 320 pixels with six decimals.
            np.testing.assert_allclose(corners_px(found[stem]), expected, atol=5e-4)
