"""`psotrack onboard fuse`: fuse the paths of on-board cameras with the tracks of static cameras."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psotrack.cli.options import out_option, running
from psotrack.cli.output import Output, check_suffix
from psotrack.cli.records import HelpfulCommand
from psotrack.errors import InputError, check_positive

if TYPE_CHECKING:
    from psotrack.inside_out import CameraPath, DroneFusion, FusedDrone, FusedTracks, SourceErrors
    from psotrack.trajectories import Trajectories


@click.command(cls=HelpfulCommand)
@click.argument("inside", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.argument("outside", type=click.Path(path_type=Path))
@out_option("CSV file of the fused tracks.  [default: fused.csv beside OUTSIDE]")
@click.option(
    "--at",
    "point",
    type=click.Choice(["camera", "middle"]),
    default="camera",
    show_default=True,
    help="Tracked point of the fused tracks: the camera's centre, or the middle of the drone as static cameras see it.",
)
@click.option(
    "--max-offset",
    "max_offset_s",
    type=float,
    metavar="SECONDS",
    help="Estimate the offset of each on-board camera's clock, up to SECONDS.  [default: no clock has an offset]",
)
@running(progress=False)
def fuse(
    output: Output,
    inside: tuple[Path, ...],
    outside: Path,
    out: Path | None,
    point: Any,
    max_offset_s: float | None,
) -> None:
    """Fuse INSIDE, paths of on-board cameras, with OUTSIDE, tracks of the same drones from static cameras.

    INSIDE are files of `psotrack onboard localise`, one per drone. OUTSIDE is a file of `psotrack track`; its drones
    may have other names. Positions are weighted by their covariances. The command estimates the scales of the
    covariances and the lever arm from the camera to the middle of the drone, and assigns the tracks to the drones.
    Drones that occur in one input only are kept unchanged. If no track is near any path, the files are not of one
    recording: nothing is written.

    \b
    Examples:
      psotrack onboard fuse dron1.csv dron2.csv tracks.csv --out fused.csv
      psotrack onboard fuse dron1.csv tracks.csv --out fused.csv --max-offset 5 --json -
      psotrack evaluate fused.csv data/Simulated_Data/S01_D2_A
    """
    from psotrack.inside_out import fuse as fuse_paths
    from psotrack.inside_out import read_camera_path, write_fused
    from psotrack.recordings.exchange import read_tracks

    out = out or outside.with_name("fused.csv")
    check_suffix("--out", out, ".csv")
    output.refuse(out)
    if max_offset_s is not None:
        check_positive("--max-offset", max_offset_s)
    paths: dict[str, CameraPath] = {}
    for file in inside:
        path, name = read_camera_path(file)
        if name in paths:
            raise InputError(file, expected="the path of another drone", found=f"a second path of {name}")
        paths[name] = path
    tracks = read_tracks(outside)
    if not any(path.seen.any() for path in paths.values()):
        where = ", ".join(map(str, inside))
        raise InputError(where, expected="a pose in at least one frame", found="none")
    if not tracks.seen.any():
        raise InputError(outside, expected="a position in at least one frame", found="none")
    if max_offset_s is None:
        _check_times(paths, tracks, outside)
    fused = fuse_paths(paths, tracks, point=point, max_offset_s=max_offset_s)
    _check_near(fused, outside)
    write_fused(out, fused, force=output.force)
    output.json(_content(fused))
    for drone in fused.drones:
        output.say(_sentence(drone))
    for exchange in fused.identity_swaps:
        output.say(
            f"from frame {exchange.frame}: {exchange.drone} is track {exchange.after} instead of {exchange.before}"
        )
    output.say(
        f"{out}: {fused.trajectories.num_drones} drones, {fused.trajectories.num_frames} frames{_doubt(fused)}"
    )


def _check_times(paths: Mapping[str, CameraPath], tracks: Trajectories, outside: Path) -> None:
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


def _check_near(fused: FusedTracks, outside: Path) -> None:
    """Raise `InputError` if no path has a track, although paths and tracks are known at the same times.

    Two positions of one drone at one time are at one place. Where all are far apart, at least one file is of another
    recording, or has another clock or another world, and there is nothing to fuse.
    """
    from psotrack.trajectories import GATE_M

    nearest_m = [drone.nearest_m for drone in fused.drones if not math.isnan(drone.nearest_m)]
    if nearest_m and not any(drone.tracks for drone in fused.drones):
        raise InputError(
            outside,
            expected=f"a track within {GATE_M:g} m of a path in most frames that have both",
            found=f"none (the nearest is {min(nearest_m):.2f} m away)",
            remedy="all files must have one recording, one clock (see --max-offset) and one world",
        )


def _doubt(fused: FusedTracks) -> str:
    """Advice where nothing was fused; empty otherwise."""
    if any(drone.tracks for drone in fused.drones):
        return ""
    return "; nothing was fused, because no frame has both a pose and a track"


def _sentence(drone: FusedDrone) -> str:
    parts = [
        f"{drone.name}: {' and '.join(f'track {name}' for name in drone.tracks) or 'no track, kept as it is'}"
    ]
    if drone.offset is not None:
        parts.append(f"clock {drone.offset.offset_s:+.4f} ± {drone.offset.std_s:.4f} s")
    parts.append(
        f"frames of both {drone.frames_both}, inside only {drone.frames_inside}, outside only {drone.frames_outside}"
    )
    if drone.fusion is not None:
        arm = ", ".join(
            f"{1e3 * value:.1f} ± {1e3 * std:.1f}"
            for value, std in zip(drone.fusion.arm_m, drone.fusion.arm_std_m, strict=True)
        )
        parts.append(f"arm ({arm}) mm")
        parts.extend(
            f"{word}: stated errors multiplied by {errors.scale:.2f}, {errors.gated} gross errors left out"
            for word, errors in (("inside", drone.fusion.inside), ("outside", drone.fusion.outside))
        )
    return "; ".join(parts)


def _content(fused: FusedTracks) -> dict[str, Any]:
    """The report as JSON, with null for missing numbers."""
    return {
        "point": fused.point,
        "frames": fused.trajectories.num_frames,
        "drones": [
            {
                "drone": drone.name,
                "tracks": list(drone.tracks),
                "offset_s": None if drone.offset is None else drone.offset.offset_s,
                "offset_std_s": None if drone.offset is None else drone.offset.std_s,
                "frames_both": drone.frames_both,
                "frames_inside": drone.frames_inside,
                "frames_outside": drone.frames_outside,
                **_found(drone.fusion),
            }
            for drone in fused.drones
        ],
        "others": list(fused.trajectories.drones[len(fused.drones) :]),
        "exchanges": [
            {"drone": of.drone, "frame": of.frame, "before": of.before, "after": of.after}
            for of in fused.identity_swaps
        ],
    }


def _found(fusion: DroneFusion | None) -> dict[str, Any]:
    if fusion is None:
        return {"lever_arm_m": None, "lever_arm_std_m": None, "inside": None, "outside": None}
    return {
        "lever_arm_m": fusion.arm_m.tolist(),
        "lever_arm_std_m": fusion.arm_std_m.tolist(),
        "inside": _errors(fusion.inside),
        "outside": _errors(fusion.outside),
    }


def _errors(errors: SourceErrors) -> dict[str, float]:
    return {
        "scale": errors.scale,
        "lasting_share": errors.lasting_share,
        "lasting_s": errors.lasting_s,
        "gross_frames": errors.gated,
    }
