"""Births of drones from silhouettes of ellipsoids that are drawn by ray casting, and of lost drones once more."""

from dataclasses import dataclass, replace
from itertools import permutations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_flights import FPS, REDUCTION
from drawn_flights import RIG as FIVE
from helpers import ROOM_M, draw_coverage, float32, ring_rig, silhouettes_in_memory
from motion_textbook import van_loan
from scipy.stats import multivariate_normal, norm

from psotrack.foreground.silhouettes import border_cells
from psotrack.geometry import make_extents, project_boxes
from psotrack.settings import DroneSettings
from psotrack.tracking.births import (
    NEW,
    BirthRules,
    Births,
    FlightLimits,
    FrameBlobs,
    KnownDrones,
    LostTracks,
    TrackCandidate,
    find_false_tracks,
    find_lost_tracks,
    first_drones,
    reidentify,
    unexplained,
)
from psotrack.tracking.births.reidentification import NO_DRONE
from psotrack.tracking.matching import NOISE_PX, from_silhouettes

NUM_FRAMES = 25
MAX_SPEED_M_S = 3.0
IMAGE_WH = (240, 180)
RIG = ring_rig(6, image_size_wh=IMAGE_WH)
#: Width of a cell of 2 px at a distance of 4 m, for focal lengths of 200 px and of 260 px.
CELL_M, CELL_5_M = 0.04, 0.03
SIZE_M = np.array([0.5, 0.5, 0.3])


def path(position_m, velocity_m_s=(0.0, 0.0, 0.0), acceleration_m_s2=(0.0, 0.0, 0.0), num_frames=NUM_FRAMES):
    """Positions on a parabola over time: (frames, 3)."""
    time_s = np.arange(num_frames)[:, None] / FPS
    bend = np.asarray(acceleration_m_s2) * time_s**2 / 2
    return np.asarray(position_m) + np.asarray(velocity_m_s) * time_s + bend


def draw(*paths_m, size_m=SIZE_M, rig=RIG):
    """Silhouettes of drones on paths: (frames, cameras, height, width)."""
    sizes = np.broadcast_to(np.array(size_m, float), (len(paths_m), 3))
    drawn = [draw_one_drone(*each, rig) for each in zip(paths_m, sizes, strict=True)]
    return np.maximum.reduce(drawn)


def draw_one_drone(path_m, size_m, rig):
    """Silhouettes of one drone, kept in a dictionary because ray casting is slow and tests share paths."""
    key = (path_m.tobytes(), size_m.tobytes(), rig.cameras.K.tobytes(), rig.cameras.T_cam_world.tobytes())
    if key not in _DRAWN:
        # A drone that stands still looks the same in every frame.
        places, which = np.unique(path_m, axis=0, return_inverse=True)
        images = np.stack([draw_coverage(rig, place, size_m, REDUCTION) for place in places])
        _DRAWN[key] = images[which.ravel()]
    return _DRAWN[key]


_DRAWN = {}


@jax.jit
def boxes_of(cameras, position_m, size_m):
    """(drones, cameras, 4), middles and half lengths of the drones' boxes."""
    boxes = project_boxes(make_extents(cameras, size_m), position_m)
    return jnp.stack([boxes.x_middle, boxes.y_middle, boxes.x_half, boxes.y_half], axis=-1)


def step(births, instant, images, *known_m, size_m=SIZE_M, rig=RIG):
    """The next frame, with known drones at some places."""
    position_m = np.array(known_m).reshape(-1, 3)
    sizes_m = np.broadcast_to(np.array(size_m, float), position_m.shape)
    box_px = np.empty((0, len(rig), 4))
    if known_m:
        box_px = np.float64(boxes_of(*float32((rig.cameras, position_m, sizes_m))))
    blobs = FrameBlobs.of(images[None], REDUCTION, border_cells(rig.cameras.image_size_wh, REDUCTION))
    shown = unexplained(blobs, box_px[None])
    births.step(instant, shown[0], KnownDrones(position_m, sizes_m, box_px))


def candidates_in(coverage, *known_m, size_m=SIZE_M, rig=RIG, first=0, **rules):
    """Candidates after all frames; `first` is the instant of the first frame."""
    births = Births(rig.cameras, FlightLimits(FPS, ROOM_M, MAX_SPEED_M_S), BirthRules(**rules))
    for frame, images in enumerate(coverage):
        known = [one[frame] for one in known_m]
        step(births, first + frame, images, *known, size_m=size_m, rig=rig)
    return births.candidates()


def blank(coverage, frames=slice(None), cameras=slice(None)):
    """The silhouettes, empty in some frames and cameras."""
    coverage = coverage.copy()
    coverage[frames, cameras] = 0
    return coverage


