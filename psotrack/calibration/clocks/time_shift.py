"""Distances between an estimate and its reference at a shifted time, after the lever arms are subtracted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment, minimize_scalar

from psotrack.calibration.clocks.correlated_errors import autocorrelation, widening
from psotrack.errors import InputError
from psotrack.geometry import rotation_matrices
from psotrack.trajectories import GATE_M, UNASSIGNED, Trajectories, fixed_partner_values, resample
from psotrack.trajectories.resampling import interpolated

#: Velocities are differences over this time before and after a frame, seconds: shorter times would show noise.
_MOTION_S = 0.1
#: Precision of the offset at the minimum, seconds: far below the standard deviations that noise allows.
_PRECISION_S = 1e-6
#: Number of iterations of Weiszfeld's algorithm.
_MEDIAN_STEPS = 5

_At = Callable[[Float[np.ndarray, "times"]], np.ndarray]


@dataclass(frozen=True)
class Residuals:
    """Differences between estimates and reference at one offset, without the lever arms.

    Attributes:
        arm_m: (drones, 3), lever arms that were subtracted, metres; NaN for drones that are not compared.
        residual_m: (frames, drones, 3), remaining differences in the frame of the arms, metres; NaN where the estimate
            or the reference is missing.
    """

    arm_m: Float[np.ndarray, "drones 3"]
    residual_m: Float[np.ndarray, "frames drones 3"]

    @property
    def per_frame_m(self) -> Float[np.ndarray, "frames"]:
        """(frames,), mean distance of the drones in each frame, metres; NaN for a frame without compared drones."""
        distance_m = np.linalg.norm(self.residual_m, axis=-1)
        count = np.isfinite(distance_m).sum(axis=1)
        return np.where(count > 0, np.nansum(distance_m, axis=1) / np.maximum(count, 1), np.nan)

    @property
    def distance_m(self) -> Float[np.ndarray, "compared"]:
        """(compared,), distances of all compared positions, metres."""
        distance_m = np.linalg.norm(self.residual_m, axis=-1)
        return distance_m[np.isfinite(distance_m)]

    @property
    def count(self) -> int:
        """Number of compared positions."""
        return len(self.distance_m)

    @property
    def mean_m(self) -> float:
        """Mean distance of all compared positions, metres; NaN if no positions are compared."""
        return float(self.distance_m.mean()) if self.count else np.nan


@dataclass(frozen=True)
class ShiftedPair:
    """An estimate, and a reference that is interpolated at any time.

    Attributes:
        frame: (frames,), numbers of the estimate's frames.
        time_s: (frames,), times of the estimate's frames, seconds.
        est_m: (frames, estimates, 3), estimated positions, metres; NaN for lost drones.
        position_m: function from times (times,) of the reference's clock to positions (times, drones, 3), metres; NaN
            where the reference is missing.
        rotation: function from times to rotations (times, drones, 3, 3) from the lever arms' frame to the world; None
            if the lever arms are in the world.
        with_lever_arm: allow each drone a constant lever arm.
    """

    frame: Int[np.ndarray, "frames"]
    time_s: Float[np.ndarray, "frames"]
    est_m: Float[np.ndarray, "frames estimates 3"]
    position_m: _At
    rotation: _At | None
    with_lever_arm: bool

    @staticmethod
    def of(
        estimate: Trajectories,
        time_s: Float[np.ndarray, "samples"],
        position_m: Float[np.ndarray, "samples drones 3"],
        orientation_wxyz: Float[np.ndarray, "samples drones 4"] | None,
        with_lever_arm: bool,
    ) -> ShiftedPair:
        """Interpolate the samples of a reference; arguments: see `synchronisation.find_offset`.

        Raises:
            InputError: the reference's times do not increase, or one of both has fewer than two times.
        """
        if len(time_s) < 2 or not (np.diff(time_s) > 0).all():
            raise refused("a reference at two increasing times or more", f"{len(time_s)} times")
        if estimate.num_frames < 2:
            raise refused("an estimate of two frames or more", f"{estimate.num_frames}")
        return ShiftedPair(
            estimate.frame,
            estimate.time_s.astype(np.float64),
            np.where(estimate.seen[..., None], estimate.position_m, np.nan).astype(np.float64),
            interpolated(time_s, position_m),
            None if orientation_wxyz is None else interpolated(time_s, rotation_matrices(orientation_wxyz)),
            with_lever_arm,
        )

    def partner(self, offset_s: float) -> Int[np.ndarray, "drones"]:
        """(drones,), index of the estimated drone that is assigned to each drone of the reference.

        The assignment has the smallest sum of mean distances, which include the lever arms.
        """
        ref_m = self.position_m(self.time_s + offset_s)
        distance_m = np.linalg.norm(ref_m[:, :, None] - self.est_m[:, None], axis=-1)
        count = np.isfinite(distance_m).sum(axis=0)
        # A pair without common positions costs more than any real distance: no room is a kilometre wide.
        mean_m = np.where(count > 0, np.nansum(distance_m, axis=0) / np.maximum(count, 1), 1e3)
        drones, estimates = linear_sum_assignment(mean_m)
        partner = np.full(ref_m.shape[1], UNASSIGNED)
        partner[drones] = np.where(count[drones, estimates] > 0, estimates, UNASSIGNED)
        return partner

    def without_far(self, offset_s: float) -> Int[np.ndarray, "drones"]:
        """The assignment without drones whose lever arm is longer than the gate, unless all are longer."""
        partner = self.partner(offset_s)
        near = np.linalg.norm(_medians(self._residual_m(offset_s, partner)), axis=-1) <= GATE_M
        return np.where(near, partner, UNASSIGNED) if near.any() else partner

    def at(self, offset_s: float, partner: Int[np.ndarray, "drones"]) -> Residuals:
        """The residuals if the reference's clock is ahead by the offset."""
        return self._without_arms(self._residual_m(offset_s, partner))

    def least(self, partner: Int[np.ndarray, "drones"], near_s: float, reach_s: float) -> float:
        """The offset with the smallest mean distance between near_s - reach_s and near_s + reach_s, by Brent's method.

        Only positions count that can be compared at both ends: a position that can be compared at some offsets only
        would make a step in the mean.
        """
        low_s, high_s = near_s - reach_s, near_s + reach_s
        outside = np.isnan(self._residual_m(low_s, partner) + self._residual_m(high_s, partner))

        def mean_m(offset_s: float) -> float:
            residual_m = np.where(outside, np.nan, self._residual_m(offset_s, partner))
            return self._without_arms(residual_m).mean_m

        found = minimize_scalar(
            mean_m, bounds=(low_s, high_s), method="bounded", options={"xatol": _PRECISION_S}
        )
        return float(found.x)

    def standard_deviation_s(self, offset_s: float, partner: Int[np.ndarray, "drones"]) -> float:
        """Standard deviation of the offset at which the mean distance is smallest, seconds.

        It is the standard deviation of the gradient of the summed distance, over the curvature of this sum. The
        gradient is the sum of v · r / |r|, where v are the velocities and r the residuals. Neighbouring frames have
        similar errors, so the variance of the gradient uses the autocovariance of r / |r| at all lags, which is pooled
        over drones and axes, where axes with fast motion have more weight.

        An error that always points along the motion is not included, because such an error looks like an offset.
        """
        residual_m = self.at(offset_s, partner).residual_m
        ends_m = [self._residual_m(offset_s + sign * _MOTION_S, partner) for sign in (-1, 1)]
        velocity_m_s = (ends_m[1] - ends_m[0]) / (2 * _MOTION_S)
        there = np.isfinite(velocity_m_s).all(axis=-1) & np.isfinite(residual_m).all(axis=-1)
        count, there_3d = there.sum(axis=0), there[..., None]
        v = np.where(there_3d, velocity_m_s, 0.0)
        if self.with_lever_arm:
            # A constant velocity only changes the lever arm, so it does not show the offset.
            v = np.where(there_3d, v - v.sum(axis=0) / np.maximum(count, 1)[:, None], 0.0)
        distance_m = np.maximum(np.linalg.norm(residual_m, axis=-1), 1e-9)
        direction = np.where(there_3d, residual_m / distance_m[..., None], 0.0)
        curvature = self._curvature(v, direction, distance_m)
        if not curvature > 0:
            return np.inf
        squared_speed = (v**2).sum(axis=0)
        weight = squared_speed / squared_speed.sum()
        pairs = np.maximum(np.round(autocorrelation(there.astype(float))), 0.0)
        covariance = (weight * autocorrelation(direction)).sum(axis=(1, 2))
        covariance /= np.maximum((weight.sum(axis=-1) * pairs).sum(axis=-1), 1e-9)
        products = autocorrelation(v).sum(axis=(1, 2))
        # Never less than the variance of independent errors.
        independent = float(products[0] * covariance[0])
        variance = max(float(2 * covariance @ products) - independent, independent)
        share = variance / (products[0] * max(float((direction**2).sum()), 1e-300))
        return float(np.sqrt(variance) * widening(np.array(share)) / curvature)

    @staticmethod
    def _curvature(
        v: Float[np.ndarray, "frames drones 3"],
        direction: Float[np.ndarray, "frames drones 3"],
        distance_m: Float[np.ndarray, "frames drones"],
    ) -> float:
        """Second derivative of the summed distance by the offset, metres per squared second.

        The second derivative of |r + v t| is (v² - (v · r / |r|)²) / |r|. For residuals of any direction its mean is
        2/3 v² / |r|. The smaller sum of the two is returned, because residuals along the motion make the minimum
        flatter; but at least half of the mean, because residuals exactly along the motion make a kink, not a flat
        minimum.
        """
        squared = (v**2).sum(axis=-1)
        mean = np.where(squared > 0, 2 / 3 * squared / distance_m, 0.0)
        actual = np.where(squared > 0, (squared - (v * direction).sum(axis=-1) ** 2) / distance_m, 0.0)
        return float(np.clip(actual.sum(), mean.sum() / 2, mean.sum()))

    def _residual_m(
        self, offset_s: float, partner: Int[np.ndarray, "drones"]
    ) -> Float[np.ndarray, "frames drones 3"]:
        time_s = self.time_s + offset_s
        residual_m = fixed_partner_values(self.est_m, partner) - self.position_m(time_s)
        if self.rotation is None:
            return residual_m
        return np.einsum("fdji,fdj->fdi", self.rotation(time_s), residual_m)

    def _without_arms(self, residual_m: Float[np.ndarray, "frames drones 3"]) -> Residuals:
        arm_m = _medians(residual_m)
        if not self.with_lever_arm:
            arm_m = 0.0 * arm_m
        return Residuals(arm_m, residual_m - arm_m)


