"""Newcomers in silhouettes that are drawn by casting rays at ellipsoids, and who they are, worked by hand."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from helpers import ROOM_M, draw_coverage, float32, rig_of, ring_rig
from scipy.linalg import expm
from scipy.stats import multivariate_normal, norm

from psotrack.geometry import make_extents, project, project_boxes, viewpoints
from psotrack.initiation import (
    NEW,
    LostTracks,
    TrackCandidate,
    find_candidates,
    find_false_tracks,
    find_lost_tracks,
    plan_starts,
    reidentify,
)
from psotrack.initiation.reidentification import NOBODY
from psotrack.initiation.residual_foreground import SearchVolume, known, rest
from psotrack.silhouettes.foreground import ForegroundSettings, foreground, learning_step

FPS = 25.0
REDUCTION = 2
NUM_FRAMES = 25
MAX_SPEED_M_S = 3.0
IMAGE_WH = (240, 180)
RIG = ring_rig(6, image_size_wh=IMAGE_WH)
#: A cell of a silhouette is 2 px; at 4 m and a focal length of 200 px that is 4 cm.
CELL_M = 0.04
TIME_S = np.arange(NUM_FRAMES)[:, None] / FPS
SIZE_M = np.array([0.5, 0.5, 0.3])


def path(position_m, velocity_m_s=(0.0, 0.0, 0.0), acceleration_m_s2=(0.0, 0.0, 0.0)):
    """(frames, 3)."""
    bend = np.asarray(acceleration_m_s2) * TIME_S**2 / 2
    return np.asarray(position_m) + np.asarray(velocity_m_s) * TIME_S + bend


def drawn(*paths_m, size_m=SIZE_M, rig=RIG):
    """Silhouettes of drones on paths."""
    sizes = np.broadcast_to(np.array(size_m, float), (len(paths_m), 3))
    return np.maximum.reduce([drawn_alone(one, size, rig) for one, size in zip(paths_m, sizes, strict=True)])


def drawn_alone(path_m, size_m, rig):
    """Kept, as rays are slow and tests share paths; the key holds all that the picture is made of."""
    key = (path_m.tobytes(), size_m.tobytes(), len(rig))
    if key not in _DRAWN:
        # What stands still looks the same in every frame.
        places, which = np.unique(path_m, axis=0, return_inverse=True)
        images = np.stack([draw_coverage(rig, place, size_m, REDUCTION) for place in places])
        _DRAWN[key] = images[which.ravel()]
    return _DRAWN[key]


_DRAWN = {}


def found_in(coverage, *known_m, size_m=SIZE_M, rig=RIG):
    known = np.stack(known_m, axis=1) if known_m else np.empty((len(coverage), 0, 3))
    return find_candidates(
        rig.cameras,
        coverage,
        known[: len(coverage)],
        np.isfinite(known[: len(coverage)]).all(axis=-1),
        np.broadcast_to(size_m, (len(known_m), 3)),
        reduction=REDUCTION,
        fps=FPS,
        bounds_m=ROOM_M,
        max_speed_m_s=MAX_SPEED_M_S,
    )


ONE = path((0.6, -0.5, 1.5), (0.8, 0.2, 0.1))
OTHER = path((-0.7, 0.6, 0.9), (0.0, -1.0, 0.2), (1.0, 0.5, 0.0))


@pytest.fixture(scope="module")
def both():
    images = drawn(ONE, OTHER)
    images.flags.writeable = False
    return images


def without(coverage, frames=slice(None), cameras=slice(None)):
    """The silhouettes, empty in some frames and cameras."""
    coverage = coverage.copy()
    coverage[frames, cameras] = 0
    return coverage


def test_known_drones_leave_nobody(both):
    assert found_in(both, ONE, OTHER) == ()


def test_an_unknown_drone_is_found(both):
    (found,) = found_in(both, ONE)
    assert found.frame == 0
    # The middle of a blob is good to a fraction of a cell in each of six views; the first of ten frames is as good as
    # one frame by itself. Limit one cell.
    np.testing.assert_allclose(found.position_m, OTHER[0], atol=CELL_M)
    # At the end of a parabola through ten places the speed is as good as 0.44 * place / frame; 3 mm give 0.03 m/s.
    # Measured 0.07, limit 0.3.
    np.testing.assert_allclose(found.velocity_m_s, (0.0, -1.0, 0.2), atol=0.3)
    # As in tests of initialisation: at most half a cell too much at each end, and twice that for the height.
    np.testing.assert_allclose(found.size_m[:2], SIZE_M[:2], atol=1.5 * CELL_M)
    np.testing.assert_allclose(found.size_m[2], SIZE_M[2], atol=3 * CELL_M)
    # One of six has it at its border.
    assert found.num_cameras >= 5
    assert found.moves


def test_where_no_drone_is_known_all_are_found(both):
    found = found_in(both)
    assert len(found) == 2
    first = np.array([one.position_m for one in found])
    for truth in (ONE, OTHER):
        assert np.linalg.norm(first - truth[0], axis=-1).min() < CELL_M


def test_a_drone_that_explains_nothing_hides_nobody(both):
    """The same track, but marked as not to be believed: both are found."""
    known = np.stack([ONE, OTHER], axis=1)
    found = find_candidates(
        RIG.cameras,
        both,
        known,
        np.zeros(known.shape[:2], bool),
        np.stack([SIZE_M, SIZE_M]),
        reduction=REDUCTION,
        fps=FPS,
        bounds_m=ROOM_M,
        max_speed_m_s=MAX_SPEED_M_S,
    )
    assert len(found) == 2


@pytest.mark.parametrize("first", [3, 9, 15])
def test_the_first_frame_in_which_it_is_there(both, first):
    """Also where the frame that is searched (0, 8, 16, 24) is later than the first."""
    coverage = without(drawn(OTHER), slice(first))
    (found,) = found_in(np.maximum(coverage, drawn(ONE)), ONE)
    assert found.frame == first
    np.testing.assert_allclose(found.position_m, OTHER[first], atol=CELL_M)


@pytest.mark.parametrize(("frames", "count"), [(range(10, 17), 0), (range(10, 18), 1), (range(16, 25), 0)])
def test_it_must_persist(frames, count):
    """Eight of ten frames; and the last nine of a chunk are left to the next chunk."""
    gone = np.ones(NUM_FRAMES, bool)
    gone[list(frames)] = False
    assert len(found_in(without(drawn(OTHER), gone))) == count


def test_a_drone_that_flickers_is_one_drone():
    (found,) = found_in(without(drawn(OTHER), [5, 11, 12, 19]))
    assert found.frame == 0


@pytest.mark.parametrize("hidden", [slice(10, 14), slice(8, 15), slice(10, 25)])
def test_a_drone_that_is_lost_from_sight_for_a_while_is_one_newcomer(hidden):
    """It begins where it was first; that it is there again afterwards is the tracker's to find."""
    (found,) = found_in(without(drawn(OTHER), hidden))
    assert found.frame == 0