def assert_found(found, *paths_m, atol=CELL_M):
    """Each drone is one candidate, at the drone's position in the candidate's first frame; returns them in order."""
    assert len(found) == len(paths_m)
    in_order = []
    for each in paths_m:
        off_m = [np.linalg.norm(one.position_m - each[one.instant]) for one in found]
        assert min(off_m) < atol
        in_order.append(found[int(np.argmin(off_m))])
    assert len({id(one) for one in in_order}) == len(found)
    return in_order


ONE = path((0.6, -0.5, 1.5), (0.8, 0.2, 0.1))
OTHER = path((-0.7, 0.6, 0.9), (0.0, -1.0, 0.2), (1.0, 0.5, 0.0))


def test_a_drone_that_is_not_known_is_found():
    assert candidates_in(draw(ONE, OTHER), ONE, OTHER) == ()
    (found,) = candidates_in(draw(ONE, OTHER), ONE)
    assert found.instant == 0
    # Each of six views gives a blob's middle to a fraction of a cell. Limit one cell.
    np.testing.assert_allclose(found.position_m, OTHER[0], atol=CELL_M)
    # At the end of a parabola through ten positions, the standard error of the speed is 0.44 times the error of a
    # position per frame; 3 mm give 0.03 m/s. Measured 0.13, limit 0.3.
    np.testing.assert_allclose(found.velocity_m_s, (0.0, -1.0, 0.2), atol=0.3)
    # A cell belongs to a blob if a quarter of it is covered, so a blob is at most half a cell too wide at each end.
    # The height is computed from a difference of squares.
    np.testing.assert_allclose(found.size_m[:2], SIZE_M[:2], atol=1.5 * CELL_M)
    np.testing.assert_allclose(found.size_m[2], SIZE_M[2], atol=2 * CELL_M)
    # One of six cameras has the drone at its image's border.
    assert found.num_cameras >= 5


@pytest.mark.parametrize(
    ("hidden", "first"),
    [
        (slice(15), 15),
        # Eight of ten frames are needed, and are enough for a drone that is gone by the time that somebody asks.
        ([*range(10), *range(17, 25)], None),
        ([*range(10), *range(18, 25)], 10),
        (slice(1, 25, 2), None),
        # A drone that flickers or is hidden for a while is one candidate; the tracker finds it again after the gap.
        ([5, 12, 13, 14, 15, 16, 17, 18], 0),
        (slice(10, 25), 0),
    ],
)
def test_a_candidate_must_persist_and_begins_with_its_first_frame(hidden, first):
    found = candidates_in(blank(draw(OTHER), hidden))
    assert [one.instant for one in found] == ([] if first is None else [first])
    if found:
        assert_found(found, OTHER)


@pytest.mark.parametrize(("share", "count"), [(1.2, 1), (1.7, 0)])
def test_a_candidate_is_not_much_faster_than_a_drone(share, count):
    """Up to half faster than the limit: the report says that a drone flies at the limit."""
    flight = path((-1.5, 0.0, 1.5), (share * MAX_SPEED_M_S, 0.0, 0.0), num_frames=12)
    found = candidates_in(draw(flight))
    assert len(found) == count
    for one in found:
        assert np.linalg.norm(one.velocity_m_s) <= MAX_SPEED_M_S + 1e-9


def test_shadows_and_reflections_are_no_candidates():
    """Both look the same in all views and move like drones; shadows are flat on the floor, reflections below it."""
    shadow, reflection = ONE * (1, 1, 0), ONE * (1, 1, -1)
    things = [ONE[:12], shadow[:12], reflection[:12]]
    coverage = draw(*things, size_m=[SIZE_M, [0.5, 0.5, 0.02], SIZE_M])
    assert candidates_in(coverage, ONE) == ()
    assert_found(candidates_in(coverage), ONE)


@pytest.mark.parametrize(("scale", "count"), [(0.35, 0), (0.8, 1), (1.4, 1), (2.8, 0)])
def test_a_candidate_has_a_drones_size(scale, count):
    coverage = draw(ONE[:10], OTHER[:10], size_m=[SIZE_M, scale * SIZE_M])
    assert len(candidates_in(coverage, ONE)) == count


def test_the_rim_of_a_known_drone_is_no_candidate():
    """If the track is wrong by a fifth of the drone's size, and the size by a fifth too, all views show a rim."""
    beside = ONE + np.array([0.0, -0.06, 0.06])
    assert candidates_in(draw(ONE, OTHER), beside, OTHER, size_m=0.8 * SIZE_M) == ()


@pytest.mark.parametrize(("blind", "count"), [([1, 4], 1), ([0, 1, 2, 4], 0)])
def test_enough_cameras_must_see_a_candidate(blind, count):
    """They must see it in the mean over its frames, not in each frame: a drone that fades is followed on."""
    coverage = draw(OTHER)[:10]
    assert len(candidates_in(blank(coverage, cameras=blind))) == count
    assert_found(candidates_in(blank(coverage, slice(5, None), blind)), OTHER)


