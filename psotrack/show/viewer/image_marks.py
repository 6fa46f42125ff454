"""What is in the images of the cameras: frames, silhouettes, boxes, ellipses, blobs, detections and markers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Int

from psotrack.geometry import rotation_matrices
from psotrack.recordings import OnboardVideo, Recording, ellipse_outlines_px, read_detections, view_in_images
from psotrack.show.flights import FlightTracks, TrackedFlight
from psotrack.show.viewer.camera_images import CameraKey, EncodedImage, ImageSource, encode_images
from psotrack.show.viewer.entities import (
    MARKER_RGB,
    EntityLog,
    Instants,
    camera_path,
    instants,
    pinhole,
    shown_rgb,
    tracks_path,
)
from psotrack.support import Advance

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
    recording = flight.recording
    if recording is None:
        return
    for tracks in flight.tracks:
        _log_tracks(log, recording, tracks, step)
    timeline = recording.timeline()
    for index, name in enumerate(recording.rig.names):
        if name in recording.detections:
            detections = read_detections(recording.detections[name])
            rows = _rows_shown(timeline.frame[:, index], step)
            boxes_px = [detections.in_frame(int(frame)).xyxy for frame in timeline.frame[rows, index]]
            path = f"{camera_path(CameraKey(name))}/detections"
            _log_boxes(log, path, Instants(rows, timeline.time_s[rows]), boxes_px, _DETECTION_RGB)


def log_images(
    log: EntityLog, recording: Recording, camera: CameraKey, source: ImageSource, advance: Advance
) -> None:
    """Log the images of a camera: of the rig with silhouettes and blobs, on a drone with its path and markers.

    Args:
        log: receives the values.
        recording: the recording.
        camera: the camera.
        source: its images.
        advance: receives the number of images.

    Raises:
        InputError: the video ends early.
    """
    path, instant, shown = camera_path(camera), _shown_at(recording, camera, source.step), []
    kinds = [("image", source.reduction), ("silhouettes", source.cell_px)]
    for kind, reduction in kinds if source.silhouettes is not None else kinds[:1]:
        log.static(f"{path}/{kind}", rr.Transform3D(scale=[reduction, reduction, 1]))
    if camera.on_drone:
        _log_path(log, path, recording.onboard[camera.name])
    together: list[EncodedImage] = []
    for image in encode_images(source):
        if image.frame in instant:
            together.append(image)
            shown.append(replace(image, jpeg=b"", silhouette=b""))
        if len(together) == _TOGETHER:
            _log_encoded(log, path, together, instant)
            together = []
        advance(1)
    _log_encoded(log, path, together, instant)
    at = _instants(shown, instant)
    if source.silhouettes is not None:
        _log_boxes(log, f"{path}/blobs", at, [image.blobs_px for image in shown], _BLOB_RGB)
    if source.dictionary is not None:
        counts = np.array([len(image.marker_ids) for image in shown], int)
        corners_px = np.concatenate([np.zeros((0, 4, 2)), *(image.marker_corners_px for image in shown)])
        labels = [f"{marker}" for image in shown for marker in image.marker_ids.tolist()]
        # Pixel centres are at whole numbers, in Rerun half a pixel further.
        outlines_px = corners_px[:, [0, 1, 2, 3, 0]] + 0.5
        strips = {"strips": list(outlines_px), "labels": labels}
        log.marks(f"{path}/markers", at, rr.LineStrips2D, counts, MARKER_RGB, 1.0, **strips)


def _shown_at(recording: Recording, camera: CameraKey, step: int) -> dict[int, tuple[int, float]]:
    """Number and time of the instant at which each frame of a camera is shown first."""
    if camera.on_drone:
        video = recording.onboard[camera.name].video
        return {frame: (frame, frame / video.fps) for frame in range(0, video.num_frames, step)}
    timeline = recording.timeline()
    frame = timeline.frame[:, timeline.cameras.index(camera.name)]
    rows = _rows_shown(frame, step)
    return {int(frame[row]): (int(row), float(timeline.time_s[row])) for row in rows}


def _instants(images: Sequence[EncodedImage], instant: Mapping[int, tuple[int, float]]) -> Instants:
    at = np.array([instant[image.frame] for image in images], float).reshape(-1, 2)
    return Instants(at[:, 0].astype(int), at[:, 1])


def _log_encoded(
    log: EntityLog, path: str, images: Sequence[EncodedImage], instant: Mapping[int, tuple[int, float]]
) -> None:
    """Log some images together, and their silhouettes, which are in front."""
    at = _instants(images, instant)
    kinds = [("image", "image/jpeg", 0.0, [each.jpeg for each in images])]
    kinds += [("silhouettes", "image/png", 1.0, [each.silhouette for each in images])]
    for name, kind, order, blobs in kinds:
        if any(blobs):
            types, orders = [kind] * len(blobs), [order] * len(blobs)
            log.rows(f"{path}/{name}", at, rr.EncodedImage, blob=blobs, media_type=types, draw_order=orders)


def _log_boxes(
    log: EntityLog,
    path: str,
    at: Instants,
    boxes_px: Sequence[np.ndarray],
    rgb: Any,
    labels: list[str] | None = None,
) -> None:
    """Log the boxes of each row; those without names have thin lines."""
    counts = np.array([len(each) for each in boxes_px], int)
    low_px, high_px = np.split(np.concatenate([np.zeros((0, 4)), *boxes_px]), 2, axis=1)
    boxes = {"centers": (high_px + low_px) / 2, "half_sizes": (high_px - low_px) / 2, "labels": labels}
    log.marks(path, at, rr.Boxes2D, counts, rgb, 0.75 if labels is None else 1.5, **boxes)


def _log_path(log: EntityLog, path: str, onboard: OnboardVideo) -> None:
    """Log the poses of a camera on a drone, and its lens."""
    count = min(len(onboard.position_m), onboard.video.num_frames)
    position_m, orientation_wxyz = onboard.position_m[:count], onboard.orientation_wxyz[:count]
    known = np.isfinite(position_m).all(axis=1) & np.isfinite(orientation_wxyz).all(axis=1)
    frame, position_m = np.flatnonzero(known), position_m[known]
    rotation = rotation_matrices(orientation_wxyz[known])
    poses = {"translation": position_m, "mat3x3": rotation}
    log.rows(path, Instants(frame, frame / onboard.video.fps), rr.Transform3D, **poses)
    if onboard.K is not None:
        log.static(path, pinhole(onboard.K, np.array(onboard.video.image_size_wh), _ONBOARD_DISTANCE_M))


def _log_tracks(log: EntityLog, recording: Recording, tracks: FlightTracks, step: int) -> None:
    """Log the boxes and ellipses of the drones of one file."""
    views = view_in_images(recording, tracks.trajectories, tracks.size_m)
    rgb = shown_rgb(tracks)
    for index, name in enumerate(recording.rig.names):
        rows = _rows_shown(views.frame[:, index], step)
        at = Instants(*(part[rows] for part in instants(tracks)))
        path = camera_path(CameraKey(name))
        boxes_px = views.boxes_px[rows, :, index]
        there = np.isfinite(boxes_px).all(axis=-1)
        labels = [tracks.names[drone] for drone in np.nonzero(there)[1]]
        own = tracks_path(f"{path}/boxes", tracks)
        shown_px = [each_px[shown] for each_px, shown in zip(boxes_px, there, strict=True)]
        _log_boxes(log, own, at, shown_px, rgb[rows][there], labels)
        if tracks.trajectories.covariance_m2 is None:
            continue
        middle_px, shape_px2 = views.middle_px[rows, :, index], views.shape_px2[rows, :, index]
        there = np.isfinite(middle_px).all(axis=-1) & np.isfinite(shape_px2).all(axis=(-2, -1))
        # Pixel centres are at whole numbers, in Rerun half a pixel further.
        outlines_px = ellipse_outlines_px(middle_px[there] + 0.5, shape_px2[there])
        own = tracks_path(f"{path}/ellipses", tracks)
        counts, own_rgb = there.sum(axis=1), rgb[rows][there]
        log.marks(own, at, rr.LineStrips2D, counts, own_rgb, 1.0, strips=list(outlines_px))


def _rows_shown(frame: Int[np.ndarray, " instants"], step: int) -> Int[np.ndarray, " rows"]:
    """Instants at which a camera shows a new frame whose number is a multiple of `step`."""
    is_new = (frame >= 0) & (np.diff(frame, prepend=-1) != 0)
    return np.flatnonzero(is_new & (frame % step == 0))
