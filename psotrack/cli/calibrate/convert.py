"""`psotrack calibrate convert`: convert calibrations between the file formats of programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from psotrack.cli.calibrate.options import SIZE
from psotrack.cli.options import FORCE, JSON, QUIET
from psotrack.cli.output import Output, pass_output
from psotrack.cli.records import HelpfulCommand
from psotrack.errors import SettingsError
from psotrack.support import POSITION, format_numbers

if TYPE_CHECKING:
    from psotrack.geometry import Rig


@click.command(cls=HelpfulCommand)
@click.argument("source", metavar="IN", type=click.Path(path_type=Path))
@click.argument("out", metavar="OUT", type=click.Path(path_type=Path))
@SIZE
@click.option(
    "--units",
    "--unit",
    "units",
    metavar="m|cm|mm",
    help="Unit of the lengths in IN; needed if the format leaves the unit open.",
)
@click.option(
    "--format", "file_format", metavar="NAME", help="Format of IN.  [default: found by the content]"
)
@click.option("--to", "out_format", metavar="NAME", help="Format of OUT.  [default: by the name of OUT]")
@click.option("--lenses", is_flag=True, help="Convert only the lenses; IN need not have poses.")
@click.option(
    "--undistorted", is_flag=True, help="Set the distortion to zero: the videos are undistorted already."
)
@FORCE
@QUIET
@JSON
@pass_output
def convert(
    output: Output,
    source: Path,
    out: Path,
    image_size_wh: tuple[int, int] | None,
    units: str | None,
    file_format: str | None,
    out_format: str | None,
    lenses: bool,
    undistorted: bool,
) -> None:
    """Convert the calibration IN, of any program in the list below, to OUT.

    \b
    Read:    rig (rig.toml), dpjait, anipose, caliscope, pose2sim, opencv, qualisys, vicon, easymocap, kalibr,
             dlt, argus, handpose3d
    Written: rig (OUT ends in .toml), dpjait (.csv), opencv (.yml), anipose, caliscope (--to)

    Cameras that IN does not place are left out, with a warning.

    \b
    Examples:
      psotrack calibrate convert calibration.toml rig.toml --units mm
      psotrack calibrate convert cameras_calibration.csv rig.yml --size 1920,1080
    """
    from psotrack.geometry import Rig
    from psotrack.geometry.rig_files import UNITS_M, read_lenses, read_rig, write_lenses, write_rig

    if units is not None and units not in UNITS_M:
        raise SettingsError("--units", expected=f"one of {', '.join(UNITS_M)}", found=units)
    if lenses:
        rig = read_lenses(source, image_size_wh, file_format=file_format)
    else:
        metres = None if units is None else UNITS_M[units]
        rig = read_rig(source, image_size_wh, metres_per_unit=metres, file_format=file_format)
    if undistorted:
        rig = Rig(rig.names, replace(rig.cameras, dist=rig.cameras.dist[:, :0], fisheye=None))
    if lenses:
        write_lenses(out, rig, force=output.force)
    else:
        write_rig(out, rig, force=output.force, file_format=out_format)
    _show(output, rig, out, placed=not lenses)


def _show(output: Output, rig: Rig, out: Path, *, placed: bool) -> None:
    rows: dict[str, dict[str, Any]] = {
        name: ({"centre_m": centre.tolist()} if placed else {}) | {"focal_length_px": float(K[0, 0])}
        for name, centre, K in zip(rig.names, rig.cameras.centre_world, rig.cameras.K, strict=True)
    }
    output.json({"rig": str(out), "cameras": rows})
    output.table(
        ("camera", *((POSITION,) if placed else ()), "f (px)"),
        (
            (
                name,
                *((format_numbers(row["centre_m"], 3),) if placed else ()),
                f"{row['focal_length_px']:.1f}",
            )
            for name, row in rows.items()
        ),
    )
    output.say(f"{out}")
