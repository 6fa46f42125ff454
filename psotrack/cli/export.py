"""`psotrack export`: tracks in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from psotrack.cli.commands import command
from psotrack.cli.options import SeqOfTracks
from psotrack.cli.output import Output
from psotrack.cli.types import says
from psotrack.errors import OutputError, SettingsError, errors_name

if TYPE_CHECKING:
    import numpy as np

    from psotrack.trajectories import Trajectories

#: Ends of the files of formats that have one file.
_SUFFIXES = {"c3d": ".c3d", "mcap": ".mcap", "csv": ".csv", "parquet": ".parquet", "json": ".json"}
FORMAT_NAMES = ("tum", "kitti", "mot", "c3d", "mcap", "csv", "parquet", "json")


@command(without=["progress", "json_path"])
def export(
    output: Output,
    tracks: Path,
    sequence: SeqOfTracks = None,
    *,
    to: Annotated[str, says(type=click.Choice(FORMAT_NAMES))],
    out: Path | None = None,
    images: bool = False,
    drone_size_m: Annotated[tuple[float, float, float] | None, says(metavar="X,Y,Z")] = None,
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

    Options:
        to: format of the output.
        out: file of the output; a folder for tum with several drones, kitti, and mot with SEQ. None: beside TRACKS,
            with the format in its name.
        images: write the images of SEQ's cameras too; only with --to mcap.
        drone_size_m: full lengths of a drone along x, y and z, in metres, for boxes of --to mot. None: those that the
            record beside TRACKS has.
    """
    from psotrack.recordings.datasets import open_recording
    from psotrack.recordings.exchange import Footage, export_tracks, read_tracks

    out = out or tracks.with_name(f"{tracks.stem}_{to}{_SUFFIXES.get(to, '')}")
    _check_options(tracks, sequence, to, out, images)
    recording = None if sequence is None else open_recording(sequence)
    trajectories = read_tracks(tracks, recording=recording)
    footage = None
    if recording is not None:
        sizes_m = _sizes_m(trajectories, tracks, drone_size_m) if to == "mot" else None
        footage = Footage(recording, sizes_m, images)
    with errors_name(tracks):
        lost = export_tracks(trajectories, to, out, footage=footage, force=output.force, report=output.report)
    left = f"; not in this format: {', '.join(lost)}" if lost else ""
    drones = f"{trajectories.num_drones} drone{'s' if trajectories.num_drones != 1 else ''}"
    output.say(f"{out}: {to}, {drones}, {trajectories.num_frames} frames{left}")


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


def _sizes_m(
    trajectories: Trajectories, tracks: Path, drone_size_m: tuple[float, ...] | None
) -> np.ndarray | None:
    """(drones, 3), sizes of the drones, as the user says or from the record beside the tracks; None if unknown."""
    import numpy as np

    if drone_size_m is not None:
        if not min(drone_size_m) > 0:
            raise SettingsError("--drone-size", expected="lengths above 0", found=f"{drone_size_m}")
        return np.tile(drone_size_m, (trajectories.num_drones, 1))
    recorded = _recorded_sizes(tracks.with_suffix(".json"))
    sizes = [recorded.get(name, (np.nan,) * 3) for name in trajectories.drones]
    size_m = np.array(sizes, float)
    return size_m if np.isfinite(size_m).all() else None


def _recorded_sizes(record: Path) -> dict[str, list[float]]:
    """Sizes by the drones' names, from the record of a run; empty where there is no record that has them."""
    from psotrack.support import read_json

    if not record.exists():
        return {}
    drones = read_json(record, "the record of the tracks beside it").get("drones")
    # `track --causal` records the number of drones alone.
    listed = drones if isinstance(drones, list) else []
    return {str(each["drone"]): each["size_m"] for each in listed if each.get("size_m") and "drone" in each}
