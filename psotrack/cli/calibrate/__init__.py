"""`psotrack calibrate`: lenses, where cameras stand, a rig that agrees with its drones, and other programs' files."""

import click

from psotrack.cli.calibrate.adjust import adjust
from psotrack.cli.calibrate.convert import convert
from psotrack.cli.calibrate.extrinsics import extrinsics
from psotrack.cli.calibrate.intrinsics import intrinsics


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
def calibrate() -> None:
    """Calibrate cameras, and convert calibrations.

    \b
    Lenses:             psotrack calibrate intrinsics a.avi --squares 7x5 --square 0.04 --marker 0.03 --out lens.toml
    Where cameras are:  psotrack calibrate extrinsics --pairs pairs.csv --intrinsics lens.toml --out rig.toml
    From the drones:    psotrack calibrate adjust SEQ --tracks tracks.csv --out better.toml
    Other programs:     psotrack calibrate convert rig.toml cameras_calibration.csv
    """


calibrate.add_command(adjust)
calibrate.add_command(convert)
calibrate.add_command(extrinsics)
calibrate.add_command(intrinsics)
