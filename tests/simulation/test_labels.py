"""Masks, mask archives and detections of the simulator, and labels for the training of detectors.

Masks are compared with OpenCV's projection and polygons, archives with `zipfile`, detections with their settings, and
labels with boxes computed by hand and by OpenCV; a data set is read as a trainer reads it.
"""

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
from helpers import assert_refused, far_camera, posed, ring_rig, simple_lens, with_cameras
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import asdict
from placed_drones import (
    CORNERS_M,
    PLAIN,
    S02,
    cube,
    hovering,
    laboratory,
    mean_and_variance,
    number_image,
    opencv_pixels,
    with_drones,
)
from scipy.spatial.transform import Rotation
from worlds import CAMERAS, NUM_FRAMES

from psotrack.foreground.detection import LabelSettings, box_corners, label_boxes, write_data_set
from psotrack.recordings import FrameTimes, Reference, read_frames
from psotrack.recordings.datasets import open_recording
from psotrack.simulation import CameraRenderer, build, change_scenario
from psotrack.simulation.imaging.raster import RasterView, pinhole
from psotrack.simulation.labels import Silhouette, detect, iou, silhouettes
from psotrack.trajectories import Trajectories

NO_ROOM_M = 90.0


@pytest.fixture
def scene():
    return laboratory(0.5)


def empty_room_view(scene, index):
    """Return a camera and the depth image, metres, of a room in which nothing hides a drone."""
    cam = pinhole(scene.rig.cameras[index])
    return cam, np.full((cam.height, cam.width), NO_ROOM_M, np.float32)


def seen(scene, *placed, index=0, depth_m=None):
    """The silhouettes of cubes, each as (side, position), metres; in a room in which nothing hides a drone."""
    cam, nothing_m = empty_room_view(scene, index)
    scene = with_drones(scene, *(hovering(cube(side_m), position_m) for side_m, position_m in placed))
    return silhouettes(scene, cam, nothing_m if depth_m is None else depth_m, 0)


# --- masks


@pytest.mark.parametrize(("index", "frame"), [(0, 3), (4, 120), (7, 249)])
def test_masks_of_the_models_agree_with_polygons_filled_by_opencv(scene, index, frame):
    cam, depth_m = empty_room_view(scene, index)
    masks = [silhouette.mask() for silhouette in silhouettes(scene, cam, depth_m, frame)]
    found = np.any(masks, axis=0)
    angle = np.linspace(0, 2 * np.pi, 60)[:, None]
    rim = np.hstack([np.cos(angle), np.sin(angle), 0 * angle])
    # Draw 8 times as large, because OpenCV's polygons include their outline: half a pixel on every side.
    canvas = np.zeros((8 * cam.height, 8 * cam.width), np.uint8)
    position_m = scene.positions_m(frame + 1)[frame]
    orientation_wxyz = scene.orientations_wxyz(frame + 1)[frame]
    for drone, model in enumerate(scene.models):
        turn = Rotation.from_quat(orientation_wxyz[drone], scalar_first=True)
        polygons_m = list(model.triangles_m)
        for hub_m, radius_m in zip(model.rotor_centres_m, model.rotor_radii_m, strict=True):
            polygons_m.append(hub_m + radius_m * rim)
        for polygon_m in polygons_m:
            pixels = opencv_pixels(cam, turn.apply(polygon_m) + position_m[drone])
            enlarged = 8 * (pixels + 0.5) - 0.5
            cv2.fillConvexPoly(canvas, enlarged.round().astype(np.int32), 1)
    expected = canvas[4::8, 4::8] > 0
    assert expected.sum() > 200
    assert (found != expected).sum() < 0.05 * expected.sum()


