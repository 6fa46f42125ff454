"""`psotrack calibrate intrinsics`: estimate a camera's lens from a video of a ChArUco board."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from psotrack.cli.calibrate.options import OUT
from psotrack.cli.options import FORCE, JSON, QUIET, Size, dictionary_option
from psotrack.cli.output import output_json, print_line, print_table
from psotrack.support import refuse_to_overwrite

#: Names of the distortion coefficients in OpenCV's order.
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")


@click.command()
@click.argument("video", type=click.Path(path_type=Path))
@click.option(
    "--squares", "squares_wh", type=Size(), required=True, help="Number of squares of the board, such as 7x5."
)
@click.option("--square", "square_m", type=float, required=True, help="Side of a square in metres.")
@click.option("--marker", "marker_m", type=float, required=True, help="Side of a marker in metres.")
@dictionary_option("4x4_50")
@click.option(
    "--lens",
    "coefficients",
    type=click.Choice(["4", "5", "8", "12", "14"]),
    default="4",
    show_default=True,
    help="Number of distortion coefficients, in OpenCV's order; for a fisheye see calibrate rig.",
)
@click.option("--name", help="Name of the camera.  [default: the video's name]")
@OUT
@FORCE
@QUIET
@JSON
def intrinsics(
    video: Path,
    squares_wh: tuple[int, int],
    square_m: float,
    marker_m: float,
    dictionary: str,
    coefficients: str,
    name: str | None,
    out: Path,
    force: bool,
    quiet: bool,
    json_path: Path | None,
) -> None:
    """Estimate a camera's lens from VIDEO, in which a ChArUco board is moved.

    Move the board through all corners of the image, near and far, and tilt it.

    \b
    Example:
      psotrack calibrate intrinsics board.avi --squares 7x5 --square 0.04 --marker 0.03 --out lens.toml
    """
    from psotrack.calibration import Board, lens_of_board
    from psotrack.geometry import make_rig
    from psotrack.recordings import probe
    from psotrack.rig_files import write_lenses, write_rig

    refuse_to_overwrite(out, force)
    board = Board(squares_wh, square_m, marker_m, dictionary)
    lens = lens_of_board(probe(video), board, int(coefficients))
    # A rig.toml can say that the camera's place is not known; the other formats place it at the origin.
    write = write_lenses if out.suffix.lower() == ".toml" else write_rig
    write(out, make_rig({name or video.stem: lens.camera}), force=force)
    K, dist = lens.camera.K, lens.camera.dist
    values = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *dist]
    names = ("fx_px", "fy_px", "cx_px", "cy_px", *_COEFFICIENTS[: int(coefficients)])
    content = {
        "lens": str(out),
        "values": {key: float(value) for key, value in zip(names, values, strict=True)},
        "std": {key: float(value) for key, value in zip(names, lens.std, strict=True)},
        "frames": lens.frame.tolist(),
        "residual_px": lens.residual_px.tolist(),
    }
    output_json(json_path, content, force)
    rows = zip(names, values, lens.std, strict=True)
    print_table(
        quiet,
        json_path,
        ("", "value", "standard deviation"),
        ((key, f"{value:.5g}", f"{std:.2g}") for key, value, std in rows),
    )
    rms = float(np.sqrt(np.mean(lens.residual_px**2)))
    worst = lens.frame[lens.residual_px.argmax()]
    print_line(
        quiet,
        json_path,
        f"{out}: {len(lens.frame)} views, residual {rms:.2f} px, {lens.residual_px.max():.2f} px in frame {worst}",
    )
