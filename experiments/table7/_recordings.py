"""Recordings of Table 7: a drone's own video, the map of the markers, and a reference with its own clocks."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from psotrack.calibration import lens_of_view
from psotrack.calibration.clocks import own_reference
from psotrack.errors import InputError
from psotrack.evaluation import drone_of
from psotrack.geometry import Camera, make_camera
from psotrack.inside_out import MarkerMap, read_marker_map
from psotrack.recordings import OnboardVideo, VideoInfo
from psotrack.recordings.datasets import CALIBRATION, MARKER_CORNERS, read_sequence
from psotrack.support import progress_bar
from psotrack.trajectories import Trajectories

SIMULATED = ("S01_D2_A", "S02_D4_A")
#: Horizontal and vertical field of view of the paper's GoPro, degrees, for videos without intrinsics.
FOV_DEG = (92.45, 60.83)
#: Sample rates of a simulated reference, like those of the paper's Vicon system and IMU.
POSITIONS_HZ, ORIENTATIONS_HZ = 100.0, 25.0
#: Largest offset of the clocks of a simulated reference, seconds, to either side.
CLOCKS_S = 5.0


@dataclass(frozen=True)
class Recording:
    """One flight of one drone.

    Attributes:
        sequence, drone: names.
        video: video of the drone's own camera.
        lens: intrinsics of this camera.
        marker_map: markers of the room.
        reference: poses of the drone's body by the reference: input of the paper's procedure.
        turns: its orientations if they have another clock, as those of an IMU; None in real sequences.
        planted_s: offsets of the two clocks ahead of the video's clock, seconds, in simulated recordings.
        truth: true poses of the camera in simulated sequences; None in real sequences.
    """

    sequence: str
    drone: str
    video: VideoInfo
    lens: Camera
    marker_map: MarkerMap
    reference: Trajectories
    turns: Trajectories | None
    planted_s: tuple[float, float] | None
    truth: OnboardVideo | None


def simulated(data: Path, *, num_frames: int | None = None, scale: float = 1.0) -> Path:
    """Simulate the missing sequences; returns the root folder of the data.

    The room has only one camera with few pixels, because only the drones' own videos are used.
    """
    from psotrack.simulation import SimulationSettings, change_scenario, scenario, simulate

    corner = {"position_m": (2.9, 2.1, 2.5), "target_m": (0.0, 0.0, 1.0)}
    for name in SIMULATED:
        if not (data / "Simulated_Data" / name).is_dir():
            print(f"simulating the drones' own videos of {name}", flush=True)
            recipe = change_scenario(scenario(name), {"cameras": [corner], "image_size_wh": [160, 160]})
            settings = SimulationSettings(num_frames, scale, masks=False)
            simulate(recipe, data, settings, report=progress_bar)
    return data


def at_hand(data: Path) -> list[Path]:
    """Find the folders of all sequences with markers below a folder.

    Raises:
        InputError: there is no such sequence.
    """
    folders = [path.parent for path in data.glob(f"*/*/{CALIBRATION}") if path.parent.name.endswith("_A")]
    if not folders:
        expected = "sequences with markers, *_A, in Simulated_Data or Real_Data"
        raise InputError(data, expected=expected, found="none")
    return sorted(folders)


def recordings(folder: Path) -> Iterator[Recording]:
    """Read the recordings of all drones of a sequence that carry a camera.

    Raises:
        InputError: no drone carries a camera, or a file cannot be used.
    """
    if not (folder / MARKER_CORNERS).exists():
        raise InputError(folder / MARKER_CORNERS, expected="the corners of its markers", found="no such file")
    marker_map, sequence = read_marker_map(folder / MARKER_CORNERS), read_sequence(folder)
    if not sequence.onboard:
        raise InputError(folder, expected="a video of a drone's own camera, dronN_cam_s.avi", found="none")
    flights = own_reference(sequence)
    for name, onboard in sequence.onboard.items():
        reference, turns, planted_s = drone_of(flights, name), None, None
        known = np.isfinite(onboard.position_m).all(axis=-1).any()
        if known:
            reference, turns, planted_s = _with_other_clocks(reference, f"{sequence.name} {name}")
        yield Recording(
            sequence=sequence.name,
            drone=name,
            video=onboard.video,
            lens=_lens(onboard),
            marker_map=marker_map,
            reference=reference,
            turns=turns,
            planted_s=planted_s,
            truth=onboard if known else None,
        )


def _lens(onboard: OnboardVideo) -> Camera:
    size_wh = onboard.video.image_size_wh
    if onboard.K is None:
        return lens_of_view(*FOV_DEG, size_wh)
    return make_camera(R=np.eye(3), t_m=np.zeros(3), K=onboard.K, image_size_wh=size_wh)


def _with_other_clocks(
    body: Trajectories, name: str
) -> tuple[Trajectories, Trajectories, tuple[float, float]]:
    """Resample a simulated flight as two independent recorders would store it: with other rates and other clocks."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    clock_s, turn_clock_s = rng.uniform(-CLOCKS_S, CLOCKS_S, 2)
    if body.orientation_wxyz is None:
        raise InputError(name, expected="orientations of the drone", found="none")
    known = body.seen[:, 0] & np.isfinite(body.orientation_wxyz[:, 0]).all(axis=-1)
    time_s = body.time_s[known]
    samples_s, turns_s = (
        np.arange(time_s[0] + rng.uniform(0, 1 / rate_hz), time_s[-1], 1 / rate_hz)
        for rate_hz in (POSITIONS_HZ, ORIENTATIONS_HZ)
    )
    turns = RotationSpline(time_s, Rotation.from_quat(body.orientation_wxyz[known, 0], scalar_first=True))
    positions = Trajectories(
        np.arange(len(samples_s)),
        samples_s + clock_s,
        body.drones,
        CubicSpline(time_s, body.position_m[known, 0])(samples_s)[:, None],
    )
    orientations = Trajectories(
        np.arange(len(turns_s)),
        turns_s + turn_clock_s,
        body.drones,
        np.zeros((len(turns_s), 1, 3)),
        orientation_wxyz=turns(turns_s).as_quat(scalar_first=True)[:, None],
    )
    return positions, orientations, (float(clock_s), float(turn_clock_s))
