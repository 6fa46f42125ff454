"""One page about whatever a user has: tracks of a flight, the results of a sweep, or the record of a calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from psotrack.errors import SettingsError
from psotrack.recordings import Recording
from psotrack.show.flights import TrackedFlight, read_flight
from psotrack.show.reports.calibration_report import is_calibration_record, write_calibration_report
from psotrack.show.reports.flight_report import write_flight_report
from psotrack.show.reports.sweep_report import write_sweep_report
from psotrack.support import Report, no_progress
from psotrack.sweeps import is_results_folder


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


def write_report(
    sources: TrackedFlight | Sequence[Path],
    out: Path | None = None,
    *,
    recording: Recording | Path | str | None = None,
    pictures: bool = True,
    jobs: int | None = None,
    force: bool = False,
    report: Report = no_progress,
) -> WrittenPage:
    """Write one HTML page about what the sources are.

    Args:
        sources: a flight; or files of tracks of one flight; or the folder of a sweep's results; or the JSON file of
            `psotrack calibrate rig --json`.
        out: file that ends in .html; None: beside the first source, with the same name.
        recording: the recording of files of tracks; None: the one that their record names.
        pictures: whether events are shown with a picture, where there are videos.
        jobs: largest number of videos that are read at the same time; None is one per processor.
        force: replace an existing file.
        report: shows the progress in pictures.

    Raises:
        InputError: a file cannot be used.
        SettingsError: there is something else beside a sweep or a calibration, or no path for the page of a flight.
        OutputError: the file exists and `force` is not set, or it cannot be written.
    """
    if not isinstance(sources, TrackedFlight):
        first, *others = sources
        is_sweep = is_results_folder(first)
        is_calibration = first.suffix == ".json" and is_calibration_record(first)
        out = out or (first / "report.html" if is_sweep else first.with_suffix(".html"))
        if is_sweep or is_calibration:
            if recording is not None or others:
                what = "the results of a sweep" if is_sweep else "a calibration"
                found = f"{others[0] if recording is None else recording}"
                raise SettingsError("report", expected=f"no further files with {what}", found=found)
            write = write_sweep_report if is_sweep else write_calibration_report
            write(out, first, force=force)
            return WrittenPage(out)
        sources = read_flight(sources, recording)
    if out is None:
        raise SettingsError("report, out", expected="a file that ends in .html", found="none")
    write_flight_report(out, sources, pictures=pictures, jobs=jobs, force=force, report=report)
    return WrittenPage(out)
