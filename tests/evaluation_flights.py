"""Flights of a few frames, for the tests of evaluation."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from psotrack.trajectories import Status, Trajectories

#: Frames per second. Frames 0 and 1 are the first second, in which identity is fixed.
FPS = 2.0
#: Keys of the errors as JSON, which the contract promises.
ERROR_KEYS = {
    *("frames", "drones", "missed_rate", "id_switches", "mota", "motp_m", "idf1", "per_drone"),
    *("mean_error_m", "median_error_m", "std_error_m", "p95_error_m", "max_error_m"),
    *("matched_mean_error_m", "offset_removed_mean_error_m"),
    *("hota", "deta", "assa", "loca"),
    *("gospa_m", "gospa_localisation_m", "gospa_missed_m", "gospa_false_m"),
    *("ate_rmse_m", "ate_aligned_rmse_m", "rpe_1s_rmse_m", "rpe_1s_rotation_rmse_deg"),
    *("inside_90_rate", "mean_nees", "offset_removed_inside_90_rate", "offset_removed_mean_nees"),
}
#: Tolerance for sums of a few float64 numbers of some metres, metres.
ROUNDING = 1e-12


def on_x_axis(*tracks, frame=None, **others):
    """Trajectories of drones on the x axis; a track is a list of x in metres, or None where x is unknown."""
    x_m = np.array(tracks, float).T
    frame = np.arange(len(x_m)) if frame is None else np.array(frame)
    position_m = np.stack([x_m, 0 * x_m, 0 * x_m], axis=-1)
    names = tuple(f"d{number}" for number in range(len(tracks)))
    return Trajectories(frame=frame, time_s=frame / FPS, drones=names, position_m=position_m, **others)


#: Reference of two drones that stand still, 10 m apart.
TRUTH = on_x_axis([0] * 5, [10] * 5)


def with_covariance(est, covariance_m2):
    """The flight with one covariance for all positions."""
    shape = (est.num_frames, est.num_drones, 3, 3)
    return replace(est, covariance_m2=np.broadcast_to(np.array(covariance_m2, float), shape).copy())


def random_flights(seed, num_frames=7, num_drones=3, num_estimates=4, missing=0.15):
    """A random estimate and a random reference in a cube of 1 m, so small that drones are often mixed up."""
    rng = np.random.default_rng(seed)

    def flights(drones, prefix):
        position_m = rng.uniform(-0.5, 0.5, (num_frames, drones, 3))
        position_m[rng.random((num_frames, drones)) < missing] = np.nan
        frame = np.arange(num_frames)
        return Trajectories(frame, frame / FPS, tuple(f"{prefix}{d}" for d in range(drones)), position_m)

    ref = flights(num_drones, "true")
    # At least one position of the reference must be known.
    ref.position_m[0, 0] = 0.0
    turns = Rotation.random(num_frames * num_drones, rng=rng)
    turns_wxyz = turns.as_quat(scalar_first=True).reshape(num_frames, num_drones, 4)
    return flights(num_estimates, "est"), replace(ref, orientation_wxyz=turns_wxyz)


#: Frames of `circling_flights`.
NUM_FRAMES = 50


def circling_flights(num_drones=3, *, swap=False, names=()):
    """Estimate and reference of drones on circles.

    The estimate has an offset of 20 mm, and drone 2 is lost in frames 10 to 19. With `swap`, the first two tracks are
    exchanged from frame 40 on.
    """
    frame = np.arange(NUM_FRAMES)
    angle = frame[:, None] / 10 + np.arange(num_drones)
    ref_m = np.stack([np.cos(angle) + 2 * np.arange(num_drones), np.sin(angle), 1 + 0 * angle], axis=-1)
    est_m = ref_m + np.array([0.02, 0, 0])
    if swap:
        est_m[40:, [0, 1]] = est_m[40:, [1, 0]]
    status = np.full((NUM_FRAMES, num_drones), Status.TRACKED)
    status[10:20, 2] = Status.LOST
    numbers = tuple(str(number) for number in range(num_drones))
    return (
        Trajectories(frame, frame / 25, numbers, est_m, status=status),
        Trajectories(frame, frame / 25, names or tuple(f"dron{number}" for number in numbers), ref_m),
    )
