"""What is in the images of the cameras: frames, silhouettes, boxes, ellipses, blobs, detections and markers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Int

from psotrack.geometry.rotations import rotation_matrices
from psotrack.recordings import OnboardVideo, Recording, read_detections
from psotrack.show.flights import FlightTracks, TrackedFlight, ellipse_outlines_px, view_in_images
from psotrack.show.viewer.camera_images import CameraKey, EncodedImages, split_images
from psotrack.show.viewer.entity_log import EntityLog, Instants, camera_path, instants, shown_rgb, tracks_path
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
    recording = flight.recording
    if recording is None:
        return
    for tracks in flight.tracks:
        _log_tracks(log, recording, tracks, step)
    timeline = recording.timeline()
    for index, name in enumerate(recording.rig.names):
        if name in (recording.detections or {}):
            assert recording.detections is not None
            detections = read_detections(recording.detections[name])
            rows = _rows_shown(timeline.frame[:, index], step)
            boxes_px = [detections.in_frame(int(frame)).xyxy for frame in timeline.frame[rows, index]]
            path = f"{camera_path(CameraKey(name))}/detections"
            _log_boxes(log, path, Instants(rows, timeline.time_s[rows]), boxes_px, _DETECTION_RGB)


def log_images(
    log: EntityLog,
    recording: Recording,
    camera: CameraKey,
    images: EncodedImages,
    pixels: tuple[int, int],
) -> None:
    """Log the images of a camera: of the rig with silhouettes and blobs, on a drone with its path and markers.

    Args:
        log: receives the values.
        recording: the recording.
        camera: the camera.
        images: its images.
        pixels: pixels of the video per pixel of the images, and per pixel of the silhouettes, along each side.
    """
    path = camera_path(camera)
    for kind, reduction in zip(("image", "silhouettes"), pixels, strict=True):
        if kind == "image" or images.blobs_px:
            log.static(f"{path}/{kind}", rr.Transform3D(scale=[reduction, reduction, 1]))
    if camera.on_drone:
        assert recording.onboard is not None
        video = recording.onboard[camera.name]
        _log_path(log, path, video)
        chosen, at = np.arange(len(images.frame)), Instants(images.frame, images.frame / video.video.fps)
    else:
        timeline = recording.timeline()
        shown = timeline.frame[:, timeline.cameras.index(camera.name)]
        frame = np.flatnonzero(_is_new(shown) & np.isin(shown, images.frame))
        chosen, at = np.searchsorted(images.frame, shown[frame]), Instants(frame, timeline.time_s[frame])
    for first in range(0, len(chosen), _TOGETHER):
        rows = slice(first, first + _TOGETHER)
        jpegs, pngs = zip(*split_images(images, chosen[rows].tolist()), strict=True)
        own = Instants(at.frame[rows], at.time_s[rows])
        _log_encoded(log, f"{path}/image", own, jpegs, "image/jpeg", 0.0)
        if images.blobs_px:
            _log_encoded(log, f"{path}/silhouettes", own, pngs, "image/png", 1.0)
    if images.blobs_px:
        _log_boxes(log, f"{path}/blobs", at, [images.blobs_px[index] for index in chosen], _BLOB_RGB)
    if images.markers:
        # Pixel centres are at whole numbers, in Rerun half a pixel further.
        corners_px = (
            np.concatenate([corners_px for _, corners_px in images.markers])[:, [0, 1, 2, 3, 0]] + 0.5
        )
        labels = [f"{marker}" for ids, _ in images.markers for marker in ids.tolist()]
        counts = np.array([len(ids) for ids, _ in images.markers], int)
        log.lines(f"{path}/markers", at, counts, corners_px, MARKER_RGB, labels)


def _log_boxes(
    log: EntityLog, path: str, at: Instants, boxes_px: Sequence[np.ndarray], rgb: tuple[int, int, int]
) -> None:
    """Log the boxes of each row, without names."""
    counts = np.array([len(each) for each in boxes_px], int)
    log.boxes(path, at, counts, np.concatenate([np.zeros((0, 4)), *boxes_px]), rgb)


def _log_encoded(
    log: EntityLog, path: str, at: Instants, blobs: Sequence[bytes], kind: str, order: float
) -> None:
    """Log encoded images; those of a higher order are in front."""
    count = len(blobs)

    def columns(_: slice) -> Any:
        return rr.EncodedImage.columns(
            blob=list(blobs), media_type=[kind] * count, draw_order=[order] * count
        )

    log.rows(path, at, columns)


def _log_path(log: EntityLog, path: str, onboard: OnboardVideo) -> None:
    """Log the poses of a camera on a drone, and its lens."""
    count = min(len(onboard.position_m), onboard.video.num_frames)
    position_m, orientation_wxyz = onboard.position_m[:count], onboard.orientation_wxyz[:count]
    known = np.isfinite(position_m).all(axis=1) & np.isfinite(orientation_wxyz).all(axis=1)
    frame, position_m = np.flatnonzero(known), position_m[known]
    rotation = rotation_matrices(orientation_wxyz[known])
    log.rows(
        path,
        Instants(frame, frame / onboard.video.fps),
        lambda rows: rr.Transform3D.columns(translation=position_m[rows], mat3x3=rotation[rows]),
    )
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
        counts = there.sum(axis=1)
        log.boxes(tracks_path(f"{path}/boxes", tracks), at, counts, boxes_px[there], rgb[rows][there], labels)
        middle_px, shape_px2 = views.middle_px[rows, :, index], views.shape_px2[rows, :, index]
        there = np.isfinite(middle_px).all(axis=-1) & np.isfinite(shape_px2).all(axis=(-2, -1))
        # Pixel centres are at whole numbers, in Rerun half a pixel further.
        outlines_px = ellipse_outlines_px(middle_px[there] + 0.5, shape_px2[there])
        counts = there.sum(axis=1)
        if tracks.trajectories.covariance_m2 is not None:
            log.lines(tracks_path(f"{path}/ellipses", tracks), at, counts, outlines_px, rgb[rows][there])


def _is_new(frame: Int[np.ndarray, " instants"]) -> np.ndarray:
    """(instants,), whether a camera shows another frame than at the instant before."""
    return (frame >= 0) & (np.diff(frame, prepend=-1) != 0)


def _rows_shown(frame: Int[np.ndarray, " instants"], step: int) -> Int[np.ndarray, " rows"]:
    """Instants at which a camera shows a new frame whose number is a multiple of `step`."""
    return np.flatnonzero(_is_new(frame) & (frame % step == 0))
