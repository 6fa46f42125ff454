"""Functions that are defined for the public face only: reading a recording, tracking it, and single steps.

What only some functions need is reached through its room (`calibration.save_coverage`), which loads it at its first
use.
"""

from __future__ import annotations

import functools
import inspect
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import UInt8

from psotrack import calibration, inside_out
from psotrack.calibration import doctor as examination
from psotrack.errors import InputError, SettingsError
from psotrack.foreground.markers import DetectedMarkers, MarkerDetector
from psotrack.foreground.silhouettes import ForegroundSettings, Living, SilhouetteSettings, compute
from psotrack.geometry.rig_files import write_rig
from psotrack.pipeline import (
    Parts,
    TrackedRecording,
    check_detections,
    detection_files_of,
    track_recording,
    with_real_time,
)
from psotrack.recordings import RECORDING_FILE, Recording, read_detections
from psotrack.recordings.datasets import (
    Draft,
    DraftOptions,
    draft_recording,
    is_recording,
    open_recording,
    videos_in,
)
from psotrack.settings import BLOBS, YOLO, TrackSettings, full_name
from psotrack.show import flights, reports
from psotrack.show import overlay as overlays
from psotrack.support import (
    Report,
    bind,
    read_json,
    refuse_files,
    report_of,
    short_text,
    user_cache,
    write_json,
)
from psotrack.tracking.births import room_bounds
from psotrack.tracking.matching import from_detections, from_silhouettes
from psotrack.trajectories import Trajectories

#: Fields of `RigSettings` that are files.
_RIG_FILES = ("lenses", "pairs", "places", "markers", "world")
#: Tracks in memory.
Tracks = TrackedRecording | Trajectories


def read_recording(
    folder: Path | str, *, cameras: Sequence[str] | str | None = None, num_frames: int | None = None
) -> Recording:
    """Read a recording, checked to be fit for tracking.

    Args:
        folder: a `recording.toml`, a folder that holds one, or a folder of the DPJAIT dataset.
        cameras: names of the cameras to use, or one name; None uses all.
        num_frames: number of first frames to use; None uses all.

    Raises:
        InputError: the folder or one of its files cannot be used; the message says what to do.
        SettingsError: a camera is unknown, or the videos have fewer frames.
    """
    return open_recording(folder).usable(cameras, num_frames, videos=False)


def track(
    recording: Recording | Path | str,
    settings: TrackSettings | Mapping[str, Any] | None = None,
    *,
    cache: Path | str | None = None,
    jobs: int | None = None,
    progress: bool | Report = False,
    **more: Any,
) -> TrackedRecording:
    """Track the drones of a recording.

    Silhouettes are made by several processes: in a script, call this function below `if __name__ == "__main__":`.

    Args:
        recording: recording from `read_recording`, or its `recording.toml` or folder.
        settings: settings, or names and values such as {"swarm.particles": 50}; None takes the defaults.
        cache: folder of stored silhouettes and detections; None takes the user's cache folder.
        jobs: number of processes for the silhouettes; None is one per processor.
        progress: whether to show progress bars; or a function that shows the progress (see `support.Report`).
        **more: single settings by the last part of their names, such as `particles=50`; and parts that the caller
            brings: `search`, `score`, `method`, `background`, `detector` (see `Parts`).

    Raises:
        InputError: a file cannot be used, or no drones are found.
        SettingsError: a setting does not exist, or does not fit the recording.
    """
    # A text is the name of a part, and so a setting.
    parts = {
        name: part
        for name, part in more.items()
        if name in Parts.__annotations__ and not isinstance(part, str)
    }
    single = {full_name(name): value for name, value in more.items() if name not in parts}
    if not isinstance(settings, TrackSettings):
        settings = TrackSettings().changed(settings or {})
    settings = settings.changed(single)
    if not isinstance(recording, Recording):
        recording = read_recording(recording)
        if "detector" not in parts:
            check_detections(recording, settings)
    return track_recording(
        recording,
        settings,
        cache=user_cache() if cache is None else cache,
        jobs=jobs,
        report=report_of(progress),
        **cast(Parts, parts),
    )


