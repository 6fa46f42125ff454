"""What is in the images of the cameras: frames, silhouettes, boxes, ellipses, blobs, detections and markers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from jaxtyping import Float, Int

from psotrack.geometry.rotations import rotation_matrices
from psotrack.recordings import OnboardVideo, read_detections
from psotrack.show.flights import (
    FlightTracks,
    TrackedFlight,
    boxes_in_images,
    ellipse_outlines_px,
    ellipses_in_images,
    shown_frames,
    status_colours,
    statuses,
)
from psotrack.show.viewer.camera_images import CameraKey, EncodedImages, split_images
from psotrack.show.viewer.entity_log import EntityLog, camera_path, drone_label, shown_rgb, tracks_path
from psotrack.show.viewer.space import MARKER_RGB, pinhole

_DETECTION_RGB = (255, 214, 10)
_BLOB_RGB = (120, 255, 190)
#: Images that are sent together.
_TOGETHER = 25
#: Distance of the images from the cameras on drones, metres.
_ONBOARD_DISTANCE_M = 0.4


def log_marks(log: EntityLog, flight: TrackedFlight, step: int) -> None:
    """Log the drones' boxes and ellipses, and the detections, in the images of the rig's cameras.

    Args:
        log: receives the values.
        flight: the flight.
        step: each frame whose number is a multiple of it is shown.
    """
    for number, tracks in enumerate(flight.tracks):
        colours = [shown_rgb(colour) for colour in flight.colours(number)]
        _log_boxes(log, flight, tracks, colours, step)
    recording = flight.recording
    if recording is None or recording.detections is None:
        return
    timeline = recording.timeline()
    for index, name in enumerate(recording.rig.names):
        if name in recording.detections:
            detections = read_detections(recording.detections[name])
            rows = _rows_shown(timeline.frame[:, index], step)
            of_rows = [detections.in_frame(int(frame)).xyxy for frame in timeline.frame[rows, index]]
            path = f"{camera_path(CameraKey(name))}/detections"
            log.boxes(path, rows, timeline.time_s[rows], of_rows, _DETECTION_RGB)


def log_images(
    log: EntityLog,
    flight: TrackedFlight,
    camera: CameraKey,
    images: EncodedImages,
    pixels: tuple[int, int],
) -> None:
    """Log the images of a camera: of the rig with silhouettes and blobs, on a drone with its path and markers.

    Args:
        log: receives the values.
        flight: the flight.
        camera: the camera.
        images: its images.
        pixels: pixels of the video per pixel of the images, and per pixel of the silhouettes, along each side.
    """
    assert flight.recording is not None
    path = camera_path(camera)
    for kind, reduction in zip(("image", "silhouettes"), pixels, strict=True):
        if kind == "image" or images.blobs_px:
            log.static(f"{path}/{kind}", rr.Transform3D(scale=[reduction, reduction, 1]))
    if camera.on_drone:
        assert flight.recording.onboard is not None
        video = flight.recording.onboard[camera.name]
        _log_path(log, path, video)
        chosen = np.arange(len(images.frame))
        frame, time_s = images.frame, images.frame / video.video.fps
    else:
        timeline = flight.recording.timeline()
        shown = timeline.frame[:, timeline.cameras.index(camera.name)]
        frame = np.flatnonzero(_is_new(shown) & np.isin(shown, images.frame))
        chosen, time_s = np.searchsorted(images.frame, shown[frame]), timeline.time_s[frame]
    for first in range(0, len(chosen), _TOGETHER):
        rows = slice(first, first + _TOGETHER)
        jpegs, pngs = zip(*split_images(images, chosen[rows].tolist()), strict=True)
        _log_encoded(log, f"{path}/image", frame[rows], time_s[rows], jpegs)
        if images.blobs_px:
            _log_encoded(log, f"{path}/silhouettes", frame[rows], time_s[rows], pngs)
    if images.blobs_px:
        log.boxes(f"{path}/blobs", frame, time_s, [images.blobs_px[index] for index in chosen], _BLOB_RGB)
    if images.markers:
        # Pixel centres are at whole numbers, in Rerun half a pixel further.
        outlines_px = [corners_px[:, [0, 1, 2, 3, 0]] + 0.5 for _, corners_px in images.markers]
        labels = [f"{marker}" for ids, _ in images.markers for marker in ids.tolist()]
        log.lines(f"{path}/markers", frame, time_s, outlines_px, MARKER_RGB, labels)


def _log_encoded(
    log: EntityLog,
    path: str,
    frame: Int[np.ndarray, " rows"],
    time_s: Float[np.ndarray, " rows"],
    blobs: Sequence[bytes],
) -> None:
    kinds = ["image/png" if blob.startswith(b"\x89PNG") else "image/jpeg" for blob in blobs]
    # PNG images are silhouettes, in front of the JPEG images.
    orders = [float(kind == "image/png") for kind in kinds]
    log.rows(
        path,
        frame,
        time_s,
        lambda _: rr.EncodedImage.columns(blob=list(blobs), media_type=kinds, draw_order=orders),
    )


def _log_path(log: EntityLog, path: str, onboard: OnboardVideo) -> None:
    """Log the poses of a camera on a drone, and its lens."""
    count = min(len(onboard.position_m), onboard.video.num_frames)
    position_m, orientation_wxyz = onboard.position_m[:count], onboard.orientation_wxyz[:count]
    known = np.isfinite(position_m).all(axis=1) & np.isfinite(orientation_wxyz).all(axis=1)
    frame, position_m = np.flatnonzero(known), position_m[known]
    rotation = rotation_matrices(orientation_wxyz[known])
    log.rows(
        path,
        frame,
        frame / onboard.video.fps,
        lambda rows: rr.Transform3D.columns(translation=position_m[rows], mat3x3=rotation[rows]),
    )
    if onboard.K is not None:
        log.static(path, pinhole(onboard.K, np.array(onboard.video.image_size_wh), _ONBOARD_DISTANCE_M))


def _log_boxes(
    log: EntityLog,
    flight: TrackedFlight,
    tracks: FlightTracks,
    colours: Sequence[tuple[int, int, int]],
    step: int,
) -> None:
    recording, trajectories = flight.recording, tracks.trajectories
    if recording is None:
        return
    shown = shown_frames(recording, trajectories)
    boxes_px = boxes_in_images(recording, trajectories, tracks.size_m)
    ellipses = ellipses_in_images(recording, trajectories)
    status = statuses(trajectories)
    rgb = np.stack([status_colours(status[:, drone], colour) for drone, colour in enumerate(colours)], axis=1)
    labels = [drone_label(flight, tracks, name) for name in trajectories.drones]
    for index, name in enumerate(recording.rig.names):
        rows = _rows_shown(shown.frame[:, index], step)
        at = (trajectories.frame[rows], trajectories.time_s[rows])
        path = camera_path(CameraKey(name))
        there = np.isfinite(boxes_px[rows, :, index]).all(axis=-1)
        log.boxes(
            tracks_path(f"{path}/boxes", flight, tracks),
            *at,
            [boxes[seen] for boxes, seen in zip(boxes_px[rows, :, index], there, strict=True)],
            rgb[rows][there],
            [labels[drone] for drone in np.nonzero(there)[1]],
        )
        if ellipses is None:
            continue
        middle_px, shape_px2 = ellipses.middle_px[rows, :, index], ellipses.shape_px2[rows, :, index]
        there = np.isfinite(middle_px).all(axis=-1) & np.isfinite(shape_px2).all(axis=(-2, -1))
        log.lines(
            tracks_path(f"{path}/ellipses", flight, tracks),
            *at,
            # Pixel centres are at whole numbers, in Rerun half a pixel further.
            [
                ellipse_outlines_px(middle[seen] + 0.5, shape[seen])
                for middle, shape, seen in zip(middle_px, shape_px2, there, strict=True)
            ],
            rgb[rows][there],
        )


def _is_new(frame: Int[np.ndarray, " instants"]) -> np.ndarray:
    """(instants,), whether a camera shows another frame than at the instant before."""
    return (frame >= 0) & (np.diff(frame, prepend=-1) != 0)


def _rows_shown(frame: Int[np.ndarray, " instants"], step: int) -> Int[np.ndarray, " rows"]:
    """Instants at which a camera shows a new frame whose number is a multiple of `step`."""
    return np.flatnonzero(_is_new(frame) & (frame % step == 0))
