"""`psotrack calibrate rig --points` and `--pairs`: a rig from points instead of a board."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from psotrack.cli.calibrate.located import locate_cameras
from psotrack.cli.calibrate.shown import row_of
from psotrack.errors import InputError, SettingsError, errors_name

if TYPE_CHECKING:
    from psotrack.calibration import PointRig, PointViews, Similarity
    from psotrack.geometry import Rig

#: Share of the sightings below which the user is told how few are used.
_FEW_USED = 0.5


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
) -> tuple[Rig, dict[str, dict[str, Any]], list[str]]:
    """Rig from a moving point, a row of each camera, and sentences on the world and on what is not determined."""
    from psotrack.calibration import (
        calibrate_by_point,
        check_two_cameras,
        covariance_of_centres,
        distance_between,
        find_point_shifts,
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
    if distance is not None:
        with errors_name(sources[0]):
            check_two_cameras(views.names, *distance[:2])
    if stick_m is not None and not views.point.any():
        raise InputError(
            sources[0],
            expected="the two ends of a stick, told apart by a column named point",
            found="one point",
        )
    lenses = known_lenses_of(views.names, lenses_path)
    with errors_name(sources[0]):
        found = calibrate_by_point(lenses, views)
    stated = None if world is None else read_world(world)

    def world_of(found: PointRig) -> Similarity:
        rig = found.adjusted.rig
        if stated is not None:
            return fit_world(rig, stated, _numbered(found), with_scale=True)[0]
        if distance is not None:
            return world_of_camera(rig, 0, distance[2] / distance_between(rig, *distance[:2]))
        return world_of_camera(rig, 0, (stick_m or 1.0) / stick_length(found))

    with errors_name(sources[0] if world is None else world):
        change = world_of(found)
    covariance = covariance_of_centres(found, world_of)
    if stated is not None:
        _, left = fit_world(found.adjusted.rig, stated, _numbered(found), with_scale=True)
        place = in_words(stated.path, left)
    else:
        place = f"camera {views.names[0]}: x right, y down, z forward; --world places it elsewhere"
    rig = change.rig(found.adjusted.rig)
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
    shifts = [str(shift) for shift in find_point_shifts(found.adjusted.rig, views)]
    said = [*_left_out(found, views), f"the world is {place}", *shifts]
    return rig, rows, [*said, *_unused(found), *_undetermined(rig, covariance)]


def _numbered(found: PointRig) -> dict[int, np.ndarray]:
    """Positions of the moving point, of the first end of a stick, by the number of the instant."""
    first = found.views.point == 0
    return dict(zip(found.views.number[first].tolist(), found.adjusted.points_m[first], strict=True))


def _left_out(found: PointRig, views: PointViews) -> list[str]:
    """A sentence on sightings of a long recording that were left out."""
    both = np.isfinite(views.points_px[..., 0]).sum(axis=1) >= 2
    used, seen = len(np.unique(found.views.number)), len(np.unique(views.number[both]))
    if used == seen:
        return []
    return [f"{used} of {seen} instants at which two cameras see the point are used, evenly spread"]


def _unused(found: PointRig) -> list[str]:
    """A sentence on sightings of two cameras, if the rig explains few of them."""
    used, seen = int(found.adjusted.used.any(axis=1).sum()), len(found.views.number)
    if used >= _FEW_USED * seen:
        return []
    return [
        f"only {used} of {seen} sightings by two cameras fit the rig: check that frames of equal number are of one "
        "instant, that the cameras see the same thing, and the lenses"
    ]


def _undetermined(rig: Rig, covariance_m2: np.ndarray) -> list[str]:
    """A sentence on cameras whose places the sightings hardly determine."""
    from psotrack.calibration import LOOSE

    centres = np.asarray(rig.cameras.centre_world)
    apart_m = np.linalg.norm(centres[:, None] - centres, axis=-1)
    std_m = np.sqrt(np.trace(covariance_m2, axis1=1, axis2=2))
    loose = [
        f"{name} (± {std:.2g} m, {apart:.2g} m from the farthest camera)"
        for name, std, apart in zip(rig.names, std_m, apart_m.max(axis=1), strict=True)
        if std > LOOSE * apart
    ]
    if not loose:
        return []
    return [
        f"the sightings hardly determine the places of {', '.join(loose)}: move the point nearer to the cameras, "
        "check the lenses, add a camera, or give points of known place with --pairs"
    ]


def calibrate_pairs(
    sources: tuple[Path, ...],
    pairs: Path | None,
    markers: Path | None,
    dictionary: str,
    lenses_path: Path | None,
    noise_px: float,
    world: Path | None,
) -> tuple[Rig, dict[str, dict[str, Any]], list[str]]:
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
    with errors_name(pairs or markers):
        found, rows = locate_cameras(marks, by_name, noise_px)
    return found, rows, [f"the world is that of {pairs or markers}"]


def known_lenses_of(names: tuple[str, ...], path: Path | None) -> Rig:
    """Lenses of the cameras from a calibration; a file with one camera has the lens of all."""
    from psotrack.geometry import Rig, chosen_camera
    from psotrack.geometry.rig_files import read_lenses

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
    from psotrack.recordings import read_detections
    from psotrack.recordings.datasets import open_recording

    if len(sources) != 1:
        raise SettingsError(
            "--points", expected="one recording or one CSV file", found=f"{len(sources)} paths"
        )
    if sources[0].suffix.lower() == ".csv":
        return read_point_views(sources[0])
    recording = open_recording(sources[0])
    if not recording.detections:
        raise InputError(sources[0], expected="detections of a moving point", found="none")
    boxes = {name: read_detections(path) for name, path in recording.detections.items()}
    times = {each.name: each.times for each in recording.cameras if each.times}
    line_time_s = {each.name: each.line_time_s for each in recording.cameras}
    with errors_name(sources[0]):
        return views_of_detections(boxes, times, line_time_s)
