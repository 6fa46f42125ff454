"""The report of a flight: one page for a colleague who has neither psotrack nor the videos."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from psotrack.evaluation import Evaluation, evaluate
from psotrack.pipeline import changed_settings
from psotrack.show.flights import (
    QUANTITIES,
    FlightTracks,
    RunRecord,
    TrackedFlight,
    camera_quality,
    find_events,
    quantities,
)
from psotrack.show.reports.charts import quantity_svg
from psotrack.show.reports.moments import Moment, choose_events, take_pictures
from psotrack.show.reports.page import check_page_path, render, write_page
from psotrack.show.reports.scene import row_step, scene_data, shown_times_s
from psotrack.support import Report, html_table, no_progress
from psotrack.trajectories import drones_html

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
    flight: TrackedFlight,
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
    flight: TrackedFlight, tracks: FlightTracks, pictures: bool, jobs: int | None, report: Report
) -> dict[str, Any]:
    """What the page shows of one file of tracks; None for a part of which there is nothing to show."""
    truth, recording, record = flight.truth, flight.recording, tracks.record
    evaluation = None
    if truth is not None and flight.errors(tracks) is not None:
        evaluation = evaluate(tracks.trajectories, truth)
    events = [event for event in find_events(flight) if event.tracks == tracks.label]
    chosen = choose_events(events, MOST_PICTURES)
    moments = [Moment(event) for event in chosen]
    if pictures and recording is not None and recording.videos:
        moments = take_pictures(chosen, tracks, recording, jobs=jobs, report=report)
    cameras = None
    if recording is not None:
        quality = camera_quality(tracks, recording).to_dict("records")
        rows = [[_text(row[key], form) for _, key, form in _CAMERAS] for row in quality]
        cameras = Markup(html_table([heading for heading, _, _ in _CAMERAS], rows))
    return {
        "label": tracks.label,
        "figures": _figures(tracks, evaluation),
        "drones": Markup(drones_html(tracks.trajectories, tracks.size_m)),
        "cameras": cameras,
        "errors": None if evaluation is None else Markup(evaluation._repr_html_()),
        "charts": [(QUANTITIES[each.key][1], quantity_svg(each)) for each in quantities(flight, tracks)],
        "moments": moments,
        "more_events": len(events) - len(chosen),
        "run": None if record is None or not record.settings else _run(tracks.path.name, record, flight.name),
    }


def _text(value: Any, form: str) -> str:
    return "-" if value is None or value != value else form.format(value)


def _figures(tracks: FlightTracks, evaluation: Evaluation | None) -> list[tuple[str, str]]:
    """Large numbers, with a word each."""
    flown = tracks.trajectories
    shown = [(f"{flown.num_drones}", "drones"), (f"{flown.seen.mean():.1%}", "of all frames seen")]
    if evaluation is not None:
        found = evaluation.to_dict()
        shown += [
            (_text(found["mean_error_m"] and 1e3 * found["mean_error_m"], "{:.1f} mm"), "mean error"),
            (f"{evaluation.missed_rate:.1%}", "missed"),
            (f"{evaluation.id_switches}", "identity switches"),
            (f"{evaluation.hota:.3f}", "HOTA"),
        ]
    factor = None if tracks.record is None else tracks.record.real_time_factor
    if factor:
        times, word = (factor, "faster") if factor >= 1 else (1 / factor, "slower")
        shown.append((f"{times:.2g} times", f"{word} than the video"))
    return shown


def _run(file: str, record: RunRecord, name: str) -> dict[str, Any]:
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
