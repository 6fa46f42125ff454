"""`psotrack simulate fly`: fly a simulated drone by hand and record the flight for scenarios."""

from __future__ import annotations

from pathlib import Path

import click

from psotrack.cli.options import FORCE, QUIET, out_option
from psotrack.cli.output import Output, check_suffix, pass_output
from psotrack.cli.records import HelpfulCommand
from psotrack.cli.types import Numbers
from psotrack.errors import errors_name
from psotrack.support.interrupts import unhurried_end


@click.command(cls=HelpfulCommand)
@out_option(
    "CSV file of the recorded flight.", default=Path("flight.csv"), show_default=True, metavar="FILE.csv"
)
@click.option(
    "--device",
    required=True,
    metavar="gamepad|keyboard|FILE.csv",
    help="Controller; a file has the columns time_s,forward,left,up,turn, the last four from -1 to 1.",
)
@click.option(
    "--rate",
    "rate_hz",
    type=click.FloatRange(1, 1000),
    default=25.0,
    show_default=True,
    help="Samples per second.",
)
@click.option(
    "--hall",
    default="laboratory",
    show_default=True,
    help="Hall in which the drone flies; halls are named as in scenarios.",
)
@click.option(
    "--start",
    "start_m",
    type=Numbers(3),
    metavar="X,Y,Z",
    default=(0.0, 0.0, 1.0),
    help="Position in which the drone hovers at first, in metres.  [default: 0,0,1]",
)
@click.option(
    "--max-seconds",
    type=click.FloatRange(1),
    default=300.0,
    show_default=True,
    help="Longest duration of the flight, in seconds.",
)
@FORCE
@QUIET
@pass_output
def fly(
    output: Output,
    out: Path,
    device: str,
    rate_hz: float,
    hall: str,
    start_m: tuple[float, float, float],
    max_seconds: float,
) -> None:
    """Fly a simulated drone by hand and record the flight for a scenario.

    Writes position and orientation over time to OUT, and the movements of the sticks to a file beside OUT that ends in
    .sticks.csv. --device repeats a flight from such a file. The buttons start and back, the key Esc and Ctrl-C end the
    flight; the flight until then is kept. Controllers and the keyboard are an extra,
    pip install '.[control]' in the checkout of psotrack.

    \b
    Examples:
      psotrack simulate fly --out loop.csv --device gamepad
      psotrack simulate fly --out loop.csv --device keyboard --start -2,0,1.5
      psotrack simulate fly --out again.csv --device loop.sticks.csv --start -2,0,1.5 --rate 100
    """
    import numpy as np

    from psotrack.simulation import flight_space, write_recorded_flight
    from psotrack.simulation.flights import devices, piloting

    sticks_path = out.with_suffix(".sticks.csv")
    check_suffix("--out", out, ".csv")
    output.refuse(out, sticks_path)
    space = flight_space(hall)
    start = np.array(start_m)
    piloting.check(start, space, rate_hz)
    # Ctrl-C ends the flight, which is then written.
    with unhurried_end(), errors_name(device):
        with devices.open_device(device, space) as opened:
            samples = piloting.until(opened.samples(), max_seconds)
            flown = piloting.fly(samples, start, space, rate_hz=rate_hz, watch=opened.watch)
        recorded = flown.recorded
        write_recorded_flight(out, recorded.time_s, recorded.position_m, recorded.orientation_wxyz)
        piloting.write_sticks(sticks_path, flown.samples)
    output.say(
        f"{out}: {len(recorded.time_s)} samples at {rate_hz:g} Hz, {recorded.duration_s:.1f} s",
        f'in a scenario: flight = {{ kind = "recording", file = "{out}" }}',
        f"the same again: --device {sticks_path}, with the same --start and --hall",
    )
