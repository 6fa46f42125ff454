"""Masks, mask archives, detections and mocap markers of the simulator.

Masks are compared with OpenCV's projection and polygons, archives with `zipfile`, detections with their settings.
"""

import math
import zipfile
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
import pytest
from helpers import read_mocap_markers, sphere_points
from hypothesis import given, settings
from hypothesis import strategies as st
from placed_drones import drone_masks
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

from psotrack.errors import InputError
from psotrack.recordings.datasets import (
    MaskWriter,
    join_archives,
    read_masks,
    write_mocap_markers,
)
from psotrack.simulation import CameraRenderer, build, change_scenario, scenario
from psotrack.simulation.flights.motion import HarmonicFlight, Heading
from psotrack.simulation.imaging.raster import RasterView, pinhole
from psotrack.simulation.labels.detector import detect, iou
from psotrack.simulation.labels.masks import Silhouette, silhouettes
from psotrack.simulation.scenarios import Mesh
from psotrack.simulation.world import drones, models

S02 = scenario("S02_D4_A")
NO_ROOM_M = 90.0


@pytest.fixture(scope="module")
def scene():
    return build(S02, scale=0.5)


def make_hovering_flight(position_m):
    """Make a flight that stays at a point."""
    nothing = np.zeros((1, 3))
    return HarmonicFlight(np.array(position_m, float), nothing, np.ones(1), nothing, Heading(yaw_rad=0.4))


def with_drones(scene, *placed):
    """Return the scene with other drones, each given as (model, position)."""
    models, positions = zip(*placed, strict=True)
    return replace(
        scene, models=tuple(models), flights=tuple(make_hovering_flight(position) for position in positions)
    )


def empty_room_view(scene, index):
    """Return a camera and the depth image, metres, of a room in which nothing hides a drone."""
    cam = pinhole(scene.rig.cameras[index])
    return cam, np.full((cam.height, cam.width), NO_ROOM_M, np.float32)


def project_by_opencv(scene, index, points_m):
    cam = scene.rig.cameras[index]
    rotation, _ = cv2.Rodrigues(cam.T_cam_world[:3, :3])
    pixels, _ = cv2.projectPoints(
        np.reshape(points_m, (-1, 3)), rotation, cam.T_cam_world[:3, 3], cam.K, None
    )
    return pixels[:, 0]


def centroid(mask):
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()])


def cube(side_m):
    triangles = models.box((0.0, 0.0, 0.0), (side_m, side_m, side_m))
    return drones.DroneModel(triangles, np.ones(len(triangles)), np.zeros((0, 3)), np.zeros(0))


def write_sphere_file(path, radius_m):
    points = radius_m * sphere_points(400)
    faces = ConvexHull(points).simplices
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"]
    rows = [" ".join(map(str, point)) for point in points] + [f"3 {a} {b} {c}" for a, b, c in faces]
    path.write_text("\n".join([*header, *rows]) + "\n")
    return path


# --- masks


@pytest.mark.parametrize("index", [0, 3, 6])
def test_the_mask_of_a_ball_is_centred_on_the_projected_centre(scene, index, tmp_path):
    """`cv2.projectPoints` projects the centre of the mesh; the mask's centroid is within 1 px."""
    ball = drones.model(Mesh(file=str(write_sphere_file(tmp_path / "ball.ply", 0.1))))
    cam, depth_m = empty_room_view(scene, index)
    rng = np.random.default_rng(index)
    num_checked = 0
    for position in rng.uniform((-2.5, -1.8, 0.6), (2.5, 1.8, 2.3), (12, 3)):
        expected = project_by_opencv(scene, index, position)[0]
        mask = drone_masks(with_drones(scene, (ball, position)), cam, depth_m, 0)
        if mask.any() and not (mask[[0, -1]].any() or mask[:, [0, -1]].any()):
            num_checked += 1
            # Measured 0.3 px at most: the outline is an ellipse whose centre differs from the projected centre.
            assert np.linalg.norm(centroid(mask) - expected) < 1.0
    assert num_checked >= 6


