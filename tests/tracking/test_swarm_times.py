"""The swarm with cameras that are exposed at different times; silhouettes are drawn by casting rays."""

import numpy as np
import pytest
from helpers import ROOM_M, draw_coverage, ring_rig, track_settings

from psotrack.foreground.silhouettes import Silhouettes
from psotrack.recordings import FrameTimes, make_timeline
from psotrack.tracking.births import InitialState
from psotrack.tracking.swarm import RunInputs, track_silhouettes, tracker_settings
from psotrack.trajectories import Status

FPS = 25.0
REDUCTION = 2
RIG = ring_rig(5, image_size_wh=(480, 360))
SIZE_M = np.array([[0.5, 0.5, 0.3]])
SETTINGS = track_settings(particles=20, iterations=15)
NUM_FRAMES = 75


def positions(time_s):
    """(..., 1, 3), a drone on a circle, 1.6 m/s."""
    turn = 1.6 * np.asarray(time_s)[..., None]
    return np.stack([np.cos(turn), np.sin(turn), 1.2 + 0.2 * np.sin(0.7 * turn)], axis=-1)


def drawn(frame_times):
    """Silhouettes of each camera's frames at the frames' own times."""
    arrays = []
    for number, times in enumerate(frame_times.values()):
        one = RIG.select([RIG.names[number]])
        arrays.append(
            np.stack([draw_coverage(one, at, SIZE_M, REDUCTION)[0] for at in positions(times.time_s)])
        )
    most = max(len(array) for array in arrays)
    keys = dict.fromkeys(RIG.names, "drawn")
    return Silhouettes(RIG.names, keys, REDUCTION, most, arrays[0].shape[1:], {}, tuple(arrays))


def figures(frame_times, given=None):
    """Mean error, metres; share of the truths inside the 90 % ellipsoid; share of the instants that are tracked."""
    timeline = make_timeline(given or frame_times)
    timeline = timeline.part(slice(NUM_FRAMES))
    silhouettes = drawn(frame_times).at_instants(timeline)
    step_s = 1e-3
    velocity = (positions(step_s) - positions(0.0)) / step_s
    initial = InitialState(positions(0.0), velocity, SIZE_M, np.array([5.0]))
    inputs = RunInputs(ROOM_M, tracker_settings(SETTINGS), initial)
    ((tracks, _),) = track_silhouettes(RIG, silhouettes, [inputs], fps=timeline.rate_hz)
    settled = slice(15, None)
    error_m = (tracks.position_m[:, :1] - positions(timeline.time_s))[settled]
    inverse = np.linalg.inv(tracks.covariance_m2[settled, :1])
    nees = np.einsum("fdi,fdij,fdj->fd", error_m, inverse, error_m)
    found = (tracks.status[settled, 0] == Status.TRACKED).mean()
    return np.linalg.norm(error_m, axis=-1).mean(), (nees < 6.25).mean(), found


def alike():
    return {name: FrameTimes(NUM_FRAMES, FPS) for name in RIG.names}


@pytest.mark.slow
def test_frames_that_are_exposed_at_different_times():
    synchronous_m, _, _ = figures(alike())
    offsets = [0.0, 0.5, -0.45, 0.3, -0.4]
    shown = {name: FrameTimes(80, FPS, off / FPS) for name, off in zip(RIG.names, offsets, strict=True)}
    error_m, inside, found = figures(shown)
    ignored_m, _, _ = figures(shown, alike())
    assert error_m < 1.3 * synchronous_m + 0.0005
    assert ignored_m > 2 * error_m
    assert inside > 0.7
    assert found == 1.0


@pytest.mark.slow
def test_a_camera_that_starts_late_and_ends_early_and_one_that_is_slower():
    synchronous_m, _, _ = figures(alike())
    shown = alike() | {RIG.names[1]: FrameTimes(30, FPS, 0.813), RIG.names[3]: FrameTimes(30, 10.0, 0.02)}
    error_m, inside, found = figures(shown)
    assert error_m < 1.6 * synchronous_m + 0.001
    # The slower camera's frames are shown two or three times each and do not shrink the covariance.
    assert inside > 0.8
    assert found == 1.0