def test_in_a_short_recording_fewer_frames_are_enough():
    assert candidates_in(draw(OTHER)[:6]) == ()
    assert len(candidates_in(draw(OTHER)[:6], num_frames=6)) == 1


def test_a_slow_drone_moves_as_soon_as_it_is_found():
    """At 0.15 m/s, it moves by half a cell in eight frames. A track must not wait for a second."""
    slow = path((0.6, -0.5, 1.5), (0.12, 0.09, 0.0))
    (found,) = candidates_in(draw(slow)[:8], ghosts_from=0)
    assert found.moves


def point_behind(near_m, camera, gap_m):
    """(3,), the point `gap_m` metres behind the point `near_m` on the ray of a camera."""
    ray = np.asarray(near_m) - RIG.cameras.centre_world[camera]
    return near_m + gap_m * ray / np.linalg.norm(ray)


def test_crossing_rays_of_different_drones_are_no_candidate():
    """Three cameras see foreground in the direction of an empty place: each of them sees another drone."""
    place = np.array([0.2, 0.3, 1.4])
    behind = [path(point_behind(place, camera, 1.0)) for camera in (0, 2, 4)]
    assert_found(candidates_in(draw(*behind)), *behind)


def test_a_drone_that_a_known_drone_half_hides():
    """In camera 0 the known drone hides a side of the other drone; the visible rest must not shift the position."""
    known = path(point_behind(OTHER[0], 0, -1.2) + np.array([0.0, 0.0, 0.3]))
    other = path(OTHER[0], (0.2, 0.0, 0.0))
    assert_found(candidates_in(draw(known, other), known), other)


@pytest.mark.parametrize(("ghosts_from", "moves"), [(0, False), (10, True), (None, True)])
def test_what_stands_still_may_be_a_ghost_but_not_from_the_start(ghosts_from, moves):
    """A ghost looks like a drone that does not move; only the missing motion shows the difference."""
    still = path((0.6, -0.5, 1.5))
    found = assert_found(candidates_in(draw(still, OTHER), ghosts_from=ghosts_from), still, OTHER)
    assert [one.moves for one in found] == [moves, True]


def test_a_drone_departs_from_its_ghost():
    """The background model had learned the drone: where it stood, all but the drone itself is foreground.

    Drone and ghost are one blob at first, so both are found once they are apart; the ghost gets no track.
    """
    rig = ring_rig(4, image_size_wh=IMAGE_WH)
    flight = path((0.1, -0.2, 1.2), (1.2, 0.9, 0.2))
    covered = draw(flight, rig=rig) > 128
    coverage = 255 * (covered != covered[:1]).astype(np.uint8)
    found = candidates_in(coverage, rig=rig, first=60, ghosts_from=10)
    assert sorted(one.moves for one in found) == [False, True]


# --- several drones at once, few cameras

THREE_M = [
    path((0.5, -0.4, 1.4), velocity_m_s=(1.0, 0.0, 0.2)),
    path((-0.7, 0.3, 0.8), velocity_m_s=(0.0, -1.5, 0.0)),
    path((0.1, 0.9, 1.9)),
]
SIZES_M = np.array([[0.5, 0.5, 0.3], [0.6, 0.6, 0.25], [0.4, 0.4, 0.4]])


def three_drones():
    return draw(*THREE_M, size_m=SIZES_M, rig=FIVE)[:12]


@pytest.mark.parametrize(("names", "cells"), [("c0 c1 c2 c3 c4", 1), ("c0 c1 c3", 1), ("c0 c1 c2", 3)])
def test_positions_and_sizes_of_three_drones(names, cells):
    """In the first two frames, one camera shows two drones as one blob, whose middle is at neither.

    Regression: it counted like the others, so a drone that stood still was 7 to 17 cm off and flew with 0.6 to 1.5 m/s.
    """
    rig = FIVE.select(names.split())
    shown = three_drones()[:, np.isin(FIVE.names, rig.names)]
    found = assert_found(candidates_in(shown, rig=rig), *THREE_M, atol=cells * CELL_5_M)
    assert np.linalg.norm(found[2].velocity_m_s) < 0.3 * cells
    np.testing.assert_allclose([one.size_m for one in found], SIZES_M, atol=2 * CELL_5_M)


@pytest.mark.parametrize(
    ("rig", "hidden", "frames"),
    [
        (ring_rig(3, image_size_wh=IMAGE_WH), [], 8),
        # Two viewpoints are all that there are.
        (FIVE.select(["c0", "c1"]), [], 15),
        # Something hides the drone from the third viewpoint.
        (FIVE.select(["c0", "c1", "c3"]), [2], 30),
    ],
    ids=["three viewpoints", "two viewpoints", "hidden from one"],
)
def test_the_fewer_viewpoints_the_more_frames(rig, hidden, frames):
    drone = path((0.5, -0.4, 1.4), (0.8, 0.0, 0.2), num_frames=30)
    coverage = blank(draw(drone, rig=rig), cameras=hidden)[:frames]
    assert candidates_in(coverage[:-1], rig=rig) == ()
    (found,) = assert_found(candidates_in(coverage, rig=rig), drone)
    viewpoints = len(rig) - len(hidden)
    assert found.num_cameras == viewpoints
    assert len(candidates_in(coverage, rig=rig, min_viewpoints=3)) == (viewpoints == 3)


