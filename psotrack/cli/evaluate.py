"""`psotrack evaluate`: compare tracks with the reference of their sequence."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import click
from msgspec import Meta

from psotrack.cli.options import (
    BODIES,
    FORCE,
    JSON,
    QUIET,
    TRACKS,
    plot_option,
    sequence_argument,
    sequence_of,
)
from psotrack.cli.output import Output, pass_output
from psotrack.cli.records import HelpfulCommand, options_of
from psotrack.errors import SettingsError, errors_name
from psotrack.evaluation import PathSettings
from psotrack.support import first_line

if TYPE_CHECKING:
    from psotrack.evaluation import PathComparison
    from psotrack.trajectories import Trajectories


@dataclass(frozen=True)
class ReferenceOptions:
    """What of the reference a path is compared with.

    Attributes:
        drone: drone of the reference that carries the camera; None: the name in TRACKS, or the only drone.
        orientations: orientations of the reference by a clock of their own, as of an IMU, as TUM.
    """

    drone: Annotated[str, Meta(extra={"metavar": "NAME"})] | None = None
    orientations: Path | None = None


_NAMES = {"with_lever_arm": "lever-arm", "with_turn": "turn", "max_offset_s": "max-offset"}


@click.command(cls=HelpfulCommand)
@TRACKS
@sequence_argument
@plot_option("3D paths and error over time", "beside TRACKS, as .png")
@click.option(
    "--offset",
    metavar="SECONDS|auto",
    callback=lambda _, __, given: _read_offset(given),
    help="Time by which the reference's clock is ahead of the videos'; auto estimates it, up to 2 s.  [default: 0; "
    "auto for paths with orientations]",
)
@options_of(ReferenceOptions, "given", heading="Paths with orientations")
@options_of(PathSettings, "settings", names=_NAMES, heading="Paths with orientations")
@BODIES
@FORCE
@QUIET
@JSON
@pass_output
def evaluate(
    output: Output,
    tracks: Path,
    sequence: Path | None,
    plot: Path | None,
    offset: float | Literal["auto"] | None,
    bodies: dict[str, tuple[str, ...]],
    **options: Any,
) -> None:
    """Compare TRACKS with the reference of SEQ.

    SEQ is the recording of TRACKS; the record beside TRACKS names it.

    The path of one camera or drone, as `psotrack onboard localise` writes it, is compared with its orientation, as in
    the paper's Tables 7 and 8: the offset of the clocks is searched, and distances and differences of roll, pitch and
    yaw are stated. So are all paths with --drone, and where SEQ is a file of poses: TUM, or a table.

    TRACKS is a file of `psotrack track`, or tracks of any other program: CSV, Parquet, JSON, TUM, KITTI, MOTChallenge
    with positions, C3D or MCAP, as a file or a folder.

    \b
    Examples:
      psotrack evaluate my_lab/results/tracks.csv
      psotrack evaluate tracks.csv data/Simulated_Data/S02_D4_A --json errors.json --plot errors.png
      psotrack evaluate tracks.csv data/Real_Data/R12_D4 --offset auto
      psotrack evaluate tracks.csv flight --body cf1=M1,M2,M3,M4 --body cf2
      psotrack evaluate folder_of_tum_files data/Simulated_Data/S02_D4_A
      psotrack evaluate dron1.csv data/Simulated_Data/S01_D2_A --json errors.json --plot errors.png
      psotrack evaluate gopro.csv data/Real_Data/R17_D1_A --orientations imu.tum
      psotrack evaluate slam.tum groundtruth.tum --offset 0 --no-lever-arm --no-turn
    """
    from psotrack.calibration.clocks import own_reference, reference_for
    from psotrack.evaluation import evaluate as compare
    from psotrack.evaluation import plots, tables
    from psotrack.evaluation.path_plots import save_paths
    from psotrack.recordings.datasets import open_recording
    from psotrack.recordings.exchange import read_tracks

    sequence = sequence_of(tracks, sequence)
    is_poses = sequence.is_file() and sequence.suffix.lower() not in (".toml", ".c3d")
    if is_poses or options["given"] != ReferenceOptions() or _is_camera_path(tracks):
        reference = (
            read_tracks(sequence) if is_poses else own_reference(open_recording(sequence, bodies=bodies))
        )
        found = _compare_path(tracks, sequence, reference, None if offset == "auto" else offset, **options)
        output.json(found.to_dict())
        output.show(tables.render_paths(found, title=f"{tracks.name} and {sequence.name}"))
        if plot is not None:
            picture = plot if plot.name else tracks.with_suffix(".png")
            save_paths(picture, {tracks.stem: found}, force=output.force)
            output.say(f"{picture}: the path, and errors over time")
        return
    recording = open_recording(sequence, bodies=bodies)
    estimate = read_tracks(tracks, recording=recording)
    with errors_name(f"{tracks} and {sequence}"):
        truth, offset_s = reference_for(recording, estimate, offset)
        evaluation = compare(estimate, truth)
    content = evaluation.to_dict() | ({} if offset is None else {"reference_offset_s": offset_s})
    output.json(content)
    clock = "" if offset is None else f", reference's clock {offset_s:+.4f} s"
    output.show(tables.render(evaluation, title=f"{recording.name}{clock}"))
    if plot is not None:
        picture = plot if plot.name else tracks.with_suffix(".png")
        plots.save_overview(picture, estimate, truth, force=output.force)
        output.say(f"{picture}: paths, and errors over time")


def _is_camera_path(tracks: Path) -> bool:
    """Whether a file is a table of `psotrack onboard localise`."""
    return tracks.is_file() and tracks.suffix.lower() == ".csv" and "reprojection_px" in first_line(tracks)


def _compare_path(
    tracks: Path,
    sequence: Path,
    reference: Trajectories,
    offset_s: float | None,
    *,
    given: ReferenceOptions,
    settings: PathSettings,
) -> PathComparison:
    """Compare the path of one drone with its reference."""
    from psotrack.evaluation import compare_paths, drone_of
    from psotrack.recordings.exchange import read_tracks

    path = drone_of(read_tracks(tracks), given.drone)
    turns = None if given.orientations is None else drone_of(read_tracks(given.orientations))
    with errors_name(f"{tracks} and {sequence}"):
        body = drone_of(reference, given.drone or path.drones[0])
        return compare_paths(path, body, turns, settings, offset_s=offset_s)


def _read_offset(given: str | None) -> float | Literal["auto"] | None:
    """The value of --offset."""
    if given is None:
        return None
    if given == "auto":
        return "auto"
    try:
        offset_s = float(given)
    except ValueError:
        offset_s = math.nan
    if not math.isfinite(offset_s):
        raise SettingsError("--offset", expected="a number of seconds, or auto", found=given)
    return offset_s
