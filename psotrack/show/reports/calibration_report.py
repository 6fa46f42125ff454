"""The report of a calibration: errors of each camera, coverage of each image, and the cameras in 3D."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from psotrack.errors import InputError, PsotrackError
from psotrack.geometry.rig_files import read_rig
from psotrack.show.reports.page import check_page_path, render, write_page
from psotrack.show.reports.scene import Scene3D
from psotrack.show.reports.tables import PageCell, PageTable, number, percent
from psotrack.support import convert, read_json

#: Largest number of views, corners and pixels along a side.
_MOST = 10**9


class CalibratedCamera(msgspec.Struct, frozen=True):
    """Figures of one camera, as `calibrate rig --json` writes them."""

    views: int
    corners: int
    rms_px: float
    median_px: float
    own_median_px: float
    covered: float
    focal_px: tuple[float, float]
    centre_m: tuple[float, float, float]
    centre_std_m: tuple[float | None, float | None, float | None]
    focal_std_px: tuple[float | None, float | None] = (None, None)
    lens: str = ""
    best_partner: str = ""
    shared: int = 0
    coverage: tuple[tuple[int, ...], ...] = ()
    image_size_wh: tuple[int, int] = (4, 3)


class WorstView(msgspec.Struct, frozen=True):
    """A view of large residuals."""

    camera: str
    frame: int
    residual_px: float


class CalibrationRecord(msgspec.Struct, frozen=True):
    """What `calibrate rig --json` writes, by a board."""

    rig: str
    cameras: dict[str, CalibratedCamera]
    advice: tuple[str, ...] = ()
    print: tuple[str, ...] = ()
    worst_views: tuple[WorstView, ...] = ()
    world: str = ""


def is_calibration_record(path: Path | str) -> bool:
    """Whether a JSON file is what `calibrate rig --json` writes."""
    try:
        content = read_json(path)
    except PsotrackError:
        return False
    return {"rig", "cameras"} <= set(content)


def write_calibration_report(path: Path | str, record_path: Path | str, *, force: bool = False) -> None:
    """Write the report of a calibration.

    Args:
        path: file that ends in .html.
        record_path: file that `calibrate rig --json` wrote.
        force: replace an existing file.

    Raises:
        InputError: the file is no record of a calibration by a board, or the rig that it names cannot be read.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    check_page_path(path, force)
    record_path = Path(record_path)
    record = _read(record_path)
    rig_path = _rig_path(record_path, record.rig)
    rig = read_rig(rig_path)
    rms_px = [camera.rms_px for camera in record.cameras.values()]
    text = render(
        "calibration.html",
        scenes={"scene": Scene3D(np.zeros(1), rig=rig)},
        title=f"Calibration {rig_path.name}",
        name=f"Calibration {rig_path.name}",
        figures=(
            (f"{len(record.cameras)}", "cameras"),
            (f"{np.median(rms_px):.2f} px", "median rms"),
            (f"{max(rms_px):.2f} px", "largest rms"),
            (f"{100 * min(camera.covered for camera in record.cameras.values()):.0f} %", "least coverage"),
        ),
        table=_table(record),
        coverage=[_grid(name, camera) for name, camera in record.cameras.items()],
        sentences=[*record.print, *record.advice],
        worst=record.worst_views,
        world=record.world,
    )
    write_page(path, text, force=force)


def _read(path: Path) -> CalibrationRecord:
    content = read_json(path, "JSON, as `calibrate rig --json` writes it")

    def wrong(field: str, expected: str, found: str, remedy: str) -> InputError:
        return InputError(f"{path}, {field}", expected=expected, found=found, remedy=remedy)

    if not content.get("cameras"):
        raise InputError(path, expected="the record of a calibration by a board", found="no cameras")
    record = convert(content, CalibrationRecord, wrong)
    for name, camera in record.cameras.items():
        if len({len(line) for line in camera.coverage}) > 1:
            raise wrong(f"cameras.{name}.coverage", "lines of equal length", "different ones", "")
        cells = [count for line in camera.coverage for count in line]
        if wrong_cells := [count for count in cells if not 0 <= count <= _MOST]:
            expected = f"numbers from 0 to {_MOST}"
            raise wrong(f"cameras.{name}.coverage", expected, f"{wrong_cells[0]}", "")
        for field in ("views", "corners", "shared"):
            if not 0 <= (count := getattr(camera, field)) <= _MOST:
                raise wrong(f"cameras.{name}.{field}", f"a number from 0 to {_MOST}", f"{count}", "")
        if not all(1 <= side <= _MOST for side in camera.image_size_wh):
            raise wrong(f"cameras.{name}.image_size_wh", "a width and height", f"{camera.image_size_wh}", "")
    return record


def _rig_path(record_path: Path, rig: str) -> Path:
    """The rig that a record names: as named, or beside the record where both were moved."""
    named, beside = Path(rig), record_path.parent / Path(rig).name
    found = next((place for place in (beside, named) if place.is_file()), None)
    if found is None:
        raise InputError(record_path, expected=f"the rig {rig}, or {beside}", found="neither")
    return found


def _table(record: CalibrationRecord) -> PageTable:
    rows = tuple(
        (
            PageCell(name),
            PageCell(camera.lens),
            number(camera.views),
            number(camera.corners),
            number(camera.rms_px, 2),
            number(camera.median_px, 2),
            number(camera.own_median_px, 2),
            percent(camera.covered, 0),
            number(camera.focal_px[0], 1),
            number(camera.focal_std_px[0], 1),
            PageCell(" ".join(f"{part:.3f}" for part in camera.centre_m)),
            number(_length(camera.centre_std_m), 1, factor=1e3),
            PageCell(f"{camera.best_partner} ({camera.shared})" if camera.best_partner else "–"),  # noqa: RUF001
        )
        for name, camera in record.cameras.items()
    )
    headings = (
        *("camera", "lens", "views", "corners", "rms (px)", "median (px)", "within views (px)", "covered"),
        *("f (px)", "std f (px)", "centre (m)", "std (mm)", "shares most views with"),
    )
    note = (
        "rms: of the corners that count. Within views: errors of the corners and of the lens alone. Covered: share of "
        "the image in which corners were found."
    )
    return PageTable(headings, rows, note)


def _length(parts: tuple[float | None, ...]) -> float | None:
    known = [part for part in parts if part is not None]
    return float(np.linalg.norm(known)) if len(known) == len(parts) else None


def _grid(name: str, camera: CalibratedCamera) -> dict[str, Any]:
    """Coverage of one camera: cells with their shade from 0 (no corner) to 1 (most corners)."""
    counts = np.array(camera.coverage, float)
    most = counts.max() if counts.size else 0
    cells = [
        {
            "x": column,
            "y": row,
            "shade": round(0.15 + 0.85 * float(np.sqrt(count / most)), 3) if count else 0,
            "count": int(count),
        }
        for row, line in enumerate(camera.coverage)
        for column, count in enumerate(line)
    ]
    rows, columns = counts.shape if counts.size else (0, 0)
    return {
        "name": name,
        "cells": cells,
        "rows": rows,
        "columns": columns,
        "aspect": camera.image_size_wh[0] / camera.image_size_wh[1],
    }