def coplanar(velocity_m_s, num_frames):
    """Two drones in a plane with two cameras, so that rays to different drones cross too; they move apart."""
    first, second = FIVE.cameras.centre_world[:2]
    along = 0.5 * (second - first) / np.linalg.norm(second - first)
    middle, velocity = np.array([0.1, -0.1, 1.2]), np.array(velocity_m_s)
    return [
        path(middle - along, -velocity, num_frames=num_frames),
        path(middle + along, velocity, num_frames=num_frames),
    ]


def test_drones_that_are_ambiguous_in_two_views_are_found_once_they_move():
    """Two drones hover at two of four crossings of rays; two views cannot decide which two."""
    pair, three = FIVE.select(["c0", "c1"]), FIVE.select(["c0", "c1", "c3"])
    drones = coplanar((0.0, 0.0, 0.0), 35)
    assert candidates_in(draw(*drones, rig=pair), rig=pair) == ()
    assert_found(candidates_in(draw(*drones, rig=three)[:10], rig=three), *drones, atol=CELL_5_M)
    # If one drone rises and the other sinks, two views are enough.
    drones = coplanar((0.0, 0.0, 1.0), 20)
    assert_found(candidates_in(draw(*drones, rig=pair), rig=pair), *drones, atol=CELL_5_M)


# --- noise, thin and small silhouettes


def test_noise_is_no_drone_and_a_silhouette_with_gaps_is_one():
    rng = np.random.default_rng(0)
    # A drone, and noise blobs at different places in every frame.
    coverage = draw(OTHER)[:12].copy()
    for image in coverage.reshape(-1, *coverage.shape[2:]):
        x, y = rng.integers(0, 110), rng.integers(0, 80)
        image[y : y + 6, x : x + 6] = 255
    assert_found(candidates_in(coverage), OTHER)
    # A few random cells in every image.
    cells = rng.random(coverage.shape) < 0.01
    assert candidates_in(255 * cells.astype(np.uint8)) == ()
    # A drone of which a quarter of the cells are seen.
    coverage = draw(OTHER)
    thin = coverage * (rng.random(coverage.shape) < 0.25)
    assert_found(candidates_in(thin), OTHER, atol=2 * CELL_M)


#: Half a metre at 4 m is six to nine pixels: three or four cells wide, and one or two high.
SMALL = ring_rig(6, image_size_wh=(64, 48))


def test_drones_of_a_few_cells():
    coverage = draw(ONE[:12], OTHER[:12], rig=SMALL)
    # A cell is 16 cm.
    assert_found(candidates_in(coverage, rig=SMALL), ONE, OTHER, atol=0.08)
    assert_found(candidates_in(coverage, ONE, rig=SMALL), OTHER, atol=0.08)
    assert candidates_in(coverage, ONE, OTHER, rig=SMALL) == ()


# --- what known drones do not explain, and first states


def test_what_no_known_drone_explains_by_hand():
    """Of three blobs, one is within a drone's ellipse, one reaches out of it, and one is alone; cells of 4 px.

    The frame after it shows the same in another camera, and no drone is known there.
    """
    coverage = np.zeros((2, 2, 40, 60), np.uint8)
    image = coverage[0, 0]
    image[10:14, 10:16] = 255
    image[20:24, 14:40] = 255
    image[34:38, 2:8] = 255
    coverage[1, 1] = image
    box_px = np.full((2, 2, 2, 4), np.nan)
    box_px[0, :, 0] = [[52, 48, 20, 12], [56, 88, 20, 20]]
    sides = np.array([[60, 40], [60, 40]])
    view, after = unexplained(FrameBlobs.of(coverage, 4, sides), box_px)
    # The ellipse of the second drone has its middle at (14, 22) and is enlarged to 1.3 * 5 + 1.5 = 8 cells.
    np.testing.assert_allclose(view.centre_px[0, :2], [[19.5, 143.5], [123.5, 87.5]], atol=2)
    np.testing.assert_allclose(view.size_px[0, :2], [[24, 16], [72, 16]], atol=4)
    # The middle of a blob that is cut is less certain.
    assert view.noise_px[0, 1] > 4 * (view.noise_px[0, 0] - NOISE_PX)
    assert np.isnan(view.noise_px[1]).all()
    assert np.isfinite(after.noise_px).sum(axis=-1).tolist() == [0, 3]


