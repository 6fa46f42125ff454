"""`psotrack map-markers`: where a room's markers are, from motion capture or videos, and what is wrong with a map."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from psotrack.cli.answers import answer, check_outputs, report_to, say
from psotrack.cli.options import FORCE, FRAMES, JSON, QUIET, Numbers
from psotrack.errors import InputError, SettingsError, check_positive

if TYPE_CHECKING:
    from psotrack.cameras import Camera
    from psotrack.inside_out.mapping import BuiltMap
    from psotrack.inside_out.mapping.check import Checkup
    from psotrack.inside_out.mapping.sightings import Sightings
    from psotrack.inside_out.mapping.squares import Squares
    from psotrack.inside_out.marker_map import MarkerMap
    from psotrack.video import VideoInfo

#: Of the exit, where something is wrong with a map.
FOUND = 2
#: Files of measured corners; all others are videos.
_MEASURED = {".c3d", ".csv", ".txt", ".tsv"}


@click.command("map-markers")
@click.argument("sources", metavar="SOURCE...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), help="The table of corners to write; not needed for --check."
)
@click.option(
    "--known",
    metavar="ID,ID...",
    help="Markers that say where the world is: in --markers, or one with a --side.",
)
@click.option(
    "--markers",
    "table",
    type=click.Path(path_type=Path),
    help="A table with the corners of the known markers.  [default: SEQ's, if there is no --side]",
)
@click.option("--side", "side_m", type=float, help="Of the markers' black squares, in metres.")
@click.option("--estimate-sides", is_flag=True, help="Find the sides of markers that are not known, too.")
@click.option(
    "--check",
    "checked",
    type=click.Path(path_type=Path),
    metavar="MAP",
    help="Check this map instead of making one.",
)
@click.option("--drone", "drones", metavar="NAME,NAME...", help="Whose videos of a sequence.  [default: all]")
@click.option(
    "--camera",
    "--intrinsics",
    "camera_file",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Intrinsics of the videos: .csv, .toml or .yml.  [default: those of a sequence]",
)
@click.option(
    "--camera-name",
    "camera_names",
    metavar="NAME,NAME...",
    help="Of the camera in FILE, where that has several: one for all videos, or one for each.",
)
@click.option("--scale-camera", is_flag=True, help="Scale intrinsics for another size of the same images.")
@click.option("--fov", "fov_deg", type=Numbers(2), metavar="H,V", help="Instead: fields of view in degrees.")
@click.option("--dictionary", default="4x4_1000", show_default=True, help="Of the markers.")
@click.option(
    "--seen-from",
    "seen_from_m",
    type=Numbers(3),
    metavar="X,Y,Z",
    help="A place that all measured markers face.  [default: their middle]",
)
@FRAMES
@FORCE
@QUIET
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
    num_frames: int | None,
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Make the table of a room's marker corners, from SOURCE, or check one.

    SOURCE is a .c3d or table of measured corners, labelled such as Marker7:1; or videos of the room, or a sequence
    whose drones carry cameras. From videos all markers are placed relative to those that are --known: where these
    are in --markers they stay. Of one with a --side alone the world's axes are its own: origin in its centre, x to its
    right, y up, z out of the print.

    With --check MAP, says which markers of a map are not where a video sees them, and how. The exit code is then 2 if
    something was found.

    \b
    Examples:
      psotrack map-markers room.c3d --out corners.csv
      psotrack map-markers walk.mp4 --known 7 --side 0.2 --camera lens.toml --out corners.csv
      psotrack map-markers a.mp4 b.mp4 --known 7,12 --markers measured.csv --fov 92.45,60.83 --out corners.csv
      psotrack map-markers data/Simulated_Data/S01_D2_A --drone dron1 --known 7 --out corners.csv --json -
      psotrack map-markers data/Simulated_Data/S01_D2_A --check corners.csv
    """
    from psotrack.datasets.dpjait import write_marker_corners
    from psotrack.inside_out.mapping import build_map
    from psotrack.inside_out.mapping.check import check_map
    from psotrack.inside_out.mapping.squares import read_measured, squares
    from psotrack.inside_out.marker_map import read_marker_map

    given = [name for name, value in {"--out": out, "--check": checked}.items() if value is not None]
    if len(given) != 1:
        raise SettingsError(
            "map-markers", expected="--out FILE or --check MAP", found=" and ".join(given) or "neither"
        )
    check_outputs(out, json_path, force)
    if side_m is not None:
        check_positive("--side", side_m)
    if out is not None and sources[0].suffix.lower() in _MEASURED:
        if len(sources) > 1:
            raise SettingsError(
                "SOURCE", expected="one file of measured corners", found=f"{len(sources)} files"
            )
        viewer = None if seen_from_m is None else np.array(seen_from_m)
        measured = squares(read_measured(sources[0]), side_m=side_m, seen_from_m=viewer)
        write_marker_corners(out, measured.marker_map.corners_m)
        _answer_measured(measured, out, quiet, json_path, force)
        return
    # What can be wrong is looked at before the videos are.
    marker_map = None if checked is None else read_marker_map(checked)
    world = {} if out is None else _world(known, table, side_m, sources)
    videos = _videos(sources, drones, _Lenses(camera_file, camera_names, scale_camera, fov_deg))
    videos = {name: (_leading(video, num_frames), lens) for name, (video, lens) in videos.items()}
    sightings = _sightings(videos, dictionary, quiet)
    if marker_map is not None:
        _answer_check(check_map(sightings, marker_map), Path(str(checked)), quiet, json_path, force)
    elif out is not None:
        built = build_map(sightings, world, side_m=side_m, estimate_sides=estimate_sides)
        write_marker_corners(out, built.marker_map.corners_m)
        _answer_built(built, list(videos), out, quiet, json_path, force)


