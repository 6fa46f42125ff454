"""`psotrack onboard fuse`: fuse the paths of on-board cameras with the tracks of static cameras."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from msgspec import Meta

from psotrack import inside_out, trajectories
from psotrack.cli.commands import command
from psotrack.cli.output import Output, check_suffix
from psotrack.cli.types import says
from psotrack.errors import InputError, errors_name
from psotrack.recordings import exchange


@command(without=["progress"])
def fuse(
    output: Output,
    inside: tuple[Path, ...],
    outside: Path,
    *,
    out: Path | None = None,
    point: Annotated[Literal["camera", "middle"], says(flag="at")] = "camera",
    max_offset_s: Annotated[Annotated[float, Meta(gt=0)] | None, says(metavar="SECONDS")] = None,
) -> None:
    """Fuse INSIDE, paths of on-board cameras, with OUTSIDE, tracks of the same drones from static cameras.

    INSIDE are files of `psotrack onboard localise`, one per drone. OUTSIDE is a file of `psotrack track`; its drones
    may have other names. Paths are smoothed, unless they have velocities, and positions are weighted by their
    covariances. The command estimates the scales of the covariances and the lever arm from the camera to the middle of
    the drone, and assigns the tracks to the drones. Drones that occur in one input only are kept. If no track is near
    any path, the files are not of one recording: nothing is written.

    \b
    Examples:
      psotrack onboard fuse dron1.csv dron2.csv tracks.csv --out fused.csv
      psotrack onboard fuse dron1.csv tracks.csv --out fused.csv --max-offset 5 --json -
      psotrack evaluate fused.csv data/Simulated_Data/S01_D2_A

    Options:
        out: CSV file of the fused tracks. None: fused.csv beside OUTSIDE.
        point: tracked point of the fused tracks: the camera's centre, or the middle of the drone as static cameras see
            it.
        max_offset_s: estimate the offset of each on-board camera's clock, up to SECONDS. None: no clock has an offset.
    """
    out = out or outside.with_name("fused.csv")
    check_suffix("--out", out, ".csv")
    output.refuse(out)
    paths: dict[str, inside_out.CameraPath] = {}
    for file in inside:
        path, name = inside_out.read_camera_path(file)
        if name in paths:
            raise InputError(file, expected="the path of another drone", found=f"a second path of {name}")
        paths[name] = path
    tracks = exchange.read_tracks(outside)
    if not any(path.seen.any() for path in paths.values()):
        where = ", ".join(map(str, inside))
        raise InputError(where, expected="a pose in at least one frame", found="none")
    if max_offset_s is None:
        _check_times(paths, tracks, outside)
    with errors_name(outside):
        fused = inside_out.fuse(paths, tracks, point=point, max_offset_s=max_offset_s)
    inside_out.write_fused(out, fused, force=output.force)
    output.json(fused.to_dict())
    *lines, whole = str(fused).splitlines()
    output.say(*lines, f"{out}: {whole}")


def _check_times(
    paths: Mapping[str, inside_out.CameraPath], tracks: trajectories.Trajectories, outside: Path
) -> None:
    """Raise `InputError` if no path has times in common with the tracks."""
    begin_s, end_s = tracks.time_s[[0, -1]]
    spans = [path.time_s[[0, -1]] for path in paths.values()]
    if not any(first_s <= end_s and begin_s <= last_s for first_s, last_s in spans):
        listed = ", ".join(
            f"{first_s:.2f} to {last_s:.2f} s of {name}"
            for name, (first_s, last_s) in zip(paths, spans, strict=True)
        )
        raise InputError(
            outside,
            expected=f"times in common with the paths, {listed}",
            found=f"{begin_s:.2f} to {end_s:.2f} s",
            remedy="all files must be of one recording; --max-offset SECONDS estimates the offset of a clock",
        )