def test_faster_than_a_drone():
    assert found_in(drawn(path((-1.5, 0.0, 1.5), (1.1 * MAX_SPEED_M_S, 0.0, 0.0)))) == ()
    assert len(found_in(drawn(path((-1.5, 0.0, 1.5), (0.9 * MAX_SPEED_M_S, 0.0, 0.0))))) == 1


def test_shadows_and_reflections():
    """Both agree between all views and move as drones do; shadows are flat on the floor, reflections beneath it."""
    shadow, reflection = ONE * (1, 1, 0), ONE * (1, 1, -1)
    assert found_in(drawn(ONE, shadow, reflection, size_m=[SIZE_M, [0.5, 0.5, 0.02], SIZE_M]), ONE) == ()


@pytest.mark.parametrize(("scale", "count"), [(0.35, 0), (0.8, 1), (1.4, 1), (2.8, 0)])
def test_of_a_drones_size(both, scale, count):
    coverage = drawn(ONE, OTHER, size_m=[SIZE_M, scale * SIZE_M])
    assert len(found_in(coverage, ONE)) == count


@pytest.mark.parametrize("off_m", [(0.08, 0.0, 0.0), (0.0, -0.06, 0.06), (0.0, 0.0, -0.1)])
def test_the_rim_of_a_known_drone_is_nobody(both, off_m):
    """Where the track is off by a fifth of the drone, and its size too small by as much, all views have a rim."""
    assert found_in(both, ONE + off_m, OTHER, size_m=0.8 * SIZE_M) == ()


