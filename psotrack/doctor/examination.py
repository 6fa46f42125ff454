"""A rig checked against its own data, before anybody tracks: what disagrees, by how much, and what to do.

Sightings of a few runs of frames are matched over the cameras and triangulated. Where they do not agree, other readings
of the whole rig are tried (`readings`), then faults of each camera (`suspects`), clocks, and the reference
(`reference_fit`). A fault is named only if it explains clearly more than the rig as it was read.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from psotrack.correspondence import Sightings, epipolar_distance
from psotrack.doctor.agreement import Agreement, agreement
from psotrack.doctor.findings import CLEARLY, Finding, fault_of, late_clock, reference_findings
from psotrack.doctor.readings import better_lenses, better_reading, certain_lenses, halfway
from psotrack.doctor.reference_fit import ReferenceFit, fit_reference
from psotrack.doctor.suspects import LEAST_POINTS, explanations, late_cameras, views_of
from psotrack.geometry import CameraRig
from psotrack.trajectories import Trajectories

#: Runs of consecutive frames that are looked at, so that motion shows.
RUNS, RUN_FRAMES = 4, 15
#: Frames that readings of the whole rig are tried on; the best one is judged by all.
READING_FRAMES = 8
#: Cameras of one room are so far from each other, at the median. Other conventions bring them to decimetres.
PLAUSIBLE_M = (0.05, 200.0)
#: Of the image's sides, by which principal points are off its middle at most: lenses are off by a few per cent.
OFF_MIDDLE = 0.15
#: Share of sightings that a sound rig explains; false alarms, and drones that only two cameras see, are the rest.
SOUND_SHARE = 0.9
#: Explained less than this, and nothing can be said of single cameras.
LEAST_SHARE = 0.3
#: A camera is off if it explains less than this share of what its fellows do.
OFF_SHARE = 0.5


@dataclass(frozen=True)
class Diagnosis:
    """What was looked at, and what is wrong.

    Attributes:
        findings: none for a sound rig.
        found: the agreement of the rig as it was read, or as it is with its unit or reading corrected.
        offset_frames, offset_std_frames: (cameras,), how late each camera is; NaN where it cannot be told.
        epipolar_px: (cameras, cameras), median distance of sightings from each other's epipolar lines; NaN for none.
        reference: how it fits; None without.
    """

    findings: tuple[Finding, ...]
    found: Agreement
    offset_frames: Float[np.ndarray, "cameras"]
    offset_std_frames: Float[np.ndarray, "cameras"]
    epipolar_px: Float[np.ndarray, "cameras cameras"]
    reference: ReferenceFit | None


def examine(
    rig: CameraRig, sightings: Sightings, *, fps: float, reference: Trajectories | None = None
) -> Diagnosis:
    """Look for what is wrong with a rig, from sightings of moving drones.

    Not found are faults that move what is seen by less than the sightings' noise, and those of rigs with fewer than
    four viewpoints, where nobody can tell which camera it is.

    Args:
        rig: as it was read.
        sightings: of its cameras, at whole frames.
        fps: frames per second.
        reference: at the video's frames, or None.
    """
    frames = sampled_frames(sightings.num_frames)
    findings, rig = _of_numbers(rig)
    found = agreement(rig, sightings, frames)
    if found.share < SOUND_SHARE and found.num_sightings.any():
        reading = better_reading(rig, sightings, frames[:: max(1, len(frames) // READING_FRAMES)])
        better = found if reading is None else agreement(reading.rig, sightings, frames)
        if reading is not None and better.share > halfway(found.share):
            who = f"cameras {' and '.join(reading.cameras)}" if reading.cameras else "the calibration"
            numbers = f"(explains {better.share:.0%} of the detections, not {found.share:.0%})"
            message = f"{who}: {reading.words} {numbers}"
            findings.append(Finding(reading.kind, reading.cameras, message, reading.remedy))
            rig, found = reading.rig, better
    if found.share < LEAST_SHARE or len(found.frame) < LEAST_POINTS:
        findings.append(_nothing_agrees(found))
        nothing = np.full(len(rig), np.nan)
        return Diagnosis(tuple(findings), found, nothing, nothing, _epipolar(rig, found), None)
    lenses = better_lenses(rig, found, CLEARLY)
    if lenses is not None:
        rig, found = lenses.rig, agreement(lenses.rig, sightings, frames)
    of_cameras, sound = _of_cameras(rig, found, sightings, frames)
    certain = certain_lenses(rig, found) if lenses is None else None
    if certain is not None:
        agreed = agreement(certain.rig, sightings, frames)
        # What is wrong with all may look as if it were with the one that shows it most; the reverse does not go away.
        still, all_sound = _of_cameras(certain.rig, agreed, sightings, frames)
        if not still:
            lenses, rig, found, of_cameras, sound = certain, certain.rig, agreed, still, all_sound
    if lenses is not None:
        findings.append(Finding(lenses.kind, (), f"the calibration: {lenses.words}", lenses.remedy))
    findings += of_cameras
    offset, std, late = late_cameras(rig, found, sound, fps)
    findings += [late_clock(rig.names[index], offset[index], std[index]) for index in late]
    fit = None
    if reference is not None:
        inside = found.frame < reference.num_frames
        fit = fit_reference(found.frame[inside], found.position_m[inside], reference, fps)
        findings += reference_findings(fit, fps)
    return Diagnosis(tuple(findings), found, offset, std, _epipolar(rig, found), fit)


def sampled_frames(num_frames: int) -> Int[np.ndarray, "chosen"]:
    """A few runs of frames over the whole video."""
    starts = np.linspace(0, max(num_frames - RUN_FRAMES, 0), RUNS).astype(int)
    frames = np.unique(starts[:, None] + np.arange(RUN_FRAMES))
    return frames[frames < num_frames]


def _of_numbers(rig: CameraRig) -> tuple[list[Finding], CameraRig]:
    """What the numbers alone say: lengths that no room has, and principal points of another image; both put right."""
    findings = []
    cameras = rig.cameras
    distances_m = [np.linalg.norm(a - b) for a, b in combinations(cameras.centre_world, 2)]
    apart_m = float(np.median(distances_m)) if distances_m else 1.0
    # In between, neither is said: a room of any size is somebody's.
    factor = 1e-3 if apart_m > PLAUSIBLE_M[1] else 1e3 if apart_m < PLAUSIBLE_M[0] else 1.0
    if factor != 1.0 and PLAUSIBLE_M[0] <= factor * apart_m <= PLAUSIBLE_M[1]:
        read, right = ("metres", "millimetres") if factor < 1 else ("millimetres", "metres")
        findings.append(
            Finding(
                "unit",
                (),
                f"the calibration: cameras are {apart_m:.3g} m apart: {right} were read as {read}",
                f"name the unit in the header, cam_x[{'mm' if factor < 1 else 'm'}]",
            )
        )
        T = cameras.T_cam_world.copy()
        T[:, :3, 3] *= factor
        cameras = replace(cameras, T_cam_world=T)
    of_lenses, K = _of_lenses(rig)
    findings += of_lenses
    return findings, CameraRig(rig.names, replace(cameras, K=K))


def _of_lenses(rig: CameraRig) -> tuple[list[Finding], np.ndarray]:
    """Principal points of another image, cameras that are off alike together; and K put right."""
    cameras, K = rig.cameras, np.array(rig.cameras.K)
    ratio = K[:, :2, 2] / ((cameras.image_size_wh - 1) / 2)
    off = np.abs(ratio - 1).max(axis=-1) > 2 * OFF_MIDDLE
    alike: dict[tuple[str, ...], list[int]] = {}
    for index in np.flatnonzero(off).tolist():
        alike.setdefault(tuple(f"{each:.2f}" for each in ratio[index]), []).append(index)
    findings = []
    for indices in alike.values():
        first, names = indices[0], tuple(rig.names[index] for index in indices)
        (x, y), (width, height) = K[first, :2, 2], cameras.image_size_wh[first]
        remedy = "check cx and cy"
        if (ratio[first] > 0).all() and 0.95 < ratio[first, 0] / ratio[first, 1] < 1.05:
            scale = 1 / float(ratio[first].mean())
            remedy = f"it is of an image {1 / scale:.2f} times as large: multiply focal length, cx, cy by {scale:.3f}"
            K[indices, :2] *= scale
        message = (
            f"camera{'s' * (len(names) > 1)} {', '.join(names)}: the principal point ({x:.0f}, {y:.0f}) is far from "
            f"the middle of the {width:.0f} x {height:.0f} image"
        )
        findings.append(Finding("image size", names, message, remedy))
    return findings, K


def _nothing_agrees(found: Agreement) -> Finding:
    seen = int(found.num_sightings.sum())
    # What little there is may well agree.
    if seen < LEAST_POINTS or found.share >= LEAST_SHARE:
        message = (
            f"the detections: only {seen}, of {len(found.frame)} places that three viewpoints see, in the "
            f"{found.num_frames} frames that were looked at"
        )
        return Finding(
            "too little seen", (), message, "nothing can be said of the rig; pass other --detections"
        )
    message = (
        f"the rig: three viewpoints agree on only {found.share:.0%} of {seen} detections, however it is read"
    )
    return Finding(
        "no agreement", (), message, "calibrate it anew, and check that videos and detections are its own"
    )


def _of_cameras(
    rig: CameraRig, found: Agreement, sightings: Sightings, frames: Int[np.ndarray, "chosen"]
) -> tuple[list[Finding], np.ndarray]:
    """Faults of single cameras, the worst first, each without those before it; and which cameras are sound."""
    findings: list[Finding] = []
    sound = np.ones(len(rig), bool)
    while sound.sum() > 3:
        index = np.flatnonzero(sound)
        rest = rig.select([rig.names[each] for each in index])
        seen = Sightings(*(value[:, index] for value in vars(sightings).values()))
        found = agreement(rest, seen, frames) if findings else found
        views = [views_of(rest, found, seen, each) for each in range(len(rest))]
        judged = [
            explanations(rest, of, each) if len(of.point_m) >= LEAST_POINTS else []
            for each, of in enumerate(views)
        ]
        won = [max(one.gain for one in each) - each[0].gain if each else 0.0 for each in judged]
        worst = int(np.argmax(won))
        usual = float(np.median([each[0].gain for each in judged if each] or [0.0]))
        off = [bool(each) and each[0].gain < OFF_SHARE * usual for each in judged]
        if won[worst] <= CLEARLY and any(off):
            worst = off.index(True)
        elif won[worst] <= CLEARLY:
            break
        findings.append(fault_of(rest, worst, judged[worst]))
        sound[index[worst]] = False
    return findings, sound


def _epipolar(rig: CameraRig, found: Agreement) -> Float[np.ndarray, "cameras cameras"]:
    median_px = np.full((len(rig), len(rig)), np.nan)
    for first, second in combinations(range(len(rig)), 2):
        both = np.isfinite(found.noise_px[:, [first, second]]).all(axis=1)
        if both.any():
            px = found.centre_px[both]
            pair = epipolar_distance(rig.cameras[first], rig.cameras[second], px[:, first], px[:, second])
            median_px[first, second] = median_px[second, first] = np.median(
                pair.max(axis=-1)[np.diag_indices(len(px))]
            )
    return median_px
