"""Findings in words: what disagrees, by how much, and what to do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from psotrack.calibration.doctor.camera_faults import CameraFault
from psotrack.calibration.doctor.corrections import Corrected
from psotrack.calibration.doctor.evidence import Judged
from psotrack.calibration.doctor.fault_search import FoundFault
from psotrack.calibration.doctor.reference_fit import NEAR_M, ReferenceFit
from psotrack.geometry import Camera, Rig

#: Smallest gain of a fault, as a fraction of the camera's points: six parameters fitted to 30 points of a correct
#: camera gain 0.015 by chance.
_CLEARLY = 0.05
#: The simpler of two explanations is taken if its gain is at least this fraction of the larger gain.
_ALMOST = 0.9
#: Smallest relative difference between the scales of rig and reference that is reported: focal lengths are known to a
#: few per cent.
_SAME_SCALE = 0.03
#: What to do about a camera's place, and about its lens.
_PLACE_ANEW = (
    "place it anew with `psotrack calibrate rig --pairs`, or all cameras with `psotrack calibrate rig`"
)
_LENS_ANEW = "calibrate its lens anew with `psotrack calibrate intrinsics`"


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
    name, sound = rig.names[index], explained[0].explained
    best = max(each.explained for each in explained)
    if best - sound <= _CLEARLY:
        message = (
            f"camera {name}: it explains {sound:.0%} of the drones that the others see; no correction helps"
        )
        return Finding("disagrees", (name,), message, f"leave {name} out with --cameras, or {_PLACE_ANEW}")
    fault = next(each for each in explained if each.explained - sound >= _ALMOST * (best - sound))
    words, remedy = _in_words(fault.kind, rig.cameras[index], fault.camera, fault.lag_frames / fps)
    numbers = f"(explains {fault.explained:.0%} of the drones that the others see, not {sound:.0%})"
    return Finding(_named(fault.kind), (name,), f"camera {name}: {words} {numbers}", remedy)


def describe_fault(rig: Rig, fault: FoundFault, fps: float) -> Finding:
    """Describe a small fault, or the faults of several cameras that explain the sightings equally well."""
    every = [fault.best, *fault.as_well]
    (words, remedy), *also = (_of_judged(rig, one, fps) for one in every)
    names = tuple(
        dict.fromkeys(rig.names[one.hypothesis.camera] for one in every if one.hypothesis.camera >= 0)
    )
    if not fault.certain:
        several = "; or ".join(f"{_who(rig, one)}: {_of_judged(rig, one, fps)[0]}" for one in every)
        message = f"the cameras disagree, and these faults explain it about equally well: {several}"
        return Finding("unclear", names, message, "none is certain: check these cameras, or use more cameras")
    numbers = f"which moves its boxes by {fault.shift_px:.0f} px"
    if also:
        numbers += f"; nearly as likely, {' or '.join(said for said, _ in also)}"
    kind, *others = (_named(one.hypothesis.kind) for one in every)
    other_kinds = tuple(other for other in dict.fromkeys(others) if other != kind)
    return Finding(kind, names, f"{_who(rig, fault.best)}: {words}, {numbers}", remedy, other_kinds)


def _named(kind: str) -> str:
    """The kind for programs: a camera that is turned and moved was moved."""
    return "moved" if kind == "turned and moved" else kind


def _who(rig: Rig, judged: Judged) -> str:
    camera = judged.hypothesis.camera
    return "the calibration" if camera < 0 else f"camera {rig.names[camera]}"


def _of_judged(rig: Rig, judged: Judged, fps: float) -> tuple[str, str]:
    """What is wrong and by how much, and what to do."""
    # A fault of all lenses is the same factor for each camera.
    kind, camera = judged.hypothesis.kind, max(judged.hypothesis.camera, 0)
    after = Corrected(rig, np.zeros(len(rig))).by(judged.step)
    late_s = float(after.lag_frames[camera]) / fps
    std = judged.std[judged.hypothesis.columns[0]] / (fps if kind == "clock" else 1)
    return _in_words(kind, rig.cameras[camera], after.rig.cameras[camera], late_s, std)


def _in_words(
    kind: str, before: Camera, after: Camera, late_s: float, std: float | None = None
) -> tuple[str, str]:
    """What is wrong and by how much, with a standard deviation where it is known, and what to do."""
    if kind == "clock":
        known = "" if std is None else f" (± {1e3 * std:.0f} ms)"
        words = f"its video is {1e3 * abs(late_s):.0f} ms {'late' if late_s > 0 else 'early'}{known}"
        return words, (
            "track with --clocks auto, which finds it to a millisecond or so; "
            f"or add {-late_s:.4f} to its time_offset_s"
        )
    scale = float(after.K[0, 0] / before.K[0, 0])
    known = "" if std is None else f" (± {100 * std:.1f} %)"
    how = f"{100 * abs(1 / scale - 1):.1f} % too {'short' if scale > 1 else 'long'}{known}"
    if kind == "focal lengths":
        return f"all focal lengths are {how}", (
            f"multiply them by {scale:.3f}, or calibrate each lens anew with `psotrack calibrate intrinsics`"
        )
    if kind == "focal length":
        return f"its focal length is {how}", f"try {after.K[0, 0]:.0f} px, or {_LENS_ANEW}"
    turn = Rotation.from_matrix(after.T_cam_world[:3, :3] @ before.T_cam_world[:3, :3].T)
    way_m = float(np.linalg.norm(after.centre_world - before.centre_world))
    parts = [f"turned by {np.rad2deg(turn.magnitude()):.1f} degrees"] if "turned" in kind else []
    parts += [f"moved by {100 * way_m:.0f} cm"] if "moved" in kind else []
    centre = ", ".join(f"{value:.2f}" for value in after.centre_world)
    return f"it is {' and '.join(parts)}", f"{_PLACE_ANEW}; the boxes put it at ({centre}) m"


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
    if abs(fit.scale - 1) > _SAME_SCALE:
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
