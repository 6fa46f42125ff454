"""Options of several commands of `calibrate`."""

from __future__ import annotations

from pathlib import Path

from psotrack.cli.options import out_option

OUT = out_option(
    "Calibration to write: a file that ends in .toml, .yml or .csv.",
    default=Path("rig.toml"),
    show_default=True,
)
#: Names of the options of `BoardSettings`.
BOARD_NAMES = {"kind": "board"}