def _world(
    known: str | None, table: Path | None, side_m: float | None, sources: tuple[Path, ...]
) -> dict[int, np.ndarray]:
    """The corners of the known markers, by id."""
    from psotrack.datasets.dpjait import MARKER_CORNERS
    from psotrack.inside_out.mapping import own_frame
    from psotrack.inside_out.marker_map import read_marker_map

    words = [word.strip() for word in (known or "").split(",") if word.strip()]
    if not words or not all(word.isdecimal() for word in words):
        expected = "numbers of markers that are known, such as 7 or 7,12"
        raise SettingsError("--known", expected=expected, found=known or "none")
    ids = list(dict.fromkeys(map(int, words)))
    if table is None and side_m is None and sources[0].is_dir():
        table = sources[0] / MARKER_CORNERS
    if table is not None:
        marker_map = read_marker_map(table)
        missing = [marker for marker in ids if marker not in marker_map]
        if missing:
            found = f"only {', '.join(map(str, marker_map.ids.tolist()))}"
            raise InputError(table, expected=f"the known marker {missing[0]}", found=found)
        return {marker: marker_map.corners_m[marker] for marker in ids}
    if side_m is None or len(ids) > 1:
        expected = "--markers with the corners of the known markers, or --side and one known marker"
        raise SettingsError(
            "--known", expected=expected, found="no --markers" if side_m is not None else "neither"
        )
    return {ids[0]: own_frame(side_m)}


@dataclass(frozen=True)
class _Lenses:
    """What was said of the videos' lenses."""

    file: Path | None
    names: str | None
    scale: bool
    fov_deg: tuple[float, float] | None

    def of(self, video: VideoInfo, index: int, count: int) -> Camera:
        """The lens of a video, number `index` of `count`."""
        from psotrack.inside_out.lens_files import chosen_lens

        names = [None] if self.names is None else self.names.split(",")
        if len(names) not in (1, count):
            expected = f"one name, or one for each of {count} videos"
            raise SettingsError("--camera-name", expected=expected, found=f"{len(names)}")
        name = names[index % len(names)]
        return chosen_lens(
            video.image_size_wh, path=self.file, fov_deg=self.fov_deg, name=name, scale=self.scale
        )


