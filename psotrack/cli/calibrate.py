"""`psotrack calibrate`: lenses, where cameras stand, a rig that agrees with its drones, and other programs' files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from jaxtyping import Float

from psotrack.cli.answers import answer, say
from psotrack.cli.options import FORCE, JSON, QUIET, SEQUENCE, Numbers
from psotrack.errors import InputError, SettingsError
from psotrack.files import refuse_to_overwrite

if TYPE_CHECKING:
    from psotrack.marks import Marks

#: Points that are shown by name, those that fit worst.
_WORST = 5
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}


class Size(click.ParamType):
    """Two whole numbers above 0, such as 1920,1080 or 7x5."""

    name = "W,H"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """A pair of integers; what is no string was converted before."""
        if not isinstance(value, str):
            return value
        words = value.replace("x", ",").split(",")
        if len(words) != 2 or not all(word.isdecimal() and int(word) > 0 for word in words):
            self.fail(f"expected two whole numbers above 0, such as 1920,1080, found {value!r}", param, ctx)
        return int(words[0]), int(words[1])


OUT = click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="A file that ends in .toml, .yml or .csv."
)
SIZE = click.option(
    "--size", "image_size_wh", type=Size(), help="Of the images in pixels, where FILE does not have it."
)


def _noise(default: float) -> Any:
    return click.option(
        "--noise",
        "noise_px",
        type=float,
        default=default,
        show_default=True,
        help="Standard deviation of a point in the image, along x and along y, in pixels.",
    )


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
def calibrate() -> None:
    """Calibrate cameras, and convert calibrations.

    \b
    Lenses:             psotrack calibrate intrinsics a.avi --squares 7x5 --square 0.04 --marker 0.03 --out lens.toml
    Where cameras are:  psotrack calibrate extrinsics --pairs pairs.csv --intrinsics lens.toml --out rig.toml
    From the drones:    psotrack calibrate adjust SEQ --tracks tracks.csv --out better.toml
    Other programs:     psotrack calibrate convert rig.toml cameras_calibration.csv
    """


@calibrate.command()
@click.option(
    "--pairs",
    type=click.Path(path_type=Path),
    help="Points marked by hand: camera,point,x_px,y_px,x_m,y_m,z_m.",
)
@click.option(
    "--points",
    type=click.Path(path_type=Path),
    help="Where the points are, if --pairs does not say: point,x_m,y_m,z_m.",
)
@click.option(
    "--markers",
    type=click.Path(path_type=Path),
    metavar="SEQ",
    help="Instead of --pairs: find the ArUco markers of SEQ's aruco_corners.csv in its videos.",
)
@click.option("--dictionary", default="4x4_1000", show_default=True, help="Of the markers.")
@click.option(
    "--intrinsics",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="The cameras' lenses; a file of one camera is for all.",
)
@click.option("--fov", "fov_deg", type=Numbers(2), metavar="H,V", help="Instead: fields of view in degrees.")
@click.option("--focal-length", "focal_length_mm", type=float, help="Instead: in millimetres, with --sensor.")
@click.option("--sensor", "sensor_mm", type=Numbers(2), metavar="W,H", help="Its size in millimetres.")
@SIZE
@_noise(1.0)
@OUT
@FORCE
@QUIET
@JSON
def extrinsics(
    pairs: Path | None,
    points: Path | None,
    markers: Path | None,
    dictionary: str,
    noise_px: float,
    out: Path,
    force: bool,
    quiet: bool,
    json_path: Path | None,
    **lens: Any,
) -> None:
    """Find where cameras stand, from points whose places in the world and in the images are known.

    Four points that are not on one line are the least; twelve, spread over the image and in depth, are good. Points
    that do not agree with the others are left out, and shown.

    \b
    Examples:
      psotrack calibrate extrinsics --pairs pairs.csv --intrinsics lens.toml --out rig.toml
      psotrack calibrate extrinsics --pairs pairs.csv --points points.csv --fov 92.4,60.8 --size 1920,1080 --out rig.yml
      psotrack calibrate extrinsics --markers data/Simulated_Data/S01_D2_A --intrinsics rig.toml --out found.toml
    """
    from psotrack.calibration import locate_camera
    from psotrack.cameras import Camera, stack
    from psotrack.marks import read_marks
    from psotrack.rig_files import write_rig

    if (pairs is None) == (markers is None):
        found = "neither" if pairs is None else "both"
        raise SettingsError("extrinsics", expected="--pairs FILE or --markers SEQ", found=found)
    refuse_to_overwrite(out, force)
    marks = read_marks(pairs, points) if pairs else _marker_marks(Path(str(markers)), dictionary)
    lenses = _lenses(list(marks), **lens)
    cameras: dict[str, Camera] = {}
    rows: dict[str, dict[str, Any]] = {}
    for name, of_camera in marks.items():
        one = lenses[name]
        located = locate_camera(
            of_camera.points_m, of_camera.points_px, one.K, one.dist, noise_px, name=f"camera {name}"
        )
        cameras[name] = replace(one, T_cam_world=located.T_cam_world)
        rows[name] = _row(
            np.asarray(cameras[name].centre_world),
            located.centre_covariance_m2,
            located.residual_px,
            located.used,
            of_camera.points,
        )
    rig = stack(cameras)
    write_rig(out, rig, force=force)
    _answer(rows, out, quiet, json_path, force)


@calibrate.command()
@click.argument("video", type=click.Path(path_type=Path))
@click.option("--squares", "squares_wh", type=Size(), required=True, help="Of the board, such as 7x5.")
@click.option("--square", "square_m", type=float, required=True, help="Side of a square in metres.")
@click.option("--marker", "marker_m", type=float, required=True, help="Side of a marker in metres.")
@click.option("--dictionary", default="4x4_50", show_default=True, help="Of the markers.")
@click.option("--name", help="Of the camera.  [default: the video's]")
@OUT
@FORCE
@QUIET
@JSON
def intrinsics(
    video: Path,
    squares_wh: tuple[int, int],
    square_m: float,
    marker_m: float,
    dictionary: str,
    name: str | None,
    out: Path,
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Find a camera's lens from VIDEO, in which a ChArUco board is moved about.

    Carry the board into all corners of the image, near and far, and tilt it.

    \b
    Example:
      psotrack calibrate intrinsics board.avi --squares 7x5 --square 0.04 --marker 0.03 --out lens.toml
    """
    from psotrack.cameras import stack
    from psotrack.lenses import Board, lens_of_board
    from psotrack.rig_files import write_rig
    from psotrack.video import probe

    refuse_to_overwrite(out, force)
    lens = lens_of_board(probe(video), Board(squares_wh, square_m, marker_m, dictionary))
    write_rig(out, stack({name or video.stem: lens.camera}), force=force)
    K, dist = lens.camera.K, lens.camera.dist
    values = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *dist]
    names = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2")
    content = {
        "lens": str(out),
        "values": {key: float(value) for key, value in zip(names, values, strict=True)},
        "std": {key: float(value) for key, value in zip(names, lens.std, strict=True)},
        "frames": lens.frame.tolist(),
        "residual_px": lens.residual_px.tolist(),
    }
    answer(json_path, content, force)
    if not quiet and json_path != Path("-"):
        table = _table("", "value", "give or take")
        for key, value, std in zip(names, values, lens.std, strict=True):
            table.add_row(key, f"{value:.5g}", f"{std:.2g}")
        _print(table)
    rms = float(np.sqrt(np.mean(lens.residual_px**2)))
    worst = lens.frame[lens.residual_px.argmax()]
    say(
        quiet,
        json_path,
        f"{out}: {len(lens.frame)} views, residual {rms:.2f} px, {lens.residual_px.max():.2f} px in frame {worst}",
    )


