"""Simulated cameras with lens distortion: OpenCV's projection is the oracle for what they draw."""

from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest
from placed_drones import cube, straight_flight, with_drones

from psotrack.errors import SettingsError
from psotrack.geometry import look_at, make_camera, make_rig, project, undistort
from psotrack.recordings.datasets import open_recording
from psotrack.simulation import (
    CameraRenderer,
    SimulationSettings,
    build,
    change_scenario,
    scenario,
    simulate,
)
from psotrack.simulation.imaging import sensor
from psotrack.simulation.labels.masks import lens_silhouettes

S02 = scenario("S02_D4_A")
SIZE_WH = (480, 270)
PRISM = (-0.28, 0.11, 0.0007, -0.0011, -0.02, 0.02, -0.01, 0.003, 0.0011, -0.0004, -0.0008, 0.0003)
#: Focal length in pixels, coefficients, and whether the lens is a fisheye.
LENSES = {
    "4": (270.0, (-0.25, 0.05, 0.001, -0.002), False),
    "5": (270.0, (0.21, -0.02, -0.0004, 0.0009, 0.03), False),
    "8": (230.0, (0.3, 0.05, 0.0004, -0.0002, 0.01, 0.6, 0.2, 0.02), False),
    "12": (270.0, PRISM, False),
    "14": (270.0, (*PRISM, 0.06, -0.04), False),
    "fisheye": (200.0, (-0.012, 0.021, -0.018, 0.004), True),
}
#: Corners of a cube of 6 cm around the origin, metres.
CORNERS = 0.03 * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])


@pytest.fixture(scope="module")
def scene():
    """A small scene without blur, motion and shadows."""
    effects = {"shutter_s": 0.0, "lens_blur_px": 0.0, "shadows": False}
    imaging = msgspec.structs.replace(S02.imaging, reflections=0.0, **effects)
    return build(msgspec.structs.replace(S02, imaging=imaging), scale=0.25)


def with_lens(scene, name):
    """The scene with one camera, in the middle of the room, whose lens has this name."""
    focal_px, dist, fisheye = LENSES[name]
    R, t_m = look_at((0.3, -1.5, 1.6), (0.0, 3.0, 1.3))
    K = np.array([[focal_px, 3.0, 236.0], [0.0, 1.02 * focal_px, 137.0], [0.0, 0.0, 1.0]])
    lens = make_camera(R=R, t_m=t_m, K=K, image_size_wh=SIZE_WH, dist=dist, fisheye=fisheye)
    return replace(scene, rig=make_rig({"cam1": lens}))


def opencv_pixels(lens, points_m):
    """Pixels of points by OpenCV, which has no skew: the skew is added to normalised coordinates."""
    function = cv2.projectPoints if lens.fisheye is None else cv2.fisheye.projectPoints
    turn = cv2.Rodrigues(lens.T_cam_world[:3, :3])[0]
    flat = function(points_m.reshape(-1, 1, 3), turn, lens.T_cam_world[:3, 3], np.eye(3), lens.dist)[0]
    return flat[:, 0] @ lens.K[:2, :2].T + lens.K[:2, 2]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in {"4", "12"} else []) for name in LENSES]
)
def test_small_drones_are_drawn_where_opencv_projects_them(scene, name):
    scene = with_lens(scene, name)
    lens = scene.rig.cameras[0]
    R, t_m = lens.T_cam_world[:3, :3], lens.T_cam_world[:3, 3]
    # In the middle, near the left border and near a corner.
    pixels = np.array([[240.0, 130.0], [25.0, 140.0], [450.0, 240.0]])
    rays = np.column_stack([undistort(lens, pixels), np.ones(3)])
    places_m = (1.5 * rays / np.linalg.norm(rays, axis=-1, keepdims=True) - t_m) @ R
    scene = with_drones(scene, *((cube(0.06), straight_flight(place_m), (0.0,) * 3) for place_m in places_m))
    renderer = CameraRenderer(scene, 0)
    views = renderer.views
    without = renderer.lens.assemble([sensor.develop(view.backdrop.light) for view in views])
    light, empty = (sensor.undevelop(image).sum(axis=-1) for image in (renderer.clean_frame(0), without))
    silhouettes = lens_silhouettes(
        scene, renderer.cam, renderer.lens, [view.backdrop.depth_m for view in views], 0
    )
    for pixel, place_m, silhouette in zip(pixels, places_m, silhouettes, strict=True):
        np.testing.assert_allclose(opencv_pixels(lens, place_m)[0], pixel, atol=1e-6)
        # The middle of the cube's outline, whose edges are straight over so short a distance.
        outline = cv2.convexHull((256 * opencv_pixels(lens, place_m + CORNERS)).round().astype(np.int32))
        moments = cv2.moments(outline)
        expected = np.array([moments["m10"], moments["m01"]]) / moments["m00"] / 256
        x, y = pixel.astype(int)
        window = np.s_[y - 20 : y + 21, x - 20 : x + 21]
        share = 1 - light[window] / empty[window]
        covered = np.where(share > 0.05, share, 0.0)
        rows, columns = np.mgrid[window]
        found = np.array([(covered * columns).sum(), (covered * rows).sum()]) / covered.sum()
        # The cubes are 6 to 25 px wide. Interpolation, 8 bits and 8 samples per pixel cost a tenth of a pixel.
        np.testing.assert_allclose(found, expected, atol=0.15)
        assert covered.sum() == pytest.approx(moments["m00"] / 256**2, rel=0.08)
        # The mask of the drone is where the drone is drawn; they differ by a part of the pixels at the edge.
        mask = silhouette.mask()[window]
        assert (mask != (covered > 0.5)).sum() <= 0.2 * mask.sum()
        assert silhouette.seen_share > 0.9


