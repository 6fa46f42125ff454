"""What a 3D view shows: drones, truth, cameras and clouds of points over time, as plain data for the page's JavaScript.

The JavaScript is `assets/scene.js`. Positions are sent in float32, relative to an origin near the flight, so that a
world in national coordinates, hundreds of kilometres from its origin, loses nothing.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from psotrack.errors import SettingsError
from psotrack.geometry import Rig, undistort
from psotrack.pipeline import TrackedRecording
from psotrack.recordings import Recording
from psotrack.show.flights import FlightTracks, TrackedFlight, ellipsoids_90, flight_of, rows_at, statuses
from psotrack.support import short_repr
from psotrack.trajectories import Status, Trajectories

#: Largest number of rows of a view. 5,000 rows of ten drones take 2 MB, and a slider has fewer pixels.
MOST_ROWS = 5000
#: Length of the drawn pyramids of the cameras, as a share of the extent of the scene.
_PYRAMID = 0.06
#: Coordinates beyond this distance from the world's origin lose millimetres in float32, metres.
_FAR_M = 1000.0
#: Shares of the image at which the rays of a pyramid are looked for: the corners of a wide lens may show nothing.
_CORNER_SHARES = (1.0, 0.9, 0.75, 0.5, 0.25)


@dataclass(frozen=True, repr=False)
class PointCloud:
    """Points that move together, such as the particles of a swarm.

    Attributes:
        name: name of the group, by which the view shows and hides the points.
        position_m: (rows, points, 3), positions in each row of the scene, metres.
        colour: colour, as #rrggbb.
        size_px: diameter of a point on the screen, pixels.
    """

    name: str
    position_m: Float[np.ndarray, "rows points 3"]
    colour: str = "#e69f00"
    size_px: float = 5.0

    __repr__ = short_repr


@dataclass(frozen=True, repr=False)
class Scene3D:
    """A scene that turns and plays; a notebook shows it, also after it was saved and opened again.

    Attributes:
        time_s: (rows,), times of the rows, seconds.
        drones: the drones of each file of tracks.
        truth: the reference; None where there is none.
        rig: the cameras; None where they are not known.
        clouds: clouds of points.
        step_name: word for the rows where they are no times, such as "iteration"; empty for times.
    """

    time_s: Float[np.ndarray, "rows"]
    drones: tuple[FlightTracks, ...] = ()
    truth: Trajectories | None = None
    rig: Rig | None = None
    clouds: tuple[PointCloud, ...] = ()
    step_name: str = ""

    __repr__ = short_repr

    def __post_init__(self) -> None:
        if not len(self.time_s):
            raise SettingsError("scene", expected="at least one row", found="none")
        for cloud in self.clouds:
            if len(cloud.position_m) != len(self.time_s):
                raise SettingsError(
                    f"scene.clouds, {cloud.name}",
                    expected=f"{len(self.time_s)} rows",
                    found=f"{len(cloud.position_m)}",
                )

    def _repr_html_(self) -> str:
        from psotrack.show.reports.page import scene_frame

        return scene_frame(self)

    def data(self) -> dict[str, Any]:
        """The scene as plain data, fit for JSON, with every n-th row where there are more than `MOST_ROWS`."""
        rows = slice(None, None, row_step(len(self.time_s)))
        time_s = np.asarray(self.time_s, np.float64)[rows]
        low_m, high_m = self._bounds_m()
        origin_m = np.round((low_m + high_m) / 2) if np.abs([low_m, high_m]).max() > _FAR_M else np.zeros(3)
        extent_m = float((high_m - low_m).max())
        truth, rig = self.truth, self.rig
        true_m = None if truth is None else _at_times(truth, time_s, truth.position_m) - origin_m
        return {
            "time_s": _packed(time_s),
            "step_name": self.step_name,
            "origin_m": origin_m.tolist(),
            "bounds_m": [(low_m - origin_m).tolist(), (high_m - origin_m).tolist()],
            "drones": [drone for each in self.drones for drone in _drones(each, time_s, origin_m)],
            "truth": [] if true_m is None else [_packed(own_m) for own_m in np.swapaxes(true_m, 0, 1)],
            "cameras": [] if rig is None else _cameras(rig, origin_m, _PYRAMID * extent_m),
            "clouds": [
                {
                    "name": cloud.name,
                    "colour": cloud.colour,
                    "size_px": cloud.size_px,
                    "position_m": _packed(cloud.position_m[rows] - origin_m),
                }
                for cloud in self.clouds
            ],
        }

    def _bounds_m(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Lowest and highest coordinates of all that is shown; with drones also the floor, z = 0, if it is near."""
        parts = [each.trajectories.position_m[each.trajectories.seen] for each in self.drones]
        parts += [cloud.position_m.reshape(-1, 3) for cloud in self.clouds]
        if self.truth is not None:
            parts.append(self.truth.position_m.reshape(-1, 3))
        if self.rig is not None:
            parts.append(np.asarray(self.rig.cameras.centre_world))
        points_m = np.concatenate([np.zeros((0, 3)), *(np.asarray(part, np.float64) for part in parts)])
        points_m = points_m[np.isfinite(points_m).all(axis=-1)]
        points_m = points_m if len(points_m) else np.zeros((1, 3))
        low_m, high_m = points_m.min(axis=0), points_m.max(axis=0)
        extent_m = max(float((high_m - low_m).max()), 0.1)
        middle_m = (low_m + high_m) / 2
        low_m, high_m = np.minimum(low_m, middle_m - 0.05), np.maximum(high_m, middle_m + 0.05)
        if (self.drones or self.rig is not None) and 0 < low_m[2] < extent_m:
            low_m[2] = 0.0
        return low_m, high_m