@pytest.mark.parametrize("frame", [3, 120, 249])
@pytest.mark.parametrize("index", [0, 4, 7])
def test_masks_of_the_models_agree_with_polygons_filled_by_opencv(scene, index, frame):
    cam, depth_m = empty_room_view(scene, index)
    turn = Rotation.from_quat(scene.orientations_wxyz(frame + 1)[-1], scalar_first=True).as_matrix()
    at_m = scene.positions_m(frame + 1)[-1]
    found = silhouettes(scene, cam, depth_m, frame)
    assert found
    for drone_silhouette in found:
        if drone_silhouette.xyxy is None or not (
            drone_silhouette.xyxy[0] > 0 and drone_silhouette.xyxy[2] < cam.width
        ):
            continue
        alone = replace(
            scene,
            models=(scene.models[drone_silhouette.number - 1],),
            flights=(scene.flights[drone_silhouette.number - 1],),
        )
        (mask,) = (silhouette.mask() for silhouette in silhouettes(alone, cam, depth_m, frame))
        model = scene.models[drone_silhouette.number - 1]
        angle = np.linspace(0, 2 * np.pi, 60)[:, None]
        rim = np.hstack([np.cos(angle), np.sin(angle), 0 * angle])
        polygons_m = [*model.triangles_m]
        for hub, radius in zip(model.rotor_centres_m, model.rotor_radii_m, strict=True):
            polygons_m.append(hub + radius * rim)
        # Draw 32 times as large, because OpenCV's polygons include their outline: half a pixel on every side.
        x, y, width, height = cv2.boundingRect(mask.astype(np.uint8))
        corner = np.array([x - 2, y - 2])
        canvas = np.zeros((32 * (height + 4), 32 * (width + 4)), np.uint8)
        for polygon in polygons_m:
            pixels = project_by_opencv(
                scene,
                index,
                polygon @ turn[drone_silhouette.number - 1].T + at_m[drone_silhouette.number - 1],
            )
            cv2.fillConvexPoly(canvas, (32 * (pixels - corner + 0.5) - 0.5).round().astype(np.int32), 1)
        middle = (centroid(canvas) + 0.5) / 32 - 0.5 + corner
        # Measured 0.4 px at most: with one sample per pixel, a thin arm is drawn fully or not at all.
        assert np.linalg.norm(centroid(mask) - middle) < 1.0
        # Measured 4 % at most, for the smallest mask: 100 of its 200 px lie on the edge.
        assert mask.sum() == pytest.approx(canvas.sum() / 32**2, rel=0.07)
        assert drone_silhouette.whole_px >= mask.sum()


def test_the_nearer_drone_hides_the_farther_drone_in_either_order(scene):
    cam, depth_m = empty_room_view(scene, 0)
    centre = scene.rig.cameras.centre_world[0]
    towards = np.array([0.0, 0.0, 1.4]) - centre
    near, far = centre + 0.5 * towards, centre + 0.9 * towards + np.array([0.0, 0.0, 0.3])
    first = silhouettes(with_drones(scene, (cube(0.3), near), (cube(0.3), far)), cam, depth_m, 0)
    second = silhouettes(with_drones(scene, (cube(0.3), far), (cube(0.3), near)), cam, depth_m, 0)
    np.testing.assert_array_equal(first[0].mask(), second[1].mask())
    np.testing.assert_array_equal(first[1].mask(), second[0].mask())
    (alone,) = silhouettes(with_drones(scene, (cube(0.3), near)), cam, depth_m, 0)
    (behind,) = silhouettes(with_drones(scene, (cube(0.3), far)), cam, depth_m, 0)
    np.testing.assert_array_equal(first[0].mask(), alone.mask())
    assert first[0].seen_share == alone.seen_share == 1.0
    np.testing.assert_array_equal(first[1].mask(), behind.mask() & ~alone.mask())
    assert 0.05 < first[1].seen_share < 0.95, "the far drone must be partly hidden"