def test_first_drones_for_a_method_that_is_plugged_in():
    shown = silhouettes_in_memory(FIVE, three_drones(), REDUCTION)
    limits = {"fps": FPS, "bounds_m": ROOM_M, "max_speed_m_s": MAX_SPEED_M_S}
    start = first_drones(FIVE, shown, drones=DroneSettings(), **limits)
    assert len(start.position_m) == 3
    for drone in THREE_M:
        assert np.linalg.norm(start.position_m - drone[0], axis=-1).min() < 2 * CELL_5_M
    told = first_drones(FIVE, shown, drones=DroneSettings(count=2, size_m=(0.3, 0.3, 0.1)), **limits)
    np.testing.assert_array_equal(told.size_m, [[0.3, 0.3, 0.1]] * 2)


# --- re-identification: which candidate is which lost drone, and which drones are lost

#: The instant from which the times of the tests count.
NOW = 1000

ROOM_M3 = float(np.prod(ROOM_M[1] - ROOM_M[0]))


def candidate(position_m=(0.0, 0.0, 1.0), velocity_m_s=(1.0, 0.0, 0.0), *, frame=0, span_m=0.5, **how):
    """A candidate that is first seen some frames after instant `NOW`."""
    how = {"num_cameras": 5, "moves": True} | how
    motion = np.array([position_m, velocity_m_s], float)
    return TrackCandidate(NOW + frame, *motion, span_m * np.array([1.0, 1.0, 0.5]), **how)


@dataclass(frozen=True)
class Lost:
    """A drone that was lost some seconds before `NOW`."""

    position_m: tuple[float, ...]
    velocity_m_s: tuple[float, ...] = (1.0, 0.0, 0.0)
    ago_s: float = 0.5
    span_m: float = 0.5
    doubtful: bool = False


def lost_tracks(*lost, left_m=(), new_per_s=0.0):
    """The drones numbered from 10 on, and places that ghosts left."""
    instants = [NOW - round(one.ago_s * FPS) for one in lost]
    spans_m = np.array([one.span_m for one in lost]).reshape(-1, 1)
    return LostTracks(
        drone=10 + np.arange(len(lost)),
        position_m=np.array([one.position_m for one in lost], float).reshape(-1, 3),
        velocity_m_s=np.array([one.velocity_m_s for one in lost], float).reshape(-1, 3),
        instant=np.array(instants, int),
        size_m=spans_m * [1.0, 1.0, 0.5],
        doubtful=np.array([one.doubtful for one in lost], bool),
        left_m=np.array(left_m, float).reshape(-1, 3),
        region_m=ROOM_M,
        new_per_s=new_per_s,
    )


def assigned_drones(found, gone, **keywords):
    return reidentify(tuple(found), gone, FlightLimits(FPS, ROOM_M, 6.0), **keywords).tolist()


STILL_M_S = (0.0, 0.0, 0.0)
HERE = candidate()
#: Lost drones: half a metre before `HERE` and flying towards it, or away from it; beside; out of reach, which is three
#: metres in half a second; long ago.
AHEAD = Lost((-0.5, 0.0, 1.0))
AWAY = Lost((0.5, 0.0, 1.0))
BESIDE = Lost((-0.6, 0.5, 1.0))
FAR = Lost((-4.5, 0.0, 1.0))
LONG_AGO = Lost((2.0, 2.0, 1.0), (0.0, 1.0, 0.0), ago_s=20.0)
LARGE = replace(LONG_AGO, span_m=0.9)
#: Two drones that left through the ceiling two metres apart; three seconds after the first, one is back near its place.
LEFT = Lost((-1.5, -2.0, 3.0), (0.0, 0.0, 2.0), ago_s=3.5)
LEFT_TOO = Lost((-1.5, 0.5, 3.0), (0.0, 0.0, 2.0), ago_s=5.5, span_m=0.46)
BACK = candidate((-0.5, -1.7, 2.8), (1.4, 0.2, -2.5), span_m=0.46)
#: The background model has learned a drone: its ghost, which does not move, or seems to while the drone overlaps it.
STOOD = Lost((0.0, 0.0, 1.0), STILL_M_S, ago_s=20.0)
GHOST = candidate(velocity_m_s=STILL_M_S, moves=False)
SEEMING = candidate((0.0, 0.0, 1.05), (0.0, -0.02, 0.13))
DEPARTING = candidate((0.5, 0.0, 1.0), frame=5)
PASSING = candidate((0.5, 0.0, 1.0), (0.0, 1.0, 0.0), frame=5)
RISING = candidate((0.1, 0.0, 1.3), (0.1, 0.0, 1.5), frame=9)
ELSEWHERE = candidate((1.0, 0.0, 1.3), (0.1, 0.0, 1.5), frame=9)
#: Another drone comes in at two metres per second, three metres away.
COMING = candidate((0.0, -2.7, 2.7), (0.0, 0.0, -2.0))
STAYED = Lost((0.0, 0.3, 1.5), STILL_M_S, ago_s=2.6)
FLEW = Lost((0.0, 0.3, 1.5), (0.0, 0.0, 2.0), ago_s=2.6)
#: A drone takes off where one was lost as it landed; another was lost in the air a moment ago, and is as large.
TAKING_OFF = candidate((0.0, 0.1, 0.12), (0.0, 0.0, 0.3), is_sure=False)
LANDED = Lost((0.0, 0.0, 0.13), (0.0, 0.5, -0.5), ago_s=9.5)
IN_THE_AIR = Lost((-1.3, -1.8, 3.0), (0.5, 0.5, -1.0), ago_s=2.6)
#: A drone that was found again at the place of its loss, so that it may be a ghost.
HELD = replace(STOOD, doubtful=True)
#: A drone that was tracked for another 0.8 s, of which a candidate at instant `NOW` was there for 0.7 s.
LOST_LATER = Lost((0.3, 0.0, 1.0), ago_s=-0.8)
NOT_SURE = candidate(is_sure=False)

