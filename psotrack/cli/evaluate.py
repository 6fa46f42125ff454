"""`psotrack evaluate`: compare tracks with the reference of their sequence."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

from psotrack.cli.commands import OptionGroup, command
from psotrack.cli.options import Bodies, Plot, SeqOfTracks, sequence_of
from psotrack.cli.output import Output
from psotrack.cli.types import Words, says
from psotrack.errors import errors_name
from psotrack.evaluation import PathSettings
from psotrack.support import first_line


def _offset(given: str) -> float | Literal["auto"]:
    """The value of --offset."""
    if given == "auto":
        return "auto"
    if not math.isfinite(float(given)):
        raise ValueError
    return float(given)


_PATHS = "Paths with orientations"
_NAMES = {"with_lever_arm": "lever-arm", "with_turn": "turn", "max_offset_s": "max-offset"}


@command(without=["progress"])
def evaluate(
    output: Output,
    tracks: Path,
    sequence: SeqOfTracks = None,
    *,
    plot: Plot = None,
    offset: Annotated[
        float | Literal["auto"] | None,
        says(metavar="SECONDS|auto", type=Words("SECONDS|auto", "a number of seconds, or auto", _offset)),
    ] = None,
    drone: Annotated[str | None, says(metavar="NAME", heading=_PATHS)] = None,
    orientations: Annotated[Path | None, says(heading=_PATHS)] = None,
    settings: Annotated[PathSettings, OptionGroup(_PATHS, _NAMES)],
    bodies: Bodies,
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

    Options:
        plot: save paths from above and from the side, and errors over time. None: beside TRACKS, as .png.
        offset: time by which the reference's clock is ahead of the videos'; auto estimates it, up to 2 s. None: 0 s;
            auto for paths with orientations.
        drone: drone of the reference that carries the camera. None: the name in TRACKS, or the only drone.
        orientations: orientations of the reference by a clock of their own, as of an IMU, as TUM.
    """
    from psotrack import evaluation
    from psotrack.calibration.clocks import own_reference, reference_for
    from psotrack.evaluation import plots, tables
    from psotrack.recordings.datasets import open_recording
    from psotrack.recordings.exchange import read_tracks

    sequence = sequence_of(tracks, sequence)
    picture = None if plot is None else plot if plot.name else tracks.with_suffix(".png")
    output.refuse(picture)
    is_poses = sequence.is_file() and sequence.suffix.lower() not in (".toml", ".c3d")
    if is_poses or drone is not None or orientations is not None or _is_camera_path(tracks):
        path = evaluation.drone_of(read_tracks(tracks), drone)
        reference = (
            read_tracks(sequence) if is_poses else own_reference(open_recording(sequence, bodies=bodies))
        )
        turns = None if orientations is None else evaluation.drone_of(read_tracks(orientations))
        with errors_name(f"{tracks} and {sequence}"):
            body = evaluation.drone_of(reference, drone or path.drones[0])
            offset_s = None if offset == "auto" else offset
            compared = evaluation.compare_paths(path, body, turns, settings, offset_s=offset_s)
        output.json(compared.to_dict())
        output.say(*tables.paths_as_text(compared, f"{tracks.name} and {sequence.name}").splitlines())
        if picture is not None:
            plots.save_paths(picture, {tracks.stem: compared}, force=output.force)
            output.say(f"{picture}: paths, and errors over time")
        return
    recording = open_recording(sequence, bodies=bodies)
    estimate = read_tracks(tracks, recording=recording)
    with errors_name(f"{tracks} and {sequence}"):
        truth, by_s = reference_for(recording, estimate, offset)
        found = evaluation.evaluate(estimate, truth)
    output.json(found.to_dict() | ({} if offset is None else {"reference_offset_s": by_s}))
    clock = "" if offset is None else f", reference's clock {by_s:+.4f} s"
    output.say(*tables.as_text(found, f"{recording.name}{clock}").splitlines())
    if picture is not None:
        plots.save_overview(picture, estimate, truth, force=output.force)
        output.say(f"{picture}: paths, and errors over time")


def _is_camera_path(tracks: Path) -> bool:
    """Whether a file is a table of `psotrack onboard localise`."""
    return tracks.is_file() and tracks.suffix.lower() == ".csv" and "reprojection_px" in first_line(tracks)