def _videos(
    sources: tuple[Path, ...], drones: str | None, lenses: _Lenses
) -> dict[str, tuple[VideoInfo, Camera]]:
    """The videos with their lenses, by name."""
    from psotrack.video import probe

    if sources[0].is_dir():
        if len(sources) > 1:
            raise SettingsError("SOURCE", expected="one sequence, or videos", found=f"{len(sources)} of them")
        return _of_sequence(sources[0], drones, lenses)
    if drones is not None:
        raise SettingsError("--drone", expected="a sequence's folder as SOURCE", found=f"{sources[0]}")
    infos = [probe(path) for path in sources]
    return {
        str(video.path): (video, lenses.of(video, index, len(infos))) for index, video in enumerate(infos)
    }


def _of_sequence(folder: Path, drones: str | None, lenses: _Lenses) -> dict[str, tuple[VideoInfo, Camera]]:
    from psotrack.datasets.dpjait import read_sequence
    from psotrack.inside_out.lens_files import lens_of_matrix

    onboard = read_sequence(folder).onboard or {}
    if not onboard:
        raise InputError(
            folder, expected="videos of drones' own cameras, such as dron1_cam_s.avi", found="none"
        )
    chosen = list(onboard) if drones is None else drones.split(",")
    unknown = [name for name in chosen if name not in onboard]
    if unknown:
        raise SettingsError("--drone", expected=f"some of {', '.join(onboard)}", found=", ".join(unknown))
    videos = {}
    for index, name in enumerate(chosen):
        video, K = onboard[name].video, onboard[name].K
        if K is None or lenses.file is not None or lenses.fov_deg is not None:
            lens = lenses.of(video, index, len(chosen))
        else:
            lens = lens_of_matrix(K, video.image_size_wh)
        videos[name] = (video, lens)
    return videos


def _leading(video: VideoInfo, num_frames: int | None) -> VideoInfo:
    if num_frames is None:
        return video
    if not 0 < num_frames <= video.num_frames:
        expected = f"1 to {video.num_frames}, the frames of {video.path}"
        raise SettingsError("--frames", expected=expected, found=f"{num_frames}")
    return replace(video, num_frames=num_frames)


def _sightings(videos: dict[str, tuple[VideoInfo, Camera]], dictionary: str, quiet: bool) -> Sightings:
    from psotrack.inside_out.mapping.sightings import find_sightings

    return find_sightings(list(videos.values()), dictionary, report=report_to(quiet))


def _answer_measured(squares: Squares, out: Path, quiet: bool, json_path: Path | None, force: bool) -> None:
    rows = {
        marker: {**_place(squares.marker_map, marker), "residual_m": squares.residual_m[marker].tolist()}
        for marker in squares.marker_map.ids.tolist()
    }
    answer(json_path, {"map": str(out), "reordered": list(squares.reordered), "markers": rows}, force)
    _print(
        quiet,
        json_path,
        ("marker", "centre (m)", "side (mm)", "corners off (mm)"),
        [
            (
                f"{marker}",
                _numbers(row["centre_m"], 3),
                f"{1e3 * row['side_m']:.1f}",
                _numbers([1e3 * off for off in row["residual_m"]], 1),
            )
            for marker, row in rows.items()
        ],
    )
    for marker in squares.reordered:
        say(quiet, json_path, f"marker {marker}: its corners were labelled in another order, and put right")
    worst = max(max(row["residual_m"]) for row in rows.values())
    say(quiet, json_path, f"{out}: {len(rows)} markers, corners within {1e3 * worst:.1f} mm of squares")


