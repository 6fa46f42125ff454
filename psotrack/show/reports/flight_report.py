"""The report of a flight: one page for a colleague who has neither psotrack nor the videos."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from psotrack.errors import InputError
from psotrack.evaluation import Evaluation, errors_over_time, evaluate
from psotrack.pipeline import changed_settings
from psotrack.show.flights import (
    FlightTracks,
    TrackedFlight,
    camera_quality,
    drone_quality,
    find_events,
)
from psotrack.show.reports.charts import lines_over_time
from psotrack.show.reports.moments import Moment, choose_events, take_pictures
from psotrack.show.reports.page import check_page_path, render, write_page
from psotrack.show.reports.scene import row_step, scene_of_flight
from psotrack.show.reports.tables import PageCell, PageTable, number, percent
from psotrack.support import Report, drone_colour, no_progress
from psotrack.trajectories import Trajectories

#: Largest number of events with a picture; a picture has about 20 kB.
MOST_PICTURES = 40


@dataclass(frozen=True)
class Section:
    """What a page shows of one file of tracks.

    Attributes:
        label: name of the tracks.
        figures: large numbers with a word each.
        drones, cameras, errors: tables; None where there is nothing to show.
        charts: plots over time, each with a caption.
        moments: events with pictures.
        more_events: number of events that are not shown.
    """

    label: str
    figures: tuple[tuple[str, str], ...]
    drones: PageTable
    cameras: PageTable | None
    errors: PageTable | None
    charts: tuple[tuple[str, Markup], ...]
    moments: tuple[Moment, ...]
    more_events: int


def write_flight_report(
    path: Path | str,
    flight: TrackedFlight,
    *,
    pictures: bool = True,
    jobs: int | None = None,
    force: bool = False,
    report: Report = no_progress,
) -> None:
    """Write the report of a flight.

    Args:
        path: file that ends in .html.
        flight: the flight.
        pictures: whether events are shown with a picture, where there are videos.
        jobs: largest number of processes that take pictures; None is one per processor.
        force: replace an existing file.
        report: shows the progress in pictures.

    Raises:
        InputError: a video cannot be read, or there are no tracks.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    check_page_path(path, force)
    if not flight.tracks:
        raise InputError("report", expected="a file of tracks", found="none")
    sections = [_section(flight, which, pictures, jobs, report) for which in range(len(flight.tracks))]
    scene = scene_of_flight(flight)
    step = row_step(len(scene.time_s))
    first = flight.tracks[0]
    text = render(
        "flight.html",
        scenes={"scene": scene},
        title=f"{flight.name}: {first.trajectories.num_drones} drones",
        name=flight.name,
        lead=_lead(flight),
        sections=sections,
        scene_note="" if step == 1 else f"The 3D view shows every {step}th frame.",
        runs=[_run(each, flight) for each in flight.tracks],
    )
    write_page(path, text, force=force)


def _lead(flight: TrackedFlight) -> str:
    tracks = flight.tracks[0].trajectories
    span_s = float(tracks.time_s[-1] - tracks.time_s[0])
    cameras = "" if flight.recording is None else f", {len(flight.recording.rig)} cameras"
    truth = "" if flight.truth is None else ", compared with a reference"
    return f"{span_s:.1f} s, {tracks.num_frames} frames{cameras}{truth}"


def _section(flight: TrackedFlight, which: int, pictures: bool, jobs: int | None, report: Report) -> Section:
    tracks, colours = flight.tracks[which], flight.colours(which)
    evaluation = None if flight.truth is None else evaluate(tracks.trajectories, flight.truth)
    events = [event for event in find_events(flight) if event.tracks == tracks.label]
    chosen = choose_events(events, MOST_PICTURES)
    moments = [Moment(event) for event in chosen]
    if pictures and flight.recording is not None and flight.recording.videos:
        moments = take_pictures(chosen, tracks, colours, flight.recording, jobs=jobs, report=report)
    return Section(
        label=tracks.label,
        figures=_figures(tracks, evaluation),
        drones=_drone_table(tracks, colours),
        cameras=None if flight.recording is None else _camera_table(tracks, flight),
        errors=None if evaluation is None else _error_table(evaluation),
        charts=_charts(tracks, colours, flight.truth),
        moments=tuple(moments),
        more_events=len(events) - len(chosen),
    )


def _figures(tracks: FlightTracks, evaluation: Evaluation | None) -> tuple[tuple[str, str], ...]:
    shown = [
        (f"{tracks.trajectories.num_drones}", "drones"),
        (f"{100 * tracks.trajectories.seen.mean():.1f} %", "of all frames seen"),
    ]
    if evaluation is not None:
        shown += [
            (number(evaluation.mean_error_m, 0, factor=1e3, unit=" mm").text, "mean error"),
            (
                number(evaluation.offset_removed_mean_error_m, 1, factor=1e3, unit=" mm").text,
                "without offsets",
            ),
            (f"{100 * evaluation.missed_rate:.1f} %", "missed"),
            (f"{evaluation.id_switches}", "identity switches"),
            (f"{evaluation.hota:.3f}", "HOTA"),
        ]
    record = tracks.record
    if record is not None and record.real_time_factor is not None:
        shown.append((f"{record.real_time_factor:.2g}", "of real time"))
    return tuple(shown)


