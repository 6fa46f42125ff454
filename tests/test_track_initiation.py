"""Track candidates in silhouettes of ellipsoids that are drawn by ray casting, and re-identification of lost drones."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from helpers import ROOM_M, draw_coverage, float32, make_unnamed_rig, ring_rig
from scipy.linalg import expm
from scipy.stats import multivariate_normal, norm

from psotrack.geometry import make_extents, project, project_boxes, viewpoints
from psotrack.initiation import (
    NEW,
    KnownDrones,
    LostTracks,
    TrackCandidate,
    find_candidates,
    find_false_tracks,
    find_lost_tracks,
    plan_starts,
    reidentify,
)
from psotrack.initiation.reidentification import NO_DRONE
from psotrack.initiation.residual_foreground import ResidualForeground, SearchVolume, project_drones
from psotrack.silhouettes import ForegroundSettings
from psotrack.silhouettes.foreground import foreground, learning_step

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
    """Positions on a parabola over time: (frames, 3)."""
    bend = np.asarray(acceleration_m_s2) * TIME_S**2 / 2
    return np.asarray(position_m) + np.asarray(velocity_m_s) * TIME_S + bend


def draw_silhouettes(*paths_m, size_m=SIZE_M, rig=RIG):
    """Silhouettes of drones on paths: (frames, cameras, height, width)."""
    sizes = np.broadcast_to(np.array(size_m, float), (len(paths_m), 3))
    return np.maximum.reduce(
        [draw_one_drone(one, size, rig) for one, size in zip(paths_m, sizes, strict=True)]
    )


def draw_one_drone(path_m, size_m, rig):
    """Silhouettes of one drone, kept in a dictionary because ray casting is slow and tests share paths."""
    key = (path_m.tobytes(), size_m.tobytes(), len(rig))
    if key not in _DRAWN:
        # A drone that stands still looks the same in every frame.
        places, which = np.unique(path_m, axis=0, return_inverse=True)
        images = np.stack([draw_coverage(rig, place, size_m, REDUCTION) for place in places])
        _DRAWN[key] = images[which.ravel()]
    return _DRAWN[key]


_DRAWN = {}


def candidates_in(coverage, *known_m, size_m=SIZE_M, rig=RIG, min_viewpoints=None):
    known = np.stack(known_m, axis=1) if known_m else np.empty((len(coverage), 0, 3))
    return find_candidates(
        rig.cameras,
        coverage,
        KnownDrones(
            known[: len(coverage)],
            np.isfinite(known[: len(coverage)]).all(axis=-1),
            np.broadcast_to(size_m, (len(known_m), 3)),
            min_viewpoints=min_viewpoints,
        ),
        reduction=REDUCTION,
        fps=FPS,
        bounds_m=ROOM_M,
        max_speed_m_s=MAX_SPEED_M_S,
    )


ONE = path((0.6, -0.5, 1.5), (0.8, 0.2, 0.1))
OTHER = path((-0.7, 0.6, 0.9), (0.0, -1.0, 0.2), (1.0, 0.5, 0.0))


@pytest.fixture(scope="module")
def two_drones():
    images = draw_silhouettes(ONE, OTHER)
    images.flags.writeable = False
    return images


def blank(coverage, frames=slice(None), cameras=slice(None)):
    """The silhouettes, empty in some frames and cameras."""
    coverage = coverage.copy()
    coverage[frames, cameras] = 0
    return coverage


def test_known_drones_explain_all_foreground(two_drones):
    assert candidates_in(two_drones, ONE, OTHER) == ()


def test_an_unknown_drone_is_found(two_drones):
    (found,) = candidates_in(two_drones, ONE)
    assert found.frame == 0
    # Each of six views gives a blob's middle to a fraction of a cell, and the position in the first of ten frames is as
    # accurate as a position from a single frame. Limit one cell.
    np.testing.assert_allclose(found.position_m, OTHER[0], atol=CELL_M)
    # At the end of a parabola through ten positions, the standard error of the speed is 0.44 times the error of a
    # position per frame; 3 mm give 0.03 m/s. Measured 0.07, limit 0.3.
    np.testing.assert_allclose(found.velocity_m_s, (0.0, -1.0, 0.2), atol=0.3)
    # As in the tests of initialisation, sizes are at most half a cell too large at each end, heights a whole cell.
    np.testing.assert_allclose(found.size_m[:2], SIZE_M[:2], atol=1.5 * CELL_M)
    np.testing.assert_allclose(found.size_m[2], SIZE_M[2], atol=3 * CELL_M)
    # One of six cameras has the drone at its image's border.
    assert found.num_cameras >= 5
    assert found.moves


def test_without_known_drones_all_drones_are_found(two_drones):
    found = candidates_in(two_drones)
    assert len(found) == 2
    first = np.array([one.position_m for one in found])
    for truth in (ONE, OTHER):
        assert np.linalg.norm(first - truth[0], axis=-1).min() < CELL_M


def test_a_drone_that_explains_nothing_hides_no_candidate(two_drones):
    """Known drones whose positions are marked as too uncertain: both drones are found."""
    known = np.stack([ONE, OTHER], axis=1)
    found = find_candidates(
        RIG.cameras,
        two_drones,
        KnownDrones(known, np.zeros(known.shape[:2], bool), np.stack([SIZE_M, SIZE_M])),
        reduction=REDUCTION,
        fps=FPS,
        bounds_m=ROOM_M,
        max_speed_m_s=MAX_SPEED_M_S,
    )
    assert len(found) == 2


@pytest.mark.parametrize("first", [3, 9, 15])
def test_the_first_frame_of_a_candidate(two_drones, first):
    """Also where the frame that is searched (0, 8, 16, 24) comes after the drone's first frame."""
    coverage = blank(draw_silhouettes(OTHER), slice(first))
    (found,) = candidates_in(np.maximum(coverage, draw_silhouettes(ONE)), ONE)
    assert found.frame == first
    np.testing.assert_allclose(found.position_m, OTHER[first], atol=CELL_M)


