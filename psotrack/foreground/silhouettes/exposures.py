"""When the cameras' frames of each instant were exposed: what moves a drone's box from camera to camera in time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from psotrack.geometry import Camera, Extents, moved_extents, project_boxes
from psotrack.support.array_types import Array

#: Pose of a camera that sees nothing: the whole world is behind it.
_SEES_NOTHING = np.array([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, -1], [0, 0, 0, 1]], np.float32)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Exposures:
    """Exposures of the cameras' frames at one instant, or at several instants along a leading axis.

    Attributes:
        offset_s: (..., cameras), time of the camera's frame minus time of the instant, seconds.
        is_there: (..., cameras), whether the camera has a frame at the instant.
        share: (..., cameras), 1 / number of instants that show the frame: the part of the frame's information that one
            of these instants may use.
        line_time_s: (..., cameras), time from row to row of a rolling shutter, seconds; `offset_s` is that of the
            middle row.
    """

    offset_s: Float[Array, "*instants cameras"]
    is_there: Bool[Array, "*instants cameras"]
    share: Float[Array, "*instants cameras"]
    line_time_s: Float[Array, "*instants cameras"]

    def __getitem__(self, index: int | slice | Shaped[np.ndarray, "chosen"]) -> Exposures:
        return self._changed(lambda values: values[index])

    def of_cameras(self, chosen: Int[np.ndarray, "chosen"]) -> Exposures:
        """The exposures of some cameras."""
        return self._changed(lambda values: values[..., chosen])

    def padded(self, num_instants: int) -> Exposures:
        """These exposures, and after them instants without frames, up to a number of instants."""
        missing = ((0, num_instants - len(self.offset_s)), (0, 0))
        return self._changed(lambda values: np.pad(values, missing))

    def _changed(self, change: Callable[[Any], Any]) -> Exposures:
        return Exposures(*map(change, vars(self).values()))

    def seeing(self, cameras: Camera) -> Camera:
        """The cameras of one instant, where those without a frame see nothing."""
        nothing = jnp.asarray(_SEES_NOTHING, cameras.T_cam_world.dtype)
        T_cam_world = jnp.where(self.is_there[:, None, None], cameras.T_cam_world, nothing)
        return replace(cameras, T_cam_world=T_cam_world)

    def moved(
        self, extents: Extents, position_m: Float[Array, "drones 3"], velocity_m_s: Float[Array, "drones 3"]
    ) -> Extents:
        """Extents of one instant whose drones are where each camera's frame shows them.

        A drone at the position X at the instant is at X + velocity * offset in a camera's frame.

        Args:
            extents: extents of the drones in the cameras.
            position_m: (drones, 3), expected positions, which say in which rows a rolling shutter shows the drones.
            velocity_m_s: (drones, 3), velocities, m/s.
        """
        height_px = jnp.asarray(extents.cameras.image_size_wh, extents.s_xx.dtype)[:, 1]
        row_px = jnp.clip(project_boxes(extents, position_m).y_middle, 0.0, height_px) - height_px / 2
        offset_s = self.offset_s + self.line_time_s * row_px
        return moved_extents(extents, velocity_m_s[:, None, :] * offset_s[..., None])


def moved_by(
    exposures: Exposures, velocity_m_s: Float[np.ndarray, "instants drones 3"]
) -> Float[np.ndarray, "instants drones cameras 3"]:
    """Motion of each drone from each instant to each camera's exposure, metres."""
    offset_s = np.asarray(exposures.offset_s, np.float64)
    return velocity_m_s[:, :, None, :] * offset_s[:, None, :, None]
