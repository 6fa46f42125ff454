"""`psotrack calibrate convert`: convert calibrations between the file formats of programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from psotrack.cli.calibrate.options import SIZE
from psotrack.cli.options import FORCE, JSON, QUIET
from psotrack.cli.output import POSITION, format_numbers, output_json, print_line, print_table

_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}


@click.command()
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.argument("out", metavar="OUT", type=click.Path(path_type=Path))
@SIZE
@click.option(
    "--unit",
    type=click.Choice(list(_METRES)),
    default="m",
    show_default=True,
    help="Unit of the lengths in IN; a CSV file names its own unit.",
)
@FORCE
@QUIET
@JSON
def convert(
    source: Path,
    out: Path,
    image_size_wh: tuple[int, int] | None,
    unit: str,
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Convert a calibration: IN and OUT end in .csv (DPJAIT), .toml (anipose, caliscope) or .yml (OpenCV).

    \b
    Examples:
      psotrack calibrate convert calibration.toml cameras_calibration.csv --unit mm
      psotrack calibrate convert cameras_calibration.csv rig.yml --size 1920,1080
    """
    from psotrack.geometry import read_rig, write_rig

    rig = read_rig(source, image_size_wh, metres_per_unit=_METRES[unit])
    write_rig(out, rig, force=force)
    rows: dict[str, dict[str, Any]] = {
        name: {"centre_m": centre.tolist(), "focal_length_px": float(K[0, 0])}
        for name, centre, K in zip(rig.names, rig.cameras.centre_world, rig.cameras.K, strict=True)
    }
    output_json(json_path, {"rig": str(out), "cameras": rows}, force)
    print_table(
        quiet,
        json_path,
        ("camera", POSITION, "f (px)"),
        (
            (name, format_numbers(row["centre_m"], 3), f"{row['focal_length_px']:.1f}")
            for name, row in rows.items()
        ),
    )
    print_line(quiet, json_path, f"{out}")