#: While the background model learns the floor again, the rest of a ghost at a place seems to move.
DYING, HERE_M = candidate((2.2, 1.4, 1.5), (-0.1, 0.04, 0.01)), {"left_m": [(2.2, 1.3, 1.5)]}
#: As large as `LARGE`; and a rate of one drone that comes in every two seconds.
AS_LARGE, OFTEN = replace(HERE, size_m=LARGE.span_m * np.ones(3)), {"new_per_s": 0.5}
FAST_AWAY = replace(AWAY, velocity_m_s=(4.0, 0.0, 0.0), ago_s=1.5)

#: What is the case: candidates, lost drones, which lost drone each candidate is, and what else is known.
CASES = {
    "one of two flew towards the candidate": ([HERE], [AWAY, AHEAD], [1]),
    # The first drone fits both candidates best, but only one candidate gets it.
    "each drone is one candidate": ([HERE, candidate((0.0, 0.2, 1.0))], [AHEAD, BESIDE], [0, 1]),
    "out of reach": ([HERE], [FAR], [NEW]),
    "out of reach until time has passed": ([HERE], [replace(FAR, ago_s=10.0)], [0]),
    "long ago, of half the size": ([candidate(span_m=1.0)], [LONG_AGO], [NEW]),
    "long ago, the other is as large": ([candidate(span_m=0.9)], [LONG_AGO, LARGE], [1]),
    # Walls reflect drones, so the drones are nearer than they would be without walls.
    "the drone that left here is back": ([BACK], [LEFT, LEFT_TOO], [0]),
    "what does not move is not new": ([GHOST], [], [NO_DRONE]),
    # The lost drone may be anywhere by then, so the candidate may as well be a chair that a person has moved.
    "what does not move is no drone of long ago": ([GHOST], [LONG_AGO], [NO_DRONE]),
    "it is the drone that stood here": ([GHOST], [STOOD], [0]),
    "a drone departs from its ghost": ([GHOST, DEPARTING], [STOOD], [NO_DRONE, 0]),
    "a drone passes by": ([GHOST, PASSING], [STOOD], [0, NEW]),
    "a ghost that seems to move": ([SEEMING, RISING], [STOOD], [NO_DRONE, 0]),
    "a ghost of nobody that seems to move": ([SEEMING, RISING], [], [NO_DRONE, NEW]),
    # A slow and a fast drone at different places are two drones.
    "a slow and a fast drone": ([SEEMING, ELSEWHERE], [STOOD], [0, NEW]),
    "of two, the one that flew": ([COMING], [STAYED, FLEW], [1]),
    "who was lost as it landed takes off": ([TAKING_OFF], [IN_THE_AIR, LANDED], [1]),
    # A candidate that departs from the place where the drone was found again is the drone.
    "a ghost keeps no track": ([candidate((0.6, 0.0, 1.0))], [HELD], [0]),
    "who passes by a doubtful track": ([PASSING], [HELD], [NEW]),
    "two at the same time are two": ([candidate(frame=2)], [LOST_LATER], [NEW]),
    "nearly at the same time": ([candidate(frame=18)], [LOST_LATER], [0]),
    # A drone that was lost is found again by fewer frames than a new one.
    "not sure, but lost here": ([NOT_SURE], [AHEAD], [0]),
    "not sure": ([NOT_SURE], [], [NO_DRONE]),
    "a fading ghost": ([DYING], [], [NO_DRONE], HERE_M),
    "slow elsewhere": ([DYING], [], [NEW], {"left_m": [(1.2, 1.3, 1.5)]}),
    "fast at the place of a ghost": ([candidate((2.2, 1.4, 1.5))], [], [NEW], HERE_M),
    "lost at the place of a ghost": ([DYING], [Lost((2.2, 1.3, 1.5), STILL_M_S, 5.0)], [0], HERE_M),
    # A lost drone that is expected anywhere does not come back where new drones come.
    "lost long ago": ([AS_LARGE], [LARGE], [0]),
    "lost long ago, and new drones come": ([AS_LARGE], [LARGE], [NEW], OFTEN),
    "lost a moment ago, and new drones come": ([HERE], [AHEAD], [0], OFTEN),
    "it flew away, and new drones come": ([HERE], [FAST_AWAY], [NEW], OFTEN),
    "it departs, and new drones come": ([DEPARTING], [STOOD], [0], OFTEN),
}


