"""The result of a run: trajectories with names that last, and the record."""

from __future__ import annotations

import logging
import platform
import shlex
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from typing import Any

import jax
import msgspec
import numpy as np
from jaxtyping import Bool, Float

from psotrack.errors import InputError
from psotrack.geometry import in_images
from psotrack.pipeline.inputs import Run
from psotrack.settings import BLOBS, DroneSettings, TrackSettings, flatten
from psotrack.support import evenly_spread, html_block, html_lines, identify
from psotrack.tracking.births import (
    BirthRules,
    count_common,
    find_cut_off,
    find_outside,
    state_at_first_frame,
)
from psotrack.tracking.camera_errors import TrackErrors
from psotrack.tracking.identity import Identities, postprocess
from psotrack.tracking.matching import are_near, from_silhouettes
from psotrack.trajectories import Status, Tracks, Trajectories, drones_html

logger = logging.getLogger(__name__)

#: Where detections of different cameras meet in a smaller share of the frames, something is wrong with the cameras:
#: rays of false detections meet by chance.
_FEW_MET = 0.2
#: A camera is named that shows nothing in a larger share of the instants at which it should, from some instant on, for
#: a second and a larger share of all these instants.
_BLIND_SHARE, _LEAST_BLIND = 0.5, 0.2
#: Number of frames in which explained detections are counted.
_COUNTED_FRAMES = 100
#: Tracks and a camera's detections do not belong together where less than this share of both has a partner: false
#: detections leave detections alone, missing ones leave tracks alone. Fewer detections than this number say nothing.
_FEW_EXPLAINED, _TOO_FEW = 0.5, 10
#: Settings that the data give where nobody does, and the key of the record's `volume` that says which.
_FOUND = {"motion.max_speed_m_s": "speed_from", "bounds_m": "bounds_from"}


@dataclass(frozen=True)
class MethodResult:
    """The result of a method for one run.

    Attributes:
        tracks: tracks of all frames.
        points: for each drone the point that its track follows (no image shows where the origin of the body is), as
            the record has it: the contract's key `points`.
        input_keys: digests of the inputs, by camera.
        seconds: seconds of the stages after the silhouettes: "track" at least, "compile", and "finish" so far.
        errors: errors of the tracks that come from the cameras; None where the method states all errors itself.
    """

    tracks: Tracks
    points: list[dict[str, Any]]
    input_keys: Mapping[str, str]
    seconds: Mapping[str, float]
    errors: TrackErrors | None = None


@dataclass(frozen=True)
class TrackedRecording:
    """The result of tracking a recording.

    Attributes:
        trajectories: positions and covariances of every drone in every frame.
        size_m: (drones, 3), full lengths of each drone along the world's axes, as learned, metres.
        identities: which drones may have been taken for each other, and when.
        record: settings, versions, device, input keys and seconds per stage, fit for JSON.
    """

    trajectories: Trajectories
    size_m: Float[np.ndarray, "drones 3"]
    identities: Identities
    record: Mapping[str, Any]

    @property
    def _title(self) -> str:
        drones, frames = self.trajectories.num_drones, self.trajectories.num_frames
        seen = self.trajectories.seen.mean()
        return f"{self.record['sequence']}: {drones} drones, {frames} frames, {seen:.1%} seen"

    def __repr__(self) -> str:
        return f"TrackedRecording({self._title}, {self.record['seconds']['total']:.1f} s)"

    def _repr_html_(self) -> str:
        """What a notebook shows: the drones, their paths from above, other settings than the defaults, and seconds."""
        changed = [f"{name} = {value}" for name, value in changed_settings(self.record).items()]
        seconds = [f"{stage} {spent:.1f}" for stage, spent in self.record["seconds"].items()]
        lines = html_lines({"settings": ", ".join(changed), "seconds": ", ".join(seconds)})
        return html_block(self._title, drones_html(self.trajectories, self.size_m), lines)