def test_three_viewpoints_are_enough_and_two_are_not():
    """A third camera beside the second sees the drone, but from where it is seen already."""
    three = ring_rig(3, image_size_wh=IMAGE_WH)
    (found,) = found_in(drawn(OTHER, rig=three), rig=three)
    np.testing.assert_allclose(found.position_m, OTHER[0], atol=CELL_M)
    assert found.num_cameras == 3
    first, second = three.cameras[0], three.cameras[1]
    T = second.T_cam_world.copy()
    T[0, 3] += 0.1
    twin = rig_of(first, second, replace(second, T_cam_world=T))
    images = np.concatenate([drawn(OTHER, rig=three)[:, :2], drawn(OTHER, rig=three)[:, 1:2]], axis=1)
    assert found_in(images, rig=twin) == ()


@pytest.mark.parametrize(("blind", "count"), [([4], 1), ([1, 4], 0)])
def test_cameras_that_ought_to_see_it_must(blind, count):
    """One of six may have an obstacle before it. If two see nothing, four see something else."""
    assert len(found_in(without(drawn(OTHER), cameras=blind))) == count


def test_rays_of_different_drones_that_cross_are_nobody():
    """Three cameras see foreground in line with a place where nothing is: one sees a drone, two see rims."""
    place = np.array([0.2, 0.3, 1.4])
    behind = []
    for camera, distance in ((0, 0.9), (2, 1.1), (4, 1.0)):
        ray = place - RIG.cameras.centre_world[camera]
        behind.append(path(place + distance * ray / np.linalg.norm(ray)))
    coverage = drawn(*behind)
    seen = [coverage[0, camera, *_cell(place, camera)] > 0 for camera in range(6)]
    assert sum(seen) >= 3
    places = [one.position_m for one in found_in(coverage)]
    assert all(np.linalg.norm(place - one) > 0.5 for one in places)
    assert len(places) == 3


