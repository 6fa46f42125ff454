"""Kill runners at random file operations: no finished cell is lost or run twice, and later runners finish the rest.

`PSOTRACK_KILLS=20 pytest -n 0 --log-cli-level=INFO tests/test_sweep_kills.py` kills more runners and logs the counts.
"""

import json
import logging
import os
import random
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest
from small_sweeps import all_rows, grid_file, psotrack, python, small_sequence, stamps

from psotrack.sweeps import Store

logger = logging.getLogger(__name__)

KILLS = int(os.environ.get("PSOTRACK_KILLS", "3"))

#: Number of cells per kill: large enough that unfinished cells are always left.
CELLS = 3

#: Program that runs `psotrack WORDS` and kills itself before its N-th operation on a file in FOLDER:
#: python -c KILLED N FOLDER WORDS.
KILLED = """
import os, signal, sys

left, folder = int(sys.argv.pop(1)), sys.argv.pop(1)

def on_event(event, arguments):
    global left
    if event in ("open", "os.mkdir", "os.remove", "os.rename") and str(arguments[0]).startswith(folder):
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)

sys.addaudithook(on_event)
from psotrack.cli import main
main()
"""
#: Number of file operations of a runner in a folder with three unfinished cells; each cell takes about a third.
OPERATIONS = 60


@pytest.mark.slow
def test_kills_lose_nothing_and_repeat_nothing(tmp_path_factory, tmp_path):
    root, results = small_sequence(tmp_path_factory), tmp_path / "results"
    rng = random.Random(KILLS)
    iterations = list(range(2, 2 + CELLS * KILLS))
    words = ("sweep", grid_file(tmp_path, iterations), "--data", root, "--out", results)
    finished: dict[str, tuple[int, int]] = {}
    for number in range(KILLS):
        operation = rng.randrange(1, OPERATIONS)
        killed = python(root, "-c", KILLED, operation, results, *words)
        assert killed.returncode == -signal.SIGKILL, killed
        now = stamps(results)
        assert finished.items() <= now.items(), "a finished cell was lost or written again"
        locks = len(list((results / "cells").glob(".*.lock")))
        logger.info(
            "kill %d, operation %d: %d cells finished, %d locked", number + 1, operation, len(now), locks
        )
        finished = now
    logger.info("runners that were killed finished %d of %d cells", len(finished), len(iterations))
    with ThreadPoolExecutor(2) as threads:
        two = list(threads.map(lambda _: psotrack(root, *words, "--json", "-"), range(2)))
    assert [runner.returncode for runner in two] == [0, 0], two
    counts = [json.loads(runner.stdout) for runner in two]
    logger.info("then two runners finished %s", [count["finished"] for count in counts])
    assert sum(count["finished"] for count in counts) == len(iterations) - len(finished)
    assert finished.items() <= stamps(results).items()
    assert sorted(all_rows(results)["settings.swarm.iterations"]) == iterations
    assert Store(results).status()["at_work"] == []
