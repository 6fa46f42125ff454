"""How large the errors of corners are, learned from a recording, and whether covariances fit them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from psotrack.foreground.markers import DetectedMarkers
from psotrack.geometry import look_at, make_camera, project
from psotrack.inside_out import LocaliseSettings, MarkerMap, PoseSettings, RollingShutter
from psotrack.inside_out.localising import localise_frames
from psotrack.inside_out.pose import CornerNoise

LENS = make_camera(
    R=np.eye(3),
    t_m=np.zeros(3),
    K=np.array([[900.0, 0, 639.5], [0, 900.0, 359.5], [0, 0, 1.0]]),
    image_size_wh=(1280, 720),
    dist=(-0.08, 0.02, 0.0004, -0.0003),
)
SIDE_M = 0.25
#: Points along an edge, in units of half the edge, at which the edge is measured.
ALONG = np.linspace(-0.7, 0.7, 16)


def wall():
    """Ten markers on a wall and on a pillar in front of it, by id."""
    found = {}
    for index, (x, z) in enumerate((x, z) for x in (-1.6, -0.8, 0.0, 0.8, 1.6) for z in (0.9, 1.6)):
        y = 2.6 if index % 3 == 0 else 3.0
        found[index] = np.array(
            [[x, y, z + SIDE_M], [x + SIDE_M, y, z + SIDE_M], [x + SIDE_M, y, z], [x, y, z]], float
        )
    return found


def independent(rng, corners_px):
    return 0.15 * rng.normal(size=corners_px.shape)


def by_edges(rng, corners_px):
    """Errors of the intersections of lines that are fitted to points with independent errors."""
    next_px = np.roll(corners_px, -1, axis=1)
    along = (next_px - corners_px) / np.linalg.norm(next_px - corners_px, axis=-1, keepdims=True)
    across = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    off_px = 0.2 * rng.normal(size=(*corners_px.shape[:2], len(ALONG)))
    shift = off_px.mean(axis=-1)
    slope = (off_px * ALONG).sum(axis=-1) / (ALONG**2).sum()
    # Each corner is where the end of one edge meets the start of the next.
    ends = (shift + slope)[..., None], (shift - slope)[..., None]
    moved = np.zeros_like(corners_px)
    for corner in range(4):
        before, after = (corner - 1) % 4, corner
        normals = np.stack([across[:, before], across[:, after]], axis=1)
        offs = np.concatenate([ends[0][:, before], ends[1][:, after]], axis=1)
        moved[:, corner] = np.linalg.solve(normals, offs[..., None])[..., 0]
    return moved


def together(rng, corners_px):
    """Small independent errors, and larger ones that all corners of a marker share, as of a lens that is not exact."""
    return 0.1 * rng.normal(size=corners_px.shape) + 0.3 * rng.normal(size=(len(corners_px), 1, 2))


def as_drawn(rng, corners_px):
    """Errors as in drawn videos: by edges, 0.08 px, and a shift of 0.015 px that all corners of a frame share."""
    return 0.6 * by_edges(rng, corners_px) + 0.015 * rng.normal(size=(1, 1, 2))


def filmed(errors, num_frames=60, markers=10, seed=0):
    """Number, time and markers of frames, and the true poses."""
    rng, corners = np.random.default_rng(seed), wall()
    ids = np.arange(markers)
    points_m = np.array([corners[index] for index in ids])
    frames, poses = [], []
    for number in range(num_frames):
        position_m = np.array([0.0, -0.6, 1.4]) + rng.uniform(-0.5, 0.5, 3)
        target_m = np.array([0.0, 3.0, 1.35]) + rng.uniform(-0.1, 0.1, 3)
        R = look_at(tuple(position_m), tuple(target_m))[0].T
        pixels = project(LENS, (points_m - position_m).reshape(-1, 3) @ R)[0].reshape(-1, 4, 2)
        frames.append(
            (
                number,
                number / 30,
                DetectedMarkers(ids, pixels + errors(rng, pixels), np.full(markers, np.nan)),
            )
        )
        poses.append((position_m, R))
    return frames, poses


def nees(frames, poses, size=6, noise=None):
    """Mean squared error of poses (size 6) or positions (size 3) by their covariances, divided by its expectation.

    Also the fraction in the 90 % ellipsoid.
    """
    settings = LocaliseSettings(pose=PoseSettings(noise=noise), filter=None, shutter=RollingShutter(0.0))
    path = localise_frames(frames, MarkerMap(wall()), LENS, settings).path
    position_m, R = (np.array(part) for part in zip(*poses, strict=True))
    turns = Rotation.from_quat(path.orientation_wxyz, scalar_first=True).inv() * Rotation.from_matrix(R)
    off = np.concatenate([position_m - path.position_m, turns.as_rotvec()], axis=1)[:, :size]
    squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(path.covariance[:, :size, :size]), off)
    return np.mean(squares) / size, np.mean(squares < chi2.ppf(0.9, size))


@pytest.mark.parametrize("errors", [by_edges, independent, together, as_drawn])
def test_positions_and_poses_have_covariances_that_fit_their_errors(errors):
    """By edges, independent, of whole markers, and as in drawn videos: two variances fit all of them."""
    frames, poses = filmed(errors, 100)
    for size in (3, 6):
        found, inside = nees(frames, poses, size)
        # Measured 0.7 to 1.1, and 0.85 to 0.95; with 100 frames, 0.1 and 0.03 are one standard deviation.
        assert 0.5 < found < 1.3
        assert 0.8 <= inside <= 0.99


@pytest.mark.parametrize("std_px", [0.05, 0.5])
def test_the_noise_of_corners_is_learned_from_the_recording(std_px):
    """Corners in frames of four markers, whose residuals alone say little."""
    frames, poses = filmed(lambda rng, corners_px: std_px * rng.normal(size=corners_px.shape), 100)
    few = [(number, time_s, markers.select(np.arange(10) < 4)) for number, time_s, markers in frames]
    found, inside = nees(few, poses)
    assert 0.5 < found < 1.5
    assert inside > 0.8


def test_a_shift_of_all_corners_of_a_frame_may_be_stated():
    """Found: 0.015 px, as in drawn videos, whatever the camera."""

    def shaken(rng, corners_px):
        return 0.1 * rng.normal(size=corners_px.shape) + 0.2 * rng.normal(size=(1, 1, 2))

    frames, poses = filmed(shaken, 100)
    assert nees(frames, poses)[1] < 0.5
    found, inside = nees(frames, poses, noise=CornerNoise(0.5, 3e-4, shift_px=0.2))
    assert 0.5 < found < 1.3
    assert inside >= 0.8
