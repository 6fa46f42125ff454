"""Clock offsets, compared with motion that is known at any time, so that the true offset is known exactly."""

import json
from dataclasses import replace

import numpy as np
import pytest
from clock_worlds import FPS, LATE_S, make_late_videos, random_motion, simulate_estimate, simulate_reference
from helpers import fading, make_once, opencv_pixels, ring_rig
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.calibration.clocks import camera_offsets
from psotrack.evaluation import find_offset
from psotrack.trajectories import UNASSIGNED


def find(estimate, *paths, max_offset_s=0.5, **options):
    """The offset of the tracks from a reference of these paths at 100 Hz."""
    return find_offset(estimate, *simulate_reference(*paths), max_offset_s=max_offset_s, **options)


# The clock of a reference.


@pytest.mark.parametrize(("rate_hz", "fps", "offset_s"), [(25.0, 29.97, -0.4317), (119.88, 25.0, 0.7123)])
def test_shifted_copies(rate_hz, fps, offset_s):
    paths = random_motion(0), random_motion(1)
    estimate = simulate_estimate(*paths, offset_s=offset_s, fps=fps)
    found = find_offset(estimate, *simulate_reference(*paths, rate_hz=rate_hz), max_offset_s=1.0)
    # Splines at 25 Hz of motion of at most 1.6 rad/s have an error of (h w)⁴ / 384, 4e-8 m. Measured 3e-6 s.
    assert found.offset_s == pytest.approx(offset_s, abs=2e-5)
    assert found.mean_distance_m < 1e-5
    assert found.mean_distance_before_m > 0.2
    assert found.overlap == 1.0
    assert found.partner.tolist() == [0, 1]
    np.testing.assert_allclose(found.lever_arm_m, 0, atol=1e-5)
    # The first step compares whole frames, or whole samples of a slower reference.
    least = np.nanargmin(found.curve_m)
    assert abs(found.curve_s[least] - offset_s) <= 0.5001 / 25
    assert found.curve_s[[0, -1]] == pytest.approx([-1, 1], abs=1 / 25)


def test_flights_with_arms_and_noise():
    """The required accuracy is 0.1 frame, with lever arms of 0.12 m on drones that turn, and noise of 20 mm."""
    offset_s = 0.1234
    arms_m = np.array([[0.1, -0.06, 0.03], [0.02, 0.07, -0.095]])

    def turns(number, t):
        return Rotation.from_rotvec(0.4 * (random_motion(7 + number)(t) - [21.0 + 3 * number, 0, 1.5]))

    def tracked(number):
        return lambda t: random_motion(number)(t) + turns(number, t).apply(arms_m[number])

    estimate = simulate_estimate(
        tracked(0), tracked(1), seconds=20, start_s=0.7, offset_s=offset_s, noise_m=0.02
    )
    time_s, position_m = simulate_reference(random_motion(0), random_motion(1), seconds=22)
    wxyz = [turns(number, time_s).as_quat(scalar_first=True) for number in (0, 1)]
    found = find_offset(estimate, time_s, position_m, np.stack(wxyz, axis=1), max_offset_s=0.6)
    assert abs(found.offset_s - offset_s) * FPS < 0.1
    assert found.std_s * FPS < 0.05
    # Noise of 20 mm along three axes has a mean length of √(8 / π) times 20 mm. A median of 500 positions is good to
    # 2 mm; along directions in which the arm looks like motion it is less accurate.
    assert found.mean_distance_m == pytest.approx(0.02 * np.sqrt(8 / np.pi), rel=0.05)
    np.testing.assert_allclose(found.lever_arm_m, arms_m, atol=0.012)


def turning_error(rng, time_s):
    """Error of tracked points that are beside the reference's points and turn with the drones."""
    yaw = rng.uniform(0.4, 1.2, 2) * time_s[:, None]
    arm_m = 0.02 * rng.normal(size=(2, 3))
    turns = Rotation.from_euler("z", yaw.reshape(-1, 1))
    return turns.apply(np.tile(arm_m, (len(time_s), 1))).reshape(-1, 2, 3)


@pytest.mark.parametrize("errors", ["correlated", "independent", "turning"])
def test_the_true_offset_is_within_two_standard_deviations(errors):
    """Of 40 draws at least 85 % are inside; chance gives fewer in 2 % of cases if 95 % is right."""
    off_s, std_s = np.empty(40), np.empty(40)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        paths = [random_motion(3 * seed), random_motion(3 * seed + 1)]
        estimate = simulate_estimate(*paths, seconds=10, offset_s=0.3)
        noise = rng.normal(size=estimate.position_m.shape)
        if errors == "independent":
            error_m = 0.02 * noise
        elif errors == "correlated":
            error_m = 0.02 * fading(noise, 0.95)
        else:
            error_m = turning_error(rng, estimate.time_s) + 0.005 * noise
        found = find(replace(estimate, position_m=estimate.position_m + error_m), *paths)
        off_s[seed] = found.offset_s - 0.3
        std_s[seed] = found.std_s
    in_std = off_s / std_s
    assert np.mean(np.abs(in_std) < 2) >= 0.85
    assert np.mean(std_s**2) < 4 * np.mean(off_s**2)
    if errors == "independent":
        assert 0.6 < np.sqrt(np.mean(in_std**2)) < 1.4


