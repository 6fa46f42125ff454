"""The search for drones without a track while frames come.

A search takes as long as several frames. So the tracks that it finds begin some time after the frames that were
searched, and until then the candidates are followed. This time depends on what was found, and not on the computer: a
search beside the tracker, in another process, finds the same as a search that the tracker waits for.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Bool, Float, UInt8

from psotrack.geometry import Camera
from psotrack.initiation.new_tracks import (
    FollowedCandidate,
    KnownDrones,
    compile_search,
    find_candidates,
    follow_candidates,
    search_volume,
)

#: Frames that are searched, and number of frames between two searches.
SEARCHED_FRAMES, SEARCH_EVERY = 15, 5
#: Time from the last frame that is searched to the first frame of the tracks, seconds: for the search, more for each
#: candidate, and for the result to arrive; in this last part candidates need not be followed. With 8 cameras, one
#: processor takes 0.05 to 0.08 s for each candidate; cameras and tracker take the rest of the time.
SEARCH_S, CANDIDATE_S, ARRIVAL_S = 0.3, 0.15, 0.16
#: Time between two frames in which candidates are followed, seconds. A drone leaves its course by 13 cm in this time,
#: with an acceleration of 10 m/s².
FOLLOW_EVERY_S = 0.16
#: A candidate that was not seen for longer is given up, seconds.
_MOST_MISSED_S = 0.5
#: A candidate that is hidden for more frames at the end of the frames that are searched is none.
_MOST_HIDDEN = 4
#: Number of candidates that explain foreground while they are followed.
_EXPLAINING = 16


@dataclass(frozen=True)
class SeenFrame:
    """A frame, and the drones that the tracker knows in it; with a place in the arrays for each drone.

    Attributes:
        number: number of the frame, from 0.
        coverage: (cameras, height, width), silhouettes.
        is_there: (cameras,), whether the camera has a frame.
        position_m: (places, 3), positions of the drones; any value where the drone does not explain foreground.
        explains: (places,), whether the drone explains foreground.
        size_m: (places, 3), full lengths of the drones; NaN for a place without a drone.
        moved_m: (places, cameras, 3), motion of the drones from the instant to each camera's exposure.
        is_wanted: whether a track may begin.
        begun: number of the last result whose tracks have begun; 0 for none.
    """

    number: int
    coverage: UInt8[np.ndarray, "cameras height width"]
    is_there: Bool[np.ndarray, "cameras"]
    position_m: Float[np.ndarray, "places 3"]
    explains: Bool[np.ndarray, "places"]
    size_m: Float[np.ndarray, "places 3"]
    moved_m: Float[np.ndarray, "places cameras 3"]
    is_wanted: bool
    begun: int


@dataclass(frozen=True)
class FoundCandidates:
    """A result of the search.

    Attributes:
        number: number of the result, from 1; a result with the same number is an update.
        begin_frame: number of the frame in which the tracks shall begin.
        last_frame: number of the last frame in which the candidates were followed.
        candidates: the candidates, whose frames have the numbers of the frames that were seen.
    """

    number: int
    begin_frame: int
    last_frame: int
    candidates: tuple[FollowedCandidate, ...]


@runtime_checkable
class DroneSearch(Protocol):
    """Searches frames for drones without a track."""

    def compile(self) -> None:
        """Compile what `see` calls, so that no frame has to wait for it."""
        ...

    def see(self, frame: SeenFrame) -> list[FoundCandidates]:
        """Take the next frame; tell what was found."""
        ...


@dataclass
class _Group:
    """Candidates of one search, which are followed until their tracks begin."""

    number: int
    tell_frame: int
    begin_frame: int
    candidates: tuple[FollowedCandidate, ...]


class CandidateSearch:
    """Searches the frames that `see` is given, which waits for the search.

    Args:
        cameras: cameras with one leading axis, for the full image.
        reduction: image pixels per silhouette pixel, along each side.
        fps: frames per second.
        bounds_m: (2, 3), lowest and highest corner of the room, metres.
        max_speed_m_s: largest speed of a drone.
        min_viewpoints: smallest number of viewpoints that must see a drone; None: three, or two if the rig has no
            third.
        places: numbers of places for drones for which `compile` compiles.
    """

    def __init__(
        self,
        cameras: Camera,
        *,
        reduction: int,
        fps: float,
        bounds_m: Float[np.ndarray, "2 3"],
        max_speed_m_s: float,
        min_viewpoints: int | None,
        places: tuple[int, ...],
    ) -> None:
        self._cameras, self._reduction, self._fps, self._bounds_m = cameras, reduction, fps, bounds_m
        self._max_speed_m_s, self._min_viewpoints, self._places = max_speed_m_s, min_viewpoints, places
        self._volume = search_volume(cameras, bounds_m, reduction, min_viewpoints)
        self._follow_every = max(1, round(FOLLOW_EVERY_S * fps))
        self._recent: deque[SeenFrame] = deque(maxlen=SEARCHED_FRAMES)
        self._followed: list[_Group] = []
        self._num_results, self._last_begin = 0, 0

    def compile(self) -> None:
        """Compile what `see` calls, so that no frame has to wait for it."""
        with jax.default_device(jax.local_devices(backend="cpu")[0]):
            for places in self._places:
                compile_search(self._cameras, SEARCHED_FRAMES, places + _EXPLAINING, self._reduction)

    def see(self, frame: SeenFrame) -> list[FoundCandidates]:
        """Take the next frame; tell what was found in earlier searches, some frames before the tracks shall begin.

        Until the tracks have begun, updates follow.
        """
        self._followed = [group for group in self._followed if group.number > frame.begun]
        # The search takes many small steps, for which a CPU serves best.
        with jax.default_device(jax.local_devices(backend="cpu")[0]):
            found = self._follow(frame)
            self._remember(frame)
            if (
                frame.is_wanted
                and frame.number % SEARCH_EVERY == SEARCH_EVERY - 1
                and len(self._recent) == SEARCHED_FRAMES
                and len(self._candidates) < _EXPLAINING
            ):
                self._search(frame.number)
        return found

    @property
    def _candidates(self) -> tuple[FollowedCandidate, ...]:
        return tuple(each for group in self._followed for each in group.candidates)

    def _remember(self, frame: SeenFrame) -> None:
        """Keep a frame, with the drones and the followed candidates that explain its foreground."""
        frame = self._explained(frame, self._candidates[:_EXPLAINING])
        before = self._recent[-1] if self._recent else frame
        # Frames that were left out, and more places for drones, begin anew.
        if before.number not in (frame.number, frame.number - 1) or len(before.size_m) != len(frame.size_m):
            self._recent.clear()
        self._recent.append(frame)

    def _explained(self, frame: SeenFrame, candidates: tuple[FollowedCandidate, ...]) -> SeenFrame:
        """The frame with candidates as further drones; always with the same number of places for them."""
        position_m, size_m = np.full((2, _EXPLAINING, 3), np.nan)
        for row, candidate in enumerate(candidates):
            last = candidate.last
            elapsed_s = (frame.number - last.frame) / self._fps
            position_m[row], size_m[row] = last.position_m + elapsed_s * last.velocity_m_s, candidate.size_m
        return replace(
            frame,
            position_m=np.concatenate([frame.position_m, position_m]),
            explains=np.append(frame.explains, np.arange(_EXPLAINING) < len(candidates)),
            size_m=np.concatenate([frame.size_m, size_m]),
            moved_m=np.pad(frame.moved_m, ((0, _EXPLAINING), (0, 0), (0, 0))),
        )

    def _search(self, number: int) -> None:
        first = number + 1 - SEARCHED_FRAMES
        found = find_candidates(
            self._cameras,
            np.stack([frame.coverage for frame in self._recent]),
            self._known_drones(list(self._recent)),
            reduction=self._reduction,
            fps=self._fps,
            bounds_m=self._bounds_m,
            max_speed_m_s=self._max_speed_m_s,
            # The tracker learns the sizes.
            measures_sizes=False,
        )
        candidates = tuple(
            replace(each, frame=first + each.frame, last=replace(each.last, frame=first + each.last.frame))
            for each in found
            if each.last.frame >= SEARCHED_FRAMES - 1 - _MOST_HIDDEN
        )
        if candidates:
            self._num_results += 1
            tell = number + max(1, round((SEARCH_S + CANDIDATE_S * len(found)) * self._fps))
            # The results come one after the other.
            self._last_begin = max(self._last_begin, tell + 1 + round(ARRIVAL_S * self._fps))
            self._followed.append(_Group(self._num_results, tell, self._last_begin, candidates))

    def _follow(self, frame: SeenFrame) -> list[FoundCandidates]:
        """Follow the candidates of all searches together; the results that are to be told."""
        is_due = frame.number % self._follow_every == 0
        if not self._followed or not (
            is_due or any(frame.number == each.tell_frame for each in self._followed)
        ):
            return []
        followed = follow_candidates(
            self._volume,
            frame.coverage,
            self._known_drones([self._explained(frame, ())]),
            self._candidates,
            frame=frame.number,
            fps=self._fps,
            max_speed_m_s=self._max_speed_m_s,
        )
        oldest = frame.number - _MOST_MISSED_S * self._fps
        stop = 0
        for group in self._followed:
            first, stop = stop, stop + len(group.candidates)
            group.candidates = tuple(each for each in followed[first:stop] if each.last.frame >= oldest)
        self._followed = [group for group in self._followed if group.candidates]
        return [
            FoundCandidates(group.number, group.begin_frame, frame.number, group.candidates)
            for group in self._followed
            if frame.number >= group.tell_frame
        ]

    def _known_drones(self, frames: list[SeenFrame]) -> KnownDrones:
        size_m = frames[-1].size_m
        for frame in reversed(frames):  # a candidate of earlier frames has a size there
            size_m = np.where(np.isnan(size_m), frame.size_m, size_m)
        return KnownDrones(
            np.stack([frame.position_m for frame in frames]),
            np.stack([frame.explains for frame in frames]),
            size_m,
            moved_m=np.stack([frame.moved_m for frame in frames]),
            is_there=np.stack([frame.is_there for frame in frames]),
            min_viewpoints=self._min_viewpoints,
        )
