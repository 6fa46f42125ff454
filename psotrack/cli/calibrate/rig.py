"""`psotrack calibrate rig`: lenses and places of all cameras from a board that is moved before them, or from points."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psotrack.cli.calibrate.options import LENS, OUT, board_of, board_options, noise_option
from psotrack.cli.calibrate.rig_points import (
    Distance,
    calibrate_pairs,
    calibrate_points,
    in_words,
    is_recording,
)
from psotrack.cli.calibrate.shown import show_cameras
from psotrack.cli.options import FORCE, JSON, plot_option, reporting
from psotrack.cli.output import POSITION, format_numbers, output_json, print_line, print_table, report_to
from psotrack.errors import SettingsError, errors_name
from psotrack.support import refuse_to_overwrite

if TYPE_CHECKING:
    from psotrack.calibration import Board, CalibratedRig, CameraFigures, LensChoice


@click.command()
@click.argument("sources", metavar="[VIDEO...]", nargs=-1, type=click.Path(path_type=Path))
@board_options()
@LENS
@click.option(
    "--same-lens", is_flag=True, help="All cameras have one lens, as equal cameras at equal zoom nearly do."
)
@click.option(
    "--lenses",
    "lenses_path",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Calibration whose lenses are kept; a camera that is not in FILE gets a lens from the board.",
)
@click.option(
    "--names", metavar="NAME,NAME...", help="Names of the cameras.  [default: from the files' names]"
)
@click.option(
    "--floor",
    type=int,
    metavar="FRAME",
    help="Frame in which the board lies on the floor: its first corner is the origin, and z points up.  "
    "[default: the first camera is the world]",
)
@click.option(
    "--world",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Three or more points and where they are: point,x_m,y_m,z_m, where a point is a camera, or a frame of the "
    "moving point; with camera,x_px,y_px for points that are marked in the images of two cameras.",
)
@click.option(
    "--points",
    "is_point",
    is_flag=True,
    help="A single moving point instead of a board: the detections of the recording, or a CSV file with "
    "camera,frame,x_px,y_px (and point, for the two ends of a stick). Needs --lenses.",
)
@click.option(
    "--distance",
    type=Distance(),
    help="Distance between two cameras' centres in metres, for --points: a,b=4.20.",
)
@click.option("--stick", "stick_m", type=float, help="Distance of the two points in metres, for --points.")
@click.option(
    "--pairs",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Points of known place instead of a board: camera,point,x_px,y_px,x_m,y_m,z_m. Needs --lenses.",
)
@click.option(
    "--markers",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="ArUco markers of known place instead of a board: a map of their corners. Needs --lenses.",
)
@noise_option(1.0)
@plot_option("a picture of where each camera saw the board", "beside OUT, as .png")
@OUT
@FORCE
@reporting
@JSON
def rig(
    sources: tuple[Path, ...],
    kind: str | None,
    squares_wh: tuple[int, int] | None,
    square_m: float | None,
    marker_m: float | None,
    separation_m: float | None,
    dictionary: str,
    first_marker: int,
    lens: str,
    same_lens: bool,
    lenses_path: Path | None,
    names: str | None,
    floor: int | None,
    world: Path | None,
    is_point: bool,
    distance: tuple[str, str, float] | None,
    stick_m: float | None,
    pairs: Path | None,
    markers: Path | None,
    noise_px: float,
    plot: Path | None,
    out: Path,
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Calibrate a rig from nothing: lenses and places of all cameras, from a board that is moved before them.

    Each VIDEO is that of one camera: a video, a folder of images, or a pattern such as 'left*.png'. Frames of equal
    number are one instant. A single recording.toml, or its folder, says by itself when each frame was exposed. The
    board must be seen by two cameras at a time, and the pairs must join all cameras.
    With --points, VIDEO is a recording with detections, or a CSV file; with --pairs there is none.

    \b
    Examples:
      psotrack calibrate rig cam_0.mp4 cam_1.mp4 --squares 4x5 --square 0.054 --marker 0.0405 --out rig.toml
      psotrack calibrate rig left right --squares 10x7 --square 0.025 --floor 0 --out rig.toml
      psotrack calibrate rig a b --squares 6x6 --marker 0.09 --separation 0.03 --dictionary apriltag_36h11 --out r.toml
      psotrack calibrate rig a b --squares 1x1 --marker 0.2 --first-marker 7 --lenses lenses.toml --out rig.toml
      psotrack calibrate rig SEQ --points --lenses lenses.toml --distance left,right=4.20 --out rig.toml
      psotrack calibrate rig --pairs pairs.csv --lenses lenses.toml --out rig.toml
    """
    refuse_to_overwrite(out, force)
    modes = {
        "--squares": squares_wh is not None,
        "--points": is_point,
        "--pairs": pairs is not None,
        "--markers": markers is not None,
    }
    chosen = [name for name, is_chosen in modes.items() if is_chosen]
    if len(chosen) != 1:
        raise SettingsError(
            "rig", expected=f"one of {', '.join(modes)}", found=" and ".join(chosen) if chosen else "none"
        )
    if (distance is not None or stick_m is not None) and not is_point:
        raise SettingsError("rig", expected="--distance and --stick with --points", found=chosen[0])
    if not sources and pairs is None:
        raise SettingsError("rig", expected="a video, a folder or a pattern for each camera", found="none")
    if squares_wh is None:
        if floor is not None or plot is not None:
            raise SettingsError("rig", expected="--floor and --plot with --squares", found=chosen[0])
        if is_point:
            found, points, sentences = calibrate_points(sources, lenses_path, distance, stick_m, world)
        else:
            found, points, sentences = calibrate_pairs(
                sources, pairs, markers, dictionary, lenses_path, noise_px, world
            )
        _write(out, found, force)
        show_cameras(points, out, quiet, json_path, force, sentences)
        return
    from psotrack.calibration import fit_world, in_new_world, read_world

    board = board_of(kind, squares_wh, square_m, marker_m, separation_m, dictionary, first_marker)
    if world is not None and floor is not None:
        raise SettingsError("rig", expected="--floor or --world", found="both")
    given = None if world is None else read_world(world)
    lenses = _lenses(lens, same_lens, lenses_path)
    calibrated, said = _by_board(sources, names, board, lenses, floor, quiet, json_path)
    if given is None:
        place = (
            f"the board in frame {floor}: its first corner is the origin, z points up"
            if floor is not None
            else f"camera {calibrated.rig.names[0]}: x right, y down, z forward; --floor and --world place it elsewhere"
        )
    else:
        with errors_name(given.path):
            change, left_m = fit_world(calibrated.rig, given, with_scale=False)
        calibrated, place = in_new_world(calibrated, change), in_words(given.path, left_m)
    _write(out, calibrated.rig, force)
    if plot is not None:
        from psotrack.calibration import save_coverage

        save_coverage(plot if plot != Path("") else out.with_suffix(".png"), calibrated, force=force)
    _report(calibrated, said, place, out, force, quiet, json_path)


