"""A rig from a board, or from points: one that moves, the two ends of a stick, or points of known place."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from psotrack.calibration.board_recognition import describe_board, detect_board
from psotrack.calibration.boards import Board
from psotrack.calibration.extrinsics import locate_camera
from psotrack.calibration.lens_models import known_lenses, lens_of_view, lenses_at_size, parse_lens_model
from psotrack.calibration.rig import findings, point_files
from psotrack.calibration.rig import views as board_views
from psotrack.calibration.rig.adjustment import LensChoice, calibrate_rig, in_new_world, start_lenses
from psotrack.calibration.rig.findings import RigCalibration
from psotrack.calibration.rig.moving_point import (
    LOOSE,
    PointRig,
    PointViews,
    calibrate_by_point,
    covariance_of_centres,
)
from psotrack.calibration.rig.settings import RigSettings
from psotrack.calibration.rig.shifts import find_board_shifts, find_point_shifts
from psotrack.calibration.rig.views import CameraImages, FoundBoards, Instants
from psotrack.calibration.rig.world import Similarity, world_of_camera
from psotrack.errors import InputError, SettingsError, errors_name
from psotrack.geometry import Rig, chosen_camera, make_rig
from psotrack.geometry.rig_files import read_lenses
from psotrack.recordings import read_detections
from psotrack.recordings.datasets import is_recording, open_recording
from psotrack.support import Report, no_progress

_logger = logging.getLogger(__name__)

#: Largest number of times that the views are found: after two shifts the frames are the right ones.
_MOST_ROUNDS = 3
#: Fraction of the sightings below which the user is told how few are used.
_FEW_USED = 0.5


def calibrate_by_board(
    sources: Sequence[Path], settings: RigSettings, report: Report = no_progress
) -> RigCalibration:
    """Calibrate a rig by a board that is moved before the cameras.

    Args:
        sources: a video, a folder of images or a pattern of each camera; or one recording.
        settings: what is known.
        report: display of the progress.

    Raises:
        InputError: an image cannot be read, the board is not seen, or the views do not determine the rig.
        SettingsError: the settings do not say what the board is like, or do not fit the sources.
    """
    given = None if settings.world is None else point_files.read_world(settings.world)
    cameras, instants = _open(sources, settings)
    lenses, said = _lens_choice(settings, cameras), []
    if settings.squares is None:
        stated = detect_board(settings.square_m or 0.0, board_views.first_images(cameras, 4))
        said.append(f"the board is {describe_board(stated)}")
        _logger.info("%s", said[0])
    else:
        stated = Board.of(settings)
    with errors_name(f"{sources[0]} and {len(sources) - 1} more" if sources[1:] else sources[0]):
        found, lenses, shifts = _find_views(stated, cameras, instants, lenses, settings.floor, report)
        said += findings.say_searched(found)
        said += findings.say_starts(found.views.names, shifts)
        calibrated = calibrate_rig(found.board, found.views, lenses, floor=settings.floor, report=report)
    if given is not None:
        with errors_name(given.path):
            change, left_m = point_files.fit_world(calibrated.rig, given, with_scale=False)
        calibrated, place = in_new_world(calibrated, change), point_files.world_in_words(given.path, left_m)
    elif settings.floor is not None:
        place = f"the board in frame {settings.floor}: its first corner is the origin, z points up"
    else:
        first = calibrated.rig.names[0]
        place = f"camera {first}: x right, y down, z forward; --floor and --world place it elsewhere"
    begins = {name: -shift for name, shift in zip(found.views.names, shifts, strict=True)}
    return findings.result_of_board(calibrated, said, findings.say_print(found), place, begins)


def _open(sources: Sequence[Path], settings: RigSettings) -> tuple[tuple[CameraImages, ...], Instants]:
    """Images of a recording's cameras, or of each path, and which of them belong to one instant."""
    if len(sources) == 1 and is_recording(sources[0]):
        return board_views.open_recorded(open_recording(sources[0]))
    cameras = board_views.open_images(sources, settings.names)
    return cameras, board_views.instants_of_numbers(cameras)


def _find_views(
    board: Board,
    cameras: Sequence[CameraImages],
    instants: Instants,
    lenses: LensChoice,
    floor: int | None,
    report: Report,
) -> tuple[FoundBoards, LensChoice, list[int]]:
    """Views of the board at instants that are counted as its motion says.

    Also the lenses from which an adjustment starts, and at how many instants later each camera shows what the first
    one shows.
    """
    shifts = np.zeros(len(cameras), np.int64)
    for _ in range(_MOST_ROUNDS):
        chosen = board_views.choose_instants(instants, floor, shifts.tolist())
        found = board_views.find_views(board, cameras, chosen, report)
        if lenses.start is None:
            lenses = replace(lenses, start=start_lenses(found.board, found.views, lenses, report))
        # A shift that is found between searched frames is looked at once more where it has these frames.
        more = find_board_shifts(found.board, found.views, lenses.start or {})
        if not more.any():
            break
        shifts += more
    return found, lenses, shifts.tolist()


