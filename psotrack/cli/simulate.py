"""`psotrack simulate`: simulate the sequence of a scenario, list scenarios, or preview one."""

from __future__ import annotations

import contextlib
import os
import tomllib
from pathlib import Path
from typing import Any

import click

from psotrack.cli.options import FORCE, JOBS, JSON, reporting
from psotrack.cli.output import output_json, print_line, report_to
from psotrack.errors import SettingsError, errors_name


@click.command()
@click.argument("name", required=False)
@click.option("--out", type=click.Path(path_type=Path), help="Root folder of the data.")
@click.option(
    "--scenario",
    "scenario_file",
    type=click.Path(path_type=Path),
    metavar="FILE.toml",
    help="A scenario of your own, instead of NAME.",
)
@click.option(
    "--set",
    "changes",
    multiple=True,
    metavar="FIELD=VALUE",
    help="Change a field of the scenario, e.g. imaging.reflections=0; may be repeated.",
)
@click.option(
    "--restless",
    is_flag=True,
    help="Add an automatic exposure, a lamp that goes off, a screen and a plant.",
)
@click.option("--list", "listed", is_flag=True, help="List the scenarios, and end.")
@click.option("--show", is_flag=True, help="Print the scenario's file, as a start for your own, and end.")
@click.option(
    "--preview", is_flag=True, help="Save one page of pictures, OUT/NAME.png, instead of the sequence."
)
@click.option(
    "--frames", "num_frames", type=int, metavar="N", help="Simulate the first N frames only.  [default: all]"
)
@click.option(
    "--scale", type=float, default=1.0, show_default=True, help="Scale of the image size; 1 is full size."
)
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of flights and noise.")
@click.option("--masks/--no-masks", default=True, show_default=True, help="Write drone_masks.zip.")
@click.option(
    "--onboard/--no-onboard", default=True, show_default=True, help="Render the videos of on-board cameras."
)
@click.option(
    "--as-own-cameras",
    "own_cameras",
    is_flag=True,
    help="Write OUT as a laboratory would have it: videos of different rates and sizes, and videos of a board.",
)
@JOBS
@FORCE
@reporting
@JSON
def simulate(
    name: str | None,
    out: Path | None,
    scenario_file: Path | None,
    changes: tuple[str, ...],
    restless: bool,
    listed: bool,
    show: bool,
    preview: bool,
    num_frames: int | None,
    scale: float,
    seed: int,
    masks: bool,
    onboard: bool,
    own_cameras: bool,
    jobs: int | None,
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Simulate a sequence: videos, calibration, ground truth, masks and detections.

    Writes OUT/Simulated_Data/NAME. The same seed makes the same flights and the same pixels; the same
    command continues an interrupted simulation.

    \b
    Examples:
      psotrack simulate --list
      psotrack simulate S02_D4_A --out data
      psotrack simulate S04_D10 --out small --scale 0.5 --frames 60 --seed 7
      psotrack simulate S02_D4_A --out pages --preview
      psotrack simulate S02_D4_A --out restless --restless
      psotrack simulate S02_D4_A --as-own-cameras --out my_lab
      psotrack simulate S02_D4_A --show > mine.toml
      psotrack simulate --scenario mine.toml --out data --set camera_spread.focal_length=0.02
    """
    if listed:
        _list(json_path, quiet, force)
        return
    from psotrack.simulation import (
        RESTLESS,
        SimulationSettings,
        change_scenario,
        load,
        preset_text,
        scenario,
        simulate_own_cameras,
    )
    from psotrack.simulation import simulate as make

    if (name is None) == (scenario_file is None):
        raise SettingsError(
            "simulate",
            expected="the NAME of a scenario or --scenario FILE.toml",
            found="neither" if name is None else "both",
            remedy="psotrack simulate --list shows the names",
        )
    if show:
        if name is None:
            raise SettingsError("--show", expected="the NAME of a scenario", found="none")
        for option, found in (("--set", changes[:1]), ("--restless", ("--restless",) * restless)):
            if found:
                raise SettingsError(
                    "--show",
                    expected=f"no {option}, as the file is shown as it is",
                    found=found[0],
                    remedy=f"give {option} when the scenario is simulated",
                )
        click.echo(preset_text(str(name)), nl=False)
        return
    if out is None:
        raise SettingsError("--out", expected="the folder to write to", found="none")
    recipe = load(scenario_file) if scenario_file else scenario(str(name))
    recipe = change_scenario(recipe, RESTLESS if restless else {})
    recipe = change_scenario(recipe, dict(_change(change) for change in changes))
    if preview:
        from psotrack.simulation import save_preview

        page = save_preview(
            out / f"{recipe.name}.png",
            recipe,
            num_frames=num_frames,
            seed=seed,
            force=force,
            jobs=jobs or os.cpu_count() or 1,
            report=report_to(quiet),
        )
        output_json(json_path, {"preview": str(page)}, force)
        print_line(quiet, json_path, f"{page}")
        return
    with errors_name(scenario_file) if scenario_file else contextlib.nullcontext():
        folder = (simulate_own_cameras if own_cameras else make)(
            recipe,
            out,
            SimulationSettings(num_frames, scale, seed, masks, onboard),
            force=force,
            jobs=jobs,
            report=report_to(quiet),
        )
    output_json(json_path, {"sequence": str(folder)}, force)
    print_line(quiet, json_path, f"{folder}")


def _list(json_path: Path | None, quiet: bool, force: bool) -> None:
    from rich.console import Console

    from psotrack.simulation import catalogue, render

    rows = catalogue()
    output_json(json_path, rows, force)
    if not quiet and json_path != Path("-"):
        Console().print(render(rows))


def _change(text: str) -> tuple[str, Any]:
    """Field and value of `FIELD=VALUE`; the value is parsed as TOML, and kept as a string if it is not valid TOML."""
    field, equals, value = text.partition("=")
    if not equals or not field.strip():
        raise SettingsError("--set", expected="FIELD=VALUE, such as imaging.shutter_s=0.01", found=text)
    try:
        return field.strip(), tomllib.loads(f"value = {value}")["value"]
    except ValueError:
        # Not valid TOML, or an integer of thousands of digits.
        return field.strip(), value
