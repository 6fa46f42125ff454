"""Pictures of a flight at chosen moments: the part of a camera's frame in which an event happens."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.geometry import in_images, project_visible
from psotrack.recordings import Recording, read_frames_at, view_in_images
from psotrack.show.flights import Event, EventKind, FlightTracks
from psotrack.show.overlay import draw_drones, drawn_tracks, places_in
from psotrack.support import Report, processors

#: Kinds of events that are shown with a picture, in this order of importance.
_SHOWN = (
    EventKind.LOST,
    EventKind.SWITCH,
    EventKind.MET,
    EventKind.COASTING,
    EventKind.FOUND_AGAIN,
    EventKind.BEGINS,
    EventKind.LARGEST_ERROR,
)
#: Width and height of a picture, pixels.
_SIZE_WH = (360, 240)
#: Height of the part of the scene that a picture shows, in lengths of the largest drone, and the smallest part of an
#: image, pixels.
_LENGTHS, _LEAST_PX = 4.0, 60
_JPEG_QUALITY = 85


@dataclass(frozen=True, eq=False)
class Moment:
    """An event, and its picture.

    Attributes:
        event: the event.
        camera: the camera of the picture; empty without a picture.
        picture: JPEG as a data address; empty without a picture.
    """

    event: Event
    camera: str = ""
    picture: str = ""


def choose_events(events: Iterable[Event], most: int) -> list[Event]:
    """The events that matter most, at most a number of them, in the order of their times."""
    shown = [event for event in events if event.kind in _SHOWN]
    ranked = sorted(shown, key=lambda event: _SHOWN.index(event.kind))
    return sorted(ranked[:most], key=lambda event: event.time_s)


def take_pictures(
    events: Sequence[Event],
    tracks: FlightTracks,
    recording: Recording,
    *,
    jobs: int | None = None,
    report: Report,
) -> list[Moment]:
    """A picture of each event, from the camera that shows the place of the event largest.

    Args:
        events: events of these tracks.
        tracks: the tracks, which are drawn.
        recording: the recording; cameras without a video take no pictures.
        jobs: largest number of videos that are read at the same time; None is one per processor.
        report: shows the progress in pictures.

    Raises:
        InputError: a video cannot be read.
    """
    views, drawn = view_in_images(recording, tracks.trajectories, tracks.size_m), drawn_tracks(tracks)
    length_m, names = float(tracks.size_m.max(initial=0)), recording.rig.names
    rows = [int(np.searchsorted(tracks.trajectories.frame, event.frame)) for event in events]
    moments = [Moment(event) for event in events]
    by_camera: dict[int, dict[int, list[int]]] = {}
    for number, event in enumerate(events):
        per_m = _sizes_px_per_m(event.position_m, recording)
        per_m[views.frame[rows[number]] < 0] = 0.0
        camera = int(per_m.argmax())
        if per_m[camera] > 0:
            frame = int(views.frame[rows[number], camera])
            by_camera.setdefault(camera, {}).setdefault(frame, []).append(number)

    def take(camera: int) -> None:
        numbers = by_camera[camera]
        for frame, image in read_frames_at(recording.videos[names[camera]], sorted(numbers)):
            for number in numbers[frame]:
                at_m = events[number].position_m
                height_px = max(_LENGTHS * length_m * _sizes_px_per_m(at_m, recording)[camera], _LEAST_PX)
                middle_px = np.asarray(project_visible(recording.rig.cameras[camera], at_m)[0])
                part, scale, corner_px = _part(image, middle_px, height_px)
                draw_drones(part, drawn, places_in(views, camera), rows[number], scale, corner_px)
                moments[number] = Moment(events[number], names[camera], _address(part))
                advance(1)

    count = sum(len(numbers) for frames in by_camera.values() for numbers in frames.values())
    # OpenCV decodes videos in threads side by side.
    with report("pictures", count) as advance, ThreadPoolExecutor(jobs or processors()) as threads:
        list(threads.map(take, by_camera))
    return moments


def _sizes_px_per_m(position_m: Float[np.ndarray, "3"], recording: Recording) -> Float[np.ndarray, "cameras"]:
    """Number of pixels per metre at a place in each camera; 0 where it is not shown or the camera has no video."""
    cameras = recording.rig.cameras
    depth_m = np.asarray(project_visible(cameras, position_m)[1])
    films = np.array([each.video is not None for each in recording.placed])
    shown = np.asarray(in_images(cameras, position_m)) & films
    return np.where(shown, np.asarray(cameras.K)[:, 0, 0] / np.where(shown, depth_m, 1.0), 0.0)


def _part(
    image: UInt8[np.ndarray, "height width 3"], middle_px: Float[np.ndarray, "2"], height_px: float
) -> tuple[UInt8[np.ndarray, "rows columns 3"], float, tuple[float, float]]:
    """The part of a frame around a place, as far as possible inside the frame; its scale, and its corner, pixels."""
    scale = _SIZE_WH[1] / min(height_px, image.shape[0])
    size_px = np.array(_SIZE_WH) / scale
    margin_px = np.array(image.shape[1::-1]) - size_px
    wanted_px = np.clip(middle_px + 0.5 - size_px / 2, 0, np.maximum(margin_px, 0))
    left, top = np.where(margin_px < 0, margin_px / 2, wanted_px).tolist()
    # A pixel's centre is at a whole number for OpenCV, and half a pixel further for boxes.
    half = 0.5 * (scale - 1)
    to_part = np.array([[scale, 0, half - scale * left], [0, scale, half - scale * top]], np.float64)
    smooth = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    part = cv2.warpAffine(image, to_part, _SIZE_WH, flags=smooth, borderValue=(90, 90, 90))
    return np.asarray(part, np.uint8), scale, (left, top)


def _address(picture: UInt8[np.ndarray, "rows columns 3"]) -> str:
    done, coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    assert done, "JPEG takes every picture"
    return "data:image/jpeg;base64," + base64.b64encode(coded.tobytes()).decode("ascii")
