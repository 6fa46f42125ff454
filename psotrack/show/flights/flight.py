"""A flight as people look at it: files of tracks, their records, the recording, and how drones look in all views."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, UInt8

from psotrack.errors import InputError, SettingsError
from psotrack.evaluation import INSIDE_90, errors_over_time
from psotrack.foreground.silhouettes import check_whole
from psotrack.pipeline import TrackedRecording
from psotrack.recordings import Recording
from psotrack.recordings.datasets import is_recording, open_recording
from psotrack.recordings.exchange import read_tracks
from psotrack.show.flights.run_record import RunRecord, as_run_record, read_run_record
from psotrack.support import drone_colour, short_repr
from psotrack.trajectories import Status, Trajectories

if TYPE_CHECKING:
    from pandas import DataFrame

_Point = Float[np.ndarray, "3"]
#: Fraction of the pale colour in the colours of predicted drones, and the grey of lost ones, 0 to 255.
_COASTING_PALER, _LOST_GREY = 0.65, 150


def statuses(trajectories: Trajectories) -> Int[np.ndarray, "frames drones"]:
    """Status of each drone in each frame; of tracks without status: lost where there is no position."""
    if trajectories.status is not None:
        return trajectories.status
    return np.where(trajectories.seen, int(Status.TRACKED), int(Status.LOST))


def colour_rgb(colour: str) -> tuple[int, int, int]:
    """A colour #rrggbb as red, green and blue, 0 to 255."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def status_rgb(
    status: Int[np.ndarray, "*frames drones"],
    colours: Sequence[str],
    *,
    lighter: float = 0.0,
    pale: int = 255,
) -> UInt8[np.ndarray, "*frames drones 3"]:
    """Colours by status: the drone's own where it is tracked, paler where it is predicted, grey where it is lost.

    Args:
        status: (..., drones), values of `Status`.
        colours: a colour per drone, as #rrggbb.
        lighter: fraction of white that is mixed into all colours, for dark backgrounds.
        pale: grey level that is mixed into the colours of predicted drones, 0 to 255.
    """
    own = np.array([colour_rgb(colour) for colour in colours], float).reshape(-1, 3)
    own += lighter * (255 - own)
    of_status = {
        Status.TRACKED: own,
        Status.COASTING: own + _COASTING_PALER * (pale - own),
        Status.LOST: np.full_like(own, _LOST_GREY),
    }
    table = np.rint([of_status[each] for each in Status]).astype(np.uint8)
    return table[status, np.arange(len(colours))]


def ellipsoids_90(
    covariance_m2: Float[np.ndarray, "*points 3 3"],
) -> tuple[Float[np.ndarray, "*points 3"], Float[np.ndarray, "*points 3 3"]]:
    """The ellipsoid that holds 90 % of each normal distribution.

    Args:
        covariance_m2: (..., 3, 3), covariances, m²; NaN where unknown.

    Returns:
        (..., 3), half lengths of the axes, from the shortest to the longest, metres, NaN where unknown; and
        (..., 3, 3), rotation matrices whose columns are the directions of the axes in the world.
    """
    known = np.isfinite(covariance_m2).all(axis=(-2, -1))
    whole = np.where(known[..., None, None], covariance_m2, np.eye(3)).astype(np.float64)
    variance_m2, directions = np.linalg.eigh(whole)
    # Eigenvectors may form a left-handed system, which is no rotation.
    directions[..., :, 0] *= np.linalg.det(directions)[..., None]
    half_m = np.sqrt(np.maximum(variance_m2, 0.0) * INSIDE_90)
    return np.where(known[..., None], half_m, np.nan), directions


_logger = logging.getLogger(__name__)

#: Full lengths of a drone of whose size the record says nothing, metres: an assumption, for drawing only.
USUAL_SIZE_M = (0.3, 0.3, 0.3)
#: Name of tracks that are of no file.
_IN_MEMORY = "tracks"
#: Largest distance of a row from a time that it is shown at, in intervals between rows.
_NEAR = 0.6


