"""The errors of fused tracks that come from the cameras."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Int

from psotrack.camera_errors import (
    CameraErrors,
    LastingCovariances,
    MeasurementErrors,
    TrackErrors,
    noise_ratios,
)
from psotrack.fusion.fusion import Fusion
from psotrack.settings import MotionSettings
from psotrack.trajectories import Tracks


def fused_errors(
    fusion: Fusion,
    swarm: TrackErrors | None,
    lines: TrackErrors | None,
    motion: MotionSettings,
    fps: float,
) -> tuple[Tracks, TrackErrors]:
    """Fused tracks with the errors of both methods.

    Errors that last have the same causes in both methods, the turned cameras and the late clocks, and do not average
    out. A weighted mean of two errors has at most the weighted mean of their squares, whatever their correlation: that
    is the covariance of the fused errors that last.

    Args:
        fusion: the fused tracks; their measured covariances are those of the noise that was found.
        swarm, lines: errors of both methods; None for a method that found no drone. The noise of the first that found
            one fades as that of the fused positions.
        motion: settings of the motion model that the fusion used.
        fps: frames per second.
    """
    known = [each for each in (swarm, lines) if each is not None]
    first, second = known[0].cameras, known[-1].cameras

    def mean(one: Any, other: Any) -> Any:
        return np.sqrt((np.square(one) + np.square(other)) / 2)

    errors = CameraErrors(
        noise_px=np.full_like(first.noise_px, np.nan),
        fading=first.fading,
        lasting_px=mean(first.lasting_px, second.lasting_px),
        turn_rad=float(mean(first.turn_rad, second.turn_rad)),
        clock_s=float(mean(first.clock_s, second.clock_s)),
        constant_covariance=(first.constant_covariance + second.constant_covariance) / 2,
    )
    tracks = fusion.tracks
    measured_m2 = np.asarray(tracks.measured_covariance_m2, np.float64)
    _, filtered = noise_ratios(
        measured_m2,
        measured_m2,
        errors,
        MeasurementErrors(1.0, motion.error_share, motion.error_time_s),
        dt_s=1 / fps,
        jerk_density_m2_s5=motion.jerk_density,
    )
    corrected = replace(tracks, covariance_m2=tracks.covariance_m2 * filtered[..., None, None])
    return corrected, TrackErrors(errors, _fused_lasting(fusion, swarm, lines))


def _fused_lasting(
    fusion: Fusion, swarm: TrackErrors | None, lines: TrackErrors | None
) -> LastingCovariances:
    """Covariances of the fused positions by errors that last: the weighted means of both methods' covariances."""
    import pandas as pd  # takes 0.2 s, and only fused tracks need it

    num_drones = fusion.tracks.num_drones
    num_swarm = 0 if swarm is None else swarm.lasting.absolute_m2.shape[1]
    in_swarm = np.where(np.arange(num_drones) < num_swarm, np.arange(num_drones), -1)
    # A drone that is not found keeps the weights of the frame in which it was last found.
    share = pd.DataFrame(fusion.lines_share).ffill().bfill().fillna(0.0).to_numpy()[..., None, None]

    def of_drones(errors: TrackErrors | None, drones: Int[np.ndarray, "drones"], name: str) -> np.ndarray:
        if errors is None:
            return np.zeros((*fusion.lines_share.shape, 3, 3))
        lasting_m2: np.ndarray = getattr(errors.lasting, name)
        return np.where((drones >= 0)[:, None, None], lasting_m2[:, np.maximum(drones, 0)], 0.0)

    def both(name: str) -> np.ndarray:
        return (1 - share) * of_drones(swarm, in_swarm, name) + share * of_drones(
            lines, fusion.lines_drones, name
        )

    return LastingCovariances(both("absolute_m2"), both("relative_m2"))