def test_the_room_hides_drones(scene):
    cam, depth_m = empty_room_view(scene, 0)
    placed = with_drones(scene, (cube(0.3), (0.0, 0.0, 1.4)))
    (free,) = silhouettes(placed, cam, depth_m, 0)
    x = round(centroid(free.mask())[0])
    depth_m[:, :x] = 1.0
    (half,) = silhouettes(placed, cam, depth_m, 0)
    expected = free.mask()
    expected[:, :x] = False
    np.testing.assert_array_equal(half.mask(), expected)
    assert half.seen_share == pytest.approx(0.5, abs=0.1)
    assert half.whole_px == free.whole_px
    depth_m[:] = 1.0
    (hidden,) = silhouettes(placed, cam, depth_m, 0)
    assert (hidden.seen_share, hidden.xyxy) == (0.0, None)


def test_parts_outside_the_image_count_as_unseen(scene):
    cam, depth_m = empty_room_view(scene, 0)
    R, t = scene.rig.cameras.T_cam_world[0, :3, :3], scene.rig.cameras.T_cam_world[0, :3, 3]
    for x, share in ((-0.5, 0.5), (cam.width - 0.5, 0.5), (cam.width / 2, 1.0)):
        ray = np.linalg.inv(cam.K) @ [x, cam.height / 2, 1.0]
        (silhouette,) = silhouettes(with_drones(scene, (cube(0.3), R.T @ (4.0 * ray - t))), cam, depth_m, 0)
        assert silhouette.seen_share == pytest.approx(share, abs=0.1)  # a turned cube is not symmetric
    behind = R.T @ (np.array([0.0, 0.0, -2.0]) - t)
    assert silhouettes(with_drones(scene, (cube(0.3), behind)), cam, depth_m, 0) == []
    # A cube around the camera fills the whole image.
    (around,) = silhouettes(
        with_drones(scene, (cube(3.0), scene.rig.cameras.centre_world[0])), cam, depth_m, 0
    )
    assert around.seen_share == 1.0


def test_masks_of_one_camera_are_disjoint_and_boxes_bound_them(scene):
    renderer = CameraRenderer(scene, 4)
    for frame in range(0, 250, 25):
        found = silhouettes(scene, renderer.cam, renderer.backdrop.depth_m, frame)
        numbers = drone_masks(scene, renderer.cam, renderer.backdrop.depth_m, frame)
        for silhouette in found:
            np.testing.assert_array_equal(silhouette.mask(), numbers == silhouette.number)
            if silhouette.xyxy is not None:
                x, y, width, height = cv2.boundingRect((numbers == silhouette.number).astype(np.uint8))
                assert silhouette.xyxy.tolist() == [x, y, x + width, y + height]


def test_masks_and_frames_agree():
    """Without shadows, reflections and noise, a frame differs from the empty room exactly inside the masks."""
    plain = {"shadows": False, "reflections": 0, "exposure_drift": 0, "flicker": 0}
    plain |= {"white_balance_drift": 0, "read_noise": 0, "shot_noise": 0, "shutter_s": 0, "lens_blur_px": 0}
    recipe = change_scenario(S02, {f"imaging.{field}": value for field, value in plain.items()})
    recipe = change_scenario(recipe, {f"drones[{i}].paint_bgr": [0.0, 0.0, 0.9] for i in range(4)})
    bright = build(recipe, scale=0.5)
    empty = replace(bright, flights=(), models=())
    for index in (1, 5):
        renderer = CameraRenderer(bright, index)
        room = CameraRenderer(empty, index).frame(0).astype(int)
        for frame in (10, 200):
            difference = np.abs(renderer.frame(frame) - room).max(axis=-1)
            mask = drone_masks(bright, renderer.cam, renderer.backdrop.depth_m, frame) > 0
            assert np.median(difference[mask]) > 20
            near = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
            assert not difference[~near].any()
            # Masks have one sample per pixel and frames eight, so the edges of thin arms differ. Measured 0.88 to 0.90.
            changed = difference > 10
            assert (changed & mask).sum() > 0.8 * (changed | mask).sum()


