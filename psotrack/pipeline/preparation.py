"""What a run of any method needs to know before tracking: detections, the room's bounds, the speed limit."""

from __future__ import annotations

from dataclasses import dataclass

from psotrack.initiation import (
    FlightVolume,
    MovingPoints,
    StartSource,
    flight_volume,
    moving_blobs,
    moving_detections,
    start_source,
)
from psotrack.methods import DetectionInputs, Method, read_sightings
from psotrack.pipeline.parts import Parts, method_plugin, tracks_detections
from psotrack.recordings import Recording
from psotrack.settings import BLOBS, TrackSettings
from psotrack.silhouettes import Silhouettes
from psotrack.support import Report


@dataclass(frozen=True)
class PreparedRun:
    """What is known of a run before tracking.

    Attributes:
        settings: settings of the run, with the speed limit that was found.
        source: source of the first positions.
        volume: bounds of the room, and where they come from.
        plugin: the method that the caller brings or that an entry point names; None for the methods of this package.
        detections: detections of all cameras; None where the method reads none.
    """

    settings: TrackSettings
    source: StartSource
    volume: FlightVolume
    plugin: Method | None
    detections: DetectionInputs | None


def prepare(
    recording: Recording,
    silhouettes: Silhouettes | None,
    settings: TrackSettings,
    parts: Parts,
    points: dict[str, MovingPoints],
    report: Report,
) -> PreparedRun:
    """Read the detections that the method needs, and find the volume and the speed limit.

    Args:
        recording, silhouettes, settings, parts, report: as in `track_runs`.
        points: moving points that earlier runs found, by the source of the detections; new ones are added.
    """
    plugin = method_plugin(settings, parts)
    reads_detections = tracks_detections(settings, plugin) if plugin is None else plugin.reads_detections
    detections = (
        read_sightings(recording, silhouettes, settings.detections, report) if reads_detections else None
    )
    source = BLOBS if detections is None else settings.detections
    bounds_m = settings.bounds_m or recording.bounds_m
    if source not in points and (bounds_m is None or settings.motion.max_speed_m_s is None):
        if detections is not None:
            points[source] = moving_detections(recording.rig, detections.sightings, recording.fps)
        elif silhouettes is not None:
            points[source] = moving_blobs(recording.rig, silhouettes, recording.fps)
    volume = flight_volume(
        recording.rig,
        points.get(source),
        bounds_m=bounds_m,
        max_speed_m_s=settings.motion.max_speed_m_s,
    )
    settings = settings.changed({"motion.max_speed_m_s": volume.max_speed_m_s})
    return PreparedRun(settings, start_source(recording, settings.init), volume, plugin, detections)
