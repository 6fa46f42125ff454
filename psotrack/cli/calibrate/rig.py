"""`psotrack calibrate rig`: lenses and places of all cameras from a board that is moved before them, or from points."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click
from msgspec import Meta

from psotrack.cli.calibrate.options import BOARD_NAMES, OUT, BoardOptions, noise_option
from psotrack.cli.calibrate.rig_points import (
    Distance,
    calibrate_pairs,
    calibrate_points,
    in_words,
)
from psotrack.cli.calibrate.shown import show_cameras
from psotrack.cli.options import FORCE, JSON, plot_option, reporting
from psotrack.cli.output import POSITION, Output, format_numbers, pass_output
from psotrack.cli.records import HelpfulCommand, options_of
from psotrack.errors import SettingsError, errors_name

if TYPE_CHECKING:
    from psotrack.calibration import CalibratedRig, CameraFigures, LensChoice


@dataclass(frozen=True)
class LensOptions:
    """The lenses of the cameras.

    Attributes:
        lens: number of distortion coefficients of OpenCV's lens model, or its fisheye model; auto chooses by views that
            are left out.
        same_lens: all cameras have one lens, as equal cameras at equal zoom nearly do.
        lenses: calibration whose lenses are kept; a camera that is not in the file gets a lens from the board.
    """

    lens: Annotated[str, Meta(extra={"metavar": "auto|0|4|5|8|12|14|fisheye"})] = "auto"
    same_lens: bool = False
    lenses: Path | None = None

    def choice(self) -> LensChoice:
        """The lenses of the options."""
        from psotrack.calibration import LensChoice, known_lenses, parse_lens_model
        from psotrack.geometry.rig_files import read_lenses

        known = None if self.lenses is None else known_lenses(read_lenses(self.lenses))
        return LensChoice(parse_lens_model(self.lens), known, self.same_lens)


@dataclass(frozen=True)
class PointOptions:
    """What is seen instead of a board.

    Attributes:
        points: a single moving point instead of a board: the detections of the recording, or a CSV file with
            camera,frame,x_px,y_px (and point, for the two ends of a stick). Needs --lenses.
        distance: distance between two cameras' centres in metres, for --points: a,b=4.20.
        stick_m: distance of the two points in metres, for --points.
        pairs: points of known place instead of a board: camera,point,x_px,y_px,x_m,y_m,z_m. Needs --lenses.
        markers: ArUco markers of known place instead of a board: a map of their corners. Needs --lenses.
    """

    points: bool = False
    distance: Annotated[tuple[str, str, float], Meta(extra={"type": Distance()})] | None = None
    stick_m: float | None = None
    pairs: Path | None = None
    markers: Path | None = None


@click.command(cls=HelpfulCommand)
@click.argument("sources", metavar="[VIDEO...]", nargs=-1, type=click.Path(path_type=Path))
@options_of(BoardOptions, "board", names=BOARD_NAMES, heading="Board")
@options_of(LensOptions, "lens", heading="Lenses")
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
@options_of(PointOptions, "points", heading="Instead of a board")
@noise_option(1.0)
@plot_option("a picture of where each camera saw the board", "beside OUT, as .png")
@OUT
@FORCE
@reporting
@JSON
@pass_output
def rig(
    output: Output,
    sources: tuple[Path, ...],
    board: BoardOptions,
    lens: LensOptions,
    points: PointOptions,
    names: str | None,
    floor: int | None,
    world: Path | None,
    noise_px: float,
    plot: Path | None,
    out: Path,
) -> None:
    """Calibrate a rig from nothing: lenses and places of all cameras, from a board that is moved before them.

    Each VIDEO is that of one camera: a video, a folder of images, or a pattern such as 'left*.png'; a folder of videos
    stands for all of them. Frames of equal number are one instant. A single recording.toml, or its folder, says by
    itself when each frame was exposed. The board must be seen by two cameras at a time, and the pairs must join all
    cameras. Of the board only --square must be stated: whether it is a ChArUco board or a chessboard, its squares,
    markers and dictionary are found in the images; --squares states them. With --points, VIDEO is a recording with
    detections, or a CSV file; with --pairs there is none.

    \b
    Examples:
      psotrack calibrate rig my_lab/board --square 0.04 --out my_lab/rig.toml
      psotrack calibrate rig cam_0.mp4 cam_1.mp4 --squares 4x5 --square 0.054 --marker 0.0405 --out rig.toml
      psotrack calibrate rig left right --squares 10x7 --square 0.025 --floor 0 --out rig.toml
      psotrack calibrate rig a b --squares 6x6 --marker 0.09 --separation 0.03 --dictionary apriltag_36h11 --out r.toml
      psotrack calibrate rig a b --squares 1x1 --marker 0.2 --first-marker 7 --lenses lenses.toml --out rig.toml
      psotrack calibrate rig SEQ --points --lenses lenses.toml --distance left,right=4.20 --out rig.toml
      psotrack calibrate rig --pairs pairs.csv --lenses lenses.toml --out rig.toml
    """
    from psotrack.recordings.datasets import is_recording, videos_in

    output.refuse(out)
    modes = {
        "--squares": board.squares is not None,
        "--points": points.points,
        "--pairs": points.pairs is not None,
        "--markers": points.markers is not None,
    }
    chosen = [name for name, is_chosen in modes.items() if is_chosen]
    if not chosen and board.square_m is not None:
        chosen = ["--square"]
    if len(chosen) != 1:
        raise SettingsError(
            "rig",
            expected=f"one of --square, {', '.join(modes)}",
            found=" and ".join(chosen) if chosen else "none",
        )
    if (points.distance is not None or points.stick_m is not None) and not points.points:
        raise SettingsError("rig", expected="--distance and --stick with --points", found=chosen[0])
    if not sources and points.pairs is None:
        raise SettingsError("rig", expected="a video, a folder or a pattern for each camera", found="none")
    if len(sources) == 1 and not is_recording(sources[0]):
        # A folder of videos stands for all of them.
        sources = tuple(videos_in(sources[0])) or sources
    if chosen[0] in ("--points", "--pairs", "--markers"):
        if floor is not None or plot is not None:
            raise SettingsError("rig", expected="--floor and --plot with --squares", found=chosen[0])
        if points.points:
            found, rows, sentences = calibrate_points(
                sources, lens.lenses, points.distance, points.stick_m, world
            )
        else:
            found, rows, sentences = calibrate_pairs(
                sources, points.pairs, points.markers, board.dictionary, lens.lenses, noise_px, world
            )
        _write(output, out, found)
        show_cameras(output, rows, out, sentences)
        return
    from psotrack.calibration import fit_world, in_new_world, read_world

    if world is not None and floor is not None:
        raise SettingsError("rig", expected="--floor or --world", found="both")
    given = None if world is None else read_world(world)
    calibrated, said = _by_board(output, sources, names, board, lens.choice(), floor)
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
    _write(output, out, calibrated.rig)
    if plot is not None:
        from psotrack.calibration import save_coverage

        save_coverage(plot if plot != Path("") else out.with_suffix(".png"), calibrated, force=output.force)
    _report(output, calibrated, said, place, out)


def _write(output: Output, out: Path, rig: Any) -> None:
    from psotrack.geometry.rig_files import write_rig

    write_rig(out, rig, force=output.force)


def _by_board(
    output: Output,
    sources: tuple[Path, ...],
    names: str | None,
    board: BoardOptions,
    lenses: LensChoice,
    floor: int | None,
) -> tuple[CalibratedRig, list[str]]:
    """Calibrate by a board; also sentences on how the board was printed, which are printed at once."""
    from psotrack.calibration import (
        calibrate_rig,
        describe_board,
        detect_board,
        find_views,
        first_images,
        instants_of_numbers,
        open_images,
        open_recorded,
        say_print,
        say_searched,
    )
    from psotrack.recordings.datasets import is_recording, open_recording

    if len(sources) == 1 and is_recording(sources[0]):
        cameras, instants = open_recorded(open_recording(sources[0]), floor)
    else:
        cameras = open_images(sources, names.split(",") if names else None)
        instants = instants_of_numbers(cameras, floor)
    report = output.report
    if board.squares is None:
        stated = detect_board(board.square_m or 0.0, first_images(cameras, 4))
        output.say(f"the board is {describe_board(stated)}")
    else:
        stated = board.board()
    named = f"{sources[0]} and {len(sources) - 1} more" if sources[1:] else f"{sources[0]}"
    with errors_name(named):
        found = find_views(stated, cameras, instants, report)
    every = {camera.name: len(camera.frames) for camera in cameras}
    searched = dict(zip(found.views.names, found.searched.tolist(), strict=True))
    said = say_print(found)
    for sentence in [*say_searched({name: (count, every[name]) for name, count in searched.items()}), *said]:
        output.say(sentence)
    with errors_name(named):
        calibrated = calibrate_rig(found.recognised.board, found.views, lenses, floor=floor, report=report)
    return calibrated, said


def _report(output: Output, calibrated: CalibratedRig, said: list[str], place: str, out: Path) -> None:
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
    output.json(content)
    _show(output, rows)
    models = ", ".join(f"{name} {row.lens}" for name, row in rows.items())
    output.say(f"lens models (distortion coefficients): {models}")
    views = ", ".join(f"{name} {frame} {residual:.2f}" for name, frame, residual in worst)
    output.say(f"worst views (camera, frame, px): {views}")
    for sentence in advice:
        output.say(sentence)
    output.say(f"the world is {place}")
    output.say(f"{out}")


def _show(output: Output, rows: dict[str, CameraFigures]) -> None:
    """Table of the cameras."""
    output.table(
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
