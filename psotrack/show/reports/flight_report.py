"""The report of a flight: a page with tables, plots and pictures, for a colleague without psotrack and the videos."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from markupsafe import Markup
from matplotlib import rc_context
from matplotlib.figure import Figure

from psotrack.evaluation import Evaluation, evaluate
from psotrack.geometry import in_images, project_visible
from psotrack.pipeline import changed_settings
from psotrack.recordings import Recording, read_frames_at, view_in_images
from psotrack.show import flights
from psotrack.show.overlay import draw_drones, drawn_tracks, places_in
from psotrack.show.reports.scene import (
    check_page_path,
    render,
    row_step,
    scene_data,
    shown_times_s,
    write_page,
)
from psotrack.support import FAINT, INK, LINE, STYLE, Report, html_table, no_progress, processors
from psotrack.trajectories import drones_html

#: Kinds of events that are shown with a picture, in this order of importance.
_SHOWN = (
    flights.EventKind.LOST,
    flights.EventKind.SWITCH,
    flights.EventKind.MET,
    flights.EventKind.COASTING,
    flights.EventKind.FOUND_AGAIN,
    flights.EventKind.BEGINS,
    flights.EventKind.LARGEST_ERROR,
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

    event: flights.Event
    camera: str = ""
    picture: str = ""


def choose_events(events: Iterable[flights.Event], most: int) -> list[flights.Event]:
    """The events that matter most, at most a number of them, in the order of their times."""
    shown = [event for event in events if event.kind in _SHOWN]
    ranked = sorted(shown, key=lambda event: _SHOWN.index(event.kind))
    return sorted(ranked[:most], key=lambda event: event.time_s)


def take_pictures(
    events: Sequence[flights.Event],
    tracks: flights.FlightTracks,
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


#: Colours of figures, and the colours of a page that replace them.
_OF_PAGE = {INK: "currentColor", FAINT: "var(--faint)", LINE: "var(--line)"}


@rc_context(STYLE)
def quantity_svg(quantity: flights.Quantity) -> Markup:
    """A plot of a quantity over time as an SVG element: a line per drone, and gaps where a value is not known.

    Matplotlib leaves out points that do not change how a line looks, so that long flights have small plots.
    """
    figure = Figure((9.5, 2.6), facecolor="none")
    axes = figure.add_subplot(xlabel="time (s)", ylabel=flights.QUANTITIES[quantity.key][0], facecolor="none")
    for name, colour, values in zip(quantity.names, quantity.colours, quantity.values.T, strict=True):
        axes.plot(quantity.time_s, values, color=colour, linewidth=1.2, label=name)
    axes.margins(x=0.01)
    if np.nan_to_num(quantity.values).min(initial=0) >= 0:
        axes.set_ylim(bottom=0)
    if len(quantity.names) > 1:
        figure.legend(loc="outside upper left", ncols=5, handlelength=1.4)
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    content = text.getvalue()
    content = content[content.index("<svg") :]
    for colour, of_page in _OF_PAGE.items():
        content = content.replace(colour, of_page)
    return Markup(content)


#: Largest number of events with a picture; a picture has about 20 kB.
MOST_PICTURES = 40
#: Columns of the table of cameras: the heading, where the values are, and how they are shown.
_CAMERAS = (
    ("camera", "camera", "{}"),
    ("frames there", "frames", "{:.0%}"),
    ("drones in view", "in_view", "{:.1%}"),
    ("width of a drone (px)", "width_px", "{:.0f}"),
    ("noise (px)", "noise_px", "{:.2f}"),
    ("detections near a track", "explained", "{:.0%}"),
    ("left out", "left_out", "{}"),
)


@dataclass(frozen=True)
class WrittenPage:
    """A page that was written; its text is what `psotrack report` prints.

    Attributes:
        path: the page.
    """

    path: Path

    def __str__(self) -> str:
        return f"{self.path}: {self.path.stat().st_size / 1e6:.1f} MB"


def write_flight_report(
    path: Path | str,
    flight: flights.TrackedFlight,
    *,
    pictures: bool = True,
    jobs: int | None = None,
    force: bool = False,
    report: Report = no_progress,
) -> WrittenPage:
    """Write the report of a flight.

    Args:
        path: file that ends in .html.
        flight: the flight; without tracks, the page shows the recording's cameras and reference.
        pictures: whether events are shown with a picture, where there are videos.
        jobs: largest number of videos that are read at the same time; None is one per processor.
        force: replace an existing file.
        report: shows the progress in pictures.

    Raises:
        InputError: a video cannot be read.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    check_page_path(path, force)
    time_s = shown_times_s(flight)
    step, span_s = row_step(len(time_s)), float(time_s[-1] - time_s[0])
    cameras = "" if flight.recording is None else f", {len(flight.recording.rig)} cameras"
    truth = "" if flight.truth is None else ", compared with a reference"
    text = render(
        "flight.html",
        scene_data(flight),
        title=flight.name,
        lead=f"{span_s:.1f} s, {len(time_s)} frames{cameras}{truth}",
        sections=[_section(flight, tracks, pictures, jobs, report) for tracks in flight.tracks],
        scene_note="" if step == 1 else f"The 3D view shows every {step}th frame.",
    )
    write_page(path, text, force=force)
    return WrittenPage(Path(path))


