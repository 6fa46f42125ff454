"""`psotrack evaluate`, `export` and `archive`: tracks and their errors, files for other programs, archives."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import click

from psotrack import support
from psotrack.calibration import clocks
from psotrack.cli.commands import OptionGroup, command
from psotrack.cli.options import DETECTOR_SIZE, Bodies, Cache, Plot, SeqOfTracks, cache_folder, sequence_of
from psotrack.cli.output import Output, check_suffix
from psotrack.cli.types import Words, says
from psotrack.errors import OutputError, SettingsError, errors_name
from psotrack.evaluation import PathSettings
from psotrack.pipeline import archives
from psotrack.recordings import datasets, exchange
from psotrack.support import ARCHIVE_SUFFIX, first_line

if TYPE_CHECKING:
    import numpy as np

    from psotrack.trajectories import Trajectories


def _offset(given: str) -> float | Literal["auto"]:
    """The value of --offset."""
    if given == "auto":
        return "auto"
    if not math.isfinite(float(given)):
        raise ValueError
    return float(given)


_PATHS = "Paths with orientations"
_NAMES = {"with_lever_arm": "lever-arm", "with_turn": "turn", "max_offset_s": "max-offset"}


@command(without=["progress"])
def evaluate(
    output: Output,
    tracks: Path,
    sequence: SeqOfTracks = None,
    *,
    plot: Plot = None,
    offset: Annotated[
        float | Literal["auto"] | None,
        says(metavar="SECONDS|auto", type=Words("SECONDS|auto", "a number of seconds, or auto", _offset)),
    ] = None,
    drone: Annotated[str | None, says(metavar="NAME", heading=_PATHS)] = None,
    orientations: Annotated[Path | None, says(heading=_PATHS)] = None,
    settings: Annotated[PathSettings, OptionGroup(_PATHS, _NAMES)],
    bodies: Bodies,
) -> None:
    """Compare TRACKS with the reference of SEQ.

    SEQ is the recording of TRACKS; the record beside TRACKS names it.

    The path of one camera or drone, as `psotrack onboard localise` writes it, is compared with its orientation, as in
    the paper's Tables 7 and 8: the offset of the clocks is searched, and distances and differences of roll, pitch and
    yaw are stated. So are all paths with --drone, and where SEQ is a file of poses: TUM, or a table.

    TRACKS is a file of `psotrack track`, or tracks of any other program: CSV, Parquet, JSON, TUM, KITTI, MOTChallenge
    with positions, C3D or MCAP, as a file or a folder.

    \b
    Examples:
      psotrack evaluate my_lab/results/tracks.csv
      psotrack evaluate tracks.csv data/Simulated_Data/S02_D4_A --json errors.json --plot errors.png
      psotrack evaluate tracks.csv data/Real_Data/R12_D4 --offset auto
      psotrack evaluate tracks.csv flight --body cf1=M1,M2,M3,M4 --body cf2
      psotrack evaluate folder_of_tum_files data/Simulated_Data/S02_D4_A
      psotrack evaluate dron1.csv data/Simulated_Data/S01_D2_A --json errors.json --plot errors.png
      psotrack evaluate gopro.csv data/Real_Data/R17_D1_A --orientations imu.tum
      psotrack evaluate slam.tum groundtruth.tum --offset 0 --no-lever-arm --no-turn

    Options:
        plot: save paths from above and from the side, and errors over time. None: beside TRACKS, as .png.
        offset: time by which the reference's clock is ahead of the videos'; auto estimates it, up to 2 s. None: 0 s;
            auto for paths with orientations.
        drone: drone of the reference that carries the camera. None: the name in TRACKS, or the only drone.
        orientations: orientations of the reference by a clock of their own, as of an IMU, as TUM.
    """
    from psotrack import evaluation
    from psotrack.evaluation import plots, tables

    sequence = sequence_of(tracks, sequence)
    picture = None if plot is None else plot if plot.name else tracks.with_suffix(".png")
    output.refuse(picture)
    is_poses = sequence.is_file() and sequence.suffix.lower() not in (".toml", ".c3d")
    if is_poses or drone is not None or orientations is not None or _is_camera_path(tracks):
        path = evaluation.drone_of(exchange.read_tracks(tracks), drone)
        reference = (
            exchange.read_tracks(sequence)
            if is_poses
            else clocks.own_reference(datasets.open_recording(sequence, bodies=bodies))
        )
        turns = None if orientations is None else evaluation.drone_of(exchange.read_tracks(orientations))
        with errors_name(f"{tracks} and {sequence}"):
            body = evaluation.drone_of(reference, drone or path.drones[0])
            offset_s = None if offset == "auto" else offset
            compared = evaluation.compare_paths(path, body, turns, settings, offset_s=offset_s)
        output.json(compared.to_dict())
        output.say(*tables.paths_as_text(compared, f"{tracks.name} and {sequence.name}").splitlines())
        if picture is not None:
            plots.save_paths(picture, {tracks.stem: compared}, force=output.force)
            output.say(f"{picture}: paths, and errors over time")
        return
    recording = datasets.open_recording(sequence, bodies=bodies)
    estimate = exchange.read_tracks(tracks, recording=recording)
    with errors_name(f"{tracks} and {sequence}"):
        truth, by_s = clocks.reference_for(recording, estimate, offset)
        found = evaluation.evaluate(estimate, truth)
    output.json(found.to_dict() | ({} if offset is None else {"reference_offset_s": by_s}))
    clock = "" if offset is None else f", reference's clock {by_s:+.4f} s"
    output.say(*tables.as_text(found, f"{recording.name}{clock}").splitlines())
    if picture is not None:
        plots.save_overview(picture, estimate, truth, force=output.force)
        output.say(f"{picture}: paths, and errors over time")


def _is_camera_path(tracks: Path) -> bool:
    """Whether a file is a table of `psotrack onboard localise`."""
    return tracks.is_file() and tracks.suffix.lower() == ".csv" and "reprojection_px" in first_line(tracks)


#: Ends of the files of formats that have one file.
_SUFFIXES = {"c3d": ".c3d", "mcap": ".mcap", "csv": ".csv", "parquet": ".parquet", "json": ".json"}
FORMAT_NAMES = ("tum", "kitti", "mot", "c3d", "mcap", "csv", "parquet", "json")


@command(without=["progress", "json_path"])
def export(
    output: Output,
    tracks: Path,
    sequence: SeqOfTracks = None,
    *,
    to: Annotated[str, says(type=click.Choice([*FORMAT_NAMES, "onnx"]))],
    out: Path | None = None,
    images: bool = False,
    drone_size_m: Annotated[tuple[float, float, float] | None, says(metavar="X,Y,Z")] = None,
    size: int = DETECTOR_SIZE,
) -> None:
    """Write TRACKS, or a network of `psotrack train`, in a format of another program.

    A line says what the format cannot hold. SEQ adds what only its cameras have: for mot the boxes in each camera, for
    mcap the cameras and with --images their images. `psotrack evaluate OUT SEQ` reads all of these formats again.

    \b
    Examples:
      psotrack export tracks.csv --to tum --out tum
      psotrack export tracks.csv --to c3d --out tracks.c3d
      psotrack export tracks.csv data/Simulated_Data/S02_D4_A --to mot --out mot
      psotrack export tracks.csv data/Simulated_Data/S02_D4_A --to mcap --out flight.mcap --images
      psotrack export drones.model --to onnx --out drones.onnx

    Options:
        to: format of the output; onnx is that of a network, which `psotrack detect` and other programs read.
        out: file of the output; a folder for tum with several drones, kitti, and mot with SEQ. None: beside TRACKS,
            with the format in its name.
        images: write the images of SEQ's cameras too; only with --to mcap.
        drone_size_m: full lengths of a drone along x, y and z, in metres, for boxes of --to mot. None: those that the
            record beside TRACKS has.
        size: height and width of the images of --to onnx, pixels, a multiple of 8.
    """
    out = out or tracks.with_name(f"{tracks.stem}_{to}{_SUFFIXES.get(to, '')}")
    _check_options(tracks, sequence, to, out, images)
    if to == "onnx":
        from psotrack.foreground.network import model_at, write_onnx

        output.refuse(out)
        write_onnx(out, model_at(tracks).network, size)
        output.say(f"{out}: a network for images of {size} x {size} pixels, in the layout v8 of YOLO")
        return
    recording = None if sequence is None else datasets.open_recording(sequence)
    trajectories = exchange.read_tracks(tracks, recording=recording)
    footage = None
    if recording is not None:
        sizes_m = _sizes_m(trajectories, tracks, drone_size_m) if to == "mot" else None
        footage = exchange.Footage(recording, sizes_m, images)
    with errors_name(tracks):
        lost = exchange.export_tracks(
            trajectories, to, out, footage=footage, force=output.force, report=output.report
        )
    left = f"; not in this format: {', '.join(lost)}" if lost else ""
    drones = f"{trajectories.num_drones} drone{'s' if trajectories.num_drones != 1 else ''}"
    output.say(f"{out}: {to}, {drones}, {trajectories.num_frames} frames{left}")


def _check_options(tracks: Path, sequence: Path | None, to: str, out: Path, images: bool) -> None:
    """Raise an error for options that do not fit each other, and for an output that would replace an input."""
    if images and (to != "mcap" or sequence is None):
        found = f"--to {to}" if to != "mcap" else "no SEQ"
        raise SettingsError("--images", expected="--to mcap and SEQ, whose images are written", found=found)
    inputs = {tracks.resolve(): "TRACKS"}
    if tracks.suffix in {".csv", ".parquet"}:
        inputs[tracks.with_suffix(".json").resolve()] = "the place of the record of TRACKS"
    if sequence is not None:
        inputs[sequence.resolve()] = "SEQ"
    if out.resolve() in inputs:
        raise OutputError(
            out,
            expected="another path than those of the inputs",
            found=inputs[out.resolve()],
            remedy="name another one; nothing was written",
        )


def _sizes_m(
    trajectories: Trajectories, tracks: Path, drone_size_m: tuple[float, ...] | None
) -> np.ndarray | None:
    """(drones, 3), sizes of the drones, as the user says or from the record beside the tracks; None if unknown."""
    import numpy as np

    if drone_size_m is not None:
        if not min(drone_size_m) > 0:
            raise SettingsError("--drone-size", expected="lengths above 0", found=f"{drone_size_m}")
        return np.tile(drone_size_m, (trajectories.num_drones, 1))
    recorded = _recorded_sizes(tracks.with_suffix(".json"))
    sizes = [recorded.get(name, (np.nan,) * 3) for name in trajectories.drones]
    size_m = np.array(sizes, float)
    return size_m if np.isfinite(size_m).all() else None


def _recorded_sizes(record: Path) -> dict[str, list[float]]:
    """Sizes by the drones' names, from the record of a run; empty where there is no record that has them."""
    if not record.exists():
        return {}
    drones = support.read_json(record, "the record of the tracks beside it").get("drones")
    # `track --causal` records the number of drones alone.
    listed = drones if isinstance(drones, list) else []
    return {str(each["drone"]): each["size_m"] for each in listed if each.get("size_m") and "drone" in each}


