"""A flight as a file of Rerun, .rrd, and the arrangement of views: space, cameras, plots and events."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from psotrack.errors import OutputError
from psotrack.foreground.silhouettes import Silhouettes
from psotrack.recordings import Recording, VideoInfo
from psotrack.show.flights import QUANTITIES, TrackedFlight
from psotrack.show.viewer.camera_images import CameraKey, ImagePlan, ImageSource, plan_images
from psotrack.show.viewer.entities import (
    FRAME,
    TIME,
    EntityLog,
    camera_path,
    drone_path,
    log_flight,
    log_plots,
    log_world,
)
from psotrack.show.viewer.image_marks import log_images, log_marks
from psotrack.support import Report, atomic_write, no_progress

#: Time for which a drone's trail is shown, seconds.
_TRAIL_S = 3.0
_STATES = rrb.StateTimelineView(origin="/status", name="status")


def blueprint_of(flight: TrackedFlight, *, has_images: bool, has_onboard: bool = False) -> rrb.Blueprint:
    """The arrangement for a flight.

    Args:
        flight: the flight.
        has_images: whether the cameras have images.
        has_onboard: whether the cameras on drones are shown.
    """
    left: list[rrb.View | rrb.Container] = [_space_view(flight)]
    right: list[rrb.View | rrb.Container] = []
    if flight.recording is not None and (has_images or flight.tracks):
        right.append(_cameras(flight.recording, has_onboard))
    if flight.tracks:
        plots = [_plot(key) for key in QUANTITIES if flight.truth is not None or key != "error_mm"]
        left.append(rrb.Horizontal(rrb.Tabs(*plots, active_tab=0), _STATES, column_shares=[3, 2]))
        columns = rrb.TextLogColumns(timeline_columns=[TIME, FRAME], text_log_columns=["loglevel", "body"])
        name = "events: a click on a time jumps there"
        right.append(rrb.TextLogView(origin="/events", name=name, columns=columns))
    halves = [rrb.Vertical(*views, row_shares=[5, 2][: len(views)]) for views in (left, right) if views]
    return _arranged(halves, [5.0, 4.0], loop_mode="all")


def live_blueprint() -> rrb.Blueprint:
    """The arrangement for tracks that come while cameras film."""
    delay = rrb.TimeSeriesView(origin="/plots/delay_ms", name="delay (ms)")
    space = rrb.Spatial3DView(origin="/world", name="space")
    return _arranged(
        [space, rrb.Vertical(_plot("deviation_mm"), delay, _STATES)], [2.0, 1.0], play_state="following"
    )


def _arranged(
    columns: Sequence[rrb.View | rrb.Container], shares: list[float], **playing: Any
) -> rrb.Blueprint:
    return rrb.Blueprint(
        rrb.Horizontal(*columns, column_shares=shares[: len(columns)]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIME, **playing),
        collapse_panels=False,
        auto_layout=False,
        auto_views=False,
    )


def _space_view(flight: TrackedFlight) -> rrb.Spatial3DView:
    last = rr.VisibleTimeRange(
        TIME,
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-_TRAIL_S),
        end=rr.TimeRangeBoundary.cursor_relative(),
    )
    trails: dict[Any, Any] = {
        f"{drone_path('world/drones', tracks, drone)}/trail": rrb.VisibleTimeRanges([last])
        for tracks in flight.tracks
        for drone in tracks.trajectories.drones
    }
    # Marks in the images would hide the drones in space.
    marks = ("boxes", "ellipses", "blobs", "detections", "silhouettes")
    return rrb.Spatial3DView(
        origin="/world",
        contents=["$origin/**", *(f"- $origin/cameras/*/{mark}/**" for mark in marks)],
        name="space",
        overrides=trails,
        eye_controls=_eye(flight),
        line_grid=rrb.LineGrid3D(visible=True, spacing=1.0),
    )


def _eye(flight: TrackedFlight) -> rrb.EyeControls3D | None:
    """A look from a corner above, so that all cameras and drones are in view."""
    bounds_m = flight.bounds_m
    if bounds_m is None:
        return None
    low, high = bounds_m
    reach_m = max(float(np.linalg.norm(high - low)), 1.0)
    target_m = low + (high - low) * [0.5, 0.5, 0.3]
    position_m = target_m + reach_m * np.array([-0.33, -0.52, 0.4])
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital, position=position_m, look_target=target_m, eye_up=(0, 0, 1)
    )


def _plot(quantity: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=f"/plots/{quantity}",
        name=QUANTITIES[quantity][0],
        axis_y=rrb.ScalarAxis(range=(0.0, 1.0)) if quantity == "score" else None,
        plot_legend=rrb.PlotLegend(visible=True),
    )


def _cameras(recording: Recording, has_onboard: bool) -> rrb.Container:
    def grid(names: Iterable[str], on_drone: bool, title: str) -> rrb.Container:
        keys = [CameraKey(name, on_drone) for name in names]
        views = [rrb.Spatial2DView(origin=f"/{camera_path(key)}", name=key.name) for key in keys]
        columns = 2 if len(keys) <= 8 else int(np.ceil(np.sqrt(len(keys))))
        return rrb.Grid(*views, grid_columns=columns, name=title)

    of_rig = grid(recording.rig.names, False, "cameras")
    if not has_onboard:
        return of_rig
    return rrb.Tabs(of_rig, grid(recording.onboard, True, "cameras on drones"), active_tab=0)


#: Largest size by default: this number of bytes per second of the recording, up to the second number.
_BYTES_PER_S, _MOST_BYTES = 5.8e6, 1.95e9
#: Fraction of the rest of the size that images take, and bytes of the list of contents at the end of the file.
_IMAGES_SHARE, _CONTENTS_BYTES = 0.96, 250e3
#: End of a complete file.
_END = b"RRF2FOOT\x01\x00\x00\x00"
#: Name of the program in Rerun; arrangements that a user changes are kept under it.
APPLICATION = "psotrack"


@dataclass(frozen=True)
class WrittenFlight:
    """What was written.

    Attributes:
        path: the file.
        num_bytes: size of the file.
        plan: how the images were reduced.
        has_silhouettes: whether silhouettes are shown.
    """

    path: Path
    num_bytes: int
    plan: ImagePlan
    has_silhouettes: bool

    def __str__(self) -> str:
        parts = [f"{self.path}: {self.num_bytes / 1e6:.1f} MB"]
        if self.plan.num_images:
            smallest = max(self.plan.reduction.values())
            frames = "every frame" if self.plan.step == 1 else f"1 frame in {self.plan.step}"
            size = "full size" if smallest == 1 else f"1/{smallest} of the width and height"
            parts.append(f"{self.plan.num_images} images ({frames}, {size})")
            if not self.has_silhouettes:
                parts.append("no silhouettes are stored; --silhouettes computes them")
        else:
            parts.append("without images; the recording with its videos shows the cameras, too")
        return ", ".join(parts)


@dataclass(frozen=True)
class ViewContent:
    """What is shown of a flight.

    Attributes:
        silhouettes: the silhouettes of the recording by frames; None: they are not shown.
        onboard: whether the cameras on drones are shown, with the markers that they see.
        dictionary: dictionary of the markers.
        max_bytes: largest size of the file; None: 5.8 MB per second of the recording, at most 1.95 GB.
    """

    silhouettes: Silhouettes | None = None
    onboard: bool = False
    dictionary: str = "4x4_1000"
    max_bytes: float | None = None


def write_flight(
    path: Path,
    flight: TrackedFlight,
    content: ViewContent = ViewContent(),
    *,
    jobs: int | None = None,
    report: Report = no_progress,
) -> WrittenFlight:
    """Write a flight as a file of Rerun, which appears under its name when it is complete.

    Images are made as small, and as many frames are left out, as `max_bytes` demands.

    Args:
        path: the file; an existing file is replaced.
        flight: the flight.
        content: what is shown.
        jobs: largest number of processes; None is one per processor.
        report: progress of the images.

    Raises:
        InputError: a video cannot be read.
        OutputError: the file cannot be written completely.
    """
    with atomic_write(path) as temporary:
        try:
            plan = _write(temporary, flight, content, jobs or os.cpu_count() or 1, report)
        except RuntimeError as error:
            expected, found = "to write the whole file", "that Rerun could not"
            raise OutputError(path, expected=expected, found=found, remedy="is the disk full?") from error
        num_bytes = temporary.stat().st_size
    return WrittenFlight(path, num_bytes, plan, content.silhouettes is not None)


def _write(path: Path, flight: TrackedFlight, content: ViewContent, jobs: int, report: Report) -> ImagePlan:
    """Write the file; raises `RuntimeError` where Rerun cannot."""
    stream = rr.RecordingStream(APPLICATION, recording_id=flight.name, send_properties=False)
    stream.save(path)
    try:
        stream.send_recording_name(flight.name)
        videos = _videos(flight, content.onboard)
        log = EntityLog(stream)
        stream.send_blueprint(blueprint_of(flight, has_images=bool(videos), has_onboard=content.onboard))
        log_world(log, flight)
        log_flight(log, flight)
        log_plots(log, flight)
        stream.flush()
        most = _max_bytes(flight, content)
        plan = plan_images(videos, _left_bytes(path, most))
        log_marks(log, flight, plan.step)
        stream.flush()
        sources = _sources(content, videos, plan, _left_bytes(path, most))
        if flight.recording is not None:
            _log_all_images(log, flight.recording, sources, plan.num_images, jobs, report)
    finally:
        stream.disconnect()
    with path.open("rb") as file:
        file.seek(-min(len(_END), path.stat().st_size), os.SEEK_END)
        if file.read() != _END:
            raise RuntimeError("the end is missing")
    return plan


def _left_bytes(path: Path, max_bytes: float) -> float:
    """Bytes that are left for images."""
    return max(0.0, _IMAGES_SHARE * (max_bytes - path.stat().st_size - _CONTENTS_BYTES))


def _max_bytes(flight: TrackedFlight, content: ViewContent) -> float:
    if content.max_bytes is not None:
        return content.max_bytes
    if flight.recording is None or not flight.recording.num_frames:
        return _MOST_BYTES
    return min(_MOST_BYTES, _BYTES_PER_S * max(1.0, flight.recording.num_frames / flight.recording.fps))


def _videos(flight: TrackedFlight, with_onboard: bool) -> dict[CameraKey, VideoInfo]:
    """The videos that are shown."""
    recording = flight.recording
    if recording is None:
        return {}
    videos = {CameraKey(each.name): each.video for each in recording.placed if each.video is not None}
    onboard = recording.onboard if with_onboard else {}
    return videos | {CameraKey(name, on_drone=True): camera.video for name, camera in onboard.items()}


def _sources(
    content: ViewContent, videos: Mapping[CameraKey, VideoInfo], plan: ImagePlan, max_bytes: float
) -> dict[CameraKey, ImageSource]:
    silhouettes = content.silhouettes
    arrays = {} if silhouettes is None else dict(zip(silhouettes.cameras, silhouettes.arrays, strict=True))
    return {
        camera: ImageSource(
            video=video,
            step=plan.step,
            reduction=plan.reduction[camera],
            bytes_per_image=max_bytes / max(plan.num_images, 1),
            silhouettes=None if camera.on_drone else arrays.get(camera.name),
            cell_px=1 if silhouettes is None else silhouettes.reduction,
            dictionary=content.dictionary if camera.on_drone else None,
        )
        for camera, video in videos.items()
    }


def _log_all_images(
    log: EntityLog,
    recording: Recording,
    sources: Mapping[CameraKey, ImageSource],
    num_images: int,
    jobs: int,
    report: Report,
) -> None:
    """Log the images of all cameras, several cameras at the same time: OpenCV decodes and encodes in threads."""
    stop = threading.Event()
    with report("images", num_images) as advance, ThreadPoolExecutor(jobs) as threads:

        def log_one(camera: CameraKey) -> None:
            def goes_on(steps: int) -> None:
                if stop.is_set():
                    raise InterruptedError
                advance(steps)

            log_images(log, recording, camera, sources[camera], goes_on)

        try:
            list(threads.map(log_one, sources))
        except BaseException:
            # The other threads end with their next image.
            stop.set()
            raise