def _lens_choice(settings: RigSettings, cameras: Sequence[CameraImages]) -> LensChoice:
    model = parse_lens_model(settings.lens)
    if settings.lenses is None:
        return LensChoice(model)
    sizes_wh = {camera.name: camera.image_size_wh for camera in cameras}
    return LensChoice(
        model, known_lenses(lenses_at_size(settings.lenses, read_lenses(settings.lenses), sizes_wh))
    )


def calibrate_by_moving_point(sources: Sequence[Path], settings: RigSettings) -> RigCalibration:
    """Place the cameras of a rig by a moving point, or by the two ends of a moving stick.

    Args:
        sources: one recording with detections, or one CSV file (see `read_point_views`).
        settings: the lenses, and what fixes the unit of length.

    Raises:
        InputError: a file cannot be read, or the sightings do not determine the rig.
        SettingsError: not one length is given, or no lenses.
    """
    distance, stick_m = settings.distance, settings.stick_m
    lengths = sum(value is not None for value in (distance, stick_m, settings.world))
    if lengths != 1:
        raise SettingsError(
            "length",
            expected="one of --distance NAME,NAME=METRES, --stick METRES and --world FILE",
            found="none" if not lengths else f"{lengths}",
        )
    views = _read_views(sources)
    if stick_m is not None and not views.point.any():
        expected = "the two ends of a stick, told apart by a column named point"
        raise InputError(sources[0], expected=expected, found="one point")
    lenses = _lenses_of(views.names, settings)
    with errors_name(sources[0]):
        found = calibrate_by_point(lenses, views)
    given = None if settings.world is None else point_files.read_world(settings.world)

    def world_of(found: PointRig) -> tuple[Similarity, str]:
        rig = found.rig
        if given is not None:
            change, left_m = point_files.fit_world(rig, given, found.by_number(0), with_scale=True)
            return change, point_files.world_in_words(given.path, left_m)
        factor = (
            (stick_m or 1.0) / point_files.stick_length(found)
            if distance is None
            else distance[2] / point_files.distance_between(rig, *distance[:2])
        )
        words = f"camera {rig.names[0]}: x right, y down, z forward; --world places it elsewhere"
        return world_of_camera(rig, 0, factor), words

    with errors_name(settings.world or sources[0]):
        change, place = world_of(found)
    covariance_m2 = covariance_of_centres(found, lambda found: world_of(found)[0])
    rig, fits = change.rig(found.rig), {}
    for index, name in enumerate(rig.names):
        seen = np.isfinite(found.residual_px[:, index])
        residual_px, used = found.residual_px[seen, index], found.used[seen, index]
        fits[name] = findings.PointFit(
            found.views.number[seen].tolist(), covariance_m2[index], residual_px, used
        )
    shifts = map(str, find_point_shifts(found.rig, views))
    notes = [*_left_out(found, views), f"the world is {place}", *shifts, *_weak(found, rig, covariance_m2)]
    return findings.result_of_points(rig, fits, notes)


def calibrate_by_known_points(
    sources: Sequence[Path],
    settings: RigSettings,
    marker_corners_m: Mapping[int, Float[np.ndarray, "4 3"]] | None = None,
) -> RigCalibration:
    """Place the cameras of a rig by points of known place, or by ArUco markers in their images.

    Args:
        sources: with markers, a recording or the video of each camera; with points none.
        settings: the points, and the lenses.
        marker_corners_m: corners of the markers by number, metres; None for points.

    Raises:
        InputError: a file cannot be read, or the points do not determine a camera's place.
        SettingsError: a video or a world is given where the points stand for it, or there are no lenses.
    """
    if settings.world is not None:
        expected = "none with points of known place, which are the world"
        raise SettingsError("--world", expected=expected, found=f"{settings.world}")
    sizes_wh: dict[str, tuple[int, int]] = {}
    if marker_corners_m is not None:
        opened, _ = _open(sources, settings)
        sizes_wh = {camera.name: camera.image_size_wh for camera in opened}
        marks = {
            camera.name: point_files.find_markers(camera.video, marker_corners_m, settings.dictionary)
            for camera in opened
        }
    elif sources:
        raise SettingsError("--pairs", expected="no video", found=f"{sources[0]}")
    else:
        marks = point_files.read_image_points(settings.pairs or "", settings.places)
    lenses, world = _lenses_of(tuple(marks), settings, sizes_wh), settings.pairs or settings.markers
    cameras, fits, notes = {}, {}, [f"the world is that of {world}"]
    for index, (name, mark) in enumerate(marks.items()):
        lens = lenses.cameras[index]
        with errors_name(world):
            located = locate_camera(
                mark.points_m, mark.points_px, lens, settings.noise_px, name=f"camera {name}"
            )
        cameras[name] = replace(lens, T_cam_world=located.T_cam_world)
        covariance_m2 = located.centre_covariance_m2
        fits[name] = findings.PointFit(mark.points, covariance_m2, located.residual_px, located.used)
        if located.lens_shift_m:
            notes.append(
                f"the residuals of {name} are not noise: another lens explains them, and has the camera "
                f"{1e3 * located.lens_shift_m:.0f} mm away, which its standard deviation contains; calibrate its lens"
            )
    return findings.result_of_points(make_rig(cameras), fits, notes)