def _cell(place_m, camera):
    (column, row), _ = project(RIG.cameras[camera], place_m)
    return int((row + 0.5) // REDUCTION), int((column + 0.5) // REDUCTION)


def test_half_hidden_by_a_known_drone():
    """The known drone is before it in camera 0, off to a side: what is left of it there must not shift it."""
    ray = OTHER[0] - RIG.cameras.centre_world[0]
    before = OTHER[0] - 1.2 * ray / np.linalg.norm(ray) + (0.0, 0.0, 0.3)
    known = path(before)
    other = path(OTHER[0], (0.2, 0.0, 0.0))
    (found,) = found_in(drawn(known, other), known)
    np.testing.assert_allclose(found.position_m, other[0], atol=CELL_M)


def test_a_flat_drone_that_sinks_fast():
    """From frame to frame it moves by more than it is high: nobody knows yet where to look for it in the next one."""
    size_m = np.array([0.5, 0.5, 0.12])
    known, sinking = path((-0.6, 0.6, 0.9)), path((0.6, -0.5, 2.9), (0.0, 0.0, -2.8))[:15]
    silhouettes = np.maximum(drawn(known, size_m=size_m)[:15], drawn(sinking, size_m=size_m))
    (found,) = found_in(silhouettes, known, size_m=size_m)
    np.testing.assert_allclose(found.position_m, sinking[found.frame], atol=2 * CELL_M)
    assert found.moves


def test_what_stands_still_is_marked():
    """A hole in the background looks like a drone that does not move, and is told by that alone."""
    hole, drone = path((0.6, -0.5, 1.5)), OTHER
    found = sorted(found_in(drawn(hole, drone)), key=lambda one: one.position_m[0])
    assert [one.moves for one in found] == [True, False]


def test_what_known_drones_explain_is_their_ellipse_a_little_enlarged():
    """Against the ellipse's inequality at the middle of every cell; cells that its edge crosses may be either."""
    full = np.full((6, 90, 120), 255, np.uint8)
    room = SearchVolume(RIG.cameras, viewpoints(RIG.cameras), ROOM_M, REDUCTION)
    drones = known(room, ONE[:1, None], SIZE_M[None])
    left = rest(full, drones, 0)
    seen = project_boxes(make_extents(float32(RIG.cameras), np.float32(SIZE_M)), np.float32(ONE[0]))
    y, x = np.mgrid[:90, :120] + 0.5
    for camera in range(6):
        u = (x - seen.x_middle[camera] / REDUCTION) / (1.3 * seen.x_half[camera] / REDUCTION + 1.5)
        v = (y - seen.y_middle[camera] / REDUCTION) / (1.3 * seen.y_half[camera] / REDUCTION + 1.5)
        radius = np.hypot(u, v)
        # The half axes are eight cells and more: a tenth of them is about a cell.
        assert not left.foreground[camera][radius < 0.9].any()
        assert (left.foreground[camera][radius > 1.1] == 255).all()
    np.testing.assert_array_equal(left.visible, left.foreground == 255)


def test_a_short_chunk_has_no_newcomers(both):
    assert found_in(both[:9], ONE[:9]) == ()
    assert len(found_in(both[:10], ONE[:10])) == 1


def test_a_drone_that_flies_off_from_where_the_background_has_it():
    """Pictures through MOG2: a drone stands for two thirds of the video, so that it is learned, and then flies off.

    While it stands it cannot be seen. When it has left, a hole is where it stood, which looks like a drone.
    """
    rig, standing = ring_rig(4, image_size_wh=IMAGE_WH), 60
    place = np.array([0.1, -0.2, 1.2])
    flight = path(place, (1.2, 0.9, 0.2))
    away = drawn_alone(flight, SIZE_M, rig)
    before = np.broadcast_to(drawn_alone(path(place), SIZE_M, rig)[0], (standing, *away.shape[1:]))
    rng = np.random.default_rng(0)
    settings = ForegroundSettings(working_reduction=1, min_blob_px=8)
    masks = []
    for camera in range(len(rig)):
        room = rng.integers(90, 160, (*away.shape[2:], 3)).astype(float)
        video = []
        for covered in np.concatenate([before, away])[:, camera, :, :, None] / 255:
            picture = room * (1 - covered) + 25.0 * covered + rng.normal(0.0, 2.0, room.shape)
            video.append(np.clip(picture, 0, 255).astype(np.uint8))
        step = learning_step(len(video), settings)
        masks.append(np.stack(list(foreground(video[::step], video, settings))))
    coverage = np.stack(masks, axis=1)
    # The mean over its place: nothing while it stands, a hole after it.
    cells = away[0] > 128
    assert coverage[20, cells].mean() < 10
    assert coverage[-1, cells].mean() > 200

    chunk = coverage[standing:]
    found = found_in(chunk, rig=rig)
    # Over the hole both are one, and then the hole changes: neither is a place to begin at. The drone is, once apart.
    assert [one.moves for one in found] == [True]
    # The hole is still beside it in the first of ten frames. Measured 3 cm, limit 6.
    np.testing.assert_allclose(found[0].position_m, flight[found[0].frame], atol=2 * CELL_M)
    stood = lost((place, (0.0, 0.0, 0.0), 2.0))
    assert who(found, stood, max_speed_m_s=MAX_SPEED_M_S) == [0]

    # A second later the drone is known and the hole is as it was.
    hole = np.repeat(coverage[-1:], NUM_FRAMES, axis=0)
    found = found_in(hole, np.broadcast_to(flight[-1], (NUM_FRAMES, 3)).copy(), rig=rig)
    assert [one.moves for one in found] == [False]
    np.testing.assert_allclose(found[0].position_m, place, atol=CELL_M)
    assert who(found, lost()) == [NOBODY]


# --- who a newcomer is

ROOM_M3 = float(np.prod(ROOM_M[1] - ROOM_M[0]))


def newcomer(position_m=(0.0, 0.0, 1.0), velocity_m_s=(1.0, 0.0, 0.0), *, frame=0, span_m=0.5, moves=True):
    size = np.array([span_m, span_m, span_m / 2])
    return TrackCandidate(frame, np.array(position_m, float), np.array(velocity_m_s, float), size, 5, moves)


def lost(*rows, left_m=()):
    """Rows of position, velocity, seconds and, where they differ, keywords span_m and doubtful."""
    full = [{"span_m": 0.5, "doubtful": False} | (row[3] if len(row) > 3 else {}) for row in rows]
    return LostTracks(
        drone=10 + np.arange(len(rows)),
        position_m=np.array([row[0] for row in rows], float).reshape(-1, 3),
        velocity_m_s=np.array([row[1] for row in rows], float).reshape(-1, 3),
        seconds=np.array([row[2] for row in rows], float),
        size_m=np.array([[more["span_m"], more["span_m"], more["span_m"] / 2] for more in full]).reshape(
            -1, 3
        ),
        doubtful=np.array([more["doubtful"] for more in full], bool),
        left_m=np.array(left_m, float).reshape(-1, 3),
    )


def who(found, gone, **keywords):
    keywords = {"fps": FPS, "bounds_m": ROOM_M, "max_speed_m_s": 6.0} | keywords
    return reidentify(tuple(found), gone, **keywords).tolist()


AHEAD = ((-0.5, 0.0, 1.0), (1.0, 0.0, 0.0), 0.5)


def test_nobody_lost_is_a_birth():
    assert who([newcomer()], lost()) == [NEW]
    assert who([], lost()) == []


def test_the_drone_that_was_heading_there():
    """Two were lost half a metre away: one flew towards where the newcomer is now, one away from it."""
    away = ((0.5, 0.0, 1.0), (1.0, 0.0, 0.0), 0.5)
    assert who([newcomer()], lost(away, AHEAD)) == [1]


def test_each_lost_drone_is_one_newcomer():
    """Both newcomers are best explained by the first; only one of them is it."""
    also = ((-0.6, 0.5, 1.0), (1.0, 0.0, 0.0), 0.5)
    assert who([newcomer(), newcomer((0.0, 0.2, 1.0))], lost(AHEAD, also)) == [0, 1]
    assert who([newcomer((0.0, 0.2, 1.0)), newcomer()], lost(AHEAD, also)) == [1, 0]
    assert sorted(who([newcomer(), newcomer((0.0, 0.2, 1.0))], lost(AHEAD))) == [NEW, 0]


def test_out_of_reach_is_a_birth_unless_the_number_is_pinned():
    """Six metres per second for half a second reach three metres."""
    far = ((-4.5, 0.0, 1.0), (1.0, 0.0, 0.0), 0.5)
    assert who([newcomer()], lost(far)) == [NEW]
    assert who([newcomer()], lost(far), max_births=0) == [0]
    assert who([newcomer()], lost((*far[:2], 10.0))) == [0]


def test_after_a_long_time_size_tells():
    gone = ((2.0, 2.0, 1.0), (0.0, 1.0, 0.0), 20.0)
    assert who([newcomer(span_m=0.55)], lost(gone)) == [0]
    assert who([newcomer(span_m=1.0)], lost(gone)) == [NEW]
    assert who([newcomer(span_m=0.9)], lost(gone, (*gone, {"span_m": 0.9}))) == [1]
    assert who([newcomer(span_m=1.0)], lost(gone), max_births=0) == [0]


def test_it_comes_back_where_it_went():
    """Two of a kind left through the ceiling two metres apart; after three seconds one is back beside one of them.

    Nobody flies through walls: they are not as far off as they could be in the open. Size alone decided before.
    """
    left = (-1.5, -2.0, 3.0), (0.0, 0.0, 2.0), 3.5
    also = (-1.5, 0.5, 3.0), (0.0, 0.0, 2.0), 5.5
    back = newcomer((-0.5, -1.7, 2.8), (1.4, 0.2, -2.5), span_m=0.46)
    assert who([back], lost((*left, {"span_m": 0.5}), (*also, {"span_m": 0.46}))) == [0]
    assert who([back], lost((*also, {"span_m": 0.46}), (*left, {"span_m": 0.5}))) == [1]
    # Where the sizes differ by a third they decide.
    assert who([back], lost((*left, {"span_m": 0.62}), (*also, {"span_m": 0.46}))) == [1]


def test_only_so_many_births():
    found = [newcomer(), newcomer((1.0, 1.0, 1.0)), newcomer((-1.0, 1.0, 1.0))]
    assert who(found, lost()) == [NEW] * 3
    assert sorted(who(found, lost(), max_births=2)) == [NOBODY, NEW, NEW]
    assert who(found, lost(), max_births=0) == [NOBODY] * 3


def test_what_does_not_move_is_never_new():
    still = newcomer(velocity_m_s=(0.0, 0.0, 0.0), moves=False)
    assert who([still], lost()) == [NOBODY]
    # Nor a drone that may be anywhere: a chair that somebody moved is as likely.
    assert who([still], lost(((2.0, 2.0, 1.0), (0.0, 1.0, 0.0), 20.0))) == [NOBODY]
    # But the drone that stood there when it vanished, however long ago.
    assert who([still], lost(((0.0, 0.1, 1.0), (0.05, 0.0, 0.0), 20.0))) == [0]


def test_a_hole_is_not_the_drone_that_flew_off_from_it():
    """A drone was swallowed where it stood. The hole is exactly there; the drone has left it by one metre."""
    stood = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 20.0)
    hole = newcomer((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), moves=False)
    drone = newcomer((0.5, 0.0, 1.0), (1.0, 0.0, 0.0), frame=5)
    assert who([hole, drone], lost(stood)) == [NOBODY, 0]
    passing_by = newcomer((0.5, 0.0, 1.0), (0.0, 1.0, 0.0), frame=5)
    assert who([hole, passing_by], lost(stood)) == [0, NEW]


