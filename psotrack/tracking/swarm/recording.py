"""Tracking of a whole recording by the swarm: blocks of frames come from disk, and each block may be tracked again.

A candidate is a drone some frames after it was first seen. Its track begins where it was first seen, in the present
block or in the one before, and these blocks are tracked again with it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields

import numpy as np
from jaxtyping import Float

from psotrack.foreground.silhouettes import Exposures, Silhouettes, border_cells
from psotrack.geometry import Rig
from psotrack.support import Report, as_written, no_progress
from psotrack.tracking.births import TrackCandidate, state_at
from psotrack.tracking.swarm.block import BLOCK_FRAMES, Block, Engine, Setting, make_block
from psotrack.tracking.swarm.parameters import TrackerSettings
from psotrack.tracking.swarm.run import RunInputs, Start, SwarmRun
from psotrack.tracking.swarm.tracker import Rows, Slots
from psotrack.trajectories import ARRAYS, Arrival, Tracks, padded

#: Largest number of searches for new drones in a block: each time with the drones that the search before has found.
_MOST_SEARCHES = 3
#: Number of drones for which the program is compiled ahead where the number is not given.
USUAL_DRONES = 4


@dataclass(frozen=True)
class Places:
    """Where each camera shows the drones of a run, and how much the camera counts in the drones' positions.

    Attributes:
        middle_px: (frames, drones, cameras, 2), middles of the drones' foreground or detections, pixels; pixel centres
            are at whole numbers. NaN where the camera does not show the drone whole and clear of other drones.
        scale_px: (frames, drones, cameras, 2), lengths in which the method measures errors along columns and rows: half
            lengths of the drone's box, or standard deviations; NaN where the camera does not count.
    """

    middle_px: Float[np.ndarray, "frames drones cameras 2"]
    scale_px: Float[np.ndarray, "frames drones cameras 2"]

    @property
    def weight(self) -> Float[np.ndarray, "frames drones cameras 2"]:
        """(frames, drones, cameras, 2), weights of the views in the estimate; 0 where a camera does not count."""
        return np.nan_to_num(np.square(1 / np.asarray(self.scale_px, np.float64)))


@dataclass
class _Progress:
    """A run of the recording: its rows so far, and the drones before the last two blocks."""

    run: SwarmRun
    starts: list[Start]
    rows: list[Rows] = field(default_factory=list)
    before: list[Slots] = field(default_factory=list)
    arrivals: list[Arrival] = field(default_factory=list)


@as_written()
def track_silhouettes(
    rig: Rig,
    silhouettes: Silhouettes,
    runs: Sequence[RunInputs],
    *,
    fps: float,
    side_by_side: bool | None = None,
    report: Report = no_progress,
) -> list[tuple[Tracks, Places]]:
    """Track the drones of one or more runs through all frames.

    Args:
        rig: calibrated cameras.
        silhouettes: silhouettes of all cameras of the rig.
        runs: inputs of each run.
        fps: instants per second.
        side_by_side: whether runs are computed side by side, not one after the other; None: on accelerators only.
        report: shows the progress in frames; all runs go through the frames together.

    Returns:
        For each run its tracks, and where the cameras show the drones.
    """
    setting = Setting(rig, silhouettes.reduction, silhouettes.borders, fps)
    engine = Engine(setting, side_by_side=side_by_side)
    on_cpu = not engine.side_by_side
    progress = []
    for inputs in runs:
        run = SwarmRun(setting, inputs, on_cpu=on_cpu, num_frames=silhouettes.num_frames)
        progress.append(_Progress(run, [] if inputs.given is None else run.given_starts(inputs.given, 0)))
    last: Block | None = None
    with report("track", silhouettes.num_frames) as advance:
        for block in _blocks(setting, silhouettes):
            tracked = engine.track([each.run.job(block, each.starts) for each in progress], block)
            begun = list(range(len(progress)))
            for attempt in range(_MOST_SEARCHES):
                starts = {
                    number: _planned(progress[number], block, last, *tracked[number], again=attempt > 0)
                    for number in begun
                }
                begun = [number for number in begun if starts[number]]
                _track_again(
                    engine,
                    [
                        progress[number]
                        for number in begun
                        if any(start.instant < block.instant[0] for start in starts[number])
                    ],
                    last,
                )
                jobs = [progress[number].run.job(block, progress[number].starts) for number in begun]
                for number, result in zip(begun, engine.track(jobs, block), strict=True):
                    tracked[number] = result
            for each, (slots, rows) in zip(progress, tracked, strict=True):
                each.before = [*each.before[-1:], each.run.slots]
                each.rows.append(rows)
                each.run.finish(block, slots, rows)
                # The block may be tracked again with the next one: with these starts, and further ones.
                each.starts = [start for start in each.starts if start.instant >= block.instant[0]]
            last = block
            advance(len(block))
    return [_results(each) for each in progress]


@as_written()
def compile_ahead(
    rig: Rig,
    settings: TrackerSettings,
    *,
    fps: float,
    reduction: int,
    exposures: Exposures | None,
    num_frames: int,
) -> None:
    """Compile the program that `track_silhouettes` will need, while its silhouettes are made.

    The number of drones that is given is taken, or `USUAL_DRONES`: another number compiles once more, later.

    Args:
        rig: calibrated cameras.
        settings: settings of the run.
        fps: instants per second.
        reduction: image pixels per silhouette pixel, along each side.
        exposures: when the frames will be exposed; None where all cameras' frames are exposed together.
        num_frames: number of instants.
    """
    borders = border_cells(rig.cameras.image_size_wh, reduction)
    setting, length = Setting(rig, reduction, borders, fps), min(BLOCK_FRAMES, num_frames)
    engine = Engine(setting)
    coverage = np.zeros((length, len(rig), *borders.max(axis=0)[::-1]), np.uint8)
    exposed = None if exposures is None else exposures[:length]
    block = make_block(setting, np.arange(length), coverage, exposed, length=length)
    run = SwarmRun(setting, RunInputs(np.zeros((2, 3)), settings), on_cpu=not engine.side_by_side)
    engine.track([run.job(block, [])], block)  # the first block, before a drone is found
    run.resize(settings.of_run.drones.count or USUAL_DRONES)
    engine.compile(run.job(block, []), block)


def _planned(
    each: _Progress, block: Block, last: Block | None, slots: Slots, rows: Rows, *, again: bool
) -> list[Start]:
    """Tracks that start in the block that was just tracked, or in the one before; they are added to the run's."""
    run = each.run
    oldest = int((block if last is None else last).instant[0])

    def begin(candidate: TrackCandidate) -> tuple[int, np.ndarray, np.ndarray]:
        instant = max(candidate.instant, oldest)
        return instant, *state_at(candidate.path, instant, run.limits)

    starts = run.plan(run.search(block, rows, slots, again=again), block, rows, begin)
    for start in starts:
        if start.instant > 0 or start.again:
            each.arrivals.append(Arrival(start.instant, int(run.drone[start.slot]), start.again))
    each.starts = [*each.starts, *starts]
    return starts