@pytest.mark.parametrize("case", CASES)
def test_which_drone_a_candidate_is(case):
    found, gone, expected, *known = CASES[case]
    assert assigned_drones(found, lost_tracks(*gone, **dict(*known))) == expected


def test_only_so_many_candidates_are_drones():
    found = [candidate(), candidate((1.0, 1.0, 1.0)), candidate((-1.0, 1.0, 1.0))]
    assert sorted(assigned_drones(found, lost_tracks(), max_births=2)) == [NO_DRONE, NEW, NEW]
    # If no drone is new, a lost one may be out of reach, but a doubtful track is kept.
    assert assigned_drones([HERE], lost_tracks(FAR), max_births=0) == [0]
    assert assigned_drones([candidate((2.0, 0.0, 1.0))], lost_tracks(HELD), max_births=0) == [NO_DRONE]


def oracle_log_density(one, position_m, velocity_m_s, gap_s, sigma_m_s, time_s=1.0):
    """dv = -v/time dt + noise: the exact discretisation by a matrix exponential.

    The walls are mirrors: the images of the drone in them count as the drone.
    """
    drift = np.array([[0.0, 1.0], [0.0, -1.0 / time_s]])
    to, noise = van_loan(drift, np.diag([0.0, 2 * sigma_m_s**2 / time_s]), gap_s)
    measured = np.diag([0.1**2, 0.3**2])
    covariance = noise + to @ measured @ to.T + measured
    total = 0.0
    for axis, walls in enumerate(ROOM_M.T):
        density = multivariate_normal(to @ [position_m[axis], velocity_m_s[axis]], covariance).pdf
        images = {(one.position_m[axis], one.velocity_m_s[axis])}
        for _ in range(5):
            for place, velocity in list(images):
                images |= {(round(2 * wall - place, 9), -velocity) for wall in walls}
        total += np.log(sum(density(image) for image in images))
    return total


@pytest.mark.parametrize("seed", range(20))
def test_the_assignment_has_the_largest_likelihood(seed):
    """Compared with all permutations, with likelihoods from SciPy, for moving drones within reach."""
    rng = np.random.default_rng(seed)
    velocity = rng.normal(0.0, 1.0, (3, 3))
    place = rng.uniform((-1, -1, 1), (1, 1, 2), (3, 3))
    gap = rng.uniform(0.2, 1.5, 3)
    span = rng.uniform(0.4, 0.6, 3)
    order = rng.permutation(3)
    found, gone = [], []
    for k in order:
        place_m = place[k] + gap[k] * velocity[k] + rng.normal(0, 0.3, 3)
        found.append(candidate(place_m, velocity[k] + rng.normal(0, 0.5, 3)))
    for k in range(3):
        gone.append(Lost(place[k], velocity[k], gap[k] + 0.5, span[k]))
    sigma = 6.0 / 3

    def log_likelihood(one, k):
        own = np.clip(np.linalg.norm(velocity[k]) / np.sqrt(3), 0.3, sigma)
        moved = max(
            oracle_log_density(one, place[k], velocity[k], gap[k] + 0.5, each) for each in (own, sigma)
        )
        anywhere = norm.logpdf(one.velocity_m_s, 0, sigma).sum() - np.log(ROOM_M3)
        return max(moved, anywhere) + norm.logpdf(np.log(0.5 / span[k]), 0, 0.2)

    score = np.array([[log_likelihood(one, k) for k in range(3)] for one in found])
    orders = list(permutations(range(3)))
    best = np.argmax([score[range(3), columns].sum() for columns in orders])
    assert tuple(assigned_drones(found, lost_tracks(*gone), max_births=0)) == orders[best]


# --- lost drones


def tracked_frames(*rows):
    """Whether each drone was tracked, (frames, drones), from strings of `x` (tracked) and dots (not tracked)."""
    return np.array([[letter == "x" for letter in row] for row in rows]).T


def lost_in(position_m, velocity_m_s, tracked, *, fps, counted=False):
    """The lost drones, where every instant has a frame."""
    size_m = np.full((len(tracked[0]), 3), 0.5)
    instant = np.arange(len(tracked))
    return find_lost_tracks(position_m, velocity_m_s, tracked, size_m, instant, fps, counted=counted)


