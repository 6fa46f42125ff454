"""`psotrack simulate`: sequences of scenarios, and what else is made from simulated flights."""

import click

from psotrack.cli.lazy import SETTINGS, LazyGroup, commands_in

#: Commands by name, as in `psotrack.cli`.
COMMANDS = commands_in(
    "psotrack.cli.simulate",
    {
        "Commands": {
            "sequence": "Simulate a sequence: videos, calibration, ground truth, masks and detections.",
            "fly": "Fly a simulated drone by hand and record the flight for a scenario.",
            "labels": "Write a YOLO training set from sequences with a reference.",
        },
    },
)


@click.group(cls=LazyGroup, lazy_commands=COMMANDS, default="sequence", context_settings=SETTINGS)
def simulate() -> None:
    """Simulate sequences: videos, calibration, ground truth, masks and detections.

    `psotrack simulate NAME` is short for `psotrack simulate sequence NAME`.

    \b
    Scenarios:    psotrack simulate --list
    A sequence:   psotrack simulate S02_D4_A --out data
    Your own:     psotrack simulate --scenario mine.toml --out data
    """
