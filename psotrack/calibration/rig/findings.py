"""What a calibration of a rig gives: its record, figures of each camera, and sentences on what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import ceil, hypot
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float

from psotrack.calibration.rig.adjustment import CalibratedRig
from psotrack.calibration.rig.views import FoundBoards
from psotrack.errors import InputError
from psotrack.geometry import Rig
from psotrack.support import (
    POSITION,
    finite_or_none,
    format_numbers,
    html_block,
    html_table,
    save_figure,
    text_table,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Columns and rows of cells of an image; a cell with a corner is covered.
CELLS = (8, 6)
#: Smallest fraction of an image that the board should have covered.
_COVERED = 0.5
#: Smallest number of views that a camera should share with another one.
_SHARED = 12
#: Largest standard deviation of a focal length, as a fraction of it, that needs no advice.
_FOCAL_STD = 0.005
#: A camera's views slip if the residuals are larger by this factor, and by this many pixels, than within the views.
_SLIP_FACTOR, _SLIP_PX = 2.0, 0.3
#: Largest distance of a board from where a camera sees it, median of the instants, as a fraction of the image's longer
#: side: ten pixels of 1920. A board that is moved by hand is within it for frames that are half an interval apart.
_MISFIT = 0.005
#: Largest number of pictures in a row.
_PICTURES = 4
#: Residuals from this multiple of the median residual on have the brightest colour.
_BRIGHT = 4.0
#: Number of views, and of points of each camera, that are named: those that fit worst.
_WORST = 5
_HEADINGS = ("camera", "views", "rms (px)", "f (px)", POSITION, "std (mm)")


@dataclass(frozen=True, repr=False)
class RigCalibration:
    """A rig that was calibrated; its text is what `psotrack calibrate rig` prints.

    Attributes:
        rig: the cameras.
        cameras: figures of each camera, by its name.
        table: headings, and a row of texts of each camera.
        before: sentences above the table.
        after: sentences below the table.
        more: what JSON has besides the cameras.
        calibrated: how the rig fits each view of a board; None without a board.
        misfit: error about views that do not fit the rig, which is then not written without `force`; None where all do.
        path: file of the rig; None where it is not written.
    """

    rig: Rig
    cameras: Mapping[str, dict[str, Any]]
    table: tuple[Sequence[str], Sequence[Sequence[str]]]
    before: Sequence[str] = ()
    after: Sequence[str] = ()
    more: Mapping[str, Any] = field(default_factory=dict)
    calibrated: CalibratedRig | None = None
    misfit: InputError | None = None
    path: Path | None = None

    def to_dict(self) -> dict[str, Any]:
        """The figures of the cameras, and the sentences."""
        path = None if self.path is None else str(self.path)
        return {"rig": path, "cameras": dict(self.cameras), **self.more}

    def __str__(self) -> str:
        path = () if self.path is None else (f"{self.path}",)
        return "\n".join([*self.before, text_table(*self.table), *self.after, *path])

    def __repr__(self) -> str:
        return f"RigCalibration({', '.join(self.rig.names)}; {'; '.join(self.after)})"

    def _repr_html_(self) -> str:
        """What a notebook shows: the table of the cameras, and the sentences."""
        return html_block("; ".join(self.after), html_table(*self.table))


def result_of_board(
    calibrated: CalibratedRig, said: list[str], printed: list[str], world: str, begins: Mapping[str, int]
) -> RigCalibration:
    """A calibration by a board: the figures of the cameras, the views that fit worst, and what to do.

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
            f"{1e3 * hypot(*row['centre_std_m']):.1f}",
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


@dataclass(frozen=True)
class PointFit:
    """How points fit one camera.

    Attributes:
        points: names of the points.
        covariance_m2: (3, 3), covariance of the camera's centre, m².
        residual_px: (points,), distances of the points from their projections, pixels; infinite behind the camera.
        used: (points,), False for points that were left out.
    """

    points: Sequence[Any]
    covariance_m2: Float[np.ndarray, "3 3"]
    residual_px: Float[np.ndarray, " points"]
    used: Bool[np.ndarray, " points"]


def result_of_points(rig: Rig, fits: Mapping[str, PointFit], notes: Sequence[str]) -> RigCalibration:
    """The result of a calibration by points: positions, standard deviations, and the points that fit worst.

    Args:
        rig: the cameras.
        fits: how the points fit each camera.
        notes: sentences on the world, and on what the points do not determine.
    """
    cameras, rows, worst = {}, [], []
    for name, centre_m in zip(rig.names, np.asarray(rig.cameras.centre_world), strict=True):
        fit = fits[name]
        std_m = np.sqrt(np.diag(fit.covariance_m2))
        rms_px = float(np.sqrt(np.mean(fit.residual_px[fit.used] ** 2))) if fit.used.any() else None
        points = [
            {
                "point": str(fit.points[index]),
                "residual_px": finite_or_none(fit.residual_px[index]),
                "used": bool(fit.used[index]),
            }
            for index in np.argsort(-fit.residual_px)[:_WORST]
        ]
        cameras[name] = {
            "centre_m": centre_m.tolist(),
            "centre_std_m": std_m.tolist(),
            "points": len(fit.used),
            "used": int(fit.used.sum()),
            "rms_px": rms_px,
            "worst": points,
        }
        rows.append(
            (
                name,
                f"{fit.used.sum()} of {len(fit.used)}",
                "" if rms_px is None else f"{rms_px:.2f}",
                format_numbers(centre_m.tolist(), 3),
                format_numbers((1e3 * std_m).tolist(), 1),
            )
        )
        # Names of points may be too long for a column.
        worst.append(f"{name}, worst points (px): {', '.join(map(_point_in_words, points))}")
    table = ("camera", "points", "rms (px)", POSITION, "std (mm)"), rows
    return RigCalibration(rig, cameras, table, after=[*worst, *notes], more={"notes": list(notes)})