def test_drones_in_another_order_with_a_false_track_and_a_missing_drone():
    paths = [random_motion(number) for number in range(3)]
    estimate = simulate_estimate(paths[2], random_motion(7), paths[0], offset_s=0.25, noise_m=0.01)
    found = find(estimate, *paths)
    assert found.offset_s == pytest.approx(0.25, abs=4e-3)
    assert found.partner.tolist() == [2, UNASSIGNED, 0]
    assert np.isnan(found.lever_arm_m[1]).all()
    assert found.overlap == pytest.approx(2 / 3)


@pytest.mark.parametrize(("gap_s", "bridged"), [(0.08, True), (0.5, False)])
def test_long_gaps_are_not_bridged(gap_s, bridged):
    """Within the reference's gap, the estimate is 5 m off: the distance is large only if the gap is compared."""
    time_s, position_m = simulate_reference(random_motion(0))
    position_m[(time_s > 8) & (time_s < 8 + gap_s)] = np.nan
    estimate = simulate_estimate(random_motion(0), offset_s=0.25, noise_m=0.01)
    inside = (estimate.time_s + 0.25 > 8 + 1e-9) & (estimate.time_s + 0.25 < 8 + gap_s - 1e-9)
    estimate.position_m[inside] += 5.0
    found = find_offset(estimate, time_s, position_m, max_offset_s=0.5)
    compared = 1.0 if bridged else 1 - inside.sum() / estimate.num_frames
    assert found.overlap == pytest.approx(compared, abs=1.5 / estimate.num_frames)
    assert (found.mean_distance_m > 0.03) == bridged


@given(st.integers(0, 2**32 - 1), st.floats(-100, 100), st.floats(0, 6.3))
@settings(max_examples=5)
def test_the_origins_of_clock_and_world_do_not_matter(seed, later_s, turn):
    paths = random_motion(0), random_motion(1)
    estimate = simulate_estimate(*paths, offset_s=0.2, noise_m=0.02, seed=seed, seconds=6)
    time_s, position_m = simulate_reference(*paths, rate_hz=50, seconds=10)
    first = find_offset(estimate, time_s, position_m, max_offset_s=0.4)
    R = Rotation.from_euler("Z", turn).as_matrix()
    moved_m = estimate.position_m @ R.T + 4.0
    moved = replace(estimate, time_s=estimate.time_s + later_s, position_m=moved_m)
    again = find_offset(moved, time_s + later_s, position_m @ R.T + 4.0, max_offset_s=0.4)
    # Medians along the axes turn only approximately with the world: a fraction of the standard deviation of 2 ms.
    assert again.offset_s == pytest.approx(first.offset_s, abs=1e-3)
    assert again.partner.tolist() == [0, 1]


# The clocks of cameras, by detections.


def detected_points(rig, paths, offsets_frames, num_frames=200, seed=0, **errors):
    """Pixels (frames, drones, cameras, 2) by OpenCV; camera c sees frame k at the time (k + offset of c) / FPS."""
    points_px = np.full((num_frames, len(paths), len(rig), 2), np.nan)
    for number, offset_frames in enumerate(offsets_frames):
        time_s = (np.arange(num_frames) + offset_frames) / FPS
        for drone, path in enumerate(paths):
            points_px[:, drone, number] = opencv_pixels(rig.cameras[number], path(time_s))
    return points_px


def with_errors(points_px, noise_px=1.0, seed=0):
    """Detections with errors, of which one in fifty is anywhere in the image, and one in ten is missing."""
    rng = np.random.default_rng(seed)
    points_px = points_px + rng.normal(0, noise_px, points_px.shape)
    stray = rng.random(points_px.shape[:-1]) < 0.02
    points_px[stray] = rng.uniform((0, 0), (1920, 1080), (stray.sum(), 2))
    missed = rng.random(points_px.shape[:-1]) < 0.1
    points_px[missed] = np.nan
    return points_px


def path_near_origin(number, speed_m_s=1.0):
    path = random_motion(number, speed_m_s)
    return lambda time_s: path(time_s) - [3.0 * number, 0, 0.3]


RIG = ring_rig(8, coefficients=5, image_size_wh=(1920, 1080), radius_m=6.0)
OFFSET_FRAMES = np.array([0.4, -1.0, 0.75, -0.2, 1.0, -0.6, 0.15, -0.5])
DRONES = [path_near_origin(number) for number in range(3)]


@pytest.fixture(scope="module")
def exact_px():
    return detected_points(RIG, DRONES, OFFSET_FRAMES)


@pytest.fixture(scope="module")
def points_px(exact_px):
    return with_errors(exact_px)


