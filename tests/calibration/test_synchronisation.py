"""Clock offsets, compared with motion that is known at any time, so that the true offset is known exactly."""

import json
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from helpers import make_unnamed_rig, ring_rig
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from psotrack.calibration.clocks import camera_offsets
from psotrack.cli.doctor import doctor
from psotrack.errors import InputError, SettingsError
from psotrack.evaluation import find_offset
from psotrack.geometry import look_at, make_camera
from psotrack.geometry.rig_files import write_calibration
from psotrack.recordings import VideoWriter
from psotrack.recordings.datasets import CALIBRATION
from psotrack.recordings.mocap import Markers, write_c3d
from psotrack.simulation import scenario
from psotrack.simulation.flights.planning import plan
from psotrack.trajectories import UNASSIGNED, Trajectories, write_trajectories

FPS = 25.0


def random_motion(number: int = 0, speed_m_s: float = 1.0):
    """A function of times (...,) that returns positions (..., 3); the motion never repeats and has about this speed."""
    rng = np.random.default_rng(number)
    rate, phase = rng.uniform(0.4, 1.6, (4, 3)), rng.uniform(0, 2 * np.pi, (4, 3))
    size_m = speed_m_s / np.sqrt(6) / rate

    def position_m(time_s):
        angle = rate * np.asarray(time_s)[..., None, None] + phase
        return (size_m * np.sin(angle)).sum(axis=-2) + np.array([3.0 * number, 0, 1.5])

    return position_m


def simulate_estimate(*paths, seconds=12.0, start_s=3.0, offset_s=0.0, noise_m=0.0, fps=FPS, seed=0):
    """Tracks of drones whose true positions are `path(t)` by the reference's clock.

    The reference's clock is `offset_s` ahead of the clock of the tracks.
    """
    time_s = start_s - offset_s + np.arange(int(seconds * fps)) / fps
    position_m = np.stack([path(time_s + offset_s) for path in paths], axis=1)
    position_m = position_m + np.random.default_rng(seed).normal(0, noise_m, position_m.shape)
    return Trajectories(np.arange(len(time_s)), time_s, tuple(map(str, range(len(paths)))), position_m)


def correlated_noise(rng, shape, correlation):
    """Noise of standard deviation 1 from a first-order autoregression along the first axis."""
    noise = rng.normal(size=shape)
    for row in range(1, len(noise)):
        noise[row] = correlation * noise[row - 1] + np.sqrt(1 - correlation**2) * noise[row]
    return noise


def headings(paths, time_s):
    """Directions in which the drones fly, radians: (frames, drones)."""
    step_m = np.stack([path(time_s + 0.01) - path(time_s - 0.01) for path in paths], axis=1)
    return np.arctan2(step_m[..., 1], step_m[..., 0])