def test_lost_drones_by_hand():
    """Seven drones: tracked; lost early; lost late; not there; doubtful; moved; given in frame 3, but never seen."""
    tracked = tracked_frames(
        "xxxxxxxxxxxx",
        "xxx.........",
        "xxxxxxxxxx..",
        "............",
        "xx....xxxxxx",
        "xx....xxxxxx",
        "............",
    )
    frames = np.arange(12.0)
    position = np.zeros((12, 7, 3))
    position[..., 0] = frames[:, None]
    position[:, 3] = position[:3, 6] = np.nan
    position[:, 4] = (1.0, 2.0, 0.1)
    gone = lost_in(position, position / 2, tracked, fps=2.0)
    assert gone.drone.tolist() == [1, 2, 4, 6]
    # The last frames in which these drones were tracked are 2, 9 and 1; the last drone was given in frame 3.
    np.testing.assert_array_equal(gone.position_m[:, 0], [2.0, 9.0, 1.0, 3.0])
    # The third drone stands still, so its velocity is 0, although its state has another.
    np.testing.assert_array_equal(gone.velocity_m_s[:, 0], [1.0, 4.5, 0.0, 1.5])
    np.testing.assert_array_equal(gone.instant, [2, 9, 1, 3])
    assert gone.doubtful.tolist() == [False, False, True, False]
    # Those that are found in the first ten frames were there.
    assert gone.new_per_s == 0.5 / 6
    tracked[:11, 0] = False
    assert lost_in(position, position / 2, tracked, fps=2.0).new_per_s == 1.5 / 6
    assert lost_in(position, position / 2, tracked, fps=2.0, counted=True).new_per_s == 0


def test_a_track_that_never_moved_where_a_drone_was_is_false():
    """One track stands still; one lands at its place; one passes above; one hovers elsewhere. The first is false."""
    position = np.full((12, 4, 3), np.nan)
    position[:6, 0] = (1.0, 0.0, 0.1)
    position[:8, 1] = (1.0, 0.0, 0.1)
    position[:7, 1, 2] += np.arange(7)[::-1] * 0.2
    position[:, 2] = (0.0, 0.0, 0.4)
    position[:, 2, 0] += 0.2 * np.arange(12)
    position[:4, 3] = (1.6, 0.0, 0.1)
    position[:, :, 1] += 0.01 * np.arange(12)[:, None] % 0.02
    tracked = np.isfinite(position[..., 0])
    size = np.full((4, 3), 0.5)
    assert find_false_tracks(position, tracked, size).tolist() == [True, False, False, False]
    assert lost_in(position, np.zeros_like(position), tracked, fps=10.0).drone.tolist() == [1, 3]
    # A single track is not false.
    assert find_false_tracks(position[:, :1], tracked[:, :1], size[:1]).tolist() == [False]


def test_a_drone_that_the_background_learns_only_seems_to_move():
    """Ten frames at 10 frames per second, with four drones.

    The first drone stood still until the rest of its blob moved slowly away; the second flew slowly; the third stopped;
    the fourth has just landed.
    """
    position = np.zeros((12, 4, 3))
    position[..., 1] = (0.0, 1.0, 2.0, 3.0)
    position[8:10, 0, 0] = (0.04, 0.08)
    position[:, 1, 0] = 0.03 * np.arange(12)
    position[:4, 3, 2] = (0.8, 0.6, 0.4, 0.2)
    position[9, 3, 0] = 0.06
    velocity = np.zeros((12, 4, 3))
    velocity[8:10, 0, 0] = 0.5
    velocity[:, 1, 0] = 0.3
    velocity[9, 2, 0] = 0.05
    velocity[9, 3, 0] = 0.4
    position[:, 2, 0] = np.minimum(0.1 * np.arange(12), 0.8)
    gone = lost_in(position, velocity, tracked_frames(*["x" * 10 + ".."] * 4), fps=10.0)
    np.testing.assert_array_equal(gone.position_m[:, 0], [0.0, 0.27, 0.8, 0.0])
    np.testing.assert_array_equal(gone.velocity_m_s[:, 0], [0.0, 0.3, 0.05, 0.0])
    np.testing.assert_array_equal(gone.left_m, [[0.0, 0.0, 0.0], [0.0, 3.0, 0.0]])


def test_sightings_of_some_frames_of_silhouettes():
    """60 frames with a square each; frames are read in pieces."""
    coverage = np.zeros((60, 2, 30, 40), np.uint8)
    for frame in range(60):
        coverage[frame, :, 4 : 8 + frame // 10, 2 : 6 + frame // 2] = 255
    silhouettes = silhouettes_in_memory(RIG.select(RIG.names[:2]), coverage, 2)
    chosen = np.array([0, 3, 24, 25, 49, 59])
    some, every = from_silhouettes(silhouettes, frames=chosen), from_silhouettes(silhouettes)[chosen]
    np.testing.assert_array_equal(some.size_px, every.size_px)
    assert some.size_px[:, 0, 0, 0].tolist() == [8, 10, 32, 32, 56, 66]
