"""Bundle adjustment: back to the truth, with honest covariances, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import ring_rig
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from psotrack.calibration import CommonErrors, adjust
from psotrack.errors import InputError, SettingsError
from psotrack.geometry import CameraRig, project


def jittered(rig: CameraRig, rng, *, turn_deg=0.6, shift_m=0.03, skip=()) -> CameraRig:
    T = rig.cameras.T_cam_world.copy()
    for index, name in enumerate(rig.names):
        if name not in skip:
            R = Rotation.from_rotvec(rng.normal(0, np.deg2rad(turn_deg), 3)).as_matrix() @ T[index, :3, :3]
            T[index, :3, :3] = R
            T[index, :3, 3] = -R @ (rig.cameras.centre_world[index] + rng.normal(0, shift_m, 3))
    return CameraRig(rig.names, replace(rig.cameras, T_cam_world=T))


def flown(rig, rng, count, *, noise_px=1.0, unseen=0.2):
    points = rng.uniform((-1.5, -1.5, 0.3), (1.5, 1.5, 2.3), (count, 3))
    pixels = project(rig.cameras, points[:, None])[0] + rng.normal(0, noise_px, (count, len(rig), 2))
    pixels[rng.random((count, len(rig))) < unseen] = np.nan
    return points, pixels


def similar(points, others):
    """Points after the similarity that brings them nearest to others (Umeyama 1991)."""
    a, b = points - points.mean(axis=0), others - others.mean(axis=0)
    U, strength, Vt = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.sign(np.linalg.det(U @ Vt))])
    return (strength * sign).sum() / (a * a).sum() * a @ (U * sign @ Vt).T + others.mean(axis=0)


def test_a_jittered_rig_comes_back_to_the_truth():
    rng = np.random.default_rng(0)
    rig = ring_rig(5, coefficients=4, image_size_wh=(1920, 1080))
    points, pixels = flown(rig, rng, 151)
    seen = np.isfinite(pixels).all(axis=-1)
    wrong = seen & (rng.random(seen.shape) < 0.03)
    pixels[wrong] += rng.choice([-1, 1], (wrong.sum(), 2)) * rng.uniform(25, 200, (wrong.sum(), 2))
    given_rig = jittered(rig, rng)
    adjusted = adjust(given_rig, pixels, 1.0)
    truth = rig.cameras.centre_world
    assert np.linalg.norm(given_rig.cameras.centre_world - truth, axis=1).mean() > 0.03
    off = np.linalg.norm(similar(adjusted.rig.cameras.centre_world, truth) - truth, axis=1)
    std = np.sqrt(np.trace(adjusted.centre_covariance_m2, axis1=1, axis2=2))
    # Aligned on five centres, errors are smaller than those of a rig that is held by its poses.
    assert (off < 4 * std).all()
    assert std.max() < 0.004
    # Outliers are found, and of a point that two cameras see both are left out.
    assert not adjusted.used[wrong].any()
    assert adjusted.used[seen & ~wrong].mean() > 0.95
    assert (np.isfinite(adjusted.residual_px) == (seen & (seen.sum(axis=1) >= 2)[:, None])).all()
    there = np.isfinite(adjusted.points_m).all(axis=1)
    # A pixel is 2.6 mm at 4 m; points that are seen twice from one side are worse.
    assert (
        np.median(np.linalg.norm(similar(adjusted.points_m[there], points[there]) - points[there], axis=1))
        < 0.005
    )


def test_the_covariance_of_the_rig_is_honest():
    """Two cameras are fixed at the truth, so that nothing need be aligned: the others' ellipsoids hold their share."""
    rng, runs = np.random.default_rng(1), 12
    rig = ring_rig(5, image_size_wh=(1920, 1080))
    distances = []
    for _ in range(runs):
        _, pixels = flown(rig, rng, 31)
        adjusted = adjust(jittered(rig, rng, skip=("c0", "c3")), pixels, 1.0, fixed=("c0", "c3"))
        off = adjusted.rig.cameras.centre_world - rig.cameras.centre_world
        # To the last bit.
        np.testing.assert_array_equal(off[[0, 3]], 0)
        np.testing.assert_array_equal(adjusted.covariance[[0, 3]], 0)
        distances += [off[i] @ np.linalg.solve(adjusted.centre_covariance_m2[i], off[i]) for i in (1, 2, 4)]
    # The three of a run are not independent: counted as if there were a third of them.
    for share in (0.5, 0.9):
        inside = (np.array(distances) < chi2.ppf(share, 3)).mean() * runs
        assert binom.ppf(0.0005, runs, share) - 1 <= inside <= binom.ppf(0.9995, runs, share) + 1