@pytest.mark.parametrize(("frames", "count"), [(range(10, 17), 0), (range(10, 18), 1), (range(16, 25), 0)])
def test_a_candidate_must_persist(frames, count):
    """Eight of ten frames are needed; the last nine frames of a chunk are searched with the next chunk."""
    gone = np.ones(NUM_FRAMES, bool)
    gone[list(frames)] = False
    assert len(candidates_in(blank(draw_silhouettes(OTHER), gone))) == count


def test_a_drone_that_flickers_is_one_drone():
    (found,) = candidates_in(blank(draw_silhouettes(OTHER), [5, 11, 12, 19]))
    assert found.frame == 0


@pytest.mark.parametrize("hidden", [slice(10, 14), slice(8, 15), slice(10, 25)])
def test_a_drone_that_is_hidden_for_a_while_is_one_candidate(hidden):
    """The candidate begins at the drone's first frame; the tracker finds the drone again after the gap."""
    (found,) = candidates_in(blank(draw_silhouettes(OTHER), hidden))
    assert found.frame == 0


def test_a_candidate_is_no_faster_than_a_drone():
    assert candidates_in(draw_silhouettes(path((-1.5, 0.0, 1.5), (1.1 * MAX_SPEED_M_S, 0.0, 0.0)))) == ()
    assert len(candidates_in(draw_silhouettes(path((-1.5, 0.0, 1.5), (0.9 * MAX_SPEED_M_S, 0.0, 0.0))))) == 1


def test_shadows_and_reflections_are_no_candidates():
    """Both look the same in all views and move like drones; shadows are flat on the floor, reflections below it."""
    shadow, reflection = ONE * (1, 1, 0), ONE * (1, 1, -1)
    assert (
        candidates_in(
            draw_silhouettes(ONE, shadow, reflection, size_m=[SIZE_M, [0.5, 0.5, 0.02], SIZE_M]), ONE
        )
        == ()
    )


