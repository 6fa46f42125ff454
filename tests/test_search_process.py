"""The search for new drones in a process of its own: same results, and one line where the process dies."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from dataclasses import replace

import numpy as np
import pytest
from helpers import ROOM_M, draw_coverage, ring_rig

from psotrack.errors import PsotrackError
from psotrack.initiation import CandidateSearch, FoundCandidates, SeenFrame
from psotrack.live.packed_image import PackedImage
from psotrack.live.search_process import search_beside

FPS = 25.0
RIG = ring_rig(5, image_size_wh=(480, 360))
SIZE_M = np.array([[0.5, 0.5, 0.3]])
PLACES = 4


def _search() -> CandidateSearch:
    return CandidateSearch(
        RIG.cameras,
        reduction=2,
        fps=FPS,
        bounds_m=ROOM_M,
        max_speed_m_s=10.0,
        min_viewpoints=3,
        places=(PLACES,),
    )


def _frame(number: int) -> SeenFrame:
    """One drone that nobody tracks."""
    position_m = np.array([[-0.5, 0.2, 1.2]]) + number / FPS * np.array([[0.4, 0.1, 0.0]])
    return SeenFrame(
        number,
        draw_coverage(RIG, position_m, SIZE_M, 2),
        np.ones(len(RIG), bool),
        np.zeros((PLACES, 3)),
        np.zeros(PLACES, bool),
        np.full((PLACES, 3), np.nan),
        np.zeros((PLACES, len(RIG), 3)),
        is_wanted=True,
        begun=0,
    )


@pytest.mark.slow
def test_the_process_finds_what_the_search_finds() -> None:
    search, frames = _search(), [_frame(number) for number in range(40)]
    expected = [found for frame in frames for found in search.see(frame)]
    assert len(expected) > 1
    with search_beside(_search()) as beside:
        beside.compile()
        found: list[FoundCandidates] = []
        for frame in frames:
            found += beside.see(frame)
        # Frames without a drone bring no results, but results of before arrive with them.
        for number in range(40, 400):
            if found and found[-1].last_frame >= expected[-1].last_frame:
                break
            time.sleep(0.05)
            empty = _frame(number)
            found += beside.see(replace(empty, coverage=np.zeros_like(empty.coverage)))
    found = [each for each in found if each.last_frame < 40]
    assert [(each.number, each.begin_frame, each.last_frame) for each in found] == [
        (each.number, each.begin_frame, each.last_frame) for each in expected
    ]
    for one, two in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.candidates[0].last.position_m, two.candidates[0].last.position_m)


@pytest.mark.slow
def test_a_process_that_died_is_one_line() -> None:
    with search_beside(_search()) as beside:
        beside.compile()
        (process,) = multiprocessing.active_children()
        assert process.pid is not None
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        with pytest.raises(
            PsotrackError, match="the process that searches for new drones: expected that it runs, "
        ):
            beside.see(_frame(0))


def test_an_image_is_the_same_after_it_was_packed() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (3, 17, 23), dtype=np.uint8) * (rng.random((3, 17, 23)) < 0.1).astype(
        np.uint8
    )
    packed = PackedImage.of(image)
    assert len(packed.pixel) == np.count_nonzero(image)
    np.testing.assert_array_equal(packed.unpacked(), image)
