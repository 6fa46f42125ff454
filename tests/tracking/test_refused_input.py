"""Messages of the tracking room: settings and measurements that it cannot use."""

import numpy as np
import pytest
from helpers import assert_refused, track_settings
from motion_textbook import simulate_flight

from psotrack.pipeline import causal_settings
from psotrack.settings import TrackSettings
from psotrack.tracking.motion import smooth
from psotrack.tracking.swarm import tracker_settings


def causal(name, value):
    return lambda: causal_settings(TrackSettings().changed({name: value}))


def measured(function, array, index, value):
    """A call with measurements of two drones in 30 frames, of which one value is wrong."""

    def call():
        flown = simulate_flight(18, frames=30, drones=2)
        getattr(flown, array)[index] = value
        return function(flown.measurements, flown.params)

    return call


def kernel(**options):
    return lambda: tracker_settings(track_settings(search="pso-kernel", **options))


KERNEL = "swarm.search pso-kernel: expected swarm.kind per-drone, score.kind soft and no fisheye lens, found "
POSITION = "expected a position and a positive definite covariance where it was measured, found "
TIMES = "time_s: expected increasing times, found repeats, steps back or no numbers"
#: Name of the case -> how the bad input is made, words of the line.
BAD = {
    "causal method": (causal("method", "fused"), "method: expected swarm without the future, found fused"),
    "causal smoothing": (causal("smooth", True), "smooth: expected False without the future, found True"),
    "causal start": (causal("init", "truth"), "init: expected auto without the future, found truth"),
    "causal clocks": (causal("clocks", "auto"), "clocks: expected given without the future, found auto"),
    "causal background": (causal("silhouettes.background", "mog2"), "first_look: expected"),
    "kernel, joint swarm": (kernel(swarm="joint"), KERNEL + "swarm.kind joint"),
    "kernel, hard score": (kernel(score="hard"), KERNEL + "another score"),
    "time that steps back": (measured(smooth, "time_s", 3, 0.01), TIMES),
    "no position": (measured(smooth, "measured_m", (4, 1, 2), np.nan), "row 4, drone 1: " + POSITION),
    "negative variance": (
        measured(smooth, "covariance_m2", (5, 0), np.diag([1, 1, -1])),
        "measurements, row 5, drone 0: " + POSITION,
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_refused_in_one_line(case, tmp_path):
    make, *words = BAD[case]
    assert_refused(make, *words, unchanged=tmp_path)