def calibrate_rig(
    sources: Path | str | Sequence[Path | str] = (),
    *,
    out: Path | str | None = None,
    plot: Path | str | None = None,
    force: bool = False,
    progress: bool | Report = False,
    **more: Any,
) -> calibration.RigCalibration:
    """Calibrate a rig from nothing: lenses and places of all cameras, from a board that is moved before them.

        calibrated = pt.calibrate_rig("my_lab/board", square_m=0.04, floor=0)
        pt.write_rig("my_lab/rig.toml", calibrated.rig)

    The result's text is what `psotrack calibrate rig` prints.

    Args:
        sources: for each camera a video, a folder of images or a pattern of their names; or a folder of videos, or a
            recording.
        out: file of the rig to write; None writes none.
        plot: picture to write of where each camera saw the board; None writes none.
        force: replace existing files.
        progress: as in `track`.
        **more: what is known, at least `square_m`, the side of a square of the board: fields of `RigSettings`.

    Raises:
        InputError: a file cannot be used, or what it shows does not determine the rig.
        SettingsError: a value does not exist, or does not fit the others.
        OutputError: a file exists and `force` is not set.
    """
    bind("calibrate_rig()", inspect.signature(calibration.RigSettings), (), more)
    files = {name: Path(more[name]) for name in _RIG_FILES if isinstance(more.get(name), str)}
    settings = calibration.RigSettings(**{**more, **files})
    paths = _paths(sources) if sources else []
    if not paths and settings.pairs is None:
        raise SettingsError("rig", expected="a video, a folder or a pattern for each camera", found="none")
    if len(paths) == 1 and not is_recording(paths[0]):
        # A folder of videos stands for all of them.
        paths = videos_in(paths[0]) or paths
    if plot is not None and not settings.by_board:
        raise SettingsError("rig", expected="--plot with --squares", found="points")
    refuse_files(*(Path(path) for path in (out, plot) if path is not None), force=force)
    if settings.points:
        found = calibration.calibrate_by_moving_point(paths, settings)
    elif settings.by_board:
        found = calibration.calibrate_by_board(paths, settings, report_of(progress))
        if found.misfit is not None and out is not None and not force:
            raise found.misfit
        if plot is not None and found.calibrated is not None:
            calibration.save_coverage(Path(plot), found.calibrated, force=force)
    else:
        corners_m = (
            None if settings.markers is None else inside_out.read_marker_map(settings.markers).corners_m
        )
        found = calibration.calibrate_by_known_points(paths, settings, corners_m)
    if out is not None:
        write_rig(out, found.rig, force=force)
        found = replace(found, path=Path(out))
    return found


def doctor(
    recording: Recording | Path | str,
    *,
    detections: str | None = None,
    bounds_m: Sequence[float] | None = None,
    cache: Path | str | None = None,
    jobs: int | None = None,
    progress: bool | Report = False,
) -> examination.Diagnosis:
    """Check the calibration of a recording against the detections of its cameras, before tracking.

    The result's text is what `psotrack doctor` prints: which camera, pair of cameras or file disagrees, by how much,
    and what to do.

    Args:
        recording: recording, or its `recording.toml` or folder.
        detections: "yolo" for the recording's own, "blobs" for those of its silhouettes, or a folder of files; None:
            the recording's own, or else blobs.
        bounds_m: bounds of the room (x0, x1, y0, y1, z0, z1), metres; None: far around the cameras.
        cache: folder of stored silhouettes; None takes the user's cache folder.
        jobs: number of processes for the silhouettes; None is one per processor.
        progress: as in `track`.

    Raises:
        InputError: a file cannot be used, or there are no detections.
    """
    if not isinstance(recording, Recording):
        recording = open_recording(recording)
    source = detections or (YOLO if recording.detections else BLOBS)
    if source == BLOBS:
        recording = recording.usable(silhouettes=True)
        stored, report = user_cache() if cache is None else cache, report_of(progress)
        made = compute(recording, SilhouetteSettings(), cache=stored, jobs=jobs, report=report)
        sightings = from_silhouettes(made, report)
    else:
        recording = recording.usable(videos=False)
        files = detection_files_of(recording, source)
        recording.check_detections(files)
        boxes = {name: read_detections(path) for name, path in files.items()}
        longest = max((each.times.num_frames for each in recording.cameras if each.times), default=0)
        sightings = from_detections(boxes, recording.rig, longest)
    room_m = recording.bounds_m if bounds_m is None else cast(Any, tuple(bounds_m))
    return examination.examine(
        recording.rig,
        sightings.at_instants(recording.timeline()),
        fps=recording.fps,
        reference=recording.truth,
        bounds_m=None if room_m is None else room_bounds(recording.rig, room_m),
    )


