"""What the doctor found: findings in words, and what was measured of each camera, as records, tables and JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from psotrack.calibration.doctor.common_points import Corrected
from psotrack.calibration.doctor.fault_search import FoundFault, Judged
from psotrack.geometry import Camera, Rig
from psotrack.support import finite_or_none, html_block, html_table, text_table
from psotrack.tracking.camera_errors import ClockStep, Knock

#: Largest median distance between reference and points that agree, metres: lever arms of real recordings are up to
#: 0.15 m.
_NEAR_M = 0.3
#: What to do about a camera's place, and about its lens.
_PLACE_ANEW = (
    "place it anew with `psotrack calibrate rig --pairs`, or all cameras with `psotrack calibrate rig`"
)
_LENS_ANEW = "calibrate its lens anew with `psotrack calibrate rig`"
_RIG_ANEW = "place all cameras anew with `psotrack calibrate rig`"
_HEADINGS = ("camera", "detections/frame", "explained", "median (px)", "(noise)", "late (ms)")
_SOUND = "nothing disagrees"


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


def describe_change(names: tuple[str, ...], change: Knock | ClockStep, fps: float) -> Finding:
    """Describe a camera, or one of two, that changed in mid-flight."""
    who, at = f"camera {' or '.join(names)}", f"frame {change.frame} ({change.frame / fps:.2f} s)"
    if isinstance(change, Knock):
        off_px = np.linalg.norm(change.shift_px)
        message = f"{who}: it was knocked at {at}, which moves its boxes by {off_px:.0f} px from then on"
        return Finding("knocked", names, message, f"before the next flight, {_PLACE_ANEW}")
    early, as_if = ("earlier", "lost frames") if change.step_s > 0 else ("later", "repeated frames")
    by_ms = 1e3 * abs(change.step_s)
    message = f"{who}: from {at} on, its video is {by_ms:.0f} ms {early} than before, as if it had {as_if}"
    return Finding("clock step", names, message, "track with --clocks auto, or give the times of its frames")


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
    # A camera that is turned and moved was moved, for programs.
    kind, *others = (one.hypothesis.kind.removeprefix("turned and ") for one in every)
    other_kinds = tuple(other for other in dict.fromkeys(others) if other != kind)
    return Finding(kind, names, f"{_who(rig, fault.best)}: {words}{numbers}", remedy, other_kinds)


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


def _in_words(kind: str, before: Camera, after: Camera, late_s: float, std: float) -> tuple[str, str]:
    """What is wrong and by how much, with a standard deviation, and what to do."""
    if kind == "clock":
        when = "late" if late_s > 0 else "early"
        words = f"its video is {1e3 * abs(late_s):.0f} ms {when} (± {1e3 * std:.0f} ms)"
        return words, (
            "track with --clocks auto, which finds it to a millisecond or so; "
            f"or add {-late_s:.4f} to its time_offset_s"
        )
    scale = float(after.K[0, 0] / before.K[0, 0])
    too = "short" if scale > 1 else "long"
    how = f"{100 * abs(1 / scale - 1):.1f} % too {too} (± {100 * std:.1f} %)"
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


@dataclass(frozen=True)
class Diagnosis:
    """Result of an examination; its text is what `psotrack doctor` prints.

    Attributes:
        cameras: names of the cameras.
        fps: frames per second of the videos.
        findings: disagreements; empty for a correct rig.
        num_frames: number of examined frames.
        num_sightings: (cameras,), numbers of sightings in these frames.
        num_explained: (cameras,), numbers of sightings that agree with those of other cameras, after a wrong unit or
            interpretation of the rig was corrected.
        residual_px: (cameras,), median distance of the camera's sightings from where the other cameras put the bodies,
            pixels; NaN if too few agree.
        residual_std: (cameras,), the same in units of the noise that boxes are first assumed to have.
        late_frames: (cameras,), how late each camera's video shows the scene, relative to the median camera, frames:
            frame i of a video that is late by k shows what the others show in frame i - k; NaN if it cannot be found.
        late_std_frames: (cameras,), standard deviations of `late_frames`.
        epipolar_px: (cameras, cameras), median distances of sightings from each other's epipolar lines, pixels; NaN for
            pairs of cameras without common points.
        reference_m: median distance of the points from the reference, metres; NaN without one.
    """

    cameras: tuple[str, ...]
    fps: float
    findings: tuple[Finding, ...]
    num_frames: int
    num_sightings: Int[np.ndarray, "cameras"]
    num_explained: Int[np.ndarray, "cameras"]
    residual_px: Float[np.ndarray, "cameras"]
    residual_std: Float[np.ndarray, "cameras"]
    late_frames: Float[np.ndarray, "cameras"]
    late_std_frames: Float[np.ndarray, "cameras"]
    epipolar_px: Float[np.ndarray, "cameras cameras"]
    reference_m: float

    def to_dict(self) -> dict[str, Any]:
        """The findings and measurements, with None for missing numbers."""
        return {
            "findings": [asdict(finding) for finding in self.findings],
            "frames": self.num_frames,
            "explained": float(self.num_explained.sum() / max(self.num_sightings.sum(), 1)),
            "cameras": self._measured(),
            "epipolar_px": [[finite_or_none(value) for value in row] for row in self.epipolar_px],
            "reference_m": finite_or_none(self.reference_m),
        }

    def __str__(self) -> str:
        """Tables of the cameras and of their pairs, and the findings."""
        pairs = (
            (name, *("" if np.isnan(value) else f"{value:.1f}" for value in values))
            for name, values in zip(self.cameras, self.epipolar_px, strict=True)
        )
        title = "median distance from epipolar lines (px)"
        tables = [text_table(_HEADINGS, self._rows()), text_table(("", *self.cameras), pairs, title)]
        return "\n".join([*tables, *(map(str, self.findings) if self.findings else [_SOUND])])

    def __repr__(self) -> str:
        return f"Diagnosis({'; '.join(map(str, self.findings)) or _SOUND})"

    def _repr_html_(self) -> str:
        """What a notebook shows: the findings, and the table of the cameras."""
        return html_block("; ".join(map(str, self.findings)) or _SOUND, html_table(_HEADINGS, self._rows()))

    def _measured(self) -> list[dict[str, Any]]:
        """Measurements of each camera."""
        return [
            {
                "camera": name,
                "detections_per_frame": float(self.num_sightings[index] / max(self.num_frames, 1)),
                "explained": float(self.num_explained[index] / max(self.num_sightings[index], 1)),
                "residual_px": finite_or_none(self.residual_px[index]),
                "residual_std": finite_or_none(self.residual_std[index]),
                "late_frames": finite_or_none(self.late_frames[index]),
                "late_std_frames": finite_or_none(self.late_std_frames[index]),
            }
            for index, name in enumerate(self.cameras)
        ]

    def _rows(self) -> list[tuple[str, ...]]:
        """The same as texts of a table."""
        rows, to_ms = [], 1e3 / self.fps
        for row in self._measured():
            late, std = row["late_frames"], row["late_std_frames"]
            rows.append(
                (
                    row["camera"],
                    f"{row['detections_per_frame']:.2f}",
                    f"{row['explained']:.0%}",
                    *(
                        "" if row[key] is None else f"{row[key]:.1f}"
                        for key in ("residual_px", "residual_std")
                    ),
                    "" if late is None else f"{late * to_ms:+.0f} ± {std * to_ms:.0f}",
                )
            )
        return rows
