"""`psotrack simulate`: simulate the sequence of a scenario, list scenarios, or preview one."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import click
from msgspec import Meta

from psotrack.cli.options import out_option, running
from psotrack.cli.output import Output
from psotrack.cli.records import HelpfulCommand, options_of
from psotrack.cli.types import change_of
from psotrack.errors import SettingsError, errors_name


@dataclass(frozen=True)
class ScenarioOptions:
    """What is simulated.

    Attributes:
        scenario: a scenario of your own, instead of NAME.
        restless: add an automatic exposure, a lamp that goes off, a screen and a plant.
        as_own_cameras: write OUT as a laboratory would have it: videos of different rates and sizes, and videos of a
            board.
    """

    scenario: Annotated[Path, Meta(extra={"metavar": "FILE.toml"})] | None = None
    restless: bool = False
    as_own_cameras: bool = False


@dataclass(frozen=True)
class SequenceOptions:
    """What of a sequence is made.

    Attributes:
        num_frames: simulate the first N frames only; None: all.
        scale: scale of the image size; 1 is full size.
        seed: seed of flights and noise.
        masks: write drone_masks.zip.
        onboard: render the videos of on-board cameras.
        jobs: largest number of processes; None: one per processor.
    """

    num_frames: Annotated[int, Meta(extra={"metavar": "N"})] | None = None
    scale: float = 1.0
    seed: int = 0
    masks: bool = True
    onboard: bool = True
    jobs: Annotated[int, Meta(ge=1)] | None = None


@dataclass(frozen=True)
class PreviewOptions:
    """What is shown instead of a sequence.

    Attributes:
        list: list the scenarios, and end.
        show: print the scenario's file, as a start for your own, and end.
        preview: save one page of pictures, OUT/NAME.png, instead of the sequence.
    """

    list: bool = False
    show: bool = False
    preview: bool = False


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
@options_of(PreviewOptions, "shown")
@options_of(SequenceOptions, "made", names={"num_frames": "frames"})
@running()
def sequence(
    output: Output,
    name: str | None,
    out: Path | None,
    chosen: ScenarioOptions,
    changes: tuple[str, ...],
    shown: PreviewOptions,
    made: SequenceOptions,
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
    if shown.list:
        from psotrack.simulation import catalogue, render

        output.json(catalogue())
        output.show(render(catalogue()))
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

    if (name is None) == (chosen.scenario is None):
        raise SettingsError(
            "simulate",
            expected="the NAME of a scenario or --scenario FILE.toml",
            found="neither" if name is None else "both",
            remedy="psotrack simulate --list shows the names",
        )
    if shown.show:
        if name is None:
            raise SettingsError("--show", expected="the NAME of a scenario", found="none")
        for option, found in (("--set", changes[:1]), ("--restless", ("--restless",) * chosen.restless)):
            if found:
                raise SettingsError(
                    "--show",
                    expected=f"no {option}, as the file is shown as it is",
                    found=found[0],
                    remedy=f"give {option} when the scenario is simulated",
                )
        click.echo(preset_text(str(name)), nl=False)
        return
    out = out or Path("data")
    recipe = load(chosen.scenario) if chosen.scenario else scenario(str(name))
    recipe = change_scenario(recipe, RESTLESS if chosen.restless else {})
    recipe = change_scenario(recipe, dict(change_of(change, "imaging.shutter_s=0.01") for change in changes))
    if shown.preview:
        from psotrack.simulation import save_preview

        page = save_preview(
            out / f"{recipe.name}.png",
            recipe,
            num_frames=made.num_frames,
            seed=made.seed,
            force=output.force,
            jobs=made.jobs or os.cpu_count() or 1,
            report=output.report,
        )
        output.json({"preview": str(page)})
        output.say(f"{page}")
        return
    with errors_name(chosen.scenario) if chosen.scenario else contextlib.nullcontext():
        folder = (simulate_own_cameras if chosen.as_own_cameras else make)(
            recipe,
            out,
            SimulationSettings(made.num_frames, made.scale, made.seed, made.masks, made.onboard),
            force=output.force,
            jobs=made.jobs,
            report=output.report,
        )
    output.json({"sequence": str(folder)})
    output.say(f"{folder}")
