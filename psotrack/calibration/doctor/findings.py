"""Findings in words: what disagrees, by how much, and what to do."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.calibration.doctor.corrections import Corrected
from psotrack.calibration.doctor.evidence import Judged
from psotrack.calibration.doctor.fault_search import FoundFault
from psotrack.geometry import Camera, Rig
from psotrack.tracking.camera_errors import Knock

#: Largest median distance between reference and points that agree, metres: lever arms of real recordings are up to
#: 0.15 m.
_NEAR_M = 0.3
#: What to do about a camera's place, and about its lens.
_PLACE_ANEW = (
    "place it anew with `psotrack calibrate rig --pairs`, or all cameras with `psotrack calibrate rig`"
)
_LENS_ANEW = "calibrate its lens anew with `psotrack calibrate rig`"
_RIG_ANEW = "place all cameras anew with `psotrack calibrate rig`"


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


def describe_disagreement(
    explained: float, count: int, viewpoints: int, off_std: float = 0.0, name: str = ""
) -> Finding:
    """Describe a rig whose cameras disagree by more than the errors of boxes, without a fault that explains it.

    Args:
        explained: share of the sightings on which enough viewpoints agree.
        count: number of sightings.
        viewpoints: number of viewpoints that are enough.
        off_std: median distance of the worst camera's sightings from where the others put the bodies, standard
            deviations of boxes.
        name: name of this camera; empty where it is not known.
    """
    worst = f", and camera {name} is off by {off_std:.1f} times the error of its boxes" if name else ""
    message = (
        f"the rig or the detections: {'three' if viewpoints > 2 else 'two'} viewpoints agree on {explained:.0%} of "
        f"{count} detections{worst}; no single fault and no other reading of the rig explains it"
    )
    # Blobs can be other parts of a body in each camera, if the body hardly moves: then the soundest rig disagrees.
    remedy = (
        "look whether the detections are of the same bodies in all cameras, and videos of this rig; "
        "if they are, calibrate it anew"
    )
    return Finding("no agreement", (), message, remedy)


def describe_knock(names: tuple[str, ...], knock: Knock, fps: float) -> Finding:
    """Describe a camera, or one of two, that was knocked in mid-flight."""
    message = (
        f"camera {' or '.join(names)}: it was knocked at frame {knock.frame} ({knock.frame / fps:.2f} s), which moves "
        f"its boxes by {np.linalg.norm(knock.shift_px):.0f} px from then on"
    )
    return Finding("knocked", names, message, f"before the next flight, {_PLACE_ANEW}")


def describe_gross_fault(explained: float, name: str) -> Finding:
    """Describe a camera that explains hardly any of the points that the others see."""
    message = (
        f"camera {name}: it has detections near {explained:.0%} of the drones that the others see: it was turned or "
        "moved far, or has another lens, or its video is upside down or of another time"
    )
    remedy = f"look at its video beside the others; leave {name} out with --cameras, or {_PLACE_ANEW}"
    return Finding("disagrees", (name,), message, remedy)


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
    of_lenses = fault.best.hypothesis.kind == "focal lengths"
    numbers = "" if of_lenses else f", which moves its boxes by {fault.shift_px:.0f} px"
    if also:
        numbers += f"; nearly as likely, {' or '.join(said for said, _ in also)}"
    kind, *others = (_named(one.hypothesis.kind) for one in every)
    other_kinds = tuple(other for other in dict.fromkeys(others) if other != kind)
    return Finding(kind, names, f"{_who(rig, fault.best)}: {words}{numbers}", remedy, other_kinds)


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
    if kind == "several":
        worst_deg = np.max(_turned_deg(rig.cameras, after.rig.cameras))
        return f"its cameras are turned or moved, by up to {worst_deg:.1f} degrees", _RIG_ANEW
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
            f"multiply them by {scale:.3f}, or calibrate each lens anew with `psotrack calibrate rig`"
        )
    if kind == "focal length":
        return f"its focal length is {how}", f"try {after.K[0, 0]:.0f} px, or {_LENS_ANEW}"
    way_m = float(np.linalg.norm(after.centre_world - before.centre_world))
    parts = [f"turned by {_turned_deg(before, after):.1f} degrees"] if "turned" in kind else []
    parts += [f"moved by {100 * way_m:.0f} cm"] if "moved" in kind else []
    centre = ", ".join(f"{value:.2f}" for value in after.centre_world)
    return f"it is {' and '.join(parts)}", f"{_PLACE_ANEW}; the boxes put it at ({centre}) m"


def _turned_deg(before: Camera, after: Camera) -> Float[np.ndarray, "*cameras"]:
    """Angles by which cameras are turned, degrees."""
    R = after.T_cam_world[..., :3, :3] @ before.T_cam_world[..., :3, :3].swapaxes(-1, -2)
    return np.asarray(np.rad2deg(Rotation.from_matrix(R).magnitude()))


def describe_reference(
    point_m: Float[np.ndarray, "points 3"], reference_m: Float[np.ndarray, "points drones 3"]
) -> tuple[float, list[Finding]]:
    """Median distance of points from the nearest drone of the reference, metres, and whether it contradicts the rig.

    Args:
        point_m: (points, 3), triangulated points of unknown drones.
        reference_m: (points, drones, 3), the reference in each point's frame; NaN where it is missing.
    """
    distance_m = np.linalg.norm(reference_m - point_m[:, None], axis=-1)
    known = np.isfinite(distance_m).any(axis=1)
    median_m = float(np.median(np.nanmin(distance_m[known], axis=1))) if known.any() else np.nan
    if not median_m >= _NEAR_M:
        return median_m, []
    extents_m = [np.nanstd(each, axis=0).max() for each in (reference_m.reshape(-1, 3), point_m)]
    message = (
        f"the reference: it is {median_m:.2f} m from what the cameras see, at the median; its extent is "
        f"{extents_m[0] / extents_m[1]:.3g} times theirs"
    )
    remedy = (
        "find the offset of its clock with `psotrack doctor --tracks`; else check its unit and its axes, and that it "
        "is of this flight"
    )
    return median_m, [Finding("reference", (), message, remedy)]