@pytest.mark.parametrize(("scale", "count"), [(0.35, 0), (0.8, 1), (1.4, 1), (2.8, 0)])
def test_a_candidate_has_a_drones_size(two_drones, scale, count):
    coverage = draw_silhouettes(ONE, OTHER, size_m=[SIZE_M, scale * SIZE_M])
    assert len(candidates_in(coverage, ONE)) == count


@pytest.mark.parametrize("off_m", [(0.08, 0.0, 0.0), (0.0, -0.06, 0.06), (0.0, 0.0, -0.1)])
def test_the_rim_of_a_known_drone_is_no_candidate(two_drones, off_m):
    """If the track is wrong by a fifth of the drone's size, and the size by a fifth too, all views show a rim."""
    assert candidates_in(two_drones, ONE + off_m, OTHER, size_m=0.8 * SIZE_M) == ()


def test_three_viewpoints_are_enough_and_two_are_only_where_the_rig_has_no_third():
    """A third camera beside the second one adds no viewpoint."""
    three = ring_rig(3, image_size_wh=IMAGE_WH)
    (found,) = candidates_in(draw_silhouettes(OTHER, rig=three), rig=three)
    np.testing.assert_allclose(found.position_m, OTHER[0], atol=CELL_M)
    assert found.num_cameras == 3
    first, second = three.cameras[0], three.cameras[1]
    T = second.T_cam_world.copy()
    T[0, 3] += 0.1
    twin = make_unnamed_rig(first, second, replace(second, T_cam_world=T))
    images = np.concatenate(
        [draw_silhouettes(OTHER, rig=three)[:, :2], draw_silhouettes(OTHER, rig=three)[:, 1:2]], axis=1
    )
    (found,) = candidates_in(images, rig=twin)
    np.testing.assert_allclose(found.position_m, OTHER[0], atol=2 * CELL_M)
    assert candidates_in(images, rig=twin, min_viewpoints=3) == ()
    four = ring_rig(4, image_size_wh=IMAGE_WH)
    two_see = blank(draw_silhouettes(OTHER, rig=four), cameras=[2, 3])
    assert candidates_in(two_see, rig=four) == ()


@pytest.mark.parametrize(("blind", "count"), [([4], 1), ([1, 4], 0)])
def test_nearly_all_cameras_must_see_a_candidate(blind, count):
    """An obstacle may hide the drone from one camera of six; if two cameras see nothing, there is no drone."""
    assert len(candidates_in(blank(draw_silhouettes(OTHER), cameras=blind))) == count


def test_crossing_rays_of_different_drones_are_no_candidate():
    """Three cameras see foreground in the direction of an empty place: one sees a drone, two see rims of drones."""
    place = np.array([0.2, 0.3, 1.4])
    behind = []
    for camera, distance in ((0, 0.9), (2, 1.1), (4, 1.0)):
        ray = place - RIG.cameras.centre_world[camera]
        behind.append(path(place + distance * ray / np.linalg.norm(ray)))
    coverage = draw_silhouettes(*behind)
    seen = [coverage[0, camera, *_cell(place, camera)] > 0 for camera in range(6)]
    assert sum(seen) >= 3
    places = [one.position_m for one in candidates_in(coverage)]
    assert all(np.linalg.norm(place - one) > 0.5 for one in places)
    assert len(places) == 3


