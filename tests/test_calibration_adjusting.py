"""Improving a rig by boxes of drones: cameras that are certainly wrong are corrected, and no other camera."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import ring_rig
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from psotrack.calibration import CommonErrors, adjust, find_drones_in_boxes, find_wrong_cameras, improve
from psotrack.errors import SettingsError
from psotrack.geometry import Rig, project
from psotrack.recordings import Detections
from psotrack.trajectories import Trajectories

RIG = ring_rig(5, image_size_wh=(1920, 1080))
DRONES, FRAMES = 3, 20


def observe(rng, *, lasting_px=1.0, stated_px=1.0, noise_px=1.0, rig=RIG):
    """Pixels of flying drones with white noise and lasting errors, and the stated common errors.

    Args:
        rng: random generator.
        lasting_px: standard deviation of the error that a camera has for all frames of a drone, pixels.
        stated_px: standard deviation of this error as it is stated to the adjustment, pixels.
        noise_px: standard deviation of the white noise, pixels.
        rig: the true rig.
    """
    points_m = rng.uniform((-1.5, -1.5, 0.3), (1.5, 1.5, 2.3), (DRONES * FRAMES, 3))
    drone = np.repeat(np.arange(DRONES), FRAMES)
    pixels = project(rig.cameras, points_m[:, None])[0]
    pixels += rng.normal(0, lasting_px, (DRONES, len(rig), 2))[drone] + rng.normal(0, noise_px, pixels.shape)
    return pixels, CommonErrors(drone, np.full(pixels.shape[:2], stated_px))


def misplace_cameras(indices, rng, *, turn_deg=0.0, shift_m=0.0):
    """The rig with wrong poses of some cameras: turned by random angles, degrees, and shifted by `shift_m`, metres."""
    T = RIG.cameras.T_cam_world.copy()
    for index in indices:
        shift, turn = rng.normal(size=3), rng.normal(0, np.deg2rad(turn_deg), 3)
        T[index, :3, :3] = Rotation.from_rotvec(turn).as_matrix() @ T[index, :3, :3]
        centre = RIG.cameras.centre_world[index] + shift_m * shift / np.linalg.norm(shift)
        T[index, :3, 3] = -T[index, :3, :3] @ centre
    return Rig(RIG.names, replace(RIG.cameras, T_cam_world=T))


@pytest.mark.slow
def test_lasting_errors_are_in_the_covariance():
    """With lasting errors of 2 px and white noise of 1 px, the 90 % ellipsoids contain 9 of 10 camera centres."""
    rng, runs, distances = np.random.default_rng(1), 12, []
    for _ in range(runs):
        pixels, common_errors = observe(rng, lasting_px=2.0, stated_px=2.0)
        adjusted = adjust(RIG, pixels, fixed=("c0", "c3"), common_errors=[common_errors])
        off = adjusted.rig.cameras.centre_world - RIG.cameras.centre_world
        distances += [off[i] @ np.linalg.solve(adjusted.centre_covariance_m2[i], off[i]) for i in (1, 2, 4)]
    # The three cameras of a run are dependent, so each run counts as one sample.
    for share in (0.5, 0.9):
        inside = (np.array(distances) < chi2.ppf(share, 3)).mean() * runs
        assert binom.ppf(0.0005, runs, share) - 1 <= inside <= binom.ppf(0.9995, runs, share) + 1


def test_lasting_errors_larger_than_stated_enlarge_the_covariance():
    pixels, common_errors = observe(np.random.default_rng(2), lasting_px=8.0)
    small, stated = (
        np.trace(adjust(RIG, pixels, common_errors=kinds).centre_covariance_m2, axis1=1, axis2=2).mean()
        for kinds in (
            [replace(common_errors, std_px=0.1 * common_errors.std_px)],
            [replace(common_errors, std_px=8 * common_errors.std_px)],
        )
    )
    # Points and poses absorb most of the 30 common errors: the residuals show about half of them.
    assert 0.15 < small / stated < 1.1


@pytest.mark.parametrize("seed", range(6))
def test_a_correct_rig_is_not_changed(seed):
    pixels, common_errors = observe(np.random.default_rng(seed), lasting_px=1.5, stated_px=1.5)
    improved = improve(RIG, pixels, common_errors=[common_errors], refine_focal_length=True)
    assert improved.rig is RIG
    assert (improved.moved, improved.zoomed, improved.rescaled, improved.final) == ((), {}, False, None)
    # The adjustment of all cameras to the points would have moved them.
    assert np.linalg.norm(improved.everything.rig.cameras.centre_world - RIG.cameras.centre_world) > 0.002


@pytest.mark.parametrize(("turn_deg", "shift_m"), [(0.0, 0.05), (0.5, 0.0)])
def test_only_the_camera_that_was_pushed_is_moved(turn_deg, shift_m):
    rng = np.random.default_rng(3)
    rig = misplace_cameras([2], rng, turn_deg=turn_deg, shift_m=shift_m)
    pixels, common_errors = observe(rng)
    improved = improve(rig, pixels, common_errors=[common_errors])
    assert (improved.moved, improved.zoomed) == (("c2",), {})
    off_m = improved.rig.cameras.centre_world - RIG.cameras.centre_world
    np.testing.assert_array_equal(off_m[[0, 1, 3, 4]], 0)
    covariance_m2 = improved.centre_covariance_m2
    # One of 1000 is farther off. The covariances of the other cameras are those of the adjustment.
    assert off_m[2] @ np.linalg.solve(covariance_m2[2], off_m[2]) < chi2.ppf(0.999, 3)
    np.testing.assert_array_equal(covariance_m2[0], improved.everything.centre_covariance_m2[0])
    assert improve(rig, pixels, common_errors=[common_errors], fixed=("c0", "c1", "c3", "c4")).moved == (
        "c2",
    )
    assert improve(rig, pixels, common_errors=[common_errors], fixed=("c2",)).moved != ("c2",)


def test_if_most_cameras_are_wrong_all_are_moved():
    rng = np.random.default_rng(4)
    rig = misplace_cameras(range(5), rng, turn_deg=0.6)
    pixels, common_errors = observe(rng)
    adjusted = adjust(rig, pixels, common_errors=[common_errors])
    assert find_wrong_cameras(rig, adjusted) == RIG.names
    improved = improve(rig, pixels, common_errors=[common_errors])
    np.testing.assert_array_equal(improved.rig.cameras.T_cam_world, adjusted.rig.cameras.T_cam_world)


def test_if_all_focal_lengths_are_wrong_only_they_are_changed():
    pixels, common_errors = observe(np.random.default_rng(5))
    K = RIG.cameras.K.copy()
    K[:, :2, :2] *= 1.02
    rig = Rig(RIG.names, replace(RIG.cameras, K=K))
    improved = improve(rig, pixels, common_errors=[common_errors], refine_focal_length=True)
    assert (improved.moved, improved.rescaled) == ((), True)
    final = improved.final
    assert abs(final.focal_scale - 1 / 1.02) < 4 * final.focal_scale_std
    np.testing.assert_array_equal(improved.rig.cameras.T_cam_world, RIG.cameras.T_cam_world)


def test_a_wrong_focal_length_is_reported_with_the_shift_that_it_resembles():
    """A focal length 2 % too long resembles a camera 8 cm too near: both are reported and are in the covariance."""
    pixels, common_errors = observe(np.random.default_rng(8))
    K = RIG.cameras.K.copy()
    K[1, :2, :2] *= 1.02
    rig = Rig(RIG.names, replace(RIG.cameras, K=K))
    improved = improve(rig, pixels, common_errors=[common_errors])
    assert (improved.moved, list(improved.zoomed)) == (("c1",), ["c1"])
    scale, std = improved.zoomed["c1"]
    assert abs(scale - 1 / 1.02) < 4 * std
    off_m = improved.rig.cameras.centre_world[1] - RIG.cameras.centre_world[1]
    assert np.linalg.norm(off_m) > 0.04
    assert off_m @ np.linalg.solve(improved.centre_covariance_m2[1], off_m) < chi2.ppf(0.9, 3)


def test_views_are_weighted_by_their_noise():
    """Views with 100 px of noise have almost no weight: the result is that of the views with 1 px alone."""
    pixels, _ = observe(np.random.default_rng(6), lasting_px=0.0)
    rng, noise_px = np.random.default_rng(7), np.ones(pixels.shape[:2])
    bad = rng.random(noise_px.shape) < 0.2
    noise_px[bad] = 100.0
    pixels[bad] += rng.normal(0, 100, (bad.sum(), 2))
    weighted = adjust(RIG, pixels, noise_px).rig.cameras.centre_world
    without = adjust(RIG, np.where(bad[..., None], np.nan, pixels)).rig.cameras.centre_world
    # A pixel is 2.6 mm at 4 m; with equal weights the errors would be decimetres.
    np.testing.assert_allclose(weighted, without, atol=0.0005)
    with pytest.raises(SettingsError, match="noise_px"):
        adjust(RIG, pixels, np.where(bad, -1.0, noise_px))


def test_boxes_at_the_border_or_touching_another_box_are_not_used():
    position_m = np.tile([[[0.0, 0.0, 1.2], [0.9, 0.2, 1.0]]], (3, 1, 1))
    tracks = Trajectories(np.arange(3), np.array([0.0, 0.04, 2.0]), ("a", "b"), position_m)
    middle = np.stack([project(RIG.cameras, point)[0] for point in position_m[0]], axis=1) + 0.5
    # (cameras, drones, 4), 40 x 20 px.
    half_px = np.array([20.0, 10.0])
    xyxy = np.concatenate([middle - half_px, middle + half_px], axis=-1)
    # The first drone's box is cut off by the image's border in camera 1, and touches another box in camera 2.
    xyxy[1, 0, 0] = 0.0
    touching = np.append(xyxy[2], [xyxy[2, 0] + (35, 0, 70, 0)], axis=0)
    boxes = [touching if camera == 2 else xyxy[camera] for camera in range(5)]
    found = {
        name: Detections(np.repeat(np.arange(3), len(own)), np.tile(own, (3, 1)), np.ones(3 * len(own)))
        for name, own in zip(RIG.names, boxes, strict=True)
    }
    views = find_drones_in_boxes(RIG, found, tracks)
    assert views.points == ("a@0", "b@0", "a@1", "b@1", "a@2", "b@2")
    used = np.isfinite(views.points_px).all(axis=-1)
    np.testing.assert_array_equal(used, np.isfinite(views.noise_px))
    np.testing.assert_array_equal(used[0], [True, False, False, True, True])
    np.testing.assert_array_equal(used[1], [True] * 5)
    np.testing.assert_allclose(views.points_px[1], project(RIG.cameras, position_m[0, 1])[0], atol=1e-9)
    # One pixel, and 5 % of √(40 · 20) px.
    np.testing.assert_allclose(views.noise_px[used], 1 + 0.05 * np.sqrt(800))
    short, lasting, *_ = views.common_errors
    # Frames 0 and 1 are 0.04 s apart and share an error; frame 2 is 2 s later.
    np.testing.assert_array_equal(short.label[[0, 2]] == short.label[0], True)
    assert len(set(short.label.tolist())) == 4
    np.testing.assert_array_equal(lasting.label, [0, 1, 0, 1, 0, 1])
