"""The arrangement of views in Rerun: a large view in space, the cameras, plots, and the events."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from psotrack.recordings import Recording
from psotrack.show.flights import QUANTITIES, TrackedFlight
from psotrack.show.viewer.camera_images import CameraKey
from psotrack.show.viewer.entity_log import FRAME, TIME, camera_path, drone_path

#: Time for which a drone's trail is shown, seconds.
_TRAIL_S = 3.0
_STATES = rrb.StateTimelineView(origin="/status", name="status")


def blueprint_of(flight: TrackedFlight, *, has_images: bool, has_onboard: bool = False) -> rrb.Blueprint:
    """The arrangement for a flight.

    Args:
        flight: the flight.
        has_images: whether the cameras have images.
        has_onboard: whether the cameras on drones are shown.
    """
    left: list[rrb.View | rrb.Container] = [_space_view(flight)]
    right: list[rrb.View | rrb.Container] = []
    if flight.recording is not None and (has_images or flight.tracks):
        right.append(_cameras(flight.recording, has_onboard))
    if flight.tracks:
        plots = [_plot(key) for key in QUANTITIES if flight.truth is not None or key != "error_mm"]
        left.append(rrb.Horizontal(rrb.Tabs(*plots, active_tab=0), _STATES, column_shares=[3, 2]))
        columns = rrb.TextLogColumns(timeline_columns=[TIME, FRAME], text_log_columns=["loglevel", "body"])
        name = "events: a click on a time jumps there"
        right.append(rrb.TextLogView(origin="/events", name=name, columns=columns))
    halves = [rrb.Vertical(*views, row_shares=[5, 2][: len(views)]) for views in (left, right) if views]
    return _arranged(halves, [5.0, 4.0], loop_mode="all")


def live_blueprint() -> rrb.Blueprint:
    """The arrangement for tracks that come while cameras film."""
    delay = rrb.TimeSeriesView(origin="/plots/delay_ms", name="delay (ms)")
    space = rrb.Spatial3DView(origin="/world", name="space")
    return _arranged(
        [space, rrb.Vertical(_plot("deviation_mm"), delay, _STATES)], [2.0, 1.0], play_state="following"
    )


def _arranged(
    columns: Sequence[rrb.View | rrb.Container], shares: list[float], **playing: Any
) -> rrb.Blueprint:
    return rrb.Blueprint(
        rrb.Horizontal(*columns, column_shares=shares[: len(columns)]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIME, **playing),
        collapse_panels=False,
        auto_layout=False,
        auto_views=False,
    )


def _space_view(flight: TrackedFlight) -> rrb.Spatial3DView:
    last = rr.VisibleTimeRange(
        TIME,
        start=rr.TimeRangeBoundary.cursor_relative(seconds=-_TRAIL_S),
        end=rr.TimeRangeBoundary.cursor_relative(),
    )
    trails: dict[Any, Any] = {
        f"{drone_path('world/drones', tracks, drone)}/trail": rrb.VisibleTimeRanges([last])
        for tracks in flight.tracks
        for drone in tracks.trajectories.drones
    }
    # Marks in the images would hide the drones in space.
    marks = ("boxes", "ellipses", "blobs", "detections", "silhouettes")
    return rrb.Spatial3DView(
        origin="/world",
        contents=["$origin/**", *(f"- $origin/cameras/*/{mark}/**" for mark in marks)],
        name="space",
        overrides=trails,
        eye_controls=_eye(flight),
        line_grid=rrb.LineGrid3D(visible=True, spacing=1.0),
    )


def _eye(flight: TrackedFlight) -> rrb.EyeControls3D | None:
    """A look from a corner above, so that all cameras and drones are in view."""
    parts = [each.trajectories.position_m.reshape(-1, 3) for each in flight.tracks]
    if flight.recording is not None and len(flight.recording.rig):
        parts.append(np.asarray(flight.recording.rig.cameras.centre_world, np.float64))
    points_m = np.concatenate([np.zeros((0, 3)), *parts])
    points_m = points_m[np.isfinite(points_m).all(axis=1)]
    if not len(points_m):
        return None
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    reach_m = max(float(np.linalg.norm(high - low)), 1.0)
    target_m = low + (high - low) * [0.5, 0.5, 0.3]
    position_m = target_m + reach_m * np.array([-0.33, -0.52, 0.4])
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital, position=position_m, look_target=target_m, eye_up=(0, 0, 1)
    )


def _plot(quantity: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=f"/plots/{quantity}",
        name=QUANTITIES[quantity][0],
        axis_y=rrb.ScalarAxis(range=(0.0, 1.0)) if quantity == "score" else None,
        plot_legend=rrb.PlotLegend(visible=True),
    )


def _cameras(recording: Recording, has_onboard: bool) -> rrb.Container:
    def grid(names: Iterable[str], on_drone: bool, title: str) -> rrb.Container:
        keys = [CameraKey(name, on_drone) for name in names]
        views = [rrb.Spatial2DView(origin=f"/{camera_path(key)}", name=key.name) for key in keys]
        columns = 2 if len(keys) <= 8 else int(np.ceil(np.sqrt(len(keys))))
        return rrb.Grid(*views, grid_columns=columns, name=title)

    of_rig = grid(recording.rig.names, False, "cameras")
    if not has_onboard:
        return of_rig
    return rrb.Tabs(of_rig, grid(recording.onboard, True, "cameras on drones"), active_tab=0)