def _track_again(engine: Engine, runs: Sequence[_Progress], block: Block | None) -> None:
    """Track the block before the present one again, of runs in which a track starts there."""
    if block is None or not runs:
        return
    jobs = [each.run.job(block, each.starts, each.before[-1]) for each in runs]
    for each, (slots, rows) in zip(runs, engine.track(jobs, block), strict=True):
        each.rows[-1] = rows
        each.run.take_back()
        each.run.finish(block, slots, rows)


def _blocks(setting: Setting, silhouettes: Silhouettes) -> Iterator[Block]:
    """The blocks of a recording; while a block is used, a thread reads the next one."""
    length, exposures = min(BLOCK_FRAMES, silhouettes.num_frames), silhouettes.exposures
    firsts = range(0, silhouettes.num_frames, BLOCK_FRAMES)

    def read(first: int) -> Block:
        stop = min(first + BLOCK_FRAMES, silhouettes.num_frames)
        exposed = None if exposures is None else exposures[first:stop]
        coverage = silhouettes.read(first, stop)
        return make_block(setting, np.arange(first, stop), coverage, exposed, length=length)

    with ThreadPoolExecutor(1) as thread:
        reading = [thread.submit(read, first) for first in firsts[:1]]
        for number in range(len(firsts)):
            block = reading.pop().result()
            reading += [thread.submit(read, first) for first in firsts[number + 1 : number + 2]]
            yield block


def _results(each: _Progress) -> tuple[Tracks, Places]:
    """The rows of all blocks of a run, by drone."""
    num_drones = int(each.run.drone.max(initial=-1)) + 1

    def joined(name: str) -> np.ndarray:
        return np.concatenate([padded(name, getattr(rows, name), num_drones) for rows in each.rows])

    arrays = {one.name: joined(one.name) for one in fields(Rows)}
    box_px = arrays.pop("box_px")
    places = Places(arrays.pop("middle_px"), box_px[..., 2:])
    slots = each.run.with_room(each.run.slots)
    tracks = Tracks(
        **{name: arrays[name] for name in ARRAYS},
        size_m=np.asarray(slots.size_m)[:num_drones],
        size_frames=np.asarray(slots.size_frames)[:num_drones],
        arrivals=tuple(each.arrivals),
    )
    return tracks, places
