"""Many tries in processes with limits of memory and time, which are replaced when they die or hang."""

from __future__ import annotations

import argparse
import collections
import os
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import click

from fuzz.formats import FORMATS
from fuzz.trial import Trial
from fuzz.worker import NAMES, Worker

#: Folder of files that failed.
FINDS = Path("build/fuzz")


def main() -> None:
    """Make tries until the time is over or the count is reached; exit code 1 if one failed."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--tries", type=int, default=10**9, help="largest number of tries")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first try")
    options = parser.parse_args()

    numbers = iter(range(options.first, options.first + options.tries))
    lock, began_s = threading.Lock(), time.monotonic()
    done: list[bool] = []
    finds: dict[tuple[str, str], int] = collections.Counter()

    def work(folder: Path) -> None:
        worker = Worker(folder, options.seed)
        while time.monotonic() - began_s < 60 * options.minutes:
            with lock:
                number = next(numbers, None)
            if number is None:
                break
            trial = worker.attempt(number)
            with lock:
                done.append(trial.is_refused)
                if trial.fault:
                    report(trial)
        worker.stop()

    def report(trial: Trial) -> None:
        """Of equal faults the first one."""
        key = (trial.name, trial.fault[:60])
        finds[key] += 1
        if finds[key] > 1:
            return
        kept = ""
        # The content of a try whose process ended is made again by the seed and the number.
        if trial.content:
            FINDS.mkdir(parents=True, exist_ok=True)
            suffix = Path(FORMATS[trial.name].file).suffix
            path = FINDS / f"{trial.name}-{options.seed}-{trial.number}{suffix}"
            path.write_bytes(trial.content)
            kept = f" ({path})"
        click.echo(f"FAILED try {trial.number}, {trial.name}, {trial.call}: {trial.fault}{kept}")

    jobs = os.sched_getaffinity(0)
    with tempfile.TemporaryDirectory(prefix="psotrack-fuzz-", ignore_cleanup_errors=True) as root:
        folders = [Path(root, f"{job}") for job in jobs]
        with ThreadPoolExecutor(len(jobs)) as threads:
            # To take the results raises the error of a thread.
            list(threads.map(work, folders))
    click.echo(
        f"{len(done)} tries of {len(NAMES)} formats with seed {options.seed}, from try {options.first} on, in "
        f"{time.monotonic() - began_s:.0f} s: {sum(done)} files refused, {sum(finds.values())} failures"
    )
    sys.exit(bool(finds))


if __name__ == "__main__":
    main()