def turn_offsets(yaw_rad, offset_m):
    """Offsets (drones, 3) in the drones' axes, turned about the vertical by the yaw angles: (frames, drones, 3)."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    x, y, z = offset_m.T
    return np.stack([cos * x - sin * y, sin * x + cos * y, z + 0 * cos], axis=-1)


def simulate_reference(*paths, rate_hz=100.0, seconds=18.0):
    time_s = np.arange(int(seconds * rate_hz)) / rate_hz
    return time_s, np.stack([path(time_s) for path in paths], axis=1)


class TestFindOffset:
    @pytest.mark.parametrize("rate_hz", [25.0, 100.0, 119.88])
    @pytest.mark.parametrize("fps", [25.0, 29.97])
    @pytest.mark.parametrize("offset_s", [0.7123, -0.4317])
    def test_shifted_copies(self, rate_hz, fps, offset_s):
        estimate = simulate_estimate(random_motion(0), random_motion(1), offset_s=offset_s, fps=fps)
        found = find_offset(
            estimate,
            *simulate_reference(random_motion(0), random_motion(1), rate_hz=rate_hz),
            max_offset_s=1.0,
        )
        # Splines at 25 Hz of motion of at most 1.6 rad/s have an error of (h w)⁴ / 384, 4e-8 m. Measured 3e-6 s.
        assert found.offset_s == pytest.approx(offset_s, abs=2e-5)
        assert found.mean_distance_m < 1e-5
        assert found.mean_distance_before_m > 0.2
        assert (found.overlap, found.partner.tolist()) == (1.0, [0, 1])
        np.testing.assert_allclose(found.lever_arm_m, 0, atol=1e-5)
        # The first step compares whole frames, or whole samples of a slower reference.
        step_s = 1 / min(fps, rate_hz)
        assert np.abs(found.curve_s[np.nanargmin(found.curve_m)] - offset_s) <= 0.5001 * step_s
        assert found.curve_s[[0, -1]] == pytest.approx([-1, 1], abs=step_s)

    @pytest.mark.parametrize("name", ["S01_D2_A", "S02_D4_A"])
    def test_simulated_flights_with_arms_and_noise(self, name):
        """The required accuracy is 0.1 frame, with lever arms of 0.12 m on drones that turn, and noise of 20 mm."""
        flights = plan(scenario(name), 3)
        rng, offset_s = np.random.default_rng(1), 0.1234
        time_s = np.arange(900) / 100
        arm_m = rng.normal(size=(len(flights), 3))
        arm_m *= 0.12 / np.linalg.norm(arm_m, axis=-1, keepdims=True)

        def tracked_m(flight, arm_m):
            return lambda t: flight.position_m(t) + flight.rotation(t) @ arm_m

        paths = [tracked_m(*item) for item in zip(flights, arm_m, strict=True)]
        estimate = simulate_estimate(*paths, seconds=7.5, start_s=0.7, offset_s=offset_s, noise_m=0.02)
        found = find_offset(
            estimate,
            time_s,
            np.stack([flight.position_m(time_s) for flight in flights], axis=1),
            np.stack([flight.orientation_wxyz(time_s) for flight in flights], axis=1),
            max_offset_s=0.6,
        )
        assert abs(found.offset_s - offset_s) * FPS < 0.1
        assert found.std_s * FPS < 0.05
        # Noise of 20 mm along three axes has a mean length of √(8 / π) times 20 mm. A median of 187 positions is
        # good to 2 mm; along directions in which the arm looks like motion it is less accurate.
        assert found.mean_distance_m == pytest.approx(0.02 * np.sqrt(8 / np.pi), rel=0.05)
        np.testing.assert_allclose(found.lever_arm_m, arm_m, atol=0.012)

    @pytest.mark.parametrize(
        "errors",
        ["correlated", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("independent", "turning"))],
    )
    def test_the_true_offset_is_within_two_standard_deviations(self, errors):
        """Of 40 draws at least 85 % are inside; chance gives fewer in 2 % of cases if 95 % is right."""
        normalised, spread = [], []
        for seed in range(40):
            rng = np.random.default_rng(seed)
            paths = [random_motion(3 * seed + number) for number in range(2)]
            estimate = simulate_estimate(*paths, seconds=10, offset_s=0.3)
            shape = estimate.position_m.shape
            if errors == "independent":
                error_m = 0.02 * rng.normal(size=shape)
            elif errors == "correlated":
                error_m = 0.02 * correlated_noise(rng, shape, 0.95)
            else:
                # The tracked point is beside the reference's point and turns with the drone.
                yaw_rad = rng.uniform(0.4, 1.2, 2) * estimate.time_s[:, None]
                error_m = turn_offsets(yaw_rad, 0.02 * rng.normal(size=(2, 3))) + 0.005 * rng.normal(
                    size=shape
                )
            estimate = replace(estimate, position_m=estimate.position_m + error_m)
            found = find_offset(estimate, *simulate_reference(*paths), max_offset_s=0.5)
            normalised.append((found.offset_s - 0.3) / found.std_s)
            spread.append((found.offset_s - 0.3, found.std_s))
        assert np.mean(np.abs(normalised) < 2) >= 0.85
        error_s, std_s = np.sqrt(np.mean(np.square(spread), axis=0))
        assert std_s < 2 * error_s
        if errors == "independent":
            assert 0.6 < np.sqrt(np.mean(np.square(normalised))) < 1.4

    def test_a_lever_arm_along_the_flight_is_not_taken_for_an_offset(self):
        """The drone flies straight ahead with changing speed: at 1 m/s, an arm of 0.12 m is as long as 0.12 s."""

        def ahead(time_s):
            time_s = np.asarray(time_s)
            return np.stack([time_s + 0.5 * np.sin(1.3 * time_s), 0 * time_s, 1 + 0 * time_s], axis=-1)

        estimate = simulate_estimate(lambda t: ahead(t) + np.array([0.12, 0, 0]), offset_s=0.2)
        reference = simulate_reference(ahead)
        found = find_offset(estimate, *reference, max_offset_s=0.5)
        assert found.offset_s == pytest.approx(0.2, abs=1e-4)
        np.testing.assert_allclose(found.lever_arm_m, [[0.12, 0, 0]], atol=1e-4)
        without = find_offset(estimate, *reference, max_offset_s=0.5, with_lever_arm=False)
        assert without.offset_s == pytest.approx(0.2 + 0.12, abs=0.05)
        assert (without.lever_arm_m == 0).all()

    def test_drones_in_another_order_with_a_false_track_and_a_missing_drone(self):
        paths = [random_motion(number) for number in range(3)]
        false = [lambda t: random_motion(7)(t) - [0, 9, 0]]
        estimate = simulate_estimate(paths[2], *false, paths[0], offset_s=0.25, noise_m=0.01)
        found = find_offset(estimate, *simulate_reference(*paths), max_offset_s=0.5)
        assert found.offset_s == pytest.approx(0.25, abs=4e-3)
        assert found.partner.tolist() == [2, UNASSIGNED, 0]
        assert np.isnan(found.lever_arm_m[1]).all()
        assert found.overlap == pytest.approx(2 / 3)

    def test_an_identity_swap_has_little_effect(self):
        """The cost is a sum of distances, not of squares, so a sixth of the frames with the wrong drone is outvoted."""
        estimate = simulate_estimate(random_motion(0), random_motion(1), offset_s=0.25, noise_m=0.01)
        estimate.position_m[250:] = estimate.position_m[250:, ::-1]
        found = find_offset(
            estimate, *simulate_reference(random_motion(0), random_motion(1)), max_offset_s=0.5
        )
        assert found.offset_s == pytest.approx(0.25, abs=0.1 / FPS)

    @pytest.mark.parametrize(("gap_s", "bridged"), [(0.08, True), (0.5, False)])
    def test_long_gaps_are_not_bridged(self, gap_s, bridged):
        """Within the reference's gap, the estimate is 5 m off: the distance is large only if the gap is compared."""
        time_s, position_m = simulate_reference(random_motion(0))
        gap = (time_s > 8) & (time_s < 8 + gap_s)
        position_m[gap] = np.nan
        estimate = simulate_estimate(random_motion(0), offset_s=0.25, noise_m=0.01)
        inside = (estimate.time_s + 0.25 > 8 + 1e-9) & (estimate.time_s + 0.25 < 8 + gap_s - 1e-9)
        estimate.position_m[inside] += 5.0
        found = find_offset(estimate, time_s, position_m, max_offset_s=0.5)
        compared = 1.0 if bridged else 1 - inside.sum() / estimate.num_frames
        assert found.overlap == pytest.approx(compared, abs=1.5 / estimate.num_frames)
        assert (found.mean_distance_m > 0.03) == bridged

    @given(st.integers(0, 2**32 - 1), st.floats(-100, 100), st.floats(0, 6.3))
    @settings(max_examples=6)
    def test_the_origins_of_clock_and_world_do_not_matter(self, seed, later_s, turn):
        estimate = simulate_estimate(
            random_motion(0), random_motion(1), offset_s=0.2, noise_m=0.02, seed=seed, seconds=6
        )
        time_s, position_m = simulate_reference(random_motion(0), random_motion(1), rate_hz=50, seconds=10)
        first = find_offset(estimate, time_s, position_m, max_offset_s=0.4)
        R = Rotation.from_euler("Z", turn).as_matrix()
        moved = replace(
            estimate, time_s=estimate.time_s + later_s, position_m=estimate.position_m[:, ::-1] @ R.T + 4.0
        )
        again = find_offset(moved, time_s + later_s, position_m @ R.T + 4.0, max_offset_s=0.4)
        # Medians along the axes turn only approximately with the world: a fraction of the standard deviation of 2 ms.
        assert again.offset_s == pytest.approx(first.offset_s, abs=1e-3)
        assert again.partner.tolist() == first.partner.tolist()[::-1] == [1, 0]


