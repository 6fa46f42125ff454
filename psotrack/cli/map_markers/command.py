"""The command `psotrack map-markers`."""

from __future__ import annotations

import sys
from pathlib import Path

import click
import numpy as np

from psotrack.cli.map_markers.shown import show_built, show_check, show_measured
from psotrack.cli.map_markers.sources import PICTURES_FPS, Lenses, known_corners, leading, videos_of
from psotrack.cli.options import (
    FORCE,
    FOV,
    JSON,
    SCALE_CAMERA,
    Numbers,
    dictionary_option,
    frames_option,
    reporting,
)
from psotrack.cli.output import check_outputs, report_to
from psotrack.cli.shutter import given_shutter, shutter_options
from psotrack.errors import SettingsError, check_positive

#: Exit code if a marker of a map was reported.
FOUND = 2
#: Suffixes of files with measured corners; all other files are videos.
_MEASURED = {".c3d", ".csv", ".txt", ".tsv"}


@click.command("map-markers")
@click.argument("sources", metavar="SOURCE...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), help="Table of corners to write; not needed with --check."
)
@click.option(
    "--known",
    metavar="ID,ID...",
    help="Markers that define the world's axes: markers in --markers, or one marker with a --side.",
)
@click.option(
    "--markers",
    "table",
    type=click.Path(path_type=Path),
    help="Table with the corners of the known markers.  [default: SEQ's, if there is no --side]",
)
@click.option("--side", "side_m", type=float, help="Side of the markers' black squares, in metres.")
@click.option("--estimate-sides", is_flag=True, help="Estimate the sides of unknown markers, too.")
@click.option(
    "--check",
    "checked",
    type=click.Path(path_type=Path),
    metavar="MAP",
    help="Check the table MAP instead of writing one.",
)
@click.option(
    "--drone",
    "drones",
    metavar="NAME,NAME...",
    help="Drones of a sequence whose videos are used.  [default: all]",
)
@click.option(
    "--camera",
    "--intrinsics",
    "camera_file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Intrinsics of the videos' cameras: .csv, .toml or .yml.  [default: the sequence's]",
)
@click.option(
    "--camera-name",
    "camera_names",
    metavar="NAME,NAME...",
    help="Names of cameras in FILE, if FILE has several cameras: one for all videos, or one for each video.",
)
@SCALE_CAMERA
@FOV
@dictionary_option()
@click.option(
    "--seen-from",
    "seen_from_m",
    type=Numbers(3),
    metavar="X,Y,Z",
    help="Position that all measured markers face, in metres.  [default: the mean of their corners]",
)
@shutter_options
@click.option(
    "--fps",
    type=float,
    help=f"Frames per second of folders of images, on which only the time from row to row depends.  "
    f"[default: {PICTURES_FPS:g}]",
)
@frames_option
@FORCE
@reporting
@JSON
def map_markers(
    sources: tuple[Path, ...],
    out: Path | None,
    known: str | None,
    table: Path | None,
    side_m: float | None,
    estimate_sides: bool,
    checked: Path | None,
    drones: str | None,
    camera_file: Path | None,
    camera_names: str | None,
    scale_camera: bool,
    fov_deg: tuple[float, float] | None,
    dictionary: str,
    seen_from_m: tuple[float, float, float] | None,
    line_time_s: float | None,
    readout_s: float | None,
    fps: float | None,
    num_frames: int | None,
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Write the table of a room's marker corners from SOURCE, or check such a table.

    SOURCE is a .c3d file or a table of measured corners with labels such as Marker7:1, or videos of the room, each a
    file or a folder of images, or a sequence whose drones carry cameras. In videos, markers are placed relative to the
    --known markers. Known markers that --markers lists keep their corners. A single known marker with a --side defines
    the world: origin in the marker's centre, x to its right, y up, z out of the print.

    --check MAP reports the markers of MAP that videos see elsewhere. The exit code is then 2 if a marker was reported.

    Most cameras expose the rows of a frame one after the other (rolling shutter). The time from row to row is estimated
    from each video, unless --line-time or --readout gives it for all.

    \b
    Examples:
      psotrack map-markers room.c3d --out corners.csv
      psotrack map-markers walk.mp4 --known 7 --side 0.2 --camera lens.toml --out corners.csv
      psotrack map-markers a.mp4 b.mp4 --known 7,12 --markers measured.csv --fov 92.45,60.83 --out corners.csv
      psotrack map-markers photos/ --known 7 --side 0.2 --camera lens.toml --out corners.csv
      psotrack map-markers data/Simulated_Data/S01_D2_A --drone dron1 --known 7 --out corners.csv --json -
      psotrack map-markers data/Simulated_Data/S01_D2_A --check corners.csv
    """
    from psotrack.inside_out import (
        build_map,
        check_map,
        find_sightings,
        fit_squares,
        read_marker_map,
        read_measured_corners,
    )
    from psotrack.recordings.datasets import write_marker_corners

    given = [name for name, value in {"--out": out, "--check": checked}.items() if value is not None]
    if len(given) != 1:
        raise SettingsError(
            "map-markers", expected="--out FILE or --check MAP", found=" and ".join(given) or "neither"
        )
    check_outputs(out, json_path, force)
    if side_m is not None:
        check_positive("--side", side_m)
    if fps is not None:
        check_positive("--fps", fps)
    if out is not None and sources[0].suffix.lower() in _MEASURED:
        if len(sources) > 1:
            raise SettingsError(
                "SOURCE", expected="one file of measured corners", found=f"{len(sources)} files"
            )
        viewer = None if seen_from_m is None else np.array(seen_from_m)
        measured = fit_squares(read_measured_corners(sources[0]), side_m=side_m, seen_from_m=viewer)
        write_marker_corners(out, measured.marker_map.corners_m)
        show_measured(measured, out, quiet, json_path, force)
        return
    # Errors of small files are found before the videos are read, which takes long.
    marker_map = None if checked is None else read_marker_map(checked)
    world = {} if out is None else known_corners(known, table, side_m, sources)
    videos = videos_of(sources, drones, Lenses(camera_file, camera_names, scale_camera, fov_deg), fps)
    videos = {name: (leading(video, num_frames), lens) for name, (video, lens) in videos.items()}
    shutter = None
    for video, _ in videos.values():
        shutter = given_shutter(line_time_s, readout_s, video.image_size_wh[1], video.fps)
    sightings = find_sightings(list(videos.values()), dictionary, consecutive=True, report=report_to(quiet))
    rows = {name: video.image_size_wh[1] for name, (video, _) in videos.items()}
    if marker_map is not None:
        checkup = check_map(sightings, marker_map, shutter)
        show_check(checkup, rows, shutter, Path(str(checked)), quiet, json_path, force)
        if checkup.findings:
            sys.exit(FOUND)
    elif out is not None:
        built = build_map(sightings, world, side_m=side_m, estimate_sides=estimate_sides, shutter=shutter)
        write_marker_corners(out, built.marker_map.corners_m)
        show_built(built, rows, shutter, out, quiet, json_path, force)
