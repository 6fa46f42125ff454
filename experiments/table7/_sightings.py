"""The markers that are seen in every frame of a video: detected once, kept in a file, and mislabelled at will."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from _recordings import Recording
from jaxtyping import Float, Int

from psotrack.foreground import markers
from psotrack.foreground.markers import DetectedMarkers, MarkerDetector
from psotrack.inside_out import MarkerMap
from psotrack.recordings import read_frames
from psotrack.support import atomic_write, progress_bar

DICTIONARY = "4x4_1000"


@dataclass(frozen=True)
class Sightings:
    """Detected markers of all frames.

    Attributes:
        frame: (seen,), frame of each detected marker, not decreasing.
        ids: (seen,), id of each detected marker.
        corners_px: (seen, 4, 2), corners in the image, pixels.
        std_px: (seen,), standard deviation of a marker's corners, pixels.
    """

    frame: Int[np.ndarray, "seen"]
    ids: Int[np.ndarray, "seen"]
    corners_px: Float[np.ndarray, "seen 4 2"]
    std_px: Float[np.ndarray, " seen"]

    def in_frame(self, frame: int) -> DetectedMarkers:
        """Markers of one frame."""
        first, last = np.searchsorted(self.frame, [frame, frame + 1])
        return DetectedMarkers(self.ids[first:last], self.corners_px[first:last], self.std_px[first:last])


def detected(recording: Recording, kept: Path) -> Sightings:
    """Detect the markers of the map in a video, or read them from the file `kept` if its inputs have not changed."""
    video, ids = recording.video, recording.marker_map.ids
    made_of = _made_of(recording)
    if kept.exists():
        with np.load(kept) as stored:
            if str(stored["made_of"]) == made_of:
                return Sightings(stored["frame"], stored["ids"], stored["corners_px"], stored["std_px"])
    detector = MarkerDetector(DICTIONARY, recording.lens, ids=ids.tolist())
    seen = []
    with progress_bar(f"detect {video.path.stem}", video.num_frames) as advance:
        for image in read_frames(video):
            seen.append(detector.detect(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)).of_single_ids())
            advance(1)
    found = Sightings(
        np.repeat(np.arange(len(seen)), [len(one.ids) for one in seen]),
        np.concatenate([one.ids for one in seen]),
        np.concatenate([one.corners_px for one in seen]),
        np.concatenate([one.std_px for one in seen]),
    )
    columns = {"ids": found.ids, "corners_px": found.corners_px, "std_px": found.std_px}
    with atomic_write(kept) as temporary:
        np.savez(temporary, made_of=made_of, frame=found.frame, **columns)
    return found


def _made_of(recording: Recording) -> str:
    """Text that changes whenever an input of the detection changes."""
    video, lens, status = recording.video, recording.lens, recording.video.path.stat()
    sources = sorted(Path(str(markers.__file__)).parent.glob("*.py"))
    detector = zlib.crc32(b"".join(source.read_bytes() for source in sources))
    seen = (status.st_size, status.st_mtime_ns, video.num_frames, recording.marker_map.ids.tolist())
    return repr((*seen, np.asarray(lens.K).tolist(), np.asarray(lens.dist).tolist(), detector))


def mislabelled(seen: Sightings, share: float, marker_map: MarkerMap, rng: np.random.Generator) -> Sightings:
    """Replace the id of each marker, with the probability `share`, by the id of another marker of the map."""
    ids, known = seen.ids.copy(), marker_map.ids
    wrong = np.flatnonzero(np.isin(ids, known) & (rng.random(len(ids)) < share))
    # A shift of at least 1 and less than the number of markers never gives the same id.
    places = np.searchsorted(known, ids[wrong]) + rng.integers(1, len(known), len(wrong))
    ids[wrong] = known[places % len(known)]
    return replace(seen, ids=ids)
