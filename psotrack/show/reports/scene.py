"""What a 3D view shows: drones, truth, cameras and clouds of points over time, as plain data for the page's JavaScript.

The JavaScript is `assets/scene.js`. Positions are sent in float32, relative to an origin near the flight, so that a
world in national coordinates, hundreds of kilometres from its origin, loses nothing.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from psotrack.errors import SettingsError
from psotrack.geometry import Rig, undistort
from psotrack.show.flights import USUAL_SIZE_M, TrackedFlight, ellipsoids_90
from psotrack.support import drone_colour, short_repr
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
class SceneDrones:
    """Drones of a scene.

    Attributes:
        trajectories: their positions, status and covariances.
        size_m: (drones, 3), full lengths along the world's axes, metres.
        colours: a colour per drone, as #rrggbb.
        names: the shown name of each drone.
    """

    trajectories: Trajectories
    size_m: Float[np.ndarray, "drones 3"]
    colours: tuple[str, ...]
    names: tuple[str, ...]

    __repr__ = short_repr


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
    drones: tuple[SceneDrones, ...] = ()
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
        step = row_step(len(self.time_s))
        rows = np.arange(0, len(self.time_s), step)
        time_s = np.asarray(self.time_s, np.float64)[rows]
        low_m, high_m = self._bounds_m()
        origin_m = np.round((low_m + high_m) / 2) if np.abs([low_m, high_m]).max() > _FAR_M else np.zeros(3)
        extent_m = float((high_m - low_m).max())
        return {
            "time_s": _packed(time_s),
            "step_name": self.step_name,
            "origin_m": origin_m.tolist(),
            "bounds_m": [(low_m - origin_m).tolist(), (high_m - origin_m).tolist()],
            "drones": [drone for each in self.drones for drone in _drones(each, time_s, origin_m)],
            "truth": []
            if self.truth is None
            else [
                {"name": name, "position_m": _packed(positions)}
                for name, positions in zip(
                    self.truth.drones,
                    np.swapaxes(_at_times(self.truth, time_s, self.truth.position_m) - origin_m, 0, 1),
                    strict=True,
                )
            ],
            "cameras": [] if self.rig is None else _cameras(self.rig, origin_m, _PYRAMID * extent_m),
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
        points_m = np.concatenate([np.asarray(part, np.float64) for part in parts] or [np.zeros((1, 3))])
        points_m = points_m[np.isfinite(points_m).all(axis=-1)]
        if not len(points_m):
            points_m = np.zeros((1, 3))
        low_m, high_m = points_m.min(axis=0), points_m.max(axis=0)
        extent_m = max(float((high_m - low_m).max()), 0.1)
        middle_m = (low_m + high_m) / 2
        low_m, high_m = np.minimum(low_m, middle_m - 0.05), np.maximum(high_m, middle_m + 0.05)
        if (self.drones or self.rig is not None) and 0 < low_m[2] < extent_m:
            low_m[2] = 0.0
        return low_m, high_m


def scene_of_flight(flight: TrackedFlight) -> Scene3D:
    """The scene of a flight: its tracks at the times of the first tracks, its truth and its cameras.

    Raises:
        SettingsError: the flight has neither tracks nor a truth.
    """
    several = len(flight.tracks) > 1
    drones = tuple(
        SceneDrones(
            each.trajectories,
            each.size_m,
            tuple(flight.colours(number)),
            tuple(f"{each.label} {name}" if several else name for name in each.trajectories.drones),
        )
        for number, each in enumerate(flight.tracks)
    )
    first = flight.tracks[0].trajectories if flight.tracks else flight.truth
    if first is None:
        raise SettingsError("scene", expected="tracks, or a recording with a reference", found="neither")
    return Scene3D(
        first.time_s, drones, flight.truth, None if flight.recording is None else flight.recording.rig
    )


def scene_of_tracks(
    trajectories: Trajectories,
    *,
    truth: Trajectories | None = None,
    rig: Rig | None = None,
    size_m: Float[np.ndarray, "drones 3"] | None = None,
) -> Scene3D:
    """The scene of tracks that are in memory.

    Args:
        trajectories: the tracks.
        truth: a reference to show beside; None for none.
        rig: cameras to show; None for none.
        size_m: (drones, 3), full lengths of the drones, metres; None: `USUAL_SIZE_M`.
    """
    count = trajectories.num_drones
    sizes = np.tile(np.array(USUAL_SIZE_M), (count, 1)) if size_m is None else np.asarray(size_m, np.float64)
    colours = tuple(drone_colour(drone) for drone in range(count))
    drones = SceneDrones(trajectories, sizes, colours, trajectories.drones)
    return Scene3D(trajectories.time_s, (drones,), truth, rig)


def row_step(num_rows: int) -> int:
    """Distance between the rows of a scene that are shown."""
    return -(-num_rows // MOST_ROWS)


def _drones(
    each: SceneDrones, time_s: Float[np.ndarray, "rows"], origin_m: np.ndarray
) -> list[dict[str, Any]]:
    trajectories = each.trajectories
    position_m = np.where(trajectories.seen[..., None], trajectories.position_m, np.nan)
    status = np.where(trajectories.seen, 0.0, float(Status.LOST))
    if trajectories.status is not None:
        status = np.where(trajectories.seen, trajectories.status, Status.LOST).astype(float)
    of_rows = {
        "position_m": _at_times(trajectories, time_s, position_m) - origin_m,
        "status": np.nan_to_num(_at_times(trajectories, time_s, status), nan=float(Status.LOST)),
    }
    if trajectories.covariance_m2 is not None:
        ellipsoids = ellipsoids_90(_at_times(trajectories, time_s, trajectories.covariance_m2))
        of_rows["half_axes_m"] = ellipsoids.half_axes_m
        turns = Rotation.from_matrix(ellipsoids.rotation.reshape(-1, 3, 3)).as_quat()
        of_rows["rotation_xyzw"] = turns.reshape(*ellipsoids.rotation.shape[:2], 4)
    return [
        {
            "name": name,
            "colour": each.colours[drone],
            "size_m": each.size_m[drone].tolist(),
            **{key: _packed(values[:, drone]) for key, values in of_rows.items()},
        }
        for drone, name in enumerate(each.names)
    ]


def _at_times(
    trajectories: Trajectories, time_s: Float[np.ndarray, "rows"], values: Float[np.ndarray, "frames *rest"]
) -> Float[np.ndarray, "rows *rest"]:
    """Values in the rows of a scene: those of the nearest frame, NaN where no frame is near."""
    own_s = np.asarray(trajectories.time_s, np.float64)
    nearest = _nearest(own_s, time_s)
    interval_s = max(
        np.median(np.diff(own_s)) if len(own_s) > 1 else 0.0,
        np.median(np.diff(time_s)) if len(time_s) > 1 else 0.0,
    )
    there = np.abs(own_s[nearest] - time_s) <= 0.6 * interval_s + 1e-9
    found = np.asarray(values, np.float64)[nearest]
    found[~there] = np.nan
    return found


def _nearest(
    own_s: Float[np.ndarray, "frames"], time_s: Float[np.ndarray, "rows"]
) -> Int[np.ndarray, "rows"]:
    after = np.clip(np.searchsorted(own_s, time_s), min(1, len(own_s) - 1), len(own_s) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(np.abs(own_s[before] - time_s) <= np.abs(own_s[after] - time_s), before, after)


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
