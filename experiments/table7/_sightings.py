"""The markers that are seen in every frame of a video: detected once, kept in a file, and mislabelled at will."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from _recordings import Recording
from jaxtyping import Float, Int

from psotrack.files import written_whole
from psotrack.inside_out.detection import MarkerDetector, SeenMarkers
from psotrack.inside_out.marker_map import MarkerMap
from psotrack.progress import terminal
from psotrack.video import read_frames

DICTIONARY = "4x4_1000"


@dataclass(frozen=True)
class Sightings:
    """Of all frames, one after the other.

    Attributes:
        frame: (seen,), in which each marker is seen, not decreasing.
        ids: (seen,), what it is taken for.
        corners_px: (seen, 4, 2).
    """

    frame: Int[np.ndarray, "seen"]
    ids: Int[np.ndarray, "seen"]
    corners_px: Float[np.ndarray, "seen 4 2"]

    def in_frame(self, frame: int) -> SeenMarkers:
        """Those of one frame."""
        first, last = np.searchsorted(self.frame, [frame, frame + 1])
        return SeenMarkers(self.ids[first:last], self.corners_px[first:last])


def detected(recording: Recording, kept: Path) -> Sightings:
    """The markers of the map in a video; from the file `kept`, if it was made of that very video and map."""
    video, ids = recording.video, recording.marker_map.ids
    status = video.path.stat()
    made_of = np.array([status.st_size, status.st_mtime_ns, video.num_frames, *ids])
    if kept.exists():
        with np.load(kept) as stored:
            if np.array_equal(stored["made_of"], made_of):
                return Sightings(stored["frame"], stored["ids"], stored["corners_px"])
    detector = MarkerDetector(DICTIONARY, recording.lens, ids=ids.tolist())
    seen = []
    with terminal(f"detect {video.path.stem}", video.num_frames) as advance:
        for image in read_frames(video):
            seen.append(detector.detect(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)))
            advance(1)
    found = Sightings(
        np.repeat(np.arange(len(seen)), [len(one.ids) for one in seen]),
        np.concatenate([one.ids for one in seen]),
        np.concatenate([one.corners_px for one in seen]),
    )
    with written_whole(kept) as temporary:
        np.savez(temporary, made_of=made_of, frame=found.frame, ids=found.ids, corners_px=found.corners_px)
    return found


def mislabelled(seen: Sightings, share: float, marker_map: MarkerMap, rng: np.random.Generator) -> Sightings:
    """The same with each marker of the map taken, with a probability, for any other marker of it."""
    ids, known = seen.ids.copy(), marker_map.ids
    wrong = np.flatnonzero(np.isin(ids, known) & (rng.random(len(ids)) < share))
    # So many places further on in the list of all: never its own.
    places = np.searchsorted(known, ids[wrong]) + rng.integers(1, len(known), len(wrong))
    ids[wrong] = known[places % len(known)]
    return replace(seen, ids=ids)
