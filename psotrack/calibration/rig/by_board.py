"""A rig from videos of a board: the views, the calibration, and what people are told of it."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from psotrack.calibration.board_recognition import describe_board, detect_board
from psotrack.calibration.boards import Board
from psotrack.calibration.lens_models import known_lenses, parse_lens_model
from psotrack.calibration.rig.adjustment import CalibratedRig, LensChoice, calibrate_rig, in_new_world
from psotrack.calibration.rig.findings import advise, figures_of, say_print, say_searched, worst_views
from psotrack.calibration.rig.images import first_images, instants_of_numbers, open_images, open_recorded
from psotrack.calibration.rig.point_files import fit_world, read_world, world_in_words
from psotrack.calibration.rig.settings import RigSettings
from psotrack.calibration.rig.views import find_views
from psotrack.errors import errors_name
from psotrack.geometry import Rig
from psotrack.geometry.rig_files import read_lenses
from psotrack.recordings.datasets import is_recording, open_recording
from psotrack.support import (
    POSITION,
    Report,
    format_numbers,
    html_block,
    html_table,
    no_progress,
    text_table,
)

_logger = logging.getLogger(__name__)

_HEADINGS = ("camera", "views", "rms (px)", "f (px)", POSITION, "std (mm)")


@dataclass(frozen=True, repr=False)
class RigCalibration:
    """A rig that was calibrated by a board; its text is what `psotrack calibrate rig` prints.

    Attributes:
        calibrated: the rig, and how it fits each view.
        found: sentences on the board, and on which frames were searched for it.
        printed: sentences on how the board was printed and seen.
        world: what the world is.
        path: file of the rig; None where it is not written.
    """

    calibrated: CalibratedRig
    found: tuple[str, ...]
    printed: tuple[str, ...]
    world: str
    path: Path | None = None

    @property
    def rig(self) -> Rig:
        """The cameras."""
        return self.calibrated.rig

    def to_dict(self) -> dict[str, Any]:
        """Figures of the cameras, the views that fit worst, and what to do."""
        worst = worst_views(self.calibrated)
        return {
            "rig": None if self.path is None else str(self.path),
            "cameras": {name: asdict(row) for name, row in figures_of(self.calibrated).items()},
            "print": list(self.printed),
            "worst_views": [
                {"camera": name, "frame": frame, "residual_px": residual} for name, frame, residual in worst
            ],
            "advice": advise(self.calibrated),
            "world": self.world,
        }

    def __str__(self) -> str:
        models = ", ".join(f"{name} {row.lens}" for name, row in figures_of(self.calibrated).items())
        worst = ", ".join(f"{name} {frame} {off:.2f}" for name, frame, off in worst_views(self.calibrated))
        lines = [
            *self.found,
            *self.printed,
            text_table(_HEADINGS, self._rows()),
            f"lens models (distortion coefficients): {models}",
            f"worst views (camera, frame, px): {worst}",
            *advise(self.calibrated),
            f"the world is {self.world}",
        ]
        return "\n".join(lines if self.path is None else [*lines, f"{self.path}"])

    def __repr__(self) -> str:
        return f"RigCalibration({', '.join(self.rig.names)}; the world is {self.world})"

    def _repr_html_(self) -> str:
        """What a notebook shows: the table of the cameras, and what to do."""
        return html_block("; ".join(advise(self.calibrated)), html_table(_HEADINGS, self._rows()))

    def _rows(self) -> list[tuple[str, ...]]:
        return [
            (
                name,
                f"{row.views}",
                f"{row.rms_px:.2f}",
                f"{row.focal_px[0]:.1f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{row.focal_std_px[0]:.1f}",
                format_numbers(row.centre_m, 3),
                f"{1e3 * math.hypot(*row.centre_std_m):.1f}",
            )
            for name, row in figures_of(self.calibrated).items()
        ]


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
    given, lenses = None if settings.world is None else read_world(settings.world), _lens_choice(settings)
    if len(sources) == 1 and is_recording(sources[0]):
        cameras, instants = open_recorded(open_recording(sources[0]), settings.floor)
    else:
        cameras = open_images(sources, settings.names)
        instants = instants_of_numbers(cameras, settings.floor)
    said = []
    if settings.squares is None:
        stated = detect_board(settings.square_m or 0.0, first_images(cameras, 4))
        said.append(f"the board is {describe_board(stated)}")
        _logger.info("%s", said[0])
    else:
        stated = Board.of(settings)
    with errors_name(f"{sources[0]} and {len(sources) - 1} more" if sources[1:] else sources[0]):
        found = find_views(stated, cameras, instants, report)
        every = {camera.name: len(camera.frames) for camera in cameras}
        searched = zip(found.views.names, found.searched.tolist(), strict=True)
        said += say_searched({name: (count, every[name]) for name, count in searched})
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
    return RigCalibration(calibrated, tuple(said), tuple(say_print(found)), place)


def _lens_choice(settings: RigSettings) -> LensChoice:
    known = None if settings.lenses is None else known_lenses(read_lenses(settings.lenses))
    return LensChoice(parse_lens_model(settings.lens), known, settings.same_lens)
