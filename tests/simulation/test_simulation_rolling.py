"""On-board cameras with rolling shutter, lens distortion and automatic exposure, beside frames drawn otherwise."""

from dataclasses import replace

import cv2
import msgspec
import numpy as np
import pytest

from psotrack.errors import SettingsError
from psotrack.geometry import project
from psotrack.inside_out import choose_lens
from psotrack.simulation import SimulationSettings, build, change_scenario, scenario, simulate
from psotrack.simulation.imaging.onboard import OnboardRenderer, lens
from psotrack.simulation.imaging.strips import strips
from psotrack.simulation.scenarios import OnboardCamera
from psotrack.simulation.world.rooms import MARKER_DICTIONARY

S02 = scenario("S02_D4_A")
SIZE_WH = (640, 360)
FOV_DEG = (92.45, 60.83)


def made(**onboard):
    """A scene without shadows and noise whose drones carry cameras of 640 x 360 pixels."""
    imaging = msgspec.structs.replace(
        S02.imaging, shadows=False, read_noise=0.0, shot_noise=0.0, antialiasing=False
    )
    fields = {"image_size_wh": SIZE_WH, "fov_deg": FOV_DEG, "shutter_s": 1 / 10_000, "pitch_deg": 10.0}
    camera = OnboardCamera(**{**fields, **onboard})
    return build(msgspec.structs.replace(S02, imaging=imaging, onboard=camera), seed=1)


@pytest.mark.parametrize(("height", "motion_px"), [(360, 0.01), (361, 0.3), (17, 5.0), (360, 0.0)])
def test_strips_cover_each_row_once_and_its_time_on_average(height, motion_px):
    rows = np.arange(height)
    times = np.zeros(height)
    for sample in range(8):
        covered = np.zeros(height, int)
        for strip in strips(height, motion_px, sample, 8):
            covered[strip.rows] += 1
            times[strip.rows] += strip.middle / 8
        np.testing.assert_array_equal(covered, 1)
    if motion_px:
        # The samples' strips begin at different rows, up to the rounding to whole rows.
        assert np.abs(times - rows).max() <= 0.5 + max(0.5 / motion_px, 4) / 16


def test_each_row_is_what_a_global_shutter_shows_at_its_time():
    line_time_s = 0.03 / SIZE_WH[1]
    frame, drone = 40, 0
    rolled = OnboardRenderer(made(line_time_s=line_time_s), drone).clean_frame(frame).astype(float)
    fixed = made()
    still = OnboardRenderer(fixed, drone).clean_frame(frame).astype(float)
    for row in (0, 359):
        late_s = line_time_s * (row - (SIZE_WH[1] - 1) / 2)
        shown = OnboardRenderer(replace(fixed, start_s=late_s), drone).clean_frame(frame).astype(float)
        # Motion within a strip is at most half a pixel; at edges of markers a grey level may differ.
        assert np.abs(rolled[row] - shown[row]).mean() < 2.0
        assert np.abs(rolled[row] - shown[row]).mean() < 0.3 * np.abs(rolled[row] - still[row]).mean()
    # Half way down, both are exposed at the time of the frame.
    assert np.abs(rolled[180] - still[180]).mean() < 1.0


@pytest.mark.slow
def test_markers_of_a_distorting_lens_are_detected_at_their_projection():
    """OpenCV detects and OpenCV projects."""
    distortion = (-0.1, 0.03, 0.0005, -0.0004)
    scene = made(distortion=distortion, image_size_wh=(1280, 720))
    renderer = OnboardRenderer(scene, 0)
    dictionary = cv2.aruco.getPredefinedDictionary(MARKER_DICTIONARY)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary, parameters)
    corners, ids, _ = detector.detectMarkers(cv2.cvtColor(renderer.frame(40), cv2.COLOR_BGR2GRAY))
    assert len(corners) >= 4
    cam, off_px, straight_px = renderer.cam_at(scene.time_s(40)), [], []
    for marker, found in zip(ids.ravel().tolist(), corners, strict=True):
        points_m = scene.room.marker_corners_m[marker]
        rvec, _ = cv2.Rodrigues(cam.R)
        for into, coefficients in ((off_px, np.array(distortion)), (straight_px, None)):
            pixels = cv2.projectPoints(points_m, rvec, cam.t_m, cam.K, coefficients)[0][:, 0]
            into.append(np.linalg.norm(found[0] - pixels, axis=1))
    # Measured 0.3 px, by OpenCV's refinement of corners; without the distortion tens of pixels.
    assert np.median(off_px) < 0.7
    assert np.max(straight_px) > 20
    # The lens of the package is the same.
    x_cam = points_m @ cam.R.T + cam.t_m
    own = project(lens(scene), x_cam)[0]
    np.testing.assert_allclose(
        own, cv2.projectPoints(points_m, rvec, cam.t_m, cam.K, np.array(distortion))[0][:, 0], atol=1e-3
    )


def test_the_exposure_swings_between_its_limits():
    scene = made(exposure=(0.3, 2.0), exposure_period_s=2.0)
    renderer = OnboardRenderer(scene, 0)
    times_s = np.linspace(0, 2, 400)
    factors = np.array([renderer.sensor.exposure(time_s) for time_s in times_s])
    assert factors.min() == pytest.approx(0.3, rel=1e-3)
    assert factors.max() == pytest.approx(2.0, rel=1e-3)
    dark, bright = (int(factors.argmin()), int(factors.argmax()))
    image = np.full((SIZE_WH[1], SIZE_WH[0], 3), 100, np.uint8)
    levels = [renderer.sensor.expose(image, 0, times_s[index]).mean() for index in (dark, bright)]
    # A factor of light is its power 1 / 2.2 of grey levels; flicker and drift change the light by up to 10 %.
    assert levels[1] / levels[0] == pytest.approx((2.0 / 0.3) ** (1 / 2.2), rel=0.06)
    assert OnboardRenderer(made(), 0).sensor.exposure(0.7) == 1.0


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("line_time_s", 1e-3, "at most 3.7e-05 s: 1080 rows in 0.04 s"),
        ("line_time_s", -1e-6, "onboard.line_time_s"),
        ("distortion", [0.1], "0, 4, 5, 8, 12, 14 coefficients"),
        ("exposure", [2.0, 0.5], "the smaller factor first"),
    ],
)
def test_a_wrong_camera_is_refused(field, value, message):
    with pytest.raises(SettingsError, match=message.replace(".", r"\.")):
        build(change_scenario(S02, {f"onboard.{field}": value}), scale=0.25)


@pytest.mark.slow
def test_a_simulated_sequence_with_distortion_has_the_lens_of_each_drone(tmp_path):
    camera = {"image_size_wh": list(SIZE_WH), "fov_deg": list(FOV_DEG), "distortion": [-0.1, 0.03, 0.0, 0.0]}
    recipe = change_scenario(S02, {"onboard": camera, "image_size_wh": [64, 64], "cameras": "laboratory"})
    folder = simulate(recipe, tmp_path, SimulationSettings(num_frames=2, scale=0.5), jobs=1)
    found = choose_lens(
        (320, 180), path=folder / "drone_cameras.toml", fov_deg=None, name="dron1", scale=False
    )
    np.testing.assert_allclose(found.dist[:4], camera["distortion"])
    # The table without distortion is absent, so that no command takes the lens for ideal.
    assert not (folder / "drone_cameras_calibration.csv").exists()
