"""Paths of cameras on drones, and tracks of the same drones by static cameras, with known errors."""

from dataclasses import replace

import numpy as np
from helpers import fading
from scipy.spatial.transform import Rotation, Slerp

from psotrack.inside_out import CameraPath, Flag, write_camera_path
from psotrack.trajectories import Status, Trajectories, write_trajectories

FPS = 25.0
#: (3, 3), columns are the axes (right, down, ahead) of a camera that looks along the x axis of its body or the world.
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
#: From the camera to the middle of the drone, in the camera's axes.
ARM_M = np.array([0.01, 0.03, -0.12])
INSIDE_M, OUTSIDE_M = np.array([0.001, 0.001, 0.003]), np.array([0.004, 0.004, 0.004])


def camera_path(position_m, rotation, covariance, *, first_s=0.0, num_markers=8):
    """A path at 25 Hz with a pose in each frame."""
    count = len(position_m)
    return CameraPath(
        frame=np.arange(count),
        time_s=np.arange(count) / FPS + first_s,
        position_m=position_m,
        orientation_wxyz=rotation.as_quat(scalar_first=True).reshape(count, 4),
        covariance=covariance,
        num_markers=np.full(count, num_markers),
        reprojection_px=np.full(count, 0.3),
        ambiguity=np.zeros(count),
        status=np.full(count, int(Status.TRACKED)),
        flags=np.zeros(count, int),
    )


def orientations(path):
    """The orientations of all frames, where a frame without a pose counts as not turned."""
    wxyz = np.where(path.seen[:, None], path.orientation_wxyz, [1.0, 0.0, 0.0, 0.0])
    return Rotation.from_quat(wxyz, scalar_first=True)


def distances_m(path, position_m):
    """Distances from the true positions, NaN without a pose."""
    return np.linalg.norm(path.position_m - position_m, axis=1)


def pose_errors(path, position_m, rotation):
    """True minus estimated poses (frames, 6) in the covariance's order: along the world's axes, about the camera's."""
    turn = orientations(path).inv() * rotation
    return np.concatenate([position_m - path.position_m, turn.as_rotvec()], axis=1)


def squared_errors(error, covariance):
    """Squared Mahalanobis distances (n,) of errors (n, size), by covariances of as many numbers or of more."""
    size = error.shape[1]
    solved = np.linalg.solve(covariance[:, :size, :size], error[..., None])
    return np.vecdot(error, solved[..., 0])


def in_other_world(path, turn, shift_m):
    """The path with its poses in a world that is turned and shifted."""
    by_world = np.eye(6)
    by_world[:3, :3] = turn.as_matrix()
    return replace(
        path,
        position_m=turn.apply(path.position_m) + shift_m,
        orientation_wxyz=(turn * orientations(path)).as_quat(scalar_first=True),
        covariance=by_world @ path.covariance @ by_world.T,
    )


def remove_poses(path, rows):
    """The path with the poses of some frames lost."""
    names = ("position_m", "orientation_wxyz", "covariance", "ambiguity", "reprojection_px")
    values = {name: getattr(path, name).copy() for name in (*names, "status", "num_markers")}
    for name in names:
        values[name][rows] = np.nan
    values["status"][rows], values["num_markers"][rows] = Status.LOST, 0
    return replace(path, **values)


def example_path(with_velocity=True):
    """Path of six frames with random poses and all kinds of status and flags; frame 5 has no pose."""
    rng, frame = np.random.default_rng(3), np.array([0, 1, 2, 4, 5, 6])
    root = rng.normal(size=(6, 6, 6))
    covariance = root @ root.mT
    path = camera_path(rng.normal(size=(6, 3)), Rotation.random(6, rng=rng), (covariance + covariance.mT) / 2)
    path = replace(
        path,
        frame=frame,
        time_s=np.round(frame / FPS, 2),
        ambiguity=np.array([0.0, 0.0, 0.3, np.nan, np.nan, 0.0]),
        status=np.array([Status.TRACKED] * 3 + [Status.COASTING, Status.LOST, Status.TRACKED]),
        flags=np.array([0, 0, Flag.FEW_MARKERS | Flag.AMBIGUOUS, Flag.GATED, 0, 0]),
        velocity_m_s=rng.normal(size=(6, 3)) if with_velocity else None,
    )
    return remove_poses(path, [4])


