"""`psotrack report`: one HTML page about a flight, a sweep or a calibration."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.options import FORCE, JOBS, SequencePath, reporting
from psotrack.cli.output import print_line, report_to
from psotrack.errors import SettingsError


@click.command()
@click.argument("source", metavar="SOURCE", type=click.Path(path_type=Path))
@click.argument("sequence", metavar="[SEQ]", type=SequencePath(path_type=Path), required=False)
@click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="Page to write; it ends in .html."
)
@click.option(
    "--compare",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="TRACKS",
    help="Further tracks of the same flight to show beside; may be repeated.",
)
@click.option(
    "--no-pictures", is_flag=True, help="Show events without pictures, which need the videos of SEQ."
)
@JOBS
@FORCE
@reporting
def report(
    source: Path,
    sequence: Path | None,
    out: Path,
    compare: tuple[Path, ...],
    no_pictures: bool,
    jobs: int | None,
    force: bool,
    quiet: bool,
) -> None:
    """Write one HTML page about SOURCE: tracks of a flight, results of a sweep, or a calibration.

    SOURCE is a file of tracks, the folder of a sweep, or the JSON file of `psotrack calibrate rig --json`. With SEQ,
    the recording of the tracks, the page of a flight has errors, cameras, and pictures of events. The page needs no
    network and no other file: a browser opens it by a double click.

    \b
    Examples:
      psotrack report tracks.csv data/Simulated_Data/S02_D4_A --out report.html
      psotrack report tracks.csv flight --compare lines.csv --out report.html
      psotrack report results --out sweep.html
      psotrack report calibration.json --out calibration.html
    """
    from psotrack.show.flights import read_flight
    from psotrack.show.reports import (
        is_calibration_record,
        write_calibration_report,
        write_flight_report,
        write_sweep_report,
    )
    from psotrack.sweep import is_results_folder

    is_sweep = is_results_folder(source)
    is_calibration = source.suffix == ".json" and is_calibration_record(source)
    if (is_sweep or is_calibration) and (sequence is not None or compare):
        what = "the results of a sweep" if is_sweep else "a calibration"
        found = f"{sequence}" if sequence is not None else f"--compare {compare[0]}"
        raise SettingsError("report", expected=f"no further files with {what}", found=found)
    if is_sweep:
        write_sweep_report(out, source, force=force)
    elif is_calibration:
        write_calibration_report(out, source, force=force)
    else:
        flight = read_flight([source, *compare], sequence)
        write_flight_report(
            out, flight, pictures=not no_pictures, jobs=jobs, force=force, report=report_to(quiet)
        )
    print_line(quiet, None, f"{out}: {out.stat().st_size / 1e6:.1f} MB")
