"""`psotrack calibrate extrinsics`: estimate the poses of cameras from points with known positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click
from msgspec import Meta

from psotrack.cli.calibrate.options import OUT
from psotrack.cli.options import running
from psotrack.cli.output import Output
from psotrack.cli.records import HelpfulCommand, options_of
from psotrack.errors import InputError, SettingsError, errors_name

if TYPE_CHECKING:
    from psotrack.calibration import ImagePoints


@dataclass(frozen=True)
class PointOptions:
    """Points whose positions are known.

    Attributes:
        pairs: points marked by hand: camera,point,x_px,y_px,x_m,y_m,z_m.
        points: positions of the points, if --pairs has none: point,x_m,y_m,z_m.
        markers: sequence whose videos show the ArUco markers of its aruco_corners.csv, instead of --pairs.
        dictionary: dictionary of the markers; any dictionary of OpenCV.
        noise_px: standard deviation of a point in the image, along x and along y, in pixels.
    """

    pairs: Path | None = None
    points: Path | None = None
    markers: Annotated[Path, Meta(extra={"metavar": "SEQ"})] | None = None
    dictionary: str = "4x4_1000"
    noise_px: float = 1.0


@dataclass(frozen=True)
class LensOptions:
    """The lenses of the cameras.

    Attributes:
        intrinsics: intrinsics of the cameras; if FILE has only one camera, its intrinsics are used for all cameras.
        fov_deg: horizontal and vertical field of view in degrees, instead of intrinsics.
        focal_length_mm: focal length in millimetres, with --sensor, instead of intrinsics.
        sensor_mm: size of the sensor in millimetres.
        size: size of the images in pixels, if the calibration file does not contain the size.
    """

    intrinsics: Annotated[Path, Meta(extra={"metavar": "FILE"})] | None = None
    fov_deg: Annotated[tuple[float, float], Meta(extra={"metavar": "H,V"})] | None = None
    focal_length_mm: float | None = None
    sensor_mm: Annotated[tuple[float, float], Meta(extra={"metavar": "W,H"})] | None = None
    size: tuple[int, int] | None = None


@click.command(cls=HelpfulCommand)
@options_of(PointOptions, "known")
@options_of(LensOptions, "lens", heading="Lenses")
@OUT
@running(progress=False)
def extrinsics(output: Output, known: PointOptions, lens: LensOptions, out: Path) -> None:
    """Find the poses of cameras, from points whose positions in the world and in the images are known.

    At least four points that are not on one line are needed. Twelve points that are spread over the image and in depth
    are good. Points that disagree with the other points are left out, and shown.

    \b
    Examples:
      psotrack calibrate extrinsics --pairs pairs.csv --intrinsics lens.toml --out rig.toml
      psotrack calibrate extrinsics --pairs pairs.csv --points points.csv --fov 92.4,60.8 --size 1920,1080 --out rig.yml
      psotrack calibrate extrinsics --markers data/Simulated_Data/S01_D2_A --intrinsics rig.toml --out found.toml
    """
    from psotrack.calibration import place_cameras, read_image_points
    from psotrack.geometry.rig_files import write_rig

    pairs, markers = known.pairs, known.markers
    if (pairs is None) == (markers is None):
        found = "neither" if pairs is None else "both"
        raise SettingsError("extrinsics", expected="--pairs FILE or --markers SEQ", found=found)
    output.refuse(out)
    marks = (
        read_image_points(pairs, known.points)
        if pairs
        else _find_markers(Path(f"{markers}"), known.dictionary)
    )
    lenses = _lenses(list(marks), lens)
    with errors_name(pairs or markers):
        placed = place_cameras(marks, lenses, known.noise_px)
    write_rig(out, placed.rig, force=output.force)
    output.result(replace(placed, path=out))


def _lenses(names: list[str], given: LensOptions) -> Mapping[str, Any]:
    """Lens of each camera, by name, from intrinsics, fields of view, or focal length and sensor."""
    from psotrack.calibration import lens_of_sensor, lens_of_view
    from psotrack.geometry.rig_files import read_lenses

    ways = [value is not None for value in (given.intrinsics, given.fov_deg, given.focal_length_mm)]
    if sum(ways) != 1 or (given.focal_length_mm is None) != (given.sensor_mm is None):
        raise SettingsError(
            "lens",
            expected="--intrinsics FILE, or --fov H,V, or --focal-length with --sensor",
            found="another combination" if any(ways) else "none",
        )
    if given.intrinsics is not None:
        rig = read_lenses(given.intrinsics, given.size)
        if len(rig) == 1:
            return dict.fromkeys(names, rig.cameras[0])
        missing = [name for name in names if name not in rig.names]
        if missing:
            raise InputError(
                given.intrinsics, expected=f"the lens of {missing[0]}", found=f"only {', '.join(rig.names)}"
            )
        return {name: rig.cameras[rig.names.index(name)] for name in names}
    if given.size is None:
        raise SettingsError("--size", expected="width and height of the images", found="none")
    if given.fov_deg is not None:
        return dict.fromkeys(names, lens_of_view(*given.fov_deg, given.size))
    return dict.fromkeys(
        names, lens_of_sensor(given.focal_length_mm or 0.0, given.sensor_mm or (0.0, 0.0), given.size)
    )


def _find_markers(folder: Path, dictionary: str) -> dict[str, ImagePoints]:
    """Corners of the markers in the videos of a sequence, by camera."""
    from psotrack.calibration import find_markers
    from psotrack.inside_out import read_marker_map
    from psotrack.recordings.datasets import find_marker_corners, open_recording

    corners_m = read_marker_map(find_marker_corners(folder)).corners_m
    videos = open_recording(folder).videos
    return {name: find_markers(video, corners_m, dictionary) for name, video in videos.items()}
