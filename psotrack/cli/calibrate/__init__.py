"""`psotrack calibrate`: lenses, poses of cameras, whole rigs, and other programs' files."""

import click

from psotrack.cli.lazy import SETTINGS, LazyGroup, commands_in

#: Commands by name, as in `psotrack.cli`.
COMMANDS = commands_in(
    "psotrack.cli.calibrate",
    {
        "Commands": {
            "convert": "Convert the calibration IN, of any program in the list below, to OUT.",
            "rig": "Calibrate a rig from nothing: lenses and places of all cameras, from a board that is "
            "moved before them.",
        },
    },
)


@click.group(
    cls=LazyGroup,
    lazy_commands=COMMANDS,
    renamed={"extrinsics": "calibrate rig --pairs", "intrinsics": "calibrate rig"},
    context_settings=SETTINGS,
)
def calibrate() -> None:
    """Calibrate cameras, and convert calibration files.

    \b
    A rig from nothing: psotrack calibrate rig a.mp4 b.mp4 --squares 7x5 --square 0.04 --marker 0.03 --out rig.toml
    Lenses:             psotrack calibrate rig a.avi --squares 7x5 --square 0.04 --marker 0.03 --out lens.toml
    Poses of cameras:   psotrack calibrate rig --pairs pairs.csv --lenses lens.toml --out rig.toml
    Other programs:     psotrack calibrate convert rig.toml cameras_calibration.csv
    """