def _answer_built(
    built: BuiltMap, videos: list[str], out: Path, quiet: bool, json_path: Path | None, force: bool
) -> None:
    rows = {}
    for index, marker in enumerate(built.ids.tolist()):
        rows[marker] = {
            **_place(built.marker_map, marker),
            "std_m": built.std_m[index].tolist(),
            "turn_std_deg": np.rad2deg(built.turn_std_rad[index]).tolist(),
            "side_std_m": float(np.sqrt(built.covariance[index, 6, 6]) * built.marker_map.sides_m[index]),
            "residual_px": _number(built.residual_px[index]),
            "frames": int(built.sightings[index]),
            "outliers": int(built.outliers[index]),
            "known": bool(built.known[index]),
        }
    content = {
        "map": str(out),
        "frames": built.num_views,
        "noise_px": built.noise_px,
        "inset_px": dict(zip(videos, built.inset_px.tolist(), strict=True)),
        "unplaced": list(built.unplaced),
        "markers": rows,
    }
    answer(json_path, content, force)
    _print(
        quiet,
        json_path,
        ("marker", "frames", "left out", "rms (px)", "centre (m)", "std (mm)", "turn std (deg)"),
        [
            (
                f"{marker}{' known' if row['known'] else ''}",
                f"{row['frames']}",
                f"{row['outliers']}",
                "" if row["residual_px"] is None else f"{row['residual_px']:.2f}",
                _numbers(row["centre_m"], 3),
                f"{1e3 * np.linalg.norm(row['std_m']):.1f}",
                f"{np.linalg.norm(row['turn_std_deg']):.2f}",
            )
            for marker, row in rows.items()
        ],
    )
    if built.unplaced:
        names = ", ".join(map(str, built.unplaced))
        say(quiet, json_path, f"not placed, because too seldom seen beside others: {names}")
    say(quiet, json_path, f"{out}: {len(rows)} markers from {built.num_views} frames")


def _answer_check(checkup: Checkup, path: Path, quiet: bool, json_path: Path | None, force: bool) -> None:
    rows = {
        marker: {
            "frames": one.sightings,
            "residual_px": _number(one.residual_px),
            "moved_m": [_number(value) for value in one.moved_m],
            "std_m": [_number(value) for value in one.std_m],
            "turned_deg": _number(one.turned_deg),
            "turn_std_deg": _number(one.turn_std_deg),
            "grown": _number(one.grown),
        }
        for marker, one in sorted(checkup.markers.items())
    }
    content = {
        "map": str(path),
        "findings": [{**vars(one), "markers": list(one.markers)} for one in checkup.findings],
        "frames": checkup.num_views,
        "noise_px": checkup.noise_px,
        "not_in_map": list(checkup.strangers),
        "markers": rows,
    }
    answer(json_path, content, force)
    _print(
        quiet,
        json_path,
        ("marker", "frames", "median off (px)"),
        [
            (
                f"{marker}",
                f"{row['frames']}",
                "" if row["residual_px"] is None else f"{row['residual_px']:.2f}",
            )
            for marker, row in rows.items()
        ],
    )
    for finding in checkup.findings:
        say(False, json_path, str(finding))
    if checkup.findings:
        sys.exit(FOUND)
    say(quiet, json_path, f"{path}: nothing disagrees")


def _place(marker_map: MarkerMap, marker: int) -> dict[str, Any]:
    row = marker_map.ids.tolist().index(marker)
    return {
        "centre_m": marker_map.centres_m[row].tolist(),
        "normal": marker_map.normals[row].tolist(),
        "side_m": float(marker_map.sides_m[row]),
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _numbers(values: list[float], digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)


def _print(
    quiet: bool, json_path: Path | None, headings: tuple[str, ...], rows: list[tuple[str, ...]]
) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    if quiet or json_path == Path("-"):
        return
    table = Table(box=box.HORIZONTALS, show_edge=False)
    for heading in headings:
        left = heading == "marker"
        table.add_column(heading, justify="left" if left else "right", no_wrap="centre" in heading)
    for row in rows:
        table.add_row(*row)
    Console().print(table)
