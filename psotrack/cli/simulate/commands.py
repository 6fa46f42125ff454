"""`psotrack simulate`: sequences of scenarios, flights by hand, and training sets for detectors."""

from __future__ import annotations

import contextlib
import tomllib
from pathlib import Path
from typing import Annotated, Any

import click
from msgspec import Meta

from psotrack import simulation
from psotrack.cli.commands import OptionGroup, command
from psotrack.cli.options import Jobs
from psotrack.cli.output import Output, check_suffix
from psotrack.cli.types import says
from psotrack.errors import SettingsError, errors_name
from psotrack.foreground import detection
from psotrack.foreground.detection import LabelSettings
from psotrack.recordings import datasets
from psotrack.support.interrupts import unhurried_end


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
        raise SettingsError("--set", expected="FIELD=VALUE, such as imaging.shutter_s=0.01", found=text)
    try:
        return name.strip(), tomllib.loads(f"value = {value}")["value"]
    except ValueError:
        # Not valid TOML, or an integer of thousands of digits.
        return name.strip(), value


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

    from psotrack.simulation.flights.piloting import fly, open_device, write_sticks

    sticks_path = out.with_suffix(".sticks.csv")
    check_suffix("--out", out, ".csv")
    output.refuse(out, sticks_path)
    space = simulation.flight_space(hall)
    # Ctrl-C ends the flight, which is then written.
    with unhurried_end(), errors_name(device):
        with open_device(device, space) as (samples, watch):
            known: dict[str, Any] = {"rate_hz": rate_hz, "max_s": max_seconds, "watch": watch}
            recorded, used = fly(samples, np.array(start_m), space, **known)
        simulation.write_recorded_flight(out, recorded.time_s, recorded.position_m, recorded.orientation_wxyz)
        write_sticks(sticks_path, used)
    output.say(
        f"{out}: {len(recorded.time_s)} samples at {rate_hz:g} Hz, {recorded.duration_s:.1f} s",
        f'in a scenario: flight = {{ kind = "recording", file = "{out}" }}',
        f"the same again: --device {sticks_path}, with the same --start and --hall",
    )


@command()
def labels(
    output: Output,
    sequences: Annotated[tuple[Path, ...], says(metavar="SEQ [SEQ ...]")],
    *,
    out: Path = Path("yolo"),
    settings: LabelSettings,
    validation: tuple[str, ...] | None = None,
    jobs: Jobs = None,
) -> None:
    """Write a YOLO training set from sequences with a reference.

    Writes OUT/images, OUT/labels (a text file per image, `class cx cy w h`) and OUT/data.yaml. Every
    sequence is used either for training or for validation, because frames of one flight resemble each other too much.
    At least two sequences are needed.

    \b
    Examples:
      psotrack simulate labels data/Simulated_Data/S0* --out yolo --drone-size 0.43,0.43,0.23 --every 5
      psotrack simulate labels R01_D2 R12_D4 --out yolo --drone-size 0.4,0.4,0.2 --offset 0,0,-0.117 --validation R12_D4

    Options:
        out: folder of the training set.
        validation: sequences for validation, not for training. None: the last sequence.
    """
    counts = detection.write_data_set(
        [datasets.open_recording(sequence) for sequence in sequences],
        out,
        settings,
        validation=validation or (),
        force=output.force,
        jobs=jobs,
        report=output.report,
    )
    output.json(counts)
    shown = "; ".join(f"{part}: {of['images']} images, {of['labels']} labels" for part, of in counts.items())
    output.say(f"{out / detection.DATA_SET}: {shown}")
