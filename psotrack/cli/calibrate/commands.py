"""`psotrack calibrate rig` and `convert`, and `psotrack doctor`: rigs from boards or points, files, and checks."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from psotrack import geometry
from psotrack.calibration import clocks
from psotrack.calibration.rig.settings import BoardSettings, LensSettings, PointSettings, WorldSettings
from psotrack.cli.commands import OptionGroup, command
from psotrack.cli.options import Bodies, Cache, Jobs, Plot, Seq, cache_folder, detections_of
from psotrack.cli.output import Output
from psotrack.cli.types import says
from psotrack.errors import SettingsError, errors_name
from psotrack.geometry import rig_files
from psotrack.recordings import datasets, exchange
from psotrack.support import POSITION, format_numbers


@command(without=["progress"])
def convert(
    output: Output,
    source: Annotated[Path, says(metavar="IN")],
    out: Annotated[Path, says(metavar="OUT")],
    *,
    size: tuple[int, int] | None = None,
    units: Annotated[str | None, says(metavar="m|cm|mm")] = None,
    format: Annotated[str | None, says(metavar="NAME")] = None,
    to: Annotated[str | None, says(metavar="NAME")] = None,
    lenses: bool = False,
    undistorted: bool = False,
    distortion: Annotated[Path | None, says(metavar="FILE")] = None,
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
      psotrack calibrate convert dltcoefs.csv rig.toml --units m --size 1920,1080 --distortion lenses.txt
      psotrack calibrate convert rig.toml half.toml --size 960,540

    Options:
        size: size of the images in pixels. If IN states another one of the same shape, the lenses are rescaled, which
            is right where the images of both sizes show the same field of view.
        units: unit of the lengths in IN; needed if the format leaves the unit open.
        format: format of IN. None: found by the content.
        to: format of OUT. None: by the name of OUT.
        lenses: convert only the lenses; IN need not have poses.
        undistorted: set the distortion to zero: the videos are undistorted already.
        distortion: calibration of any format whose distortion the cameras get, by name: for DLT coefficients of points
            that were undistorted with it.
    """
    import numpy as np

    if units is not None and units not in rig_files.UNITS_M:
        raise SettingsError("--units", expected=f"one of {', '.join(rig_files.UNITS_M)}", found=units)
    if lenses:
        rig = rig_files.read_lenses(source, size, file_format=format)
    else:
        metres = None if units is None else rig_files.UNITS_M[units]
        rig = rig_files.read_rig(source, size, metres_per_unit=metres, file_format=format)
    if distortion is not None:
        if undistorted or lenses:
            raise SettingsError(
                "--distortion", expected="neither --undistorted nor --lenses", found="one of them"
            )
        with errors_name(distortion):
            own = rig_files.read_lenses(distortion, size).select(rig.names).cameras
        # The focal length stays: it is that with which the coefficients were found.
        rig = geometry.Rig(rig.names, replace(rig.cameras, dist=own.dist, fisheye=own.fisheye))
    calibrated_wh = np.unique(rig.cameras.image_size_wh, axis=0)
    if size is not None and (calibrated_wh != size).any():
        shapes = " and ".join(f"{width:.0f} x {height:.0f}" for width, height in calibrated_wh)
        # A side is a whole number of pixels.
        if (np.abs(calibrated_wh[:, 1] * size[0] / calibrated_wh[:, 0] - size[1]) >= 1).any():
            expected = f"a size of the shape of {shapes} pixels, as {source.name} states"
            raise SettingsError("--size", expected=expected, found="{},{}".format(*size))
        rig = geometry.Rig(rig.names, geometry.scale_lens(rig.cameras, size))
        output.say(
            f"rescaled from {shapes} to {size[0]} x {size[1]} pixels: both must show the same field of view"
        )
    if undistorted:
        rig = geometry.Rig(rig.names, replace(rig.cameras, dist=rig.cameras.dist[:, :0], fisheye=None))
    rig_files.write_rig(out, rig, force=output.force, file_format=to, placed=not lenses)
    _show(output, rig, out, placed=not lenses)


def _show(output: Output, rig: geometry.Rig, out: Path, *, placed: bool) -> None:
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


#: Exit code if something was found.
FOUND = 1
_Bounds = tuple[float, float, float, float, float, float]


@command()
def doctor(
    output: Output,
    sequence: Seq,
    *,
    detections: Annotated[str | None, says(metavar="yolo|blobs|FOLDER")] = None,
    bounds_m: Annotated[_Bounds | None, says(metavar="X0,X1,Y0,Y1,Z0,Z1")] = None,
    tracks: Annotated[Path | None, says(metavar="TRACKS")] = None,
    max_offset_s: float = 2.0,
    bodies: Bodies,
    cache: Cache = None,
    jobs: Jobs = None,
) -> None:
    """Check the calibration of SEQ against the detections of its cameras, before tracking.

    Reports which camera, pair of cameras or file disagrees, by how much, and what to do. It finds a camera that is
    turned, moved or late, has another focal length, or is exchanged with another camera; camera centres that were read
    as translations; millimetres that were read as metres; mirrored axes; a reference that is far from what the
    cameras see. A video is late if its frame i shows what the others show in an earlier frame.

    A fault is named only if it explains the detections clearly better than a sound rig, whose boxes may have
    correlated errors: the middle of a lopsided body's box is not the same point for two cameras. If faults of several
    cameras explain them equally well, as often with two or three cameras, all are listed and none is certain.

    With --tracks, the offset of the reference's clock minimises the mean distance between TRACKS and the reference, to
    a fraction of a frame. Each drone may have a constant lever arm.

    The exit code is 0 if nothing was found, 1 if something was found, and 2 for an error.

    \b
    Examples:
      psotrack doctor my_lab
      psotrack doctor data/Real_Data/R12_D4 --detections blobs --json -
      psotrack doctor data/Real_Data/R12_D4 --tracks tracks.csv --max-offset 10

    Options:
        detections: detections in dl_data, blobs of the foreground, or a folder of files in the layout of dl_data. None:
            yolo where there are some, else blobs.
        bounds_m: bounds of the room in metres. None: far around the cameras, above and below.
        tracks: find the offset between the clocks of SEQ's reference and of its videos instead, from the motion in
            these tracks.
        max_offset_s: largest offset that is tried in seconds, in both directions, with --tracks.
    """
    from psotrack import api

    recording = datasets.open_recording(sequence, bodies=bodies)
    if tracks is not None:
        estimate = exchange.read_tracks(tracks, recording=recording)
        with errors_name(f"{tracks} and {recording.folder}"):
            output.result(clocks.reference_offset(recording, estimate, max_offset_s=max_offset_s))
        return
    diagnosis = api.doctor(
        recording,
        detections=detections or detections_of(output, recording),
        bounds_m=bounds_m,
        cache=cache_folder(cache),
        jobs=jobs,
        progress=output.report,
    )
    output.result(diagnosis)
    if output.quiet:
        output.say(*map(str, diagnosis.findings), always=True)
    if diagnosis.findings:
        sys.exit(FOUND)