def _point_in_words(one: dict[str, Any]) -> str:
    distance = "behind" if one["residual_px"] is None else f"{one['residual_px']:.1f}"
    return f"{one['point']} {distance}{'' if one['used'] else ' left out'}"


def figures_of(calibrated: CalibratedRig) -> dict[str, dict[str, Any]]:
    """Figures of each camera, by name, fit for JSON.

    Returns:
        for each camera: lens, the model; views and corners that count, and corners found; rms_px of the residuals that
        count; median_px of all corners found, and own_median_px within the views, errors of the corners and of the lens
        alone; covered, the fraction of the image in which corners were found, and coverage, their number in each part,
        row by row; focal_px and focal_std_px along x and y; centre_m in the world and centre_std_m; best_partner, the
        camera that shares most views, or none, and shared, their number.
    """
    rig, views = calibrated.rig, calibrated.views
    others = np.where(np.eye(len(rig), dtype=bool), -1, calibrated.shared)
    rows: dict[str, dict[str, Any]] = {}
    for index, name in enumerate(rig.names):
        used, residual = calibrated.used[index], calibrated.residual_px[index]
        found, cells = np.isfinite(residual), coverage(calibrated, index)
        partner, std = int(others[index].argmax()), calibrated.lens_std[index]
        variance_m2 = np.diag(calibrated.centre_covariance_m2[index])
        rows[name] = {
            "lens": str(calibrated.lens_models[index]),
            "views": int(used.any(axis=-1).sum()),
            "corners": int(used.sum()),
            "found": int(found.sum()),
            "rms_px": float(np.sqrt(np.mean(residual[used] ** 2))),
            "median_px": float(np.median(residual[found])),
            "own_median_px": float(np.median(calibrated.own_residual_px[index][found])),
            "covered": float(cells.astype(bool).mean()),
            "coverage": cells.astype(int).tolist(),
            "image_size_wh": tuple(views.image_size_wh[index].tolist()),
            "focal_px": tuple(np.diag(rig.cameras.K[index])[:2].tolist()),
            "focal_std_px": tuple(std[:2].tolist()),
            "centre_m": tuple(rig.cameras.centre_world[index].tolist()),
            "centre_std_m": tuple(np.sqrt(np.maximum(variance_m2, 0)).tolist()),
            "best_partner": rig.names[partner] if len(views.names) > 1 else "none",
            "shared": max(int(others[index, partner]), 0),
        }
    return rows


def coverage(calibrated: CalibratedRig, camera: int) -> Float[np.ndarray, "rows columns"]:
    """(rows, columns), number of corners in each cell of a camera's image."""
    pixels = calibrated.views.corners_px[camera].reshape(-1, 2)
    pixels = pixels[np.isfinite(pixels[:, 0])]
    width, height = calibrated.views.image_size_wh[camera].tolist()
    counts, _, _ = np.histogram2d(
        pixels[:, 1],
        pixels[:, 0],
        bins=(CELLS[1], CELLS[0]),
        range=((-0.5, height - 0.5), (-0.5, width - 0.5)),
    )
    return counts


def worst_views(calibrated: CalibratedRig) -> list[tuple[str, int, float]]:
    """Camera, number of the instant and median residual, pixels, of the views that fit worst."""
    view_px = calibrated.view_px
    order = np.argsort(-view_px, axis=None)[: min(_WORST, int(np.isfinite(view_px).sum()))]
    return [
        (calibrated.rig.names[camera], int(calibrated.views.number[instant]), float(view_px[camera, instant]))
        for camera, instant in zip(*np.unravel_index(order, view_px.shape), strict=True)
    ]


def say_searched(found: FoundBoards) -> list[str]:
    """A sentence on frames of long videos that were left out."""
    counts = zip(found.views.names, found.searched.tolist(), found.frames.tolist(), strict=True)
    fewer = [f"{name} {some} of {every}" for name, some, every in counts if some < every]
    return [f"frames that were searched for the board, evenly spread: {', '.join(fewer)}"] if fewer else []


