"""kill -9 at lines of chance: no finished cell is lost or run twice, and runners share what is left.

`PSOTRACK_KILLS=20 pytest -n 0 --log-cli-level=INFO tests/test_sweep_kills.py` does it more often, and says what it saw.
"""

import json
import logging
import os
import random
import signal
from concurrent.futures import ThreadPoolExecutor

import pytest
from sweeps import all_rows, grid_file, psotrack, python, small_sequence, stamps

from psotrack.sweep import Store

logger = logging.getLogger(__name__)

KILLS = int(os.environ.get("PSOTRACK_KILLS", "3"))

#: Cells per kill: there is always something left.
CELLS = 3

#: `psotrack`, which kills itself before it runs the LINE-th line of what keeps results: python -c KILLED LINE WORDS.
#: Between lines of anything else, nothing changes on the disk.
KILLED = """
import os, signal, sys

left = int(sys.argv.pop(1))
keepers = tuple(f"psotrack/{name}.py" for name in ("files", "sweep/locks", "sweep/store"))

def on_line(frame, event, argument):
    global left
    left -= event == "line"
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return on_line

def on_call(frame, event, argument):
    return on_line if frame.f_code.co_filename.endswith(keepers) else None

sys.settrace(on_call)
from psotrack.cli import main
main()
"""
#: Measured: modules are imported until line 106; rows of cells are written from lines 363, 516, 669 and so on.
LINES = range(106, 700)


@pytest.mark.slow
def test_kills_lose_nothing_and_repeat_nothing(tmp_path_factory, tmp_path):
    root, results = small_sequence(tmp_path_factory), tmp_path / "results"
    rng = random.Random(KILLS)
    iterations = list(range(2, 2 + CELLS * KILLS))
    words = ("sweep", grid_file(tmp_path, iterations), "--data", root, "--out", results)
    finished: dict[str, tuple[int, int]] = {}
    for number in range(KILLS):
        line = rng.choice(LINES)
        killed = python(root, "-c", KILLED, line, *words)
        assert killed.returncode == -signal.SIGKILL, killed
        now = stamps(results)
        assert finished.items() <= now.items(), "a finished cell was lost or written again"
        claims = len(list((results / "cells").glob("*.claim")))
        logger.info("kill %d, line %d: %d cells finished, %d claimed", number + 1, line, len(now), claims)
        finished = now
    logger.info("%d of %d cells were finished by runners that were killed", len(finished), len(iterations))
    with ThreadPoolExecutor(2) as threads:
        two = list(threads.map(lambda _: psotrack(root, *words, "--json", "-"), range(2)))
    assert [runner.returncode for runner in two] == [0, 0], two
    counts = [json.loads(runner.stdout) for runner in two]
    logger.info("then two runners finished %s", [count["finished"] for count in counts])
    assert sum(count["finished"] for count in counts) == len(iterations) - len(finished)
    assert finished.items() <= stamps(results).items()
    assert sorted(all_rows(results)["settings.iterations"]) == iterations
    assert Store(results).status()["at_work"] == []
