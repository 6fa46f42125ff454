"""Options that the commands of `calibrate` share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from psotrack.cli.options import out_option
from psotrack.cli.types import Size

OUT = out_option(
    "Calibration to write: a file that ends in .toml, .yml or .csv.",
    default=Path("rig.toml"),
    show_default=True,
)
SIZE = click.option(
    "--size",
    "image_size_wh",
    type=Size(),
    help="Size of the images in pixels, if the calibration file does not contain the size.",
)


def noise_option(default: float) -> Any:
    """Option `--noise`: standard deviation of points in the image."""
    return click.option(
        "--noise",
        "noise_px",
        type=float,
        default=default,
        show_default=True,
        help="Standard deviation of a point in the image, along x and along y, in pixels.",
    )


LENS = click.option(
    "--lens",
    default="auto",
    show_default=True,
    metavar="auto|0|4|5|8|12|14|fisheye",
    help="Number of distortion coefficients of OpenCV's lens model, or its fisheye model; auto chooses by views that "
    "are left out.",
)


#: Names of the options of `BoardSettings`.
BOARD_NAMES = {"kind": "board"}