def test_a_drone_that_vanished_where_it_stood_is_there_and_nowhere_else():
    """Swallowed by the background; then another one comes in at two metres per second, three metres away.

    It was taken for the one that stood there. One that flew out of sight may well be back.
    """
    coming = newcomer((0.0, -2.7, 2.7), (0.0, 0.0, -2.0))
    stood = ((0.0, 0.3, 1.5), (0.0, 0.0, 0.0), 2.6)
    flew = ((0.0, 0.3, 1.5), (0.0, 0.0, 2.0), 2.6)
    assert who([coming], lost(stood)) == [NEW]
    assert who([coming], lost(flew)) == [0]
    # If nobody can be new it is that one all the same; and of two that were lost, the one that flew.
    assert who([coming], lost(stood), max_births=0) == [0]
    assert who([coming], lost(stood, flew)) == [1]


def test_a_hole_that_seems_to_move_is_no_drone():
    """With the drone still over it, what is there creeps upwards: it was taken for the drone, which was born anew."""
    stood = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 20.0)
    hole = newcomer((0.0, 0.0, 1.05), (0.0, -0.02, 0.13))
    drone = newcomer((0.1, 0.0, 1.3), (0.1, 0.0, 1.5), frame=9)
    assert who([hole, drone], lost(stood)) == [NOBODY, 0]
    assert who([hole, drone], lost()) == [NOBODY, NEW]
    # Two drones that are slow and fast are two.
    elsewhere = newcomer((1.0, 0.0, 1.3), (0.1, 0.0, 1.5), frame=9)
    assert who([hole, elsewhere], lost(stood)) == [0, NEW]