class TestRefusedInput:
    def refused(self, path, text, *, max_offset_s=1.0, offset_s=0.2, **others):
        estimate = simulate_estimate(path, offset_s=offset_s, noise_m=0.02, **others)
        with pytest.raises(InputError, match=text):
            find_offset(estimate, *simulate_reference(path), max_offset_s=max_offset_s)

    def test_drones_that_move_only_a_little(self):
        self.refused(
            random_motion(0, 0.01),
            "motion that determines the offset to a frame, 0.04 s, found a standard dev",
        )

    def test_a_drone_that_hovers_or_flies_straight_on(self):
        for velocity_m_s in (0.0, 1.0):
            self.refused(
                lambda t, v=velocity_m_s: np.stack([v * np.asarray(t), 0 * t, 1 + 0 * t], axis=-1),
                "standard deviation|if the drones hover",
            )

    def test_circles(self):
        def circle(time_s):
            angle = 2 * np.pi * np.asarray(time_s) / 0.8
            return np.stack([np.cos(angle), np.sin(angle), 1 + 0 * angle], axis=-1)

        self.refused(
            circle,
            "one offset that fits best, found both .* repeats: narrow the range",
            max_offset_s=1.2,
        )
        estimate = simulate_estimate(circle, offset_s=0.2, noise_m=0.02)
        found = find_offset(estimate, *simulate_reference(circle), max_offset_s=0.35)
        assert found.offset_s == pytest.approx(0.2, abs=2e-3)

    def test_an_offset_outside_of_the_range(self):
        self.refused(
            random_motion(0),
            r"within 0.3 s, found the least distance at an end of the range, \+0.3 s; widen",
            max_offset_s=0.3,
            offset_s=0.9,
        )

    def test_no_common_time(self):
        self.refused(random_motion(0), "positions of both at offsets within 1 s, found none", start_s=60.0)

    def test_invalid_arguments_are_refused(self):
        estimate, (time_s, position_m) = (
            simulate_estimate(random_motion(0)),
            simulate_reference(random_motion(0)),
        )
        with pytest.raises(SettingsError, match=r"max_offset_s: expected a step of the reference, 0.01 s"):
            find_offset(estimate, time_s, position_m, max_offset_s=0.001)
        with pytest.raises(InputError, match="reference at two increasing times"):
            find_offset(estimate, time_s[::-1].copy(), position_m, max_offset_s=1.0)
        with pytest.raises(InputError, match="estimate of two frames or more, found 1"):
            find_offset(estimate.at_frames(np.array([5])), time_s, position_m, max_offset_s=1.0)
        unseen = replace(estimate, position_m=np.full_like(estimate.position_m, np.nan))
        with pytest.raises(InputError, match="found none"):
            find_offset(unseen, time_s, position_m, max_offset_s=1.0)


