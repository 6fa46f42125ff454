"""`psotrack simulate`: sequences of scenarios, and what else is made from simulated flights."""

import click

from psotrack.cli.lazy import SETTINGS, LazyCommand, LazyGroup

#: Commands by name, as in `psotrack.cli`.
COMMANDS = {
    "sequence": LazyCommand(
        "psotrack.cli.simulate.sequence:sequence",
        "Simulate a sequence: videos, calibration, ground truth, masks and detections.",
    ),
    "fly": LazyCommand(
        "psotrack.cli.simulate.fly:fly",
        "Fly a simulated drone by hand and record the flight for a scenario.",
    ),
    "labels": LazyCommand(
        "psotrack.cli.simulate.labels:labels", "Write a YOLO training set from sequences with a reference."
    ),
}


@click.group(cls=LazyGroup, lazy_commands=COMMANDS, default="sequence", context_settings=SETTINGS)
def simulate() -> None:
    """Simulate sequences: videos, calibration, ground truth, masks and detections.

    `psotrack simulate NAME` is short for `psotrack simulate sequence NAME`.

    \b
    Scenarios:    psotrack simulate --list
    A sequence:   psotrack simulate S02_D4_A --out data
    Your own:     psotrack simulate --scenario mine.toml --out data
    """
