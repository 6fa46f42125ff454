"""`psotrack calibrate rig`: lenses and places of all cameras from a board that is moved before them, or from points."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from psotrack.calibration.rig.settings import (
    BoardSettings,
    LensSettings,
    PointSettings,
    WorldSettings,
)
from psotrack.cli.commands import OptionGroup, command
from psotrack.cli.options import Plot
from psotrack.cli.output import Output
from psotrack.cli.types import says


@command()
def rig(
    output: Output,
    sources: Annotated[tuple[Path, ...], says(metavar="[VIDEO...]")] = (),
    *,
    board: Annotated[
        BoardSettings, OptionGroup("Board", {"kind": "board"}, rare=("kind", "separation_m", "first_marker"))
    ],
    lens: Annotated[LensSettings, OptionGroup("Lenses", rare=("fov_deg", "size"))],
    world: WorldSettings,
    points: Annotated[PointSettings, OptionGroup("Instead of a board", rare=("stick_m", "noise_px"))],
    plot: Plot = None,
    out: Path = Path("rig.toml"),
) -> None:
    """Calibrate a rig from nothing: lenses and places of all cameras, from a board that is moved before them.

    Each VIDEO is that of one camera: a video, a folder of images, or a pattern such as 'left*.png'; a folder of
    videos stands for all of them. Frames of equal number are one instant. A single recording.toml, or its folder,
    says by itself when each frame was exposed. Of a single camera, the lens is found. Of several, two must see the
    board at a time, and the pairs must join all cameras. Of the board only --square must be stated: whether it is a
    ChArUco board or a chessboard, its squares, markers and dictionary are found in the images; --squares states
    them. With --points, VIDEO is a recording with detections, or a CSV file; with --pairs there is none.

    Of points of known place, each camera needs at least four that are not on one line. Twelve that are spread over the
    image and in depth are good. Points that disagree with the others are left out, and shown.

    \b
    Examples:
      psotrack calibrate rig my_lab/board --square 0.04 --out my_lab/rig.toml
      psotrack calibrate rig cam_0.mp4 cam_1.mp4 --squares 4x5 --square 0.054 --marker 0.0405 --out rig.toml
      psotrack calibrate rig a b --squares 6x6 --marker 0.09 --separation 0.03 --dictionary apriltag_36h11 --out r.toml
      psotrack calibrate rig a b --squares 1x1 --marker 0.2 --first-marker 7 --lenses lenses.toml --out rig.toml
      psotrack calibrate rig board.avi --square 0.04 --lens fisheye --out lens.toml
      psotrack calibrate rig SEQ --points --lenses lenses.toml --distance left,right=4.20 --out rig.toml
      psotrack calibrate rig --pairs pairs.csv --lenses lenses.toml --out rig.toml
      psotrack calibrate rig --pairs pairs.csv --places points.csv --fov 92.4,60.8 --size 1920,1080 --out rig.yml
      psotrack calibrate rig SEQ --markers SEQ/aruco_corners.csv --lenses lenses.toml --out rig.toml

    Options:
        plot: save a picture of where cameras saw the board. None: beside OUT, as .png.
        out: file to write, which ends in .toml, .yml or .csv.
    """
    from psotrack import api

    output.refuse(out)
    settings = {
        name: value for record in (board, lens, world, points) for name, value in vars(record).items()
    }
    if plot is not None:
        plot = plot if plot.name else out.with_suffix(".png")
    written: dict[str, Any] = {"plot": plot, "force": output.force, "progress": output.report}
    output.result(api.calibrate_rig(sources, out=out, **written, **settings))
