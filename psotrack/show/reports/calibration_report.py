"""The report of a calibration: errors of each camera, coverage of each image, and the cameras in 3D."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from psotrack.errors import InputError, PsotrackError
from psotrack.geometry.rig_files import read_rig
from psotrack.show.reports.page import check_page_path, render, write_page
from psotrack.show.reports.scene import Scene3D
from psotrack.show.reports.tables import PageColumn, make_table, percent
from psotrack.support import convert, read_json

Count = Annotated[int, msgspec.Meta(ge=0, le=10**9)]
Side = Annotated[int, msgspec.Meta(ge=1, le=10**9)]

_CAMERAS = (
    PageColumn("camera", "camera"),
    PageColumn("lens", "lens"),
    PageColumn("views", "views", 0),
    PageColumn("corners", "corners", 0),
    PageColumn("rms (px)", "rms_px", 2),
    PageColumn("median (px)", "median_px", 2),
    PageColumn("within views (px)", "own_median_px", 2),
    percent("covered", "covered", 0),
    PageColumn("f (px)", "focal", 1),
    PageColumn("std f (px)", "focal_std", 1),
    PageColumn("centre (m)", "centre"),
    PageColumn("std (mm)", "centre_std", 1, 1e3),
    PageColumn("shares most views with", "partner"),
)
_NOTE = (
    "rms: of the corners that count. Within views: errors of the corners and of the lens alone. Covered: share of the "
    "image in which corners were found."
)


class CalibratedCamera(msgspec.Struct, frozen=True):
    """Figures of one camera, as `calibrate rig --json` writes them."""

    views: Count
    corners: Count
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
    shared: Count = 0
    coverage: tuple[tuple[Count, ...], ...] = ()
    image_size_wh: tuple[Side, Side] = (4, 3)


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
    # The rig as named, or beside the record where both were moved.
    places = (record_path.parent / Path(record.rig).name, Path(record.rig))
    rig_path = next((place for place in places if place.is_file()), None)
    if rig_path is None:
        raise InputError(record_path, expected=f"the rig {record.rig}, or {places[0]}", found="neither")
    cameras = record.cameras.values()
    rms_px = [camera.rms_px for camera in cameras]
    text = render(
        "calibration.html",
        Scene3D(np.zeros(1), rig=read_rig(rig_path)),
        title=f"Calibration {rig_path.name}",
        figures=(
            (f"{len(cameras)}", "cameras"),
            (f"{np.median(rms_px):.2f} px", "median rms"),
            (f"{max(rms_px):.2f} px", "largest rms"),
            (f"{100 * min(camera.covered for camera in cameras):.0f} %", "least coverage"),
        ),
        table=make_table(_CAMERAS, [_row(*item) for item in record.cameras.items()], _NOTE),
        record=record,
    )
    write_page(path, text, force=force)


def _read(path: Path) -> CalibrationRecord:
    content = read_json(path, "JSON, as `calibrate rig --json` writes it")

    def wrong(field: str, expected: str, found: str, remedy: str) -> InputError:
        return InputError(f"{path}, {field}", expected=expected, found=found, remedy=remedy)

    if not content.get("cameras"):
        raise InputError(path, expected="the record of a calibration by a board", found="no cameras")
    return convert(content, CalibrationRecord, wrong)


def _row(name: str, camera: CalibratedCamera) -> dict[str, Any]:
    """Figures of a camera as its row shows them."""
    return {
        **msgspec.structs.asdict(camera),
        "camera": name,
        "focal": camera.focal_px[0],
        "focal_std": camera.focal_std_px[0],
        "centre": " ".join(f"{part:.3f}" for part in camera.centre_m),
        "centre_std": float(np.linalg.norm(np.array(camera.centre_std_m, float))),
        "partner": f"{camera.best_partner} ({camera.shared})" if camera.best_partner else "",
    }