@dataclass(frozen=True)
class DetectionErrors:
    """Errors of simulated detections.

    Attributes:
        noise_px: standard deviation of a detection, pixels.
        missed: share of the detections that are missing.
        wrong: share of the detections that are anywhere in the image.
        seed: seed of all random numbers.
    """

    noise_px: float = 1.0
    missed: float = 0.1
    wrong: float = 0.02
    seed: int = 0


def detected_points(rig, paths, offsets_frames, *, num_frames=300, **errors):
    """Pixels (frames, drones, cameras, 2) by OpenCV; camera c sees frame k at the time (k + offset of c) / FPS."""
    errors = DetectionErrors(**errors)
    rng = np.random.default_rng(errors.seed)
    points_px = np.full((num_frames, len(paths), len(rig), 2), np.nan)
    for number, offset_frames in enumerate(offsets_frames):
        time_s = (np.arange(num_frames) + offset_frames) / FPS
        one = rig.cameras[number]
        R, t = one.T_cam_world[:3, :3], one.T_cam_world[:3, 3]
        for drone, path in enumerate(paths):
            projected = cv2.projectPoints(path(time_s), cv2.Rodrigues(R)[0], t, one.K, one.dist)[0]
            points_px[:, drone, number] = projected[:, 0]
    points_px += rng.normal(0, errors.noise_px, points_px.shape)
    stray = rng.random(points_px.shape[:-1]) < errors.wrong
    points_px[stray] = rng.uniform((0, 0), (1920, 1080), (int(stray.sum()), 2))
    points_px[rng.random(points_px.shape[:-1]) < errors.missed] = np.nan
    return points_px


def path_near_origin(number, speed_m_s=1.0):
    path = random_motion(number, speed_m_s)
    return lambda time_s: path(time_s) - [3.0 * number, 0, 0.3]


RIG = ring_rig(8, coefficients=5, image_size_wh=(1920, 1080), radius_m=6.0)
OFFSET_FRAMES = np.array([0.4, -1.0, 0.75, -0.2, 1.0, -0.6, 0.15, -0.5])
DRONES = [path_near_origin(number) for number in range(3)]


