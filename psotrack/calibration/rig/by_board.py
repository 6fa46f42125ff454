"""A rig from videos of a board: the views, the calibration, and what people are told of it."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from psotrack.calibration.board_recognition import describe_board, detect_board
from psotrack.calibration.boards import Board
from psotrack.calibration.lens_models import known_lenses, lenses_at_size, parse_lens_model
from psotrack.calibration.rig.adjustment import (
    CalibratedRig,
    LensChoice,
    calibrate_rig,
    in_new_world,
    start_lenses,
)
from psotrack.calibration.rig.findings import (
    RigCalibration,
    advise,
    figures_of,
    find_misfit,
    say_print,
    say_searched,
    say_starts,
    worst_views,
)
from psotrack.calibration.rig.point_files import fit_world, read_world, world_in_words
from psotrack.calibration.rig.settings import RigSettings
from psotrack.calibration.rig.shifts import find_board_shifts
from psotrack.calibration.rig.views import (
    CameraImages,
    FoundBoards,
    Instants,
    choose_instants,
    find_views,
    first_images,
    instants_of_numbers,
    open_images,
    open_recorded,
)
from psotrack.errors import errors_name
from psotrack.geometry.rig_files import read_lenses
from psotrack.recordings.datasets import is_recording, open_recording
from psotrack.support import POSITION, Report, format_numbers, no_progress

_logger = logging.getLogger(__name__)

#: Largest number of times that the views are found: after two shifts the frames are the right ones.
_MOST_ROUNDS = 3

_HEADINGS = ("camera", "views", "rms (px)", "f (px)", POSITION, "std (mm)")


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
    given = None if settings.world is None else read_world(settings.world)
    if len(sources) == 1 and is_recording(sources[0]):
        cameras, instants = open_recorded(open_recording(sources[0]))
    else:
        cameras = open_images(sources, settings.names)
        instants = instants_of_numbers(cameras)
    lenses, said = _lens_choice(settings, cameras), []
    if settings.squares is None:
        stated = detect_board(settings.square_m or 0.0, first_images(cameras, 4))
        said.append(f"the board is {describe_board(stated)}")
        _logger.info("%s", said[0])
    else:
        stated = Board.of(settings)
    with errors_name(f"{sources[0]} and {len(sources) - 1} more" if sources[1:] else sources[0]):
        found, lenses, shifts = _find_views(stated, cameras, instants, lenses, settings.floor, report)
        said += say_searched(found)
        said += say_starts(found.views.names, shifts)
        calibrated = calibrate_rig(found.board, found.views, lenses, floor=settings.floor, report=report)
    if given is not None:
        with errors_name(given.path):
            change, left_m = fit_world(calibrated.rig, given, with_scale=False)
        calibrated, place = in_new_world(calibrated, change), world_in_words(given.path, left_m)
    elif settings.floor is not None:
        place = f"the board in frame {settings.floor}: its first corner is the origin, z points up"
    else:
        first = calibrated.rig.names[0]
        place = f"camera {first}: x right, y down, z forward; --floor and --world place it elsewhere"
    begins = {name: -shift for name, shift in zip(found.views.names, shifts, strict=True)}
    return _result(calibrated, said, say_print(found), place, begins)


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
        found = find_views(board, cameras, choose_instants(instants, floor, shifts.tolist()), report)
        if lenses.start is None:
            lenses = replace(lenses, start=start_lenses(found.board, found.views, lenses, report))
        # A shift that is found between searched frames is looked at once more where it has these frames.
        more = find_board_shifts(found.board, found.views, lenses.start or {})
        if not more.any():
            break
        shifts += more
    return found, lenses, shifts.tolist()


def _result(
    calibrated: CalibratedRig, said: list[str], printed: list[str], world: str, begins: Mapping[str, int]
) -> RigCalibration:
    """The figures of the cameras, the views that fit worst, and what to do.

    Args:
        calibrated: the rig, and how it fits each view.
        said: sentences on the board, and on which frames were searched for it.
        printed: sentences on how the board was printed and seen.
        world: what the world is.
        begins: by how many frames each camera begins after the first one.
    """
    figures, worst, advice = figures_of(calibrated), worst_views(calibrated), advise(calibrated)
    rows = [
        (
            name,
            f"{row['views']}",
            f"{row['rms_px']:.2f}",
            f"{row['focal_px'][0]:.1f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{row['focal_std_px'][0]:.1f}",
            format_numbers(row["centre_m"], 3),
            f"{1e3 * math.hypot(*row['centre_std_m']):.1f}",
        )
        for name, row in figures.items()
    ]
    models = ", ".join(f"{name} {row['lens']}" for name, row in figures.items())
    more = {
        "print": printed,
        "begins": dict(begins),
        "worst_views": [dict(zip(("camera", "frame", "residual_px"), view, strict=True)) for view in worst],
        "advice": advice,
        "world": world,
    }
    after = [
        f"lens models (distortion coefficients): {models}",
        f"worst views (camera, frame, px): {', '.join(f'{name} {frame} {px:.2f}' for name, frame, px in worst)}",
        *advice,
        f"the world is {world}",
    ]
    return RigCalibration(
        calibrated.rig,
        figures,
        (_HEADINGS, rows),
        [*said, *printed],
        after,
        more,
        calibrated,
        misfit=find_misfit(calibrated, advice),
    )


def _lens_choice(settings: RigSettings, cameras: Sequence[CameraImages]) -> LensChoice:
    model = parse_lens_model(settings.lens)
    if settings.lenses is None:
        return LensChoice(model)
    sizes_wh = {camera.name: camera.image_size_wh for camera in cameras}
    return LensChoice(
        model, known_lenses(lenses_at_size(settings.lenses, read_lenses(settings.lenses), sizes_wh))
    )