def _section(
    flight: flights.TrackedFlight,
    tracks: flights.FlightTracks,
    pictures: bool,
    jobs: int | None,
    report: Report,
) -> dict[str, Any]:
    """What the page shows of one file of tracks; None for a part of which there is nothing to show."""
    truth, recording, record = flight.truth, flight.recording, tracks.record
    evaluation = None
    if truth is not None and flight.errors(tracks) is not None:
        evaluation = evaluate(tracks.trajectories, truth)
    events = [event for event in flights.find_events(flight) if event.tracks == tracks.label]
    chosen = choose_events(events, MOST_PICTURES)
    moments = [Moment(event) for event in chosen]
    if pictures and recording is not None and recording.videos:
        moments = take_pictures(chosen, tracks, recording, jobs=jobs, report=report)
    cameras = None
    if recording is not None:
        quality = flights.camera_quality(tracks, recording).to_dict("records")
        rows = [[_shown(row[key], form) for _, key, form in _CAMERAS] for row in quality]
        cameras = Markup(html_table([heading for heading, _, _ in _CAMERAS], rows))
    return {
        "label": tracks.label,
        "figures": _figures(tracks, evaluation),
        "drones": Markup(drones_html(tracks.trajectories, tracks.size_m)),
        "cameras": cameras,
        "errors": None if evaluation is None else Markup(evaluation._repr_html_()),
        "charts": [
            (flights.QUANTITIES[each.key][1], quantity_svg(each))
            for each in flights.quantities(flight, tracks)
        ],
        "moments": moments,
        "more_events": len(events) - len(chosen),
        "run": None if record is None or not record.settings else _run(tracks.path.name, record, flight.name),
    }


def _shown(value: Any, form: str) -> str:
    return "-" if value is None or value != value else form.format(value)


def _figures(tracks: flights.FlightTracks, evaluation: Evaluation | None) -> list[tuple[str, str]]:
    """Large numbers, with a word each."""
    flown = tracks.trajectories
    shown = [(f"{flown.num_drones}", "drones"), (f"{flown.seen.mean():.1%}", "of all frames seen")]
    if evaluation is not None:
        found = evaluation.to_dict()
        shown += [
            (_shown(found["mean_error_m"] and 1e3 * found["mean_error_m"], "{:.1f} mm"), "mean error"),
            (f"{evaluation.missed_rate:.1%}", "missed"),
            (f"{evaluation.id_switches}", "identity switches"),
            (f"{evaluation.hota:.3f}", "HOTA"),
        ]
    factor = None if tracks.record is None else tracks.record.real_time_factor
    if factor:
        times, word = (factor, "faster") if factor >= 1 else (1 / factor, "slower")
        shown.append((f"{times:.2g} times", f"{word} than the video"))
    return shown


def _run(file: str, record: flights.RunRecord, name: str) -> dict[str, Any]:
    """Settings, versions and commands of a run, for the page."""
    lines = "".join(
        f"        {json.dumps(key)}: {value!r},\n" for key, value in changed_settings(record.whole).items()
    )
    settings = f", {{\n{lines}    }}" if lines else ""
    # Processes that make silhouettes import the script again: they must not run it again.
    again = (
        "import psotrack as pt\n\n"
        'if __name__ == "__main__":\n'
        f"    tracked = pt.track({json.dumps(record.recording or record.sequence or name)}{settings})\n"
        f"    pt.write_trajectories({json.dumps(file)}, tracked.trajectories)\n"
    )
    versions = record.versions | {f"device {key}": value for key, value in record.device.items()}
    return {"again": again, "versions": versions, "settings": json.dumps(record.settings, indent=2)}