def shifted(
    reference: Trajectories,
    offset_s: float,
    frame: Int[np.ndarray, "frames"],
    time_s: Float[np.ndarray, "frames"],
) -> Trajectories:
    """Interpolate a reference at the frames of a video, if the reference's clock is ahead by the offset.

    Positions and orientations are interpolated by cubic splines; they are NaN outside of the reference and in its gaps.

    Args:
        reference: reference with the times of its own clock, at its own rate, with at least two samples.
        offset_s: the reference at time t + offset_s belongs to the video at time t, seconds.
        frame: (frames,), numbers of the video's frames.
        time_s: (frames,), times of the video's frames, seconds.
    """
    return resample(reference, frame, time_s, later_s=offset_s)


def _medians(values: Float[np.ndarray, "frames drones 3"]) -> Float[np.ndarray, "drones 3"]:
    """Geometric median of each drone's values, by a few iterations of E. Weiszfeld (1937); NaN without values."""
    found = np.full(values.shape[1:], np.nan)
    known = np.isfinite(values).all(axis=-1)
    for drone in np.flatnonzero(known.any(axis=0)):
        there = values[known[:, drone], drone]
        median = np.median(there, axis=0)
        for _ in range(_MEDIAN_STEPS):
            weight = 1 / np.maximum(np.linalg.norm(there - median, axis=-1), 1e-9)
            median = weight @ there / weight.sum()
        found[drone] = median
    return found


def refused(expected: str, found: str, remedy: str = "") -> InputError:
    """The error that an estimate and a reference cannot be compared."""
    return InputError("estimate and reference", expected=expected, found=found, remedy=remedy)
