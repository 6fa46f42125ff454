"""kill -9 at moments of chance: no finished cell is lost or run twice, and runners share what is left.

`PSOTRACK_KILLS=20 pytest -n 0 --log-cli-level=INFO tests/test_sweep_kills.py` does it more often, and says what it saw.
"""

import json
import logging
import os
import random
import time
from pathlib import Path

import pytest
from sweeps import all_rows, grid_file, small_sequence, stamps, started

logger = logging.getLogger(__name__)

KILLS = int(os.environ.get("PSOTRACK_KILLS", "3"))

#: Cells per kill: there is always something left.
CELLS = 3


def claims(results: Path) -> list[dict]:
    return [json.loads(path.read_text() or "{}") for path in (results / "cells").glob("*.claim")]


def killed(root: Path, grid: Path, results: Path, rng: random.Random) -> None:
    """Start a runner and kill it: while it starts and works at its first cell, or some cells later."""
    before, more = len(stamps(results)), rng.choice([0, 0, 1, 2])
    runner = started(root, "sweep", grid, "--data", root, "--out", results)
    try:
        until = time.monotonic() + 120
        while (
            not any(claim.get("process") == runner.pid for claim in claims(results))
            or len(stamps(results)) < before + more
        ):
            assert runner.poll() is None, runner.communicate()
            assert time.monotonic() < until, "it does nothing"
            time.sleep(0.002)
        # A first cell takes seconds, because the program is fetched; the others fractions of one.
        time.sleep(rng.uniform(0, 0.4 if more else 4))
    finally:
        runner.kill()
        runner.communicate()


@pytest.mark.slow
def test_kills_lose_nothing_and_repeat_nothing(tmp_path_factory, tmp_path):
    root, results = small_sequence(tmp_path_factory), tmp_path / "results"
    rng = random.Random(KILLS)
    iterations = list(range(2, 2 + CELLS * KILLS))
    grid = grid_file(tmp_path, iterations)
    finished: dict[str, int] = {}
    for number in range(KILLS):
        killed(root, grid, results, rng)
        now = stamps(results)
        assert finished.items() <= now.items(), "a finished cell was lost or written again"
        ended, at_work = len(now) - len(finished), len(claims(results))
        logger.info("kill %d: %d cells finished, %d being run", number + 1, ended, at_work)
        finished = now
    logger.info("%d of %d cells were finished by runners that were killed", len(finished), len(iterations))
    two = [started(root, "sweep", grid, "--data", root, "--out", results, "--json", "-") for _ in range(2)]
    ends = [(*runner.communicate(), runner.returncode) for runner in two]
    assert [code for _, _, code in ends] == [0, 0], ends
    counts = [json.loads(out) for out, _, _ in ends]
    logger.info("then two runners finished %s", [count["finished"] for count in counts])
    assert sum(count["finished"] for count in counts) == len(iterations) - len(finished)
    assert finished.items() <= stamps(results).items()
    assert sorted(all_rows(results)["settings.iterations"]) == iterations
    assert not claims(results)
