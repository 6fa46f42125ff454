"""Parts that the caller brings instead of the package's own, and the method that a run uses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from psotrack.detection import Detector
from psotrack.errors import SettingsError
from psotrack.methods import Method
from psotrack.recordings import Recording
from psotrack.settings import YOLO, TrackSettings
from psotrack.silhouettes import (
    BackgroundModel,
    Living,
    SilhouetteSettings,
    find_background,
    scaled_settings,
)
from psotrack.support import check_interface, identify, make_plugin
from psotrack.tracking import Score, Search

#: The methods of this package.
BUILT_IN_METHODS = ("swarm", "projection-lines", "fused")


@dataclass(frozen=True)
class Parts:
    """Parts that the caller brings, instead of those that the settings name.

    Attributes:
        search: the search in one frame.
        score: the score of positions in single cameras.
        method: the method of tracking.
        background: the background model that makes the silhouettes; only `track_recording` makes silhouettes.
        detector: makes the detections; only `track_recording` makes detections.

    Raises:
        SettingsError: a part lacks an attribute or a method of its interface.
    """

    search: Search | None = None
    score: Score | None = None
    method: Method | None = None
    background: BackgroundModel | None = None
    detector: Detector | None = None

    def __post_init__(self) -> None:
        for kind, interface in _INTERFACES.items():
            if getattr(self, kind) is not None:
                check_interface(kind, getattr(self, kind), interface)

    @property
    def record(self) -> dict[str, Any]:
        """Identities of the parts that the caller brings, by kind, fit for JSON."""
        brought = {kind: getattr(self, kind) for kind in _INTERFACES}
        return {kind: identify(part) for kind, part in brought.items() if part is not None}


#: Interface of each of `Parts`.
_INTERFACES: dict[str, type] = {
    "search": Search,
    "score": Score,
    "method": Method,
    "background": BackgroundModel,
    "detector": Detector,
}


def with_background(parts: Parts, recording: Recording, settings: SilhouetteSettings) -> Parts:
    """The parts with the background model that the settings name, where that model is a plugin.

    Raises:
        SettingsError: there is no background model of the settings' name.
    """
    if parts.background is not None or not (recording.videos or recording.silhouettes):
        return parts
    model = find_background(settings.background, scaled_settings(settings, recording))
    return parts if model is None or isinstance(model, Living) else replace(parts, background=model)


def method_plugin(settings: TrackSettings, parts: Parts) -> Method | None:
    """The method that the caller brings, or that an entry point names; None for the methods of this package."""
    if parts.method is not None:
        return parts.method
    if settings.method in BUILT_IN_METHODS:
        return None
    method: Method = make_plugin(
        "method", settings.method, settings, interface=Method, setting="method", built_in=BUILT_IN_METHODS
    )
    return method


def tracks_silhouettes(settings: TrackSettings, plugin: Method | None) -> bool:
    """Whether the method of the run follows silhouettes, alone or beside detections."""
    return plugin is None and settings.method in ("swarm", "fused")


def tracks_detections(settings: TrackSettings, plugin: Method | None) -> bool:
    """Whether the method of the run follows detections, alone or beside silhouettes."""
    return plugin is None and settings.method in ("projection-lines", "fused")


def check_detector_is_used(settings: TrackSettings, parts: Parts) -> None:
    """Raise `SettingsError` if a detector is brought, but the method reads no detections or others are named."""
    method = method_plugin(settings, parts)
    if not (tracks_detections(settings, method) if method is None else method.reads_detections):
        name = settings.method if method is None else type(method).__name__
        expected = "a method that reads detections, such as projection-lines or fused"
        raise SettingsError("detector", expected=expected, found=f"method {name}")
    if settings.detections != YOLO:
        found = f"detections {settings.detections} as well"
        raise SettingsError("detector", expected="detections from one source", found=found)
