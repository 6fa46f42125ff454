"""`psotrack simulate fly`: fly a simulated drone by hand and record the flight for scenarios."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from psotrack.cli.commands import command
from psotrack.cli.output import Output, check_suffix
from psotrack.cli.types import says
from psotrack.errors import errors_name
from psotrack.support.interrupts import unhurried_end


@command(without=["progress", "json_path"])
def fly(
    output: Output,
    *,
    device: Annotated[str, says(metavar="gamepad|keyboard|FILE.csv")],
    out: Annotated[Path, says(metavar="FILE.csv")] = Path("flight.csv"),
    rate_hz: Annotated[float, Meta(ge=1, le=1000)] = 25.0,
    hall: str = "laboratory",
    start_m: Annotated[tuple[float, float, float], says(metavar="X,Y,Z")] = (0.0, 0.0, 1.0),
    max_seconds: Annotated[float, Meta(ge=1)] = 300.0,
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

    Options:
        device: controller; a file has the columns time_s,forward,left,up,turn, the last four from -1 to 1.
        out: CSV file of the recorded flight.
        rate_hz: samples per second.
        hall: hall in which the drone flies; halls are named as in scenarios.
        start_m: position in which the drone hovers at first, in metres.
        max_seconds: longest duration of the flight, in seconds.
    """
    import numpy as np

    from psotrack.simulation import flight_space, write_recorded_flight
    from psotrack.simulation.flights.piloting import fly, open_device, write_sticks

    sticks_path = out.with_suffix(".sticks.csv")
    check_suffix("--out", out, ".csv")
    output.refuse(out, sticks_path)
    space = flight_space(hall)
    # Ctrl-C ends the flight, which is then written.
    with unhurried_end(), errors_name(device):
        with open_device(device, space) as (samples, watch):
            known: dict[str, Any] = {"rate_hz": rate_hz, "max_s": max_seconds, "watch": watch}
            recorded, used = fly(samples, np.array(start_m), space, **known)
        write_recorded_flight(out, recorded.time_s, recorded.position_m, recorded.orientation_wxyz)
        write_sticks(sticks_path, used)
    output.say(
        f"{out}: {len(recorded.time_s)} samples at {rate_hz:g} Hz, {recorded.duration_s:.1f} s",
        f'in a scenario: flight = {{ kind = "recording", file = "{out}" }}',
        f"the same again: --device {sticks_path}, with the same --start and --hall",
    )
