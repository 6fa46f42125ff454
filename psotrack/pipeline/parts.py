"""Parts that the caller brings instead of the package's own, and the interface of a method of tracking.

A method is given to `psotrack.track(..., method=...)`, or by name as a plugin (see `psotrack.support.plugins`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, TypedDict, get_type_hints, runtime_checkable

import numpy as np
from jaxtyping import Float

from psotrack.errors import SettingsError
from psotrack.foreground.detection import Detector
from psotrack.foreground.silhouettes import BackgroundModel, Silhouettes
from psotrack.geometry import Rig
from psotrack.settings import YOLO, TrackSettings
from psotrack.support import Report, check_interface, make_plugin, no_progress
from psotrack.tracking.births import InitialState
from psotrack.tracking.matching import Sightings
from psotrack.tracking.swarm import Score, Search
from psotrack.trajectories import Tracks

#: The methods of this package.
_BUILT_IN = ("swarm", "projection-lines", "fused")


@dataclass(frozen=True)
class MethodInputs:
    """Inputs of a method for one run.

    Attributes:
        rig: the cameras, calibrated.
        silhouettes: silhouettes of all cameras at the instants (`Silhouettes.read` gives the coverage of some of them,
            0 to 255; `exposures` says when each camera's frame was exposed, None where all were exposed together).
        sightings: detections of all cameras at all instants; None for a method that does not read detections.
        initial: positions, velocities and sizes of the drones at frame 0, (drones, 3) each, metres and m/s.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        fps: instants per second.
        settings: settings of the run; the seed of random numbers is `settings.seed`.
    """

    rig: Rig
    silhouettes: Silhouettes
    sightings: Sightings | None
    initial: InitialState
    bounds_m: Float[np.ndarray, "2 3"]
    fps: float
    settings: TrackSettings


@runtime_checkable
class Method(Protocol):
    """A method of tracking: from silhouettes or detections of the whole recording to tracks.

    A method is called once per run, outside of any compiled function; its inputs and results are NumPy arrays. The
    stages after the method (identity, smoothing, body offset, record) are the same for all methods.

    Attributes:
        reads_detections: whether the method is given detections, besides silhouettes.
    """

    @property
    def reads_detections(self) -> bool: ...  # noqa: D102

    def __call__(self, inputs: MethodInputs, report: Report = no_progress) -> Tracks:
        """Track the drones through all frames.

        Args:
            inputs: inputs of the run.
            report: shows progress: `with report("name", num_frames) as advance:`, then `advance(1)` per frame.

        Returns:
            Tracks of all frames, with all drones that the method found. NaN stands for numbers that the method does
            not have.
        """
        ...


class Parts(TypedDict, total=False):
    """Parts that the caller brings, instead of those that the settings name.

    Attributes:
        search: the search in one frame (see `Search`).
        score: the score of positions in single cameras (see `Score`).
        method: the method of tracking (see `Method`).
        background: the background model that makes the silhouettes (see `BackgroundModel`); only `track` and
            `track_recording` make silhouettes.
        detector: makes the detections (see `Detector`); only `track` and `track_recording` make detections.
    """

    search: Search
    score: Score
    method: Method
    background: BackgroundModel
    detector: Detector


def check_parts(parts: Parts) -> None:
    """Raise `SettingsError` if a part lacks an attribute or a method of its interface."""
    for kind, interface in get_type_hints(Parts).items():
        if kind in parts:
            check_interface(kind, parts.get(kind), interface)


def find_method(settings: TrackSettings, parts: Parts) -> Method | None:
    """The method that the caller brings, or that an entry point names; None for the methods of this package.

    Raises:
        SettingsError: there is no method of the settings' name.
    """
    if "method" in parts or settings.method in _BUILT_IN:
        return parts.get("method")
    method: Method = make_plugin(
        "method", settings.method, settings, interface=Method, setting="method", built_in=_BUILT_IN
    )
    return method


def check_detector_is_used(settings: TrackSettings, method: Method | None) -> None:
    """Raise `SettingsError` if a detector is brought, but the method reads no detections or others are named."""
    if settings.method == "swarm" if method is None else not method.reads_detections:
        name = settings.method if method is None else type(method).__name__
        expected = "a method that reads detections, such as projection-lines or fused"
        raise SettingsError("detector", expected=expected, found=f"method {name}")
    if settings.detections != YOLO:
        found = f"detections {settings.detections} as well"
        raise SettingsError("detector", expected="detections from one source", found=found)
