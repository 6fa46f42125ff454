"""The offset between the clocks of an estimate and of its reference, found from motion: the package's only finder.

The paper (technical validation, "ArUco markers") lays the reconstructed path on successive points of the reference and
takes the offset with the smallest mean distance. This is the first step here. The second step interpolates the
reference and finds the minimum between the steps. Every drone has a constant lever arm from the reference's point to
the tracked point. The lever arm is subtracted at every offset: for a drone that flies in one direction, a lever arm
would look like an offset in time. Orientations are compared by the same search (`path_comparison`): points on the
estimate's axes are at rest in the reference's body.

The standard deviation is a block jackknife, because errors of neighbouring frames are correlated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment, minimize_scalar

from psotrack.errors import InputError, SettingsError
from psotrack.support import block_jackknife, standard_error, time_blocks, widening
from psotrack.trajectories import GATE_M, UNASSIGNED, Trajectories, fixed_partner_values, rotation_matrices
from psotrack.trajectories.resampling import interpolated

_Vectors = Float[np.ndarray, "frames drones 3"]
_Partner = Int[np.ndarray, "drones"]
_Curve = Float[np.ndarray, "offsets"]
_Arms = Float[np.ndarray, "drones 3"]
#: An offset counts only if at least this fraction of the largest number of comparable positions is compared at it.
MIN_OVERLAP = 0.5
#: Another minimum is worse for certain if its distance is larger by this multiple of the difference's standard error.
_CLEARLY = 3.0
#: Velocities are differences over this time before and after a frame, seconds: shorter times would show noise.
_MOTION_S = 0.1
#: Precision of the offset at the minimum, seconds: far below the standard deviations that noise allows.
_PRECISION_S = 1e-6
#: Number of iterations of a geometric median, by E. Weiszfeld (1937), and of the estimates without a block.
_MEDIAN_STEPS, _BLOCK_STEPS = 5, 15
#: Smallest distance that is divided by, metres.
_LEAST_M = 1e-9

_At = Callable[[Float[np.ndarray, "times"]], np.ndarray]


@dataclass(frozen=True)
class Offset:
    """Offset of the reference's clock from the estimate's clock, and its standard deviation.

    Attributes:
        offset_s: the reference at time t + offset_s belongs to the estimate at time t, seconds.
        std_s: standard deviation of the offset, from the motion and the remaining distances, seconds.
        mean_distance_m: mean distance over frames and drones at this offset, without the lever arms, metres.
        mean_distance_before_m: mean distance at the middle of the range, usually offset 0, metres; None if too few
            positions can be compared.
        lever_arm_m: (drones, 3), vectors from the reference's point to the tracked point, metres; in the body frame if
            orientations were given, else in the world; NaN for drones that were not compared.
        partner: (drones,), index of the estimated drone that is assigned to each drone of the reference, or
            `UNASSIGNED`.
        overlap: fraction of the estimate's positions that were compared.
        curve_s: (offsets,), offsets that were tried, seconds: a frame apart, or a sample of a slower reference.
        curve_m: (offsets,), mean distances at these offsets, without the lever arms, metres; NaN if too few positions
            can be compared.
    """

    offset_s: float
    std_s: float
    mean_distance_m: float
    mean_distance_before_m: float | None
    lever_arm_m: _Arms
    partner: _Partner
    overlap: float
    curve_s: _Curve
    curve_m: _Curve


def find_offset(
    estimate: Trajectories,
    reference_time_s: Float[np.ndarray, "samples"],
    reference_position_m: Float[np.ndarray, "samples drones 3"],
    reference_orientation_wxyz: Float[np.ndarray, "samples drones 4"] | None = None,
    *,
    max_offset_s: float,
    with_lever_arm: bool = True,
) -> Offset:
    """Find the offset between the clocks of an estimate and of its reference, to a fraction of a frame.

    At every offset, the estimated drones are assigned to the reference's drones so that the sum of mean distances is
    smallest. Then each drone's lever arm, the median of its residuals, is subtracted, and the remaining distances are
    averaged. Drones whose lever arm at the best offset is longer than half a metre are left out, unless all are longer.

    Args:
        estimate: trajectories at the times of the video; lost drones do not count.
        reference_time_s: (samples,), times of the reference's own clock, at its own rate, seconds.
        reference_position_m: (samples, drones, 3), positions in the world, metres; NaN where missing.
        reference_orientation_wxyz: (samples, drones, 4), unit quaternions, body to world. With orientations, the lever
            arms turn with the drones, and positions without an orientation do not count. Without orientations, a lever
            arm along the motion is taken for an offset in time.
        max_offset_s: largest offset that is tried, forwards and backwards, seconds.
        with_lever_arm: allow each drone a constant lever arm.

    Raises:
        SettingsError: `max_offset_s` is smaller than a sample interval of the reference.
        InputError: times do not increase, no positions can be compared, the smallest distance is at an end of the
            range, the motion repeats so that another offset fits as well, or the offset's standard deviation is above
            one frame: the drones hover, or fly straight on at constant speed.
    """
    pair = ShiftedPair.of(
        estimate, reference_time_s, reference_position_m, reference_orientation_wxyz, with_lever_arm
    )
    return pair.search(0.0, max_offset_s)


@dataclass(frozen=True)
class ShiftedPair:
    """An estimate, and a reference that is interpolated at any offset of its clock.

    Attributes:
        time_s: (frames,), times of the estimate's frames, seconds.
        est_m: (frames, estimates, 3), estimated positions, metres; NaN for lost drones.
        step_s: interval of the reference's samples, seconds.
        position_m: function from times (times,) of the reference's clock to positions (times, drones, 3), metres; NaN
            where the reference is missing.
        rotation: function from an offset to rotations (frames, drones, 3, 3) from the lever arms' frame to the world;
            None if the lever arms are in the world.
        with_lever_arm: allow each drone a constant lever arm.
    """

    time_s: Float[np.ndarray, "frames"]
    est_m: Float[np.ndarray, "frames estimates 3"]
    step_s: float
    position_m: _At
    rotation: Callable[[float], np.ndarray] | None
    with_lever_arm: bool

    @staticmethod
    def of(
        estimate: Trajectories,
        time_s: Float[np.ndarray, "samples"],
        position_m: Float[np.ndarray, "samples drones 3"],
        orientation_wxyz: Float[np.ndarray, "samples drones 4"] | None,
        with_lever_arm: bool,
    ) -> ShiftedPair:
        """Interpolate the samples of a reference; arguments: see `find_offset`.

        Raises:
            InputError: the reference's times do not increase, or one of both has fewer than two times.
        """
        if len(time_s) < 2 or not (np.diff(time_s) > 0).all():
            raise refused("a reference at two increasing times or more", f"{len(time_s)} times")
        if estimate.num_frames < 2:
            raise refused("an estimate of two frames or more", f"{estimate.num_frames}")
        video_s = estimate.time_s.astype(np.float64)
        turned = (
            None if orientation_wxyz is None else interpolated(time_s, rotation_matrices(orientation_wxyz))
        )
        return ShiftedPair(
            video_s,
            np.where(estimate.seen[..., None], estimate.position_m, np.nan).astype(np.float64),
            float(np.median(np.diff(time_s))),
            interpolated(time_s, position_m),
            None if turned is None else lambda offset_s: turned(video_s + offset_s),
            with_lever_arm,
        )

    def search(self, middle_s: float, reach_s: float) -> Offset:
        """The offset with the smallest mean distance, at most `reach_s` from `middle_s`, seconds.

        Raises:
            SettingsError, InputError: see `find_offset`.
        """
        frame_s = float(np.median(np.diff(self.time_s)))
        if not self.step_s <= reach_s < np.inf:
            expected = f"a step of the reference, {self.step_s:g} s, or more"
            raise SettingsError("max_offset_s", expected=expected, found=f"{reach_s:g}")
        steps = int(np.ceil(reach_s / min(max(self.step_s, frame_s), reach_s) - 1e-6))
        step_s = reach_s / steps
        curve_s = middle_s + step_s * np.arange(-steps, steps + 1)
        curve_m = self._curve(curve_s, reach_s)
        best = int(np.nanargmin(curve_m))
        if not (0 < best < 2 * steps) or not np.isfinite(curve_m[best - 1 : best + 2]).all():
            raise refused(
                f"the least distance within {reach_s:g} s",
                f"the least distance at an end of the range, {curve_s[best]:+.3g} s",
                "widen the range; if the drones hover, their motion does not determine the offset",
            )
        partner = self.without_far(curve_s[best])
        offset_s = self._least(partner, curve_s[best], step_s)
        arm_m, residual_m = self.residuals(offset_s, partner)
        std_s = self._standard_deviation_s(offset_s, arm_m, residual_m)
        if not std_s < frame_s:
            raise refused(
                f"motion that determines the offset to a frame, {frame_s:g} s",
                f"a standard deviation of {std_s:.2g} s",
                "use more of the recording: drones that hover, or fly straight at constant speed, do not determine it",
            )
        distance_m = np.linalg.norm(residual_m, axis=-1)
        _check_unique(curve_s, curve_m, float(standard_error(_per_frame(distance_m))[0]), frame_s)
        before_m = float(curve_m[steps])
        return Offset(
            offset_s=offset_s,
            std_s=std_s,
            mean_distance_m=float(np.nanmean(distance_m)),
            mean_distance_before_m=before_m if np.isfinite(before_m) else None,
            lever_arm_m=arm_m,
            partner=partner,
            overlap=int(np.isfinite(distance_m).sum()) / int(np.isfinite(self.est_m).all(axis=-1).sum()),
            curve_s=curve_s,
            curve_m=curve_m,
        )

    def partner(self, offset_s: float) -> _Partner:
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

    def without_far(self, offset_s: float) -> _Partner:
        """The assignment without drones whose lever arm is longer than the gate, unless all are longer."""
        partner = self.partner(offset_s)
        near = np.linalg.norm(_medians(self._differences_m(offset_s, partner)), axis=-1) <= GATE_M
        return np.where(near, partner, UNASSIGNED) if near.any() else partner

    def residuals(self, offset_s: float, partner: _Partner) -> tuple[_Arms, _Vectors]:
        """Lever arms, and the differences between estimate and reference without them, in the arms' frame, metres.

        NaN where the estimate or the reference is missing, and for drones that are not compared.
        """
        return self._without_arms(self._differences_m(offset_s, partner))

    def _curve(self, curve_s: _Curve, reach_s: float) -> _Curve:
        """Mean distance at each offset, metres; NaN where too few positions can be compared (`MIN_OVERLAP`)."""
        mean_m, count = np.full(len(curve_s), np.nan), np.zeros(len(curve_s), int)
        for row, offset_s in enumerate(curve_s):
            distance_m = np.linalg.norm(self.residuals(offset_s, self.partner(offset_s))[1], axis=-1)
            count[row] = np.isfinite(distance_m).sum()
            if count[row]:
                mean_m[row] = np.nanmean(distance_m)
        if not count.any():
            raise refused(f"positions of both at offsets within {reach_s:g} s", "none")
        return np.where(count >= MIN_OVERLAP * count.max(), mean_m, np.nan)

    def _least(self, partner: _Partner, near_s: float, reach_s: float) -> float:
        """The offset with the smallest mean distance between near_s - reach_s and near_s + reach_s, by Brent's method.

        Only positions count that can be compared at both ends: a position that can be compared at some offsets only
        would make a step in the mean.
        """
        low_s, high_s = near_s - reach_s, near_s + reach_s
        outside = np.isnan(self._differences_m(low_s, partner) + self._differences_m(high_s, partner))

        def mean_m(offset_s: float) -> float:
            differences_m = np.where(outside, np.nan, self._differences_m(offset_s, partner))
            return float(np.nanmean(np.linalg.norm(self._without_arms(differences_m)[1], axis=-1)))

        found = minimize_scalar(
            mean_m, bounds=(low_s, high_s), method="bounded", options={"xatol": _PRECISION_S}
        )
        return float(found.x)

    def _standard_deviation_s(self, offset_s: float, arm_m: _Arms, residual_m: _Vectors) -> float:
        """Standard deviation of the offset, by a block jackknife, seconds; infinite without motion.

        An error that always points along the motion is not included, because such an error looks like an offset.
        """
        ends_m = [self.placed_m(offset_s + sign * _MOTION_S, arm_m) for sign in (-1, 1)]
        velocity_m_s = (ends_m[0] - ends_m[1]) / (2 * _MOTION_S)
        if self.rotation is not None:
            velocity_m_s = _turned_back(self.rotation(offset_s), velocity_m_s)
        there = np.isfinite(velocity_m_s).all(axis=-1) & np.isfinite(residual_m).all(axis=-1)
        r, v = (np.where(there[..., None], values, 0.0) for values in (residual_m, velocity_m_s))
        # A constant velocity only changes the lever arm, so it does not show the offset.
        mean_v = v.sum(axis=0) / np.maximum(there.sum(axis=0), 1)[:, None] if self.with_lever_arm else 0.0
        information = np.where(there, ((v - mean_v) ** 2).sum(axis=-1), 0.0)
        block = time_blocks(there)
        weight = np.bincount(block[there], information[there], minlength=2)
        moving = np.flatnonzero(weight > 1e-6 * weight.sum())
        if len(moving) < 2:
            return np.inf
        left_s = np.array([self._step_s(r, v, there & (block != one)) for one in moving])
        variance_s2 = block_jackknife(np.array([self._step_s(r, v, there)]), left_s[:, None], weight[moving])
        freedom = weight.sum() ** 2 / (weight**2).sum() - 1
        return float(np.sqrt(variance_s2[0, 0]) * widening(np.array(freedom)))

    def _step_s(self, r: _Vectors, v: _Vectors, kept: np.ndarray) -> float:
        """The change of the offset that makes the sum of |r + v change - arm| smallest, by reweighted least squares."""
        change_s, arm_m = 0.0, np.zeros((1, r.shape[1], 3))
        for _ in range(_BLOCK_STEPS):
            left_m = r + v * change_s - arm_m
            w = (kept / np.maximum(np.linalg.norm(left_m, axis=-1), _LEAST_M))[..., None]
            mean_r, mean_v = (
                (w * values).sum(axis=0, keepdims=True) / np.maximum(w.sum(axis=0, keepdims=True), 1e-300)
                if self.with_lever_arm
                else np.zeros_like(arm_m)
                for values in (r, v)
            )
            squares = float((w * (v - mean_v) ** 2).sum())
            change_s = -float((w * (v - mean_v) * (r - mean_r)).sum()) / max(squares, 1e-300)
            arm_m = mean_r + mean_v * change_s
        return change_s

    def placed_m(self, offset_s: float, arm_m: _Arms) -> _Vectors:
        """The tracked points by the reference, with the lever arms, in the world."""
        point_m = self.position_m(self.time_s + offset_s)
        return point_m + (
            arm_m if self.rotation is None else np.einsum("fdij,dj->fdi", self.rotation(offset_s), arm_m)
        )

    def _differences_m(self, offset_s: float, partner: _Partner) -> _Vectors:
        difference_m = fixed_partner_values(self.est_m, partner) - self.position_m(self.time_s + offset_s)
        return difference_m if self.rotation is None else _turned_back(self.rotation(offset_s), difference_m)

    def _without_arms(self, differences_m: _Vectors) -> tuple[_Arms, _Vectors]:
        arm_m = _medians(differences_m)
        if not self.with_lever_arm:
            arm_m = np.abs(0.0 * arm_m)
        return arm_m, differences_m - arm_m


def refused(expected: str, found: str, remedy: str = "") -> InputError:
    """The error that an estimate and a reference cannot be compared."""
    return InputError("estimate and reference", expected=expected, found=found, remedy=remedy)


def _turned_back(rotation: Float[np.ndarray, "frames drones 3 3"], values: _Vectors) -> _Vectors:
    return np.einsum("fdji,fdj->fdi", rotation, values)


def _per_frame(distance_m: Float[np.ndarray, "frames drones"]) -> Float[np.ndarray, "frames 1"]:
    """Mean distance of the drones in each frame; NaN for a frame without compared drones."""
    count = np.isfinite(distance_m).sum(axis=1)
    return np.where(count > 0, np.nansum(distance_m, axis=1) / np.maximum(count, 1), np.nan)[:, None]


def _check_unique(curve_s: _Curve, curve_m: _Curve, error_m: float, frame_s: float) -> None:
    """Raise an error if the distance is not clearly larger at another offset, apart from the best offset."""
    low_s = curve_s[curve_m <= np.nanmin(curve_m) + _CLEARLY * np.sqrt(2) * error_m]
    apart = np.diff(low_s) > max(frame_s, 1.5 * (curve_s[1] - curve_s[0]))
    if apart.any():
        place = int(np.argmax(apart))
        raise refused(
            "one offset that fits best",
            f"both {low_s[place]:+.2f} s and {low_s[place + 1]:+.2f} s",
            "the motion repeats: narrow the range",
        )


def _medians(values: _Vectors) -> _Arms:
    """Geometric median of each drone's values; NaN without values."""
    found = np.full(values.shape[1:], np.nan)
    known = np.isfinite(values).all(axis=-1)
    for drone in np.flatnonzero(known.any(axis=0)):
        there = values[known[:, drone], drone]
        median = np.median(there, axis=0)
        for _ in range(_MEDIAN_STEPS):
            weight = 1 / np.maximum(np.linalg.norm(there - median, axis=-1), _LEAST_M)
            median = weight @ there / weight.sum()
        found[drone] = median
    return found
