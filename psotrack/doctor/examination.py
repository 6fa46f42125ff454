"""Examination of a rig with its own data before tracking: what disagrees, by how much, and what to do.

Sightings of a few runs of frames are matched over the cameras and triangulated. If they do not agree, other
interpretations of the whole rig are tried (`rig_interpretations`), then faults of each camera (`camera_faults`),
clocks, and the reference (`reference_fit`). A fault is reported only if it explains clearly more sightings than the rig
as it was read.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from psotrack.correspondence import Sightings, epipolar_distance
from psotrack.doctor.agreement import Agreement, measure_agreement
from psotrack.doctor.camera_faults import (
    MIN_POINTS_OF_CAMERA,
    collect_views,
    explain_camera,
    find_late_cameras,
)
from psotrack.doctor.findings import (
    CLEARLY,
    Finding,
    describe_camera_fault,
    describe_late_clock,
    describe_reference,
)
from psotrack.doctor.reference_fit import ReferenceFit, fit_reference
from psotrack.doctor.rig_interpretations import (
    find_better_focal_lengths,
    find_better_interpretation,
    find_certain_focal_lengths,
    required_share,
)
from psotrack.geometry import Rig
from psotrack.trajectories import Trajectories

#: Number of runs of consecutive frames that are examined, and number of frames per run. Runs show the motion.
RUNS, RUN_FRAMES = 4, 15
#: Number of frames with which interpretations of the whole rig are compared; the best one is checked with all frames.
INTERPRETATION_FRAMES = 8
#: Smallest and largest plausible median distance of two cameras in a room, metres.
PLAUSIBLE_M = (0.05, 200.0)
#: Largest plausible distance of a principal point from the image's middle, as a share of the image's side: real lenses
#: are off by a few per cent.
OFF_MIDDLE = 0.15
#: Share of sightings that a correct rig explains. False detections, and drones that only two cameras see, are the rest.
SOUND_SHARE = 0.9
#: Smallest share of explained sightings with which single cameras can be checked.
MIN_SHARE = 0.3
#: A camera is wrong if it explains less than this share of what the median camera explains.
OFF_SHARE = 0.5


@dataclass(frozen=True)
class Diagnosis:
    """Result of an examination.

    Attributes:
        findings: disagreements; empty for a correct rig.
        found: agreement of the rig with its sightings, after a wrong unit or interpretation was corrected.
        offset_frames: (cameras,), offset of each camera's clock from the median camera, frames; positive for a late
            camera; NaN if the offset cannot be found.
        offset_std_frames: (cameras,), standard deviations of the offsets, frames.
        epipolar_px: (cameras, cameras), median distances of sightings from each other's epipolar lines, pixels; NaN for
            pairs of cameras without common points.
        reference: fit of the reference; None without a reference.
    """

    findings: tuple[Finding, ...]
    found: Agreement
    offset_frames: Float[np.ndarray, "cameras"]
    offset_std_frames: Float[np.ndarray, "cameras"]
    epipolar_px: Float[np.ndarray, "cameras cameras"]
    reference: ReferenceFit | None


def examine(
    rig: Rig, sightings: Sightings, *, fps: float, reference: Trajectories | None = None
) -> Diagnosis:
    """Find faults of a rig from sightings of moving drones.

    Faults that move the projections by less than the sightings' noise are not found. With fewer than four viewpoints,
    a fault cannot be assigned to a camera.

    Args:
        rig: the rig as it was read.
        sightings: sightings of the rig's cameras at whole frames.
        fps: frames per second of the videos.
        reference: reference at the video's frames, or None.
    """
    frames = sampled_frames(sightings.num_frames)
    findings, rig = _check_numbers(rig)
    found = measure_agreement(rig, sightings, frames)
    if found.share < SOUND_SHARE and found.num_sightings.any():
        interpretation = find_better_interpretation(
            rig, sightings, frames[:: max(1, len(frames) // INTERPRETATION_FRAMES)]
        )
        better = found if interpretation is None else measure_agreement(interpretation.rig, sightings, frames)
        if interpretation is not None and better.share > required_share(found.share):
            who = (
                f"cameras {' and '.join(interpretation.cameras)}"
                if interpretation.cameras
                else "the calibration"
            )
            numbers = f"(explains {better.share:.0%} of the detections, not {found.share:.0%})"
            message = f"{who}: {interpretation.words} {numbers}"
            findings.append(
                Finding(interpretation.kind, interpretation.cameras, message, interpretation.remedy)
            )
            rig, found = interpretation.rig, better
    if found.share < MIN_SHARE or len(found.frame) < MIN_POINTS_OF_CAMERA:
        findings.append(_nothing_agrees(found))
        nothing = np.full(len(rig), np.nan)
        return Diagnosis(
            tuple(findings), found, nothing, nothing, _median_epipolar_distances(rig, found), None
        )
    lenses = find_better_focal_lengths(rig, found, CLEARLY)
    if lenses is not None:
        rig, found = lenses.rig, measure_agreement(lenses.rig, sightings, frames)
    of_cameras, sound = _find_wrong_cameras(rig, found, sightings, frames)
    certain = find_certain_focal_lengths(rig, found) if lenses is None else None
    if certain is not None:
        agreed = measure_agreement(certain.rig, sightings, frames)
        # A fault of all lenses can look like a fault of the camera that shows it most. A fault of one camera remains
        # after all lenses are corrected.
        still, all_sound = _find_wrong_cameras(certain.rig, agreed, sightings, frames)
        if not still:
            lenses, rig, found, of_cameras, sound = certain, certain.rig, agreed, still, all_sound
    if lenses is not None:
        findings.append(Finding(lenses.kind, (), f"the calibration: {lenses.words}", lenses.remedy))
    findings += of_cameras
    offset, std, late = find_late_cameras(rig, found, sound, fps)
    findings += [describe_late_clock(rig.names[index], offset[index], std[index]) for index in late]
    fit = None
    if reference is not None:
        inside = found.frame < reference.num_frames
        fit = fit_reference(found.frame[inside], found.position_m[inside], reference, fps)
        findings += describe_reference(fit, fps)
    return Diagnosis(tuple(findings), found, offset, std, _median_epipolar_distances(rig, found), fit)


def sampled_frames(num_frames: int) -> Int[np.ndarray, "chosen"]:
    """(chosen,), numbers of the frames to examine: `RUNS` runs of `RUN_FRAMES` frames, spread over the video."""
    starts = np.linspace(0, max(num_frames - RUN_FRAMES, 0), RUNS).astype(int)
    frames = np.unique(starts[:, None] + np.arange(RUN_FRAMES))
    return frames[frames < num_frames]


def _check_numbers(rig: Rig) -> tuple[list[Finding], Rig]:
    """Find implausible lengths and principal points, and correct both: findings, and the corrected rig."""
    findings = []
    cameras = rig.cameras
    distances_m = [np.linalg.norm(a - b) for a, b in combinations(cameras.centre_world, 2)]
    apart_m = float(np.median(distances_m)) if distances_m else 1.0
    # Between these limits every distance is plausible.
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
    of_lenses, K = _check_principal_points(rig)
    findings += of_lenses
    return findings, Rig(rig.names, replace(cameras, K=K))


def _check_principal_points(rig: Rig) -> tuple[list[Finding], np.ndarray]:
    """Find principal points of another image size, one finding per ratio; return the findings and the corrected K."""
    cameras, K = rig.cameras, np.array(rig.cameras.K)
    ratio = K[:, :2, 2] / ((cameras.image_size_wh - 1) / 2)
    off = np.abs(ratio - 1).max(axis=-1) > 2 * OFF_MIDDLE
    same_ratio: dict[tuple[str, ...], list[int]] = {}
    for index in np.flatnonzero(off).tolist():
        same_ratio.setdefault(tuple(f"{each:.2f}" for each in ratio[index]), []).append(index)
    findings = []
    for indices in same_ratio.values():
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
    # The few sightings may agree with each other.
    if seen < MIN_POINTS_OF_CAMERA or found.share >= MIN_SHARE:
        message = (
            f"the detections: only {seen} in {found.num_frames} examined frames, which give {len(found.frame)} points "
            f"that three viewpoints see"
        )
        return Finding("too little seen", (), message, "the rig cannot be checked; pass other --detections")
    message = (
        f"the rig: three viewpoints agree on only {found.share:.0%} of {seen} detections, "
        "under every interpretation of the rig"
    )
    return Finding(
        "no agreement", (), message, "calibrate it anew, and check that videos and detections are its own"
    )


def _find_wrong_cameras(
    rig: Rig, found: Agreement, sightings: Sightings, frames: Int[np.ndarray, "chosen"]
) -> tuple[list[Finding], np.ndarray]:
    """Find faults of single cameras, the worst camera first, and say which cameras are sound.

    Each fault is searched without the cameras that were found wrong before.
    """
    findings: list[Finding] = []
    sound = np.ones(len(rig), bool)
    while sound.sum() > 3:
        index = np.flatnonzero(sound)
        rest = rig.select([rig.names[each] for each in index])
        seen = Sightings(*(value[:, index] for value in vars(sightings).values()))
        found = measure_agreement(rest, seen, frames) if findings else found
        views = [collect_views(rest, found, seen, each) for each in range(len(rest))]
        explained = [
            explain_camera(rest, of, each) if len(of.point_m) >= MIN_POINTS_OF_CAMERA else []
            for each, of in enumerate(views)
        ]
        won = [max(one.gain for one in each) - each[0].gain if each else 0.0 for each in explained]
        worst = int(np.argmax(won))
        usual = float(np.median([each[0].gain for each in explained if each] or [0.0]))
        off = [bool(each) and each[0].gain < OFF_SHARE * usual for each in explained]
        if won[worst] <= CLEARLY and any(off):
            worst = off.index(True)
        elif won[worst] <= CLEARLY:
            break
        findings.append(describe_camera_fault(rest, worst, explained[worst]))
        sound[index[worst]] = False
    return findings, sound


def _median_epipolar_distances(rig: Rig, found: Agreement) -> Float[np.ndarray, "cameras cameras"]:
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