@pytest.mark.slow
def test_a_wide_lens_shows_the_whole_room_without_seams_or_holes(scene):
    """The picture of a fisheye, undistorted by OpenCV, is the picture of a camera without distortion."""
    wide = with_lens(scene, "fisheye")
    lens = wide.rig.cameras[0]
    renderer = CameraRenderer(wide, 0)
    assert len(renderer.views) > 1
    picture = renderer.clean_frame(0)
    assert (renderer.lens.face >= 0).all()
    K = np.array([[120.0, 0.0, 239.5], [0.0, 120.0, 134.5], [0.0, 0.0, 1.0]])
    no_skew = lens.K * np.array([[1, 0, 1], [1, 1, 1], [1, 1, 1]])
    maps = cv2.fisheye.initUndistortRectifyMap(no_skew, lens.dist, np.eye(3), K, SIZE_WH, cv2.CV_32FC1)
    # OpenCV's maps have no skew: a row of the image is shifted by the skew.
    columns = maps[0] + lens.K[0, 1] * (maps[1] - lens.K[1, 2]) / lens.K[1, 1]
    found = cv2.remap(picture, columns.astype(np.float32), maps[1], cv2.INTER_LINEAR)
    T = lens.T_cam_world
    flat = make_camera(R=T[:3, :3], t_m=T[:3, 3], K=K, image_size_wh=SIZE_WH)
    expected = CameraRenderer(replace(scene, rig=make_rig({"cam1": flat})), 0).clean_frame(0)
    inside = (
        cv2.remap(np.ones(picture.shape[:2]), columns.astype(np.float32), maps[1], cv2.INTER_LINEAR) > 0.999
    )
    assert inside.mean() > 0.8
    # Every part of the picture, seams included, lies within a small part of a pixel of the expected picture.
    grey = [cv2.GaussianBlur(image.mean(axis=-1), (0, 0), 1.5) for image in (found, expected)]
    shifts = []
    for y in range(0, SIZE_WH[1] - 60, 30):
        for x in range(0, SIZE_WH[0] - 60, 30):
            part = np.s_[y : y + 60, x : x + 60]
            if inside[part].all() and grey[1][part].std() > 8:
                shifts.append(
                    cv2.phaseCorrelate(
                        grey[0][part], grey[1][part], np.hanning(60)[:, None] * np.hanning(60)
                    )[0]
                )
    assert len(shifts) > 40
    assert np.abs(np.median(shifts, axis=0)).max() < 0.05
    assert np.percentile(np.abs(shifts), 90) < 0.3
    assert np.abs(grey[0] - grey[1])[inside].mean() < 3


def test_a_simulated_sequence_of_any_lenses_is_a_recording(tmp_path):
    """The dataset's calibration cannot hold these lenses; the recording has them, its videos and its reference."""
    place = {"target_m": (0.0, 0.0, 1.2), "focal_length_px": 800.0}
    recipe = change_scenario(
        S02,
        {
            "cameras": [
                place
                | {"position_m": (3.0, -2.5, 2.6), "distortion": (-0.01, 0.02, 0.0, 0.0), "fisheye": True},
                place
                | {"position_m": (-3.0, -2.5, 2.6), "distortion": PRISM, "aspect": 1.01, "skew_px": 2.0},
            ]
        },
    )
    folder = simulate(
        recipe, tmp_path, SimulationSettings(num_frames=2, scale=0.04, masks=False, onboard=False), jobs=1
    )
    found = open_recording(folder)
    made = build(recipe, scale=0.04).rig
    assert found.rig.names == made.names == ("cam1", "cam2")
    assert found.rig.cameras.fisheye.tolist() == [True, False]
    points_m = np.random.default_rng(0).uniform((-1, -1, 0.5), (1, 1, 2), (9, 1, 3))
    np.testing.assert_allclose(
        project(found.rig.cameras, points_m)[0], project(made.cameras, points_m)[0], atol=1e-6
    )
    assert [video.num_frames for video in found.videos.values()] == [2, 2]
    assert found.truth.num_drones == 4
    assert set(found.detections) == {"cam1", "cam2"}


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        ({"distortion": (0.1, 0.2, 0.3)}, r"cameras\[0\]\.distortion.*expected 0, 4, 5, 8, 12, 14 .*found 3"),
        ({"distortion": (0.1,) * 5, "fisheye": True}, r"expected 0, 4 coefficients of a fisheye, found 5"),
    ],
)
def test_lenses_with_a_wrong_number_of_coefficients_are_refused(lens, message):
    places = scenario("S02_D4_A")
    place = {"position_m": (-4.7, -3.7, 3.1), "target_m": (0.1, 0.0, 1.25)} | lens
    recipe = msgspec.convert(msgspec.to_builtins(places) | {"cameras": [place]}, type(places))
    with pytest.raises(SettingsError, match=message):
        build(recipe, scale=0.25)
