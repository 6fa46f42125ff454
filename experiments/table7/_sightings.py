"""The markers that are seen in every frame of a video: detected once, kept in a file, and mislabelled at will."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from _recordings import Recording
from jaxtyping import Float, Int

from psotrack.inside_out import MarkerMap, detection
from psotrack.inside_out.detection import DetectedMarkers, MarkerDetector
from psotrack.recordings import read_frames
from psotrack.support import atomic_write, progress_bar

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

    def in_frame(self, frame: int) -> DetectedMarkers:
        """Those of one frame."""
        first, last = np.searchsorted(self.frame, [frame, frame + 1])
        return DetectedMarkers(self.ids[first:last], self.corners_px[first:last])


def detected(recording: Recording, kept: Path) -> Sightings:
    """The markers of the map in a video; from the file `kept`, if nothing that decides on them has changed since."""
    video, ids = recording.video, recording.marker_map.ids
    made_of = _made_of(recording)
    if kept.exists():
        with np.load(kept) as stored:
            if str(stored["made_of"]) == made_of:
                return Sightings(stored["frame"], stored["ids"], stored["corners_px"])
    detector = MarkerDetector(DICTIONARY, recording.lens, ids=ids.tolist())
    seen = []
    with progress_bar(f"detect {video.path.stem}", video.num_frames) as advance:
        for image in read_frames(video):
            seen.append(detector.detect(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)))
            advance(1)
    found = Sightings(
        np.repeat(np.arange(len(seen)), [len(one.ids) for one in seen]),
        np.concatenate([one.ids for one in seen]),
        np.concatenate([one.corners_px for one in seen]),
    )
    with atomic_write(kept) as temporary:
        np.savez(temporary, made_of=made_of, frame=found.frame, ids=found.ids, corners_px=found.corners_px)
    return found


def _made_of(recording: Recording) -> str:
    """All that decides which markers are found, and where."""
    video, lens, status = recording.video, recording.lens, recording.video.path.stat()
    sources = sorted(Path(str(detection.__file__)).parent.glob("*.py"))
    detector = zlib.crc32(b"".join(source.read_bytes() for source in sources))
    seen = (status.st_size, status.st_mtime_ns, video.num_frames, recording.marker_map.ids.tolist())
    return repr((*seen, np.asarray(lens.K).tolist(), np.asarray(lens.dist).tolist(), detector))


def mislabelled(seen: Sightings, share: float, marker_map: MarkerMap, rng: np.random.Generator) -> Sightings:
    """The same with each marker of the map taken, with a probability, for any other marker of it."""
    ids, known = seen.ids.copy(), marker_map.ids
    wrong = np.flatnonzero(np.isin(ids, known) & (rng.random(len(ids)) < share))
    # So many places further on in the list of all: never its own.
    places = np.searchsorted(known, ids[wrong]) + rng.integers(1, len(known), len(wrong))
    ids[wrong] = known[places % len(known)]
    return replace(seen, ids=ids)
