"""`psotrack as-real`: convert a simulated sequence to the form of the dataset's real half."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.options import FORCE, JSON, SEQUENCE, reporting
from psotrack.cli.output import output_json, print_line, report_to


@click.command("as-real")
@SEQUENCE
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Root folder of the data.")
@click.option(
    "--offset",
    "offset_s",
    type=float,
    default=0.37,
    show_default=True,
    help="Time in the C3D file at frame 0 of the videos, in seconds.",
)
@click.option(
    "--rate", "rate_hz", type=float, default=100.0, show_default=True, help="Rate of the C3D file, in hertz."
)
@click.option("--three-videos", is_flag=True, help="Leave the last camera's video out, as in R17_D1_A.")
@click.option(
    "--seed", type=int, default=0, show_default=True, help="Seed of the noise and the gaps of the markers."
)
@FORCE
@reporting
@JSON
def as_real(
    sequence: Path,
    out: Path,
    offset_s: float,
    rate_hz: float,
    three_videos: bool,
    seed: int,
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Write the simulated sequence SEQ in the form of the dataset's real half.

    Writes OUT/Real_Data/RXX_Dn, where XX is the number in SEQ's name and n the number of drones, such as R02_D4: four
    cameras with distortion, named by serial number, in millimetres; a C3D file of marker crosses with another rate and
    another start time, with gaps and swapped labels; detections.

    \b
    Example:
      psotrack simulate S02_D4_A --set cameras=laboratory_corners --no-masks --no-onboard --out data
      psotrack as-real data/Simulated_Data/S02_D4_A --out data
    """
    from psotrack.simulation import RealFormSettings, write_as_real

    folder = write_as_real(
        sequence,
        out,
        RealFormSettings(rate_hz, offset_s, three_videos, seed),
        force=force,
        report=report_to(quiet),
    )
    output_json(json_path, {"sequence": str(folder)}, force)
    print_line(quiet, json_path, f"{folder}")
