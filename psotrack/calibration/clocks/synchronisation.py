"""The offset between the clocks of a reference and of a video, found from the motion of the drones.

The paper (technical validation, "ArUco markers") lays the reconstructed path on successive points of the reference and
takes the offset with the smallest mean distance. This is the first step here. The second step interpolates the
reference and finds the minimum between its samples. Every drone has a constant lever arm from the reference's point to
the tracked point. The lever arm is subtracted at every offset: for a drone that flies in one direction, a lever arm
would look like an offset in time.

Offsets between cameras are found in `camera_clocks`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from psotrack.calibration.clocks.camera_clocks import CameraOffsets, camera_offsets
from psotrack.calibration.clocks.time_shift import ShiftedPair, refused, shifted
from psotrack.errors import InputError, SettingsError
from psotrack.recordings import Recording
from psotrack.support import COLOURS, save_figure, standard_error
from psotrack.trajectories import Trajectories

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "CameraOffsets",
    "Offset",
    "camera_offsets",
    "find_offset",
    "own_reference",
    "save_curve",
    "shifted",
]

#: An offset counts only if at least this share of the largest number of comparable positions can be compared at it.
MIN_OVERLAP = 0.5
#: Another minimum is worse for certain if its distance is larger by this multiple of the difference's standard error.
_CLEARLY = 3.0


@dataclass(frozen=True)
class Offset:
    """Offset of the reference's clock from the estimate's clock, and its standard deviation.

    Attributes:
        offset_s: the reference at time t + offset_s belongs to the estimate at time t, seconds.
        std_s: standard deviation of the offset, from the motion and the remaining distances, seconds.
        mean_distance_m: mean distance over frames and drones at this offset, without the lever arms, metres.
        mean_distance_before_m: mean distance at offset 0, metres; None if too few positions can be compared.
        lever_arm_m: (drones, 3), vectors from the reference's point to the tracked point, metres; in the body frame if
            orientations were given, else in the world; NaN for drones that were not compared.
        partner: (drones,), index of the estimated drone that is assigned to each drone of the reference, or
            `UNASSIGNED`.
        overlap: share of the estimate's positions that were compared.
        curve_s: (offsets,), offsets that were tried, seconds: whole samples of the reference.
        curve_m: (offsets,), mean distances at these offsets, without the lever arms, metres; NaN if too few positions
            can be compared.
    """

    offset_s: float
    std_s: float
    mean_distance_m: float
    mean_distance_before_m: float | None
    lever_arm_m: Float[np.ndarray, "drones 3"]
    partner: Int[np.ndarray, "drones"]
    overlap: float
    curve_s: Float[np.ndarray, "offsets"]
    curve_m: Float[np.ndarray, "offsets"]


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
    comparison = ShiftedPair.of(
        estimate, reference_time_s, reference_position_m, reference_orientation_wxyz, with_lever_arm
    )
    step_s = float(np.median(np.diff(reference_time_s)))
    frame_s = float(np.median(np.diff(estimate.time_s)))
    if not step_s <= max_offset_s < np.inf:
        expected = f"a step of the reference, {step_s:g} s, or more"
        raise SettingsError("max_offset_s", expected=expected, found=f"{max_offset_s:g}")
    # The small addition is for rounding errors.
    steps = int(max_offset_s / step_s + 1e-6)
    curve_s = step_s * np.arange(-steps, steps + 1)
    curve_m = _curve(comparison, curve_s)
    best = int(np.nanargmin(curve_m))
    if not (0 < best < 2 * steps) or not np.isfinite(curve_m[best - 1 : best + 2]).all():
        raise refused(
            f"the least distance within {max_offset_s:g} s",
            f"the least distance at an end of the range, {curve_s[best]:+.3g} s",
            "widen the range; if the drones hover, their motion does not determine the offset",
        )
    partner = comparison.without_far(curve_s[best])
    offset_s = comparison.least(partner, curve_s[best], max(step_s, frame_s))
    found = comparison.at(offset_s, partner)
    std_s = comparison.standard_deviation_s(offset_s, partner)
    if not std_s < frame_s:
        raise refused(
            f"motion that determines the offset to a frame, {frame_s:g} s",
            f"a standard deviation of {std_s:.2g} s",
            "use more of the recording: drones that hover, or fly straight at constant speed, do not determine it",
        )
    error_m = standard_error(found.per_frame_m[:, None], estimate.frame)[0]
    _check_unique(curve_s, curve_m, float(error_m), frame_s)
    before_m = float(curve_m[steps])
    return Offset(
        offset_s=offset_s,
        std_s=std_s,
        mean_distance_m=found.mean_m,
        mean_distance_before_m=before_m if np.isfinite(before_m) else None,
        lever_arm_m=found.arm_m,
        partner=partner,
        overlap=found.count / int(estimate.seen.sum()),
        curve_s=curve_s,
        curve_m=curve_m,
    )


def own_reference(recording: Recording) -> Trajectories:
    """The reference of a recording at its own rate, with orientations only if every position has one.

    Raises:
        InputError: the recording has no reference.
    """
    known = recording.reference
    if known is None:
        raise InputError(recording.folder, expected="a reference to synchronise with", found="none")
    reference = known.truth if known.own is None else known.own
    if reference.orientation_wxyz is not None:
        turned = np.isfinite(reference.orientation_wxyz).all(axis=-1)
        if not turned[reference.seen].all():
            return replace(reference, orientation_wxyz=None)
    return reference


def save_curve(path: str | Path, offset: Offset, *, force: bool = False) -> None:
    """Save a PNG with the mean distance at each offset, and a mark at the offset that was found.

    Raises:
        OutputError: the file exists and `force` is not set, or the file cannot be written.
    """

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.plot(offset.curve_s, 1e3 * offset.curve_m, color=COLOURS[0], linewidth=1.2)
        axes.plot(offset.offset_s, 1e3 * offset.mean_distance_m, "o", color=COLOURS[1], markersize=5)
        axes.annotate(
            f"{offset.offset_s:+.4f} s, {1e3 * offset.mean_distance_m:.1f} mm",
            (offset.offset_s, 1e3 * offset.mean_distance_m),
            (14, 12),
            textcoords="offset points",
        )
        axes.set_xlabel("offset of the reference (s)")
        axes.set_ylabel("mean distance (mm)")
        axes.set_ylim(bottom=0)

    save_figure(Path(path), (8.0, 4.0), draw, force)


def _curve(comparison: ShiftedPair, curve_s: Float[np.ndarray, "offsets"]) -> Float[np.ndarray, "offsets"]:
    """Mean distance at each offset, metres; NaN where too few positions can be compared (`MIN_OVERLAP`)."""
    tried = [comparison.at(offset_s, comparison.partner(offset_s)) for offset_s in curve_s]
    count = np.array([one.count for one in tried])
    if not count.any():
        raise refused(f"positions of both at offsets within {curve_s[-1]:g} s", "none")
    enough = count >= np.maximum(MIN_OVERLAP * count.max(), 1)
    return np.where(enough, [one.mean_m for one in tried], np.nan)


def _check_unique(
    curve_s: Float[np.ndarray, "offsets"],
    curve_m: Float[np.ndarray, "offsets"],
    error_m: float,
    frame_s: float,
) -> None:
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
