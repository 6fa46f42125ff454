"""`psotrack simulate`: simulate the sequence of a scenario, or list scenarios."""

from __future__ import annotations

import contextlib
import tomllib
from pathlib import Path
from typing import Annotated, Any

import click

from psotrack import simulation
from psotrack.cli.commands import OptionGroup, command
from psotrack.cli.options import Jobs
from psotrack.cli.output import Output
from psotrack.cli.types import says
from psotrack.errors import SettingsError, errors_name


@command()
def sequence(
    output: Output,
    name: str | None = None,
    *,
    out: Path = Path("data"),
    scenario: Annotated[Path | None, says(metavar="FILE.toml")] = None,
    restless: bool = False,
    as_own_cameras: bool = False,
    listed: Annotated[bool, says(flag="list")] = False,
    show: bool = False,
    changes: Annotated[
        tuple[str, ...], says(flag="set", multiple=True, metavar="FIELD=VALUE", type=str)
    ] = (),
    settings: Annotated[simulation.SimulationSettings, OptionGroup(names={"num_frames": "frames"})],
    jobs: Jobs = None,
) -> None:
    """Simulate a sequence: videos, calibration, ground truth, masks and detections.

    Writes OUT/Simulated_Data/NAME. The same seed makes the same flights and the same pixels; the same
    command continues an interrupted simulation.

    \b
    Examples:
      psotrack simulate --list
      psotrack simulate S02_D4_A --out data
      psotrack simulate S04_D10 --out small --scale 0.5 --frames 60 --seed 7
      psotrack simulate S02_D4_A --out restless --restless
      psotrack simulate S02_D4_A --as-own-cameras --out my_lab
      psotrack simulate S02_D4_A --show > mine.toml
      psotrack simulate --scenario mine.toml --out data --set imaging.jpeg_quality=40

    Options:
        out: root folder of the data.
        scenario: a scenario of your own, instead of NAME.
        restless: add an automatic exposure, a lamp that goes off, a screen and a plant.
        as_own_cameras: write OUT as a laboratory would have it: videos of different rates and sizes, and videos of a
            board.
        listed: list the scenarios, and end.
        show: print the scenario's file, as a start for your own, and end.
        changes: change a field of the scenario, e.g. imaging.reflections=0; may be repeated.
    """
    if listed:
        records = simulation.catalogue()
        output.json(records)
        for one in records:
            size = f"{one['drones']} drones, {one['cameras']} cameras, {one['frames']} frames"
            output.say(
                f"{one['name']}: {size}, {one['hall']}, {one['mean_speed_m_s']:.1f} m/s",
                f"    {one['description']}",
            )
        return
    if (name is None) == (scenario is None):
        raise SettingsError(
            "simulate",
            expected="the NAME of a scenario or --scenario FILE.toml",
            found="neither" if name is None else "both",
            remedy="psotrack simulate --list shows the names",
        )
    if show:
        given = [*changes, *["--restless"] * restless]
        if name is None or given:
            expected = "the NAME of a scenario, whose file is shown as it is"
            raise SettingsError("--show", expected=expected, found=", ".join(given) or "none")
        click.echo(simulation.preset_text(name), nl=False)
        return
    recipe = simulation.load(scenario) if scenario else simulation.scenario(str(name))
    changed = {**(simulation.RESTLESS if restless else {}), **dict(map(_change, changes))}
    recipe = simulation.change_scenario(recipe, changed)
    with errors_name(scenario) if scenario else contextlib.nullcontext():
        make = simulation.simulate_own_cameras if as_own_cameras else simulation.simulate
        folder = make(recipe, out, settings, force=output.force, jobs=jobs, report=output.report)
    output.json({"sequence": str(folder)})
    output.say(f"{folder}")


def _change(text: str) -> tuple[str, Any]:
    """Field and value of `FIELD=VALUE`; the value is parsed as TOML, and kept as text if it is not valid TOML."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip():
        expected = "FIELD=VALUE, such as imaging.shutter_s=0.01"
        raise SettingsError("--set", expected=expected, found=text)
    try:
        return name.strip(), tomllib.loads(f"value = {value}")["value"]
    except ValueError:
        # Not valid TOML, or an integer of thousands of digits.
        return name.strip(), value
