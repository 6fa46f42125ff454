"""Bundle adjustment of simulated rigs: errors, covariances, gauge, focal lengths, and invalid input."""

from dataclasses import replace

import numpy as np
import pytest
from helpers import ring_rig
from scipy.spatial.transform import Rotation
from scipy.stats import binom, chi2

from psotrack.calibration import CommonErrors, adjust
from psotrack.errors import InputError, SettingsError
from psotrack.geometry import Rig, project


def jitter_cameras(rig: Rig, rng, *, turn_deg=0.6, shift_m=0.03, skip=()) -> Rig:
    """The rig with random errors of turn and shift in all cameras but those named in `skip`."""
    T = rig.cameras.T_cam_world.copy()
    for index, name in enumerate(rig.names):
        if name not in skip:
            R = Rotation.from_rotvec(rng.normal(0, np.deg2rad(turn_deg), 3)).as_matrix() @ T[index, :3, :3]
            T[index, :3, :3] = R
            T[index, :3, 3] = -R @ (rig.cameras.centre_world[index] + rng.normal(0, shift_m, 3))
    return Rig(rig.names, replace(rig.cameras, T_cam_world=T))


def observe(rig, rng, count, *, noise_px=1.0, unseen=0.2):
    """`count` random points, (count, 3), and their noisy pixels, (count, cameras, 2); unseen ones are NaN."""
    points = rng.uniform((-1.5, -1.5, 0.3), (1.5, 1.5, 2.3), (count, 3))
    pixels = project(rig.cameras, points[:, None])[0] + rng.normal(0, noise_px, (count, len(rig), 2))
    pixels[rng.random((count, len(rig))) < unseen] = np.nan
    return points, pixels


def align(points, others):
    """Apply to `points` the similarity transform that brings them nearest to `others` (Umeyama 1991)."""
    a, b = points - points.mean(axis=0), others - others.mean(axis=0)
    U, strength, Vt = np.linalg.svd(b.T @ a)
    sign = np.array([1, 1, np.sign(np.linalg.det(U @ Vt))])
    return (strength * sign).sum() / (a * a).sum() * a @ (U * sign @ Vt).T + others.mean(axis=0)


def test_a_jittered_rig_is_adjusted_to_the_ground_truth():
    rng = np.random.default_rng(0)
    rig = ring_rig(5, coefficients=4, image_size_wh=(1920, 1080))
    points, pixels = observe(rig, rng, 151)
    seen = np.isfinite(pixels).all(axis=-1)
    wrong = seen & (rng.random(seen.shape) < 0.03)
    pixels[wrong] += rng.choice([-1, 1], (wrong.sum(), 2)) * rng.uniform(25, 200, (wrong.sum(), 2))
    given_rig = jitter_cameras(rig, rng)
    adjusted = adjust(given_rig, pixels, 1.0)
    truth = rig.cameras.centre_world
    assert np.linalg.norm(given_rig.cameras.centre_world - truth, axis=1).mean() > 0.03
    off = np.linalg.norm(align(adjusted.rig.cameras.centre_world, truth) - truth, axis=1)
    std = np.sqrt(np.trace(adjusted.centre_covariance_m2, axis1=1, axis2=2))
    # Aligning five centres removes a part of the errors, so four standard deviations are a loose limit.
    assert (off < 4 * std).all()
    assert std.max() < 0.004
    # Outliers are found; if a point has two views and one is wrong, both are left out.
    assert not adjusted.used[wrong].any()
    assert adjusted.used[seen & ~wrong].mean() > 0.95
    assert (np.isfinite(adjusted.residual_px) == (seen & (seen.sum(axis=1) >= 2)[:, None])).all()
    there = np.isfinite(adjusted.points_m).all(axis=1)
    # A pixel is 2.6 mm at 4 m; points with two views from one side have larger errors.
    assert (
        np.median(np.linalg.norm(align(adjusted.points_m[there], points[there]) - points[there], axis=1))
        < 0.005
    )