@calibrate.command()
@SEQUENCE
@click.option(
    "--tracks", type=click.Path(path_type=Path), required=True, help="Of SEQ's drones, as `track` writes."
)
@click.option("--fixed", default="", metavar="NAME,NAME...", help="Cameras that stay where they are.")
@click.option("--refine-focal-length", is_flag=True, help="Scale all focal lengths by a common factor, too.")
@_noise(2.0)
@OUT
@FORCE
@QUIET
@JSON
def adjust(
    sequence: Path,
    tracks: Path,
    fixed: str,
    refine_focal_length: bool,
    noise_px: float,
    out: Path,
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Move the cameras of SEQ until they agree on where its drones are: a bundle adjustment.

    The points are the middles of SEQ's detections that hold a tracked drone. Where the world's origin is, how its axes
    are turned and how large it is cannot be seen from them: the rig as a whole stays where it is.

    The middle of a box is not quite that of a drone: a rig that is right is moved by 1 to 3 cm. Keep the result where
    cameras moved by more than that.

    \b
    Example:
      psotrack calibrate adjust data/Simulated_Data/S02_D4_A --tracks tracks.csv --out better.toml
    """
    from psotrack.bundle import adjust as bundle
    from psotrack.datasets.dpjait import read_sequence
    from psotrack.detections import read_detections
    from psotrack.marks import in_boxes
    from psotrack.rig_files import write_rig
    from psotrack.trajectory_files import read_trajectories

    refuse_to_overwrite(out, force)
    recording = read_sequence(sequence)
    if not recording.detections:
        raise InputError(sequence, expected="detections in dl_data", found="none")
    detections = {name: read_detections(path) for name, path in recording.detections.items()}
    flown = read_trajectories(tracks, fps=recording.fps if recording.videos else None)
    points_px, names, groups = in_boxes(recording.rig, detections, flown)
    adjusted = bundle(
        recording.rig,
        points_px,
        noise_px,
        fixed=[name for name in fixed.split(",") if name],
        refine_focal_length=refine_focal_length,
        groups=groups,
    )
    write_rig(out, adjusted.rig, force=force)
    before_m, after_m = (np.asarray(rig.cameras.centre_world) for rig in (recording.rig, adjusted.rig))
    rows: dict[str, dict[str, Any]] = {}
    for index, name in enumerate(recording.rig.names):
        seen = np.isfinite(adjusted.residual_px[:, index])
        centre = after_m[index]
        rows[name] = _row(
            centre,
            adjusted.centre_covariance_m2[index],
            adjusted.residual_px[seen, index],
            adjusted.used[seen, index],
            [point for point, there in zip(names, seen, strict=True) if there],
        )
        rows[name]["moved_m"] = float(np.linalg.norm(centre - before_m[index]))
    _answer(rows, out, quiet, json_path, force)
    if refine_focal_length:
        scale, std = adjusted.focal_scale, adjusted.focal_scale_std
        say(quiet, json_path, f"focal lengths x {scale:.5f}, give or take {std:.5f}")


@calibrate.command()
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.argument("out", metavar="OUT", type=click.Path(path_type=Path))
@SIZE
@click.option(
    "--unit",
    type=click.Choice(list(_METRES)),
    default="m",
    show_default=True,
    help="Of the lengths in IN; a CSV names its own.",
)
@FORCE
@QUIET
@JSON
def convert(
    source: Path,
    out: Path,
    image_size_wh: tuple[int, int] | None,
    unit: str,
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Convert a calibration: IN and OUT end in .csv (DPJAIT), .toml (anipose, caliscope) or .yml (OpenCV).

    \b
    Examples:
      psotrack calibrate convert calibration.toml cameras_calibration.csv --unit mm
      psotrack calibrate convert cameras_calibration.csv rig.yml --size 1920,1080
    """
    from psotrack.rig_files import read_rig, write_rig

    rig = read_rig(source, image_size_wh, metres_per_unit=_METRES[unit])
    write_rig(out, rig, force=force)
    rows: dict[str, dict[str, Any]] = {
        name: {"centre_m": centre.tolist(), "focal_length_px": float(K[0, 0])}
        for name, centre, K in zip(rig.names, rig.cameras.centre_world, rig.cameras.K, strict=True)
    }
    answer(json_path, {"rig": str(out), "cameras": rows}, force)
    if not quiet and json_path != Path("-"):
        table = _table("camera", "centre (m)", "f (px)")
        for name, row in rows.items():
            table.add_row(name, _numbers(row["centre_m"], 3), f"{row['focal_length_px']:.1f}")
        _print(table)
    say(quiet, json_path, f"{out}")


def _lenses(
    names: list[str],
    *,
    intrinsics: Path | None,
    fov_deg: tuple[float, float] | None,
    focal_length_mm: float | None,
    sensor_mm: tuple[float, float] | None,
    image_size_wh: tuple[int, int] | None,
) -> Mapping[str, Any]:
    """The lens of each camera, from the one of three ways that was chosen."""
    from psotrack.lenses import lens_of_sensor, lens_of_view
    from psotrack.rig_files import read_lenses

    ways = [value is not None for value in (intrinsics, fov_deg, focal_length_mm)]
    if sum(ways) != 1 or (focal_length_mm is None) != (sensor_mm is None):
        raise SettingsError(
            "lens",
            expected="--intrinsics FILE, or --fov H,V, or --focal-length with --sensor",
            found="another choice" if any(ways) else "none",
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


def _marker_marks(folder: Path, dictionary: str) -> dict[str, Marks]:
    from psotrack.datasets.dpjait import MARKER_CORNERS, read_sequence
    from psotrack.inside_out.marker_map import read_marker_map
    from psotrack.marks import find_markers

    corners_m = read_marker_map(folder / MARKER_CORNERS).corners_m
    videos = read_sequence(folder).videos
    return {name: find_markers(video, corners_m, dictionary) for name, video in videos.items()}


def _row(
    centre_m: Float[np.ndarray, "3"],
    covariance_m2: Float[np.ndarray, "3 3"],
    residual_px: Float[np.ndarray, " points"],
    used: np.ndarray,
    points: Any,
) -> dict[str, Any]:
    order = np.argsort(-residual_px)[:_WORST]
    return {
        "centre_m": centre_m.tolist(),
        "centre_std_m": np.sqrt(np.diag(covariance_m2)).tolist(),
        "points": len(residual_px),
        "used": int(used.sum()),
        "rms_px": float(np.sqrt(np.mean(residual_px[used] ** 2))) if used.any() else None,
        "worst": [
            # Behind the camera there is no distance.
            {
                "point": str(points[index]),
                "residual_px": float(residual_px[index]) if np.isfinite(residual_px[index]) else None,
                "used": bool(used[index]),
            }
            for index in order
        ],
    }


def _answer(
    rows: dict[str, dict[str, Any]], out: Path, quiet: bool, json_path: Path | None, force: bool
) -> None:
    answer(json_path, {"rig": str(out), "cameras": rows}, force)
    if not quiet and json_path != Path("-"):
        moved = any("moved_m" in row for row in rows.values())
        table = _table(
            "camera",
            "points",
            "rms (px)",
            "centre (m)",
            "std (mm)",
            *["moved (mm)"] * moved,
        )
        for name, row in rows.items():
            table.add_row(
                name,
                f"{row['used']} of {row['points']}",
                "" if row["rms_px"] is None else f"{row['rms_px']:.2f}",
                _numbers(row["centre_m"], 3),
                _numbers([1e3 * std for std in row["centre_std_m"]], 1),
                *([f"{1e3 * row['moved_m']:.1f}"] if moved else []),
            )
        _print(table)
        # Names of points may be long, and a column of them narrow.
        for name, row in rows.items():
            say(quiet, json_path, f"{name}, worst points (px): {', '.join(map(_worst, row['worst']))}")
    say(quiet, json_path, f"{out}")


def _worst(one: dict[str, Any]) -> str:
    distance = "behind" if one["residual_px"] is None else f"{one['residual_px']:.1f}"
    return f"{one['point']} {distance}{'' if one['used'] else ' left out'}"


def _numbers(values: list[float], digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)


def _table(*headings: str) -> Any:
    from rich import box
    from rich.table import Table

    table = Table(box=box.HORIZONTALS, show_edge=False)
    for heading in headings:
        left = heading in {"", "camera"}
        table.add_column(heading, justify="left" if left else "right")
    return table


def _print(table: Any) -> None:
    from rich.console import Console

    Console().print(table)
