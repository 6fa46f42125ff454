"""What the commands of `calibrate` have in common."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from psotrack.cli.options import Size

OUT = click.option(
    "--out", type=click.Path(path_type=Path), required=True, help="A file that ends in .toml, .yml or .csv."
)
SIZE = click.option(
    "--size", "image_size_wh", type=Size(), help="Of the images in pixels, where FILE does not have it."
)


def noise_option(default: float) -> Any:
    """How well points are seen."""
    return click.option(
        "--noise",
        "noise_px",
        type=float,
        default=default,
        show_default=True,
        help="Standard deviation of a point in the image, along x and along y, in pixels.",
    )