def _cell(place_m, camera):
    (column, row), _ = project(RIG.cameras[camera], place_m)
    return int((row + 0.5) // REDUCTION), int((column + 0.5) // REDUCTION)


def test_a_drone_that_a_known_drone_half_hides():
    """In camera 0 the known drone hides a side of the other drone; the visible rest must not shift the position."""
    ray = OTHER[0] - RIG.cameras.centre_world[0]
    before = OTHER[0] - 1.2 * ray / np.linalg.norm(ray) + (0.0, 0.0, 0.3)
    known = path(before)
    other = path(OTHER[0], (0.2, 0.0, 0.0))
    (found,) = candidates_in(draw_silhouettes(known, other), known)
    np.testing.assert_allclose(found.position_m, other[0], atol=CELL_M)


def test_a_flat_drone_that_sinks_fast_is_found():
    """The drone moves by more than its height from frame to frame, so its first ellipse does not cover the next one."""
    size_m = np.array([0.5, 0.5, 0.12])
    known, sinking = path((-0.6, 0.6, 0.9)), path((0.6, -0.5, 2.9), (0.0, 0.0, -2.8))[:15]
    silhouettes = np.maximum(
        draw_silhouettes(known, size_m=size_m)[:15], draw_silhouettes(sinking, size_m=size_m)
    )
    (found,) = candidates_in(silhouettes, known, size_m=size_m)
    np.testing.assert_allclose(found.position_m, sinking[found.frame], atol=2 * CELL_M)
    assert found.moves


def test_a_candidate_that_stands_still_is_marked():
    """A ghost looks like a drone that does not move; only the missing motion shows the difference."""
    ghost, drone = path((0.6, -0.5, 1.5)), OTHER
    found = sorted(candidates_in(draw_silhouettes(ghost, drone)), key=lambda one: one.position_m[0])
    assert [one.moves for one in found] == [True, False]


def test_known_drones_explain_their_enlarged_ellipse():
    """Compared with the ellipse's inequality at the middle of each cell, except for cells on the ellipse's edge."""
    full = np.full((6, 90, 120), 255, np.uint8)
    volume = SearchVolume(RIG.cameras, viewpoints(RIG.cameras), ROOM_M, REDUCTION)
    drones = project_drones(volume, ONE[:1, None], SIZE_M[None])
    residual = ResidualForeground(full, drones, 0)
    seen = project_boxes(make_extents(float32(RIG.cameras), np.float32(SIZE_M)), np.float32(ONE[0]))
    y, x = np.mgrid[:90, :120] + 0.5
    for camera in range(6):
        u = (x - seen.x_middle[camera] / REDUCTION) / (1.3 * seen.x_half[camera] / REDUCTION + 1.5)
        v = (y - seen.y_middle[camera] / REDUCTION) / (1.3 * seen.y_half[camera] / REDUCTION + 1.5)
        radius = np.hypot(u, v)
        # The half axes are at least eight cells, so a tenth is about a cell.
        foreground, visible = residual.part(camera)
        assert not foreground[radius < 0.9].any()
        assert (foreground[radius > 1.1] == 255).all()
        np.testing.assert_array_equal(visible, foreground == 255)
        # A part of the image is what the whole image shows there, also where an ellipse is cut.
        row, column = (int(value) // REDUCTION for value in (seen.y_middle[camera], seen.x_middle[camera]))
        for rows, columns in ((slice(row, row + 30), slice(column - 12, column)), (slice(5), slice(7, 9))):
            for part, whole in zip(residual.part(camera, rows, columns), (foreground, visible), strict=True):
                np.testing.assert_array_equal(part, whole[rows, columns])


def test_a_short_chunk_has_no_candidates(two_drones):
    assert candidates_in(two_drones[:9], ONE[:9]) == ()
    assert len(candidates_in(two_drones[:10], ONE[:10])) == 1


def test_a_drone_departs_that_the_background_model_has_learned():
    """Images through MOG2: a drone stands for two thirds of the video, so that it is learned, and then departs.

    While the drone stands it is not foreground. After the departure, its place is a ghost, which looks like a drone.
    """
    rig, standing = ring_rig(4, image_size_wh=IMAGE_WH), 60
    place = np.array([0.1, -0.2, 1.2])
    flight = path(place, (1.2, 0.9, 0.2))
    away = draw_one_drone(flight, SIZE_M, rig)
    before = np.broadcast_to(draw_one_drone(path(place), SIZE_M, rig)[0], (standing, *away.shape[1:]))
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
    # The mean over the drone's place: background while it stands, a ghost after the departure.
    cells = away[0] > 128
    assert coverage[20, cells].mean() < 10
    assert coverage[-1, cells].mean() > 200

    chunk = coverage[standing:]
    found = candidates_in(chunk, rig=rig)
    # Drone and ghost are one blob at first, so no track begins there. Only the drone is a candidate once they are
    # apart.
    assert [one.moves for one in found] == [True]
    # In the first of ten frames the ghost is still beside the drone. Measured 3 cm, limit 6.
    np.testing.assert_allclose(found[0].position_m, flight[found[0].frame], atol=2 * CELL_M)
    stood = lost_tracks((place, (0.0, 0.0, 0.0), 2.0))
    assert assigned_drones(found, stood, max_speed_m_s=MAX_SPEED_M_S) == [0]

    # A second later the drone is known and the ghost has not changed.
    ghost = np.repeat(coverage[-1:], NUM_FRAMES, axis=0)
    found = candidates_in(ghost, np.broadcast_to(flight[-1], (NUM_FRAMES, 3)).copy(), rig=rig)
    assert [one.moves for one in found] == [False]
    np.testing.assert_allclose(found[0].position_m, place, atol=CELL_M)
    assert assigned_drones(found, lost_tracks()) == [NO_DRONE]


# --- re-identification

ROOM_M3 = float(np.prod(ROOM_M[1] - ROOM_M[0]))


def candidate(position_m=(0.0, 0.0, 1.0), velocity_m_s=(1.0, 0.0, 0.0), *, frame=0, span_m=0.5, moves=True):
    size = np.array([span_m, span_m, span_m / 2])
    return TrackCandidate(frame, np.array(position_m, float), np.array(velocity_m_s, float), size, 5, moves)


def lost_tracks(*rows, left_m=()):
    """Lost drones from rows of position, velocity, seconds and an optional dictionary of `span_m` and `doubtful`."""
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


def assigned_drones(found, gone, **keywords):
    keywords = {"fps": FPS, "bounds_m": ROOM_M, "max_speed_m_s": 6.0} | keywords
    return reidentify(tuple(found), gone, **keywords).tolist()


AHEAD = ((-0.5, 0.0, 1.0), (1.0, 0.0, 0.0), 0.5)


def test_without_lost_drones_a_candidate_is_new():
    assert assigned_drones([candidate()], lost_tracks()) == [NEW]
    assert assigned_drones([], lost_tracks()) == []


def test_the_drone_on_course_is_chosen():
    """Two drones were lost half a metre away: one flew towards the candidate's place, one away from it."""
    away = ((0.5, 0.0, 1.0), (1.0, 0.0, 0.0), 0.5)
    assert assigned_drones([candidate()], lost_tracks(away, AHEAD)) == [1]


def test_each_lost_drone_is_one_candidate():
    """The first lost drone fits both candidates best, but only one candidate gets it."""
    also = ((-0.6, 0.5, 1.0), (1.0, 0.0, 0.0), 0.5)
    assert assigned_drones([candidate(), candidate((0.0, 0.2, 1.0))], lost_tracks(AHEAD, also)) == [0, 1]
    assert assigned_drones([candidate((0.0, 0.2, 1.0)), candidate()], lost_tracks(AHEAD, also)) == [1, 0]
    assert sorted(assigned_drones([candidate(), candidate((0.0, 0.2, 1.0))], lost_tracks(AHEAD))) == [NEW, 0]


def test_a_candidate_out_of_reach_is_new_unless_new_drones_are_not_allowed():
    """At six metres per second for half a second, the reach is three metres."""
    far = ((-4.5, 0.0, 1.0), (1.0, 0.0, 0.0), 0.5)
    assert assigned_drones([candidate()], lost_tracks(far)) == [NEW]
    assert assigned_drones([candidate()], lost_tracks(far), max_births=0) == [0]
    assert assigned_drones([candidate()], lost_tracks((*far[:2], 10.0))) == [0]


def test_after_a_long_time_the_size_decides():
    gone = ((2.0, 2.0, 1.0), (0.0, 1.0, 0.0), 20.0)
    assert assigned_drones([candidate(span_m=0.55)], lost_tracks(gone)) == [0]
    assert assigned_drones([candidate(span_m=1.0)], lost_tracks(gone)) == [NEW]
    assert assigned_drones([candidate(span_m=0.9)], lost_tracks(gone, (*gone, {"span_m": 0.9}))) == [1]
    assert assigned_drones([candidate(span_m=1.0)], lost_tracks(gone), max_births=0) == [0]


def test_a_drone_comes_back_near_the_place_where_it_left():
    """Two drones left through the ceiling two metres apart; after three seconds a candidate is near one of the places.

    Walls reflect drones, so the drones are nearer than they would be without walls.
    """
    left = (-1.5, -2.0, 3.0), (0.0, 0.0, 2.0), 3.5
    also = (-1.5, 0.5, 3.0), (0.0, 0.0, 2.0), 5.5
    back = candidate((-0.5, -1.7, 2.8), (1.4, 0.2, -2.5), span_m=0.46)
    assert assigned_drones([back], lost_tracks((*left, {"span_m": 0.5}), (*also, {"span_m": 0.46}))) == [0]
    assert assigned_drones([back], lost_tracks((*also, {"span_m": 0.46}), (*left, {"span_m": 0.5}))) == [1]
    # Sizes that differ by a third decide.
    assert assigned_drones([back], lost_tracks((*left, {"span_m": 0.62}), (*also, {"span_m": 0.46}))) == [1]


def test_the_number_of_new_drones_is_limited():
    found = [candidate(), candidate((1.0, 1.0, 1.0)), candidate((-1.0, 1.0, 1.0))]
    assert assigned_drones(found, lost_tracks()) == [NEW] * 3
    assert sorted(assigned_drones(found, lost_tracks(), max_births=2)) == [NO_DRONE, NEW, NEW]
    assert assigned_drones(found, lost_tracks(), max_births=0) == [NO_DRONE] * 3


def test_a_candidate_that_does_not_move_is_never_new():
    still = candidate(velocity_m_s=(0.0, 0.0, 0.0), moves=False)
    assert assigned_drones([still], lost_tracks()) == [NO_DRONE]
    # The lost drone may be anywhere by then, so the candidate may as well be a chair that a person has moved.
    assert assigned_drones([still], lost_tracks(((2.0, 2.0, 1.0), (0.0, 1.0, 0.0), 20.0))) == [NO_DRONE]
    # A drone that stood at the candidate's place when it was lost is assigned, after any time.
    assert assigned_drones([still], lost_tracks(((0.0, 0.1, 1.0), (0.05, 0.0, 0.0), 20.0))) == [0]


def test_a_ghost_is_not_the_drone_that_departed_from_it():
    """The background model has learned a drone. The ghost is exactly at its place, the drone half a metre away."""
    stood = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 20.0)
    ghost = candidate((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), moves=False)
    drone = candidate((0.5, 0.0, 1.0), (1.0, 0.0, 0.0), frame=5)
    assert assigned_drones([ghost, drone], lost_tracks(stood)) == [NO_DRONE, 0]
    passing_by = candidate((0.5, 0.0, 1.0), (0.0, 1.0, 0.0), frame=5)
    assert assigned_drones([ghost, passing_by], lost_tracks(stood)) == [0, NEW]


def test_a_drone_that_stood_still_when_it_was_lost_has_stayed():
    """The background model has learned a drone; another drone comes in at two metres per second, three metres away.

    The other drone is not the one that stood still. A drone that flew out of sight may be back.
    """
    coming = candidate((0.0, -2.7, 2.7), (0.0, 0.0, -2.0))
    stood = ((0.0, 0.3, 1.5), (0.0, 0.0, 0.0), 2.6)
    flew = ((0.0, 0.3, 1.5), (0.0, 0.0, 2.0), 2.6)
    assert assigned_drones([coming], lost_tracks(stood)) == [NEW]
    assert assigned_drones([coming], lost_tracks(flew)) == [0]
    # If no drone can be new, it is the drone that stood still; of two lost drones, it is the one that flew.
    assert assigned_drones([coming], lost_tracks(stood), max_births=0) == [0]
    assert assigned_drones([coming], lost_tracks(stood, flew)) == [1]


def test_a_ghost_that_seems_to_move_is_no_drone():
    """While the drone overlaps its ghost, the ghost seems to move slowly upwards; the drone is the faster candidate."""
    stood = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 20.0)
    ghost = candidate((0.0, 0.0, 1.05), (0.0, -0.02, 0.13))
    drone = candidate((0.1, 0.0, 1.3), (0.1, 0.0, 1.5), frame=9)
    assert assigned_drones([ghost, drone], lost_tracks(stood)) == [NO_DRONE, 0]
    assert assigned_drones([ghost, drone], lost_tracks()) == [NO_DRONE, NEW]
    # A slow and a fast drone at different places are two drones.
    elsewhere = candidate((1.0, 0.0, 1.3), (0.1, 0.0, 1.5), frame=9)
    assert assigned_drones([ghost, elsewhere], lost_tracks(stood)) == [0, NEW]


