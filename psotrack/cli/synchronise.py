"""`psotrack synchronise`: estimate the offset between the clocks of a sequence's reference and of its videos."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psotrack.cli.options import BODIES, FORCE, JSON, QUIET, SEQUENCE, TRACKS, plot_option
from psotrack.cli.output import output_json, print_line
from psotrack.errors import errors_name

if TYPE_CHECKING:
    from psotrack.calibration.clocks import Offset
    from psotrack.trajectories import Trajectories


@click.command()
@TRACKS
@SEQUENCE
@click.option(
    "--max-offset",
    "max_offset_s",
    type=float,
    default=2.0,
    show_default=True,
    help="Largest offset that is tried, in seconds, in both directions.",
)
@plot_option("the mean distance over the offsets", "beside TRACKS, as .offset.png")
@BODIES
@FORCE
@QUIET
@JSON
def synchronise(
    tracks: Path,
    sequence: Path,
    max_offset_s: float,
    plot: Path | None,
    bodies: dict[str, tuple[str, ...]],
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Find the offset between the clocks of SEQ's reference and of its videos, from the motion in TRACKS.

    The offset minimises the mean distance between TRACKS and the reference, to a fraction of a frame. Each drone may
    have a constant lever arm. A .c3d file is read at its own rate, which may differ from the videos'.

    \b
    Examples:
      psotrack synchronise tracks.csv data/Real_Data/R12_D4
      psotrack synchronise tracks.csv data/Real_Data/R12_D4 --max-offset 10 --plot offset.png --json -
    """
    from psotrack.calibration.clocks import find_offset, own_reference, save_curve
    from psotrack.recordings.datasets import open_recording
    from psotrack.recordings.exchange import read_tracks

    recording = open_recording(sequence, bodies=bodies)
    reference = own_reference(recording)
    estimate = read_tracks(tracks, recording=recording)
    with errors_name(f"{tracks} and {sequence}"):
        offset = find_offset(
            estimate,
            reference.time_s,
            reference.position_m,
            reference.orientation_wxyz,
            max_offset_s=max_offset_s,
        )
    output_json(json_path, _content(offset, estimate, reference), force)
    if plot is not None:
        save_curve(plot if plot.name else tracks.with_suffix(".offset.png"), offset, force=force)
    print_line(quiet, json_path, f"{recording.name}: {offset_in_words(offset, recording.fps)}")


def offset_in_words(offset: Offset, fps: float) -> str:
    """What was found, in one line."""
    before = (
        "nothing to compare" if offset.mean_distance_before_m is None else _mm(offset.mean_distance_before_m)
    )
    ahead = offset.offset_s >= 0
    return (
        f"the reference's clock is {abs(offset.offset_s):.4f} s (± {offset.std_s:.4f} s) "
        f"{'ahead of' if ahead else 'behind'} the videos' ({offset.offset_s * fps:+.2f} frames): the videos show the "
        f"scene {'early' if ahead else 'late'}; mean distance, lever arms taken out: "
        f"{before} before, {_mm(offset.mean_distance_m)} after"
    )


def _mm(value_m: float) -> str:
    return f"{1e3 * value_m:.1f} mm"


def _content(offset: Offset, estimate: Trajectories, reference: Trajectories) -> dict[str, Any]:
    """The offset as JSON, with null for missing numbers."""
    from psotrack.trajectories import UNASSIGNED

    drones = [
        {
            "drone": name,
            "estimate": None if partner == UNASSIGNED else estimate.drones[partner],
            "lever_arm_m": None if partner == UNASSIGNED else offset.lever_arm_m[drone].tolist(),
        }
        for drone, (name, partner) in enumerate(zip(reference.drones, offset.partner, strict=True))
    ]
    return {
        "offset_s": offset.offset_s,
        "std_s": offset.std_s,
        "mean_distance_before_m": offset.mean_distance_before_m,
        "mean_distance_m": offset.mean_distance_m,
        "overlap": offset.overlap,
        "lever_arm_frame": "world" if reference.orientation_wxyz is None else "body",
        "drones": drones,
        "curve": {
            "offset_s": offset.curve_s.tolist(),
            "mean_distance_m": [None if value != value else value for value in offset.curve_m.tolist()],
        },
    }