def say_starts(names: Sequence[str], shifts: Sequence[int]) -> list[str]:
    """Sentences on cameras that begin at another time than the first one, by the board's motion.

    Args:
        names: names of the cameras.
        shifts: at how many frames later each camera shows what the first one shows.
    """
    return [
        f"{name} begins {abs(shift)} frames {'earlier' if shift > 0 else 'later'} than {names[0]}, as the board moves: "
        f"its frame {max(shift, 0)} is of the instant of frame {max(-shift, 0)} of {names[0]}"
        for name, shift in zip(names, shifts, strict=True)
        if shift
    ]


def find_misfit(calibrated: CalibratedRig, advice: Sequence[str]) -> InputError | None:
    """Error about cameras that do not have the board where others have it; None where all agree.

    A board's place follows the cameras that agree on it, so that of two that do not each fits half of the instants.
    What counts is the camera that fits worst at each instant.
    """
    view_px, widths_px = calibrated.view_px, calibrated.views.image_size_wh.max(axis=1)
    seen = ~np.isnan(view_px)
    worst = np.fmax.reduce(view_px / widths_px[:, None], axis=0)
    shared = seen & (seen.sum(axis=0) >= min(2, len(seen)))
    typical = [float(np.median(worst[of_camera])) if of_camera.any() else 0.0 for of_camera in shared]
    off = [
        f"{part * width:.1f} px with {name}"
        for name, part, width in zip(calibrated.rig.names, typical, widths_px.tolist(), strict=True)
        if part > _MISFIT
    ]
    causes = "check that the videos overlap in time, that no camera was moved, and the board's sizes"
    remedy = "; ".join([causes, *advice, "--force writes the rig nevertheless"])
    expected = f"a rig that fits the board's views to {_MISFIT:.1%} of the images' width"
    found = f"the board off by {', '.join(off)}, in the median"
    return InputError("board", expected=expected, found=found, remedy=remedy) if off else None


def say_print(found: FoundBoards) -> list[str]:
    """Sentences on how the board was printed and seen."""
    sentences = []
    if found.board.legacy:
        sentences.append(
            "the board has the pattern of OpenCV before version 4.6, with a marker in its first corner"
        )
    for name, mirrored, seen in zip(
        found.views.names, found.mirrored.tolist(), found.views.seen, strict=True
    ):
        if mirrored:
            sentences.append(f"{name} sees the board mirrored, in {mirrored} of {int(seen.sum())} views")
    return sentences


def advise(calibrated: CalibratedRig) -> list[str]:
    """Sentences that say what to film again, and why; none where the calibration is sound."""
    rows = figures_of(calibrated)
    sentences = [
        f"{name} shares {row['shared']} views with {row['best_partner']} and fewer with the others: "
        f"film more where {name} and {row['best_partner']} both see the board"
        for name, row in rows.items()
        if len(rows) > 1 and row["shared"] < _SHARED
    ]
    slip_px = {
        name: np.sqrt(max(row["median_px"] ** 2 - row["own_median_px"] ** 2, 0)) for name, row in rows.items()
    }
    focal_std = {name: row["focal_std_px"][0] / row["focal_px"][0] for name, row in rows.items()}
    named = {
        "the board was seen in small parts of the images of {}: move it into their corners": {
            name: f"{row['covered']:.0%}" for name, row in rows.items() if row["covered"] < _COVERED
        },
        "the focal lengths of {} are not well known: tilt the board more, and film it nearer": {
            name: f"± {std:.1%}" for name, std in focal_std.items() if std > _FOCAL_STD
        },
        "the board is not where the other cameras see it for {}: hold it still, "
        "or check that frames of equal number are of one instant": {
            name: f"{slip_px[name]:.1f} px"
            for name, row in rows.items()
            if row["median_px"] > _SLIP_FACTOR * row["own_median_px"] and slip_px[name] > _SLIP_PX
        },
    }
    for words, cameras in named.items():
        if cameras:
            sentences.append(words.format(", ".join(f"{name} ({value})" for name, value in cameras.items())))
    return sentences


def save_coverage(path: Path, calibrated: CalibratedRig, *, force: bool) -> None:
    """Save a PNG with the corners in each camera's image, coloured by their residuals.

    Raises:
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    count = len(calibrated.rig)
    columns = min(count, _PICTURES)
    rows = ceil(count / columns)
    brightest_px = _BRIGHT * float(np.nanmedian(calibrated.residual_px))

    def draw(figure: Figure) -> None:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for panel in panels[count:]:
            panel.axis("off")
        for index, (panel, name) in enumerate(zip(panels, calibrated.rig.names, strict=False)):
            residual = calibrated.residual_px[index]
            seen = np.isfinite(residual)
            order = np.argsort(residual[seen])
            pixels = calibrated.views.corners_px[index][seen][order]
            dots = panel.scatter(
                pixels[:, 0],
                pixels[:, 1],
                c=residual[seen][order],
                s=3,
                vmin=0,
                vmax=brightest_px,
                cmap="viridis",
            )
            width, height = calibrated.views.image_size_wh[index]
            panel.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", title=name)
        figure.colorbar(dots, ax=panels.tolist(), label="residual (px)")

    save_figure(path, (3.2 * columns + 1.0, 2.4 * rows + 0.3), draw, force)