@command(without=["json_path"])
def archive(
    output: Output,
    tracks: Path,
    sequence: SeqOfTracks = None,
    *,
    out: Path | None = None,
    videos: bool = False,
    cache: Cache = None,
) -> None:
    """Pack TRACKS and what is needed to compute them again into one file, or unpack such a file.

    SEQ is the recording from which TRACKS were computed; the record beside TRACKS names it. The archive holds TRACKS
    and their record, the cameras, the silhouettes, the detections and the reference. `track` computes the tracks again
    from the archive. An archive as TRACKS is unpacked into a folder, which other commands take as SEQ; nothing is
    written if the archive was cut short or changed.

    \b
    Examples:
      psotrack archive my_lab/results/tracks.csv --out flight.psotrack
      psotrack archive tracks.csv my_lab --out flight.psotrack --videos
      psotrack track flight.psotrack --out again.csv
      psotrack archive flight.psotrack --out flight

    Options:
        out: the archive, which ends in .psotrack, or the folder into which one is unpacked. None: beside TRACKS, with
            the same name.
        videos: pack the videos, too. None: a digest of each video.
    """
    if tracks.suffix == ARCHIVE_SUFFIX and not tracks.is_dir():
        if sequence is not None or videos:
            found = f"{sequence}" if sequence is not None else "--videos"
            raise SettingsError("archive", expected="nothing else with an archive to unpack", found=found)
        out = out or tracks.with_suffix("")
        manifest = archives.unpack(tracks, out, force=output.force, report=output.report)
        output.say(f"{out}: {manifest.sequence}, {len(manifest.files)} files, {manifest.tracks}")
        return
    out = out or tracks.with_suffix(ARCHIVE_SUFFIX)
    check_suffix("--out", out, ARCHIVE_SUFFIX)
    recording = datasets.open_recording(sequence_of(tracks, sequence))
    manifest = archives.pack_tracks(
        tracks,
        recording,
        out,
        cache=cache_folder(cache),
        videos=videos,
        force=output.force,
        report=output.report,
    )
    packed = f"{len(manifest.files)} files, {out.stat().st_size / 1e6:.3g} MB"
    output.say(f"{out}: {packed}" + ("" if videos else ", without videos"))