def test_a_ring_with_noise_and_wrong_detections_in_any_order_of_cameras(points_px):
    found = camera_offsets(RIG, points_px, FPS)
    # The required accuracy is 0.1 frame. Measured 0.013, in agreement with the standard deviations.
    np.testing.assert_allclose(found.offset_frames, OFFSET_FRAMES, atol=0.04)
    assert found.offset_frames.mean() == pytest.approx(0, abs=1e-12)
    assert (found.std_frames < 0.025).all()
    backwards = RIG.select(RIG.names[::-1])
    again = camera_offsets(backwards, points_px[:, :, ::-1], FPS)
    # The iteration stops when steps are below 1e-4 frames.
    np.testing.assert_allclose(again.offset_frames, found.offset_frames[::-1], atol=1e-3)


def test_without_noise(exact_px):
    """Found: `numpy.linalg.LinAlgError: Singular matrix` where detections have no error at all."""
    found = camera_offsets(RIG, exact_px, FPS)
    # Linear interpolation of pixels over a frame has an error of an eighth of the acceleration, at most 0.03 px.
    np.testing.assert_allclose(found.offset_frames, OFFSET_FRAMES, atol=3e-3)
    at_once = detected_points(RIG, DRONES, np.zeros(8))
    found = camera_offsets(RIG, at_once, FPS)
    np.testing.assert_allclose(found.offset_frames, 0.0, atol=3e-3)


@pytest.mark.parametrize("errors", ["independent", "correlated", "calibration"])
def test_the_true_offsets_of_cameras_are_within_two_standard_deviations(errors):
    """Of 6 x 7 offsets at least 83 % are inside; chance gives fewer in 0.5 % of cases if 95 % is right.

    The standard deviations must not be several times too large either.
    """
    true = OFFSET_FRAMES - OFFSET_FRAMES.mean()
    off, std = [], []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        paths = [path_near_origin(3 * seed), path_near_origin(3 * seed + 1)]
        exact_px = detected_points(RIG, paths, true, num_frames=90)
        points_px = with_errors(exact_px, noise_px=0.5, seed=seed)
        noise = rng.normal(size=points_px.shape)
        if errors == "correlated":
            points_px += 1.5 * fading(noise, 0.9)
        elif errors == "calibration":
            points_px += 2 * noise[0, 0]
        found = camera_offsets(RIG, points_px, FPS)
        off.append(found.offset_frames - true)
        std.append(found.std_frames)
    in_std = np.divide(off, std)
    assert np.mean(np.abs(in_std) < 2) >= 0.83
    assert np.mean(np.square(std)) < 4 * np.mean(np.square(off))


@pytest.mark.parametrize("num_cameras", [2, 3])
def test_few_cameras_and_large_offsets(num_cameras):
    rig = RIG.select(RIG.names[:num_cameras])
    offset_frames = np.linspace(-3, 3, num_cameras)
    points_px = with_errors(detected_points(rig, DRONES, offset_frames))
    found = camera_offsets(rig, points_px, FPS)
    np.testing.assert_allclose(found.offset_frames, offset_frames, atol=0.1)


def test_hovering_drones_and_cameras_that_see_nothing_leave_offsets_uncertain(points_px):
    hovering_px = detected_points(RIG, [path_near_origin(0, 0.0)], OFFSET_FRAMES)
    found = camera_offsets(RIG, with_errors(hovering_px), FPS, max_offset_frames=4.0)
    assert (found.std_frames > 2.0).all()
    assert np.abs(found.offset_frames).max() <= 4.0
    some_px = points_px.copy()
    some_px[:, :, 5] = np.nan
    found = camera_offsets(RIG, some_px, FPS, max_offset_frames=4.0)
    apart = np.delete(found.offset_frames - OFFSET_FRAMES, 5)
    np.testing.assert_allclose(apart, apart.mean(), atol=0.04)
    of_others = np.delete(found.std_frames, 5).max()
    assert found.std_frames[5] > max(2.0, 5 * of_others)
    nothing = camera_offsets(RIG, np.full((0, 1, 8, 2), np.nan), FPS)
    assert (nothing.offset_frames == 0).all()


# The command.


def test_the_doctor_finds_the_clock_of_the_reference(run_psotrack, tmp_path_factory):
    root = make_once(tmp_path_factory, "late_videos", make_late_videos)
    words = ("doctor", root / "Real_Data" / "R12_D2", "--tracks", root / "tracks.csv", "--max-offset", 1)
    done = run_psotrack(*words).ended()
    assert done.out.startswith("R12_D2: the reference's clock is 0.43")
    assert "ahead of the videos'" in done.out
    assert "(+10." in done.out
    assert len(done.out.splitlines()) == 1
    content = json.loads(run_psotrack(*words, "--json", "-").out)
    assert content["offset_s"] == pytest.approx(LATE_S, abs=0.1 / FPS)
    assert content["mean_distance_m"] < 0.03 < content["mean_distance_before_m"]
    assert content["overlap"] == 1.0
    pairs = [(drone["drone"], drone["estimate"]) for drone in content["drones"]]
    assert pairs == [("dron1", "0"), ("dron2", "1")]
    assert len(content["curve"]["offset_s"]) == len(content["curve"]["mean_distance_m"]) == 51