def report(
    source: Tracks | Path | str | Sequence[Path | str],
    out: Path | str | None = None,
    *,
    recording: Recording | Path | str | None = None,
    pictures: bool = True,
    jobs: int | None = None,
    force: bool = False,
    progress: bool | Report = False,
) -> reports.WrittenPage:
    """Write one HTML page about tracks.

    Args:
        source: the result of `track`, or trajectories; or files of tracks of one flight.
        out: file that ends in .html; None: beside the source, with the same name.
        recording: the recording of the tracks; None: the one that their record names.
        pictures: whether events are shown with a picture, where there are videos.
        jobs: largest number of videos that are read at the same time; None is one per processor.
        force: replace an existing file.
        progress: as in `track`.

    Raises:
        InputError: a file cannot be used.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    if out is None and isinstance(source, Tracks):
        raise SettingsError("report, out", expected="a file that ends in .html", found="none")
    flight = _flight(source, recording)
    page = flight.tracks[0].path.with_suffix(".html") if out is None else Path(out)
    return reports.write_flight_report(
        page, flight, pictures=pictures, jobs=jobs, force=force, report=report_of(progress)
    )


def overlay(
    tracks: Tracks | Path | str | Sequence[Path | str],
    out: Path | str | None = None,
    *,
    recording: Recording | Path | str | None = None,
    cameras: Sequence[str] | None = None,
    num_frames: int | None = None,
    jobs: int | None = None,
    progress: bool | Report = False,
    **more: Any,
) -> overlays.WrittenOverlays:
    """Draw tracks into the videos of their recording: boxes, names, trails, 90 % ellipses and time.

    Finished videos of the same tracks are kept.

    Args:
        tracks: the result of `track`, or trajectories; or files of tracks of one flight.
        out: folder of the videos; None: `overlay` beside the tracks.
        recording: the recording of the tracks; None: the one that their record names.
        cameras: names of the cameras to draw into; None uses all.
        num_frames: number of first frames; None is all.
        jobs: largest number of processes; None is one per processor.
        progress: as in `track`.
        **more: `mosaic`, `scale` and `force`, fields of `OverlayOptions`.

    Raises:
        InputError: a file cannot be used, or the recording has no video.
        SettingsError: a value is wrong.
        OutputError: the folder has other videos and `force` is not set, or a video cannot be written.
    """
    bind("overlay()", inspect.signature(overlays.OverlayOptions), (), more)
    if out is None and isinstance(tracks, Tracks):
        raise SettingsError("overlay, out", expected="a folder", found="none")
    flight = _flight(tracks, recording, cameras)
    if num_frames is not None:
        flight = flights.first_instants(flight, num_frames)
    folder = flight.tracks[0].path.parent / "overlay" if out is None else Path(out)
    return overlays.write_overlays(
        folder, flight, overlays.OverlayOptions(**more), jobs=jobs, report=report_of(progress)
    )


def save_picture(
    path: Path | str,
    tracks: Tracks | Path | str | Sequence[Path | str],
    *,
    recording: Recording | Path | str | None = None,
    most_cameras: int = 5,
    force: bool = False,
) -> None:
    """Save the middle moment of a flight as a picture: its first cameras with the tracks, and a map from above.

    Args:
        path: PNG file.
        tracks: the result of `track`, or trajectories; or files of tracks of one flight.
        recording: the recording of the tracks; None: the one that their record names.
        most_cameras: largest number of cameras.
        force: replace an existing file.

    Raises:
        InputError: a file cannot be used, or the recording has no video.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    overlays.save_picture(Path(path), _flight(tracks, recording), most_cameras=most_cameras, force=force)


