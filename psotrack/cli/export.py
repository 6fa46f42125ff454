"""`psotrack export`: tracks in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psotrack.cli.options import FORCE, QUIET, TRACKS, Numbers
from psotrack.cli.output import print_line, report_to
from psotrack.errors import InputError, OutputError, SettingsError

if TYPE_CHECKING:
    from psotrack.exchange import Footage
    from psotrack.recordings import Recording
    from psotrack.trajectories import Trajectories

FORMAT_NAMES = ("tum", "kitti", "mot", "c3d", "mcap", "csv", "parquet", "json")


@click.command()
@TRACKS
@click.argument("sequence", metavar="[SEQ]", type=click.Path(path_type=Path), required=False)
@click.option("--to", type=click.Choice(FORMAT_NAMES), required=True, help="Format of the output.")
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    help="File of the output; a folder for tum with several drones, kitti, and mot with SEQ; either for mcap.",
)
@click.option("--images", is_flag=True, help="Write the images of SEQ's cameras too; only with --to mcap.")
@click.option(
    "--drone-size",
    "drone_size_m",
    type=Numbers(3),
    metavar="X,Y,Z",
    help="Full lengths of a drone along x, y and z, in metres, for boxes of --to mot.  [default: those that the record "
    "beside TRACKS has]",
)
@FORCE
@QUIET
def export(
    tracks: Path,
    sequence: Path | None,
    to: str,
    out: Path,
    images: bool,
    drone_size_m: tuple[float, ...] | None,
    force: bool,
    quiet: bool,
) -> None:
    """Write TRACKS in a format of another program.

    A line says what the format cannot hold. SEQ adds what only its cameras have: for mot the boxes in each camera, for
    mcap the cameras and with --images their images. `psotrack evaluate OUT SEQ` reads all of these formats again.

    \b
    Examples:
      psotrack export tracks.csv --to tum --out tum
      psotrack export tracks.csv --to c3d --out tracks.c3d
      psotrack export tracks.csv data/Simulated_Data/S02_D4_A --to mot --out mot
      psotrack export tracks.csv data/Simulated_Data/S02_D4_A --to mcap --out flight.mcap --images
    """
    from psotrack.datasets import open_recording
    from psotrack.exchange import export_tracks, read_tracks

    _check_options(tracks, sequence, to, out, images)
    recording = None if sequence is None else open_recording(sequence)
    trajectories = read_tracks(tracks, recording=recording)
    footage = None
    if recording is not None:
        footage = _footage(recording, trajectories, tracks, images, drone_size_m)
    lost = export_tracks(trajectories, to, out, footage=footage, force=force, report=report_to(quiet))
    left = f"; not in this format: {', '.join(lost)}" if lost else ""
    drones = f"{trajectories.num_drones} drone{'s' if trajectories.num_drones != 1 else ''}"
    print_line(quiet, None, f"{out}: {to}, {drones}, {trajectories.num_frames} frames{left}")


def _check_options(tracks: Path, sequence: Path | None, to: str, out: Path, images: bool) -> None:
    """Raise an error for options that do not fit each other, and for an output that would replace an input."""
    if images and (to != "mcap" or sequence is None):
        found = f"--to {to}" if to != "mcap" else "no SEQ"
        raise SettingsError("--images", expected="--to mcap and SEQ, whose images are written", found=found)
    inputs = {tracks.resolve(): "TRACKS"}
    if tracks.suffix in {".csv", ".parquet"}:
        inputs[tracks.with_suffix(".json").resolve()] = "the place of the record of TRACKS"
    if sequence is not None:
        inputs[sequence.resolve()] = "SEQ"
    if out.resolve() in inputs:
        raise OutputError(
            out,
            expected="another path than those of the inputs",
            found=inputs[out.resolve()],
            remedy="name another one; nothing was written",
        )


def _footage(
    recording: Recording,
    trajectories: Trajectories,
    tracks: Path,
    images: bool,
    drone_size_m: tuple[float, ...] | None,
) -> Footage:
    import numpy as np

    from psotrack.exchange import Footage

    if drone_size_m is not None:
        if min(drone_size_m) <= 0:
            raise SettingsError("--drone-size", expected="lengths above 0", found=f"{drone_size_m}")
        return Footage(recording, np.tile(drone_size_m, (trajectories.num_drones, 1)), images)
    sizes = _recorded_sizes(tracks.with_suffix(".json"))
    known = all(name in sizes for name in trajectories.drones)
    size_m = np.array([sizes[name] for name in trajectories.drones], float) if known else None
    return Footage(recording, size_m, images)


def _recorded_sizes(record: Path) -> dict[str, Any]:
    """Sizes by the drones' names, from the record of a run; empty where there is none that has them."""
    import json

    if not record.is_file():
        return {}
    try:
        drones = json.loads(record.read_text(encoding="utf-8")).get("drones")
        if not isinstance(drones, list):
            return {}
        return {str(drone["drone"]): drone["size_m"] for drone in drones if drone.get("size_m")}
    except (OSError, ValueError, AttributeError, KeyError, TypeError) as error:
        found = f"{error}".partition("\n")[0]
        raise InputError(record, expected="the record of the tracks beside it", found=found) from error
