"""Tracking without the future: drones are found while frames come, and no row depends on a later frame."""

from __future__ import annotations

import numpy as np
import pytest
from drawn_flights import (
    AWAY,
    CELL_M,
    EFFORT,
    ENTERS,
    FPS,
    NUM_FRAMES,
    REDUCTION,
    RIG,
    TRUTH_M,
    comings_and_goings,
    draw,
    run_inputs,
    track,
)
from helpers import ROOM_M, ring_rig, track_settings

from psotrack.foreground.silhouettes import Exposures
from psotrack.geometry import Rig
from psotrack.tracking.births import InitialState
from psotrack.tracking.swarm import StepwiseTracker, block, stepwise, tracker_settings
from psotrack.tracking.swarm.run import SwarmRun
from psotrack.trajectories import Status, Trajectories

SHAPE = (120, 160)
#: A drone has a track in the frame after the eighth in which it is found.
SOON = 8


def exposures(missing: tuple[int, ...] = ()) -> Exposures:
    zero = np.zeros(len(RIG), np.float32)
    return Exposures(zero, ~np.isin(np.arange(len(RIG)), missing), zero + 1, zero)


def new_tracker(
    rig: Rig = RIG, shape: tuple[int, int] = SHAPE, most_drones: int = 16, **settings: object
) -> StepwiseTracker:
    return StepwiseTracker(
        rig,
        tracker_settings(track_settings(**(EFFORT | settings))),
        fps=FPS,
        bounds_m=ROOM_M,
        reduction=REDUCTION,
        shape=shape,
        most_drones=most_drones,
    )


def step_by_step(
    images: np.ndarray,
    tracker: StepwiseTracker | None = None,
    missing: dict[int, tuple[int, ...]] | None = None,
    kept: list[int] | None = None,
) -> list[Trajectories]:
    """The rows of all frames, or of those that are kept."""
    rows, tracker = [], tracker or new_tracker()
    for frame in range(len(images)) if kept is None else kept:
        shown = exposures((missing or {}).get(frame, ()))
        rows.append(tracker.step(frame, frame / FPS, images[frame], shown))
        tracker.look_ahead()
    return rows


def error_m(rows: Trajectories, drone: int, truth_m: np.ndarray) -> float:
    return float(np.linalg.norm(rows.position_m[0, rows.drones.index(f"{drone}")] - truth_m))


@pytest.fixture(scope="module")
def tracked() -> list[Trajectories]:
    return step_by_step(comings_and_goings())


@pytest.mark.slow
def test_drones_that_come_leave_and_return_keep_their_numbers(tracked: list[Trajectories]) -> None:
    numbers = [rows.drones for rows in tracked]
    assert not any(numbers[:SOON])
    assert set(numbers[SOON : ENTERS + SOON]) == {("0",)}
    assert set(numbers[ENTERS + SOON :]) == {("0", "1")}
    for frame in [*range(SOON, AWAY.start), *range(AWAY.stop + SOON, NUM_FRAMES)]:
        assert error_m(tracked[frame], 0, TRUTH_M[frame, 0]) < CELL_M
    for frame in range(ENTERS + SOON, NUM_FRAMES):
        assert error_m(tracked[frame], 1, TRUTH_M[frame, 1]) < CELL_M
    assert tracked[AWAY.stop - 1].status.tolist() == [[Status.LOST, Status.TRACKED]]


@pytest.mark.slow
def test_rows_do_not_depend_on_later_frames(tracked: list[Trajectories]) -> None:
    other = comings_and_goings()[:70].copy()
    other[60:] = 0
    again = step_by_step(other)
    for rows, same in zip(tracked[:60], again[:60], strict=True):
        assert rows.drones == same.drones
        for name in ("position_m", "velocity_m_s", "covariance_m2", "fitness", "num_cameras", "status"):
            assert getattr(rows, name).tobytes() == getattr(same, name).tobytes(), name


@pytest.mark.slow
def test_a_recording_is_tracked_as_it_is_frame_by_frame(tracked: list[Trajectories]) -> None:
    """Both find the same drones. Tracks begin at different instants, with other random numbers."""
    tracks, apart_m = track(comings_and_goings()), []
    for frame, rows in enumerate(tracked):
        drones = np.array(rows.drones, int)
        both = (rows.status[0] == Status.TRACKED) & (tracks.status[frame, drones] == Status.TRACKED)
        off_m = np.linalg.norm(rows.position_m[0] - tracks.position_m[frame, drones], axis=-1)
        apart_m += off_m[both].tolist()
    assert len(apart_m) > NUM_FRAMES
    # A tenth of a cell; the first frames of a track are a few millimetres apart.
    assert np.median(apart_m) < CELL_M / 10
    assert max(apart_m) < CELL_M


@pytest.mark.slow
def test_a_camera_that_is_missing_or_sees_foreground_everywhere_loses_no_drone(
    tracked: list[Trajectories],
) -> None:
    dazzled = comings_and_goings().copy()
    dazzled[85:95, 2] = 255
    rows = step_by_step(dazzled, missing=dict.fromkeys(range(80, 100), (0,)))
    for frame in range(88, NUM_FRAMES):
        assert rows[frame].drones == tracked[frame].drones
        for drone in (0, 1):
            assert error_m(rows[frame], drone, TRUTH_M[frame, drone]) < CELL_M