@dataclass(frozen=True, repr=False)
class FlightTracks:
    """The tracks of one file.

    Attributes:
        label: name of the tracks, which no other tracks of the flight have.
        path: the file, or a folder of another format; see `exchange.read_tracks`.
        trajectories: the tracks.
        record: the record of the run; None where there is none beside the file.
        size_m: (drones, 3), full lengths of the drones along the world's axes, metres: as the run learned them, else
            `USUAL_SIZE_M`.
        colours: a colour per drone, as #rrggbb; where several files of tracks are compared, one colour per file.
        group: the label where several files of tracks are compared; else empty.
    """

    label: str
    path: Path
    trajectories: Trajectories
    record: RunRecord | None
    size_m: Float[np.ndarray, "drones 3"]
    colours: tuple[str, ...]
    group: str = ""

    __repr__ = short_repr

    @property
    def names(self) -> tuple[str, ...]:
        """The shown name of each drone: with the label where several files of tracks are compared."""
        return tuple(f"{self.group} {drone}".strip() for drone in self.trajectories.drones)


@dataclass(frozen=True, repr=False)
class TrackedFlight:
    """Tracks, and the recording that they belong to.

    Attributes:
        name: name of the recording, or of the first tracks.
        tracks: the tracks of each file; empty where only the recording is known.
        recording: the recording; None where only the tracks are known.
    """

    name: str
    tracks: tuple[FlightTracks, ...]
    recording: Recording | None

    __repr__ = short_repr

    @property
    def truth(self) -> Trajectories | None:
        """The reference of the recording; None where there is none."""
        return None if self.recording is None else self.recording.truth

    @property
    def bounds_m(self) -> tuple[_Point, _Point] | None:
        """Lowest and highest coordinates of tracks, reference and cameras, metres; None where nothing has a place."""
        parts = [each.trajectories.position_m[each.trajectories.seen] for each in self.tracks]
        if self.truth is not None:
            parts.append(self.truth.position_m)
        if self.recording is not None:
            parts.append(np.asarray(self.recording.rig.cameras.centre_world))
        points_m = np.concatenate([np.zeros((0, 3)), *(part.reshape(-1, 3) for part in parts)])
        points_m = points_m[np.isfinite(points_m).all(axis=-1)]
        return (points_m.min(axis=0), points_m.max(axis=0)) if len(points_m) else None

    def errors(self, tracks: FlightTracks) -> DataFrame | None:
        """Errors of tracks over time, see `errors_over_time`; None where there is nothing to compare.

        The reference may begin after the tracks end, or know no position.
        """
        try:
            return None if self.truth is None else errors_over_time(tracks.trajectories, self.truth)
        except InputError:
            return None


def read_flight(
    tracks: Sequence[Path | str] = (),
    sequence: Recording | Path | str | None = None,
    *,
    cameras: Sequence[str] | None = None,
) -> TrackedFlight:
    """Read tracks, their records and their recording.

    Args:
        tracks: files of tracks.
        sequence: the recording, or its path as for `open_recording`; None: the one that the record of the first tracks
            names, as far as it is there.
        cameras: names of the cameras to keep; None: all.

    Raises:
        InputError: a file cannot be used, there is neither a file of tracks nor a recording, a recording stands where
            tracks are expected, or tracks have no instant of the recording.
        SettingsError: a camera is unknown.
    """
    paths = [Path(path) for path in tracks]
    for path in paths:
        if is_recording(path):
            remedy = "name the recording last, TRACKS [SEQ]"
            raise InputError(path, expected="a file of tracks", found="a recording", remedy=remedy)
    sequence = find_recording(paths[0]) if sequence is None and paths else sequence
    if sequence is None or isinstance(sequence, Recording):
        recording = sequence
    else:
        recording = open_recording(sequence)
    if recording is not None and cameras is not None:
        recording = recording.usable(cameras, videos=False)
    if recording is None and cameras is not None:
        raise SettingsError("cameras", expected="a recording, which has the cameras", found="none")
    if recording is None and not paths:
        raise InputError("flight", expected="files of tracks, or a recording", found="neither")
    read = [
        read_tracks_file(path, label, recording) for path, label in zip(paths, _labels(paths), strict=True)
    ]
    if len(read) > 1:
        read = [
            replace(each, group=each.label, colours=(drone_colour(number),) * len(each.colours))
            for number, each in enumerate(read)
        ]
    for each in read:
        if recording is not None:
            _check_fits(each, recording)
    return TrackedFlight(
        recording.name if recording is not None else _name_of(read[0]), tuple(read), recording
    )