def test_the_covariance_of_the_rig_covers_the_errors():
    """Two cameras are fixed at their true poses, so that the other centres need no alignment."""
    rng, runs = np.random.default_rng(1), 12
    rig = ring_rig(5, image_size_wh=(1920, 1080))
    distances = []
    for _ in range(runs):
        _, pixels = observe(rig, rng, 31)
        adjusted = adjust(jitter_cameras(rig, rng, skip=("c0", "c3")), pixels, 1.0, fixed=("c0", "c3"))
        off = adjusted.rig.cameras.centre_world - rig.cameras.centre_world
        # Fixed cameras keep every bit.
        np.testing.assert_array_equal(off[[0, 3]], 0)
        np.testing.assert_array_equal(adjusted.covariance[[0, 3]], 0)
        distances += [off[i] @ np.linalg.solve(adjusted.centre_covariance_m2[i], off[i]) for i in (1, 2, 4)]
    # The three cameras of a run are dependent, so each run counts as one sample.
    for share in (0.5, 0.9):
        inside = (np.array(distances) < chi2.ppf(share, 3)).mean() * runs
        assert binom.ppf(0.0005, runs, share) - 1 <= inside <= binom.ppf(0.9995, runs, share) + 1


def test_the_rig_as_a_whole_is_not_moved():
    """From exact pixels, the adjusted cameras fit, and their distance to the given cameras is the smallest possible."""
    rng = np.random.default_rng(2)
    rig = ring_rig(5, image_size_wh=(1920, 1080))
    _, pixels = observe(rig, rng, 61, noise_px=0.0)
    given_rig = jitter_cameras(rig, rng)
    adjusted = adjust(given_rig, pixels, 1.0)
    assert np.nanmax(adjusted.residual_px) < 1e-3
    turns = Rotation.from_matrix(
        adjusted.rig.cameras.T_cam_world[:, :3, :3].swapaxes(1, 2) @ given_rig.cameras.T_cam_world[:, :3, :3]
    ).as_rotvec()
    shifts = adjusted.rig.cameras.centre_world - given_rig.cameras.centre_world
    from_middle = given_rig.cameras.centre_world - given_rig.cameras.centre_world.mean(axis=0)
    # The distance has no slope along common shifts and scaling. Without the constraint the sums are about 0.1 m.
    np.testing.assert_allclose(shifts.sum(axis=0), 0, atol=1e-4)
    np.testing.assert_allclose((from_middle * shifts).sum(), 0, atol=1e-3)
    # The distance has no slope along common turns: shifts of 5 cm weigh as much as turns of half a degree.
    torque = np.cross(from_middle, shifts).sum(axis=0) / 0.05**2 + turns.sum(axis=0) / np.deg2rad(0.5) ** 2
    assert np.abs(torque).max() < 0.02 * np.linalg.norm(turns, axis=1).sum() / np.deg2rad(0.5) ** 2


def test_common_errors_count_once():
    """Seven copies of each point give the covariance of one copy, if their errors are declared as common."""
    rng = np.random.default_rng(6)
    rig = ring_rig(4, image_size_wh=(1920, 1080))
    points = rng.uniform((-1.5, -1.5, 0.3), (1.5, 1.5, 2.3), (60, 3))
    pixels = project(rig.cameras, points[:, None])[0] + rng.normal(0, 1, (60, 4, 2))
    seven = np.repeat(np.arange(60), 7)
    once = adjust(rig, pixels)
    # Nearly all of the noise is common: the independent part of seven copies is 1 / 700 of the variance.
    common_errors = adjust(rig, pixels[seven], 0.1, common_errors=[CommonErrors(seven, np.ones((420, 4)))])
    treated_as_independent = adjust(rig, pixels[seven])
    variance = [
        np.trace(adjusted.centre_covariance_m2, axis1=1, axis2=2).mean()
        for adjusted in (once, common_errors, treated_as_independent)
    ]
    # The residuals exceed 0.1 px, so the independent part is inflated to 1 / 7 of one copy's variance.
    assert variance[1] / variance[0] == pytest.approx(8 / 7, rel=0.1)
    assert variance[2] / variance[0] == pytest.approx(1 / 7, rel=0.05)


def test_a_common_focal_length_is_found():
    rng = np.random.default_rng(4)
    rig = ring_rig(5, image_size_wh=(1920, 1080))
    _, pixels = observe(rig, rng, 151)
    wide = jitter_cameras(rig, rng)
    wrong_K = wide.cameras.K.copy()
    wrong_K[:, :2, :2] *= 1.02
    adjusted = adjust(Rig(rig.names, replace(wide.cameras, K=wrong_K)), pixels, rescaled=rig.names)
    # Limit: four standard deviations.
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


def test_points_or_settings_that_determine_no_rig_are_refused():
    rng = np.random.default_rng(5)
    rig = ring_rig(3, image_size_wh=(1920, 1080))
    _, pixels = observe(rig, rng, 23, unseen=0.0)
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
