"""The arrangement of views in Rerun: a large view in space, the cameras, plots, and the events."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from psotrack.show.flights import QUANTITIES, TrackedFlight
from psotrack.show.viewer.camera_images import CameraKey
from psotrack.show.viewer.entity_log import FRAME, TIME, camera_path, drone_path

#: Time for which a drone's trail is shown, seconds.
_TRAIL_S = 3.0


def blueprint_of(flight: TrackedFlight, *, has_images: bool, has_onboard: bool = False) -> rrb.Blueprint:
    """The arrangement for a flight.

    Args:
        flight: the flight.
        has_images: whether the cameras have images.
        has_onboard: whether the cameras on drones are shown.
    """
    left: list[rrb.View | rrb.Container] = [_space_view(flight)]
    if flight.tracks:
        left.append(rrb.Horizontal(_plots(flight), _states(), column_shares=[3, 2]))
    right: list[rrb.View | rrb.Container] = []
    if flight.recording is not None and (has_images or flight.tracks):
        right.append(_cameras(flight, has_onboard))
    if flight.tracks:
        right.append(_events())
    columns: list[rrb.View | rrb.Container] = [rrb.Vertical(*left, row_shares=[5, 2][: len(left)])]
    if right:
        columns.append(rrb.Vertical(*right, row_shares=[5, 1.4][: len(right)]))
    return rrb.Blueprint(
        rrb.Horizontal(*columns, column_shares=[5, 4][: len(columns)]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIME, loop_mode="all"),
        collapse_panels=False,
        auto_layout=False,
        auto_views=False,
    )


def live_blueprint() -> rrb.Blueprint:
    """The arrangement for tracks that come while cameras film."""
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="/world", name="space"),
            rrb.Vertical(
                *(_plot(quantity) for quantity in QUANTITIES if quantity != "error_mm"),
                rrb.TimeSeriesView(origin="/plots/delay_ms", name="delay (ms)"),
                _states(),
            ),
            column_shares=[2, 1],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIME, play_state="following"),
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
    return rrb.Spatial3DView(
        origin="/world",
        # Marks in the images would hide the drones in space.
        contents=[
            "$origin/**",
            "- $origin/cameras/*/boxes/**",
            "- $origin/cameras/*/ellipses/**",
            "- $origin/cameras/*/blobs/**",
            "- $origin/cameras/*/detections/**",
            "- $origin/cameras/*/silhouettes/**",
        ],
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
    middle_m, reach_m = (low + high) / 2, max(float(np.linalg.norm(high - low)), 1.0)
    middle_m[2] = low[2] + 0.3 * (high[2] - low[2])
    position_m = middle_m + reach_m * np.array([-0.33, -0.52, 0.4])
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital, position=position_m, look_target=middle_m, eye_up=(0, 0, 1)
    )


def _plots(flight: TrackedFlight) -> rrb.Tabs:
    shown = [quantity for quantity in QUANTITIES if flight.truth is not None or quantity != "error_mm"]
    return rrb.Tabs(*map(_plot, shown), active_tab=0)


def _plot(quantity: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=f"/plots/{quantity}",
        name=QUANTITIES[quantity][0],
        axis_y=rrb.ScalarAxis(range=(0.0, 1.0)) if quantity == "score" else None,
        plot_legend=rrb.PlotLegend(visible=True),
    )


def _states() -> rrb.StateTimelineView:
    return rrb.StateTimelineView(origin="/status", name="status")


def _events() -> rrb.TextLogView:
    return rrb.TextLogView(
        origin="/events",
        name="events: a click on a time jumps there",
        columns=rrb.TextLogColumns(timeline_columns=[TIME, FRAME], text_log_columns=["loglevel", "body"]),
    )


def _cameras(flight: TrackedFlight, has_onboard: bool) -> rrb.Container:
    assert flight.recording is not None
    onboard = (flight.recording.onboard or {}) if has_onboard else {}
    names = flight.recording.rig.names
    grid = rrb.Grid(
        *(rrb.Spatial2DView(origin=f"/{camera_path(CameraKey(name))}", name=name) for name in names),
        grid_columns=2 if len(names) <= 8 else int(np.ceil(np.sqrt(len(names)))),
        name="cameras",
    )
    if not onboard:
        return grid
    on_drones = rrb.Grid(
        *(
            rrb.Spatial2DView(origin=f"/{camera_path(CameraKey(name, on_drone=True))}", name=name)
            for name in onboard
        ),
        grid_columns=2,
        name="cameras on drones",
    )
    return rrb.Tabs(grid, on_drones, active_tab=0)