class TestCameraOffsets:
    def test_a_ring_with_noise_and_wrong_detections(self):
        found = camera_offsets(RIG, detected_points(RIG, DRONES, OFFSET_FRAMES), FPS)
        # The required accuracy is 0.1 frame. Measured 0.011, in agreement with the standard deviations.
        np.testing.assert_allclose(found.offset_frames, OFFSET_FRAMES, atol=0.03)
        assert found.offset_frames.mean() == pytest.approx(0, abs=1e-12)
        assert (found.std_frames < 0.02).all()

    def test_without_noise(self):
        points_px = detected_points(RIG, DRONES, OFFSET_FRAMES, noise_px=0, missed=0, wrong=0)
        found = camera_offsets(RIG, points_px, FPS)
        # Linear interpolation of pixels over a frame has an error of an eighth of the acceleration, at most 0.03 px.
        np.testing.assert_allclose(found.offset_frames, OFFSET_FRAMES, atol=3e-3)

    @pytest.mark.parametrize("errors", ["independent", "correlated", "turning", "calibration"])
    @pytest.mark.slow
    def test_the_true_offsets_are_within_two_standard_deviations(self, errors):
        """Of 8 x 7 offsets at least 85 % are inside; chance gives fewer in 0.5 % of cases if 95 % is right.

        The standard deviations must not be several times too large either.
        """
        offset_frames = OFFSET_FRAMES - OFFSET_FRAMES.mean()
        normalised, spread = [], []
        for seed in range(8):
            rng = np.random.default_rng(seed)
            paths = [path_near_origin(3 * seed + number) for number in range(2)]
            points_px = detected_points(RIG, paths, offset_frames, num_frames=90, noise_px=0.5, seed=seed)
            if errors == "correlated":
                points_px += 1.5 * correlated_noise(rng, points_px.shape, 0.9)
            elif errors == "turning":
                # The middle of a box is off by 3 px in the image, in a direction that turns with the drone.
                heading_rad = headings(paths, np.arange(90) / FPS)
                phase = rng.uniform(0, 2 * np.pi, (2, 8))
                angle = heading_rad[..., None] + phase
                points_px += 3 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
            elif errors == "calibration":
                points_px += 2 * rng.normal(size=(8, 2))
            found = camera_offsets(RIG, points_px, FPS)
            normalised.append((found.offset_frames - offset_frames) / found.std_frames)
            spread.append(np.stack([found.offset_frames - offset_frames, found.std_frames], axis=-1))
        assert np.mean(np.abs(normalised) < 2) >= 0.85
        error, std = np.sqrt(np.mean(np.square(spread), axis=(0, 1)))
        assert std < 2 * error

    def test_offsets_of_zero_are_found(self):
        found = camera_offsets(RIG, detected_points(RIG, DRONES, np.zeros(8)), FPS)
        assert np.abs(found.offset_frames).max() < 0.03

    @pytest.mark.parametrize("num_cameras", [2, 3])
    def test_few_cameras_and_large_offsets(self, num_cameras):
        rig = RIG.select(RIG.names[:num_cameras])
        offset_frames = np.linspace(-3, 3, num_cameras)
        found = camera_offsets(rig, detected_points(rig, DRONES, offset_frames), FPS)
        np.testing.assert_allclose(found.offset_frames, offset_frames, atol=0.1)

    def test_the_order_of_cameras_does_not_matter(self):
        points_px, order = detected_points(RIG, DRONES, OFFSET_FRAMES), np.array([3, 0, 7, 1, 6, 2, 5, 4])
        first = camera_offsets(RIG, points_px, FPS)
        rig = RIG.select([RIG.names[i] for i in order])
        second = camera_offsets(rig, points_px[:, :, order], FPS)
        # The iteration stops when steps are below 1e-4 frames.
        np.testing.assert_allclose(second.offset_frames, first.offset_frames[order], atol=1e-3)

    def test_offsets_from_hovering_drones_are_uncertain(self):
        found = camera_offsets(
            RIG, detected_points(RIG, [path_near_origin(0, 0.0)], OFFSET_FRAMES), FPS, max_offset_frames=4.0
        )
        assert (found.std_frames > 2.0).all()
        assert np.abs(found.offset_frames).max() <= 4.0

    def test_the_offset_of_a_camera_without_detections_is_uncertain(self):
        points_px = detected_points(RIG, DRONES, OFFSET_FRAMES)
        points_px[:, :, 5] = np.nan
        found = camera_offsets(RIG, points_px, FPS, max_offset_frames=4.0)
        others = np.arange(8) != 5
        apart = found.offset_frames[others] - OFFSET_FRAMES[others]
        np.testing.assert_allclose(apart, apart.mean(), atol=0.03)
        assert found.std_frames[5] > 2.0
        assert found.std_frames[5] > 5 * found.std_frames[others].max()

    @pytest.mark.parametrize("shape", [(0, 1), (1, 1), (10, 0), (10, 2)])
    def test_without_detections_all_offsets_are_zero(self, shape):
        found = camera_offsets(RIG, np.full((*shape, 8, 2), np.nan), FPS)
        assert (found.offset_frames == 0).all()

    def test_invalid_arguments_are_refused(self):
        with pytest.raises(SettingsError, match="points_px: expected 8 cameras, found 5"):
            camera_offsets(RIG, np.zeros((10, 1, 5, 2)), FPS)
        with pytest.raises(SettingsError, match="max_offset_frames"):
            camera_offsets(RIG, np.zeros((10, 1, 8, 2)), FPS, max_offset_frames=0.0)