def test_the_nearer_drone_hides_the_farther_drone_in_either_order(scene):
    centre = scene.rig.cameras.centre_world[0]
    towards = np.array([0.0, 0.0, 1.4]) - centre
    near = (0.3, centre + 0.5 * towards)
    far = (0.3, centre + 0.9 * towards + np.array([0.0, 0.0, 0.3]))
    (near_alone,) = seen(scene, near)
    (far_alone,) = seen(scene, far)
    behind = far_alone.mask() & ~near_alone.mask()
    in_front, hidden = seen(scene, near, far)
    hidden_again, in_front_again = seen(scene, far, near)
    for front in (in_front, in_front_again):
        np.testing.assert_array_equal(front.mask(), near_alone.mask())
        assert front.seen_share == 1.0
    for partly in (hidden, hidden_again):
        np.testing.assert_array_equal(partly.mask(), behind)
        assert 0.05 < partly.seen_share < 0.95, "the far drone must be partly hidden"


def test_the_room_hides_drones_and_parts_outside_the_image_are_unseen(scene):
    cam, depth_m = empty_room_view(scene, 0)
    middle = (0.3, (0.0, 0.0, 1.4))
    (free,) = seen(scene, middle)
    centre, _ = mean_and_variance(free.mask())
    column = round(centre[0])
    depth_m[:, :column] = 1.0
    (half,) = seen(scene, middle, depth_m=depth_m)
    expected = free.mask()
    expected[:, :column] = False
    np.testing.assert_array_equal(half.mask(), expected)
    assert half.seen_share == pytest.approx(0.5, abs=0.1)
    depth_m[:] = 1.0
    (hidden,) = seen(scene, middle, depth_m=depth_m)
    assert hidden.seen_share == 0.0
    assert hidden.xyxy is None
    for border in (-0.5, cam.width - 0.5):
        ray = np.linalg.inv(cam.K) @ [border, cam.height / 2, 1.0]
        on_the_border = cam.R.T @ (4.0 * ray - cam.t_m)
        (cut,) = seen(scene, (0.3, on_the_border))
        assert cut.seen_share == pytest.approx(0.5, abs=0.1)  # a turned cube is not symmetric
    behind = cam.R.T @ (np.array([0.0, 0.0, -2.0]) - cam.t_m)
    assert seen(scene, (0.3, behind)) == []
    # A cube around the camera fills the whole image.
    (whole,) = seen(scene, (3.0, scene.rig.cameras.centre_world[0]))
    assert whole.seen_share == 1.0


