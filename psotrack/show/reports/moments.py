"""Pictures of a flight at chosen moments: the part of a camera's frame in which an event happens."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from psotrack.geometry import in_images, project_visible
from psotrack.recordings import Recording, VideoInfo, read_frames_at
from psotrack.show.flights import Event, EventKind, FlightTracks, boxes_in_images, shown_frames
from psotrack.support import Advance, Report, map_in_processes, processors

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


@dataclass(frozen=True)
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


@dataclass(frozen=True)
class _Picture:
    """A picture to be taken.

    Attributes:
        number: number of the event.
        frame: number of the camera's frame.
        middle_px: (2,), where the event is in the frame.
        height_px: height of the part of the frame that is shown, at most the frame's own.
        boxes_px: (drones, 4), boxes to draw; NaN for none.
        colours: a colour per drone, as #rrggbb.
        names: a name per drone.
    """

    number: int
    frame: int
    middle_px: Float[np.ndarray, "2"]
    height_px: float
    boxes_px: Float[np.ndarray, "drones 4"]
    colours: tuple[str, ...]
    names: tuple[str, ...]


@dataclass(frozen=True)
class _Task:
    video: VideoInfo
    pictures: tuple[_Picture, ...]


def choose_events(events: Sequence[Event], most: int) -> list[Event]:
    """The events that matter most, at most a number of them, in the order of their times."""
    shown = [event for event in events if event.kind in _SHOWN]
    ranked = sorted(shown, key=lambda event: _SHOWN.index(event.kind))
    return sorted(ranked[:most], key=lambda event: event.time_s)


def take_pictures(
    events: Sequence[Event],
    tracks: FlightTracks,
    colours: Sequence[str],
    recording: Recording,
    *,
    jobs: int | None = None,
    report: Report,
) -> list[Moment]:
    """A picture of each event, from the camera that shows the place of the event largest.

    Args:
        events: events of these tracks.
        tracks: the tracks, whose boxes are drawn.
        colours: a colour per drone, as #rrggbb.
        recording: the recording; cameras without a video take no pictures.
        jobs: largest number of processes; None is one per processor.
        report: shows the progress in pictures.

    Raises:
        InputError: a video cannot be read.
    """
    boxes_px = boxes_in_images(recording, tracks.trajectories, tracks.size_m)
    shown = shown_frames(recording, tracks.trajectories)
    length_m = float(tracks.size_m.max())
    by_camera: dict[int, list[_Picture]] = {}
    for number, event in enumerate(events):
        row = int(np.searchsorted(tracks.trajectories.frame, event.frame))
        if event.position_m is None:
            continue
        pixels, per_m = _views_of(np.array(event.position_m), recording)
        per_m[shown.frame[row] < 0] = 0.0
        camera = int(per_m.argmax())
        if per_m[camera] > 0:
            height_px = max(_LENGTHS * length_m * float(per_m[camera]), _LEAST_PX)
            by_camera.setdefault(camera, []).append(
                _Picture(
                    number,
                    int(shown.frame[row, camera]),
                    pixels[camera],
                    height_px,
                    boxes_px[row, :, camera],
                    tuple(colours),
                    tracks.trajectories.drones,
                )
            )
    moments = [Moment(event) for event in events]
    tasks = [
        _Task(
            recording.videos[recording.rig.names[camera]],
            tuple(sorted(pictures, key=lambda picture: picture.frame)),
        )
        for camera, pictures in by_camera.items()
    ]
    if not tasks:
        return moments
    with report("pictures", sum(len(task.pictures) for task in tasks)) as advance:
        taken = map_in_processes(_take, tasks, jobs=jobs or processors(), advance=advance)
    for camera, addresses in zip(by_camera, taken, strict=True):
        for number, address in addresses:
            moments[number] = Moment(events[number], recording.rig.names[camera], address)
    return moments


def _views_of(
    position_m: Float[np.ndarray, "3"], recording: Recording
) -> tuple[Float[np.ndarray, "cameras 2"], Float[np.ndarray, "cameras"]]:
    """Pixels of a place in each camera, and the number of pixels per metre there; 0 where it is not shown."""
    cameras = recording.rig.cameras
    pixels, depth_m = (np.asarray(part) for part in project_visible(cameras, position_m))
    films = np.array([name in recording.videos for name in recording.rig.names])
    shown = np.asarray(in_images(cameras, position_m)) & films
    focal_px = np.asarray(cameras.K)[:, 0, 0]
    return pixels, np.where(shown, focal_px / np.where(shown, depth_m, 1.0), 0.0)


def _take(task: _Task, advance: Advance) -> list[tuple[int, str]]:
    """Numbers of the events, and their pictures as data addresses."""
    by_frame: dict[int, list[_Picture]] = {}
    for picture in task.pictures:
        by_frame.setdefault(picture.frame, []).append(picture)
    taken = []
    for number, image in read_frames_at(task.video, list(by_frame)):
        for picture in by_frame[number]:
            taken.append((picture.number, _address(_part(image, picture))))
            advance(1)
    return taken


def _part(
    image: UInt8[np.ndarray, "height width 3"], picture: _Picture
) -> UInt8[np.ndarray, "rows columns 3"]:
    """The part of a frame around an event, as far as possible inside the frame, with boxes and names of the drones."""
    size_wh = np.array(image.shape[1::-1])
    scale = _SIZE_WH[1] / min(picture.height_px, image.shape[0])
    margin_px = size_wh - np.array(_SIZE_WH) / scale
    wanted = picture.middle_px + 0.5 - np.array(_SIZE_WH) / (2 * scale)
    corner = np.where(margin_px < 0, margin_px / 2, np.clip(wanted, 0, np.maximum(margin_px, 0)))
    # A pixel's centre is at a whole number for OpenCV, and half a pixel further for boxes.
    to_part = np.array([[scale, 0, 0], [0, scale, 0]], np.float64)
    to_part[:, 2] = -scale * corner + 0.5 * (scale - 1)
    smooth = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    part = cv2.warpAffine(image, to_part, _SIZE_WH, flags=smooth, borderValue=(90, 90, 90))
    for box_px, colour, name in zip(picture.boxes_px, picture.colours, picture.names, strict=True):
        if not np.isfinite(box_px).all():
            continue
        x0, y0, x1, y1 = (round(float(edge)) for edge in scale * (box_px - np.tile(corner, 2)))
        bgr = tuple(int(colour[place : place + 2], 16) for place in (5, 3, 1))
        cv2.rectangle(part, (x0, y0), (x1, y1), bgr, 2, cv2.LINE_AA)
        for thickness, ink in ((3, (255, 255, 255)), (1, bgr)):
            cv2.putText(part, name, (x0, y0 - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.45, ink, thickness, cv2.LINE_AA)
    return part


def _address(picture: UInt8[np.ndarray, "rows columns 3"]) -> str:
    done, coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    assert done, "JPEG takes every picture"
    return "data:image/jpeg;base64," + base64.b64encode(coded.tobytes()).decode("ascii")
