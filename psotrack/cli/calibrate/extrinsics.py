"""`psotrack calibrate extrinsics`: estimate the poses of cameras from points with known positions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psotrack.cli.calibrate.options import OUT, SIZE, noise_option
from psotrack.cli.options import FORCE, FOV, JSON, QUIET, dictionary_option
from psotrack.cli.output import Output, pass_output
from psotrack.cli.records import HelpfulCommand
from psotrack.cli.types import Numbers
from psotrack.errors import InputError, SettingsError, errors_name

if TYPE_CHECKING:
    from psotrack.calibration import ImagePoints


@click.command(cls=HelpfulCommand)
@click.option(
    "--pairs",
    type=click.Path(path_type=Path),
    help="Points marked by hand: camera,point,x_px,y_px,x_m,y_m,z_m.",
)
@click.option(
    "--points",
    type=click.Path(path_type=Path),
    help="Positions of the points, if --pairs has none: point,x_m,y_m,z_m.",
)
@click.option(
    "--markers",
    type=click.Path(path_type=Path),
    metavar="SEQ",
    help="Sequence whose videos show the ArUco markers of its aruco_corners.csv, instead of --pairs.",
)
@dictionary_option()
@click.option(
    "--intrinsics",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Intrinsics of the cameras; if FILE has only one camera, its intrinsics are used for all cameras.",
)
@FOV
@click.option(
    "--focal-length",
    "focal_length_mm",
    type=float,
    help="Focal length in millimetres, with --sensor, instead of intrinsics.",
)
@click.option(
    "--sensor", "sensor_mm", type=Numbers(2), metavar="W,H", help="Size of the sensor in millimetres."
)
@SIZE
@noise_option(1.0)
@OUT
@FORCE
@QUIET
@JSON
@pass_output
def extrinsics(
    output: Output,
    pairs: Path | None,
    points: Path | None,
    markers: Path | None,
    dictionary: str,
    noise_px: float,
    out: Path,
    **lens: Any,
) -> None:
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

    if (pairs is None) == (markers is None):
        found = "neither" if pairs is None else "both"
        raise SettingsError("extrinsics", expected="--pairs FILE or --markers SEQ", found=found)
    output.refuse(out)
    marks = read_image_points(pairs, points) if pairs else _find_markers(Path(str(markers)), dictionary)
    lenses = _lenses(list(marks), **lens)
    with errors_name(pairs or markers):
        placed = place_cameras(marks, lenses, noise_px)
    write_rig(out, placed.rig, force=output.force)
    output.result(replace(placed, path=out))


def _lenses(
    names: list[str],
    *,
    intrinsics: Path | None,
    fov_deg: tuple[float, float] | None,
    focal_length_mm: float | None,
    sensor_mm: tuple[float, float] | None,
    image_size_wh: tuple[int, int] | None,
) -> Mapping[str, Any]:
    """Lens of each camera, by name, from intrinsics, fields of view, or focal length and sensor."""
    from psotrack.calibration import lens_of_sensor, lens_of_view
    from psotrack.geometry.rig_files import read_lenses

    given = [value is not None for value in (intrinsics, fov_deg, focal_length_mm)]
    if sum(given) != 1 or (focal_length_mm is None) != (sensor_mm is None):
        raise SettingsError(
            "lens",
            expected="--intrinsics FILE, or --fov H,V, or --focal-length with --sensor",
            found="another combination" if any(given) else "none",
        )
    if intrinsics is not None:
        rig = read_lenses(intrinsics, image_size_wh)
        if len(rig) == 1:
            return dict.fromkeys(names, rig.cameras[0])
        missing = [name for name in names if name not in rig.names]
        if missing:
            raise InputError(
                intrinsics, expected=f"the lens of {missing[0]}", found=f"only {', '.join(rig.names)}"
            )
        return {name: rig.cameras[rig.names.index(name)] for name in names}
    if image_size_wh is None:
        raise SettingsError("--size", expected="width and height of the images", found="none")
    if fov_deg is not None:
        return dict.fromkeys(names, lens_of_view(*fov_deg, image_size_wh))
    return dict.fromkeys(
        names, lens_of_sensor(focal_length_mm or 0.0, sensor_mm or (0.0, 0.0), image_size_wh)
    )


def _find_markers(folder: Path, dictionary: str) -> dict[str, ImagePoints]:
    """Corners of the markers in the videos of a sequence, by camera."""
    from psotrack.calibration import find_markers
    from psotrack.inside_out import read_marker_map
    from psotrack.recordings.datasets import find_marker_corners, open_recording

    corners_m = read_marker_map(find_marker_corners(folder)).corners_m
    videos = open_recording(folder).videos
    return {name: find_markers(video, corners_m, dictionary) for name, video in videos.items()}