def _left_out(found: PointRig, views: PointViews) -> list[str]:
    """A sentence on sightings of a long recording that were left out."""
    both = np.isfinite(views.points_px[..., 0]).sum(axis=1) >= 2
    used, seen = len(np.unique(found.views.number)), len(np.unique(views.number[both]))
    if used == seen:
        return []
    return [f"{used} of {seen} instants at which two cameras see the point are used, evenly spread"]


def _weak(found: PointRig, rig: Rig, covariance_m2: Float[np.ndarray, "cameras 3 3"]) -> list[str]:
    """Sentences on sightings that the rig does not explain, and on cameras that they hardly determine."""
    sentences = []
    used, seen = int(found.used.any(axis=1).sum()), len(found.views.number)
    if used < _FEW_USED * seen:
        sentences.append(
            f"only {used} of {seen} sightings by two cameras fit the rig: check that frames of equal number are of "
            "one instant, that the cameras see the same thing, and the lenses"
        )
    centres = np.asarray(rig.cameras.centre_world)
    apart_m = np.linalg.norm(centres[:, None] - centres, axis=-1).max(axis=1)
    std_m = np.sqrt(np.trace(covariance_m2, axis1=1, axis2=2))
    loose = [
        f"{name} (± {std:.2g} m, {apart:.2g} m from the farthest camera)"
        for name, std, apart in zip(rig.names, std_m, apart_m, strict=True)
        if std > LOOSE * apart
    ]
    if loose:
        sentences.append(
            f"the sightings hardly determine the places of {', '.join(loose)}: move the point nearer to the cameras, "
            "check the lenses, add a camera, or give points of known place with --pairs"
        )
    return sentences


def _lenses_of(
    names: Sequence[str], settings: RigSettings, sizes_wh: Mapping[str, tuple[int, int]] | None = None
) -> Rig:
    """Lenses of the cameras, from a calibration or a data sheet; a file with one camera has the lens of all.

    `sizes_wh` has the sizes of the images where they are known, pixels.
    """
    path, fov_deg = settings.lenses, settings.fov_deg
    if (path is None) == (fov_deg is None):
        raise SettingsError(
            "--lenses",
            expected="a calibration with the lens of each camera, or --fov H,V",
            found="none" if path is None else "both",
        )
    if path is not None:
        lenses = read_lenses(path, settings.size)
    elif settings.size is None:
        raise SettingsError("--size", expected="width and height of the images", found="none")
    else:
        lenses = make_rig({"all": lens_of_view(*(fov_deg or (0.0, 0.0)), settings.size)})
    one = lenses.names[0] if len(lenses) == 1 else None
    chosen = [one or chosen_camera(name, lenses.names) for name in names]
    for name, found in zip(names, chosen, strict=True):
        if found is None:
            raise InputError(
                path or "lenses", expected=f"the lens of {name}", found=f"only {', '.join(lenses.names)}"
            )
    rows = np.array([lenses.names.index(found) for found in chosen if found is not None])
    if settings.size is not None and not sizes_wh:
        sizes_wh = dict.fromkeys(names, settings.size)
    return lenses_at_size(path or Path("--size"), Rig(tuple(names), lenses.cameras[rows]), sizes_wh or {})


def _read_views(sources: Sequence[Path]) -> PointViews:
    """Sightings from a CSV file, or from the detections of a recording."""
    if len(sources) != 1:
        expected = "one recording or one CSV file"
        raise SettingsError("--points", expected=expected, found=f"{len(sources)} paths")
    if sources[0].suffix.lower() == ".csv":
        return point_files.read_point_views(sources[0])
    recording = open_recording(sources[0])
    if not recording.detections:
        raise InputError(sources[0], expected="detections of a moving point", found="none")
    boxes = {name: read_detections(path) for name, path in recording.detections.items()}
    times = {each.name: each.times for each in recording.cameras if each.times}
    line_time_s = {each.name: each.line_time_s for each in recording.cameras}
    with errors_name(sources[0]):
        return point_files.views_of_detections(boxes, times, line_time_s)
