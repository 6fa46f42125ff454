"""The report of a flight: one page for a colleague who has neither psotrack nor the videos."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from psotrack.evaluation import Evaluation, evaluate
from psotrack.pipeline import changed_settings
from psotrack.show.flights import (
    QUANTITIES,
    FlightTracks,
    RunRecord,
    TrackedFlight,
    camera_quality,
    drone_quality,
    find_events,
    quantities,
)
from psotrack.show.reports.charts import quantity_svg
from psotrack.show.reports.moments import Moment, choose_events, take_pictures
from psotrack.show.reports.page import check_page_path, render, write_page
from psotrack.show.reports.scene import row_step, scene_data, shown_times_s
from psotrack.show.reports.tables import PageColumn, make_table, percent
from psotrack.support import Report, no_progress

#: Largest number of events with a picture; a picture has about 20 kB.
MOST_PICTURES = 40
_DRONES = (
    PageColumn("drone", "drone"),
    percent("seen", "seen"),
    percent("coasting", "coasting"),
    PageColumn("first (s)", "first_s", 2),
    PageColumn("last (s)", "last_s", 2),
    PageColumn("score", "fitness", 2),
    PageColumn("cameras", "num_cameras", 1),
    PageColumn("90 % radius (mm)", "radius_90_m", 1, 1e3),
    PageColumn("speed (m/s)", "speed_m_s", 2),
    PageColumn("size (cm)", "size_cm"),
)
_DRONES_NOTE = (
    "Score: soft IoU in [0, 1], mean. 90 % radius: longest half axis of the ellipsoid that holds the position with "
    "probability 0.9, median."
)
_CAMERAS = (
    PageColumn("camera", "camera"),
    percent("frames there", "frames", 0),
    percent("drones in view", "in_view"),
    PageColumn("width of a drone (px)", "width_px", 0),
    PageColumn("noise (px)", "noise_px", 2),
    PageColumn("left out", "left_out", 0),
)
_CAMERAS_NOTE = (
    "Noise: of a drone's place in the image, as the run learned it. Left out: frames full of foreground."
)
_ERRORS = (
    PageColumn("reference", "drone"),
    PageColumn("track", "estimate"),
    PageColumn("mean (mm)", "mean_error_m", 1, 1e3),
    PageColumn("median (mm)", "median_error_m", 1, 1e3),
    PageColumn("95 % (mm)", "p95_error_m", 1, 1e3),
    PageColumn("largest (mm)", "max_error_m", 1, 1e3),
    PageColumn("without offset (mm)", "offset_removed_mean_error_m", 1, 1e3),
    percent("missed", "missed_rate"),
    percent("in 90 % ellipsoid", "inside_90_rate", 0),
)


@dataclass(frozen=True)
class WrittenPage:
    """A page that was written; its text is what `psotrack report` prints.

    Attributes:
        path: the page.
    """

    path: Path

    def to_dict(self) -> dict[str, Any]:
        """Path and size of the page."""
        return {"page": str(self.path), "bytes": self.path.stat().st_size}

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
    drones = drone_quality(tracks)
    drones["size_cm"] = [" × ".join(f"{100 * side_m:.0f}" for side_m in size_m) for size_m in tracks.size_m]  # noqa: RUF001
    cameras = None
    if recording is not None:
        cameras = make_table(_CAMERAS, camera_quality(tracks, recording).to_dict("records"), _CAMERAS_NOTE)
    return {
        "label": tracks.label,
        "figures": _figures(tracks, evaluation),
        "drones": make_table(_DRONES, drones.to_dict("records"), _DRONES_NOTE, tracks.colours),
        "cameras": cameras,
        "errors": None if evaluation is None else _error_table(evaluation),
        "charts": [(QUANTITIES[each.key][1], quantity_svg(each)) for each in quantities(flight, tracks)],
        "moments": moments,
        "more_events": len(events) - len(chosen),
        "run": None if record is None or not record.settings else _run(tracks.path.name, record, flight.name),
    }


def _figures(tracks: FlightTracks, evaluation: Evaluation | None) -> list[tuple[str, str]]:
    flown, seen = tracks.trajectories, percent("", "").text
    shown = [(f"{flown.num_drones}", "drones"), (seen(float(flown.seen.mean())), "of all frames seen")]
    if evaluation is not None:
        error = PageColumn("", "", 1, 1e3, " mm").text
        shown += [
            (error(evaluation.mean_error_m), "mean error"),
            (error(evaluation.offset_removed_mean_error_m), "without offsets"),
            (seen(evaluation.missed_rate), "missed"),
            (f"{evaluation.id_switches}", "identity switches"),
            (f"{evaluation.hota:.3f}", "HOTA"),
        ]
    factor = None if tracks.record is None else tracks.record.real_time_factor
    if factor:
        times, word = (factor, "faster") if factor >= 1 else (1 / factor, "slower")
        shown.append((f"{times:.2g} times", f"{word} than the video"))
    return shown


def _error_table(evaluation: Evaluation) -> dict[str, Any]:
    centred = percent("", "").text(evaluation.offset_removed_inside_90_rate)
    note = (
        f"MOTA {evaluation.mota:.3f}, IDF1 {evaluation.idf1:.3f}, HOTA {evaluation.hota:.3f}, GOSPA "
        f"{1e3 * evaluation.gospa_m:.1f} mm, identity switches {evaluation.id_switches}. In 90 % ellipsoid: share of "
        "the frames in which the ellipsoid that the run states holds the reference. 90 % is right. Less says that the "
        "run is too sure, or that the track and the reference are two points of the drone, a constant offset apart: "
        f"without each drone's offset it is {centred} of all frames."
    )
    return make_table(_ERRORS, map(asdict, evaluation.per_drone), note)


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