def test_a_hole_that_dies_is_not_born():
    """The background learns the floor again: what is left of the hole seems to move. It was taken for a new drone."""
    dying = newcomer((2.2, 1.4, 1.5), (-0.1, 0.04, 0.01))
    assert who([dying], lost(left_m=[(2.2, 1.3, 1.5)])) == [NOBODY]
    # A drone may creep elsewhere, or fly there; and one that is lost there may be back.
    assert who([dying], lost(left_m=[(1.2, 1.3, 1.5)])) == [NEW]
    assert who([newcomer((2.2, 1.4, 1.5))], lost(left_m=[(2.2, 1.3, 1.5)])) == [NEW]
    stood = ((2.2, 1.3, 1.5), (0.0, 0.0, 0.0), 5.0)
    assert who([dying], lost(stood, left_m=[(2.2, 1.3, 1.5)])) == [0]


def test_a_hole_does_not_keep_a_track():
    """Found again where it had vanished and still there: the track may be on the hole, and yields to what flew off."""
    held = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 20.0, {"doubtful": True})
    assert who([newcomer((0.6, 0.0, 1.0))], lost(held)) == [0]
    assert who([newcomer((0.6, 0.0, 1.0), (0.0, 1.0, 0.0))], lost(held)) == [NEW]
    assert who([newcomer((2.0, 0.0, 1.0))], lost(held), max_births=0) == [NOBODY]