def split_sequence(paths: Sequence[Path]) -> tuple[tuple[Path, ...], Path | None]:
    """Files of tracks, and the recording if the last one of some paths is a recording."""
    if paths and is_recording(paths[-1]):
        return tuple(paths[:-1]), paths[-1]
    return tuple(paths), None


def flight_of(tracks: TrackedRecording | Trajectories, recording: Recording | None = None) -> TrackedFlight:
    """The flight of tracks that are in memory.

    Args:
        tracks: the result of `track`, or trajectories.
        recording: the recording; None shows the tracks alone.
    """
    if isinstance(tracks, TrackedRecording):
        record = as_run_record(dict(tracks.record), _IN_MEMORY)
        own = _flight_tracks(_IN_MEMORY, Path(_IN_MEMORY), tracks.trajectories, record)
    else:
        own = _flight_tracks(_IN_MEMORY, Path(_IN_MEMORY), tracks, None)
    return TrackedFlight(_name_of(own) if recording is None else recording.name, (own,), recording)


def rows_at(trajectories: Trajectories, time_s: Float[np.ndarray, "times"]) -> Int[np.ndarray, "times"]:
    """The row of trajectories that is nearest to each time; -1 where none is near."""
    own_s, at_s = np.asarray(trajectories.time_s, np.float64), np.asarray(time_s, np.float64)
    nearest = np.searchsorted((own_s[:-1] + own_s[1:]) / 2, at_s)
    interval_s = max(
        (float(np.median(np.diff(each_s))) for each_s in (own_s, at_s) if len(each_s) > 1), default=0
    )
    return np.where(np.abs(own_s[nearest] - at_s) <= _NEAR * interval_s + 1e-9, nearest, -1)


def find_recording(tracks: Path | str) -> Path | None:
    """The recording that the record beside tracks names; None where there is none, with a warning if it is gone.

    Raises:
        InputError: the record cannot be read.
    """
    record = _record_beside(Path(tracks))
    if record is None or not record.recording:
        return None
    path = Path(tracks).parent / record.recording
    if path.exists():
        return path
    _logger.warning("%s: its recording %s is not there; name the recording to see its cameras", tracks, path)
    return None


def first_instants(flight: TrackedFlight, num_frames: int) -> TrackedFlight:
    """The first instants of a flight: of its recording, of the cameras on drones, of the reference and of all tracks.

    Args:
        flight: the flight.
        num_frames: number of instants of the recording; without a recording, of each file of tracks.

    Raises:
        SettingsError: the recording has fewer instants.
        InputError: tracks begin later.
    """
    if flight.recording is None:
        check_whole("frames", num_frames, lowest=1)
        tracks = (_until(each, each.trajectories.time_s[:num_frames][-1]) for each in flight.tracks)
        return replace(flight, tracks=tuple(tracks))
    recording = flight.recording.usable(num_frames=num_frames, videos=False)
    end_s = float(recording.timeline().time_s[-1]) + 0.5 / recording.fps
    onboard = {}
    for name, camera in recording.onboard.items():
        count = max(1, min(camera.video.num_frames, int(end_s * camera.video.fps) + 1))
        onboard[name] = replace(camera, video=replace(camera.video, num_frames=count))
    reference = recording.reference
    if reference is not None:
        reference = replace(reference, truth=_cut(reference.truth, end_s))
    recording = replace(recording, onboard=onboard, reference=reference)
    return replace(flight, recording=recording, tracks=tuple(_until(each, end_s) for each in flight.tracks))