def make_recording(root):
    """A real sequence with black videos, and tracks. The .c3d file, at 100 Hz, begins 0.4321 s before the videos."""
    folder = root / "Real_Data" / "R12_D2"
    folder.mkdir(parents=True)
    R, t_m = look_at((0.0, -6.0, 2.0), (0.0, 0.0, 1.5))
    one = make_camera(
        R=R, t_m=t_m, K=np.diag([1100.0, 1100.0, 1.0]), image_size_wh=(64, 48), dist=(0.0, 0.0, 0.0, 0.0)
    )
    write_calibration(folder / CALIBRATION, make_unnamed_rig(one), "mm")
    with VideoWriter(folder / "0.avi", FPS, (64, 48)) as writer:
        for _ in range(150):
            writer.write(np.zeros((48, 64, 3), np.uint8))
    time_s, position_m = simulate_reference(random_motion(0), random_motion(1), seconds=8)
    cross_m = np.array([[0.1, 0, 0], [0, 0.13, 0], [-0.16, 0, 0], [0, -0.19, 0]])
    cross_m -= cross_m.mean(axis=0)
    labels = tuple(f"Dron{drone}:Dron{drone}{marker}" for drone in (1, 2) for marker in (1, 2, 3, 4))
    markers_m = (position_m[:, :, None] + cross_m).reshape(len(time_s), 8, 3)
    write_c3d(folder / "R12_D2.c3d", Markers(labels, markers_m, 100.0))
    estimate = simulate_estimate(
        random_motion(0), random_motion(1), seconds=6, start_s=0.4321, offset_s=0.4321, noise_m=0.01
    )
    tracks = root / "tracks.csv"
    write_trajectories(tracks, estimate)
    return folder, tracks


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """The sequence and the tracks of `make_recording`."""
    return make_recording(tmp_path_factory.mktemp("data"))


class TestCommand:
    def run(self, recording, *arguments):
        folder, tracks = recording
        return CliRunner().invoke(
            doctor, [str(folder), "--tracks", str(tracks), *map(str, arguments)], catch_exceptions=False
        )

    def test_a_recording_at_its_own_rate(self, recording):
        result = self.run(recording, "--max-offset", 1)
        assert result.exit_code == 0
        words = result.stdout.split()
        assert result.stdout.startswith("R12_D2: the reference's clock is 0.43")
        assert float(words[words.index("s") - 1]) == pytest.approx(0.4321, abs=0.1 / FPS)
        assert "ahead of the videos'" in result.stdout
        assert "(+10." in result.stdout
        assert len(result.stdout.splitlines()) == 1

    def test_json(self, recording):
        content = json.loads(self.run(recording, "--json", "-", "--max-offset", 1).stdout)
        assert content["offset_s"] == pytest.approx(0.4321, abs=0.1 / FPS)
        assert content["mean_distance_m"] < 0.03 < content["mean_distance_before_m"]
        assert content["overlap"] == 1.0
        assert [(drone["drone"], drone["estimate"]) for drone in content["drones"]] == [
            ("dron1", "0"),
            ("dron2", "1"),
        ]
        assert len(content["curve"]["offset_s"]) == len(content["curve"]["mean_distance_m"]) == 51

    def test_without_a_reference(self, recording, tmp_path):
        folder, tracks = recording
        bare = tmp_path / "R13_D2"
        bare.mkdir()
        for path in folder.iterdir():
            if path.suffix != ".c3d":
                (bare / path.name).write_bytes(path.read_bytes())
        with pytest.raises(InputError, match="R13_D2: expected a reference to synchronise with, found none"):
            self.run((bare, tracks))