def test_the_rig_as_a_whole_stays():
    """Exact pixels of a world that was moved and grew: the cameras fit, and are as near to those given as can be."""
    rng = np.random.default_rng(2)
    rig = ring_rig(5, image_size_wh=(1920, 1080))
    _, pixels = flown(rig, rng, 61, noise_px=0.0)
    given_rig = jittered(rig, rng)
    adjusted = adjust(given_rig, pixels, 1.0)
    assert np.nanmax(adjusted.residual_px) < 1e-3
    turns = Rotation.from_matrix(
        adjusted.rig.cameras.T_cam_world[:, :3, :3].swapaxes(1, 2) @ given_rig.cameras.T_cam_world[:, :3, :3]
    ).as_rotvec()
    shifts = adjusted.rig.cameras.centre_world - given_rig.cameras.centre_world
    from_middle = given_rig.cameras.centre_world - given_rig.cameras.centre_world.mean(axis=0)
    # No slope along shifts and growth, of sums that are 0.1 m if the rig is not held.
    np.testing.assert_allclose(shifts.sum(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose((from_middle * shifts).sum(), 0, atol=1e-3)
    # And along turns: shifts of 5 cm weigh as much as turns of half a degree.
    torque = np.cross(from_middle, shifts).sum(axis=0) / 0.05**2 + turns.sum(axis=0) / np.deg2rad(0.5) ** 2
    assert np.abs(torque).max() < 0.02 * np.linalg.norm(turns, axis=1).sum() / np.deg2rad(0.5) ** 2


def test_errors_that_are_alike_count_as_one():
    """Every error seven times: as sure as if each were there once, and not as seven independent ones."""
    rng = np.random.default_rng(6)
    rig = ring_rig(4, image_size_wh=(1920, 1080))
    points = rng.uniform((-1.5, -1.5, 0.3), (1.5, 1.5, 2.3), (60, 3))
    pixels = project(rig.cameras, points[:, None])[0] + rng.normal(0, 1, (60, 4, 2))
    seven = np.repeat(np.arange(60), 7)
    once = adjust(rig, pixels)
    # Nearly all of the noise is in common, so that the seven together have 1 / 700 of their own.
    common_errors = adjust(rig, pixels[seven], 0.1, common_errors=[CommonErrors(seven, np.ones((420, 4)))])
    believed = adjust(rig, pixels[seven])
    variance = [
        np.trace(one.centre_covariance_m2, axis1=1, axis2=2).mean() for one in (once, common_errors, believed)
    ]
    # Residuals are 100 times what 0.1 px explains, so that what is stated of independent errors is 1 / 7 here, too.
    assert variance[1] / variance[0] == pytest.approx(8 / 7, rel=0.1)
    assert variance[2] / variance[0] == pytest.approx(1 / 7, rel=0.05)


def test_a_common_focal_length_is_found():
    rng = np.random.default_rng(4)
    rig = ring_rig(5, image_size_wh=(1920, 1080))
    _, pixels = flown(rig, rng, 151)
    wide = jittered(rig, rng)
    wrong_K = wide.cameras.K.copy()
    wrong_K[:, :2, :2] *= 1.02
    adjusted = adjust(CameraRig(rig.names, replace(wide.cameras, K=wrong_K)), pixels, rescaled=rig.names)
    # Four standard deviations.
    assert abs(adjusted.focal_scale - 1 / 1.02) < 4 * adjusted.focal_scale_std
    assert adjusted.focal_scale_std < 0.002
    np.testing.assert_allclose(
        adjusted.rig.cameras.K,
        wrong_K
        * np.array(
            [[adjusted.focal_scale, adjusted.focal_scale, 1], [1, adjusted.focal_scale, 1], [1, 1, 1]]
        ),
        rtol=1e-12,
    )


def test_what_cannot_be_adjusted_is_refused():
    rng = np.random.default_rng(5)
    rig = ring_rig(3, image_size_wh=(1920, 1080))
    _, pixels = flown(rig, rng, 23, unseen=0.0)
    blind = pixels.copy()
    blind[5:, 1] = np.nan
    with pytest.raises(
        InputError, match="camera c1: expected at least 6 points that another camera sees too, found 5"
    ):
        adjust(rig, blind)
    assert np.isfinite(adjust(rig, blind, fixed=("c1",)).rig.cameras.T_cam_world).all()
    with pytest.raises(InputError, match=r"camera c0: .* found 0"):
        adjust(rig, pixels[:0])
    with pytest.raises(SettingsError, match="fixed: expected some of c0, c1, c2, found c9"):
        adjust(rig, pixels, fixed=("c9",))
    with pytest.raises(SettingsError, match="a camera that may move"):
        adjust(rig, pixels, fixed=rig.names)
    with pytest.raises(SettingsError, match="noise_px"):
        adjust(rig, pixels, noise_px=float("nan"))
