"""Options that the commands of `calibrate` share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from psotrack.cli.options import Size

OUT = click.option(
    "--out",
    type=click.Path(path_type=Path),
    required=True,
    help="Calibration to write: a file that ends in .toml, .yml or .csv.",
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
