"""`psotrack calibrate`: lenses, poses of cameras, whole rigs, and other programs' files."""

import click

from psotrack.cli.lazy import LazyGroup

_COMMANDS = {"Commands": {"convert": "commands.convert", "rig": "commands.rig"}}


@click.group(cls=LazyGroup, package=__name__, below=_COMMANDS)
def calibrate() -> None:
    """Calibrate cameras, and convert calibration files.

    \b
    A rig from nothing: psotrack calibrate rig a.mp4 b.mp4 --squares 7x5 --square 0.04 --marker 0.03 --out rig.toml
    Lenses:             psotrack calibrate rig a.avi --squares 7x5 --square 0.04 --marker 0.03 --out lens.toml
    Poses of cameras:   psotrack calibrate rig --pairs pairs.csv --lenses lens.toml --out rig.toml
    Other programs:     psotrack calibrate convert rig.toml cameras_calibration.csv
    """