def changed_settings(record: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a run that somebody chose and that are not today's defaults, by their dotted names.

    Args:
        record: record of the run.
    """
    # Through JSON, because a record that was read from a file has lists where settings have tuples.
    usual, used = (
        dict(flatten(msgspec.json.decode(msgspec.json.encode(settings))))
        for settings in (TrackSettings(), record["settings"])
    )

    def is_chosen(name: str) -> bool:
        # The record has the values that were used, also where the data gave them.
        return name not in _FOUND or record.get("volume", {}).get(_FOUND[name]) == "given"

    return {
        name: used[name] for name in usual if used.get(name, usual[name]) != usual[name] and is_chosen(name)
    }


def finish(run: Run, result: MethodResult) -> TrackedRecording | InputError:
    """Resolve identities, smooth, move to the body's origin, and write the record of one run."""
    recording, silhouettes = run.recording, run.silhouettes
    settings, tracks, errors = run.settings, result.tracks, result.errors
    limited = find_outside(run.volume) or find_cut_off(tracks, run.volume, recording.fps)
    if limited is not None:
        logger.warning("%s", limited)
    if not tracks.num_drones:
        return _no_drones(run)
    warn_of_missing_drones(settings, tracks.num_drones)
    began = time.perf_counter()
    explained = _explained(run, tracks)
    # How errors fade is known once the whole recording was seen.
    smoothing = settings.motion if errors is None else errors.smoothing(settings.motion)
    trajectories, identities = postprocess(
        tracks,
        settings.motion,
        settings.identity,
        fps=recording.fps,
        bounds_m=run.volume.bounds_m,
        smoothing=smoothing if settings.smooth else None,
    )
    if errors is not None:
        trajectories = errors.added_to(
            trajectories, identities.order if settings.identity.resolve_swaps else None
        )
    body_m = trajectories.position_m - settings.drones.body_offset_m
    origin_m = settings.drones.origin_uncertainty_m
    if origin_m and trajectories.covariance_m2 is not None:
        wider_m2 = trajectories.covariance_m2 + origin_m**2 * np.eye(3)
        trajectories = replace(trajectories, covariance_m2=wider_m2)
    timeline = recording.timeline()
    trajectories = replace(trajectories, position_m=body_m, time_s=timeline.time_s)
    seconds = dict.fromkeys(("decode", "foreground", "silhouettes", "compile", "finish"), 0.0)
    seconds |= {} if silhouettes is None else silhouettes.seconds
    seconds["volume"] = run.volume_s
    seconds |= result.seconds
    seconds["finish"] += time.perf_counter() - began
    seconds["total"] = sum(seconds[stage] for stage in ("volume", "track", "compile", "finish"))
    record = {
        "sequence": recording.name,
        "frames": trajectories.num_frames,
        "cameras": list(recording.rig.names),
        "rate_hz": timeline.rate_hz,
        "camera_times": {
            each.name: {
                "fps": each.times.fps,
                "time_offset_s": each.times.time_offset_s,
                "frames": each.times.num_frames,
            }
            for each in recording.placed
            if each.times is not None
        },
        **({} if run.clocks is None else {"camera_clocks": run.clocks.record(recording.rig.names)}),
        "settings": msgspec.to_builtins(settings),
        **({"parts": {kind: identify(part) for kind, part in run.parts.items()}} if run.parts else {}),
        "seed": settings.seed,
        "start": {name: value.tolist() for name, value in vars(state_at_first_frame(tracks)).items()},
        "bounds_m": run.volume.bounds_m.tolist(),
        "volume": run.volume.record,
        "drones": [
            {
                "drone": drone,
                "size_m": size_m.tolist(),
                "size_std_m": [None] * 3,
                "size_frames": num_frames.tolist(),
                "fill": None,
            }
            for drone, (size_m, num_frames) in enumerate(zip(tracks.size_m, tracks.size_frames, strict=True))
        ],
        "arrivals": [asdict(arrival) for arrival in tracks.arrivals],
        "points": result.points,
        "ellipsoid": centre_of_ellipsoids((point["middle_of"] for point in result.points), settings.drones),
        "knocks": _knocks(run, errors),
        "explained": explained,
        "camera_errors": {} if errors is None else errors.record(recording.rig.names),
        "encounters": [asdict(encounter) for encounter in identities.encounters],
        "input_keys": dict(result.input_keys),
        "left_out": {} if silhouettes is None else dict(silhouettes.left_out),
        "seconds": {stage: round(value, 4) for stage, value in seconds.items()},
        **environment(),
    }
    return TrackedRecording(trajectories, tracks.size_m, identities, record)


def _knocks(run: Run, errors: TrackErrors | None) -> list[dict[str, Any]]:
    """Cameras that were knocked in mid-flight: when, by how much, and whether they are left out from then on."""
    kept = () if errors is None or errors.knock is None else (errors.knock,)
    return [
        {
            "camera": run.recording.rig.names[knock.camera],
            "frame": knock.frame,
            "shift_px": knock.shift_px.tolist(),
            "left_out": number < len(run.knocks),
        }
        for number, knock in enumerate((*run.knocks, *kept))
    ]


def _explained(run: Run, tracks: Tracks) -> dict[str, Any]:
    """Shares of the detections that are near a track, of all cameras and of each, in frames that have tracks.

    Warns of cameras whose detections and the tracks do not belong together, as with a wrong rig.
    """
    rig, cameras = run.recording.rig, run.recording.rig.cameras
    tracked = np.asarray(tracks.status == Status.TRACKED)
    frames = np.flatnonzero(tracked.any(axis=1))
    frames = frames[evenly_spread(len(frames), _COUNTED_FRAMES)]
    if run.sightings is not None:
        sightings = run.sightings[frames]
    else:
        assert run.silhouettes is not None, "a run has silhouettes or sightings"
        sightings = from_silhouettes(run.silhouettes, frames=frames)
    position_m, velocity_m_s = (
        np.asarray(values, float)[frames] for values in (tracks.position_m, tracks.velocity_m_s)
    )
    position_m = np.where(tracked[frames, :, None], position_m, np.nan)
    near = are_near(cameras, sightings, position_m, velocity_m_s)
    visible = in_images(cameras, position_m)
    seen = np.isfinite(sightings.noise_px).sum(axis=(0, 2))
    explained = near.any(axis=1).sum(axis=(0, 2))
    in_view, found = visible.sum(axis=(0, 1)), (visible & near.any(axis=-1)).sum(axis=(0, 1))
    few = (explained < _FEW_EXPLAINED * seen) & (found < _FEW_EXPLAINED * in_view) & (seen >= _TOO_FEW)
    if few.any():
        logger.warning(
            "the tracks explain only %.0f %% of the detections of %s: place, lens, clock or detections may be wrong; "
            "run `psotrack doctor %s`",
            100 * explained[few].sum() / seen[few].sum(),
            ", ".join(np.array(rig.names)[few]),
            shlex.quote(f"{run.recording.folder}"),
        )
    shares = [float(part / whole) if whole else None for part, whole in zip(explained, seen, strict=True)]
    share = float(explained.sum() / seen.sum()) if seen.any() else None
    return {"share": share, "cameras": dict(zip(rig.names, shares, strict=True))}


def centre_of_ellipsoids(middle_of: Iterable[str], drones: DroneSettings) -> str:
    """The point of a drone for which the covariances hold: the body's origin only where its uncertainty is stated."""
    if drones.origin_uncertainty_m is not None:
        return "the body's origin"
    middles = sorted(set(middle_of), reverse=True)
    return f"the middle of the {' or the '.join(middles)}" if middles else "the point that the method follows"


def warn_of_missing_drones(settings: TrackSettings, num_drones: int) -> None:
    """Say how many drones were seen, where the settings ask for more."""
    count = settings.drones.count
    if count is not None and num_drones < count:
        logger.warning("--drones %d: only %d drones were seen; the tracks have no others", count, num_drones)


def warn_of_blind_cameras(run: Run, tracks: Tracks, shown: Bool[np.ndarray, "frames drones cameras"]) -> None:
    """Name the cameras that show no drone in most instants at which they should, by the tracks, from some instant on.

    Args:
        run: the run.
        tracks: its tracks.
        shown: (frames, drones, cameras), whether a camera shows a drone.
    """
    found = (np.asarray(tracks.status) == Status.TRACKED)[..., None]
    in_view = found & in_images(run.recording.rig.cameras, np.asarray(tracks.position_m, np.float64))
    exposures = None if run.silhouettes is None else run.silhouettes.exposures
    there = run.recording.timeline().is_there if exposures is None else np.asarray(exposures.is_there)
    should = in_view.any(axis=1) & there
    for name, of_camera, is_shown in zip(
        run.recording.rig.names, should.T, np.asarray(shown.any(axis=1)).T, strict=True
    ):
        instants = np.flatnonzero(of_camera)
        blind = ~is_shown[instants]
        # A camera that is turned away, or goes blind, does so at some instant.
        more_than_usual = np.cumsum((blind - _BLIND_SHARE)[::-1])[::-1]
        first = int(more_than_usual.argmax()) if len(instants) else 0
        lately = blind[first:]
        if lately.sum() > max(_BLIND_SHARE * len(lately), run.recording.fps) and (
            len(lately) > _LEAST_BLIND * len(instants)
        ):
            logger.warning(
                "camera %s shows no drone in %d of the last %d instants at which the tracks have one in its view, from "
                "frame %d on; look at %s",
                name,
                lately.sum(),
                len(lately),
                instants[first],
                "its detections"
                if run.silhouettes is None
                else "what it sees: `psotrack detect --silhouettes`",
            )


def _no_drones(run: Run) -> InputError:
    """The error that says why no drone was found, as far as that is known."""
    found = "none in any frame"
    least_m, most_m = BirthRules(size_m=run.settings.drones.size_m).spans_m
    remedy = "look at what the cameras see (`psotrack detect --silhouettes`), give the drones' first positions (--init)"
    if run.by_swarm or run.settings.detections == BLOBS:
        remedy += f", or their size (--drone-size) if they are not {least_m:.2g} to {most_m:.2g} m wide"
    recording = run.recording
    detected = run.silhouettes if run.sightings is None else run.sightings
    if detected is not None:
        seen, met = count_common(recording.rig, detected)
        if met < _FEW_MET * seen:
            share = f"{met} of {seen} frames"
            found += f", and detections of different cameras that meet in a place in {share}"
            remedy = f"check the rig, its unit and the clocks: `psotrack doctor {shlex.quote(f'{recording.folder}')}`"
    return InputError(recording.folder, expected="drones", found=found, remedy=remedy)


def environment() -> dict[str, Any]:
    """Versions and device on which a result depends, fit for JSON."""
    packages = ("psotrack", "jax", "jaxlib", "numpy", "opencv-python-headless", "zarr")
    device = jax.devices()[0]
    return {
        "versions": {"python": platform.python_version()} | {name: version(name) for name in packages},
        "device": {"platform": device.platform, "kind": device.device_kind, "machine": platform.machine()},
    }


def speed_in_words(real_time_factor: float) -> str:
    """How fast a run was, from its seconds of video per second of wall clock: "16 times slower than the video"."""
    times = max(real_time_factor, 1 / real_time_factor)
    if times < 1.05:
        return "as fast as the video"
    return f"{float(f'{times:.2g}'):g} times {'faster' if real_time_factor > 1 else 'slower'} than the video"


def with_real_time(record: Mapping[str, Any], wall_s: float, *, start_s: float = 0.0) -> dict[str, Any]:
    """The record with its real-time factors: seconds of video per second of wall clock.

    The factor "running" leaves out the time in which the program started and compiled.

    Args:
        record: record of a run.
        wall_s: time from the first byte that was read to the last row, seconds.
        start_s: part of it that the program took to start.
    """
    video_s = record["frames"] / record["rate_hz"]
    running_s = max(wall_s - start_s - record["seconds"]["compile"], 1e-3)
    return {
        **record,
        "seconds": {**record["seconds"], "total": round(wall_s, 4)},
        # Three digits, however slow the run is.
        "real_time_factor": float(f"{video_s / wall_s:.3g}"),
        "real_time_factor_running": float(f"{video_s / running_s:.3g}"),
    }
