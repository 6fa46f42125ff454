"""`psotrack onboard localise`: poses of a drone's camera from markers with known positions."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from psotrack import inside_out, recordings, trajectories
from psotrack.cli.commands import OptionGroup, command
from psotrack.cli.onboard.sources import LENS_NAMES, OnboardLensOptions, onboard_videos
from psotrack.cli.options import Dictionary, NumFrames
from psotrack.cli.output import Output, check_suffix
from psotrack.cli.types import says
from psotrack.errors import InputError, SettingsError
from psotrack.recordings import datasets
from psotrack.support.interrupts import unhurried_end


@dataclass(frozen=True)
class SourceOptions:
    """What is known of the video and of the markers in it.

    Attributes:
        markers: table of marker corners, or of centres (id,x_m,y_m,z_m); None: the sequence's.
        side_m: side of the markers in metres, if --markers has only their centres; None: estimated for each marker.
        drone: drone whose video is used, if VIDEO is a sequence's folder.
        name: name of the drone in the table; None: --drone, or VIDEO's name.
        fps: frames per second of a folder of images.
        live: VIDEO is a camera's number or a stream; always use the newest frame.
    """

    markers: Path | None = None
    side_m: Annotated[float, Meta(gt=0)] | None = None
    drone: Annotated[str | None, says(metavar="NAME")] = None
    name: Annotated[str | None, says(metavar="NAME")] = None
    dictionary: Dictionary = "4x4_1000"
    fps: float | None = None
    live: bool = False


@dataclass(frozen=True)
class PoseOptions:
    """How poses are estimated.

    Attributes:
        min_markers: smallest number of markers for a pose; poses from fewer than 4 markers are flagged.
        filter: filter the poses with a motion model.
        smooth: smooth the path: every pose is estimated from all frames.
        map_error: standard deviation of a marker's position, in millimetres, where the table states none.
        focal_error: standard deviation of the focal length, in percent.
        readout_s: time in which a rolling shutter exposes all rows of a frame, one after the other, seconds; 0 is a
            global shutter; None: estimated from the video.
    """

    min_markers: Annotated[int, Meta(ge=1)] = 4
    filter: bool = True
    smooth: bool = False
    map_error: Annotated[float, Meta(ge=0, lt=1000, extra={"metavar": "MM"})] = 0.0
    focal_error: Annotated[float, Meta(ge=0, lt=100, extra={"metavar": "PERCENT"})] = 0.0
    readout_s: Annotated[float | None, says(metavar="S")] = None


@command()
def localise(
    output: Output,
    video: str,
    *,
    out: Path | None = None,
    given: Annotated[SourceOptions, OptionGroup(names={"side_m": "marker-size"})],
    lenses: Annotated[OnboardLensOptions, OptionGroup("Lens", LENS_NAMES, rare=("names", "scale"))],
    poses: Annotated[PoseOptions, OptionGroup("Poses", rare=("readout_s",))],
    num_frames: NumFrames = None,
) -> None:
    """Find the position of the camera of VIDEO in every frame, from the ArUco markers that it sees.

    VIDEO is a video, a folder of images, the address of a stream, or an _A sequence of the dataset, which contains its
    markers and intrinsics. With --live, frames that arrive too fast are skipped; Ctrl-C ends the command, which then
    writes the poses so far.

    Markers may hang on walls, pillars, floor and ceiling, turned in any way. Those that are not where the table has
    them disagree with the others over the video; they are left out and named. A table of centres alone is weaker: some
    frames must show four markers at once, and errors of the centres are errors of the poses (see --map-error).

    Errors of the map and of the focal length are the same in all frames and do not average out. With --map-error and
    --focal-error the covariances include these errors, and poses from several markers become more accurate.

    Most cameras expose the rows of a frame one after the other (rolling shutter). The time that this takes is estimated
    from the video, unless --readout gives it; in a stream, without it, it is 0. A pose is that of the moment when the
    middle row is exposed, which is also the frame's time.

    \b
    Examples:
      psotrack onboard localise flight.mp4 --markers corners.csv --camera lens.toml --out track.csv
      psotrack onboard localise GOPR0017.MP4 --markers corners.csv --fov 92.45,60.83 --out track.csv --smooth
      psotrack onboard localise data/Simulated_Data/S01_D2_A --drone dron1 --out dron1.csv
      psotrack onboard localise images --fps 25 --markers corners.csv --camera lens.yml --out track.csv --frames 100
      psotrack onboard localise flight.mp4 --markers corners.csv --fov 92,61 --focal-error 0.5 --out track.csv
      psotrack onboard localise phone.mp4 --markers corners.csv --camera lens.yml --readout 0.02 --out track.csv
      psotrack onboard localise flight.mp4 --markers centres.csv --camera lens.toml --out track.csv --map-error 5
      psotrack onboard localise 0 --live --markers corners.csv --camera lens.yml --out track.csv

    Options:
        out: CSV file of the poses, one row per frame. None: NAME.csv, by the drone's name.
    """
    from dataclasses import replace

    source, drone_name, onboard = _input(video, given)
    out = out or Path(f"{drone_name}.csv")
    check_suffix("--out", out, ".csv")
    output.refuse(out)
    if given.markers is None and onboard is None:
        raise SettingsError("--markers", expected="a table of marker corners", found="none")
    table = given.markers or datasets.find_marker_corners(video)
    marker_map = inside_out.read_marker_table(table)
    centres_only = not isinstance(marker_map, inside_out.MarkerMap)
    if given.side_m is not None and not centres_only:
        raise SettingsError("--marker-size", expected="a table of centres alone", found=f"corners in {table}")
    lens = lenses.of(source.image_size_wh, K=None if onboard is None else onboard.K)
    name, source = source.name, source.first(num_frames)
    rows = source.image_size_wh[1]
    shutter = _shutter(poses.readout_s, rows, source.fps)
    settings = inside_out.LocaliseSettings(
        dictionary=given.dictionary,
        pose=inside_out.PoseSettings(
            min_markers=poses.min_markers,
            map_error_m=poses.map_error / 1e3,
            focal_error=poses.focal_error / 100,
        ),
        filter=inside_out.PoseFilterParams() if poses.filter else None,
        shutter=shutter,
    )
    # What a stream has shown is kept: no one can show the stream again.
    with unhurried_end() if source.stream else contextlib.nullcontext():
        found = inside_out.localise_video(
            source, marker_map, lens, settings, output.report, side_m=given.side_m
        )
        if poses.smooth:
            found = replace(found, path=found.smoothed(settings.filter))
        inside_out.write_camera_path(out, found.path, drone_name, force=output.force)
    content = _content(found, name, drone_name, settings.pose.min_markers)
    content |= {"track": str(out), "filtered": poses.filter, "smoothed": poses.smooth}
    content |= {"map_error_m": settings.pose.map_error_m, "focal_error": settings.pose.focal_error}
    content |= {"shutter": _shutter_content(shutter, found.shutter, found.line_time, rows)}
    content |= {"map": "centres" if centres_only else "corners"}
    output.json(content)
    output.say(_sentence(out, content) + _shutter_sentence(shutter, found.line_time))
    output.say(*_lines_on_map(table, found, centres_only, video))


def _input(
    video: str, given: SourceOptions
) -> tuple[inside_out.FrameSource, str, recordings.OnboardVideo | None]:
    """Frames, drone's name, and on-board video, if VIDEO is a sequence's folder and no video, images or stream."""
    stream, folder = given.live or "://" in video, Path(video)
    of_folder = not stream and folder.is_dir()
    if video.isdecimal() and not stream and not folder.exists():
        raise InputError(
            video, expected="a video", found="no such file", remedy="pass --live if it is a camera's number"
        )
    has_images = of_folder and recordings.is_picture_folder(folder)
    if of_folder and datasets.read_onboard(folder):
        chosen = onboard_videos(folder, None if given.drone is None else (given.drone,))
        if len(chosen) > 1:
            raise SettingsError("--drone", expected=f"one of {', '.join(chosen)}", found="none")
        ((drone, onboard),) = chosen.items()
        return inside_out.open_source(onboard.video.path, fps=given.fps), given.name or drone, onboard
    if given.drone is not None:
        raise SettingsError("--drone", expected="a folder with videos of drones' own cameras", found=video)
    if of_folder and not has_images:
        raise InputError(
            folder,
            expected=f"images, which end in {', '.join(recordings.IMAGE_SUFFIXES)}, or an _A sequence of the dataset",
            found="neither",
            remedy="to use a video in a folder, name the video itself",
        )
    name = "camera" if stream else folder.name if of_folder else folder.stem
    return inside_out.open_source(video, fps=given.fps, live=given.live), given.name or name, None


def _shutter(readout_s: float | None, rows: int, fps: float | None) -> inside_out.RollingShutter | None:
    """The shutter that --readout states; None without it."""
    if readout_s is None:
        return None
    longest_s = 1.0 if fps is None else 1 / fps
    if not 0 <= readout_s <= longest_s * (1 + 1e-9):
        of_frame = "" if fps is None else f", the time between two frames at {fps:g} frames per second"
        raise SettingsError("--readout", expected=f"0 to {longest_s:.3g} s{of_frame}", found=f"{readout_s:g}")
    return inside_out.RollingShutter(readout_s / rows)


def _content(found: inside_out.LocalisedVideo, video: str, name: str, min_markers: int) -> dict[str, Any]:
    """The results as JSON, with null for missing numbers."""
    import numpy as np

    path = found.path
    frames = path.num_frames
    shown = found.raw.reprojection_px[np.isfinite(found.raw.reprojection_px)]
    return {
        "video": video,
        "drone": name,
        "frames": frames,
        "poses": int(path.seen.sum()),
        "own_poses": int(found.raw.seen.sum()),
        "status": {status.label: int((path.status == status).sum()) for status in trajectories.Status},
        "flags": {flag.label: int(((path.flags & flag) != 0).sum()) for flag in inside_out.Flag},
        "min_markers": min_markers,
        "median_markers": float(np.median(path.num_markers)),
        "most_markers": int(path.num_markers.max()),
        "median_reprojection_px": float(np.median(shown)) if len(shown) else None,
        "wrong_markers": list(found.wrong_markers),
        "unknown_markers": list(found.unknown_markers),
        "interrupted": found.interrupted,
        "frames_per_second": found.frames_per_second,
        "wall_s": found.wall_s,
        "stage_s": dict(found.seconds),
        "stage_ms_per_frame": {stage: 1e3 * value / frames for stage, value in found.seconds.items()},
    }


def _lines_on_map(table: Path, found: inside_out.LocalisedVideo, centres_only: bool, video: str) -> list[str]:
    """What a user needs to know of the map."""
    lines = []
    wrong, count = found.wrong_markers, len(found.marker_map)
    if centres_only:
        sides_mm = 1e3 * found.marker_map.sides_m
        lines.append(
            f"{table}: centres alone, a weaker map: corners of {count} markers, {sides_mm.min():.0f} to "
            f"{sides_mm.max():.0f} mm wide, were found from the video; errors of the centres are errors of the poses"
        )
    if found.unknown_markers:
        names = ", ".join(map(str, found.unknown_markers))
        lines.append(
            f"{table}: not used, because too few frames show them where the table has them: markers {names}"
        )
    if not found.path.seen.any():
        # The sentence on the poses says what to check.
        return lines
    if len(wrong) > count / 2:
        lines.append(
            f"{table}: {len(wrong)} of {count} markers disagree with one another, so that no marker is left out: is it "
            "the map of this room, is the lens right, is an axis mirrored?"
        )
    elif wrong:
        names = ", ".join(map(str, wrong))
        lines.append(
            f"{table}: left out, because the other markers of the video say that they are elsewhere: markers {names}; "
            f"`psotrack onboard map {video} --check {table}` says what is wrong"
        )
    return lines


def _shutter_content(
    given: inside_out.RollingShutter | None,
    used: inside_out.RollingShutter,
    shown: inside_out.LineTime | None,
    rows: int,
) -> dict[str, Any]:
    """The shutter as JSON: that of --readout, that of the poses, and what the video shows, if it was looked for."""
    is_estimated = shown is not None and shown.is_shown
    return {
        "line_time_s": used.line_time_s,
        "line_time_std_s": used.std_s,
        "readout_s": used.line_time_s * rows,
        "reference_row": (rows - 1) / 2,
        "source": "given" if given is not None else "estimated" if is_estimated else "assumed",
        "shown": shown
        and {
            "line_time_s": shown.line_time_s,
            "std_s": shown.std_s,
            "frames": shown.frames,
            "is_sure": shown.is_shown,
            "contradicts": given is not None and shown.contradicts(given.line_time_s),
        },
    }


def _shutter_sentence(given: inside_out.RollingShutter | None, shown: inside_out.LineTime | None) -> str:
    """What the video shows of the shutter; empty where it confirms a global shutter or the given one."""
    if shown is None or (given is None and shown.is_shown and not shown.rolls):
        return ""
    readout = f"{1e3 * shown.readout_s:.2f} +- {1e3 * shown.readout_std_s:.2f} ms for a frame"
    if given is not None:
        if not shown.contradicts(given.line_time_s):
            return ""
        return f"; warning: the video shows a shutter of {readout}; the covariances include the difference"
    if shown.rolls:
        return f"; rolling shutter of {readout}, by {shown.frames} frames; poses are those of the middle row"
    return (
        f"; the motion does not show whether the shutter rolls ({readout}): taken as global, with this uncertainty; "
        "--readout states it"
    )


def _sentence(out: Path, content: dict[str, Any]) -> str:
    bridged, gated = content["status"]["coasting"], content["flags"]["gated"]
    stages = ", ".join(f"{stage} {value:.1f}" for stage, value in content["stage_ms_per_frame"].items())
    error_px = content["median_reprojection_px"]
    return (
        f"{out}: {content['drone']} in {content['poses']} of {content['frames']} frames"
        f"{f', {bridged} bridged by the filter' if bridged else ''}{f', {gated} gated' if gated else ''}; "
        f"median of {content['median_markers']:g} markers"
        f"{'' if error_px is None else f' that fit to {error_px:.2f} px'}; "
        f"{content['frames_per_second']:.1f} frames per second ({stages} ms)"
        f"{'; ended by Ctrl-C' if content['interrupted'] else ''}{_doubt(content)}"
    )


def _doubt(content: dict[str, Any]) -> str:
    """Advice where no frame has a pose; empty otherwise."""
    most = content["most_markers"]
    if content["poses"]:
        return ""
    if not most and not content["wrong_markers"]:
        return "; no frame shows a marker of the map: check --dictionary, --markers, and that no image is mirrored"
    if content["own_poses"] and not content["wrong_markers"]:
        return f"; the filter rejected all {content['own_poses']} poses: --no-filter keeps them"
    if most < content["min_markers"] and not content["wrong_markers"]:
        return f"; no frame shows more than {most} markers of the map: --min-markers requires {content['min_markers']}"
    return "; no pose fits the markers: check --markers, --camera or --fov, and that no image is mirrored"