def test_masks_and_frames_agree():
    """Without shadows, reflections and noise, a frame differs from the empty room exactly inside the masks."""
    changes = {"imaging": asdict(PLAIN)}
    for drone in range(4):
        changes[f"drones[{drone}].paint_bgr"] = [0.0, 0.0, 0.9]
    red = build(change_scenario(S02, changes), scale=0.5)
    empty = replace(red, flights=(), models=())
    renderer = CameraRenderer(red, 5)
    room = CameraRenderer(empty, 5).frame(0).astype(int)
    for frame in (10, 200):
        difference = np.abs(renderer.frame(frame) - room).max(axis=-1)
        numbers = number_image(renderer, frame)
        inside = numbers > 0
        assert np.median(difference[inside]) > 20
        near = cv2.dilate(inside.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        assert not difference[~near].any()
        # Masks have one sample per pixel and frames eight, so the edges of thin arms differ. Measured 0.88 to 0.90.
        changed = difference > 10
        common = np.count_nonzero(changed & inside)
        either = np.count_nonzero(changed | inside)
        assert common > 0.8 * either
        # Masks are disjoint, and boxes bound them.
        for silhouette in silhouettes(red, renderer.cam, renderer.views[0].backdrop.depth_m, frame):
            mask = silhouette.mask()
            np.testing.assert_array_equal(mask, numbers == silhouette.number)
            if silhouette.xyxy is not None:
                x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
                assert silhouette.xyxy.tolist() == [x, y, x + width, y + height]


# --- detections


def make_silhouette(scene, xyxy, number=1, share=1.0):
    """Make the silhouette of a drone: a full rectangle, which is the share `share` of the unoccluded silhouette."""
    x0, y0, x1, y1 = xyxy
    width, height = x1 - x0, y1 - y0
    window = RasterView(pinhole(scene.rig.cameras[0]), x0, y0, width, height)
    return Silhouette(number, window, np.ones(window.shape, bool), round(width * height / share))


def scene_with_detector(scene, **values):
    quiet = {"jitter": 0, "miss_rate": 0, "double_rate": 0, "false_alarms_per_frame": 0} | values
    changes = {f"detector.{field}": value for field, value in quiet.items()}
    return replace(scene, scenario=change_scenario(S02, changes))


LARGE = (300, 200, 380, 250)


def detected(scene, count, *others, share=1.0, **values):
    """Detections in the first `count` frames: of a large drone, whose visible fraction is `share`, and of others."""
    observed = scene_with_detector(scene, **values)
    silhouette = make_silhouette(scene, LARGE, share=share)
    return [detect(observed, 0, frame, [silhouette, *others]) for frame in range(count)]


def assert_binomial(found, count, rate):
    """A count is within five standard deviations of its mean; a correct detector stays inside."""
    assert abs(found - count * rate) <= 5 * math.sqrt(count * rate * (1 - rate)) + 1


def all_boxes(found):
    """Middles and sides (boxes, 2) of the boxes of several frames, pixels."""
    boxes = np.concatenate([detections.xyxy for detections in found])
    low, high = boxes[:, :2], boxes[:, 2:]
    return (low + high) / 2, high - low


def test_without_noise_the_detector_reports_the_boxes_that_are_seen(scene):
    other = make_silhouette(scene, (500, 100, 590, 160), 2)
    found = detected(scene, 18, other)[17]
    assert found.frame.tolist() == [17, 17]
    assert sorted(found.xyxy.tolist()) == [list(LARGE), [500, 100, 590, 160]]
    hidden = replace(other, seen=np.zeros_like(other.seen))
    found = detected(scene, 18, hidden)[17]
    assert found.xyxy.tolist() == [list(LARGE)]


@pytest.mark.parametrize("rate", [0.0, 0.3, 1.0])
def test_misses_and_double_detections_have_their_set_rates(scene, rate):
    count = 400
    missing = detected(scene, count, miss_rate=rate)
    num_found = sum(len(found) for found in missing)
    assert_binomial(num_found, count, 1 - rate)
    doubled = detected(scene, count, double_rate=rate)
    pairs = [found for found in doubled if len(found) == 2]
    assert_binomial(len(pairs), count, rate)
    confidences = []
    for pair in pairs:
        # A network's non-maximum suppression, with a threshold of 0.45, would have merged boxes of a larger IoU.
        assert iou(*pair.xyxy) < 0.45
        sides = pair.xyxy[:, 2:] - pair.xyxy[:, :2]
        smaller_first = np.argsort(sides.prod(axis=1))
        confidences.append(pair.confidence[smaller_first])
    if rate == 1.0:
        # Confidence is 0.25 + 0.75 (0.1 + 0.8 q) with q = 0.4 and 1; a mean of 400 values has a standard error of
        # 0.004.
        expected = [0.25 + 0.75 * 0.42, 0.25 + 0.75 * 0.9]
        np.testing.assert_allclose(np.mean(confidences, axis=0), expected, atol=0.016)


@pytest.mark.parametrize(
    ("side_px", "share", "rate"),
    # Values of 1 - (1 - v)^2 for the visible share v, and of 1 - exp(-(s / 10)^2) for the size s.
    [(20, 1.0, 0.9817), (10, 1.0, 0.6321), (5, 1.0, 0.2212), (100, 0.5, 0.75), (100, 0.1, 0.19)],
)
def test_small_and_occluded_drones_are_missed_more_often(scene, side_px, share, rate):
    silhouette = make_silhouette(scene, (300, 200, 300 + side_px, 200 + side_px), share=share)
    quiet = scene_with_detector(scene)
    count = 400
    num_found = 0
    for frame in range(count):
        num_found += len(detect(quiet, 0, frame, [silhouette]))
    assert_binomial(num_found, count, rate)


def test_jitter_is_a_share_of_the_size_of_the_box(scene):
    middle, size = all_boxes(detected(scene, 1000, jitter=0.05))
    true_size = np.array([80, 50])
    shift = (middle - [340, 225]) / true_size
    growth = size / true_size
    # With 1000 draws the standard error is 2.2 % of the deviation and 0.0016 of the mean; tolerances are four times
    # that.
    np.testing.assert_allclose(shift.std(axis=0), 0.05, rtol=0.09)
    np.testing.assert_allclose(shift.mean(axis=0), 0.0, atol=0.0064)
    np.testing.assert_allclose(growth.std(axis=0), 0.05, rtol=0.09)
    np.testing.assert_allclose(growth.mean(axis=0), 1.0, atol=0.0085)


def test_false_alarms_are_poisson_distributed_and_spread_over_the_image(scene):
    found = detected(scene, 1000, false_alarms_per_frame=0.7, miss_rate=1.0)
    counts = np.array([len(detections) for detections in found])
    # The mean of 1000 Poisson numbers has a standard error of 0.026, their variance of 0.048.
    assert counts.mean() == pytest.approx(0.7, abs=0.11)
    assert counts.var() == pytest.approx(0.7, abs=0.2)
    middle, size = all_boxes(found)
    np.testing.assert_allclose(np.median(size, axis=0), [80, 50], rtol=0.1)
    share = middle / scene.rig.cameras.image_size_wh[0]
    np.testing.assert_allclose(share.mean(axis=0), 0.5, atol=0.06)
    assert np.ptp(share, axis=0).min() > 0.8


@pytest.mark.parametrize(("right", "merged"), [(27, True), (33, False), (90, False)])
def test_boxes_with_large_overlap_are_merged(scene, right, merged):
    # A shift by 27 or 33 of 80 px gives an IoU of 0.49 or 0.42.
    x0, y0, x1, y1 = LARGE
    one = make_silhouette(scene, LARGE)
    other = make_silhouette(scene, (x0 + right, y0, x1 + right, y1), 2)
    found = detect(scene_with_detector(scene, merge_iou=0.45), 0, 0, [one, other])
    if merged:
        assert found.xyxy.tolist() == [[x0, y0, x1 + right, y1]]
    else:
        assert len(found) == 2


def test_confidence_grows_with_the_visible_share_and_the_quality_of_the_box(scene):
    # False alarms also come in frames without a drone.
    alarms = scene_with_detector(scene, false_alarms_per_frame=1.0)
    cases = [detected(scene, 400, share=share) for share in (1.0, 0.6, 0.3)]
    cases.append([detect(alarms, 0, frame, []) for frame in range(400)])
    means = []
    for found in cases:
        confidence = np.concatenate([detections.confidence for detections in found])
        assert confidence.min() >= 0.25
        means.append(confidence.mean())
    assert means[0] > 0.85
    # Each mean has a standard error of 0.01.
    assert np.diff(means).max() < -0.05
    shaky = detected(scene, 600, jitter=0.15)
    assert np.concatenate([found.confidence for found in shaky]).mean() < means[0] - 0.05


def test_boxes_lie_inside_the_image_in_order_of_confidence(scene):
    wild = scene_with_detector(scene, jitter=0.5, double_rate=0.5, false_alarms_per_frame=2.0)
    size_wh = scene.rig.cameras.image_size_wh[0].astype(int)
    width, height = size_wh.tolist()
    upper_left = make_silhouette(scene, (0, 0, 60, 40), 1)
    lower_right = make_silhouette(scene, (width - 30, height - 50, width, height), 2)
    for frame in range(200):
        found = detect(wild, 0, frame, [upper_left, lower_right])
        low, high = found.xyxy[:, :2], found.xyxy[:, 2:]
        assert (low >= 0).all()
        assert (high <= size_wh).all()
        assert (high > low).all()
        assert (np.diff(found.confidence) <= 0).all()
        assert ((found.confidence >= 0) & (found.confidence <= 1)).all()


# --- labels for training


#: A distant camera at y = -1000 m with 100 x 80 pixels and 10 pixels per metre; x is to the right, z is up.
FAR = far_camera(image_size_wh=(100, 80), pixels_per_m=10.0)


CUBE = LabelSettings(drone_size_m=(2.0, 2.0, 2.0))


SIZE_M = (0.6, 0.4, 0.3)


def make_reference(position_m, orientation_wxyz=None):
    """Make a reference from positions (frames, drones, 3) in metres and orientations (frames, drones, 4)."""
    position_m = np.asarray(position_m, np.float64)
    frame = np.arange(len(position_m))
    names = tuple(f"dron{number + 1}" for number in range(position_m.shape[1]))
    return Trajectories(frame, frame / 25, names, position_m, orientation_wxyz=orientation_wxyz)


def compute_labels(*position_m, camera=FAR, settings=CUBE):
    """Return the label boxes in an image, (drones, 4), pixels."""
    corners_m = box_corners(make_reference([position_m]), settings)
    return label_boxes(camera, corners_m, settings)[0]


def labels_in_rig(rig, truth, settings):
    """Return the label boxes of all cameras, (frames, drones, cameras, 4), pixels."""
    corners_m = box_corners(truth, settings)
    boxes = [label_boxes(rig.cameras[index], corners_m, settings) for index in range(len(rig))]
    return np.stack(boxes, axis=2)


# --- labels of one image, computed by hand


def test_missing_orientations():
    """A drone without any orientation has a level box; a drone with gaps has no box in the gaps."""
    truth = make_reference(np.zeros((2, 2, 3)), np.full((2, 2, 4), np.nan))
    truth.orientation_wxyz[0, 1] = (1, 0, 0, 0)
    corners_m = box_corners(truth, CUBE)
    assert np.isfinite(corners_m[:, 0]).all()
    assert np.isfinite(corners_m[0, 1]).all()
    assert np.isnan(corners_m[1, 1]).all()


NONE = [np.nan] * 4
NOWHERE = (np.nan, np.nan, np.nan)
#: Of the nearer drone of two, half a metre beside the farther one: it covers three quarters.
NEAR = [45, 30, 65, 50]


@pytest.mark.parametrize(
    ("places_m", "change", "expected"),
    [
        # Three quarters of a box from 85 to 105 are in an image of 100 pixels.
        ([(4.5, 0, 0)], {"min_inside": 0.7}, [[85, 30, 100, 50]]),
        ([(4.5, 0, 0)], {"min_inside": 0.8}, [NONE]),
        # Beside the image, behind the camera, around the camera, and with one corner behind the camera.
        ([(7, 0, 0)], {"min_inside": 0.0}, [NONE]),
        ([(0, -2000, 0)], {"min_inside": 0.0}, [NONE]),
        ([(0, -1000, 0)], {"min_inside": 0.0}, [NONE]),
        ([(0, -999.5, 0)], {"min_inside": 0.0}, [NONE]),
        ([(0, 5, 0), (0.5, 0, 0)], {"max_hidden": 0.74}, [NONE, NEAR]),
        ([(0, 5, 0), (0.5, 0, 0)], {"max_hidden": 0.76}, [[40, 30, 60, 50], NEAR]),
        # Drones without an image or a pose hide no other drone.
        ([(0, 0, 0), (0, -1500, 0), NOWHERE], {"max_hidden": 0.0}, [[40, 30, 60, 50], NONE, NONE]),
    ],
)
def test_drones_at_the_border_behind_the_camera_and_behind_each_other(places_m, change, expected):
    chosen = msgspec.structs.replace(CUBE, **change)
    found = compute_labels(*places_m, settings=chosen)
    np.testing.assert_allclose(found, expected, atol=0.06)


def test_boxes_agree_with_corners_projected_by_opencv():
    rig = ring_rig(3, coefficients=8)
    position_m = np.random.default_rng(0).uniform((-1, -1, 0.8), (1, 1, 1.8), (7, 3))
    turns = Rotation.random(7, rng=1)
    reference = make_reference(position_m[:, None], turns.as_quat(scalar_first=True)[:, None])
    size_m = np.array([0.5, 0.3, 0.2])
    offset_m = np.array([0.05, -0.1, 0.02])
    chosen = LabelSettings(tuple(size_m.tolist()), tuple(offset_m.tolist()))
    found = labels_in_rig(rig, reference, chosen)
    on_body_m = offset_m + size_m * CORNERS_M
    for index in range(3):
        camera = rig.cameras[index]
        view = pinhole(camera)
        for frame in range(7):
            corners_m = position_m[frame] + turns[frame].apply(on_body_m)
            pixels = opencv_pixels(view, corners_m, camera.dist)
            outline = [*pixels.min(axis=0), *pixels.max(axis=0)]
            expected = np.clip(np.add(outline, 0.5), 0, [320, 240, 320, 240])
            np.testing.assert_allclose(found[frame, 0, index], expected, atol=1e-9)


def test_points_far_outside_are_not_mapped_into_the_image():
    """The lens polynomial decreases far from the axis: it maps 65 degrees to the radius of 28 degrees."""
    lens = simple_lens(1158.0, (1924, 1082), (-0.17, 0.0, 0.0, 0.0))
    bent = posed(lens, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    far_outside_m = (2.0, -2.0 * math.tan(math.radians(65)), 0.0)
    in_the_corner_m = (4.0, -3.2, 1.6)
    small = LabelSettings(drone_size_m=(0.3, 0.3, 0.2))
    outside, inside = compute_labels(far_outside_m, in_the_corner_m, camera=bent, settings=small)
    assert np.isnan(outside).all()
    assert np.isfinite(inside).all()


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_labels_are_inside_the_image_and_do_not_depend_on_the_order(seed):
    rng = np.random.default_rng(seed)
    rig = ring_rig(3, coefficients=4)
    position_m = rng.uniform((-6, -6, -1), (6, 6, 4), (2, 5, 3))
    chosen = LabelSettings((0.8, 0.6, 0.4), min_inside=rng.uniform(), max_hidden=rng.uniform())
    order = rng.permutation(5)
    found = labels_in_rig(rig, make_reference(position_m), chosen)
    reordered = labels_in_rig(rig, make_reference(position_m[:, order]), chosen)
    np.testing.assert_array_equal(reordered, found[:, order])
    known = np.isfinite(found)
    np.testing.assert_array_equal(known.all(axis=-1), known.any(axis=-1))
    boxes = found[known.all(axis=-1)]
    low, high = boxes[:, :2], boxes[:, 2:]
    assert (low >= 0).all()
    assert (high <= (320, 240)).all()
    assert (high > low).all()


# --- data sets


@pytest.fixture
def run_labels(world, run_psotrack):
    """Runs `simulate labels` for some of the sequences."""

    def run(names, *words):
        sequences = [world / name for name in names]
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
        for image in sorted(folder.iterdir()):
            assert image.suffix == ".jpg"
            before, after = str(image).rsplit("/images/", 1)
            labels = Path(f"{before}/labels/{after}").with_suffix(".txt")
            lines = labels.read_text().splitlines()
            rows = np.array([line.split() for line in lines], float).reshape(-1, 5)
            assert (rows[:, 0] == 0).all()
            assert ((rows >= 0) & (rows <= 1)).all()
            assert len(np.unique(rows, axis=0)) == len(rows)
            found[part, image] = rows
    return found


def corners_px(rows):
    """The boxes (labels, 4) of rows of a file of labels, pixels."""
    middle, size = rows[:, 1:3], rows[:, 3:]
    return np.hstack([middle - size / 2, middle + size / 2]) * [320, 240, 320, 240]


def assert_labelled(rows, boxes):
    """Assert that rows of a file of labels are the boxes (drones, 4) in pixels that are known."""
    known = np.isfinite(boxes).all(axis=-1)
    # The file holds shares of 320 pixels with six decimals.
    np.testing.assert_allclose(corners_px(rows), boxes[known], atol=5e-4)


def test_the_data_set_can_be_loaded_by_a_trainer(world, run_labels, tmp_path):
    out = tmp_path / "set"
    result = run_labels(("flight", "second"), "--out", out, "--json", "-").ended()
    counts = json.loads(result.out)
    found = load_data_set(out)
    assert len(list((out / "labels").glob("*/*.txt"))) == len(found)
    for part, name in (("train", "flight"), ("val", "second")):
        recording = open_recording(world / name)
        boxes = labels_in_rig(recording.rig, recording.truth, LabelSettings(SIZE_M))
        num_labels = 0
        for index, camera in enumerate(recording.rig.names):
            for frame, shown in enumerate(read_frames(recording.videos[camera])):
                image = out / "images" / part / f"{name}_{camera}_{frame:06d}.jpg"
                rows = found[part, image]
                num_labels += len(rows)
                assert_labelled(rows, boxes[frame, :, index])
                # The limit is above the error of JPEG at quality 95; the noise of another frame differs more.
                difference = cv2.imread(str(image)).astype(int) - shown
                assert np.abs(difference).mean() < 2.0
        assert counts[part] == {"images": NUM_FRAMES * len(CAMERAS), "labels": num_labels}
    # An offset of one kilometre moves all drones out of all images: their label files are empty.
    options = ["--every", 2, "--validation", "flight", "--offset", "0,0,-1000", "--force"]
    assert run_labels(("flight", "second"), "--out", out, *options) == (0, "", "")
    frames = {"val": set(), "train": set()}
    for (part, image), rows in load_data_set(out).items():
        assert len(rows) == 0
        name, _, frame = image.stem.split("_")
        frames[part].add((name, int(frame)))
    even = range(0, NUM_FRAMES, 2)
    assert frames["val"] == {("flight", frame) for frame in even}
    assert frames["train"] == {("second", frame) for frame in even}


#: Name of the case -> sequences, options, and words of the line.
BAD = {
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
    home = tmp_path / "home"
    home.mkdir()
    (home / "thesis.tex").write_text("x")
    assert_refused(lambda: run_labels(sequences, "--out", "set", *options), words, unchanged=tmp_path)


def test_recordings_without_poses_or_frames_leave_nothing_behind(world, tmp_path):
    first = open_recording(world / "flight")
    second = open_recording(world / "second")
    no_pose = replace(first.truth, position_m=np.full_like(first.truth.position_m, np.nan))
    longer = make_reference(np.repeat(first.truth.position_m[:1], 2 * NUM_FRAMES, axis=0))
    short = {name: replace(video, num_frames=2 * NUM_FRAMES) for name, video in first.videos.items()}
    bad = {
        "flight: expected a reference ": replace(first, reference=None),
        "a frame in which the poses of all drones are known": replace(first, reference=Reference(no_pose)),
        "only 14 can be decoded": replace(with_cameras(first, video=short), reference=Reference(longer)),
    }
    out = tmp_path / "set"
    for words, recording in bad.items():
        write = partial(write_data_set, [recording, second], out, LabelSettings(SIZE_M), jobs=1)
        assert_refused(write, words, unchanged=tmp_path)


def test_frames_of_cameras_with_rates_and_starts_of_their_own(world, tmp_path):
    """Drones fly at 1 m/s along y, and frames are between the instants of the reference.

    Frames before the first instant, whose pose is not known, are left out.
    """
    first = open_recording(world / "flight")
    second = open_recording(world / "second")
    times = {"c0": FrameTimes(NUM_FRAMES, 25.0, -0.05), "c1": FrameTimes(NUM_FRAMES, 50.0, 0.013)}
    chosen = LabelSettings(SIZE_M)
    write_data_set([with_cameras(first, times=times), second], tmp_path / "set", chosen, jobs=1)
    found = {image.stem: rows for (_, image), rows in load_data_set(tmp_path / "set").items()}
    for index, (name, own) in enumerate(times.items()):
        time_s = own.time_offset_s + np.arange(NUM_FRAMES) / own.fps
        position_m = first.truth.position_m[0] + time_s[:, None, None] * [0.0, 1.0, 0.0]
        boxes = labels_in_rig(first.rig, make_reference(position_m), chosen)
        for frame in range(NUM_FRAMES):
            stem = f"flight_{name}_{frame:06d}"
            assert (stem in found) == (time_s[frame] > 0)
            if stem in found:
                assert_labelled(found[stem], boxes[frame, :, index])
