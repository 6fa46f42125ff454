"""Tracking without the future: drones are found while frames come, and no row depends on a later frame."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from helpers import ROOM_M, draw_coverage, ring_rig, track_settings

from psotrack.errors import InputError, OutputError, SettingsError
from psotrack.initiation import FoundCandidates, SeenFrame, candidate_search
from psotrack.pipeline import causal_settings
from psotrack.settings import TrackSettings
from psotrack.silhouettes import Exposures
from psotrack.tracking import CausalRow, CausalTracker, causal, tracker_settings
from psotrack.trajectories import RowStream, Status, Trajectories, read_trajectories, write_trajectories

FPS = 25.0
REDUCTION = 2
RIG = ring_rig(5, image_size_wh=(480, 360))
SIZE_M = np.array([[0.5, 0.5, 0.3], [0.6, 0.6, 0.35]])
SHAPE = (180, 240)
NUM_FRAMES = 215
#: A cell of a silhouette is 2 px; at 4 m and a focal length of 390 px that is 2 cm.
CELL_M = 0.02
#: The first drone is away for a while and comes back elsewhere; the second enters late.
AWAY, ENTERS = slice(75, 115), 45
#: Time from the last frame that is searched to the track of a single drone, seconds.
BEGIN_S = candidate_search.SEARCH_S + candidate_search.CANDIDATE_S + candidate_search.ARRIVAL_S
#: Frames after which a drone has a track: those that are searched, those to the next search, and the time after it.
SOON = candidate_search.SEARCHED_FRAMES + candidate_search.SEARCH_EVERY + round(BEGIN_S * FPS) + 2


def _paths() -> np.ndarray:
    """(frames, 2, 3) positions; NaN where there is no drone."""
    time_s = np.arange(NUM_FRAMES)[:, None] / FPS
    first = np.array([-0.9, -0.6, 1.2]) + time_s * [0.25, 0.1, 0.05]
    first[AWAY.stop :] += [0.3, -0.9, 0.2]
    second = np.array([0.9, 0.9, 0.9]) + time_s * [-0.1, 0.05, 0.05]
    truth = np.stack([first, second], axis=1)
    truth[AWAY, 0] = np.nan
    truth[:ENTERS, 1] = np.nan
    return truth


TRUTH_M = _paths()


@pytest.fixture(scope="module")
def coverage() -> np.ndarray:
    """(frames, cameras, height, width), drawn silhouettes."""
    there = np.isfinite(TRUTH_M).all(axis=-1)
    return np.array(
        [
            draw_coverage(RIG, positions[visible], SIZE_M[visible], REDUCTION)
            for positions, visible in zip(TRUTH_M, there, strict=True)
        ]
    )


def _exposures(missing: tuple[int, ...] = ()) -> Exposures:
    zero = np.zeros(len(RIG), np.float32)
    is_there = np.ones(len(RIG), bool)
    is_there[list(missing)] = False
    return Exposures(zero, is_there, zero + 1, zero)


def _tracker(**settings: object) -> CausalTracker:
    chosen = track_settings(particles=20, iterations=15, **settings)
    return CausalTracker(
        RIG, tracker_settings(chosen), fps=FPS, bounds_m=ROOM_M, reduction=REDUCTION, shape=SHAPE
    )


def _track(
    tracker: CausalTracker, coverage: np.ndarray, missing: dict[int, tuple[int, ...]] | None = None
) -> list[list[CausalRow]]:
    rows = []
    for frame, images in enumerate(coverage):
        rows.append(tracker.step(images, _exposures((missing or {}).get(frame, ()))))
        tracker.look_ahead()
    return rows


def _error_m(rows: list[CausalRow], drone: int, truth_m: np.ndarray) -> float:
    (row,) = (row for row in rows if row.drone == drone)
    return float(np.linalg.norm(row.position_m - truth_m))


@pytest.fixture(scope="module")
def tracked(coverage: np.ndarray, optimised: None) -> list[list[CausalRow]]:
    return _track(_tracker(), coverage)


@pytest.mark.slow
def test_drones_that_come_leave_and_return_keep_their_numbers(tracked: list[list[CausalRow]]) -> None:
    numbers = [{row.drone for row in rows} for rows in tracked]
    assert not numbers[0]
    assert all(found == {0} for found in numbers[SOON:ENTERS])
    assert all(found == {0, 1} for found in numbers[ENTERS + SOON :])
    back = range(AWAY.stop + SOON, NUM_FRAMES)
    for frame in [*range(SOON + 10, AWAY.start), *back]:
        assert _error_m(tracked[frame], 0, TRUTH_M[frame, 0]) < CELL_M
    for frame in range(ENTERS + SOON + 10, NUM_FRAMES):
        assert _error_m(tracked[frame], 1, TRUTH_M[frame, 1]) < CELL_M
    status = {row.drone: row.status for row in tracked[AWAY.stop - 1]}
    assert status == {0: Status.LOST, 1: Status.TRACKED}


@pytest.mark.slow
def test_rows_do_not_depend_on_later_frames(tracked: list[list[CausalRow]], coverage: np.ndarray) -> None:
    other = coverage.copy()
    other[130:] = 0
    again = _track(_tracker(), other)
    for rows, same in zip(tracked[:130], again[:130], strict=True):
        assert len(rows) == len(same)
        for one, two in zip(rows, same, strict=True):
            np.testing.assert_array_equal(one.position_m, two.position_m)
            np.testing.assert_array_equal(one.covariance_m2, two.covariance_m2)
            assert one.status == two.status


@pytest.mark.slow
def test_a_camera_that_is_missing_or_sees_foreground_everywhere_loses_no_drone(
    tracked: list[list[CausalRow]], coverage: np.ndarray
) -> None:
    dazzled = coverage.copy()
    dazzled[180:190, 2] = 255
    rows = _track(_tracker(), dazzled, missing=dict.fromkeys(range(170, 200), (0,)))
    for frame in range(190, NUM_FRAMES):
        assert {row.drone for row in rows[frame]} == {row.drone for row in tracked[frame]}
        for drone in (0, 1):
            assert _error_m(rows[frame], drone, TRUTH_M[frame, drone]) < CELL_M


@pytest.mark.slow
def test_one_program_for_all_frames(coverage: np.ndarray, optimised: None) -> None:
    tracker = _tracker()
    tracker.compile()
    compiled = causal._step._cache_size(), causal._with_learned_sizes._cache_size()
    _track(tracker, coverage[:110])
    assert (causal._step._cache_size(), causal._with_learned_sizes._cache_size()) == compiled


@pytest.mark.slow
def test_frames_that_were_left_out_count_as_time(coverage: np.ndarray, optimised: None) -> None:
    tracker = _tracker()
    _track(tracker, coverage[:60])
    rows = tracker.step(coverage[63], _exposures(), num_frames=4)
    assert _error_m(rows, 0, TRUTH_M[63, 0]) < CELL_M


@pytest.mark.slow
def test_a_drone_that_was_lost_for_long_leaves_its_place(
    coverage: np.ndarray, optimised: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(causal, "FORGOTTEN_S", 0.8)
    tracker = _tracker()
    nothing = np.zeros_like(coverage[:60])
    again = np.concatenate([coverage[:50], nothing, coverage[:50], nothing, coverage[:50]])
    rows = _track(tracker, again)
    assert rows[109] == []
    # The drone comes back under a new number each time, and the places are used again.
    assert [row.drone for row in rows[159]] == [1]
    assert [row.drone for row in rows[269]] == [2]
    assert len(tracker._number) == causal.CAPACITIES[0]


@pytest.mark.slow
def test_more_drones_than_allowed_are_left_out(coverage: np.ndarray, optimised: None) -> None:
    rows = _track(_tracker(drones=1), coverage[:110])
    assert {row.drone for frame in rows for row in frame} == {0}


class _LateSearch:
    """A search whose results and updates come some frames late."""

    def __init__(self, tracker: CausalTracker, num_frames: int) -> None:
        self._search, self._num_frames = tracker.search, num_frames
        self._waiting: list[list[FoundCandidates]] = []

    def compile(self) -> None:
        self._search.compile()

    def see(self, frame: SeenFrame) -> list[FoundCandidates]:
        self._waiting.append(self._search.see(frame))
        return self._waiting.pop(0) if len(self._waiting) > self._num_frames else []


@pytest.mark.slow
def test_the_result_of_a_search_beside_the_tracker_begins_at_the_same_frame(
    tracked: list[list[CausalRow]], coverage: np.ndarray
) -> None:
    """A result that comes in time changes nothing; a late one begins later, where the drone is by then."""
    in_time, late = _tracker(), _tracker()
    arrival_frames = round(candidate_search.ARRIVAL_S * FPS)
    in_time.search, late.search = _LateSearch(in_time, arrival_frames), _LateSearch(late, arrival_frames + 3)
    for rows, same in zip(tracked[:60], _track(in_time, coverage[:60]), strict=True):
        assert [row.drone for row in rows] == [row.drone for row in same]
        for one, two in zip(rows, same, strict=True):
            np.testing.assert_array_equal(one.position_m, two.position_m)
    assert in_time.num_late == 0
    rows = _track(late, coverage[:110])
    began, began_late = (next(frame for frame, found in enumerate(each) if found) for each in (tracked, rows))
    assert late.num_late == 2
    assert began < began_late <= began + 4
    for frame in range(SOON + 15, AWAY.start):
        assert _error_m(rows[frame], 0, TRUTH_M[frame, 0]) < CELL_M
    assert {row.drone for row in rows[-1]} == {0, 1}


@pytest.mark.slow
def test_a_result_that_is_too_old_begins_no_track(coverage: np.ndarray, optimised: None) -> None:
    tracker = _tracker()
    tracker.search = _LateSearch(tracker, round((causal.STALE_S + candidate_search.ARRIVAL_S) * FPS) + 1)
    assert not any(_track(tracker, coverage[: AWAY.start]))
    assert tracker.num_late == 1


@pytest.mark.slow
def test_a_drone_that_appears_while_another_one_is_followed_has_a_track_soon(
    coverage: np.ndarray, optimised: None
) -> None:
    """It is found in the first search after the tracks of the others began, in frames before that."""
    flight_m = np.array([0.9, -0.9, 1.0]) + np.arange(80)[:, None] / FPS * [0.1, 0.3, 0.0]
    both = coverage[:80].copy()
    for frame in range(20, 80):
        later = draw_coverage(RIG, flight_m[frame, None], SIZE_M[:1], REDUCTION)
        both[frame] = np.maximum(both[frame], later)
    rows = _track(_tracker(), both)
    begun = [next(frame for frame, found in enumerate(rows) if len(found) >= count) for count in (1, 2)]
    assert begun[1] - begun[0] <= round(BEGIN_S * FPS) + candidate_search.SEARCH_EVERY + 1
    assert _error_m(rows[-1], 1, flight_m[-1]) < CELL_M


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"method": "fused"}, "method"),
        ({"smooth": True}, "smooth"),
        ({"init": "truth"}, "init"),
        ({"clocks": "auto"}, "clocks"),
        ({"silhouettes.background": "mog2"}, "first_look"),
    ],
)
def test_what_needs_the_future_is_refused(change: dict[str, object], name: str) -> None:
    with pytest.raises(SettingsError, match=rf"{name}: expected .*"):
        causal_settings(TrackSettings().changed(change))


# --- Tables that grow


def _frames() -> list[Trajectories]:
    rng = np.random.default_rng(0)
    frames = []
    for frame in range(7):
        drones = tuple("ab"[: frame % 3])
        count = len(drones)
        frames.append(
            Trajectories(
                frame=np.array([frame]),
                time_s=np.array([frame / FPS]),
                drones=drones,
                position_m=rng.normal(size=(1, count, 3)).astype(np.float32),
                velocity_m_s=rng.normal(size=(1, count, 3)).astype(np.float32),
                fitness=rng.random((1, count)).astype(np.float32),
                num_cameras=np.full((1, count), 4),
                status=np.zeros((1, count), int),
                covariance_m2=np.broadcast_to(np.eye(3, dtype=np.float32), (1, count, 3, 3)),
            )
        )
    return frames


def test_a_table_that_grows_has_the_rows_of_a_table_that_is_written_at_once(tmp_path: Path) -> None:
    frames = _frames()
    with RowStream(tmp_path / "rows.csv") as rows:
        for frame in frames:
            rows.write(frame)
            # What was written can be read at once.
            assert (tmp_path / "rows.csv").read_text().startswith("frame,time_s,drone")
    header, *lines = (tmp_path / "rows.csv").read_text().splitlines()
    expected: list[str] = []
    for frame in frames:
        write_trajectories(tmp_path / "one.csv", frame, force=True)
        first, *more = (tmp_path / "one.csv").read_text().splitlines()
        assert first == header
        expected += more
    assert lines == expected
    assert len(list(csv.reader(lines))) == sum(len(frame.drones) for frame in frames)


def test_a_parquet_table_appears_when_it_is_complete(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    with RowStream(path) as rows:
        for frame in _frames():
            rows.write(frame)
            assert not path.exists()
    found = read_trajectories(path)
    assert found.drones == ("a", "b")
    assert [path.name] == [each.name for each in tmp_path.iterdir()]
    for frame in _frames():
        for index, name in enumerate(frame.drones):
            row = found.position_m[list(found.frame).index(frame.frame[0]), found.drones.index(name)]
            np.testing.assert_array_equal(row.astype(np.float32), frame.position_m[0, index])


def test_a_table_that_exists_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").write_text("mine")
    with pytest.raises(OutputError, match=r"rows\.csv"):
        RowStream(tmp_path / "rows.csv")
    with pytest.raises(InputError, match=r"\.csv or \.parquet"):
        RowStream(tmp_path / "rows.txt")
    assert (tmp_path / "rows.csv").read_text() == "mine"
