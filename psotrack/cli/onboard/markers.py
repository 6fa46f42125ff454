"""`psotrack onboard detect` and `map`: markers in photographs and videos, and the table of a room's markers."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from psotrack import inside_out, recordings
from psotrack.cli.commands import OptionGroup, command
from psotrack.cli.onboard.sources import LENS_NAMES, OnboardLensOptions, known_corners, leading, videos_of
from psotrack.cli.options import Dictionary, NumFrames
from psotrack.cli.output import Output, check_suffix
from psotrack.cli.types import says
from psotrack.errors import InputError, SettingsError
from psotrack.recordings import datasets
from psotrack.support import POSITION, finite_or_none, format_numbers


@command("detect")
def detect_markers(
    output: Output,
    images: tuple[Path, ...],
    *,
    out: Path = Path("markers.csv"),
    dictionary: Dictionary = "4x4_50",
    num_frames: NumFrames = None,
) -> None:
    """Find the ArUco markers and AprilTags in IMAGES, and their corners.

    IMAGES are photographs, which may differ in size, folders of photographs, or one video. Writes one row per marker:
    the image (or, of a video, the frame, from 0), the id, the four corners from the marker's own top left clockwise, in
    pixels (the middle of the first pixel is 0,0), and the standard deviation of a corner along x and along y. Prints
    may be inverted, and several markers of an image may have the same id.

    Photographs are searched thoroughly, which takes seconds for tens of megapixels; the frames of a video are searched
    with a part of the effort.

    \b
    Examples:
      psotrack onboard detect photo.jpg --dictionary 4x4_50 --out markers.csv
      psotrack onboard detect photos --dictionary apriltag_36h11 --out markers.csv
      psotrack onboard detect a.jpg b.png c.tif --dictionary 6x6_250 --out markers.csv --json -
      psotrack onboard detect flight.mp4 --dictionary 4x4_1000 --out markers.csv --frames 100

    Options:
        out: CSV file of the markers.
    """
    from psotrack.foreground.markers import marker_dictionary

    check_suffix("--out", out, ".csv")
    output.refuse(out)
    marker_dictionary(dictionary)
    photographs = _photographs(images)
    source: inside_out.FrameSource | list[Path]
    if photographs is None:
        names, what, source = None, "frames", inside_out.open_source(images[0]).first(num_frames)
    elif num_frames is not None:
        raise SettingsError("--frames", expected="a video", found="images")
    else:
        names, what, source = _names(photographs), "images", photographs
    found = list(inside_out.markers_of(source, dictionary, output.report))
    inside_out.write_marker_table(out, found, names, force=output.force)
    counts = Counter(marker for markers in found for marker in markers.ids.tolist())
    showing = sum(len(markers) > 0 for markers in found)
    content = {
        "out": str(out),
        "dictionary": dictionary,
        what: len(found),
        f"{what}_with_markers": showing,
        "markers": counts.total(),
        "by_id": {f"{marker}": count for marker, count in sorted(counts.items())},
    }
    output.json(content)
    doubt = "" if counts else "; check that --dictionary names the printed markers"
    sentence = f"{out}: {counts.total()} markers in {showing} of {len(found)} {what}{doubt}"
    output.say(sentence)


def _photographs(images: tuple[Path, ...]) -> list[Path] | None:
    """Files of photographs, folders replaced by the images in them; None for a video."""
    paths: list[Path] = []
    for path in images:
        if path.is_dir():
            inside = recordings.image_files(path)
            if not inside:
                expected = f"images, which end in {', '.join(recordings.IMAGE_SUFFIXES)}"
                raise InputError(path, expected=expected, found="none in this folder")
            paths += inside
        elif recordings.is_image(path) or not path.exists():
            paths.append(path)
        elif len(images) == 1:
            return None
        else:
            raise InputError(
                path,
                expected="an image or a folder of images",
                found="another file",
                remedy="a video needs a call of its own",
            )
    return paths


def _names(paths: list[Path]) -> list[str]:
    """Names of images in the table: file names; paths, if two files have the same name."""
    names = [path.name for path in paths]
    return names if len(set(names)) == len(names) else list(map(str, paths))


#: Exit code if a marker of a map was reported.
FOUND = 1
#: Suffixes of files with measured corners; all other files are videos.
_MEASURED = {".c3d", ".csv", ".txt", ".tsv"}


@dataclass(frozen=True)
class WorldOptions:
    """The markers that define the world, and how large markers are.

    Attributes:
        known: markers that define the world's axes: markers in `markers`, or one marker with a `side_m`.
        markers: table with the corners of the known markers; None: SEQ's, if there is no --side.
        side_m: side of the markers' black squares, in metres.
        estimate_sides: estimate the sides of unknown markers, too.
    """

    known: Annotated[str | None, says(metavar="ID,ID...")] = None
    markers: Path | None = None
    side_m: Annotated[float, Meta(gt=0)] | None = None
    estimate_sides: bool = False


@dataclass(frozen=True)
class VideoOptions:
    """Which videos show the markers, and how they are searched.

    Attributes:
        drone: drones of a sequence whose videos are used; None: all.
        fps: frames per second of folders of images, on which only the time from row to row depends; None: 25 for
            folders of images.
    """

    drone: tuple[str, ...] | None = None
    dictionary: Dictionary = "4x4_1000"
    fps: Annotated[float, Meta(gt=0)] | None = None


@command("map")
def map_markers(
    output: Output,
    sources: Annotated[tuple[Path, ...], says(metavar="SOURCE...")],
    *,
    out: Path | None = None,
    check: Annotated[Path | None, says(metavar="MAP")] = None,
    world: Annotated[WorldOptions, OptionGroup("World")],
    given: VideoOptions,
    lenses: Annotated[OnboardLensOptions, OptionGroup("Lenses", LENS_NAMES, rare=("names", "scale"))],
    num_frames: NumFrames = None,
) -> None:
    """Write the table of a room's marker corners from SOURCE, or check such a table.

    SOURCE is a .c3d file or a table of measured corners with labels such as Marker7:1, or videos of the room, each a
    file or a folder of images, or a sequence whose drones carry cameras. In videos, markers are placed relative to the
    --known markers. Known markers that --markers lists keep their corners. A single known marker with a --side defines
    the world: origin in the marker's centre, x to its right, y up, z out of the print.

    --check MAP reports the markers of MAP that videos see elsewhere. The exit code is then 1 if a marker was reported.

    The column std_m of the table is the standard deviation of the position of a marker's corners along each axis, in
    metres. Shutters may roll: the motion of the camera during a frame is estimated.

    \b
    Examples:
      psotrack onboard map room.c3d --out corners.csv
      psotrack onboard map walk.mp4 --known 7 --side 0.2 --camera lens.toml --out corners.csv
      psotrack onboard map a.mp4 b.mp4 --known 7,12 --markers measured.csv --fov 92.45,60.83 --out corners.csv
      psotrack onboard map photos/ --known 7 --side 0.2 --camera lens.toml --out corners.csv
      psotrack onboard map data/Simulated_Data/S01_D2_A --drone dron1 --known 7 --out corners.csv --json -
      psotrack onboard map data/Simulated_Data/S01_D2_A --check corners.csv

    Options:
        out: table of corners to write. None: aruco_corners.csv.
        check: check the table MAP instead of writing one.
    """
    if out is not None and check is not None:
        raise SettingsError("onboard map", expected="--out FILE or --check MAP", found="both")
    if check is None:
        out = out or Path("aruco_corners.csv")
        check_suffix("--out", out, ".csv")
        output.refuse(out)
    if out is not None and sources[0].suffix.lower() in _MEASURED:
        if len(sources) > 1:
            raise SettingsError(
                "SOURCE", expected="one file of measured corners", found=f"{len(sources)} files"
            )
        measured = inside_out.fit_squares(inside_out.read_measured_corners(sources[0]), side_m=world.side_m)
        datasets.write_marker_corners(out, measured.marker_map.corners_m, measured.marker_map.std_m)
        show_measured(output, measured, out)
        return
    # Errors of small files are found before the videos are read, which takes long.
    marker_map = None if check is None else inside_out.read_marker_map(check)
    known = {} if out is None else known_corners(world.known, world.markers, world.side_m, sources)
    videos = videos_of(sources, given.drone, lenses, given.fps)
    videos = {name: (leading(video, num_frames), lens) for name, (video, lens) in videos.items()}
    sightings = inside_out.find_sightings(list(videos.values()), given.dictionary, report=output.report)
    if marker_map is not None:
        checkup = inside_out.check_map(sightings, marker_map)
        show_check(output, checkup, Path(str(check)))
        if checkup.findings:
            sys.exit(FOUND)
    elif out is not None:
        built = inside_out.build_map(
            sightings, known, side_m=world.side_m, estimate_sides=world.estimate_sides
        )
        datasets.write_marker_corners(out, built.marker_map.corners_m, built.marker_map.std_m or None)
        show_built(output, built, list(videos), out)


def show_measured(output: Output, squares: inside_out.FittedSquares, out: Path) -> None:
    """Show a map from measured corners, and the distances of the corners from squares."""
    places = _places(squares.marker_map)
    off_m = squares.residual_m
    output.json(
        {
            "map": str(out),
            "markers": {
                marker: row | {"residual_m": off_m[marker].tolist()} for marker, row in places.items()
            },
        }
    )
    worst, worst_mm = max(
        ((one, 1e3 * float(off.max())) for one, off in off_m.items()), key=lambda one: one[1]
    )
    output.say(f"{out}: {len(places)} markers, corners within {worst_mm:.1f} mm of squares (marker {worst})")


def show_built(output: Output, built: inside_out.BuiltMap, videos: list[str], out: Path) -> None:
    """Show a map from videos, given their names, with the standard deviation of each marker's position."""
    rows = _places(built.marker_map)
    for index, row in enumerate(rows.values()):
        row |= {
            "std_m": built.std_m[index].tolist(),
            "turn_std_deg": np.rad2deg(built.turn_std_rad[index]).tolist(),
            "side_std_m": float(np.sqrt(built.covariance[index, 6, 6]) * built.marker_map.sides_m[index]),
            "residual_px": finite_or_none(built.residual_px[index]),
            "frames": int(built.sightings[index]),
            "outliers": int(built.outliers[index]),
            "known": bool(built.known[index]),
        }
    output.json(
        {
            "map": str(out),
            "frames": built.num_views,
            "noise_px": built.noise_px,
            "inset_px": dict(zip(videos, built.inset_px.tolist(), strict=True)),
            "unplaced": list(built.unplaced),
            "markers": rows,
        }
    )
    output.table(
        ("marker", "frames", "left out", "rms (px)", POSITION, "std (mm)", "turn std (deg)"),
        [
            (
                f"{marker}{' known' if row['known'] else ''}",
                f"{row['frames']}",
                f"{row['outliers']}",
                "" if row["residual_px"] is None else f"{row['residual_px']:.2f}",
                format_numbers(row["centre_m"], 3),
                f"{1e3 * np.linalg.norm(row['std_m']):.1f}",
                f"{np.linalg.norm(row['turn_std_deg']):.2f}",
            )
            for marker, row in rows.items()
        ],
    )
    if built.unplaced:
        names = ", ".join(map(str, built.unplaced))
        output.say(f"not placed, because too rarely seen beside other markers: {names}")
    output.say(f"{out}: {len(rows)} markers from {built.num_views} frames")


def show_check(output: Output, checkup: inside_out.MapCheck, path: Path) -> None:
    """Show the markers of a map, whose table is at a path, that videos see elsewhere."""
    output.json({"map": str(path), **checkup.to_dict()})
    output.say(*map(str, checkup.findings), always=True)
    if not checkup.findings:
        output.say(f"{path}: nothing disagrees")


def _places(marker_map: inside_out.MarkerMap) -> dict[int, dict[str, Any]]:
    """Centre, normal and side of each marker, by id, fit for JSON."""
    rows = zip(marker_map.centres_m, marker_map.normals, marker_map.sides_m, strict=True)
    return {
        marker: {"centre_m": centre_m.tolist(), "normal": normal.tolist(), "side_m": float(side_m)}
        for marker, (centre_m, normal, side_m) in zip(marker_map.ids.tolist(), rows, strict=True)
    }