def _write(out: Path, rig: Any, force: bool) -> None:
    from psotrack.geometry.rig_files import write_rig

    write_rig(out, rig, force=force)


def _by_board(
    sources: tuple[Path, ...],
    names: str | None,
    board: Board,
    lenses: LensChoice,
    floor: int | None,
    quiet: bool,
    json_path: Path | None,
) -> tuple[CalibratedRig, list[str]]:
    """Calibrate by a board; also sentences on how the board was printed, which are printed at once."""
    from psotrack.calibration import (
        calibrate_rig,
        find_views,
        instants_of_numbers,
        open_images,
        open_recorded,
        say_print,
        say_searched,
    )
    from psotrack.recordings.datasets import open_recording

    if len(sources) == 1 and is_recording(sources[0]):
        cameras, instants = open_recorded(open_recording(sources[0]), floor)
    else:
        cameras = open_images(sources, names.split(",") if names else None)
        instants = instants_of_numbers(cameras, floor)
    report = report_to(quiet)
    named = f"{sources[0]} and {len(sources) - 1} more" if sources[1:] else f"{sources[0]}"
    with errors_name(named):
        found = find_views(board, cameras, instants, report)
    every = {camera.name: len(camera.frames) for camera in cameras}
    searched = dict(zip(found.views.names, found.searched.tolist(), strict=True))
    said = say_print(found)
    for sentence in [*say_searched({name: (count, every[name]) for name, count in searched.items()}), *said]:
        print_line(quiet, json_path, sentence)
    with errors_name(named):
        calibrated = calibrate_rig(found.recognised.board, found.views, lenses, floor=floor, report=report)
    return calibrated, said


def _report(
    calibrated: CalibratedRig,
    said: list[str],
    place: str,
    out: Path,
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Print the cameras, the worst views and what to do, or write them as JSON."""
    from psotrack.calibration import advise, figures_of, worst_views

    rows, advice, worst = figures_of(calibrated), advise(calibrated), worst_views(calibrated)
    content = {
        "rig": str(out),
        "cameras": {name: asdict(row) for name, row in rows.items()},
        "print": said,
        "worst_views": [
            {"camera": name, "frame": frame, "residual_px": residual} for name, frame, residual in worst
        ],
        "advice": advice,
        "world": place,
    }
    output_json(json_path, content, force)
    _show(rows, quiet, json_path)
    models = ", ".join(f"{name} {row.lens}" for name, row in rows.items())
    print_line(quiet, json_path, f"lens models (distortion coefficients): {models}")
    views = ", ".join(f"{name} {frame} {residual:.2f}" for name, frame, residual in worst)
    print_line(quiet, json_path, f"worst views (camera, frame, px): {views}")
    for sentence in advice:
        print_line(quiet, json_path, sentence)
    print_line(quiet, json_path, f"the world is {place}")
    print_line(quiet, json_path, f"{out}")


def _lenses(lens: str, is_shared: bool, path: Path | None) -> LensChoice:
    """The lenses of the options."""
    from psotrack.calibration import LensChoice, known_lenses, parse_lens_model
    from psotrack.geometry.rig_files import read_lenses

    known = None if path is None else known_lenses(read_lenses(path))
    return LensChoice(parse_lens_model(lens), known, is_shared)


def _show(rows: dict[str, CameraFigures], quiet: bool, json_path: Path | None) -> None:
    """Table of the cameras."""
    print_table(
        quiet,
        json_path,
        ("camera", "views", "rms (px)", "f (px)", POSITION, "std (mm)"),
        (
            (
                name,
                f"{row.views}",
                f"{row.rms_px:.2f}",
                f"{row.focal_px[0]:.1f}\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}{row.focal_std_px[0]:.1f}",
                # Adding 0 makes -0 to 0.
                format_numbers([round(value, 3) + 0.0 for value in row.centre_m], 3),
                f"{1e3 * math.hypot(*row.centre_std_m):.1f}",
            )
            for name, row in rows.items()
        ),
    )