def test_a_fading_ghost_is_not_new():
    """While the background model learns the floor again, the rest of the ghost seems to move."""
    dying = candidate((2.2, 1.4, 1.5), (-0.1, 0.04, 0.01))
    assert assigned_drones([dying], lost_tracks(left_m=[(2.2, 1.3, 1.5)])) == [NO_DRONE]
    # A slow candidate elsewhere is new, and so is a fast candidate at this place; a drone lost here may be found again.
    assert assigned_drones([dying], lost_tracks(left_m=[(1.2, 1.3, 1.5)])) == [NEW]
    assert assigned_drones([candidate((2.2, 1.4, 1.5))], lost_tracks(left_m=[(2.2, 1.3, 1.5)])) == [NEW]
    stood = ((2.2, 1.3, 1.5), (0.0, 0.0, 0.0), 5.0)
    assert assigned_drones([dying], lost_tracks(stood, left_m=[(2.2, 1.3, 1.5)])) == [0]


def test_a_ghost_does_not_keep_a_track():
    """A drone found again at the place of its loss may be a ghost; a candidate that departs from there is the drone."""
    held = ((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 20.0, {"doubtful": True})
    assert assigned_drones([candidate((0.6, 0.0, 1.0))], lost_tracks(held)) == [0]
    assert assigned_drones([candidate((0.6, 0.0, 1.0), (0.0, 1.0, 0.0))], lost_tracks(held)) == [NEW]
    assert assigned_drones([candidate((2.0, 0.0, 1.0))], lost_tracks(held), max_births=0) == [NO_DRONE]


def test_a_drone_that_was_tracked_elsewhere_at_the_same_time_is_another_drone():
    """The drone is lost in frame 20 of the chunk, and the candidate is there from frame 2 on: both for 0.7 s."""
    here = ((0.3, 0.0, 1.0), (1.0, 0.0, 0.0), -20 / FPS)
    assert assigned_drones([candidate(frame=2)], lost_tracks(here)) == [NEW]
    assert assigned_drones([candidate(frame=18)], lost_tracks(here)) == [0]


def oracle_log_density(one, position_m, velocity_m_s, gap_s, sigma_m_s, time_s=1.0):
    """dv = -v/time dt + noise: the exact discretisation by a matrix exponential (C. F. Van Loan, 1978).

    The walls are mirrors: the images of the drone in them count as the drone.
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
def test_the_assignment_has_the_largest_likelihood(seed):
    """Compared with all permutations, with likelihoods from SciPy, for moving drones within reach."""
    rng = np.random.default_rng(seed)
    velocity, place = rng.normal(0.0, 1.0, (3, 3)), rng.uniform((-1, -1, 1), (1, 1, 2), (3, 3))
    gap = rng.uniform(0.2, 1.5, 3)
    span = rng.uniform(0.4, 0.6, 3)
    order = rng.permutation(3)
    found = [
        candidate(
            place[k] + gap[k] * velocity[k] + rng.normal(0, 0.3, 3), velocity[k] + rng.normal(0, 0.5, 3)
        )
        for k in order
    ]
    gone = lost_tracks(*((place[k], velocity[k], gap[k] + 0.5, {"span_m": span[k]}) for k in range(3)))
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
    assert assigned_drones(found, gone, max_births=0) == list(best)


# --- lost drones and planned starts


def tracked_frames(*rows):
    """Whether each drone was tracked, (frames, drones), from strings of `x` (tracked) and dots (not tracked)."""
    return np.array([[letter == "x" for letter in row] for row in rows]).T


def test_lost_drones_by_hand():
    """Six drones after a chunk of frames 8 to 11: tracked; lost before; lost within; never; doubtful; moved."""
    tracked = tracked_frames(
        "xxxxxxxxxxxx", "xxx.........", "xxxxxxxxxx..", "............", "xx....xxxxxx", "xx....xxxxxx"
    )
    frames = np.arange(12.0)
    position = np.zeros((12, 6, 3))
    position[..., 0] = frames[:, None]
    position[:, 4] = (1.0, 2.0, 0.1)
    gone = find_lost_tracks(position, position / 2, tracked, np.full((6, 3), 0.5), chunk_frames=4, fps=2.0)
    assert gone.drone.tolist() == [1, 2, 4]
    # The last frames in which these drones were tracked are 2, 9 and 1.
    np.testing.assert_array_equal(gone.position_m[:, 0], [2.0, 9.0, 1.0])
    # The last drone stands still, so its velocity is 0, although its state has another.
    np.testing.assert_array_equal(gone.velocity_m_s[:, 0], [1.0, 4.5, 0.0])
    np.testing.assert_array_equal(gone.seconds, [6 / 2, -1 / 2, 7 / 2])
    assert gone.doubtful.tolist() == [False, False, True]


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
    size = np.tile([0.5, 0.5, 0.2], (4, 1))
    assert find_false_tracks(position, tracked, size).tolist() == [True, False, False, False]
    still = np.zeros_like(position)
    assert find_lost_tracks(position, still, tracked, size, chunk_frames=4, fps=10.0).drone.tolist() == [1, 3]
    # A drone that lands is no false track, even if it is not found exactly there; a single track is not false.
    assert find_false_tracks(position[:, 1:], tracked[:, 1:], size[1:]).tolist() == [False, False, False]
    assert find_false_tracks(position[:, :1], tracked[:, :1], size[:1]).tolist() == [False]
    assert find_false_tracks(position[:, :0], tracked[:, :0], size[:0]).shape == (0,)


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
    velocity[9, 3, 0] = 0.4
    velocity[8:10, 0, 0], velocity[:, 1, 0], velocity[9, 2, 0] = 0.5, 0.3, 0.05
    position[:, 2, 0] = np.minimum(0.1 * np.arange(12), 0.8)
    gone = find_lost_tracks(
        position,
        velocity,
        tracked_frames(*["x" * 10 + ".."] * 4),
        np.full((4, 3), 0.5),
        chunk_frames=4,
        fps=10.0,
    )
    np.testing.assert_array_equal(gone.position_m[:, 0], [0.0, 0.27, 0.8, 0.0])
    np.testing.assert_array_equal(gone.velocity_m_s[:, 0], [0.0, 0.3, 0.05, 0.0])
    np.testing.assert_array_equal(gone.left_m, [[0.0, 0.0, 0.0], [0.0, 3.0, 0.0]])


def test_planned_starts_by_hand():
    """Of four known drones the third is found again; one candidate is new; one is no drone."""
    found = (candidate((1, 1, 1), frame=3), candidate((2, 2, 2), frame=5, span_m=0.7), candidate((3, 3, 3)))
    gone = lost_tracks(AHEAD, AHEAD)
    gone.drone[:] = (0, 2)
    planned = plan_starts(found, np.array([1, NEW, NO_DRONE]), gone, 4)
    assert planned.begin_frame.tolist() == [-1, -1, 3, -1, 5]
    assert planned.begin_position_m.tolist() == [[0, 0, 0], [0, 0, 0], [1, 1, 1], [0, 0, 0], [2, 2, 2]]
    assert planned.begin_velocity_m_s[:, 0].tolist() == [0, 0, 1, 0, 1]
    assert planned.born_size_m.tolist() == [[0.7, 0.7, 0.35]]


def test_no_planned_starts():
    planned = plan_starts((), np.empty(0, int), lost_tracks(), 2)
    assert planned.begin_frame.tolist() == [-1, -1]
    assert planned.born_size_m.shape == (0, 3)
