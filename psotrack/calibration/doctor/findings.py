"""Findings in words: what disagrees, by how much, and what to do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from psotrack.calibration.doctor.camera_faults import CameraFault, pose_difference
from psotrack.calibration.doctor.evidence import Judged
from psotrack.calibration.doctor.fault_search import FoundFault
from psotrack.calibration.doctor.hypotheses import parameters_of
from psotrack.calibration.doctor.reference_fit import NEAR_M, ReferenceFit
from psotrack.geometry import Rig

#: Smallest gain of a fault, as a share of the camera's points: six parameters fitted to 30 points of a correct camera
#: gain 0.015 by chance.
CLEARLY = 0.05
#: The simpler of two explanations is taken if its gain is at least this share of the larger gain.
ALMOST = 0.9
#: Smallest relative difference between the scales of rig and reference that is reported: focal lengths are known to a
#: few per cent.
SAME_SCALE = 0.03
#: What to do about a camera's place, and about its lens.
_PLACE_ANEW = (
    "place it anew with `psotrack calibrate rig --pairs`, or all cameras with `psotrack calibrate rig`"
)
_LENS_ANEW = "calibrate its lens anew with `psotrack calibrate intrinsics`"
_LENSES_ANEW = "calibrate each lens anew with `psotrack calibrate intrinsics`"


@dataclass(frozen=True)
class Finding:
    """A disagreement between the rig and its recording.

    Attributes:
        kind: short name of the kind of disagreement, for programs.
        cameras: names of the concerned cameras; empty if all cameras or the reference are concerned.
        message: what disagrees, and by how much.
        remedy: what to do.
        nearly_as_likely: other kinds of faults of the same camera that explain the detections nearly as well.
    """

    kind: str
    cameras: tuple[str, ...]
    message: str
    remedy: str
    nearly_as_likely: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.message}; {self.remedy}"


def describe_camera_fault(rig: Rig, index: int, explained: list[CameraFault], fps: float) -> Finding:
    """Describe the simplest explanation whose gain is almost as large as the largest gain."""
    name, sound = rig.names[index], explained[0]
    best = max(each.gain for each in explained)
    fault = next(each for each in explained if each.gain - sound.gain >= ALMOST * (best - sound.gain))
    if best - sound.gain <= CLEARLY:
        message = f"camera {name}: it explains {sound.gain:.0%} of the drones that the others see; no correction helps"
        return Finding("disagrees", (name,), message, f"leave {name} out with --cameras, or {_PLACE_ANEW}")
    numbers = f"(explains {fault.gain:.0%} of the drones that the others see, not {sound.gain:.0%})"
    if fault.kind == "clock":
        late = "late" if fault.amount > 0 else "early"
        message = f"camera {name}: its video is about {1e3 * abs(fault.amount) / fps:.0f} ms {late} {numbers}"
        return Finding("clock", (name,), message, _clock_remedy(fault.amount / fps))
    if fault.kind == "focal length":
        percent = 100 * (1 / fault.amount - 1)
        how = f"{abs(percent):.0f} % too {'short' if percent < 0 else 'long'}"
        message = f"camera {name}: its focal length is {how} {numbers}"
        f_px = fault.camera.K[0, 0]
        return Finding("focal length", (name,), message, f"try {f_px:.0f} px, or {_LENS_ANEW}")
    if fault.kind == "exchanged":
        other = rig.names[int(fault.amount)]
        message = f"camera {name}: what it sees fits the calibration of {other} {numbers}"
        return Finding(
            "exchanged", (name, other), message, "check which video and detections belong to which camera"
        )
    turn_deg, shift_m = pose_difference(rig.cameras[index], fault.camera)
    how = f"turned by {turn_deg:.1f} degrees" + (
        f" and moved by {100 * shift_m:.0f} cm" if fault.kind == "moved" else ""
    )
    centre = ", ".join(f"{value:.2f}" for value in fault.camera.centre_world)
    remedy = f"{_PLACE_ANEW}; the drones put it at ({centre}) m"
    return Finding(fault.kind, (name,), f"camera {name}: it is {how} {numbers}", remedy)


def describe_fault(rig: Rig, fault: FoundFault, fps: float) -> Finding:
    """Describe a small fault, or the faults of several cameras that explain the sightings equally well."""
    words, remedy = _in_words(rig, fault.best, fps)
    numbers = f"which moves its boxes by {fault.shift_px:.0f} px"
    hypothesis = fault.best.hypothesis
    if not fault.certain:
        several = [_in_words(rig, one, fps)[0] for one in (fault.best, *fault.as_well)]
        names = tuple(
            dict.fromkeys(
                rig.names[one.hypothesis.camera]
                for one in (fault.best, *fault.as_well)
                if one.hypothesis.camera >= 0
            )
        )
        message = (
            f"the cameras disagree, and these faults explain it about equally well: {'; or '.join(several)}"
        )
        return Finding("unclear", names, message, "none is certain: check these cameras, or use more cameras")
    if fault.as_well:
        others = " or ".join(_in_words(rig, one, fps)[0].split(": ")[1] for one in fault.as_well)
        numbers += f"; nearly as likely, {others}"
    kind, *also = (_kind(one.hypothesis.kind) for one in (fault.best, *fault.as_well))
    names = () if hypothesis.camera < 0 else (rig.names[hypothesis.camera],)
    other_kinds = tuple(other for other in dict.fromkeys(also) if other != kind)
    return Finding(kind, names, f"{words}, {numbers}", remedy, other_kinds)


def _clock_remedy(late_s: float) -> str:
    """What to do about a camera that is late by some seconds."""
    return f"track with --clocks auto, which finds it to a millisecond or so; or add {-late_s:.4f} to its time_offset_s"


def _kind(kind: str) -> str:
    return "moved" if kind == "turned and moved" else kind


def _in_words(rig: Rig, judged: Judged, fps: float) -> tuple[str, str]:
    """What is wrong and by how much, and what to do."""
    hypothesis, camera = judged.hypothesis, judged.hypothesis.camera
    if camera < 0:
        scale, scale_std = float(np.exp(judged.step[-1])), float(judged.std[-1])
        how = f"{100 * abs(1 / scale - 1):.0f} % too {'short' if scale > 1 else 'long'} (± {100 * scale_std:.1f} %)"
        words = f"the calibration: all focal lengths are {how}"
        return words, f"multiply them by {scale:.3f}, or {_LENSES_ANEW}"
    name = rig.names[camera]
    step, std = parameters_of(judged.step, camera), parameters_of(judged.std, camera)
    if hypothesis.kind == "clock":
        lag, how = float(step[7]), "late" if step[7] > 0 else "early"
        size_ms, std_ms = 1e3 * abs(lag) / fps, 1e3 * float(std[7]) / fps
        return f"camera {name}: its video is {size_ms:.0f} ms {how} (± {std_ms:.0f} ms)", _clock_remedy(
            lag / fps
        )
    if hypothesis.kind == "focal length":
        scale = float(np.exp(step[6]))
        how = f"{100 * abs(1 / scale - 1):.1f} % too {'short' if scale > 1 else 'long'} (± {100 * std[6]:.1f} %)"
        f_px = scale * rig.cameras.K[camera, 0, 0]
        return (
            f"camera {name}: its focal length is {how}",
            f"try {f_px:.0f} px, or {_LENS_ANEW}",
        )
    turn_deg, way_m = np.rad2deg(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:6]))
    parts = [f"turned by {turn_deg:.1f} degrees"] if turn_deg else []
    parts += [f"moved by {100 * way_m:.0f} cm"] if way_m else []
    centre = ", ".join(f"{value:.2f}" for value in rig.cameras.centre_world[camera] + step[3:6])
    remedy = f"{_PLACE_ANEW}; the boxes put it at ({centre}) m"
    return f"camera {name}: it is {' and '.join(parts)}", remedy


def describe_reference(fit: ReferenceFit, fps: float) -> list[Finding]:
    """Describe how the reference disagrees with the rig; an empty list if they agree."""
    if fit.agrees and fit.before_m < NEAR_M:
        return []
    numbers = f"(median distance to the detections' points {fit.after_m:.2f} m, not {fit.before_m:.2f} m)"
    if fit.agrees:
        message = f"the reference: it is {fit.before_m:.2f} m from what the cameras see, at the median"
        remedy = "no clock, unit or motion explains it: check that it is of this flight"
        return [Finding("reference", (), message, remedy)]
    if fit.offset_frames:
        frames, seconds = abs(fit.offset_frames), abs(fit.offset_frames) / fps
        where = "ahead of" if fit.offset_frames > 0 else "behind"
        message = (
            f"the reference: its clock is {frames} frames ({seconds:.2f} s) {where} the videos' {numbers}"
        )
        remedy = "find it to a fraction of a frame with `psotrack doctor --tracks`"
        return [Finding("reference clock", (), message, remedy)]
    kind, how = _motion_of(fit)
    remedy = "bring both into one world"
    if kind == "reference unit" and abs(abs(np.log10(fit.scale)) - 3) < 0.05:
        remedy = "one of them is in millimetres and was read as metres: name the right unit"
    return [Finding(kind, (), f"the reference: against the rig it is {how} {numbers}", remedy)]


def _motion_of(fit: ReferenceFit) -> tuple[str, str]:
    """The kind of the largest difference between reference and rig, and a description of all differences."""
    parts, kind = [], "reference moved"
    diagonal = np.diag(fit.R)
    turn_deg = np.rad2deg(np.arccos(np.clip((np.trace(fit.R) - 1) / 2, -1, 1)))
    if abs(fit.scale - 1) > SAME_SCALE:
        kind = "reference unit"
        parts.append(f"{fit.scale:.4g} times as large")
    if np.linalg.det(fit.R) < 0:
        kind = "reference mirrored"
        axes = ", ".join(axis for axis, value in zip("xyz", diagonal, strict=True) if value < 0)
        parts.append("mirrored" + (f" in {axes}" if np.abs(diagonal).min() > 0.95 else ""))
    elif turn_deg > 2:
        parts.append(f"turned by {turn_deg:.0f} degrees")
    if np.linalg.norm(fit.shift_m) / fit.scale > NEAR_M / 3 or not parts:
        parts.append("shifted by ({:.2f}, {:.2f}, {:.2f}) m".format(*fit.shift_m))
    return kind, ", ".join(parts)
