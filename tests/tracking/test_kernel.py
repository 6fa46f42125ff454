"""The swarm per drone as one kernel: the results of the swarm that XLA compiles, by Pallas' interpreter on the CPU."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ROOM_M, draw_coverage, drawn_silhouettes, float32, ring_rig, track_settings
from windows import cut_at

from psotrack.errors import SettingsError
from psotrack.geometry import make_extents
from psotrack.settings import SwarmSettings
from psotrack.tracking.births import InitialState
from psotrack.tracking.swarm import (
    DroneFitness,
    RunInputs,
    ScoreInputs,
    SearchRegion,
    SoftIoU,
    find_search,
    track_silhouettes,
    tracker_settings,
)

SIZE_M = np.array([[0.5, 0.5, 0.3], [0.6, 0.6, 0.35]], np.float32)
#: The drones hide each other from some cameras.
PLACE_M = np.array([[0.3, 0.0, 1.4], [-0.2, -0.5, 1.2]], np.float32)
EFFORT = {"particles": 6, "iterations": 5}


def search_case(name, *, coefficients=0, cameras=3, fisheye=None):
    """A search of two runs, and its arguments: the keys, and first positions beside the drones."""
    rig = ring_rig(cameras, coefficients=coefficients)
    patches = cut_at(rig, draw_coverage(rig, PLACE_M, SIZE_M, 2), PLACE_M, SIZE_M, reduction=2)
    seen = make_extents(float32(replace(rig.cameras, fisheye=fisheye)), SIZE_M)
    objective = DroneFitness(ScoreInputs(seen, jax.tree.map(jnp.asarray, patches), SoftIoU()))
    region = SearchRegion(PLACE_M - 0.3, PLACE_M + 0.3, jnp.full(3, 0.1))
    search = find_search(SwarmSettings(search=name, **EFFORT))

    def one_run(key, first):
        return search(key, objective, first, region, jnp.int32(EFFORT["iterations"]))

    noise = np.random.default_rng(0).normal(0, 0.1, (2, EFFORT["particles"], *PLACE_M.shape))
    arguments = jax.random.split(jax.random.key(3), 2), np.float32(PLACE_M + noise)
    return jax.jit(jax.vmap(one_run)), arguments


def test_the_best_positions_are_those_of_the_swarm():
    """Three cameras and six particles: the kernel fills up both."""
    of_swarm, of_kernel = (
        np.asarray(search(*arguments)) for search, arguments in map(search_case, ("pso", "pso-kernel"))
    )
    _, (_, first) = search_case("pso")
    assert (np.abs(of_swarm[:, None] - first).max(axis=-1) > 1e-3).all()
    # Roundings of single operations on metres.
    np.testing.assert_allclose(of_kernel, of_swarm, atol=1e-5)


@pytest.mark.parametrize(("coefficients", "cameras"), [(0, 8), (5, 3)])
def test_it_compiles_to_triton(coefficients, cameras):
    """The program for a GPU, up to Triton's code: no GPU is needed."""
    search, arguments = search_case("pso-kernel", coefficients=coefficients, cameras=cameras)
    text = search.trace(*arguments).lower(lowering_platforms=("cuda",)).as_text()
    assert text.count("custom_call @__gpu$xla.gpu.triton") == 1
    # The blocks of threads: those of two drones in two runs.
    assert "grid_x = 2 : i32, grid_y = 2 : i32, grid_z = 1 : i32" in text


@pytest.mark.parametrize(
    ("options", "found"), [({"swarm": "joint"}, "swarm.kind joint"), ({"score": "hard"}, "another score")]
)
def test_other_swarms_and_scores_are_refused(options, found):
    with pytest.raises(SettingsError) as refused:
        tracker_settings(track_settings(search="pso-kernel", **options))
    needed = "swarm.kind per-drone, score.kind soft and no fisheye lens"
    assert str(refused.value) == f"swarm.search pso-kernel: expected {needed}, found {found}"


def test_a_fisheye_lens_is_refused():
    search, arguments = search_case("pso-kernel", coefficients=5, fisheye=np.array([True, False, False]))
    with pytest.raises(SettingsError, match="found a fisheye lens"):
        search(*arguments)


@pytest.mark.slow
def test_the_tracks_are_those_of_the_swarm():
    rig, frames = ring_rig(3, coefficients=5), 4
    silhouettes = drawn_silhouettes(rig, np.broadcast_to(PLACE_M, (frames, 2, 3)), SIZE_M, 2)
    given = InitialState(PLACE_M + 0.02, np.zeros((2, 3)), SIZE_M, np.full(2, 5.0))

    def tracked(search):
        chosen = tracker_settings(track_settings(search=search, drones=2, **EFFORT))
        ((tracks, _),) = track_silhouettes(rig, silhouettes, [RunInputs(ROOM_M, chosen, given)], fps=25.0)
        return tracks.position_m

    # Where rounding puts an edge into the next pixel of a window, the searches end at different corners.
    np.testing.assert_allclose(tracked("pso-kernel"), tracked("pso"), atol=1e-4)
