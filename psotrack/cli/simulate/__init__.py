"""`psotrack simulate`: sequences of scenarios, and what else is made from simulated flights."""

import click

from psotrack.cli.lazy import LazyGroup

_COMMANDS = {"Commands": {name: f"commands.{name}" for name in ("sequence", "fly", "labels")}}


@click.group(cls=LazyGroup, package=__name__, below=_COMMANDS, default="sequence")
def simulate() -> None:
    """Simulate sequences: videos, calibration, ground truth, masks and detections.

    `psotrack simulate NAME` is short for `psotrack simulate sequence NAME`.

    \b
    Scenarios:    psotrack simulate --list
    A sequence:   psotrack simulate S02_D4_A --out data
    Your own:     psotrack simulate --scenario mine.toml --out data
    """
