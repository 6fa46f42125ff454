"""`psotrack calibrate intrinsics`: estimate a camera's lens from a video of a board."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from psotrack.calibration.rig.settings import BoardSettings, LensSettings
from psotrack.cli.calibrate.options import BOARD_NAMES, OUT
from psotrack.cli.options import running
from psotrack.cli.output import Output
from psotrack.cli.records import HelpfulCommand, options_of
from psotrack.errors import errors_name


@click.command(cls=HelpfulCommand)
@click.argument("video", type=click.Path(path_type=Path))
@options_of(BoardSettings, "board", names=BOARD_NAMES)
@options_of(LensSettings, "lenses", names={"lenses": ""})
@click.option("--name", help="Name of the camera.  [default: the video's name]")
@OUT
@running()
def intrinsics(
    output: Output, video: Path, board: BoardSettings, lenses: LensSettings, name: str | None, out: Path
) -> None:
    """Estimate a camera's lens from VIDEO, in which a board is moved.

    VIDEO may also be a folder of images, or a pattern such as 'left*.png'. Move the board through all corners of the
    image, near and far, and tilt it.

    \b
    Examples:
      psotrack calibrate intrinsics board.avi --squares 7x5 --square 0.04 --marker 0.03 --out lens.toml
      psotrack calibrate intrinsics photos --squares 10x7 --square 0.025 --lens fisheye --out lens.toml
    """
    from psotrack.calibration import (
        Board,
        lens_of_board,
        open_images,
        parse_lens_model,
        say_not_compared,
        say_searched,
    )
    from psotrack.geometry import make_rig
    from psotrack.geometry.rig_files import write_lenses, write_rig

    output.refuse(out)
    (images,) = open_images([video], [name] if name else None)
    model = parse_lens_model(lenses.lens)
    with errors_name(video):
        found = lens_of_board(images, Board.of(board), model, output.report)
    # A rig.toml can say that the camera's place is not known; the other formats place it at the origin.
    write = write_lenses if out.suffix.lower() == ".toml" else write_rig
    write(out, make_rig({images.name: found.camera}), force=output.force)
    content = {"lens": str(out), **found.to_dict()}
    output.json(content)
    output.table(
        ("", "value", "standard deviation"),
        ((key, f"{value:.5g}", f"{content['std'][key]:.2g}") for key, value in content["values"].items()),
    )
    if found.compared_px:
        errors = ", ".join(f"{name} {error:.3f}" for name, error in found.compared_px.items())
        output.say(f"lens {found.model}; median errors on views left out (px): {errors}")
    elif model is None:
        output.say(say_not_compared({images.name: len(found.frame)}))
    for sentence in say_searched({images.name: (found.searched, len(images.frames))}):
        output.say(sentence)
    rms = float(np.sqrt(np.mean(found.residual_px**2)))
    worst = found.frame[found.residual_px.argmax()]
    output.say(
        f"{out}: {len(found.frame)} views, residual {rms:.2f} px, {found.residual_px.max():.2f} px in frame {worst}"
    )