def test_a_drone_that_was_tracked_elsewhere_at_the_same_time_is_another_one():
    """LostTracks in frame 20 of the chunk, while the newcomer is there from frame 2 on: 0.7 s of both."""
    here = ((0.3, 0.0, 1.0), (1.0, 0.0, 0.0), -20 / FPS)
    assert who([newcomer(frame=2)], lost(here)) == [NEW]
    assert who([newcomer(frame=18)], lost(here)) == [0]


def oracle_log_density(one, position_m, velocity_m_s, gap_s, sigma_m_s, time_s=1.0):
    """dv = -v/time dt + noise: the exact discretisation by a matrix exponential (C. F. Van Loan, 1978).

    In a room with mirrors for walls: a drone that is seen in one of them counts as the drone itself.
    """
    drift = np.array([[0.0, 1.0], [0.0, -1.0 / time_s]])
    noise = np.diag([0.0, 2 * sigma_m_s**2 / time_s])
    big = expm(np.block([[-drift, noise], [np.zeros((2, 2)), drift.T]]) * gap_s)
    to = big[2:, 2:].T
    measured = np.diag([0.1**2, 0.3**2])
    covariance = to @ big[:2, 2:] + to @ measured @ to.T + measured
    total = 0.0
    for axis, walls in enumerate(ROOM_M.T):
        density = multivariate_normal(to @ [position_m[axis], velocity_m_s[axis]], covariance).pdf
        seen = images = {(one.position_m[axis], one.velocity_m_s[axis])}
        for _ in range(5):
            images = {(round(2 * wall - place, 9), -velocity) for wall in walls for place, velocity in images}
            seen = seen | images
        total += np.log(sum(density(image) for image in seen))
    return total


@pytest.mark.parametrize("seed", range(20))
def test_the_assignment_is_the_likeliest(seed):
    """Against all permutations, with likelihoods from SciPy, for drones that move and are within reach."""
    rng = np.random.default_rng(seed)
    velocity, place = rng.normal(0.0, 1.0, (3, 3)), rng.uniform((-1, -1, 1), (1, 1, 2), (3, 3))
    gap = rng.uniform(0.2, 1.5, 3)
    span = rng.uniform(0.4, 0.6, 3)
    order = rng.permutation(3)
    found = [
        newcomer(place[k] + gap[k] * velocity[k] + rng.normal(0, 0.3, 3), velocity[k] + rng.normal(0, 0.5, 3))
        for k in order
    ]
    gone = lost(*((place[k], velocity[k], gap[k] + 0.5, {"span_m": span[k]}) for k in range(3)))
    sigma = 6.0 / 3
    score = np.array(
        [
            [
                max(
                    oracle_log_density(one, place[k], velocity[k], gap[k] + 0.5, sigma),
                    norm.logpdf(one.velocity_m_s, 0, sigma).sum() - np.log(ROOM_M3),
                )
                + norm.logpdf(np.log(0.5 / span[k]), 0, 0.2)
                for k in range(3)
            ]
            for one in found
        ]
    )
    best = max(permutations(range(3)), key=lambda columns: score[range(3), columns].sum())
    assert who(found, gone, max_births=0) == list(best)


# --- bookkeeping


def history(*rows):
    """(frames, drones) of whether each was tracked, from words of x and dots."""
    return np.array([[letter == "x" for letter in row] for row in rows]).T


def test_lost_drones_by_hand():
    """At frame 12, of a chunk that began at frame 8: tracked; lost before it; lost in it; never there; doubtful."""
    tracked = history(
        "xxxxxxxxxxxx", "xxx.........", "xxxxxxxxxx..", "............", "xx....xxxxxx", "xx....xxxxxx"
    )
    frames = np.arange(12.0)
    position = np.zeros((12, 6, 3))
    position[..., 0] = frames[:, None]
    position[:, 4] = (1.0, 2.0, 0.1)
    gone = find_lost_tracks(position, position / 2, tracked, np.full((6, 3), 0.5), chunk_frames=4, fps=2.0)
    assert gone.drone.tolist() == [1, 2, 4]
    # The last frames in which they were tracked: 2, 9 and 1.
    np.testing.assert_array_equal(gone.position_m[:, 0], [2.0, 9.0, 1.0])
    # Where it stands the last one has none, whatever it is said to have.
    np.testing.assert_array_equal(gone.velocity_m_s[:, 0], [1.0, 4.5, 0.0])
    np.testing.assert_array_equal(gone.seconds, [6 / 2, -1 / 2, 7 / 2])
    assert gone.doubtful.tolist() == [False, False, True]