def _paths(given: Path | str | Sequence[Path | str]) -> list[Path]:
    """One path, or several."""
    paths = [given] if isinstance(given, Path | str) else list(given)
    if not paths or not all(isinstance(path, Path | str) for path in paths):
        raise SettingsError("files", expected="one or more paths", found=short_text(given))
    return [Path(path) for path in paths]


def _flight(
    tracks: Tracks | Path | str | Sequence[Path | str],
    recording: Recording | Path | str | None,
    cameras: Sequence[str] | None = None,
) -> flights.TrackedFlight:
    """Tracks in memory or in files, with their recording."""
    if isinstance(tracks, Tracks):
        if not isinstance(recording, Recording | None):
            recording = open_recording(recording)
        if recording is not None and cameras is not None:
            recording = recording.usable(cameras, videos=False)
        return flights.flight_of(tracks, recording)
    return flights.read_flight(_paths(tracks), recording, cameras=cameras)


def run(
    folder: Path | str,
    *,
    square_m: float | None = None,
    floor: int | None = None,
    drones: int | None = None,
    again: bool = False,
    progress: bool | Report = True,
    say: Callable[[str], object] = print,
    **more: Any,
) -> flights.RunSummary:
    """Calibrate, check, track and show the videos of a rig, from board to report.

    The folder has a video of each camera, and a folder `board` with videos of the same cameras in which a board is
    moved, or a rig file. The results are in the folder `results` in it. A run that was stopped goes on where it was;
    to repeat a step and those after it, remove what it made.

    Args:
        folder: the folder.
        square_m: side of a square of the board, metres; needed where the folder has no rig file.
        floor: frame of the board's videos in which the board lies on the floor, which becomes the world's origin.
        drones: number of drones; None: all that are found.
        again: whether all steps are done again, also those that are done.
        progress: as in `track`.
        say: receives the command that does the same as each step, and what the step found.
        **more: what is said of files whose names do not say whose they are: fields of `DraftOptions`, such
            as `match=[("left", "GX010123.MP4")]`.

    Raises:
        InputError: a file is missing, cannot be used, or does not show what it has to.
        SettingsError: a value is wrong, or the side of a square is missing.
    """
    bind("run()", inspect.signature(DraftOptions), (), more)
    folder = Path(folder)
    if not videos_in(folder):
        raise InputError(folder, expected="a video of each camera", found="none")
    results, rig, board = folder / "results", folder / "rig.toml", folder / "board"
    tracks, page, found = results / "tracks.csv", results / "report.html", results / "doctor.json"
    common: dict[str, Any] = {"progress": progress}

    # What follows from a step that was done is done again, too.
    anew = again

    def step(
        command: str, made: Path | None, do: Callable[[], object], *given: object, **options: object
    ) -> bool:
        if made is not None and made.exists() and not anew:
            say(f"{made}: there already")
            return False
        typed = [words for name, value in options.items() for words in _option(name, value)]
        say(f"$ psotrack {command} {shlex.join(map(str, [*given, *typed]))}")
        done = do()
        if done is not None:
            say(f"{done}")
        return True

    is_drafted = (folder / RECORDING_FILE).exists()
    if not is_drafted or again or not open_recording(folder).is_placed:
        if board.is_dir():
            if square_m is None and (again or not rig.exists()):
                expected = "the side of a square of the board, metres"
                raise SettingsError("--square", expected=expected, found="none")
            known: dict[str, Any] = {
                "square_m": square_m,
                "floor": floor,
                "out": rig,
                "force": again,
                **common,
            }
            calibrate = functools.partial(calibrate_rig, board, **known)
            step("calibrate rig", rig, calibrate, board, square=square_m, floor=floor, out=rig)
        # Another rig file is found by itself.
        if rig.exists():
            more = {"calibration": rig, **more}
        # A recording whose cameras have no places yet is drafted anew; the old file is kept beside the new one.
        draft = functools.partial(_drafted, folder, DraftOptions(**more))
        anew = step("init", None, draft, folder, calibration=more.get("calibration"), force=is_drafted)
    if not open_recording(folder).is_placed:
        raise InputError(
            folder,
            expected=f"videos of a board in {board}, or a rig file",
            found="neither",
            remedy="`psotrack board` draws a board",
        )
    anew |= step("doctor", found, lambda: _written(found, doctor(folder, **common)), folder, json=found)
    kinds = [(each["kind"], *each["nearly_as_likely"]) for each in read_json(found)["findings"]]
    is_late = any("clock" in of_one for of_one in kinds)
    chosen = {"clocks": "auto"} if is_late else {}
    track_all = functools.partial(_tracked, folder, tracks, {**chosen, "drones.count": drones}, **common)
    anew |= step("track", tracks, track_all, folder, **chosen, drones=drones, out=tracks)
    shown: dict[str, Any] = {"recording": folder, "force": anew, **common}
    step("report", page, lambda: report(tracks, page, **shown), tracks, folder, out=page)
    # Finished videos of the same tracks are kept.
    videos = results / "overlay"
    step("overlay", None, lambda: overlay(tracks, videos, **shown), tracks, folder, out=videos)
    return flights.run_summary(folder)


