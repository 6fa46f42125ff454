"""`psotrack calibrate rig --points` and `--pairs`: a rig from points instead of a board."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from psotrack.cli.calibrate.located import locate_cameras
from psotrack.cli.calibrate.shown import row_of
from psotrack.errors import InputError, SettingsError

if TYPE_CHECKING:
    from psotrack.calibration import PointViews
    from psotrack.geometry import Rig


class Distance(click.ParamType):
    """Two cameras and the distance between their centres, such as left,right=4.20."""

    name = "NAME,NAME=METRES"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Names and metres from a string; a value that is not a string is returned as it is."""
        if not isinstance(value, str):
            return value
        names, _, length = value.partition("=")
        cameras = tuple(names.split(","))
        try:
            metres = float(length)
        except ValueError:
            metres = 0.0
        if len(cameras) != 2 or not 0 < metres < float("inf"):
            self.fail(
                f"expected two cameras and metres, such as left,right=4.20, found {value!r}", param, ctx
            )
        return *cameras, metres


def calibrate_points(
    sources: tuple[Path, ...],
    lenses_path: Path | None,
    distance: tuple[str, str, float] | None,
    stick_m: float | None,
    world: Path | None,
) -> tuple[Rig, dict[str, dict[str, Any]], str]:
    """Rig from a moving point, a row of each camera, and a sentence on the world."""
    from psotrack.calibration import (
        calibrate_by_point,
        distance_between,
        fit_world,
        read_world,
        stick_length,
        world_of_camera,
    )

    given = sum(value is not None for value in (distance, stick_m, world))
    if given != 1:
        raise SettingsError(
            "length",
            expected="one of --distance NAME,NAME=METRES, --stick METRES and --world FILE",
            found="none" if not given else f"{given}",
        )
    views = _read_views(sources)
    lenses = known_lenses_of(views.names, lenses_path)
    found = calibrate_by_point(lenses, views)
    rig = found.adjusted.rig
    if world is not None:
        ends = found.views.point == 0
        numbered = dict(zip(found.views.number[ends].tolist(), found.adjusted.points_m[ends], strict=True))
        change, left = fit_world(rig, read_world(world), numbered, with_scale=True)
        place = in_words(world, left)
    else:
        if distance is not None:
            factor = distance[2] / distance_between(rig, distance[0], distance[1])
        else:
            factor = (stick_m or 1.0) / stick_length(found)
        change = world_of_camera(rig, 0, factor)
        place = f"camera {rig.names[0]}: x right, y down, z forward; --world places it elsewhere"
    rig = change.rig(rig)
    covariance = change.covariance_m2(found.adjusted.centre_covariance_m2)
    rows = {}
    for index, name in enumerate(rig.names):
        seen = np.isfinite(found.adjusted.residual_px[:, index])
        rows[name] = row_of(
            np.asarray(rig.cameras.centre_world[index]),
            covariance[index],
            found.adjusted.residual_px[seen, index],
            found.adjusted.used[seen, index],
            found.views.number[seen],
        )
    return rig, rows, place


def calibrate_pairs(
    sources: tuple[Path, ...],
    pairs: Path | None,
    markers: Path | None,
    dictionary: str,
    lenses_path: Path | None,
    noise_px: float,
    world: Path | None,
) -> tuple[Rig, dict[str, dict[str, Any]], str]:
    """Rig from points or markers of known place, a row of each camera, and a sentence on the world."""
    from psotrack.calibration import find_markers_in, open_images, read_image_points
    from psotrack.inside_out import read_marker_map

    if world is not None:
        raise SettingsError(
            "--world", expected="none with points of known place, which are the world", found=f"{world}"
        )
    if pairs is not None:
        if sources:
            raise SettingsError("--pairs", expected="no video", found=f"{sources[0]}")
        marks = read_image_points(pairs)
    else:
        corners_m = read_marker_map(markers or "").corners_m
        marks = {
            camera.name: find_markers_in(
                (grey for _, grey in camera.read(camera.spread(15))), corners_m, dictionary
            )
            for camera in open_images(sources)
        }
    lenses = known_lenses_of(tuple(marks), lenses_path)
    by_name = {name: lenses.cameras[index] for index, name in enumerate(lenses.names)}
    found, rows = locate_cameras(marks, by_name, noise_px)
    return found, rows, f"that of {pairs or markers}"


def known_lenses_of(names: tuple[str, ...], path: Path | None) -> Rig:
    """Lenses of the cameras from a calibration; a file with one camera has the lens of all."""
    from psotrack.geometry import Rig, chosen_camera
    from psotrack.rig_files import read_lenses

    if path is None:
        raise SettingsError(
            "--lenses",
            expected="a calibration with the lens of each camera",
            found="none",
            remedy="calibrate intrinsics",
        )
    lenses = read_lenses(path)
    if len(lenses) == 1:
        return Rig(names, lenses.cameras[np.zeros(len(names), np.int64)])
    chosen = [chosen_camera(name, lenses.names) for name in names]
    for name, found in zip(names, chosen, strict=True):
        if found is None:
            raise InputError(path, expected=f"the lens of {name}", found=f"only {', '.join(lenses.names)}")
    rows = np.array([lenses.names.index(found) for found in chosen if found is not None])
    return Rig(names, lenses.cameras[rows])


def is_recording(path: Path) -> bool:
    """Whether a path is a recording instead of the images of one camera."""
    return path.suffix.lower() == ".toml" or (
        path.is_dir()
        and any((path / name).is_file() for name in ("recording.toml", "cameras_calibration.csv"))
    )


def in_words(path: Path, left_m: dict[str, float]) -> str:
    """How well the points of a world are met."""
    worst = max(left_m, key=lambda name: left_m[name])
    rms_mm = 1e3 * float(np.sqrt(np.mean(np.square(list(left_m.values())))))
    worst_mm = 1e3 * left_m[worst]
    return (
        f"that of {path}: {len(left_m)} points are met to {rms_mm:.1f} mm (rms), {worst} to {worst_mm:.1f} mm"
    )


def _read_views(sources: tuple[Path, ...]) -> PointViews:
    """Sightings from a CSV file, or from the detections of a recording."""
    from psotrack.calibration import read_point_views, views_of_detections
    from psotrack.datasets import open_recording
    from psotrack.recordings import read_detections

    if len(sources) != 1:
        raise SettingsError(
            "--points", expected="one recording or one CSV file", found=f"{len(sources)} paths"
        )
    if sources[0].suffix.lower() == ".csv":
        return read_point_views(sources[0])
    recording = open_recording(sources[0])
    if not recording.detections:
        raise InputError(sources[0], expected="detections of a moving point", found="none")
    return views_of_detections({name: read_detections(path) for name, path in recording.detections.items()})
