"""Cameras that show the scene late by up to one and two frames: with the given clocks and with estimated ones.

    python experiments/accuracy/clocks.py --data data
    python experiments/accuracy/clocks.py --data data --quick

S02_D4_A, per-drone swarm of 30 x 20. Each camera's silhouettes are late by 0 to 1 or 0 to 2 frames
(`psotrack.sweeps.perturb`), three flights with two draws each; --quick takes one flight and one draw. No video shows by
how much all cameras are late together: positions are compared with the reference at the cameras' median delay.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import _runs
import numpy as np

from psotrack.evaluation import evaluate
from psotrack.foreground.silhouettes import Silhouettes
from psotrack.pipeline import TrackedRecording, track_runs
from psotrack.recordings import Recording
from psotrack.settings import Clocks, TrackSettings
from psotrack.sweeps import Perturbation, delays_frames, perturb
from psotrack.trajectories import resample

NAME = "S02_D4_A"
#: Largest delay of a camera, frames, and the clocks that are used.
CASES: tuple[tuple[float, Clocks], ...] = (
    (0.0, "given"),
    (0.0, "auto"),
    (1.0, "given"),
    (1.0, "auto"),
    (2.0, "given"),
    (2.0, "auto"),
)


def row(
    recording: Recording, silhouettes: Silhouettes, flight: int, draw: int, case: tuple[float, Clocks]
) -> dict[str, Any]:
    """Track one flight with one draw of the delays, and compare with the reference at the median delay."""
    began = time.perf_counter()
    largest, clocks = case
    perturbation = Perturbation(clock_frames=largest, draw=draw)
    _, late = perturb(recording, silhouettes, perturbation, None)
    delay_s = np.array(delays_frames(perturbation, range(len(recording.rig)))) / recording.fps
    settings = TrackSettings().changed({**_runs.EFFORT[NAME], "clocks": clocks})
    (tracked,) = track_runs(recording, late, [settings])
    assert isinstance(tracked, TrackedRecording), tracked
    assert recording.truth is not None
    truth = resample(
        recording.truth, recording.truth.frame, recording.truth.time_s, later_s=-float(np.median(delay_s))
    )
    errors = evaluate(tracked.trajectories, truth).to_dict()
    figures: dict[str, Any] = {"flight": flight, "draw": draw, "largest_frames": largest, "clocks": clocks}
    figures |= {key: errors[key] for key in _runs.KEPT}
    if clocks == "auto":
        found = tracked.record["camera_clocks"]
        offset_s, std_s = (
            np.array([found[name][key] for name in recording.rig.names])
            for key in ("offset_s", "offset_std_s")
        )
        error_s = offset_s + delay_s - np.median(delay_s)
        error_s -= error_s.mean()
        figures["clock_rms_ms"] = 1e3 * float(np.sqrt((error_s**2).mean()))
        figures["clock_std_ms"] = 1e3 * float(np.sqrt((std_s**2).mean()))
    return figures | {"seconds": time.perf_counter() - began}


def main() -> None:
    """Read the command line."""
    parser = _runs.parser(__doc__)
    parser.add_argument("--quick", action="store_true", help="one flight, one draw")
    options = parser.parse_args()
    run = _runs.start("clocks")

    def rows() -> Iterator[tuple[str, Any]]:
        for flight in range(1 if options.quick else 3):
            recording, silhouettes = _runs.open_sequence(NAME, options.data, flight)
            in_memory = silhouettes.part(0, silhouettes.num_frames)
            for draw in range(1 if options.quick else 2):
                for case in CASES:
                    name = f"flight {flight}, draw {draw}, late by {case[0]:g}, {case[1]}"
                    yield name, partial(row, recording, in_memory, flight, draw, case)

    table = _runs.save_rows(run, rows(), options.data, options.out)
    shown = ["offset_removed_mean_error_m", "offset_removed_inside_90_rate", "missed_rate"]
    print(table.groupby(["largest_frames", "clocks"])[shown].mean())


if __name__ == "__main__":
    main()
