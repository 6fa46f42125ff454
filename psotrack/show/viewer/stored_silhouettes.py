"""The silhouettes in which the drones of a flight were found, from the store."""

from __future__ import annotations

from pathlib import Path

import msgspec

from psotrack.errors import InputError
from psotrack.foreground.silhouettes import Silhouettes, SilhouetteSettings, compute, stored_silhouettes
from psotrack.show.flights import TrackedFlight
from psotrack.support import Report, no_progress


def find_silhouettes(
    flight: TrackedFlight,
    cache: Path,
    *,
    make: bool = False,
    jobs: int | None = None,
    report: Report = no_progress,
) -> Silhouettes | None:
    """The silhouettes of a flight's cameras by frames; None where they are not stored, or no camera has a video.

    Args:
        flight: the flight; the settings of the silhouettes are those of its first tracks.
        cache: folder of the store.
        make: whether silhouettes that are not stored are computed.
        jobs: largest number of processes; None is one per processor.
        report: progress.

    Raises:
        InputError: a video cannot be read, or the record of the tracks has settings that cannot be read.
    """
    if flight.recording is None or not flight.recording.videos:
        return None
    settings = _settings(flight)
    recording = flight.recording.usable(videos=False)
    stored = stored_silhouettes(recording, settings, cache).values()
    if not make and not all(each.path.exists() for each in stored):
        return None
    return compute(recording, settings, cache=cache, jobs=jobs, all_videos=False, report=report)


def _settings(flight: TrackedFlight) -> SilhouetteSettings:
    """The settings of the first tracks with a record of them, else the defaults."""
    for tracks in flight.tracks:
        if tracks.record is not None and "silhouettes" in tracks.record.settings:
            try:
                return msgspec.convert(tracks.record.settings["silhouettes"], SilhouetteSettings)
            except msgspec.ValidationError as error:
                where = f"{tracks.path.with_suffix('.json')}, settings.silhouettes"
                expected = "settings of silhouettes"
                raise InputError(where, expected=expected, found=f"{error}") from error
    return SilhouetteSettings()
