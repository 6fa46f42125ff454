"""Rendered frames, compared with independent geometry: `geometry.project`, OpenCV's markers, plane equations."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from placed_drones import cube, drone_masks, pixel_of, ray_point, straight_flight, with_drones

from psotrack.geometry import look_at, make_camera, project
from psotrack.simulation import CameraRenderer, build, scenario
from psotrack.simulation.imaging import posing, raster, sensor
from psotrack.simulation.world import drones, models, rooms

S02 = scenario("S02_D4_A")


@pytest.fixture(scope="module")
def scene():
    return build(S02, scale=0.25)


@pytest.fixture(scope="module")
def renderer(scene):
    return CameraRenderer(scene, 0)


def number_image(camera_renderer, frame):
    return drone_masks(camera_renderer.scene, camera_renderer.cam, camera_renderer.backdrop.depth_m, frame)


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


def test_a_floor_that_reaches_behind_the_camera_is_clipped():
    R, t = look_at((0.0, 0.0, 1.5), (3.0, 0.0, 1.2))
    cam = make_camera(
        R=R, t_m=t, K=np.array([[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]]), image_size_wh=(80, 60)
    )
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


def test_objects_behind_the_camera_are_not_drawn():
    R, t = look_at((0.0, 0.0, 1.5), (3.0, 0.0, 1.5))
    cam = make_camera(
        R=R, t_m=t, K=np.array([[60.0, 0, 40], [0, 60.0, 30], [0, 0, 1]]), image_size_wh=(80, 60)
    )
    view = raster.full_view(raster.pinhole(cam))
    colour, depth = raster.empty_buffers(view)
    raster.draw(view, models.box((-3.0, 0.0, 1.5), (1.0, 1.0, 1.0)), np.ones((12, 1, 3)), colour, depth)
    assert not colour.any()
    assert np.all(depth == raster.FAR_M)


# --- the backdrop


def test_markers_are_detected_at_their_projection():
    scene = build(S02, scale=0.6)
    # The image is in linear light, because gamma spreads white over black and moves each corner inwards by 0.2 px.
    image = np.clip(250 * CameraRenderer(scene, 0).backdrop.light, 0, 255).astype(np.uint8)
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(rooms.MARKER_DICTIONARY)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, settings).detectMarkers(image)
    assert set(ids.ravel()) <= set(range(1, 42)) == set(scene.room.marker_corners_m)
    assert len(ids) >= 6
    errors = [
        found.reshape(4, 2) - project(scene.rig.cameras[0], scene.room.marker_corners_m[int(marker)])[0]
        for marker, found in zip(ids.ravel(), corners, strict=True)
    ]
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
    black = with_drones(scene, (cube(0.3), straight_flight(centre, velocity_m_s), (0.0, 0.0, 0.0)))
    camera_renderer = CameraRenderer(black, index)
    with_it = sensor.undevelop(camera_renderer.clean_frame(0)).mean(axis=-1)
    without = sensor.undevelop(sensor.develop(camera_renderer.backdrop.light)).mean(axis=-1)
    x, y = pixel_of(scene, index, centre).round().astype(int)
    window = np.s_[y - 20 : y + 21, x - 20 : x + 21]
    # A black body hides the backdrop's light in proportion to the covered share of each pixel.
    covered = 1 - (with_it / without)[window]
    # Shares up to 0.03 come from the rounding to 8 bits and from the drone's own shadow.
    covered = np.where(covered > 0.03, covered, 0.0)
    rows, columns = np.mgrid[y - 20 : y + 21, x - 20 : x + 21]
    found = np.array([(covered * columns).sum(), (covered * rows).sum()]) / covered.sum()
    corners = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * 0.15 + centre
    hull = cv2.convexHull((64 * project(scene.rig.cameras[index], corners)[0]).round().astype(np.int32))
    moments = cv2.moments(hull)
    expected = np.array([moments["m10"], moments["m01"]]) / moments["m00"] / 64
    # Rounding to 8 bits, and 8 samples per pixel over an edge of about 60 pixels, give errors of a few hundredths.
    np.testing.assert_allclose(found, expected, atol=0.08)
    # The area agrees within the uncertainty of the edge, so edge pixels are covered partly.
    assert covered.sum() == pytest.approx(moments["m00"] / 64**2, rel=0.05)


@pytest.mark.parametrize("frame", [0, 100, 200])
@pytest.mark.parametrize("index", [0, 4, 7])
def test_silhouettes_lie_around_the_projected_origins(scene, index, frame):
    camera_renderer = CameraRenderer(scene, index)
    mask = number_image(camera_renderer, frame)
    origins = project(scene.rig.cameras[index], scene.positions_m(frame + 1)[-1])
    num_seen = 0
    for drone, (pixel, depth_m) in enumerate(zip(*origins, strict=True)):
        rows, columns = np.nonzero(mask == drone + 1)
        radius_px = (
            scene.rig.cameras.K[index, 0, 0]
            / scene.scale
            * scene.scale
            * scene.models[drone].radius_m
            / depth_m
        )
        if len(rows) < 0.15 * radius_px**2:
            continue  # hidden by another drone or a pillar
        num_seen += 1
        assert columns.min() - 1 <= pixel[0] <= columns.max() + 1
        assert rows.min() - 1 <= pixel[1] <= rows.max() + 1
        # The centroid of body and legs is up to 5 cm from the origin, at a radius of 25 to 30 cm, and farther where a
        # part is hidden.
        assert np.hypot(columns.mean() - pixel[0], rows.mean() - pixel[1]) < 0.35 * radius_px + 1
    assert num_seen >= 2


def test_frames_differ_from_the_empty_room_only_in_masks_and_shadows(renderer):
    frame = renderer.clean_frame(60).astype(int)
    changed = np.abs(frame - sensor.develop(renderer.backdrop.light)).max(axis=-1) > 2
    mask = number_image(renderer, 60) > 0
    # Lens blur and motion blur reach a few pixels beyond the mask at mid-exposure.
    near = cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    assert not (changed & ~near & ~renderer.backdrop.floor).any()
    assert (changed & mask).sum() > 0.5 * mask.sum(), "drones must be seen"


def test_the_nearer_drone_hides_the_farther_drone_in_either_order(scene):
    pixel = (240.0, 150.0)
    red, blue = (0.02, 0.02, 0.6), (0.6, 0.02, 0.02)
    near = (cube(0.3), straight_flight(ray_point(scene, 0, pixel, 3.5)), red)
    far = (cube(0.3), straight_flight(ray_point(scene, 0, pixel, 6.0)), blue)
    a, b = CameraRenderer(with_drones(scene, near, far), 0), CameraRenderer(with_drones(scene, far, near), 0)
    alone = CameraRenderer(with_drones(scene, near), 0)
    x, y = (int(side) for side in pixel)
    assert number_image(a, 0)[y, x] == 1
    assert number_image(b, 0)[y, x] == 2
    # The far cube's silhouette lies inside the near cube's silhouette, so the far cube is fully hidden.
    assert not (number_image(a, 0) == 2).any()
    window = np.s_[y - 8 : y + 9, x - 8 : x + 9]
    np.testing.assert_array_equal(a.clean_frame(0)[window], b.clean_frame(0)[window])
    np.testing.assert_array_equal(a.clean_frame(0)[window], alone.clean_frame(0)[window])
    assert a.clean_frame(0)[y, x, 2] > 3 * a.clean_frame(0)[y, x, 0], "the near cube is red"


def test_a_pillar_hides_a_drone_behind_it(scene):
    lower, upper = np.array([-2.1, 2.75, 1.4]), np.array([-1.85, 3.0, 1.4])  # a pillar of the laboratory
    pixel = pixel_of(scene, 3, (lower + upper) / 2)
    _, depth_m = project(scene.rig.cameras[3], (lower + upper) / 2)
    small = cube(0.1)
    for behind_m, visible in ((0.8, False), (-0.8, True)):
        flight = straight_flight(ray_point(scene, 3, pixel, depth_m + behind_m))
        camera_renderer = CameraRenderer(with_drones(scene, (small, flight, (0.0, 0.0, 0.0))), 3)
        assert number_image(camera_renderer, 0).any() == visible
        x, y = pixel.astype(int)
        darker = (
            sensor.develop(camera_renderer.backdrop.light)[y, x].astype(int)
            - camera_renderer.clean_frame(0)[y, x]
        )
        assert (darker.max() > 20) == visible


def test_rotor_discs_are_partly_transparent(scene):
    bare = cube(0.02)
    disc = replace(bare, rotor_radii_m=np.array([0.3]))
    centre = np.array([0.0, 0.0, 1.2])
    camera_renderer = CameraRenderer(with_drones(scene, (disc, straight_flight(centre), (0.0, 0.0, 0.0))), 0)
    x, y = pixel_of(scene, 0, centre + np.array([0.1, 0.1, 0.0])).round().astype(int)
    share = (
        sensor.undevelop(camera_renderer.clean_frame(0))[y, x]
        / sensor.undevelop(sensor.develop(camera_renderer.backdrop.light))[y, x]
    )
    assert np.all((share > 0.4) & (share < 0.9))


def test_rotors_dim_the_background_in_either_order_and_walls_hide_rotors(scene):
    rotor = replace(cube(0.02), rotor_radii_m=np.array([0.3]))
    places = [straight_flight(ray_point(scene, 0, (240.0, 150.0), depth_m)) for depth_m in (3.5, 6.0)]
    two_rotors = with_drones(scene, *((rotor, flight, (0.0, 0.0, 0.0)) for flight in places))
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
            num_seen = posing.sample(view, order, 0, np.full(view.shape, wall_m, np.float32))
            np.testing.assert_allclose(num_seen[150, 252], [light, light, light, clear], atol=1e-6)


def test_the_darkest_shadow_is_straight_below_a_drone_under_a_lamp(scene):
    lamp = scene.room.panels.centres_m[3]
    below = np.array([lamp[0], lamp[1], 1.2])
    camera_renderer = CameraRenderer(
        with_drones(scene, (drones.model("x_frame"), straight_flight(below), (0.1,) * 3)), 0
    )
    gain = camera_renderer.shadows.floor_gain(0.0)
    row, column = np.unravel_index(gain.argmin(), gain.shape)
    cell_m = 10.0 / gain.shape[1]
    at_m = np.array([(column + 0.5) * cell_m - 5.0, 4.0 - (row + 0.5) * cell_m])
    # The model's centre is a few centimetres from its origin.
    np.testing.assert_allclose(at_m, below[:2], atol=0.05)
    assert 0.5 < gain.min() < 0.95
    assert gain.max() == 1.0


# --- the sensor


def test_noise_has_mean_zero_and_grows_with_brightness():
    camera_sensor = sensor.Sensor(S02.imaging, 0, 0, (120, 160))
    sigmas = []
    for level in (20, 120, 220):
        image = np.full((120, 160, 3), level, np.uint8)
        frames = np.stack([camera_sensor.expose(image, frame, frame / 25) for frame in range(40)]).astype(
            float
        )
        # Flicker and drift are below one percent and shift the mean by less than that.
        assert abs(frames.mean() - level) < 0.01 * level + 0.1
        sigmas.append(np.std(frames - frames.mean(axis=(1, 2, 3), keepdims=True)))
    assert sigmas[0] < sigmas[1] < sigmas[2]
    assert sigmas[0] > 0.8
    assert sigmas[2] < 3.5


def test_noise_depends_on_seed_camera_and_frame_only():
    image = np.full((60, 80, 3), 120, np.uint8)

    def expose(seed, index, frame):
        return sensor.Sensor(S02.imaging, seed, index, (60, 80)).expose(image, frame, 0.0).astype(float)

    np.testing.assert_array_equal(expose(1, 2, 3), expose(1, 2, 3))
    for other in ((1, 2, 4), (1, 3, 3), (2, 2, 3)):
        a, b = (shown - shown.mean() for shown in (expose(1, 2, 3), expose(*other)))
        # With 14,400 numbers and correlated neighbours, independent noise has a correlation of about 0.01.
        assert abs((a * b).mean() / (a.std() * b.std())) < 0.06


def test_a_frame_does_not_depend_on_frames_drawn_before(scene, renderer):
    renderer.frame(7)
    np.testing.assert_array_equal(renderer.frame(60), CameraRenderer(scene, 0).frame(60))


# --- models


@pytest.mark.parametrize("name", drones.MODELS)
def test_models_are_closed_face_outwards_and_have_the_size_of_drones(name):
    model = drones.model(name)
    a, b, c = model.triangles_m.swapaxes(0, 1)
    # By the divergence theorem, the face vectors of closed solids sum to zero, and the enclosed volume is positive if
    # faces point outwards.
    np.testing.assert_allclose(np.cross(b - a, c - a).sum(axis=0), 0.0, atol=1e-9)
    assert np.einsum("fi,fi->", a, np.cross(b, c)) > 0
    assert len(model.rotor_centres_m) >= 4
    span = np.ptp(model.rotor_centres_m, axis=0).max() + 2 * model.rotor_radii_m.max()
    assert 0.3 <= span <= 0.85
    assert np.linalg.norm(model.triangles_m, axis=-1).max() <= model.radius_m
    assert np.all((model.paint >= 0) & (model.paint <= 1))