# --- archives


def random_mask(seed, shape=(54, 97)):
    return np.random.default_rng(seed).random(shape) > 0.7


def write_part(path, camera, frames):
    with MaskWriter(path) as writer:
        for frame in frames:
            writer.write(camera, 1, frame, random_mask(frame))
            writer.write(camera, 2, frame, np.zeros((54, 97), bool))
    return path


@pytest.fixture
def parts(tmp_path):
    return [
        write_part(tmp_path / "0.zip", "cam1i", range(0, 3)),
        write_part(tmp_path / "1.zip", "cam1i", range(3, 5)),
        write_part(tmp_path / "2.zip", "cam2i", range(0, 5)),
    ]


def check_joined_archive(path):
    """Check the content of the archive that joins `parts`, and that Python's `zipfile` accepts the archive."""
    with zipfile.ZipFile(path) as archive:
        assert archive.testzip() is None
        assert len(archive.namelist()) == 20
        assert archive.namelist()[:2] == ["cam1i/dron1/000000.png", "cam1i/dron2/000000.png"]
    with read_masks(path) as masks:
        assert (masks.cameras, masks.drones, masks.frames) == (("cam1i", "cam2i"), (1, 2), (0, 1, 2, 3, 4))
        for camera in masks.cameras:
            for frame in masks.frames:
                np.testing.assert_array_equal(masks.mask(camera, 1, frame), random_mask(frame))
                assert not masks.mask(f"{camera}_s", 2, frame).any()


def test_joined_archives_are_read_as_one_archive(tmp_path, parts):
    join_archives(tmp_path / "all.zip", parts)
    check_joined_archive(tmp_path / "all.zip")
    before = (tmp_path / "all.zip").read_bytes()
    join_archives(tmp_path / "all.zip", parts)
    assert (tmp_path / "all.zip").read_bytes() == before


def test_archives_of_more_than_65535_entries_are_read(tmp_path):
    """More than 65,535 entries need the 64-bit records of ZIP."""
    counts = (40_000, 26_000)
    halves = [tmp_path / f"half_{number}.zip" for number in range(2)]
    for number, (path, count) in enumerate(zip(halves, counts, strict=True)):
        with zipfile.ZipFile(path, "w") as half:
            for index in range(count):
                half.writestr(zipfile.ZipInfo(f"{number}/{index}"), str(index))
    join_archives(tmp_path / "all.zip", halves)
    with zipfile.ZipFile(tmp_path / "all.zip") as archive:
        names = archive.namelist()
        assert names == [f"{number}/{index}" for number in range(2) for index in range(counts[number])]
        for name in (names[0], names[65_535], names[65_536], names[-1]):
            assert archive.read(name) == name[2:].encode()


def test_masks_are_one_bit_png_images(tmp_path, parts):
    with zipfile.ZipFile(parts[0]) as archive:
        for name in archive.namelist():
            data = archive.read(name)
            # Width, height, bit depth and colour type as the PNG standard defines them.
            assert data[16:26] == (97).to_bytes(4, "big") + (54).to_bytes(4, "big") + b"\x01\x00"
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            assert image.dtype == np.uint8
            assert set(np.unique(image)) <= {0, 255}


