"""Examination of a rig with its own data before tracking: what disagrees, by how much, and what to do.

Sightings of a few runs of frames are matched over the cameras and triangulated. If they do not agree, other
interpretations of the whole rig are tried (`rig_interpretations`). A camera that agrees with no other one is named.
Small faults, of cameras and of clocks, are found by comparing all hypotheses on sightings that are matched loosely
(`fault_search`); what they leave must be what boxes err. Last, the reference is compared.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from psotrack.calibration.doctor import diagnosis
from psotrack.calibration.doctor.common_points import (
    CommonPoints,
    Corrected,
    ExaminedFrames,
    WeightedPoints,
    medians,
    misfit_px,
    weigh,
)
from psotrack.calibration.doctor.diagnosis import Diagnosis, Finding
from psotrack.calibration.doctor.fault_search import find_fault, find_lags
from psotrack.calibration.doctor.rig_interpretations import find_best_interpretation
from psotrack.geometry import Rig, project_visible
from psotrack.tracking.camera_errors import (
    ClockStep,
    Knock,
    find_change,
    views_of_places,
    with_nearest_sightings,
)
from psotrack.tracking.matching import (
    NOISE_PX,
    NOISE_SHARE,
    Sightings,
    by_image,
    epipolar_distance,
    wide_bounds,
)
from psotrack.trajectories import Trajectories

#: Smallest and largest number of runs of consecutive frames that are examined, number of frames per run, and seconds
#: from run to run in short recordings. Runs show the motion; the errors of neighbouring runs are alike.
FEWEST_RUNS, MOST_RUNS, RUN_FRAMES, APART_S = 4, 14, 12, 1.2
#: Number of frames with which interpretations of the whole rig are compared; the best one is checked with all frames.
INTERPRETATION_FRAMES = 8
#: Smallest and largest plausible median distance of two cameras in a room, metres.
PLAUSIBLE_M = (0.05, 200.0)
#: Fraction of sightings that a correct rig explains. False detections, and drones that only two cameras see, are the
#: rest.
SOUND_SHARE = 0.85
#: Smallest fraction of explained sightings with which single cameras can be checked.
MIN_SHARE = 0.3
#: A camera may be grossly wrong if the loose matching uses less of its sightings than this fraction of the median
#: camera's. It is if it has sightings near less than this fraction of the points that the others see, within this
#: number of standard deviations: 1 in 1000 right sightings is farther (χ² distribution, two degrees of freedom).
SUSPECT_SHARE, NOTHING_EXPLAINED, NEAR_STD = 0.5, 0.15, 3.7
#: Smallest number of points of the other cameras with which a camera is checked.
MIN_POINTS_OF_CAMERA = 30
#: Largest number of frames in which a change is looked for: of a longer video, every second, third, ...
MOST_FRAMES = 3000
#: Velocities are those over twice this time, seconds.
VELOCITY_S = 0.1
#: Smallest number of points with which a rig can be checked.
MIN_POINTS = 12
#: Smallest fraction of matched sightings that go on from frame to frame: of boxes of bodies nine in ten do, of matches
#: by chance about half.
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
    often not be assigned to one of them, with two it never can.

    Args:
        rig: the rig as it was read.
        sightings: sightings of the rig's cameras at whole frames.
        fps: frames per second of the videos.
        reference: reference at the video's frames, or None.
        bounds_m: (2, 3), corners of the region where bodies can be, metres; None: all places that the cameras may see.
    """
    frames = sampled_frames(sightings.num_frames, fps)
    seen = ExaminedFrames(sightings, frames, wide_bounds(rig) if bounds_m is None else bounds_m, fps)
    findings, rig = _check_numbers(rig, seen)
    if bounds_m is None:
        seen = replace(seen, bounds_m=wide_bounds(rig))
    total = max(int(seen.count.sum()), 1)
    explained, points = seen.explained(rig), seen.common_points(rig)
    # A small fault of one camera makes no interpretation of the whole rig likely.
    share = max(explained.sum() / total, float(np.mean(points.share)))
    if share < SOUND_SHARE and seen.count.any():
        few = replace(seen, frames=frames[:: max(1, len(frames) // INTERPRETATION_FRAMES)])
        better = find_best_interpretation(rig, few)
        again = seen.explained(better.rig)
        # It must explain at least half of what is missing.
        if again.sum() / total > (1 + share) / 2:
            several = "s" if len(better.cameras) > 1 else ""
            who = f"camera{several} {' and '.join(better.cameras)}" if better.cameras else "the calibration"
            numbers = (
                f"(explains {again.sum() / total:.0%} of the detections, not {explained.sum() / total:.0%})"
            )
            message = f"{who}: {better.words} {numbers}"
            findings.append(Finding(better.kind, better.cameras, message, better.remedy))
            rig, explained, points = better.rig, again, seen.common_points(better.rig)
    as_read = Corrected(rig, np.zeros(len(rig)))
    data, lags, reference_m = weigh(as_read, points), np.full((2, len(rig)), np.nan), np.nan
    unknown = _why_unknown(rig, seen, explained, points, data)
    if unknown is not None:
        findings.append(unknown)
    else:
        sound = seen
        change = _find_change(rig, seen)
        if change is not None:
            both = rig.names if seen.viewpoints(rig) < 3 else (rig.names[change.camera],)
            findings.append(diagnosis.describe_change(both, change, fps))
            sound = seen.without(change)
            points = sound.common_points(rig)
            data = weigh(as_read, points)
        lags = find_lags(rig, data)
        found, (off_std, name) = _find_faults(rig, sound, data, lags)
        findings += found
        unexplained = off_std > NEAR_STD or not (findings or explained.sum() >= MIN_SHARE * total)
        if unexplained and all(finding.kind != "unclear" for finding in found):
            share, least = explained.sum() / total, seen.viewpoints(rig)
            findings.append(diagnosis.describe_disagreement(share, total, least, off_std, name))
        if reference is not None:
            inside = points.frame < reference.num_frames
            reference_m, contradiction = diagnosis.describe_reference(
                points.start_m[inside], reference.position_m[points.frame[inside]]
            )
            findings += contradiction
    return Diagnosis(
        cameras=rig.names,
        fps=fps,
        findings=tuple(findings),
        num_frames=len(frames),
        num_sightings=seen.count,
        num_explained=explained,
        residual_px=medians(misfit_px(as_read, data)),
        residual_std=_off_std(as_read, data),
        late_frames=lags[0],
        late_std_frames=lags[1],
        epipolar_px=_median_epipolar_distances(rig, points),
        reference_m=reference_m,
    )


def sampled_frames(num_frames: int, fps: float = 25.0) -> Int[np.ndarray, "chosen"]:
    """(chosen,), numbers of the frames to examine: runs of `RUN_FRAMES` frames, spread over the video."""
    runs = int(np.clip(num_frames / (APART_S * fps), FEWEST_RUNS, MOST_RUNS))
    starts = np.linspace(0, max(num_frames - RUN_FRAMES, 0), runs).astype(int)
    frames = np.unique(starts[:, None] + np.arange(RUN_FRAMES))
    return frames[frames < num_frames]


def _find_change(rig: Rig, seen: ExaminedFrames) -> Knock | ClockStep | None:
    """A camera that changes in mid-flight, by where pairs of cameras, or more, put the bodies in all frames."""
    step = -(-seen.sightings.num_frames // MOST_FRAMES)
    every = replace(seen, frames=np.arange(0, seen.sightings.num_frames, step))
    sightings = seen.sightings[every.frames]
    frame, box, places_m = every.matched(rig, least=2)
    number = frame // step
    position_m = by_image(number, places_m, len(every.frames))
    seen_px = sightings.centre_px[number[:, None], np.arange(len(rig)), box]
    used_px = by_image(number, np.where(box[..., None] >= 0, seen_px, np.nan), len(every.frames))
    velocity_m_s = _velocities(position_m, seen.fps / step)
    all_px = with_nearest_sightings(rig.cameras, used_px, sightings, position_m, np.zeros_like(position_m))
    used, shown = (
        views_of_places(rig.cameras, places_px, np.ones(places_px.shape), position_m, velocity_m_s)
        for places_px in (used_px, all_px)
    )
    # One frame is lost, however many of them are looked at.
    change = find_change(used, shown, seen.fps)
    return None if change is None else replace(change, frame=change.frame * step)


def _velocities(
    position_m: Float[np.ndarray, "frames bodies 3"], rate_hz: float
) -> Float[np.ndarray, "frames bodies 3"]:
    """Velocities from the nearest places a little earlier and later, m/s; 0 where there is none."""
    apart, number = max(1, round(VELOCITY_S * rate_hz)), np.arange(len(position_m))
    earlier, later = (np.clip(number + there, 0, len(number) - 1) for there in (-apart, apart))
    before_m, after_m = (_nearest(position_m, position_m[there]) for there in (earlier, later))
    per_s = rate_hz / np.maximum(later - earlier, 1)
    return np.nan_to_num((after_m - before_m) * per_s[:, None, None])


def _nearest(
    position_m: Float[np.ndarray, "frames bodies 3"], other_m: Float[np.ndarray, "frames bodies 3"]
) -> Float[np.ndarray, "frames bodies 3"]:
    """Of the other places of each frame, the one that is nearest to each place."""
    distance_m = np.linalg.norm(position_m[:, :, None] - other_m[:, None], axis=-1)
    nearest = np.nan_to_num(distance_m, nan=np.inf).argmin(axis=-1)
    return np.take_along_axis(other_m, nearest[..., None], axis=1)


def _find_faults(
    rig: Rig, seen: ExaminedFrames, data: WeightedPoints, lags: Float[np.ndarray, "2 cameras"]
) -> tuple[list[Finding], tuple[float, str]]:
    """Find faults of cameras, the largest first, each without the cameras that were found wrong before.

    What they leave is returned, too: how far off the worst camera is then, standard deviations, and its name.

    The lags of wrong clocks are written into `lags`: to the estimate of all lags together, the sightings of a very
    late video are outliers.
    """
    findings: list[Finding] = []
    names, rest, left = list(rig.names), rig, Corrected(rig, np.zeros(len(rig)))
    # At least half of the cameras are taken as sound.
    while len(findings) < max(1, len(rig) // 2):
        finding = _gross_fault(rest, seen, data.points)
        if finding is None:
            fault = find_fault(rest, data)
            if fault is None or (findings and not fault.certain):
                break
            finding, left = diagnosis.describe_fault(rest, fault, seen.fps), left.by(fault.best.step)
            if seen.viewpoints(rest) < 3:
                message = f"the cameras disagree, for example as if {finding.message}"
                remedy = "two viewpoints do not show which camera is wrong: check both, or use more cameras"
                both = tuple(rest.names[each] for each in np.flatnonzero(data.used.any(axis=0)))
                finding = Finding("unclear", both, message, remedy)
            if finding.kind == "clock":
                column = list(fault.best.hypothesis.columns)
                number = names.index(finding.cameras[0])
                lags[:, number] = fault.best.step[column].item(), fault.best.std[column].item()
        findings.append(finding)
        index = [number for number, name in enumerate(rest.names) if name not in finding.cameras]
        if finding.kind == "unclear" or len(index) in (0, len(rest)):
            break
        seen, rest = seen.by(index), rest.select([rest.names[number] for number in index])
        if seen.viewpoints(rest) < 3:
            break
        left = Corrected(rest, np.zeros(len(rest)))
        data = weigh(left, seen.common_points(rest))
    off_std = np.nan_to_num(_off_std(left, data))
    return findings, (float(off_std.max()), left.rig.names[int(off_std.argmax())])


def _off_std(corrected: Corrected, data: WeightedPoints) -> Float[np.ndarray, "cameras"]:
    """Median distances of the cameras' sightings from where the others put the bodies, standard deviations of boxes."""
    return medians(misfit_px(corrected, data) / (NOISE_PX + NOISE_SHARE * data.points.side_px))


def _gross_fault(rig: Rig, seen: ExaminedFrames, points: CommonPoints) -> Finding | None:
    """A camera whose sightings take no part in the loose matching, and are not where the others see the bodies."""
    wrong: list[tuple[float, str]] = []
    for index in np.flatnonzero(points.share < SUSPECT_SHARE * np.median(points.share)).tolist():
        others = [number for number in range(len(rig)) if number != index]
        rest = rig.select([rig.names[number] for number in others])
        by_others = seen.by(others)
        if by_others.viewpoints(rest) < 3:
            continue
        known, boxes = by_others.common_points(rest), seen.sightings
        noise_px = boxes.noise_px[known.frame, index]
        # A camera that seldom has a detection is not known to be wrong.
        if len(known.frame) < MIN_POINTS_OF_CAMERA or np.isfinite(noise_px).any(axis=1).mean() < 0.5:
            continue
        off_px = (
            boxes.centre_px[known.frame, index]
            - project_visible(rig.cameras[index], known.start_m)[0][:, None]
        )
        explained = float((np.linalg.norm(off_px, axis=-1) < NEAR_STD * noise_px).any(axis=1).mean())
        if explained < NOTHING_EXPLAINED:
            wrong.append((explained, rig.names[index]))
    return diagnosis.describe_gross_fault(*min(wrong)) if wrong else None


def _check_numbers(rig: Rig, seen: ExaminedFrames) -> tuple[list[Finding], Rig]:
    """Find implausible lengths, and correct them: findings, and the corrected rig."""
    findings = []
    cameras = rig.cameras
    distances_m = [np.linalg.norm(a - b) for a, b in combinations(cameras.centre_world, 2)]
    apart_m = float(np.median(distances_m)) if distances_m else 1.0
    # Between these limits every distance is plausible.
    factor = 1e-3 if apart_m > PLAUSIBLE_M[1] else 1e3 if apart_m < PLAUSIBLE_M[0] else 1.0
    if factor != 1.0 and PLAUSIBLE_M[0] <= factor * apart_m <= PLAUSIBLE_M[1]:
        body_m = _body_size_m(rig, seen)
        # Far cameras that see bodies of plausible size are no fault: a drone that is flown over a wide field.
        if body_m is None or not PLAUSIBLE_BODY_M[0] <= body_m <= PLAUSIBLE_BODY_M[1]:
            read, right = ("metres", "millimetres") if factor < 1 else ("millimetres", "metres")
            message = f"the calibration: cameras are {apart_m:.3g} m apart: {right} were read as {read}"
            remedy = f"name the unit in the header, cam_x[{'mm' if factor < 1 else 'm'}]"
            findings.append(Finding("unit", (), message, remedy))
            T = cameras.T_cam_world.copy()
            T[:, :3, 3] *= factor
            cameras = replace(cameras, T_cam_world=T)
    return findings, Rig(rig.names, cameras)


def _body_size_m(rig: Rig, seen: ExaminedFrames) -> float | None:
    """Median size of the bodies by the rig, metres; None if too few agree."""
    few = replace(seen, frames=seen.frames[: FEWEST_RUNS * RUN_FRAMES], bounds_m=wide_bounds(rig))
    points = few.common_points(rig)
    if len(points.frame) < MIN_POINTS:
        return None
    distance_m = np.linalg.norm(points.start_m[:, None] - rig.cameras.centre_world, axis=-1)
    return float(np.nanmedian(points.side_px / rig.cameras.K[:, 0, 0] * distance_m))


def _why_unknown(
    rig: Rig,
    seen: ExaminedFrames,
    explained: Int[np.ndarray, "cameras"],
    points: CommonPoints,
    data: WeightedPoints,
) -> Finding | None:
    """Why the rig cannot be checked; None if it can."""
    total = int(seen.count.sum())
    agree = max(explained.sum() / max(total, 1), float(points.share.max(initial=0))) >= MIN_SHARE
    remedy = "the rig cannot be checked; pass other --detections"
    if total < MIN_POINTS_OF_CAMERA or (agree and len(points.frame) < MIN_POINTS):
        message = (
            f"the detections: only {total} in {len(seen.frames)} examined frames, which give {len(points.frame)} "
            "points that the cameras see together for long enough"
        )
        return Finding("too little seen", (), message, remedy)
    if not agree:
        return diagnosis.describe_disagreement(explained.sum() / total, total, seen.viewpoints(rig))
    consistent = data.used.sum() / points.seen.sum()
    if consistent >= MIN_CONSISTENT:
        return None
    message = (
        f"the detections: of those that agree over the cameras, only {consistent:.0%} go on from frame to frame, "
        "so the others agree by chance"
    )
    return Finding("too little seen", (), message, remedy)


def _median_epipolar_distances(rig: Rig, points: CommonPoints) -> Float[np.ndarray, "cameras cameras"]:
    median_px = np.full((len(rig), len(rig)), np.nan)
    for pair in combinations(range(len(rig)), 2):
        first, second = (rig.cameras[index] for index in pair)
        px = points.centre_px[points.seen[:, pair].all(axis=1)][:, pair]
        distance_px = epipolar_distance(first, second, px[:, 0], px[:, 1]).max(axis=-1)
        median_px[pair] = median_px[pair[::-1]] = medians(np.diagonal(distance_px)[:, None])[0]
    return median_px