def _option(name: str, value: object) -> list[object]:
    """Words of a command for an option; none for one that is not given."""
    return [] if value is None or value is False else [f"--{name}"] if value is True else [f"--{name}", value]


def _drafted(folder: Path, options: DraftOptions) -> Draft:
    draft = draft_recording(folder, folder / RECORDING_FILE, options)
    draft.write()
    return draft


def _written(path: Path, diagnosis: examination.Diagnosis) -> examination.Diagnosis:
    write_json(path, diagnosis.to_dict())
    return diagnosis


def _tracked(folder: Path, path: Path, settings: Mapping[str, Any], progress: bool | Report) -> str:
    """Track a recording and write the tracks; returns what `psotrack track` prints."""
    began = time.perf_counter()
    recording = read_recording(folder)
    if not recording.detections:
        settings = {"detections": BLOBS, **settings}
    tracked = track(recording, settings, progress=progress)
    record = with_real_time(tracked.record, time.perf_counter() - began)
    # A record without tracks was left by a run that was killed.
    flights.write_tracked(path, replace(tracked, record=record), folder, force=True)
    found = tracked.trajectories
    return f"{path}: {found.num_drones} drones, {found.num_frames} frames, {found.seen.mean():.1%} seen"


def detect_markers(
    image: UInt8[np.ndarray, "height width"] | UInt8[np.ndarray, "height width 3"],
    dictionary: str = "4x4_1000",
) -> DetectedMarkers:
    """ArUco markers in an image, black on white or inverted, with corners to a tenth of a pixel.

    The search is thorough: it takes seconds in images of tens of megapixels.

    Args:
        image: grey, or BGR as OpenCV reads it.
        dictionary: name of the markers' dictionary.

    Raises:
        SettingsError: there is no dictionary of this name.
    """
    import cv2

    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return MarkerDetector(dictionary, thorough=True).detect(np.asarray(grey, np.uint8))


def background_model(settings: ForegroundSettings | None = None) -> Living:
    """The default background model, which goes on learning, with given or default settings."""
    return Living(ForegroundSettings() if settings is None else settings)