@pytest.mark.parametrize(
    "layout",
    [
        "cam{camera}i/dron{drone}/{frame:06d}.png",
        "S02_D4_A/drone_masks/cam{camera}i_s/drone{drone}/frame_{frame}.png",
        "Dron_{drone}/cam{camera}i_{frame:04d}.bmp",
        "cam{camera}i_dron{drone}_{frame:05d}.PNG",
        "{frame:06d}/cam{camera}i_s_drone{drone}.png",
        "6088125{camera}/dron{drone}/{frame}.png",
    ],
)
def test_layouts_that_name_camera_drone_and_frame_are_read(tmp_path, layout):
    name = layout.split("/")[0].format(camera=2, drone=1, frame=0)
    camera = "60881252" if name.isdigit() and len(name) == 8 else "cam2i"
    with zipfile.ZipFile(tmp_path / "masks.zip", "w") as archive:
        archive.writestr("__MACOSX/._0.png", b"")
        archive.writestr("readme.txt", b"")
        for drone in (1, 2):
            for frame in (0, 7):
                _, png = cv2.imencode(".png", 255 * random_mask(10 * drone + frame).astype(np.uint8))
                archive.writestr(layout.format(camera=2, drone=drone, frame=frame), png.tobytes())
    with read_masks(tmp_path / "masks.zip") as masks:
        assert (masks.cameras, masks.drones, masks.frames) == ((camera,), (1, 2), (0, 7))
        np.testing.assert_array_equal(masks.mask(camera, 2, 7), random_mask(27))
        with pytest.raises(
            InputError, match=r"masks.*: expected a mask of dron3 in frame 7 of cam2i, found none"
        ):
            masks.mask("cam2i", 3, 7)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["a/b/0.png"], r"expected images such as cam1i/dron1/000000\.png .*, found a/b/0\.png"),
        (["cam1i/dron1/x.png"], r"expected images such as .*, found cam1i/dron1/x\.png"),
        (["masks.avi", "b.txt"], r"expected images such as .*, found masks\.avi, b\.txt"),
        ([], r"expected images such as .*, found no files"),
        (
            ["cam1i/dron1/1.png", "cam1i/dron1/01.png"],
            r"one image per camera.* found cam1i/dron1/1\.png and ",
        ),
    ],
)
def test_layouts_that_cannot_be_understood_are_named(tmp_path, names, message):
    with zipfile.ZipFile(tmp_path / "drone_masks.zip", "w") as archive:
        for name in names:
            archive.writestr(name, b"x")
    with pytest.raises(InputError, match=message):
        read_masks(tmp_path)


def test_broken_archives_and_images_are_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.zip: expected a ZIP archive of masks, found no such"):
        read_masks(tmp_path / "none.zip")
    (tmp_path / "text.zip").write_text("nothing")
    with pytest.raises(InputError, match=r"text\.zip: expected a ZIP archive of masks, found file is not"):
        read_masks(tmp_path / "text.zip")
    with zipfile.ZipFile(tmp_path / "masks.zip", "w") as archive:
        archive.writestr("cam1i/dron1/0.png", b"x")
        archive.writestr("cam1i/dron1/1.png", b"")
    with read_masks(tmp_path / "masks.zip") as masks:
        for frame in (0, 1):
            with pytest.raises(
                InputError,
                match=rf"masks\.zip: cam1i/dron1/{frame}\.png: expected an image, found a file that",
            ):
                masks.mask("cam1", 1, frame)


# --- detections


def make_silhouette(scene, xyxy, number=1, share=1.0):
    """Make the silhouette of a drone: a full rectangle, which is the share `share` of the unoccluded silhouette."""
    x0, y0, x1, y1 = xyxy
    window = RasterView(pinhole(scene.rig.cameras[0]), x0, y0, x1 - x0, y1 - y0)
    return Silhouette(number, window, np.ones(window.shape, bool), round((x1 - x0) * (y1 - y0) / share))


def scene_with_detector(scene, **values):
    quiet = {"jitter": 0, "miss_rate": 0, "double_rate": 0, "false_alarms_per_frame": 0} | values
    recipe = change_scenario(S02, {f"detector.{field}": value for field, value in quiet.items()})
    return replace(scene, scenario=recipe)


