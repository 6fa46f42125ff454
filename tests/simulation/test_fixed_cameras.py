"""What fixed cameras show, lenses with distortion included, compared with projections by OpenCV and plane equations."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from placed_drones import (
    BLACK,
    CORNERS_M,
    S02,
    around,
    centre_and_area,
    cube,
    find_markers,
    hidden_by_drones,
    hidden_share,
    hovering,
    laboratory,
    mean_and_variance,
    number_image,
    pixel_of,
    ray_point,
    straight_flight,
    with_drones,
    with_imaging,
)

from psotrack.geometry import look_at, make_camera, make_rig, project, undistort
from psotrack.recordings.datasets import open_recording
from psotrack.simulation import CameraRenderer, SimulationSettings, build, change_scenario, simulate
from psotrack.simulation.imaging import posing, raster, sensor
from psotrack.simulation.labels.masks import lens_silhouettes
from psotrack.simulation.world import drones, models


@pytest.fixture
def scene():
    return laboratory()


# --- the rasteriser and the camera convention


@pytest.mark.parametrize(
    ("window", "magnification"), [((0, 0, 200, 120), 8), ((37, 21, 90, 70), 8), ((60, 10, 51, 83), 7)]
)
def test_a_drawn_square_lies_at_its_projection(window, magnification):
    rng = np.random.default_rng(5)
    R, t = look_at((1.0, -4.0, 2.0), (0.2, 0.1, 1.0))
    K = np.array([[150.0, 0.0, 91.3], [0.0, 150.0, 66.8], [0.0, 0.0, 1.0]])  # far from the image's centre
    cam = make_camera(R=R, t_m=t, K=K, image_size_wh=(200, 120))
    view = raster.RasterView(raster.pinhole(cam), *window, magnification)
    errors = []
    while len(errors) < 40:
        centre = R.T @ (rng.uniform(3, 6) * np.linalg.inv(K) @ [*rng.uniform((70, 35), (100, 75)), 1.0] - t)
        corners = centre + 0.06 * (np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) @ R[:2])
        colour, depth = raster.empty_buffers(view)
        raster.draw(view, corners[[[0, 1, 2], [0, 2, 3]]], np.ones((2, 1, 3)), colour, depth)
        rows, columns = np.nonzero(colour[..., 0])
        # Position of a sample in camera pixels, computed from the definitions of window and magnification.
        found = [
            (np.mean(i) + 0.5) / magnification - 0.5 + first
            for i, first in ((columns, window[0]), (rows, window[1]))
        ]
        errors.append(found - project(cam, centre)[0])
        # OpenCV stores depth as float32 between the near and the far plane: half a millimetre at 5 m.
        np.testing.assert_allclose(depth[rows, columns], project(cam, centre)[1], rtol=1e-4)
    errors = np.array(errors)
    # A sample is 1/7 or 1/8 px wide: the error of one centroid is at most half a sample, and the standard error of the
    # mean of forty centroids is a sixth of that.
    assert np.abs(errors).max() < 0.5 / 7
    assert np.abs(errors.mean(axis=0)).max() < 0.5 / 7 / 3


def test_what_is_behind_the_camera_is_clipped():
    R, t = look_at((0.0, 0.0, 1.5), (3.0, 0.0, 1.2))
    K = np.array([[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]])
    cam = make_camera(R=R, t_m=t, K=K, image_size_wh=(80, 60))
    view = raster.full_view(raster.pinhole(cam))
    floor = np.array([(-9.0, -9.0, 0.0), (9.0, -9.0, 0.0), (9.0, 9.0, 0.0), (-9.0, 9.0, 0.0)])
    colour, depth = raster.empty_buffers(view)
    raster.draw(view, floor[[[0, 1, 2], [0, 2, 3]]], np.ones((2, 1, 3)), colour, depth)
    rays = np.stack(np.meshgrid(np.arange(80), np.arange(60)), axis=-1)
    rays = np.concatenate([rays, np.ones((60, 80, 1))], axis=-1) @ np.linalg.inv(cam.K).T
    downwards = rays @ R[:, 2]
    expected = np.where(downwards < 0, -1.5 / np.minimum(downwards, -1e-9), np.inf)
    at = rays @ R * np.where(np.isfinite(expected), expected, 0)[..., None]
    # Leave out a strip at the floor's edge that is wider than a pixel, which covers 0.15 m at 9 m.
    inside = np.isfinite(expected) & (np.abs(at[..., :2]).max(axis=-1) < 8.7)
    assert inside.sum() > 1000
    np.testing.assert_allclose(depth[inside], expected[inside], rtol=1e-4)  # float32 over 9 m
    colour, depth = raster.empty_buffers(view)
    raster.draw(view, models.box((-3.0, 0.0, 1.5), (1.0, 1.0, 1.0)), np.ones((12, 1, 3)), colour, depth)
    assert not colour.any()
    assert np.all(depth == raster.FAR_M)


def test_markers_are_detected_at_their_projection():
    scene = laboratory(0.6)
    # The image is in linear light, because gamma spreads white over black and moves each corner inwards by 0.2 px.
    image = np.clip(250 * CameraRenderer(scene, 0).backdrop.light, 0, 255).astype(np.uint8)
    corners_m, found = scene.room.marker_corners_m, find_markers(image)
    assert set(found) <= set(range(1, 42)) == set(corners_m)
    assert len(found) >= 6
    camera = scene.rig.cameras[0]
    errors = [corners - project(camera, corners_m[marker])[0] for marker, corners in found.items()]
    # OpenCV finds the corners of a blurred black square 0.2 to 0.4 px inside the square (measured median 0.40 px). A
    # common shift of all corners would be an error of the renderer; the mean of 60 corners has a standard error of
    # 0.05 px (measured shift 0.07 px).
    assert np.median(np.linalg.norm(errors, axis=-1)) < 0.5
    assert np.abs(np.mean(errors, axis=(0, 1))).max() < 0.15


# --- drones in frames


@pytest.mark.parametrize("velocity_m_s", [(0.0, 0.0, 0.0), (1.0, -2.0, 1.0)])
@pytest.mark.parametrize("index", [0, 3, 6])
def test_a_drone_of_known_centre_is_drawn_at_its_projection(scene, index, velocity_m_s):
    """Frames before encoding have no shift; the blur of a moving drone is centred on the projection."""
    centre = np.array([0.3, -0.2, 1.45])
    black = with_drones(scene, (cube(0.3), straight_flight(centre, velocity_m_s), BLACK))
    window, first = around(pixel_of(scene, index, centre), 20)
    covered = hidden_by_drones(black, index)[window]
    corners = project(scene.rig.cameras[index], 0.3 * CORNERS_M + centre)[0]
    expected, area = centre_and_area(corners)
    # Rounding to 8 bits, and 8 samples per pixel over an edge of about 60 pixels, give errors of a few hundredths.
    np.testing.assert_allclose(mean_and_variance(covered)[0] + first, expected, atol=0.08)
    # The area agrees within the uncertainty of the edge, so edge pixels are covered partly.
    assert covered.sum() == pytest.approx(area, rel=0.05)


def test_a_pillar_hides_a_drone_behind_it(scene):
    pillar = np.array([-1.975, 2.875, 1.4])
    pixel, depth_m = project(scene.rig.cameras[3], pillar)
    x, y = pixel.astype(int)
    for behind_m, visible in ((0.8, False), (-0.8, True)):
        placed = hovering(cube(0.1), ray_point(scene, 3, pixel, depth_m + behind_m))
        hidden = with_drones(scene, placed)
        assert number_image(CameraRenderer(hidden, 3)).any() == visible
        assert (hidden_by_drones(hidden, 3)[y, x] > 0.5) == visible


def test_rotors_dim_the_background_in_either_order_and_walls_hide_rotors(scene):
    rotor = replace(cube(0.02), rotor_radii_m=np.array([0.3]))
    places = [ray_point(scene, 0, (240.0, 150.0), depth_m) for depth_m in (3.5, 6.0)]
    two_rotors = with_drones(scene, *(hovering(rotor, place) for place in places))
    view = raster.full_view(raster.pinhole(scene.rig.cameras[0]))
    poses = []
    for drone, light in ((0, 0.0), (1, 1.0)):
        pose = posing.pose(two_rotors, drone, np.zeros(1))
        opacity_light = np.broadcast_to([0.5, light, 0.0], pose.disc_opacity_light.shape)
        poses.append(replace(pose, disc_opacity_light=opacity_light))
    # The pixel is beside the hubs; each rotor has an opacity of 0.5. Without a wall, the far bright rotor adds light
    # 0.5 * 0.5, and a quarter of the background is visible. A wall at 5 m hides the far rotor, and only the dark near
    # rotor remains. A wall at 2 m hides both rotors.
    for wall_m, light, clear in ((raster.FAR_M, 0.25, 0.25), (5.0, 0.0, 0.5), (2.0, 0.0, 1.0)):
        for order in (poses, poses[::-1]):
            seen = posing.sample(view, order, 0, np.full(view.shape, wall_m, np.float32))
            np.testing.assert_allclose(seen[150, 252], [light, light, light, clear], atol=1e-6)
    # With the opacity of a model, the wall is seen through one black rotor.
    beside = hidden_by_drones(with_drones(scene, hovering(rotor, places[0])))[150, 252]
    assert 0.1 < beside < 0.6


def test_the_darkest_shadow_is_straight_below_a_drone_under_a_lamp(scene):
    lamp = scene.room.panels.centres_m[3]
    below = np.array([lamp[0], lamp[1], 1.2])
    renderer = CameraRenderer(with_drones(scene, hovering(drones.model("x_frame"), below, (0.1,) * 3)), 0)
    gain = renderer.shadows.floor_gain(0.0)
    row, column = np.unravel_index(gain.argmin(), gain.shape)
    cell_m = 10.0 / gain.shape[1]
    at_m = np.array([(column + 0.5) * cell_m - 5.0, 4.0 - (row + 0.5) * cell_m])
    # The model's centre is a few centimetres from its origin.
    np.testing.assert_allclose(at_m, below[:2], atol=0.05)
    assert 0.5 < gain.min() < 0.95
    assert gain.max() == 1.0


# --- lenses with distortion


SIZE_WH = (480, 270)
PRISM = (-0.28, 0.11, 0.0007, -0.0011, -0.02, 0.02, -0.01, 0.003, 0.0011, -0.0004, -0.0008, 0.0003)
#: Focal length in pixels, coefficients, and whether the lens is a fisheye.
LENSES = {
    "5": (270.0, (0.21, -0.02, -0.0004, 0.0009, 0.03), False),
    "8": (230.0, (0.3, 0.05, 0.0004, -0.0002, 0.01, 0.6, 0.2, 0.02), False),
    "14": (270.0, (*PRISM, 0.06, -0.04), False),
    "fisheye": (200.0, (-0.012, 0.021, -0.018, 0.004), True),
}


def with_lens(name):
    """A scene without blur, motion and shadows, with one camera in the middle of the room that has a lens."""
    focal_px, dist, fisheye = LENSES[name]
    R, t_m = look_at((0.3, -1.5, 1.6), (0.0, 3.0, 1.3))
    K = np.array([[focal_px, 3.0, 236.0], [0.0, 1.02 * focal_px, 137.0], [0.0, 0.0, 1.0]])
    lens = make_camera(R=R, t_m=t_m, K=K, image_size_wh=SIZE_WH, dist=dist, fisheye=fisheye)
    still = {"shutter_s": 0.0, "lens_blur_px": 0.0, "shadows": False, "reflections": 0.0}
    return replace(with_imaging(laboratory(), S02.imaging, **still), rig=make_rig({"cam1": lens}))


def lens_pixels(lens, points_m):
    """Pixels of points by OpenCV, which has no skew: the skew is added to normalised coordinates."""
    function = cv2.projectPoints if lens.fisheye is None else cv2.fisheye.projectPoints
    turn = cv2.Rodrigues(lens.T_cam_world[:3, :3])[0]
    flat = function(points_m.reshape(-1, 1, 3), turn, lens.T_cam_world[:3, 3], np.eye(3), lens.dist)[0]
    return flat[:, 0] @ lens.K[:2, :2].T + lens.K[:2, 2]


@pytest.mark.parametrize("name", LENSES)
def test_small_drones_are_drawn_where_opencv_projects_them(name):
    scene = with_lens(name)
    lens = scene.rig.cameras[0]
    R, t_m = lens.T_cam_world[:3, :3], lens.T_cam_world[:3, 3]
    # In the middle, near the left border and near a corner.
    pixels = np.array([[240.0, 130.0], [25.0, 140.0], [450.0, 240.0]])
    rays = np.column_stack([undistort(lens, pixels), np.ones(3)])
    places_m = (1.5 * rays / np.linalg.norm(rays, axis=-1, keepdims=True) - t_m) @ R
    scene = with_drones(scene, *(hovering(cube(0.06), place_m) for place_m in places_m))
    renderer = CameraRenderer(scene, 0)
    empty = renderer.lens.assemble([sensor.develop(view.backdrop.light) for view in renderer.views])
    hidden = hidden_share(renderer.clean_frame(0), empty)
    depths_m = [view.backdrop.depth_m for view in renderer.views]
    silhouettes = lens_silhouettes(scene, renderer.cam, renderer.lens, depths_m, 0)
    for pixel, place_m, silhouette in zip(pixels, places_m, silhouettes, strict=True):
        np.testing.assert_allclose(lens_pixels(lens, place_m)[0], pixel, atol=1e-6)
        # The middle of the cube's outline, whose edges are straight over so short a distance.
        expected, area = centre_and_area(lens_pixels(lens, place_m + 0.06 * CORNERS_M))
        window, first = around(pixel, 20)
        covered = hidden[window]
        # The cubes are 6 to 25 px wide. Interpolation, 8 bits and 8 samples per pixel cost a tenth of a pixel.
        np.testing.assert_allclose(mean_and_variance(covered)[0] + first, expected, atol=0.15)
        assert covered.sum() == pytest.approx(area, rel=0.08)
        # The mask of the drone is where the drone is drawn; they differ by a part of the pixels at the edge.
        mask = silhouette.mask()[window]
        assert (mask != (covered > 0.5)).sum() <= 0.2 * mask.sum()
        assert silhouette.seen_share > 0.9


def test_a_wide_lens_shows_the_whole_room_without_seams_or_holes():
    """The picture of a fisheye, undistorted by OpenCV, is the picture of a camera without distortion."""
    wide = with_lens("fisheye")
    lens = wide.rig.cameras[0]
    renderer = CameraRenderer(wide, 0)
    assert len(renderer.views) > 1
    picture = renderer.clean_frame(0)
    assert (renderer.lens.face >= 0).all()
    K = np.array([[120.0, 0.0, 239.5], [0.0, 120.0, 134.5], [0.0, 0.0, 1.0]])
    no_skew = lens.K * np.array([[1, 0, 1], [1, 1, 1], [1, 1, 1]])
    maps = cv2.fisheye.initUndistortRectifyMap(no_skew, lens.dist, np.eye(3), K, SIZE_WH, cv2.CV_32FC1)
    # OpenCV's maps have no skew: a row of the image is shifted by the skew.
    columns = (maps[0] + lens.K[0, 1] * (maps[1] - lens.K[1, 2]) / lens.K[1, 1]).astype(np.float32)
    found, inside = (
        cv2.remap(image, columns, maps[1], cv2.INTER_LINEAR)
        for image in (picture, np.ones(picture.shape[:2]))
    )
    inside = inside > 0.999
    assert inside.mean() > 0.8
    T = lens.T_cam_world
    flat = make_camera(R=T[:3, :3], t_m=T[:3, 3], K=K, image_size_wh=SIZE_WH)
    expected = CameraRenderer(replace(wide, rig=make_rig({"cam1": flat})), 0).clean_frame(0)
    # Every part of the picture, seams included, lies within a small part of a pixel of the expected picture.
    grey = [cv2.GaussianBlur(image.mean(axis=-1), (0, 0), 1.5) for image in (found, expected)]
    taper = np.hanning(60)[:, None] * np.hanning(60)
    shifts = []
    for y in range(0, SIZE_WH[1] - 60, 30):
        for x in range(0, SIZE_WH[0] - 60, 30):
            part = np.s_[y : y + 60, x : x + 60]
            # A part without edges has no place.
            if inside[part].all() and grey[1][part].std() > 8:
                shifts.append(cv2.phaseCorrelate(grey[0][part], grey[1][part], taper)[0])
    assert len(shifts) > 40
    assert np.abs(np.median(shifts, axis=0)).max() < 0.05
    assert np.percentile(np.abs(shifts), 90) < 0.3
    assert np.abs(grey[0] - grey[1])[inside].mean() < 3


def test_a_simulated_sequence_of_any_lenses_is_a_recording(tmp_path):
    """The dataset's calibration cannot hold these lenses; the recording has them, its videos and its reference."""
    place = {"target_m": (0.0, 0.0, 1.2), "focal_length_px": 800.0}
    fisheye = {"position_m": (3.0, -2.5, 2.6), "distortion": (-0.01, 0.02, 0.0, 0.0), "fisheye": True}
    prism = {"position_m": (-3.0, -2.5, 2.6), "distortion": PRISM, "aspect": 1.01, "skew_px": 2.0}
    recipe = change_scenario(S02, {"cameras": [place | fisheye, place | prism]})
    settings = SimulationSettings(num_frames=2, scale=0.04, masks=False, onboard=False)
    found, made = open_recording(simulate(recipe, tmp_path, settings, jobs=1)), build(recipe, scale=0.04).rig
    assert found.rig.names == made.names == ("cam1", "cam2")
    assert found.rig.cameras.fisheye.tolist() == [True, False]
    points_m = np.random.default_rng(0).uniform((-1, -1, 0.5), (1, 1, 2), (9, 1, 3))
    pixels = [project(rig.cameras, points_m)[0] for rig in (found.rig, made)]
    np.testing.assert_allclose(*pixels, atol=1e-6)
    assert [video.num_frames for video in found.videos.values()] == [2, 2]
    assert found.truth.num_drones == 4
    assert set(found.detections) == {"cam1", "cam2"}
