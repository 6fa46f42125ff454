"""Two drones that are drawn by casting rays, and the swarm that tracks them.

All tests of the swarm use this rig, effort and length of a block, so that they share the compiled programs.
"""

from functools import cache

import numpy as np
from helpers import ROOM_M, drawn_silhouettes, ring_rig, silhouettes_in_memory, track_settings

from psotrack.tracking.births import InitialState
from psotrack.tracking.swarm import RunInputs, track_silhouettes, tracker_settings

FPS = 25.0
REDUCTION = 2
RIG = ring_rig(5, coefficients=5)
SIZE_M = np.array([[0.5, 0.5, 0.3], [0.6, 0.6, 0.35]])
#: A cell of a silhouette is 2 px; at 4 m and a focal length of 260 px that is 3 cm.
CELL_M = 0.03
EFFORT = {"particles": 20, "iterations": 15}

#: The first drone is away for a while and comes back elsewhere. The second enters in the last nine frames of a block of
#: 25: it is found in ten frames, so that both its block and the next one are tracked again.
AWAY, ENTERS, NUM_FRAMES = slice(45, 70), 43, 110
VELOCITY_M_S = np.array([[0.25, 0.1, 0.05], [-0.4, 0.05, 0.05]])


def _paths():
    """(frames, 2, 3) positions; NaN where there is no drone."""
    time_s = np.arange(NUM_FRAMES)[:, None, None] / FPS
    truth = np.array([[-0.9, -0.6, 1.2], [1.3, 0.9, 0.9]]) + time_s * VELOCITY_M_S
    truth[AWAY.stop :, 0] += [0.3, -0.9, 0.2]
    truth[AWAY, 0] = np.nan
    truth[:ENTERS, 1] = np.nan
    return truth


TRUTH_M = _paths()


def draw(truth_m, size_m=SIZE_M, rig=RIG):
    """(frames, cameras, height, width), silhouettes of drones at (frames, drones, 3)."""
    return np.stack(drawn_silhouettes(rig, truth_m, size_m, REDUCTION).arrays, axis=1)


@cache
def comings_and_goings():
    """The silhouettes of both drones at `TRUTH_M`."""
    images = draw(TRUTH_M)
    images.flags.writeable = False
    return images


def first_drone(size=1.0):
    """Initial state of the first drone alone, whose lengths are `size` times the true ones."""
    return InitialState(TRUTH_M[:1, 0], VELOCITY_M_S[:1], size * SIZE_M[:1], np.array([5.0]))


def run_inputs(given=None, **settings):
    """A run with the usual effort, unless the settings say otherwise."""
    return RunInputs(ROOM_M, tracker_settings(track_settings(**(EFFORT | settings))), given)


def track(images, given=None, *, rig=RIG, reduction=REDUCTION, **settings):
    """The tracks in silhouettes (frames, cameras, height, width)."""
    silhouettes = silhouettes_in_memory(rig, images, reduction)
    ((tracks, _),) = track_silhouettes(rig, silhouettes, [run_inputs(given, **settings)], fps=FPS)
    return tracks