def binomial_bounds(count, rate):
    """Return mean minus and plus five standard deviations; a correct detector stays inside."""
    spread = 5 * math.sqrt(count * rate * (1 - rate)) + 1
    return count * rate - spread, count * rate + spread


LARGE = (300, 200, 380, 250)


def test_without_noise_the_detector_reports_the_boxes_that_are_seen(scene):
    others = [make_silhouette(scene, LARGE), make_silhouette(scene, (500, 100, 590, 160), 2)]
    found = detect(scene_with_detector(scene), 0, 17, others)
    assert found.frame.tolist() == [17, 17]
    assert sorted(found.xyxy.tolist()) == [[300, 200, 380, 250], [500, 100, 590, 160]]


@pytest.mark.parametrize("rate", [0.0, 0.03, 0.3, 1.0])
@pytest.mark.slow
def test_misses_and_double_detections_have_their_set_rates(scene, rate):
    frames = 800
    missing = scene_with_detector(scene, miss_rate=rate)
    found = sum(len(detect(missing, 0, frame, [make_silhouette(scene, LARGE)])) for frame in range(frames))
    low, high = binomial_bounds(frames, 1 - rate)
    assert low <= found <= high
    twice = scene_with_detector(scene, double_rate=rate)
    doubled = [detect(twice, 0, frame, [make_silhouette(scene, LARGE)]) for frame in range(frames)]
    low, high = binomial_bounds(frames, rate)
    assert low <= sum(len(detections) == 2 for detections in doubled) <= high
    for detections in doubled:
        # A network's non-maximum suppression, with a threshold of 0.45, would have merged boxes of a larger IoU.
        assert len(detections) < 2 or iou(detections.xyxy[0], detections.xyxy[1]) < 0.45


def test_the_second_box_of_a_double_detection_has_less_confidence(scene):
    twice = scene_with_detector(scene, double_rate=1.0)
    found = [detect(twice, 0, frame, [make_silhouette(scene, LARGE)]) for frame in range(400)]
    larger = [
        np.argsort(np.prod(detections.xyxy[:, 2:] - detections.xyxy[:, :2], axis=1)) for detections in found
    ]
    second_box, first_box = np.mean(
        [detections.confidence[order] for detections, order in zip(found, larger, strict=True)], axis=0
    )
    # Confidence is 0.25 + 0.75 (0.1 + 0.8 q) with q = 1 and 0.4; a mean of 400 values has a standard error of 0.004.
    assert first_box == pytest.approx(0.25 + 0.75 * 0.9, abs=0.016)
    assert second_box == pytest.approx(0.25 + 0.75 * 0.42, abs=0.016)


@pytest.mark.parametrize(
    ("side_px", "share", "rate"),
    # Values of 1 - (1 - v)^2 for the visible share v, and of 1 - exp(-(s / 10)^2) for the size s.
    [
        (100, 1.0, 1.0),
        (20, 1.0, 0.9817),
        (10, 1.0, 0.6321),
        (5, 1.0, 0.2212),
        (100, 0.5, 0.75),
        (100, 0.1, 0.19),
    ],
)
def test_small_and_occluded_drones_are_missed_more_often(scene, side_px, share, rate):
    frames = 800
    silhouette = make_silhouette(scene, (300, 200, 300 + side_px, 200 + side_px), share=share)
    quiet = scene_with_detector(scene)
    found = sum(len(detect(quiet, 0, frame, [silhouette])) for frame in range(frames))
    low, high = binomial_bounds(frames, rate)
    assert low <= found <= high