def scene_of_flight(flight: TrackedFlight) -> Scene3D:
    """The scene of a flight: its tracks at the times of the first tracks, its truth and its cameras."""
    recording = flight.recording
    shown = flight.tracks[0].trajectories if flight.tracks else flight.truth
    if shown is None:
        assert recording is not None
        return Scene3D(recording.timeline().time_s, rig=recording.rig)
    return Scene3D(shown.time_s, flight.tracks, flight.truth, None if recording is None else recording.rig)


def view_3d(tracks: TrackedRecording | Trajectories, recording: Recording | None = None) -> Scene3D:
    """A view of tracks that turns and plays, for a notebook; a saved notebook keeps the view.

    Args:
        tracks: the result of `track`, or trajectories.
        recording: the recording, whose cameras and reference are shown; None shows the tracks alone.
    """
    return scene_of_flight(flight_of(tracks, recording))


def row_step(num_rows: int) -> int:
    """Distance between the rows of a scene that are shown."""
    return -(-num_rows // MOST_ROWS)


def _drones(
    tracks: FlightTracks, time_s: Float[np.ndarray, "rows"], origin_m: Float[np.ndarray, "3"]
) -> list[dict[str, Any]]:
    flown = tracks.trajectories
    position_m = np.where(flown.seen[..., None], flown.position_m, np.nan)
    status = np.where(flown.seen, statuses(flown), Status.LOST)
    of_rows = {
        "position_m": _at_times(flown, time_s, position_m) - origin_m,
        "status": np.nan_to_num(_at_times(flown, time_s, status), nan=float(Status.LOST)),
    }
    if flown.covariance_m2 is not None:
        ellipsoids = ellipsoids_90(_at_times(flown, time_s, flown.covariance_m2))
        of_rows["half_axes_m"] = ellipsoids.half_axes_m
        turns = Rotation.from_matrix(ellipsoids.rotation.reshape(-1, 3, 3)).as_quat()
        of_rows["rotation_xyzw"] = turns.reshape(*ellipsoids.rotation.shape[:2], 4)
    return [
        {
            "name": name,
            "colour": tracks.colours[drone],
            "size_m": tracks.size_m[drone].tolist(),
            **{key: _packed(values[:, drone]) for key, values in of_rows.items()},
        }
        for drone, name in enumerate(tracks.names)
    ]


def _at_times(
    trajectories: Trajectories, time_s: Float[np.ndarray, "rows"], values: np.ndarray
) -> Float[np.ndarray, "rows *rest"]:
    """Values in the rows of a scene: those of the nearest frame, NaN where no frame is near."""
    rows = rows_at(trajectories, time_s)
    found = np.asarray(values, np.float64)[rows]
    found[rows < 0] = np.nan
    return found


def _cameras(rig: Rig, origin_m: Float[np.ndarray, "3"], length_m: float) -> list[dict[str, Any]]:
    """Centre of each camera, and the four corners of a pyramid that opens along its view."""
    cameras = []
    for index, name in enumerate(rig.names):
        camera = rig.cameras[index]
        R, t_m = np.asarray(camera.T_cam_world)[:3, :3], np.asarray(camera.T_cam_world)[:3, 3]
        width, height = np.asarray(camera.image_size_wh, np.float64)
        corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) - 0.5
        middle = np.array([width, height]) / 2 - 0.5
        rays = np.full((4, 2), np.nan)
        for share in _CORNER_SHARES:
            rays = np.asarray(undistort(camera, middle + share * (corners - middle)))
            if np.isfinite(rays).all():
                break
        points_cam = length_m * np.concatenate([np.nan_to_num(rays), np.ones((4, 1))], axis=1)
        cameras.append(
            {
                "name": name,
                "centre_m": (np.asarray(camera.centre_world) - origin_m).tolist(),
                "corners_m": ((points_cam - t_m) @ R - origin_m).tolist(),
            }
        )
    return cameras


def _packed(values: np.ndarray) -> str:
    """Numbers as base64 of little-endian float32."""
    return base64.b64encode(np.ascontiguousarray(values, "<f4").tobytes()).decode("ascii")