def _until(tracks: FlightTracks, end_s: float) -> FlightTracks:
    if tracks.trajectories.time_s[0] > end_s:
        raise InputError(
            tracks.path,
            expected=f"times before {end_s:.2f} s",
            found=f"{tracks.trajectories.time_s[0]:.2f} s",
        )
    return replace(tracks, trajectories=_cut(tracks.trajectories, end_s))


def _cut(trajectories: Trajectories, end_s: float) -> Trajectories:
    return trajectories.at_frames(trajectories.frame[trajectories.time_s <= end_s])


def read_tracks_file(path: Path | str, label: str, recording: Recording | None = None) -> FlightTracks:
    """Read one file of tracks and the record beside it.

    Args:
        path: the file, or a folder of another format; see `exchange.read_tracks`.
        label: name of the tracks.
        recording: the recording, whose rate is that of tracks without times.

    Raises:
        InputError: the file or its record cannot be read.
    """
    path = Path(path)
    trajectories, record = read_tracks(path, recording=recording), _record_beside(path)
    return _flight_tracks(label, path, trajectories, record)


def _flight_tracks(
    label: str, path: Path, trajectories: Trajectories, record: RunRecord | None
) -> FlightTracks:
    learned = () if record is None or isinstance(record.drones, int) else record.drones
    sizes_m = {f"{drone.drone}": drone.size_m for drone in learned}
    size_m = np.array([sizes_m.get(name, USUAL_SIZE_M) for name in trajectories.drones]).reshape(-1, 3)
    colours = tuple(drone_colour(drone) for drone in range(trajectories.num_drones))
    return FlightTracks(label, path, trajectories, record, size_m, colours)


def _record_beside(tracks: Path) -> RunRecord | None:
    path = tracks.with_suffix(".json")
    return read_run_record(path) if path.is_file() and path != tracks else None


def _labels(paths: Sequence[Path]) -> list[str]:
    """Names of files: their own names without suffix, or with as many folders as they need to differ."""
    for count in range(1, max((len(path.parts) for path in paths), default=1) + 1):
        labels = ["/".join(path.with_suffix("").parts[-count:]) for path in paths]
        if len(set(labels)) == len(labels):
            return labels
    twice = next(path for number, path in enumerate(paths) if path in paths[:number])
    raise InputError(twice, expected="different files of tracks", found="one file twice")


def _name_of(tracks: FlightTracks) -> str:
    return tracks.record.sequence if tracks.record is not None and tracks.record.sequence else tracks.label


def _check_fits(tracks: FlightTracks, recording: Recording) -> None:
    """Raise `InputError` for tracks of another recording, as far as their record or their times say so."""
    if tracks.record is not None and tracks.record.sequence not in ("", recording.name):
        raise InputError(
            tracks.path,
            expected=f"tracks of {recording.name}",
            found=f"tracks of {tracks.record.sequence}",
            remedy=f"name the recording {tracks.record.sequence}, or remove {tracks.path.with_suffix('.json').name} "
            "if the recording was renamed",
        )
    first_s, last_s = tracks.trajectories.time_s[[0, -1]]
    begin_s, end_s = recording.timeline().time_s[[0, -1]]
    # Tracks of this package have instants of their recording only; other programs may have tracked for longer.
    apart = first_s > end_s or last_s < begin_s
    longer = tracks.record is not None and last_s > end_s + 1 / recording.fps
    if apart or longer:
        raise InputError(
            tracks.path,
            expected=f"times from {begin_s:.2f} to {end_s:.2f} s, as in {recording.name}",
            found=f"{first_s:.2f} to {last_s:.2f} s",
            remedy="name the recording that was tracked",
        )