def _drone_table(tracks: FlightTracks, colours: list[str]) -> PageTable:
    rows = []
    for drone, row in enumerate(drone_quality(tracks).to_dict("records")):
        sizes_m = [row[f"size_{axis}_m"] for axis in "xyz"]
        rows.append(
            (
                PageCell(row["drone"], colour=colours[drone]),
                percent(row["seen"]),
                percent(row["coasting"]),
                number(row["first_s"], 2),
                number(row["last_s"], 2),
                number(row["fitness"], 2),
                number(row["num_cameras"], 1),
                number(row["radius_90_m"], 1, factor=1e3),
                number(row["speed_m_s"], 2),
                PageCell(" × ".join(f"{100 * size_m:.0f}" for size_m in sizes_m), float(np.prod(sizes_m))),  # noqa: RUF001
            )
        )
    headings = (
        *("drone", "seen", "coasting", "first (s)", "last (s)", "score", "cameras"),
        *("90 % radius (mm)", "speed (m/s)", "size (cm)"),
    )
    note = (
        "Score: soft IoU in [0, 1], mean. 90 % radius: longest half axis of the ellipsoid that holds the position with "
        "probability 0.9, median."
    )
    return PageTable(headings, tuple(rows), note)


def _camera_table(tracks: FlightTracks, flight: TrackedFlight) -> PageTable:
    assert flight.recording is not None
    rows = tuple(
        (
            PageCell(row["camera"]),
            percent(row["frames"], 0),
            percent(row["in_view"]),
            number(row["width_px"], 0),
            number(row["noise_px"], 2),
            number(row["left_out"], 0),
        )
        for row in camera_quality(tracks, flight.recording).to_dict("records")
    )
    headings = ("camera", "frames there", "drones in view", "width of a drone (px)", "noise (px)", "left out")
    note = "Noise: of a drone's place in the image, as the run learned it. Left out: frames with foreground everywhere."
    return PageTable(headings, rows, note)


def _error_table(evaluation: Evaluation) -> PageTable:
    rows = tuple(
        (
            PageCell(drone.drone),
            PageCell(drone.estimate or "–"),  # noqa: RUF001
            number(drone.mean_error_m, 1, factor=1e3),
            number(drone.median_error_m, 1, factor=1e3),
            number(drone.p95_error_m, 1, factor=1e3),
            number(drone.max_error_m, 1, factor=1e3),
            number(drone.offset_removed_mean_error_m, 1, factor=1e3),
            percent(drone.missed_rate),
            percent(drone.inside_90_rate, 0),
        )
        for drone in evaluation.per_drone
    )
    headings = (
        *("reference", "track", "mean (mm)", "median (mm)", "95 % (mm)", "largest (mm)"),
        *("without offset (mm)", "missed", "in 90 % ellipsoid"),
    )
    summary = (
        f"MOTA {evaluation.mota:.3f}, IDF1 {evaluation.idf1:.3f}, HOTA {evaluation.hota:.3f}, "
        f"GOSPA {1e3 * evaluation.gospa_m:.1f} mm, identity switches {evaluation.id_switches}."
    )
    return PageTable(headings, rows, summary)


def _charts(
    tracks: FlightTracks, colours: list[str], truth: Trajectories | None
) -> tuple[tuple[str, Markup], ...]:
    trajectories = tracks.trajectories
    time_s, seen, charts = trajectories.time_s, trajectories.seen, []
    if truth is not None:
        errors = errors_over_time(trajectories, truth)
        table = errors.pivot(index="time_s", columns="drone", values="error_m").sort_index()
        names = [f"{name}" for name in table.columns]
        charts.append(
            (
                "Distance of each drone of the reference from its track.",
                lines_over_time(
                    table.index.to_numpy(float),
                    1e3 * table.to_numpy(float),
                    names,
                    [drone_colour(drone) for drone in range(len(names))],
                    "error (mm)",
                ),
            )
        )
    for values, label, caption in (
        (trajectories.fitness, "score", "Score of each drone: how well the images fit its position."),
        (trajectories.num_cameras, "cameras", "Number of cameras that see each drone."),
    ):
        if values is not None:
            shown = np.where(seen, values, np.nan)
            charts.append((caption, lines_over_time(time_s, shown, trajectories.drones, colours, label)))
    if trajectories.covariance_m2 is not None:
        variance_m2 = np.trace(trajectories.covariance_m2, axis1=-2, axis2=-1)
        std_mm = 1e3 * np.sqrt(np.where(seen, variance_m2, np.nan))
        caption = "Standard deviation of each position in space, as the run states it."
        charts.append((caption, lines_over_time(time_s, std_mm, trajectories.drones, colours, "std (mm)")))
    return tuple(charts)


def _run(tracks: FlightTracks, flight: TrackedFlight) -> dict[str, Any]:
    """Settings, versions and commands of a run, for the page."""
    record = tracks.record
    if record is None:
        return {"label": tracks.label, "again": "", "versions": (), "settings": ""}
    changed = changed_settings(record.whole) if record.settings else {}
    lines = "".join(f"    {json.dumps(name)}: {value!r},\n" for name, value in changed.items())
    sequence = record.sequence or flight.name
    again = (
        "import psotrack as pt\n\n"
        f"tracked = pt.track({json.dumps(sequence)}, {{\n{lines}}})\n"
        f"pt.write_trajectories({json.dumps(tracks.path.name)}, tracked.trajectories)\n"
    )
    versions = {**record.versions, **{f"device {key}": value for key, value in record.device.items()}}
    return {
        "label": tracks.label,
        "again": again if record.settings else "",
        "versions": tuple(versions.items()),
        "settings": json.dumps(record.settings, indent=2),
    }
