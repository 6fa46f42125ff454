"""Pictures of the pages about markers: which markers are found, and how accurate a map of markers is.

    python experiments/accuracy/marker_pages.py

Writes experiments/pictures/markers_found.png and experiments/pictures/marker_map.png. The photographs are drawn; the
markers in the frames of the walk are projected, with errors of 0.2 px.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon
from scipy.stats import chi2

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parents[1] / "tests"))
from marker_pictures import Sheet, picture

from psotrack import detect_markers
from psotrack.foreground.markers import DetectedMarkers, marker_dictionary
from psotrack.geometry import Camera, look_at, make_camera, project
from psotrack.inside_out import BuiltMap, build_map, corners_in_own_frame
from psotrack.inside_out.mapping.sightings import MarkerSightings, collect_sightings
from psotrack.support import COLOURS

DICTIONARY = "4x4_50"
#: Side of a drawn photograph, pixels, and the marker in most of them.
TILE_PX, SHEET = 180, Sheet(7, (90.0, 90.0), 90.0, 0.35, 0.5, 0.8)
#: The known marker of the map, one at the other end of the room, and one that is never seen beside others.
KNOWN, OTHER_END, ALONE = 0, 10, 20
SIDE_M, NOISE_PX, SIZE_WH, FRAMES = 0.2, 0.2, (1280, 720), 120
#: Factor on the ellipses of the map, which would be too small to be seen.
MAGNIFIED = 20


def photographs() -> dict[str, UInt8[np.ndarray, "rows columns"]]:
    """Drawn photographs by their titles: six markers that are found, and six that are lost or spoilt."""
    size_wh = (TILE_PX, TILE_PX)
    plain = picture([SHEET], size_wh)
    upright = Sheet(7, (90.0, 90.0), 90.0)
    white = cv2.aruco.generateImageMarker(marker_dictionary(DICTIONARY), 7, 90)
    on_dark = np.full(size_wh, 30, np.uint8)
    on_dark[45:135, 45:135] = np.where(white > 0, 215, 30)
    hidden = plain.copy()
    cv2.circle(hidden, tuple(int(place) for place in SHEET.corners_px[0]), 22, 90, -1)
    return {
        "tilted": plain,
        "in the shade": picture([Sheet(7, (55.0, 90.0), 80.0, 0.35, 0.5)], size_wh, shaded=True, noise=1.0),
        "blurred by a quarter of a cell": picture([SHEET], size_wh, blur_px=3.75),
        "an inverted print": picture([SHEET], size_wh, inverted=True),
        "17 pixels wide": picture([Sheet(7, (90.0, 90.0), 17.0, 0.2)], size_wh),
        "on a bent sheet": picture([Sheet(7, (90.0, 90.0), 90.0, 0.35, bow=0.1)], size_wh),
        "blurred by 0.8 cells": picture([SHEET], size_wh, blur_px=12.0),
        "cells of 1.7 pixels": picture([Sheet(7, (90.0, 90.0), 10.0, 0.2)], size_wh),
        "mirrored": plain[:, ::-1].copy(),
        "a hidden corner": hidden,
        "no white border": cv2.GaussianBlur(on_dark, (0, 0), 0.7),
        "another dictionary": picture([upright], size_wh, "6x6_250"),
    }


def draw_found() -> Figure:
    """The photographs, with the outlines of the markers that are found."""
    shown = photographs()
    columns = len(shown) // 2
    figure = Figure(figsize=(1.55 * columns, 4.0), layout="constrained")
    all_axes = figure.subplots(2, columns)
    for axes, (title, gray) in zip(all_axes.ravel(), shown.items(), strict=True):
        found = detect_markers(gray, DICTIONARY)
        axes.imshow(gray, cmap="gray", vmin=0, vmax=255)
        for corners_px in found.corners_px:
            axes.add_patch(Polygon(corners_px, fill=False, edgecolor=COLOURS[1], linewidth=1.5))
            axes.plot(*corners_px[0], "o", color=COLOURS[1], markersize=4)
        words = [
            f"id {marker}, std {std:.2f} px"
            for marker, std in zip(found.ids.tolist(), found.std_px, strict=True)
        ]
        axes.set_title(title, fontsize=7)
        axes.set_xlabel(", ".join(words) or "not found", fontsize=7)
        axes.set_xticks([])
        axes.set_yticks([])
    return figure


def room() -> dict[int, Float[np.ndarray, "4 3"]]:
    """Markers along a wall and around the corner, and one on the opposite wall: corners, world, metres."""
    own_m = corners_in_own_frame(SIDE_M)
    to_room = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # Columns: right, up, out of the print.
    corners = {
        marker: np.array([0.8 * marker, 3.0, 1.2 + 0.5 * (marker % 2)]) + own_m @ to_room
        for marker in range(8)
    }
    turned = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])
    corners |= {8 + k: np.array([6.4, 2.2 - 0.9 * k, 1.2 + 0.5 * (k % 2)]) + own_m @ turned for k in range(3)}
    back = np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
    return corners | {ALONE: np.array([3.0, -3.0, 1.5]) + own_m @ back}


def walk(
    corners_m: dict[int, Float[np.ndarray, "4 3"]],
) -> tuple[MarkerSightings, Float[np.ndarray, "frames 3"]]:
    """What a camera sees on its way along the wall, and its positions; at last it turns round."""
    rng = np.random.default_rng(0)
    lens = make_camera(
        R=np.eye(3),
        t_m=np.zeros(3),
        K=np.array([[800.0, 0, 639.5], [0, 800, 359.5], [0, 0, 1]]),
        image_size_wh=SIZE_WH,
    )
    seen, positions_m = [], []
    for frame in range(FRAMES):
        share = frame / (FRAMES - 10)
        position_m = np.array([0.2 + 4.0 * min(share, 1), 0.4 + 0.2 * np.sin(9 * share), 1.5])
        # Ahead to the wall, and more and more to the right; the last frames show the wall behind.
        turn = 1.7 * max(share - 0.35, 0) if share < 1 else np.pi
        target_m = position_m + np.array([np.sin(turn), np.cos(turn), 0.0])
        R, t_m = look_at(tuple(position_m), tuple(target_m))
        camera = make_camera(R=R, t_m=t_m, K=lens.K, image_size_wh=SIZE_WH)
        seen.append(_sighted(frame, camera, position_m, corners_m, rng))
        positions_m.append(position_m)
    return collect_sightings(seen, [lens]), np.array(positions_m)


def _sighted(
    frame: int,
    camera: Camera,
    position_m: Float[np.ndarray, "3"],
    corners_m: dict[int, Float[np.ndarray, "4 3"]],
    rng: np.random.Generator,
) -> tuple[int, float, DetectedMarkers]:
    """The markers in one frame that face the camera and are in the image."""
    ids, quads = [], []
    for marker, corners in corners_m.items():
        pixels, depth_m = (np.asarray(part) for part in project(camera, corners))
        front = np.cross(corners[3] - corners[1], corners[2] - corners[0])
        ahead = (depth_m > 0.3).all() and front @ (position_m - corners.mean(axis=0)) > 0
        if ahead and ((pixels > 0) & (pixels < np.array(SIZE_WH) - 1)).all():
            ids.append(marker)
            quads.append(pixels + NOISE_PX * rng.standard_normal((4, 2)))
    corners_px, std_px = np.array(quads).reshape(-1, 4, 2), np.full(len(ids), NOISE_PX)
    return 0, frame / 30, DetectedMarkers(np.array(ids, int), corners_px, std_px)


def draw_map() -> Figure:
    """The room from above with the map of a walk, and errors of maps with one and with two known markers."""
    corners_m = room()
    sightings, positions_m = walk(corners_m)
    maps = {
        "one known marker": build_map(sightings, {KNOWN: corners_m[KNOWN]}),
        "two, at both ends": build_map(
            sightings, {marker: corners_m[marker] for marker in (KNOWN, OTHER_END)}
        ),
    }
    figure = Figure(figsize=(9.4, 3.9), layout="constrained")
    above, errors = figure.subplots(1, 2, width_ratios=[1.25, 1])
    _draw_above(above, maps["one known marker"], corners_m, positions_m)
    for colour, (name, built) in zip(COLOURS, maps.items(), strict=False):
        away_m = [np.linalg.norm((corners_m[one] - corners_m[KNOWN]).mean(axis=0)) for one in built.ids]
        off_mm = [
            1e3 * np.linalg.norm((built.marker_map.corners_m[one] - corners_m[one]).mean(axis=0))
            for one in built.ids.tolist()
        ]
        order = np.argsort(away_m)
        errors.plot(np.array(away_m)[order], np.array(off_mm)[order], "o-", color=colour, label=name)
        stated_mm = 1e3 * np.linalg.norm(built.std_m, axis=1)
        errors.plot(np.array(away_m)[order], stated_mm[order], "--", color=colour)
    errors.plot([], [], "--", color="0.4", label="stated standard deviation")
    errors.set(xlabel=f"distance from marker {KNOWN} (m)", ylabel="error of the centre (mm)", ylim=(0, None))
    errors.legend(fontsize=8)
    return figure


def _draw_above(
    axes: Axes,
    built: BuiltMap,
    corners_m: dict[int, Float[np.ndarray, "4 3"]],
    positions_m: Float[np.ndarray, "frames 3"],
) -> None:
    radius = MAGNIFIED * np.sqrt(chi2.ppf(0.9, 2))
    for marker, corners in corners_m.items():
        centre_m = corners.mean(axis=0)
        placed = marker in built.marker_map
        colour = "black" if marker == KNOWN else COLOURS[0] if placed else COLOURS[1]
        axes.plot(corners[:, 0], corners[:, 1], color=colour, linewidth=4, solid_capstyle="butt")
        out = np.cross(corners[3] - corners[1], corners[2] - corners[0])[:2]
        words = f"{marker}" + (" known" if marker == KNOWN else "" if placed else " not placed")
        axes.annotate(
            words, centre_m[:2] - 0.35 * out / np.linalg.norm(out), ha="center", va="center", fontsize=8
        )
        if placed and marker != KNOWN:
            covariance = built.covariance[built.ids.tolist().index(marker)][:2, :2]
            variances, axes_xy = np.linalg.eigh(covariance)
            width, height = 2 * radius * np.sqrt(np.maximum(variances, 0))
            angle = np.degrees(np.arctan2(axes_xy[1, 0], axes_xy[0, 0]))
            ellipse = Ellipse(centre_m[:2], width, height, angle=angle, alpha=0.35, color=colour)
            axes.add_patch(ellipse)
    axes.plot(positions_m[:, 0], positions_m[:, 1], color="0.5", linewidth=1)
    axes.annotate("camera", positions_m[0, :2], (0, -12), textcoords="offset points", fontsize=8, color="0.4")
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", xlim=(-0.8, 7.4), ylim=(-3.8, 3.8))
    axes.set_title(f"from above; 90 % ellipses, {MAGNIFIED} times as large", fontsize=9)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=HERE.parent / "pictures", help="folder of the pictures")
    folder = parser.parse_args().out
    draw_found().savefig(folder / "markers_found.png", dpi=90)
    draw_map().savefig(folder / "marker_map.png", dpi=110)


if __name__ == "__main__":
    main()
