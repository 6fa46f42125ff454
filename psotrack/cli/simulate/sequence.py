"""`psotrack simulate`: simulate the sequence of a scenario, or list scenarios."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import click
from msgspec import Meta

from psotrack import simulation
from psotrack.cli.options import JOBS, out_option, running
from psotrack.cli.output import Output
from psotrack.cli.records import HelpfulCommand, options_of
from psotrack.cli.types import change_of
from psotrack.errors import SettingsError, errors_name


@dataclass(frozen=True)
class ScenarioOptions:
    """What is simulated, or shown instead.

    Attributes:
        scenario: a scenario of your own, instead of NAME.
        restless: add an automatic exposure, a lamp that goes off, a screen and a plant.
        as_own_cameras: write OUT as a laboratory would have it: videos of different rates and sizes, and videos of a
            board.
        list: list the scenarios, and end.
        show: print the scenario's file, as a start for your own, and end.
    """

    scenario: Annotated[Path, Meta(extra={"metavar": "FILE.toml"})] | None = None
    restless: bool = False
    as_own_cameras: bool = False
    list: bool = False
    show: bool = False


@click.command(cls=HelpfulCommand)
@click.argument("name", required=False)
@out_option("Root folder of the data.  [default: data]")
@options_of(ScenarioOptions, "chosen")
@click.option(
    "--set",
    "changes",
    multiple=True,
    metavar="FIELD=VALUE",
    help="Change a field of the scenario, e.g. imaging.reflections=0; may be repeated.",
)
@options_of(simulation.SimulationSettings, "settings", names={"num_frames": "frames"})
@JOBS
@running()
def sequence(
    output: Output,
    name: str | None,
    out: Path | None,
    chosen: ScenarioOptions,
    changes: tuple[str, ...],
    settings: simulation.SimulationSettings,
    jobs: int | None,
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
      psotrack simulate --scenario mine.toml --out data --set camera_spread.focal_length=0.02
    """
    if chosen.list:
        records = simulation.catalogue()
        output.json(records)
        for one in records:
            size = f"{one['drones']} drones, {one['cameras']} cameras, {one['frames']} frames"
            output.say(
                f"{one['name']}: {size}, {one['hall']}, {one['mean_speed_m_s']:.1f} m/s",
                f"    {one['description']}",
            )
        return
    if (name is None) == (chosen.scenario is None):
        raise SettingsError(
            "simulate",
            expected="the NAME of a scenario or --scenario FILE.toml",
            found="neither" if name is None else "both",
            remedy="psotrack simulate --list shows the names",
        )
    if chosen.show:
        given = [*changes, *["--restless"] * chosen.restless]
        if name is None or given:
            expected = "the NAME of a scenario, whose file is shown as it is"
            raise SettingsError("--show", expected=expected, found=", ".join(given) or "none")
        click.echo(simulation.preset_text(name), nl=False)
        return
    out = out or Path("data")
    recipe = simulation.load(chosen.scenario) if chosen.scenario else simulation.scenario(str(name))
    changed = dict(change_of(change, "imaging.shutter_s=0.01") for change in changes)
    restless = simulation.RESTLESS if chosen.restless else {}
    recipe = simulation.change_scenario(recipe, {**restless, **changed})
    with errors_name(chosen.scenario) if chosen.scenario else contextlib.nullcontext():
        make = simulation.simulate_own_cameras if chosen.as_own_cameras else simulation.simulate
        folder = make(
            recipe,
            out,
            settings,
            force=output.force,
            jobs=jobs,
            report=output.report,
        )
    output.json({"sequence": str(folder)})
    output.say(f"{folder}")