def test_a_track_in_whose_place_a_drone_was_is_a_hole():
    """One stands; one comes and lands there; one passes by above; one hovers elsewhere. The first was a drone lost."""
    position = np.full((12, 4, 3), np.nan)
    position[:6, 0] = (1.0, 0.0, 0.1)
    position[:8, 1] = (1.0, 0.0, 0.1)
    position[:7, 1, 2] += np.arange(7)[::-1] * 0.2
    position[:, 2] = (0.0, 0.0, 0.4)
    position[:, 2, 0] += 0.2 * np.arange(12)
    position[:4, 3] = (1.6, 0.0, 0.1)
    position[:, :, 1] += 0.01 * np.arange(12)[:, None] % 0.02
    tracked = np.isfinite(position[..., 0])
    size = np.tile([0.5, 0.5, 0.2], (4, 1))
    assert find_false_tracks(position, tracked, size).tolist() == [True, False, False, False]
    still = np.zeros_like(position)
    assert find_lost_tracks(position, still, tracked, size, chunk_frames=4, fps=10.0).drone.tolist() == [1, 3]
    # Who lands is a drone even if it is never found exactly there; and nobody is a hole by itself.
    assert find_false_tracks(position[:, 1:], tracked[:, 1:], size[1:]).tolist() == [False, False, False]
    assert find_false_tracks(position[:, :1], tracked[:, :1], size[:1]).tolist() == [False]
    assert find_false_tracks(position[:, :0], tracked[:, :0], size[:0]).shape == (0,)


def test_half_swallowed_a_drone_only_seems_to_move():
    """Ten frames at 10 frames per second. One stood until what was left of it crept away; one flew slowly; one stopped;
    one has just landed.

    The first was said to have vanished flying.
    """
    position = np.zeros((12, 4, 3))
    position[..., 1] = (0.0, 1.0, 2.0, 3.0)
    position[8:10, 0, 0] = (0.04, 0.08)
    position[:, 1, 0] = 0.03 * np.arange(12)
    position[:4, 3, 2] = (0.8, 0.6, 0.4, 0.2)
    position[9, 3, 0] = 0.06
    velocity = np.zeros((12, 4, 3))
    velocity[9, 3, 0] = 0.4
    velocity[8:10, 0, 0], velocity[:, 1, 0], velocity[9, 2, 0] = 0.5, 0.3, 0.05
    position[:, 2, 0] = np.minimum(0.1 * np.arange(12), 0.8)
    gone = find_lost_tracks(
        position, velocity, history(*["x" * 10 + ".."] * 4), np.full((4, 3), 0.5), chunk_frames=4, fps=10.0
    )
    np.testing.assert_array_equal(gone.position_m[:, 0], [0.0, 0.27, 0.8, 0.0])
    np.testing.assert_array_equal(gone.velocity_m_s[:, 0], [0.0, 0.3, 0.05, 0.0])
    np.testing.assert_array_equal(gone.left_m, [[0.0, 0.0, 0.0], [0.0, 3.0, 0.0]])


def test_arrivals_by_hand():
    """Of four known drones the third is found again; one is born; one is nobody."""
    found = (newcomer((1, 1, 1), frame=3), newcomer((2, 2, 2), frame=5, span_m=0.7), newcomer((3, 3, 3)))
    gone = lost(AHEAD, AHEAD)
    gone.drone[:] = (0, 2)
    arrivals = plan_starts(found, np.array([1, NEW, NOBODY]), gone, 4)
    assert arrivals.begin_frame.tolist() == [-1, -1, 3, -1, 5]
    assert arrivals.begin_position_m.tolist() == [[0, 0, 0], [0, 0, 0], [1, 1, 1], [0, 0, 0], [2, 2, 2]]
    assert arrivals.begin_velocity_m_s[:, 0].tolist() == [0, 0, 1, 0, 1]
    assert arrivals.born_size_m.tolist() == [[0.7, 0.7, 0.35]]


def test_no_arrivals():
    arrivals = plan_starts((), np.empty(0, int), lost(), 2)
    assert arrivals.begin_frame.tolist() == [-1, -1]
    assert arrivals.born_size_m.shape == (0, 3)
