"""`psotrack simulate as-real`: convert a simulated sequence to the form of the dataset's real half."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.options import FORCE, JSON, SEQUENCE, out_option, reporting
from psotrack.cli.output import Output, pass_output
from psotrack.cli.records import HelpfulCommand


@click.command("as-real", cls=HelpfulCommand)
@SEQUENCE
@out_option("Root folder of the data.", default=Path("data"), show_default=True)
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
@pass_output
def as_real(
    output: Output, sequence: Path, out: Path, offset_s: float, rate_hz: float, three_videos: bool, seed: int
) -> None:
    """Write the simulated sequence SEQ in the form of the dataset's real half.

    Writes OUT/Real_Data/RXX_Dn, where XX is the number in SEQ's name and n the number of drones, such as R02_D4: four
    cameras with distortion, named by serial number, in millimetres; a C3D file of marker crosses with another rate and
    another start time, with gaps and swapped labels; detections.

    \b
    Example:
      psotrack simulate S02_D4_A --set cameras=laboratory_corners --no-masks --no-onboard --out data
      psotrack simulate as-real data/Simulated_Data/S02_D4_A --out data
    """
    from psotrack.simulation import RealFormSettings, write_as_real

    folder = write_as_real(
        sequence,
        out,
        RealFormSettings(rate_hz, offset_s, three_videos, seed),
        force=output.force,
        report=output.report,
    )
    output.json({"sequence": str(folder)})
    output.say(f"{folder}")
