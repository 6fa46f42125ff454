"""The table of formats: sound files, the public functions that read them, and a command that does.

Small files lie in tests/data/formats, and are copied; the others are written here.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import archives_made
import cv2
import dpjait_folders
import numpy as np
import onnx_models
import worlds

from fuzz.mutations import Change, columns, members
from psotrack import calibration, inside_out, recordings, simulation
from psotrack.errors import errors_name
from psotrack.foreground.detection import DetectorSettings, OnnxDetector
from psotrack.foreground.silhouettes import compute
from psotrack.geometry.rig_files import read_lenses, read_rig
from psotrack.pipeline import archives
from psotrack.recordings import datasets, exchange, mocap
from psotrack.show import flights
from psotrack.sweeps import Store, read_grid
from psotrack.trajectories import read_trajectories

Read = Callable[[Path], object]

SOUND = Path(__file__).parents[1] / "data" / "formats"
#: An image size for the calibrations that have none.
SIZE_WH = (1280, 720)
_CONVERT = "calibrate convert {file} {out}/rig.toml --size 1280,720"
_EXPORT = "export {file} --to json --out {out}/tracks.json"
_INFO = "init --show {folder}"
_MAP = "onboard map {file} --out {out}/corners.csv"


@dataclass(frozen=True)
class Format:
    """A format of files.

    Attributes:
        make: fills an empty folder with sound files.
        file: path in the folder of the file that is changed.
        reads: public functions that read the file; they get its path, and the path of an empty folder with `out`.
        command: arguments of `psotrack`, with {file}, {folder} and {out}; "" for none.
        inside: change of what the file, a container, holds.
        is_refused: whether the sound file is refused, because what it names does not exist.
        is_slow: whether a try is slow; the tests make one try of the format.
    """

    make: Callable[[Path], object]
    file: str
    reads: tuple[Read, ...]
    command: str = ""
    inside: Change | None = None
    is_refused: bool = False
    is_slow: bool = False


def _copied(name: str) -> Callable[[Path], object]:
    return lambda folder: shutil.copytree(SOUND / name, folder, dirs_exist_ok=True)


def _stored(path: str, *reads: Read, command: str = "", inside: Change | None = None) -> Format:
    """A format whose sound files are copied; the path is the name of their folder, and the file."""
    name, _, file = path.partition("/")
    return Format(_copied(name), file, reads, command, inside)


# --- calibrations


def _rig(path: Path) -> object:
    return read_rig(path, SIZE_WH, metres_per_unit=1.0)


def _lenses(path: Path) -> object:
    return read_lenses(path, SIZE_WH)


def _calibration(path: str, words: str = "") -> Format:
    return _stored(path, _rig, _lenses, command=f"{_CONVERT} {words}")


_CALIBRATIONS = {
    "rig.toml": _calibration("rig.toml/rig.toml", "--size 320,240"),
    "opencv-yaml": _calibration("opencv-yaml/rig.yml", "--size 320,240"),
    "caliscope": _calibration("caliscope/camera_array.toml", "--size 320,240"),
    "anipose": _calibration("anipose/calibration.toml", "--size 320,240"),
    "dpjait-cameras": _calibration("dpjait-cameras/cameras.csv"),
    "opencv-json": _calibration("opencv-json/rig.json", "--units m"),
    "opencv-stereo-yaml": _calibration("opencv-stereo/extrinsics.yml", "--units m"),
    "opencv-stereo-xml": _calibration("opencv-stereo/intrinsics.xml", "--units m"),
    "pose2sim": _calibration("pose2sim/calib.toml"),
    "qualisys": _calibration("qualisys/a.qca.txt"),
    "vicon": _calibration("vicon/a.xcp"),
    "easymocap-lenses": _calibration("easymocap/intri.yml"),
    "easymocap-poses": _calibration("easymocap/extri.yml"),
    "kalibr": _calibration("kalibr/camchain.yaml"),
    "dlt": _calibration("dlt/dlt.csv", "--units m"),
    "handpose-lenses": _calibration("handpose/c0.dat", "--units m"),
    "handpose-poses": _calibration("handpose/rot_trans_c1.dat", "--units m"),
    "ros": _stored("ros/head.yaml", _lenses, command=f"{_CONVERT} --lenses"),
    "argus": _stored("argus/profile.txt", _lenses, command=f"{_CONVERT} --lenses"),
}


# --- tracks


def _exported(to: str, out: str, file: str | None = None, inside: Change | None = None) -> Format:
    """Tracks in a format of `export`; `file` is the file in the folder `out`."""

    def make(folder: Path) -> None:
        exchange.export_tracks(worlds.make_tracks(), to, folder / out)

    def read(path: Path) -> object:
        whole = path.parents[len(Path(file).parts) - 1] if file else path
        return exchange.read_tracks(whole)

    command = f"export {{folder}}/{out} --to json --out {{out}}/tracks.json"
    return Format(make, f"{out}/{file}" if file else out, (read,), command, inside)


def _of_run(path: Path) -> object:
    return flights.read_tracks_file(path.with_suffix(".csv"), "a")


_TRACKS = {
    "tracks-csv": _stored(
        "tracks/tracks.csv", partial(read_trajectories, fps=25.0), exchange.read_tracks, command=_EXPORT
    ),
    "tracks-parquet": _exported("parquet", "tracks.parquet", inside=columns),
    "tracks-json": _exported("json", "tracks.json"),
    "tum": _exported("tum", "tum", "1.tum"),
    "kitti": _exported("kitti", "kitti", "poses/1.txt"),
    "kitti-times": _exported("kitti", "kitti", "sequences/1/times.txt"),
    "mot": _stored("mot/tracks.txt", exchange.read_tracks, command=_EXPORT),
    "mot-rate": _stored(
        "mot/seqinfo.ini",
        lambda path: exchange.read_tracks(path.parent / "tracks.txt"),
        command="export {folder}/tracks.txt --to json --out {out}/tracks.json",
    ),
    "tracks-c3d": _exported("c3d", "tracks.c3d"),
    "mcap": _exported("mcap", "tracks.mcap"),
    "run-record": _stored(
        "tracks/tracks.json",
        flights.read_run_record,
        _of_run,
        command="export {folder}/tracks.csv --to mcap --out {out}/tracks.mcap",
    ),
    "camera-path": _stored(
        "tracks/inside.csv",
        inside_out.read_camera_path,
        command="onboard fuse {file} {folder}/tracks.csv --out {out}/fused.csv",
    ),
}


# --- recordings


def _recording(folder: Path) -> None:
    """A recording with all kinds of files; the videos have few frames, so that a try is quick."""
    worlds.make_sequence(folder)
    _copied("recording")(folder)


def _open(path: Path) -> object:
    return datasets.open_recording(path.parent).usable()


def _part(file: str, *reads: Read) -> Format:
    return Format(_recording, file, (_open, *reads), _INFO, is_slow=True)


def _dpjait(folder: Path) -> None:
    """A small sequence of the dataset with all kinds of files."""
    dpjait_folders.make_simulated(folder)
    _copied("dpjait")(folder)


def _published(file: str, *reads: Read, inside: Change | None = None) -> Format:
    def opened(path: Path) -> object:
        recording = datasets.open_recording(path.parents[file.count("/")])
        return recording.onboard, recording.truth, recording.detections

    return Format(_dpjait, file, (opened, *reads), _INFO, inside, is_slow=True)


_RECORDINGS = {
    "recording.toml": _part("recording.toml", recordings.read_recording_file),
    "recording-rig": _part("rig.toml"),
    "recording-boxes": _part("boxes.csv", recordings.read_detections),
    "recording-times": _part("times.csv", recordings.read_timestamps),
    "recording-c3d": _part("mocap.c3d", mocap.read_c3d),
    "recording-video": _part("c0.avi"),
    "recording-reference": Format(worlds.make_sequence, "dron1.csv", (_open,), _INFO, is_slow=True),
    "dpjait-calibration": _published("cameras_calibration.csv"),
    "dpjait-poses": _published("dron1_pos_25.csv"),
    "dpjait-boxes": _published("dl_data/cam2i_s.csv", recordings.read_detections),
    "dpjait-onboard-poses": _published("dron1_cam_25.csv"),
    "dpjait-onboard-lenses": _published("drone_cameras_calibration.csv"),
    "dpjait-corners": _published("aruco_corners.csv", inside_out.read_marker_map),
}


# --- videos and images


def _video(file: str) -> Format:
    def make(folder: Path) -> None:
        random = np.random.default_rng(0)
        code = cv2.VideoWriter.fourcc(*("mp4v" if file.endswith("mp4") else "FFV1"))
        writer = cv2.VideoWriter(str(folder / file), cv2.CAP_FFMPEG, code, 25.0, (64, 48))
        for _ in range(6):
            writer.write(random.integers(0, 255, (48, 64, 3), np.uint8))
        writer.release()

    def read(path: Path) -> None:
        video = recordings.probe(path)
        for _ in recordings.read_frames(video):
            pass

    command = "onboard detect {file} --out {out}/markers.csv"
    return Format(make, file, (read,), command, is_slow=True)


def _image(file: str) -> Format:
    def make(folder: Path) -> None:
        image = np.random.default_rng(0).integers(0, 255, (20, 30, 3), np.uint8)
        cv2.imwrite(str(folder / file), image)

    reads = (recordings.read_image, recordings.read_grey, recordings.read_mask)
    return Format(make, file, reads, "onboard detect {file} --out {out}/markers.csv")


_PICTURES = {
    "avi": _video("a.avi"),
    "mp4": _video("a.mp4"),
    **{suffix: _image(f"a.{suffix}") for suffix in ("png", "jpg", "tif", "bmp")},
}


# --- tables of points and markers

_TABLES = {
    "marker-centres": _stored(
        "marker-centres/centres.csv", inside_out.read_marker_table, datasets.read_marker_centres
    ),
    "measured-corners": _stored(
        "measured-corners/corners.csv",
        inside_out.read_measured_corners,
        inside_out.read_marker_table,
        command=_MAP,
    ),
    "measured-c3d": _stored(
        "measured-c3d/room.c3d", inside_out.read_measured_corners, mocap.read_c3d, command=_MAP
    ),
    "image-points": _stored(
        "image-points/pairs.csv",
        calibration.read_image_points,
        calibration.read_world,
        command="calibrate rig --pairs {file} --fov 92.4,60.8 --size 1280,720 --out {out}/rig.toml",
    ),
    "point-views": _stored("point-views/views.csv", calibration.read_point_views),
    "world": _stored("world/world.csv", calibration.read_world),
}


# --- settings, records, archives, networks, the simulator's files


def _loaded(path: Path) -> object:
    # The world is built small; a scenario that is read but cannot be built must say so too.
    with errors_name(path):
        return simulation.build(simulation.load(path), scale=0.05)


def _drone(path: Path) -> object:
    """The scene in which a mesh is a drone."""
    model = {"drones[0].model": {"file": f"{path}"}}
    return simulation.build(simulation.change_scenario(simulation.scenario("S01_D2_A"), model), scale=0.1)


def _of_results(path: Path) -> None:
    store = Store(path.parents[1])
    store.status()
    store.rows()
    store.finished_seeds("a" * 40)


def _unpack(path: Path) -> None:
    archives.unpack(path, path.parents[2] / "out" / "unpacked")


def _unpacked(file: str, read: Read, command: str) -> Format:
    """A file of an archive that was unpacked."""

    def make(folder: Path) -> None:
        archives.unpack(archives_made.OLD, folder / "flight")

    return Format(make, f"flight/{file}", (read,), command)


def _frames_of_silhouettes(path: Path) -> object:
    (flight,) = (each for each in path.parents if each.name == "flight")
    recording = datasets.open_recording(flight).usable(silhouettes=True)
    return compute(recording, cache=flight / "none").read(0, recording.num_frames)


def _network(folder: Path) -> None:
    (folder / "a.onnx").write_bytes(onnx_models.bright_squares("v8", 64))
    (folder / "pictures").mkdir()
    cv2.imwrite(str(folder / "pictures" / "0.png"), np.zeros((48, 64, 3), np.uint8))


def _detected(path: Path) -> object:
    return OnnxDetector(path, DetectorSettings(size=64)).boxes(np.zeros((48, 64, 3), np.uint8))


_ARCHIVE = "archive {folder}/flight/tracks.csv {folder}/flight --out {out}/a.psotrack"
_OTHERS = {
    "scenario": Format(
        lambda folder: (folder / "mine.toml").write_text(simulation.preset_text("S02_D4_A")),
        "mine.toml",
        (simulation.load, _loaded),
        "simulate --scenario {file} --out {out} --scale 0.05 --frames 1 --jobs 1 --quiet",
        is_slow=True,
    ),
    "mesh-obj": _stored("mesh-obj/drone.obj", _drone),
    "mesh-ply": _stored("mesh-ply/drone.ply", _drone),
    "recorded-flight": _stored("recorded-flight/flight.csv", simulation.read_recorded_flight),
    "sticks": _stored(
        "sticks/sticks.csv",
        simulation.read_sticks,
        command="simulate fly --out {out}/flight.csv --device {file}",
    ),
    "grid": _stored(
        "grid/grid.toml",
        lambda path: read_grid(path).cells(),
        command="sweep {file} --dry-run --data {folder}",
    ),
    "config": Format(
        _copied("config"),
        "run.toml",
        (),
        "track {folder}/nowhere --config {file} --out {out}/tracks.csv",
        is_refused=True,
    ),
    "sweep-rows": _stored(
        f"results/cells/{'a' * 40}.parquet", _of_results, command="report {folder} --table", inside=columns
    ),
    "sweep-failure": _stored(
        f"results/cells/_{'c' * 40}.error.json", _of_results, command="sweep --status {folder}"
    ),
    "archive": Format(
        lambda folder: shutil.copy(archives_made.OLD, folder / "a.psotrack"),
        "a.psotrack",
        (_unpack,),
        "archive {file} --out {out}/unpacked",
        members,
    ),
    "archive-manifest": _unpacked(
        archives.MANIFEST_FILE,
        lambda path: archives.read_manifest(path.parent),
        "init --show {folder}/flight",
    ),
    "stored-silhouettes": _unpacked("silhouettes/cam1/zarr.json", _frames_of_silhouettes, _ARCHIVE),
    "stored-silhouettes-chunk": _unpacked("silhouettes/cam1/c/0/0/0", _frames_of_silhouettes, _ARCHIVE),
    "onnx": Format(
        _network,
        "a.onnx",
        (_detected,),
        "detect {folder}/pictures --detector {file} --size 64 --out {out}/boxes",
        is_slow=True,
    ),
}

#: The formats by name.
FORMATS: dict[str, Format] = {**_CALIBRATIONS, **_TRACKS, **_RECORDINGS, **_PICTURES, **_TABLES, **_OTHERS}


def make_all(folder: Path, names: Iterable[str]) -> None:
    """Write the sound files of some formats, each in a folder of its name."""
    for name in names:
        (folder / name).mkdir(parents=True)
        FORMATS[name].make(folder / name)
