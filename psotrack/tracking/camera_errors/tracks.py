"""Tracks with covariances that hold for the errors of their cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Int

from psotrack.settings import ErrorSettings, MotionSettings
from psotrack.tracking.camera_errors.changes import ClockStep, Knock, find_change
from psotrack.tracking.camera_errors.covariances import (
    SystematicCovariances,
    noise_covariance,
    noise_ratios,
    systematic_covariances,
)
from psotrack.tracking.camera_errors.learning import CameraErrors, learn_camera_errors
from psotrack.tracking.camera_errors.views import CameraViews
from psotrack.trajectories import Status, Tracks, Trajectories

#: Largest fraction of the noise that fades, for the motion model, which needs some white noise.
_MOST_FADING = 0.95


@dataclass(frozen=True)
class TrackErrors:
    """The errors of a method's tracks that come from the cameras.

    Attributes:
        cameras: errors of the cameras.
        systematic: covariances of the positions by systematic errors, which the tracks' covariances do not contain.
        knock: a camera that was knocked during the recording, which they do contain; None for no camera.
        clock_step: a camera whose clock steps during the recording; None for no camera.
    """

    cameras: CameraErrors
    systematic: SystematicCovariances
    knock: Knock | None = None
    clock_step: ClockStep | None = None

    def smoothing(self, motion: MotionSettings) -> MotionSettings:
        """Settings of the motion model with noise that fades as it was found to."""
        fraction = min(self.cameras.fading_fraction, _MOST_FADING)
        return msgspec.structs.replace(motion, error_share=fraction, error_time_s=self.cameras.fading_time_s)

    def added_to(
        self, trajectories: Trajectories, order: Int[np.ndarray, "frames drones"] | None
    ) -> Trajectories:
        """Trajectories with the systematic errors in their covariances.

        Args:
            trajectories: trajectories from the tracks.
            order: (frames, drones), index of each drone's track (see `Identities.order`); None where labels stay.
        """
        assert trajectories.covariance_m2 is not None
        covariances = []
        for systematic_m2 in (self.systematic.absolute_m2, self.systematic.relative_m2):
            if order is not None:
                systematic_m2 = np.take_along_axis(systematic_m2, order[..., None, None], axis=1)
            total_m2 = trajectories.covariance_m2 + systematic_m2
            covariances.append((total_m2 + total_m2.swapaxes(-1, -2)) / 2)
        return replace(trajectories, covariance_m2=covariances[0], relative_covariance_m2=covariances[1])

    def record(self, names: Sequence[str]) -> dict[str, Any]:
        """The cameras' errors, fit for JSON; None for what is not known."""
        errors = self.cameras
        return {
            "cameras": {
                name: {
                    "noise_px": None if np.isnan(noise_px).any() else noise_px.tolist(),
                    "lasting_px": bias_px.tolist(),
                }
                for name, noise_px, bias_px in zip(names, errors.noise_px, errors.bias_px, strict=True)
            },
            "turn_deg": float(np.degrees(errors.turn_rad) * np.sqrt(3)),
            "clock_s": errors.clock_s,
            "fading_share": errors.fading_fraction,
            "fading_time_s": errors.fading_time_s,
        }


def with_camera_errors(
    tracks: Tracks,
    views: CameraViews,
    motion: MotionSettings,
    given: ErrorSettings,
    fps: float,
    all_views: CameraViews | None = None,
) -> tuple[Tracks, TrackErrors]:
    """Tracks whose covariances are those of the noise that was found, and the systematic errors.

    Args:
        tracks: tracks of the swarm or of the projection lines.
        views: the views of the tracked drones.
        motion: settings of the motion model that the tracker used.
        given: what is known of the cameras' errors beforehand.
        fps: frames per second.
        all_views: the views with those that do not count in the tracks, which may show a knock; None: they are not
            known.
    """
    errors = learn_camera_errors(views, fps, (motion.error_share, motion.error_time_s))
    measured_m2, filtered_m2 = (
        np.asarray(value, np.float64) for value in (tracks.measured_covariance_m2, tracks.covariance_m2)
    )
    found = (tracks.status == Status.TRACKED)[..., None, None]
    measured, filtered = noise_ratios(
        np.where(found, measured_m2, np.nan),
        noise_covariance(views, errors),
        errors,
        motion,
        fps,
    )
    corrected = replace(
        tracks,
        measured_covariance_m2=measured_m2 * measured[..., None, None],
        covariance_m2=filtered_m2 * filtered[..., None, None],
    )
    change = find_change(views, views if all_views is None else all_views, fps)
    knock = change if isinstance(change, Knock) else None
    clock_step = change if isinstance(change, ClockStep) else None
    systematic = systematic_covariances(views, errors, given, knock)
    return corrected, TrackErrors(errors, systematic, knock, clock_step)
