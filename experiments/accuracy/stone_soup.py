"""Stone Soup's trackers on points in space: global nearest neighbour (GNN) and joint probabilistic data association.

The points of each frame are those of `psotrack.tracking.matching.match`, without any prediction: Stone Soup does not
match detections of several cameras whose correspondence is unknown.
"""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import Float

from psotrack.geometry import Rig, reconstruct
from psotrack.tracking.matching import Sightings, match

START = datetime.datetime(2000, 1, 1)


@dataclass(frozen=True)
class Grid:
    """Parameters of one run of Stone Soup.

    Attributes:
        associator: "GNN" or "JPDA".
        min_views: smallest number of views of a point; None: three where three cameras have the place in view, else 2.
        acceleration: spectral density of the white acceleration, m²/s³.
        gate: distance, in standard deviations, beyond which a point is of no track.
        min_points: number of points that begin a track.
        deleted_after: number of frames without a point after which a track ends.
    """

    associator: str
    min_views: int | None
    acceleration: float
    gate: float
    min_points: int
    deleted_after: int = 12


def grid(associator: str) -> list[Grid]:
    """The parameters that are tried."""
    return [
        Grid(associator, *values)
        for values in product((None, 2), (3.0, 30.0), (4.0, 8.0), (3, 5))
        if associator == "GNN" or values[3] == 5
    ]


#: Positions (points, 3) and covariances (points, 3, 3) of each frame, metres and m².
Points = list[tuple[np.ndarray, np.ndarray]]


def points_of(
    rig: Rig, sightings: Sightings, bounds_m: Float[np.ndarray, "2 3"], min_views: int | None
) -> Points:
    """Points in which the lines of sight of detections meet, in each frame alone."""
    points = []
    for frame in range(sightings.num_frames):
        view = sightings[frame]
        found = match(rig.cameras, view.centre_px, view.noise_px, bounds_m=bounds_m, min_views=min_views)
        shown = view.grouped(found.detection)
        lines = reconstruct(rig.cameras, shown.centre_px, noise_px=np.nan_to_num(shown.noise_px, nan=1.0))
        kept = np.isfinite(lines.covariance_m2).all(axis=(1, 2))
        points.append((lines.position_m[kept], lines.covariance_m2[kept]))
    return points


def track(points: Points, fps: float, speed_m_s: float, how: Grid) -> Float[np.ndarray, "frames tracks 3"]:
    """Positions of Stone Soup's tracks; NaN where a track has no state.

    Args:
        points: points of each frame.
        fps: frames per second.
        speed_m_s: standard deviation of a new track's velocity.
        how: parameters.
    """
    from stonesoup.types.detection import Detection

    tracker = _tracker(how, speed_m_s)
    rows: dict[str, dict[int, np.ndarray]] = {}
    for frame, (position_m, covariance_m2) in enumerate(points):
        time = START + datetime.timedelta(seconds=frame / fps)
        detections = {
            Detection(place[:, None], timestamp=time, measurement_model=_measured(spread))
            for place, spread in zip(position_m, covariance_m2, strict=True)
        }
        for one in tracker.step(time, detections):
            rows.setdefault(one.id, {})[frame] = np.asarray(one.state.mean, float)[::2, 0]
    tracks = np.full((len(points), max(len(rows), 1), 3), np.nan)
    for number, states in enumerate(rows.values()):
        for frame, place in states.items():
            tracks[frame, number] = place
    return tracks


def _measured(covariance_m2: Float[np.ndarray, "3 3"]) -> Any:
    from stonesoup.models.measurement.linear import LinearGaussian

    return LinearGaussian(6, (0, 2, 4), covariance_m2)


class _Steps:
    """Stone Soup's multi-target tracker, frame by frame."""

    def __init__(self, associator: Any, updater: Any, initiator: Any, deleter: Any, mixed: bool) -> None:
        self.tracks: set[Any] = set()
        self._associator, self._updater, self._initiator = associator, updater, initiator
        self._deleter, self._mixed = deleter, mixed

    def step(self, time: datetime.datetime, detections: set[Any]) -> set[Any]:
        """The tracks after a frame; as in `stonesoup.tracker.simple`."""
        used: set[Any] = set()
        for one, hypotheses in self._associator.associate(self.tracks, detections, time).items():
            if self._mixed:
                one.append(_mixture(hypotheses, self._updater))
                likely = max(hypotheses, key=lambda each: each.probability)
                used |= {each.measurement for each in hypotheses if each and each is likely}
            elif hypotheses:
                one.append(self._updater.update(hypotheses))
                used.add(hypotheses.measurement)
            else:
                one.append(hypotheses.prediction)
        self.tracks -= self._deleter.delete_tracks(self.tracks)
        self.tracks |= self._initiator.initiate(detections - used, time)
        return self.tracks


def _mixture(hypotheses: Any, updater: Any) -> Any:
    """The state of a track from all its hypotheses, each weighted by its probability."""
    from stonesoup.functions import gm_reduce_single
    from stonesoup.types.array import StateVectors
    from stonesoup.types.update import GaussianStateUpdate

    states, weights = [], []
    for each in hypotheses:
        states.append(updater.update(each) if each else each.prediction)
        weights.append(float(each.probability))
    mean, covariance = gm_reduce_single(
        StateVectors([state.state_vector for state in states]),
        np.stack([state.covar for state in states], axis=2),
        np.array(weights),
    )
    return GaussianStateUpdate(mean, covariance, hypotheses, hypotheses[0].prediction.timestamp)


def _tracker(how: Grid, speed_m_s: float) -> _Steps:
    from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
    from stonesoup.dataassociator.probability import JPDA
    from stonesoup.deleter.time import UpdateTimeStepsDeleter
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.initiator.simple import MultiMeasurementInitiator
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import KalmanUpdater

    motion = CombinedLinearGaussianTransitionModel([ConstantVelocity(how.acceleration)] * 3)
    predictor, updater = KalmanPredictor(motion), KalmanUpdater(None)
    nearest = GNNWith2DAssignment(
        DistanceHypothesiser(predictor, updater, measure=Mahalanobis(), missed_distance=how.gate)
    )
    mixed = how.associator == "JPDA"
    associator = nearest
    if mixed:
        share = {4.0: 0.999, 8.0: 0.999999}[how.gate]
        associator = JPDA(
            PDAHypothesiser(
                predictor, updater, clutter_spatial_density=1e-3, prob_detect=0.9, prob_gate=share
            )
        )
    # The position of the prior is replaced by the first point.
    prior = GaussianState(np.zeros((6, 1)), np.diag([1.0, speed_m_s**2] * 3), timestamp=START)
    initiator = MultiMeasurementInitiator(
        prior_state=prior,
        measurement_model=None,
        deleter=UpdateTimeStepsDeleter(3),
        data_associator=nearest,
        updater=updater,
        min_points=how.min_points,
    )
    return _Steps(associator, updater, initiator, UpdateTimeStepsDeleter(how.deleted_after), mixed)
