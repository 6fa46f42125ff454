"""The table of formats: sound files, the public functions that read them, and a command that does."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import archives_made
import cv2
import dpjait_folders
import numpy as np
import onnx_models
import pandas as pd
import rig_texts as rigs
import worlds
from helpers import ring_rig

from fuzz.mutations import Change, columns, members
from psotrack import calibration, inside_out, recordings, simulation
from psotrack.errors import errors_name
from psotrack.foreground.detection import DetectorSettings, OnnxDetector
from psotrack.foreground.silhouettes import compute
from psotrack.geometry.rig_files import read_lenses, read_rig, write_rig
from psotrack.pipeline import archives
from psotrack.recordings import datasets, exchange, mocap
from psotrack.recordings.datasets import (
    read_marker_centres,
    read_masks,
    write_marker_corners,
)
from psotrack.show import flights
from psotrack.simulation import build, change_scenario, read_recorded_flight, read_sticks, scenario
from psotrack.sweeps import Store, read_grid
from psotrack.trajectories import read_trajectories

Read = Callable[[Path], object]

#: An image size for the calibrations that have none.
SIZE_WH = (1280, 720)
_CONVERT = "calibrate convert {file} {out}/rig.toml --size 1280,720"
_EXPORT = "export {file} --to json --out {out}/tracks.json"
_INFO = "init --show {folder}"


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


# --- calibrations


def _rig(path: Path) -> object:
    return read_rig(path, SIZE_WH, metres_per_unit=1.0)


def _lenses(path: Path) -> object:
    return read_lenses(path, SIZE_WH)


def _calibration(make: Callable[[Path], object], file: str, units: str = "") -> Format:
    return Format(make, file, (_rig, _lenses), f"{_CONVERT}{units and f' --units {units}'}")


def _only_lenses(file: str, text: str) -> Format:
    return Format(_text(file, text), file, (_lenses,), f"{_CONVERT} --lenses")


def _written(file: str, file_format: str | None = None) -> Format:
    def make(folder: Path) -> None:
        write_rig(folder / file, ring_rig(2, coefficients=5), file_format=file_format)

    return _calibration(make, file)


def _text(file: str, text: str) -> Callable[[Path], object]:
    return lambda folder: (folder / file).write_text(text, encoding="utf-8")


_VICON = 'VICON_RADIAL2="ViconRadial2 650.5 350.25 0.06 -0.01"'
_CALIBRATIONS = {
    "rig.toml": _written("rig.toml"),
    "opencv-yaml": _written("rig.yml"),
    "caliscope": _written("camera_array.toml"),
    "anipose": _written("calibration.toml", "anipose"),
    "dpjait-cameras": _calibration(
        _text(
            "cameras.csv",
            f"{dpjait_folders.REAL_HEADER}\n55260362;-100;250.5;6000;1.9;0.1;0;1158.7;640;360;-0.1;0.02;0.001;-0.002\n"
            "56339527;100;250.5;6000;1.9;-0.1;0;1158.7;640;360;-0.1;0.02;0.001;-0.002\n",
        ),
        "cameras.csv",
    ),
    "opencv-json": _calibration(rigs.json_file, "rig.json", "m"),
    "opencv-stereo-yaml": _calibration(rigs.storage_files, "extrinsics.yml", "m"),
    "opencv-stereo-xml": _calibration(rigs.storage_files, "intrinsics.xml", "m"),
    "ros": _only_lenses("head.yaml", rigs.ros_text()),
    "pose2sim": _calibration(lambda folder: rigs.pose2sim_file(folder / "calib.toml"), "calib.toml"),
    "qualisys": _calibration(lambda folder: rigs.qualisys_file(folder / "a.qca.txt"), "a.qca.txt"),
    "vicon": _calibration(lambda folder: rigs.vicon_file(folder / "a.xcp", _VICON), "a.xcp"),
    "easymocap-lenses": _calibration(rigs.easymocap_files, "intri.yml"),
    "easymocap-poses": _calibration(rigs.easymocap_files, "extri.yml"),
    "kalibr": _calibration(lambda folder: rigs.kalibr_file(folder / "camchain.yaml"), "camchain.yaml"),
    "dlt": _calibration(
        lambda folder: rigs.dlt_file(folder / "dlt.csv", rigs.dlt_columns(upwards=True)), "dlt.csv", "m"
    ),
    "handpose-lenses": _calibration(rigs.handpose_files, "c0.dat", "m"),
    "handpose-poses": _calibration(rigs.handpose_files, "rot_trans_c1.dat", "m"),
    "argus": _only_lenses(
        "profile.txt",
        "1 1165.5 1920 1080 960 540 1 -0.2 0.05 0.001 0.002 0.01\n2 800 1280 720 640 360 1 0 0 0 0 0\n",
    ),
}


# --- tracks


def _exported(to: str, out: str, file: str | None = None, inside: Change | None = None) -> Format:
    """Tracks in a format of `export`; `file` is the file in the folder `out`."""

    def make(folder: Path) -> None:
        exchange.export_tracks(worlds.make_tracks(), to, folder / out)
        if to == "mot":
            (folder / "seqinfo.ini").write_text("[Sequence]\nname=a\nframeRate=25\nseqLength=14\n")

    def read(path: Path) -> object:
        whole = path.parents[len(Path(file).parts) - 1] if file else path
        return exchange.read_tracks(whole)

    command = f"export {{folder}}/{out} --to json --out {{out}}/tracks.json"
    return Format(make, f"{out}/{file}" if file else out, (read,), command, inside)


def _mot_info(folder: Path) -> None:
    _exported("mot", "tracks.txt").make(folder)


_TRACKS = {
    "tracks-csv": Format(
        lambda folder: worlds.make_tracks_file(folder / "tracks.csv"),
        "tracks.csv",
        (partial(read_trajectories, fps=25.0), exchange.read_tracks),
        _EXPORT,
    ),
    "tracks-parquet": _exported("parquet", "tracks.parquet", inside=columns),
    "tracks-json": _exported("json", "tracks.json"),
    "tum": _exported("tum", "tum", "1.tum"),
    "kitti": _exported("kitti", "kitti", "poses/1.txt"),
    "kitti-times": _exported("kitti", "kitti", "sequences/1/times.txt"),
    "mot": _exported("mot", "tracks.txt"),
    "mot-rate": Format(
        _mot_info,
        "seqinfo.ini",
        (lambda path: exchange.read_tracks(path.parent / "tracks.txt"),),
        "export {folder}/tracks.txt --to json --out {out}/tracks.json",
    ),
    "tracks-c3d": _exported("c3d", "tracks.c3d"),
    "mcap": _exported("mcap", "tracks.mcap"),
    "run-record": Format(
        lambda folder: worlds.make_tracks_file(folder / "tracks.csv"),
        "tracks.json",
        (flights.read_run_record, lambda path: flights.read_tracks_file(path.with_suffix(".csv"), "a")),
        "export {folder}/tracks.csv --to mcap --out {out}/tracks.mcap",
    ),
}


# --- recordings


def _recording(folder: Path) -> None:
    """A recording with all kinds of files; the videos have few frames, so that a try is quick."""
    worlds.make_sequence(folder)
    rows = "".join(f"{frame},{10 + frame},20,12,10,16,25,0.9\n" for frame in range(worlds.NUM_FRAMES))
    (folder / "boxes.csv").write_text(rows)
    times = "".join(f"{frame},{frame / worlds.RATE_HZ}\n" for frame in range(worlds.NUM_FRAMES))
    (folder / "times.csv").write_text(f"frame,time_s\n{times}")
    labels = tuple(f"{body}:{body}{i}" for body in ("dronA", "dronB") for i in range(4))
    cross_m = np.array([[0.1, 0, 0], [0, 0.12, 0], [-0.15, 0, 0], [0, -0.1, 0.05]])
    position_m = np.concatenate([cross_m + np.array([x, 0, 1.2]) for x in (-0.6, 0.6)])
    moved_m = position_m + 0.01 * np.arange(20)[:, None, None]
    mocap.write_c3d(folder / "mocap.c3d", mocap.Markers(labels, moved_m, 50.0))
    write_marker_corners(folder / "corners.csv", _corners())
    text = (folder / "recording.toml").read_text()
    text = text.replace('video = "c1.avi"', 'video = "c1.avi"\ntimestamps = "times.csv"')
    text = text.replace('video = "c2.avi"', 'video = "c2.avi"\nline_time_s = 1e-5\ndetections = "boxes.csv"')
    files = ", ".join(f'"{name}.csv"' for name in worlds.REFERENCE)
    text = text.replace(f"files = [{files}]", 'files = ["mocap.c3d"]\ntime_offset_s = 0.01')
    text += '[markers]\ncorners = "corners.csv"\n[world]\nbounds_m = [[-3, -3, 0], [3, 3, 3]]\n'
    (folder / "recording.toml").write_text(text)


def _corners() -> Mapping[int, np.ndarray]:
    square = np.array([[0, 2, 1.2], [0.2, 2, 1.2], [0.2, 2, 1.0], [0, 2, 1.0]])
    return {marker: square + np.array([marker, 0, 0]) for marker in (0, 1, 7)}


def _csv_recording(folder: Path) -> None:
    worlds.make_sequence(folder)


def _open(path: Path) -> object:
    return datasets.open_recording(path.parent).usable()


def _part(file: str, *reads: Read) -> Format:
    return Format(_recording, file, (_open, *reads), _INFO, is_slow=True)


def _dpjait(folder: Path) -> None:
    """A small sequence of the dataset with all kinds of files."""
    dpjait_folders.make_simulated(folder)
    write_marker_corners(folder / "aruco_corners.csv", _corners())
    mask = cv2.imencode(".png", np.eye(8, dtype=np.uint8) * 255)[1].tobytes()
    with zipfile.ZipFile(folder / "drone_masks.zip", "w") as archive:
        for frame in range(3):
            archive.writestr(f"cam1i/dron1/{frame:06d}.png", mask)


def _all_masks(path: Path) -> None:
    with read_masks(path) as masks:
        for frame in masks.frames:
            masks.mask("cam1i", 1, frame)


def _published(file: str, *reads: Read, inside: Change | None = None) -> Format:
    opened = (_open_root,) if "/" not in file else (lambda path: _open_root(path.parent),)
    return Format(_dpjait, file, (*opened, *reads), _INFO, inside, is_slow=True)


def _open_root(path: Path) -> object:
    recording = datasets.open_recording(path.parent)
    return recording.onboard, recording.truth, recording.detections


_RECORDINGS = {
    "recording.toml": _part("recording.toml", recordings.read_recording_file),
    "recording-rig": _part("rig.toml"),
    "recording-boxes": _part("boxes.csv", recordings.read_detections),
    "recording-times": _part("times.csv", recordings.read_timestamps),
    "recording-c3d": _part("mocap.c3d", mocap.read_c3d),
    "recording-video": _part("c0.avi"),
    "recording-reference": Format(_csv_recording, "dron1.csv", (_open,), _INFO, is_slow=True),
    "dpjait-calibration": _published("cameras_calibration.csv"),
    "dpjait-poses": _published("dron1_pos_25.csv"),
    "dpjait-boxes": _published("dl_data/cam2i_s.csv", recordings.read_detections),
    "dpjait-onboard-poses": _published("dron1_cam_25.csv"),
    "dpjait-onboard-lenses": _published("drone_cameras_calibration.csv"),
    "dpjait-corners": _published("aruco_corners.csv", inside_out.read_marker_map),
    "dpjait-masks": _published("drone_masks.zip", _all_masks, inside=members()),
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
        recordings.check_end(video)
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
    "png": _image("a.png"),
    "jpg": _image("a.jpg"),
    "tif": _image("a.tif"),
    "bmp": _image("a.bmp"),
}


# --- tables of points and markers


def _path_of_camera(folder: Path) -> None:
    count, time_s = 12, np.arange(12) / 25
    position_m = np.column_stack([np.cos(time_s), np.sin(time_s), 1 + time_s])
    inside_out.write_camera_path(
        folder / "inside.csv",
        inside_out.CameraPath(
            frame=np.arange(count),
            time_s=time_s,
            position_m=position_m,
            orientation_wxyz=np.tile([1.0, 0, 0, 0], (count, 1)),
            covariance=np.tile(1e-4 * np.eye(6), (count, 1, 1)),
            num_markers=np.full(count, 3),
            reprojection_px=np.full(count, 0.4),
            ambiguity=np.zeros(count),
            status=np.zeros(count, int),
            flags=np.zeros(count, int),
        ),
        "dron1",
    )
    worlds.make_tracks_file(folder / "tracks.csv")


def _table(file: str, text: str, *reads: Read, command: str = "") -> Format:
    return Format(_text(file, text), file, reads, command)


#: A tetrahedron of 0.2 m as a drone, in both formats of meshes.
_OBJ = "v 0 0 0\nv 0.2 0 0\nv 0 0.2 0\nv 0 0 0.2\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"
_PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "element face 4\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n0.2 0 0\n0 0.2 0\n0 0 0.2\n"
    "3 0 2 1\n3 0 1 3\n3 1 2 3\n3 2 0 3\n"
)


def _drone(path: Path) -> object:
    """The scene in which a mesh is a drone."""
    recipe = change_scenario(scenario("S01_D2_A"), {"drones[0].model": {"file": f"{path}"}})
    return build(recipe, scale=0.1)


def _marks() -> str:
    """Points marked in the images of two cameras."""
    rng = np.random.default_rng(0)
    points_m = rng.uniform((-1, -1, 0), (1, 1, 2), (9, 3))
    rows = ["camera,point,x_px,y_px,x_m,y_m,z_m"]
    for name, (R, t) in zip(("left", "right"), rigs.poses(), strict=True):
        seen = points_m @ R.T + t
        pixels = seen[:, :2] / seen[:, 2:] * 620 + (639.5, 359.5)
        rows += [
            f"{name},p{i},{x},{y},{m[0]},{m[1]},{m[2]}"
            for i, ((x, y), m) in enumerate(zip(pixels, points_m, strict=True))
        ]
    return "\n".join(rows)


_VIEWS = "camera,frame,x_px,y_px,point\n" + "".join(
    f"{camera},{frame},{100 + frame},{50.5 + frame},{end}\n"
    for camera in ("left", "right")
    for frame in range(4)
    for end in "ab"
)
_CENTRES = "id,x_m,y_m,z_m\n1,0,2,1\n2,0.5,2,1\n7,1,2,1.2\n"
_TABLES = {
    "camera-path": Format(
        _path_of_camera,
        "inside.csv",
        (inside_out.read_camera_path,),
        "onboard fuse {file} {folder}/tracks.csv --out {out}/fused.csv",
    ),
    "marker-centres": _table("centres.csv", _CENTRES, inside_out.read_marker_table, read_marker_centres),
    "measured-corners": Format(
        lambda folder: write_marker_corners(folder / "corners.csv", _corners()),
        "corners.csv",
        (inside_out.read_measured_corners, inside_out.read_marker_table),
        "onboard map {file} --out {out}/corners.csv",
    ),
    "measured-c3d": Format(
        lambda folder: mocap.write_c3d(
            folder / "room.c3d",
            mocap.Markers(
                tuple(f"Marker{marker}:{corner + 1}" for marker in _corners() for corner in range(4)),
                np.tile(np.concatenate(list(_corners().values())), (3, 1, 1)),
                100.0,
            ),
        ),
        "room.c3d",
        (inside_out.read_measured_corners, mocap.read_c3d),
        "onboard map {file} --out {out}/corners.csv",
    ),
    "image-points": _table(
        "pairs.csv",
        _marks(),
        calibration.read_image_points,
        calibration.read_world,
        command="calibrate rig --pairs {file} --fov 92.4,60.8 --size 1280,720 --out {out}/rig.toml",
    ),
    "point-views": _table("views.csv", _VIEWS, calibration.read_point_views),
    "world": _table(
        "world.csv", "point,x_m,y_m,z_m\na,0,0,1\nb,1,0,1\nc,0,1,1\nd,1,1,2\n", calibration.read_world
    ),
}


# --- settings, records, archives, networks


def _loaded(path: Path) -> object:
    # The world is built small; a scenario that is read but cannot be built must say so too.
    with errors_name(path):
        return simulation.build(simulation.load(path), scale=0.05)


_OBJ = "".join(f"v {x} {y} {z}\n" for x in (-0.2, 0.2) for y in (-0.2, 0.2) for z in (-0.1, 0.1)) + (
    "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
)


def _mesh(folder: Path) -> None:
    text = simulation.preset_text("S01_D2_A")
    (folder / "mesh.obj").write_text(_OBJ)
    (folder / "scenario.toml").write_text(text)


def _mesh_of(path: Path) -> object:
    recipe = simulation.load(path.parent / "scenario.toml")
    model = {"file": str(path), "scale": 1.0}
    with errors_name(path):
        return simulation.build(simulation.change_scenario(recipe, {"drones[0].model": model}), scale=0.05)


_GRID = """sequences = ["S01_D2_A", "S02_D4_A"]
runs = 3
first_seed = 1
[settings]
swarm.particles = 8
swarm.kind = "joint"
init = "truth"
drones.size_m = [0.5, 0.5, 0.2]
[methods.swarm]
swarm.search = "pso"
[grid]
swarm.iterations = [10, 20]
"""
_CONFIG = """command = "track"
SEQ = "nowhere"
particles = 20
iterations = 10
cameras = "cam1,cam2"
size = [0.4, 0.4, 0.2]
swarm = "joint"
out = "tracks.csv"
"""


_FIGURES = ("track_ms_per_frame", "hota", "offset_removed_mean_error_m", "p95_error_m", "missed_rate")


def _results(folder: Path) -> None:
    store = Store(folder)
    for key in ("a" * 40, "b" * 40):
        rows = pd.DataFrame(
            {
                "cell": key,
                "sequence": "S01",
                "method": "swarm",
                "seed": [0, 1],
                "mean_error_m": [0.01, 0.02],
                "settings.swarm.particles": [8, 8],
                **{figure: [0.5, 0.25] for figure in _FIGURES},
            }
        )
        store.add(key, rows)
    store.add_failure("c" * 40, "no file", {"sequence": "S03", "method": "swarm"})


def _of_results(path: Path) -> None:
    store = Store(path.parents[1])
    store.status()
    store.rows()
    store.finished_seeds("a" * 40)


def _stored(file: str, command: str, inside: Change | None = None) -> Format:
    return Format(_results, file, (_of_results,), command, inside)


def _archive(folder: Path) -> None:
    shutil.copy(archives_made.OLD, folder / "a.psotrack")


def _unpack(path: Path) -> None:
    archives.unpack(path, path.parents[2] / "out" / "unpacked")


def _network(folder: Path) -> None:
    (folder / "a.onnx").write_bytes(onnx_models.bright_squares("v8", 64))
    (folder / "pictures").mkdir()
    cv2.imwrite(str(folder / "pictures" / "0.png"), np.zeros((48, 64, 3), np.uint8))


def _detected(path: Path) -> object:
    return OnnxDetector(path, DetectorSettings(size=64)).boxes(np.zeros((48, 64, 3), np.uint8))


def _unpacked(file: str) -> Format:
    """Silhouettes of a camera in an archive that was unpacked."""
    return Format(
        lambda folder: archives.unpack(archives_made.OLD, folder / "flight"),
        f"flight/silhouettes/cam1/{file}",
        (_frames_of_silhouettes,),
        "archive {folder}/flight/tracks.csv {folder}/flight --out {out}/a.psotrack",
    )


def _frames_of_silhouettes(path: Path) -> object:
    (flight,) = (each for each in path.parents if each.name == "flight")
    recording = datasets.open_recording(flight).usable(silhouettes=True)
    return compute(recording, cache=flight / "none").read(0, recording.num_frames)


_FLIGHT = "frame,time_s,drone,x_m,y_m,z_m\n" + "".join(
    f"{i},{i / 25},a,{i / 50},0.5,1.25\n" for i in range(12)
)
_STICKS = "time_s,forward,left,up,turn\n0,0,0,0,0\n0.2,0.5,0,0.25,-0.5\n0.4,-1,1,0,0\n0.6,0,0,0,0\n"
_OTHERS = {
    "scenario": Format(
        lambda folder: (folder / "mine.toml").write_text(simulation.preset_text("S02_D4_A")),
        "mine.toml",
        (simulation.load, _loaded),
        "simulate --scenario {file} --out {out} --scale 0.05 --frames 1 --jobs 1 --quiet",
        is_slow=True,
    ),
    "mesh": Format(_mesh, "mesh.obj", (_mesh_of,), is_slow=True),
    "grid": Format(
        _text("grid.toml", _GRID),
        "grid.toml",
        (lambda path: read_grid(path).cells(),),
        "sweep {file} --dry-run --data {folder}",
    ),
    "config": Format(
        _text("run.toml", _CONFIG),
        "run.toml",
        (),
        "track {folder}/nowhere --config {file} --out {out}/tracks.csv",
        is_refused=True,
    ),
    "sweep-rows": _stored(f"cells/{'a' * 40}.parquet", "report {folder} --table", columns),
    "sweep-failure": _stored(f"cells/_{'c' * 40}.error.json", "sweep --status {folder}"),
    "archive": Format(
        _archive,
        "a.psotrack",
        (_unpack,),
        "archive {file} --out {out}/unpacked",
        members(),
    ),
    "stored-silhouettes": _unpacked("zarr.json"),
    "stored-silhouettes-chunk": _unpacked("c/0/0/0"),
    "mesh-obj": _table("drone.obj", _OBJ, _drone),
    "mesh-ply": _table("drone.ply", _PLY, _drone),
    "recorded-flight": Format(_text("flight.csv", _FLIGHT), "flight.csv", (read_recorded_flight,)),
    "sticks": Format(
        _text("sticks.csv", _STICKS),
        "sticks.csv",
        (read_sticks,),
        "simulate fly --out {out}/flight.csv --device {file}",
    ),
    "archive-manifest": Format(
        lambda folder: archives.unpack(archives_made.OLD, folder / "flight"),
        f"flight/{archives.MANIFEST_FILE}",
        (lambda path: archives.read_manifest(path.parent),),
        "init --show {folder}/flight",
    ),
    "onnx": Format(
        _network,
        "a.onnx",
        (_detected,),
        "detect {folder}/pictures --detector {file} --size 64 --out {out}/boxes",
        is_slow=True,
    ),
}

#: The formats by name.
FORMATS: dict[str, Format] = {
    **_CALIBRATIONS,
    **_TRACKS,
    **_RECORDINGS,
    **_PICTURES,
    **_TABLES,
    **_OTHERS,
}


def make_all(folder: Path, names: Iterable[str]) -> None:
    """Write the sound files of some formats, each in a folder of its name."""
    for name in names:
        (folder / name).mkdir(parents=True)
        FORMATS[name].make(folder / name)