def test_jitter_is_a_share_of_the_size_of_the_box(scene):
    shaky = scene_with_detector(scene, jitter=0.05)
    boxes = np.concatenate(
        [detect(shaky, 0, frame, [make_silhouette(scene, LARGE)]).xyxy for frame in range(2000)]
    )
    size = boxes[:, 2:] - boxes[:, :2]
    shift = ((boxes[:, :2] + boxes[:, 2:]) / 2 - [340, 225]) / [80, 50]
    # With 2000 draws the standard error is 1.6 % of the deviation and 0.0011 of the mean; tolerances are four times
    # that.
    np.testing.assert_allclose(shift.std(axis=0), 0.05, rtol=0.065)
    np.testing.assert_allclose(shift.mean(axis=0), 0.0, atol=0.0045)
    np.testing.assert_allclose((size / [80, 50]).std(axis=0), 0.05, rtol=0.065)
    np.testing.assert_allclose((size / [80, 50]).mean(axis=0), 1.0, atol=0.006)


def test_false_alarms_are_poisson_distributed_and_spread_over_the_image(scene):
    noisy = scene_with_detector(scene, false_alarms_per_frame=0.7, miss_rate=1.0)
    found = [detect(noisy, 0, frame, [make_silhouette(scene, LARGE)]) for frame in range(2000)]
    counts = np.array([len(detections) for detections in found])
    # The mean of 2000 Poisson numbers has a standard error of 0.019, their variance of 0.034.
    assert counts.mean() == pytest.approx(0.7, abs=0.08)
    assert counts.var() == pytest.approx(0.7, abs=0.14)
    boxes = np.concatenate([detections.xyxy for detections in found])
    size = boxes[:, 2:] - boxes[:, :2]
    np.testing.assert_allclose(np.median(size, axis=0), [80, 50], rtol=0.1)
    width, height = scene.rig.cameras.image_size_wh[0]
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2 / [width, height]
    np.testing.assert_allclose(middle.mean(axis=0), 0.5, atol=0.05)
    assert np.all(np.ptp(middle, axis=0) > 0.8)
    # False alarms also come in frames without a drone.
    assert sum(len(detect(noisy, 0, frame, [])) for frame in range(200)) > 90


@pytest.mark.parametrize(("right", "merged"), [(20, True), (27, True), (33, False), (60, False), (90, False)])
def test_boxes_with_large_overlap_are_merged(scene, right, merged):
    # A shift by 20, 27 or 33 of 80 px gives an IoU of 0.6, 0.49 or 0.42.
    x0, y0, x1, y1 = LARGE
    pair = [make_silhouette(scene, LARGE), make_silhouette(scene, (x0 + right, y0, x1 + right, y1), 2)]
    found = detect(scene_with_detector(scene, merge_iou=0.45), 0, 0, pair)
    assert len(found) == (1 if merged else 2)
    if merged:
        assert found.xyxy.tolist() == [[x0, y0, x1 + right, y1]]


def test_confidence_grows_with_the_visible_share(scene):
    frames, quiet = 400, scene_with_detector(scene)
    means = []
    for share in (1.0, 0.6, 0.3):
        silhouette = make_silhouette(scene, LARGE, share=share)
        found = [detect(quiet, 0, frame, [silhouette]).confidence for frame in range(frames)]
        means.append(np.concatenate(found).mean())
    alarms = scene_with_detector(scene, false_alarms_per_frame=1.0)
    false = np.concatenate([detect(alarms, 0, frame, []).confidence for frame in range(frames)])
    means.append(false.mean())
    assert means[0] > 0.85
    # Each mean has a standard error of 0.01.
    assert np.all(np.diff(means) < -0.05)
    assert false.min() >= 0.25


def test_confidence_grows_with_the_quality_of_the_box(scene):
    shaky = scene_with_detector(scene, jitter=0.15)
    truth = np.array(LARGE, float)
    pairs = []
    for frame in range(600):
        detections = detect(shaky, 0, frame, [make_silhouette(scene, LARGE)])
        pairs += [
            (iou(box, truth), confidence)
            for box, confidence in zip(detections.xyxy, detections.confidence, strict=True)
        ]
    quality, confidence = np.array(pairs).T
    # Measured rank correlation 0.66.
    assert spearmanr(quality, confidence).statistic > 0.5