def outside_tracks(middle_m, covariance_m2, first=0):
    """Tracks at 25 Hz of the middles (frames, drones, 3)."""
    frame = np.arange(first, first + len(middle_m))
    return Trajectories(
        frame=frame,
        time_s=frame / FPS,
        drones=tuple(str(drone) for drone in range(middle_m.shape[1])),
        position_m=middle_m,
        status=np.full(middle_m.shape[:2], int(Status.TRACKED)),
        covariance_m2=covariance_m2,
    )


def remove_positions(tracks, rows, drone=0):
    """The tracks with some frames of one track lost."""
    status = tracks.status.copy()
    status[rows, drone] = Status.LOST
    return replace(tracks, status=status)


def smooth_flight(rng, num_frames, offset_s=0.0):
    """Positions (frames, 3) and rotations of a camera that flies and turns smoothly."""
    time_s = np.arange(num_frames) / FPS + offset_s
    frequency, phase = rng.uniform(0.1, 0.5, (3, 3, 1)), rng.uniform(0, 6, (3, 3, 1))
    waves = np.sin(2 * np.pi * frequency * time_s + phase).sum(axis=0).T
    knots_s = np.arange(-5.0, num_frames / FPS + 7.0)
    turns = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.4, size=(len(knots_s), 3)), axis=0))
    return 0.8 * waves + [0, 0, 2.0], Slerp(knots_s, turns)(time_s)


#: Errors of both sources: standard deviations, metres, and factors on the stated ones; the parts of the variances that
#: are correlated, over 0.3 s inside and `outside_s` outside.
USUAL = {
    "inside_m": INSIDE_M,
    "inside_stated": 1.0,
    "inside_part": 0.5,
    "outside_part": 1.0,
    "outside_s": 0.3,
}


def fly_twice_seen(seed, num_frames=150, num_drones=1, *, distance_m=4.0, **given):
    """Inside paths by name, outside tracks, and each drone's true camera positions (frames, 3) and rotations."""
    given = USUAL | given
    rng = np.random.default_rng(seed)

    def errors(part, time_s):
        white, noise = rng.normal(size=(2, num_frames, 3))
        return np.sqrt(1 - part) * white + np.sqrt(part) * fading(noise, np.exp(-1 / FPS / time_s))

    paths, middles, truths = {}, [], []
    for drone in range(num_drones):
        position_m, rotation = smooth_flight(rng, num_frames)
        position_m = position_m + np.array([distance_m * drone, 0, 0])
        error_m = rotation.apply(errors(given["inside_part"], 0.3) * given["inside_m"])
        covariance = np.zeros((num_frames, 6, 6))
        root = rotation.as_matrix() * (given["inside_stated"] * np.asarray(given["inside_m"]))
        covariance[:, :3, :3] = root @ root.mT
        covariance[:, 3:, 3:] = 1e-6 * np.eye(3)
        paths[f"dron{drone + 1}"] = camera_path(position_m + error_m, rotation, covariance)
        outside_m = errors(given["outside_part"], given["outside_s"]) * OUTSIDE_M
        middles.append(position_m + rotation.apply(ARM_M) + outside_m)
        truths.append((position_m, rotation))
    middle_m = np.stack(middles, axis=1)
    stated_m2 = np.tile(np.diag(OUTSIDE_M**2), (*middle_m.shape[:2], 1, 1))
    return paths, outside_tracks(middle_m, stated_m2), truths


def fly_with_a_swap():
    """Two camera paths, one with a gap, and tracks with another, whose identities are exchanged from frame 60 on."""
    paths, outside, truths = fly_twice_seen(31, 100, num_drones=2, distance_m=1.5)
    outside.position_m[60:, [0, 1]] = outside.position_m[60:, [1, 0]]
    paths["dron1"] = remove_poses(paths["dron1"], slice(20, 30))
    return paths, outside, truths


def make_paths_and_tracks(folder):
    """Write the flight with a swap: `dron1.csv`, `dron2.csv`, `tracks.csv`, and files that do not belong to it."""
    paths, outside, _ = fly_with_a_swap()
    write_trajectories(folder / "tracks.csv", remove_positions(outside, slice(80, 90)))
    write_trajectories(folder / "later.csv", replace(outside, time_s=outside.time_s + 100))
    write_camera_path(folder / "blind.csv", remove_poses(paths["dron1"], slice(0, 100)), "dron3")
    for name, path in paths.items():
        write_camera_path(folder / f"{name}.csv", path, name)
    return folder