@pytest.mark.slow
@pytest.mark.parametrize("every", [(True, True, False), (True, False, False)])
def test_frames_that_are_left_out_count_as_time(every: tuple[bool, ...]) -> None:
    """A drone of 1 m/s is found while frames are left out, and its track begins with its velocity.

    The velocity was that between frames, and the first prediction was off by the distance of the frames left out.
    """
    number = np.arange(60)
    frames = number[np.resize(every, len(number))].tolist()
    velocity_m_s = np.array([0.8, 0.6, 0.0])
    truth_m = np.array([-1.0, -0.6, 1.2]) + number[:, None] / FPS * velocity_m_s
    images = np.zeros((len(number), len(RIG), *SHAPE), np.uint8)
    images[frames] = draw(truth_m[frames, None], np.array([[0.5, 0.5, 0.3]]))
    rows = step_by_step(images, kept=frames)
    assert [found.num_drones for found in rows] == [0] * SOON + [1] * (len(frames) - SOON)
    for frame, found in zip(frames[SOON:], rows[SOON:], strict=True):
        assert found.status == Status.TRACKED
        assert error_m(found, 0, truth_m[frame]) < CELL_M / 2
        # Measured 0.06 m/s in the first frame, and 0.4 to 0.6 m/s before.
        assert np.linalg.norm(found.velocity_m_s - velocity_m_s) < 0.15


@pytest.mark.slow
def test_a_drone_that_was_lost_for_long_leaves_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stepwise, "FORGOTTEN_S", 0.8)
    drones = comings_and_goings()[:25]
    nothing = np.zeros_like(comings_and_goings()[:40])
    rows = step_by_step(np.concatenate([drones, nothing, drones]), new_tracker(drones=1))
    # The drone comes back under a new number; there is one place, which is used again.
    assert [rows[frame].drones for frame in (24, 64, 89)] == [("0",), (), ("1",)]
    # More drones than allowed are left out.
    limited = step_by_step(comings_and_goings()[ENTERS : ENTERS + 20], new_tracker(drones=1))
    assert {found.num_drones for found in limited} == {0, 1}


def test_a_track_may_wait_for_a_slot_that_the_next_frame_adds() -> None:
    """Three drones are found together, where there are two slots: to forget drones then raised an IndexError."""
    setting = block.Setting(RIG, REDUCTION, np.array([SHAPE[::-1]] * len(RIG)), FPS)
    run = SwarmRun(setting, run_inputs())
    places_m, size_m = np.arange(9.0).reshape(3, 3), np.full((3, 3), 0.5)
    waiting = run.given_starts(InitialState(places_m, np.zeros((3, 3)), size_m, np.full(3, 5.0)), 7)
    assert len(run.slots) == 2
    run.forget(oldest=-100)
    assert run.known == [start.slot for start in waiting] == [0, 1, 2]


# --- compilations: one per capacity of the slots and shape of the images, for all values of the inputs

SMALL = ring_rig(3, image_size_wh=(80, 60))
SMALL_SHAPE = (30, 40)


def track_noise(num_drones: int, *, seed: int = 0, **settings: object) -> None:
    """Track given drones in random silhouettes of 30 frames."""
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 256, (30, len(SMALL), *SMALL_SHAPE)).astype(np.uint8)
    places_m = rng.uniform([-1, -1, 0.5], [1, 1, 2.5], (num_drones, 3))
    size_m = np.full((num_drones, 3), 0.4 + 0.1 * seed)
    given = InitialState(places_m, np.zeros((num_drones, 3)), size_m, np.full(num_drones, 3.0))
    effort = {"particles": 7, "iterations": 3, "seed": seed, "drones": num_drones}
    tracks = track(images, given, rig=SMALL, **(effort | settings))
    assert tracks.num_drones == num_drones


def compiled() -> int:
    """Number of programs of the tracker that this process has compiled so far."""
    return block._one_run._cache_size()


@pytest.mark.slow
def test_a_new_number_of_drones_within_a_capacity_and_other_values_compile_nothing() -> None:
    before = compiled()
    track_noise(3)
    # One block of 25 frames, and one that is filled up to 25: the same program.
    assert compiled() == before + 1
    track_noise(4, seed=1, max_speed_m_s=3.0, inertia=0.4, min_fitness=0.3)
    track_noise(4, seed=2, iterations=0, cognitive=2.0, social=0.1, spread_m=0.2, max_coasting_s=2.0)
    assert compiled() == before + 1
    # The test can see a compilation: five drones need more slots.
    track_noise(5)
    assert compiled() == before + 2


@pytest.mark.slow
def test_no_frame_waits_for_a_compilation() -> None:
    tracker = new_tracker(rig=SMALL, shape=SMALL_SHAPE, most_drones=4, particles=7, iterations=3)
    tracker.compile()
    before, zero = compiled(), np.zeros(len(SMALL), np.float32)
    for frame in range(3):
        images = np.full((len(SMALL), *SMALL_SHAPE), 40 * frame, np.uint8)
        there = np.arange(len(SMALL)) != frame
        tracker.step(2 * frame, 0.08 * frame, images, Exposures(zero, there, zero + 1, zero))
        tracker.look_ahead()
    assert compiled() == before
