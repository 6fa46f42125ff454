"""Examination of a rig with its own data before tracking: what disagrees, by how much, and what to do.

Sightings of a few runs of frames are matched over the cameras and triangulated. If they do not agree, other
interpretations of the whole rig are tried (`rig_interpretations`), then large faults of each camera (`camera_faults`).
Small faults, of cameras and of clocks, are found by comparing all hypotheses on sightings that are matched loosely
(`fault_search`). Last, the reference is compared (`reference_fit`).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Bool, Float, Int

from psotrack.calibration.doctor.agreement import MIN_VIEWPOINTS, Agreement, measure_agreement
from psotrack.calibration.doctor.camera_faults import MIN_POINTS_OF_CAMERA, collect_views, explain_camera
from psotrack.calibration.doctor.common_points import CommonPoints, find_common_points
from psotrack.calibration.doctor.diagnosis import Diagnosis
from psotrack.calibration.doctor.fault_search import consistent_share, find_faults
from psotrack.calibration.doctor.findings import (
    Finding,
    describe_camera_fault,
    describe_fault,
    describe_reference,
)
from psotrack.calibration.doctor.hypotheses import parameters_of
from psotrack.calibration.doctor.late_videos import measure_lags
from psotrack.calibration.doctor.reference_fit import fit_reference
from psotrack.calibration.doctor.rig_interpretations import (
    find_better_interpretation,
    required_share,
)
from psotrack.geometry import Rig
from psotrack.tracking.matching import Sightings, epipolar_distance, wide_bounds
from psotrack.trajectories import Trajectories

#: Smallest and largest number of runs of consecutive frames that are examined, number of frames per run, and seconds
#: from run to run in short recordings. Runs show the motion; the errors of neighbouring runs are alike.
FEWEST_RUNS, MOST_RUNS, RUN_FRAMES, APART_S = 4, 14, 12, 1.2
#: Number of frames with which interpretations of the whole rig are compared; the best one is checked with all frames.
INTERPRETATION_FRAMES = 8
#: Smallest and largest plausible median distance of two cameras in a room, metres.
PLAUSIBLE_M = (0.05, 200.0)
#: Largest plausible distance of a principal point from the image's middle, as a share of the image's side: real lenses
#: are off by a few per cent.
OFF_MIDDLE = 0.15
#: Share of sightings that a correct rig explains. False detections, and drones that only two cameras see, are the rest.
SOUND_SHARE = 0.85
#: Smallest share of explained sightings with which single cameras can be checked.
MIN_SHARE = 0.3
#: A camera may be grossly wrong if the loose matching uses less of its sightings than this share of the median
#: camera's. It is wrong if a correction explains more of what the others see by this share, or if it explains less of
#: this than the last number without a correction that helps.
OFF_SHARE, GROSS_GAIN, NOTHING_EXPLAINED = 0.5, 0.3, 0.1
#: Smallest number of points with which a rig can be checked.
MIN_POINTS = 12
#: Smallest share of matched sightings that go on from frame to frame: of boxes of bodies nine in ten do, of matches by
#: chance about half.
MIN_CONSISTENT = 0.75
#: Smallest and largest plausible size of a body, metres.
PLAUSIBLE_BODY_M = (0.01, 10.0)


def examine(
    rig: Rig,
    sightings: Sightings,
    *,
    fps: float,
    reference: Trajectories | None = None,
    bounds_m: Float[np.ndarray, "2 3"] | None = None,
) -> Diagnosis:
    """Find faults of a rig from sightings of moving bodies.

    Faults that move the projections by less than the boxes' own errors are not found. With three cameras, a fault can
    often not be assigned to one of them.

    Args:
        rig: the rig as it was read.
        sightings: sightings of the rig's cameras at whole frames.
        fps: frames per second of the videos.
        reference: reference at the video's frames, or None.
        bounds_m: (2, 3), corners of the region where bodies can be, metres; None: all places that the cameras may see.
    """
    frames = sampled_frames(sightings.num_frames, fps)
    findings, rig = _check_numbers(rig, sightings, frames)
    bounds_m = wide_bounds(rig) if bounds_m is None else bounds_m
    found = measure_agreement(rig, sightings, frames, bounds_m)
    points = find_common_points(rig, sightings, frames, bounds_m, fps)
    # A small fault of one camera makes no interpretation of the whole rig likely.
    share = max(found.share, float(np.mean(points.share)))
    if share < SOUND_SHARE and found.num_sightings.any():
        interpretation = find_better_interpretation(
            rig, sightings, frames[:: max(1, len(frames) // INTERPRETATION_FRAMES)], bounds_m
        )
        better = (
            found
            if interpretation is None
            else measure_agreement(interpretation.rig, sightings, frames, bounds_m)
        )
        if interpretation is not None and better.share > required_share(share):
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
            points = find_common_points(rig, sightings, frames, bounds_m, fps)
    if max(found.share, float(points.share.max())) < MIN_SHARE or len(points.frame) < MIN_POINTS:
        return _undecided(rig, found, [*findings, _nothing_agrees(found, points)], fps)
    consistent = consistent_share(rig, points)
    if consistent < MIN_CONSISTENT:
        message = (
            f"the detections: of those that agree over the cameras, only {consistent:.0%} go on from frame to frame, "
            "so the others agree by chance"
        )
        finding = Finding(
            "too little seen", (), message, "the rig cannot be checked; pass other --detections"
        )
        return _undecided(rig, found, [*findings, finding], fps)
    lag, std = measure_lags(rig, points, fps)
    gross, sound = _find_gross_faults(rig, found, points, sightings, frames, bounds_m, fps)
    findings += gross
    if gross and sound.sum() >= MIN_VIEWPOINTS:
        rest, seen = _select(rig, sightings, sound)
        small, _ = find_faults(rest, find_common_points(rest, seen, frames, bounds_m, fps))
    else:
        rest = rig
        small, _ = find_faults(rig, points)
    findings += [describe_fault(rest, fault, fps) for fault in small]
    for fault in small:
        if fault.certain and fault.best.hypothesis.kind == "clock":
            # To the estimate of all lags together, the sightings of a very late video are outliers.
            index, camera = (
                rig.names.index(rest.names[fault.best.hypothesis.camera]),
                fault.best.hypothesis.camera,
            )
            lag[index] = parameters_of(fault.best.step, camera)[-1]
            std[index] = parameters_of(fault.best.std, camera)[-1]
    fit = None
    if reference is not None:
        inside = found.frame < reference.num_frames
        fit = fit_reference(found.frame[inside], found.position_m[inside], reference, fps)
        findings += describe_reference(fit, fps)
    epipolar_px = _median_epipolar_distances(rig, found)
    return Diagnosis(rig.names, fps, tuple(findings), found, lag, std, epipolar_px, fit)


def _undecided(rig: Rig, found: Agreement, findings: list[Finding], fps: float) -> Diagnosis:
    """The diagnosis of a rig that cannot be checked further."""
    nothing = np.full(len(rig), np.nan)
    epipolar_px = _median_epipolar_distances(rig, found)
    return Diagnosis(rig.names, fps, tuple(findings), found, nothing, nothing, epipolar_px, None)


def sampled_frames(num_frames: int, fps: float = 25.0) -> Int[np.ndarray, "chosen"]:
    """(chosen,), numbers of the frames to examine: runs of `RUN_FRAMES` frames, spread over the video."""
    runs = int(np.clip(num_frames / (APART_S * fps), FEWEST_RUNS, MOST_RUNS))
    starts = np.linspace(0, max(num_frames - RUN_FRAMES, 0), runs).astype(int)
    frames = np.unique(starts[:, None] + np.arange(RUN_FRAMES))
    return frames[frames < num_frames]


def _check_numbers(
    rig: Rig, sightings: Sightings, frames: Int[np.ndarray, "chosen"]
) -> tuple[list[Finding], Rig]:
    """Find implausible lengths and principal points, and correct both: findings, and the corrected rig."""
    findings = []
    cameras = rig.cameras
    distances_m = [np.linalg.norm(a - b) for a, b in combinations(cameras.centre_world, 2)]
    apart_m = float(np.median(distances_m)) if distances_m else 1.0
    # Between these limits every distance is plausible.
    factor = 1e-3 if apart_m > PLAUSIBLE_M[1] else 1e3 if apart_m < PLAUSIBLE_M[0] else 1.0
    if factor != 1.0 and PLAUSIBLE_M[0] <= factor * apart_m <= PLAUSIBLE_M[1]:
        body_m = _body_size_m(rig, sightings, frames)
        # Far cameras that see bodies of plausible size are no fault: a drone that is flown over a wide field.
        if body_m is None or not PLAUSIBLE_BODY_M[0] <= body_m <= PLAUSIBLE_BODY_M[1]:
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


def _body_size_m(rig: Rig, sightings: Sightings, frames: Int[np.ndarray, "chosen"]) -> float | None:
    """Median size of the bodies by the rig, metres; None if too few agree."""
    points = find_common_points(rig, sightings, frames[: FEWEST_RUNS * RUN_FRAMES], wide_bounds(rig), 1.0)
    if len(points.frame) < MIN_POINTS:
        return None
    distance_m = np.linalg.norm(points.start_m[:, None] - rig.cameras.centre_world, axis=-1)
    return float(np.nanmedian(points.side_px / rig.cameras.K[:, 0, 0] * distance_m))


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


def _nothing_agrees(found: Agreement, points: CommonPoints) -> Finding:
    seen = int(found.num_sightings.sum())
    # The few sightings may agree with each other.
    if seen < MIN_POINTS_OF_CAMERA or found.share >= MIN_SHARE or points.share.max() >= MIN_SHARE:
        message = (
            f"the detections: only {seen} in {found.num_frames} examined frames, which give {len(found.frame)} points "
            f"that three viewpoints see"
        )
        return Finding("too little seen", (), message, "the rig cannot be checked; pass other --detections")
    message = (
        f"the rig or the detections: three viewpoints agree on only {found.share:.0%} of {seen} detections, "
        "under every interpretation of the rig"
    )
    # Blobs can be other parts of a body in each camera, if the body hardly moves: then the soundest rig disagrees.
    remedy = (
        "look whether the detections are of the same bodies in all cameras, and videos of this rig; "
        "if they are, calibrate it anew"
    )
    return Finding("no agreement", (), message, remedy)


def _select(rig: Rig, sightings: Sightings, kept: Bool[np.ndarray, "cameras"]) -> tuple[Rig, Sightings]:
    index = np.flatnonzero(kept)
    rest = rig.select([rig.names[each] for each in index])
    seen = Sightings(
        sightings.centre_px[:, index],
        sightings.size_px[:, index],
        sightings.noise_px[:, index],
        None if sightings.exposures is None else sightings.exposures.of_cameras(index),
    )
    return rest, seen


def _find_gross_faults(
    rig: Rig,
    found: Agreement,
    points: CommonPoints,
    sightings: Sightings,
    frames: Int[np.ndarray, "chosen"],
    bounds_m: Float[np.ndarray, "2 3"],
    fps: float,
) -> tuple[list[Finding], Bool[np.ndarray, "cameras"]]:
    """Find cameras with faults so large that their sightings take no part in the loose matching.

    The worst camera is first. Each fault is searched without the cameras that were found wrong before.

    Returns:
        The findings, and (cameras,), False for wrong cameras.
    """
    findings: list[Finding] = []
    sound = np.ones(len(rig), bool)
    share = points.share
    while sound.sum() > MIN_VIEWPOINTS:
        rest, seen = _select(rig, sightings, sound)
        if findings:
            found = measure_agreement(rest, seen, frames, bounds_m)
            share = find_common_points(rest, seen, frames, bounds_m, fps).share
        suspects = np.flatnonzero(share < OFF_SHARE * np.median(share))
        views = {each: collect_views(rest, found, seen, each) for each in suspects.tolist()}
        explained = {
            each: explain_camera(rest, of, each)
            for each, of in views.items()
            if len(of.point_m) >= MIN_POINTS_OF_CAMERA
        }
        won = {each: max(one.gain for one in faults) - faults[0].gain for each, faults in explained.items()}
        off = [
            each
            for each, faults in explained.items()
            if won[each] > GROSS_GAIN or faults[0].gain < NOTHING_EXPLAINED
        ]
        if not off:
            break
        worst = max(off, key=lambda each: won[each])
        if won[worst] <= GROSS_GAIN and np.isfinite(views[worst].noise_px).any(axis=1).mean() < 0.5:
            # A camera that seldom has a detection is not known to be wrong.
            break
        fault = describe_camera_fault(rest, worst, explained[worst], fps)
        findings.append(fault)
        # The other one of two exchanged cameras is wrong for the same reason.
        concerned = [rig.names.index(name) for name in fault.cameras]
        sound[concerned] = False
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