def test_boxes_lie_inside_the_image_in_order_of_confidence(scene):
    wild = scene_with_detector(scene, jitter=0.5, double_rate=0.5, false_alarms_per_frame=2.0)
    width, height = (int(side) for side in scene.rig.cameras.image_size_wh[0])
    at_edges = [
        make_silhouette(scene, (0, 0, 60, 40)),
        make_silhouette(scene, (width - 30, height - 50, width, height), 2),
    ]
    for frame in range(200):
        found = detect(wild, 0, frame, at_edges)
        assert np.all(found.xyxy >= 0)
        assert np.all(found.xyxy <= [width, height, width, height])
        assert np.all(found.xyxy[:, 2:] > found.xyxy[:, :2])
        assert np.all(np.diff(found.confidence) <= 0)
        assert np.all((found.confidence >= 0) & (found.confidence <= 1))


def test_detections_depend_only_on_seed_camera_and_frame(scene):
    silhouettes_seen = [make_silhouette(scene, LARGE)]
    shaky = scene_with_detector(scene, jitter=0.1)
    first = detect(shaky, 0, 5, silhouettes_seen).xyxy.tolist()
    detect(shaky, 0, 6, silhouettes_seen)
    assert detect(shaky, 0, 5, silhouettes_seen).xyxy.tolist() == first
    others = [(shaky, 1, 5), (shaky, 0, 6), (replace(shaky, seed=1), 0, 5)]
    for arguments in others:
        assert detect(*arguments, silhouettes_seen).xyxy.tolist() != first


def test_a_fully_hidden_drone_is_not_detected(scene):
    silhouette = make_silhouette(scene, LARGE)
    hidden = replace(silhouette, seen=np.zeros_like(silhouette.seen))
    assert len(detect(scene_with_detector(scene), 0, 0, [hidden])) == 0


@given(st.lists(st.integers(0, 12), min_size=8, max_size=8))
@settings(max_examples=60, deadline=None)
def test_iou_agrees_with_counted_pixels(corners):
    boxes = np.sort(np.reshape(corners, (2, 2, 2)), axis=1).reshape(2, 4)
    canvases = []
    for x0, y0, x1, y1 in boxes:
        canvas = np.zeros((12, 12), bool)
        canvas[y0:y1, x0:x1] = True
        canvases.append(canvas)
    union = (canvases[0] | canvases[1]).sum()
    expected = (canvases[0] & canvases[1]).sum() / union if union else 0.0
    assert iou(*boxes.astype(float)) == pytest.approx(expected, abs=1e-12)


# --- mocap markers


def test_markers_are_fixed_to_the_body_and_differ_between_drones(scene, tmp_path):
    markers = scene.mocap_markers_m(40)
    assert markers.shape == (40, 4, 4, 3)
    position, orientation = scene.positions_m(40), scene.orientations_wxyz(40)
    distances = []
    for drone in range(4):
        turn = Rotation.from_quat(orientation[:, drone], scalar_first=True)
        in_body = np.stack(
            [turn.inv().apply(markers[:, drone, marker] - position[:, drone]) for marker in range(4)], axis=1
        )
        # Quaternions are rounded to sixteen digits.
        np.testing.assert_allclose(in_body, np.broadcast_to(in_body[:1], in_body.shape), atol=1e-12)
        assert np.all(in_body[0, :, 2] > scene.models[drone].triangles_m[..., 2].max())
        distances.append(
            sorted(np.linalg.norm(in_body[0, a] - in_body[0, b]) for a, b in combinations(range(4), 2))
        )
        path = tmp_path / f"dron{drone + 1}_markers_25.csv"
        write_mocap_markers(path, markers[:, drone])
        np.testing.assert_array_equal(read_mocap_markers(path), markers[:, drone])
    for first, second in combinations(distances, 2):
        assert np.abs(np.subtract(first, second)).max() > 0.015, "crosses differ clearly"
