"""Many tries in processes with limits of memory and time, which are replaced when they die."""

from __future__ import annotations

import argparse
import collections
import os
import shutil
import sys
import tempfile
import threading
import time
from pathlib import Path

import click

from fuzz.formats import FORMATS
from fuzz.worker import Worker


def main() -> None:
    """Make tries until the time is over or the count is reached; exit code 1 if one failed."""
    parser = argparse.ArgumentParser(prog="python -m fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--tries", type=int, default=10**9, help="largest number of tries")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first try")
    parser.add_argument(
        "--formats", default="", help="names of formats, with commas between them; all if empty"
    )
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--finds", type=Path, default=Path("build/fuzz"), help="folder of files that failed")
    options = parser.parse_args()

    names = tuple(options.formats.split(",")) if options.formats else tuple(FORMATS)
    numbers = iter(range(options.first, options.first + options.tries))
    lock, began_s = threading.Lock(), time.monotonic()
    done, refused = collections.Counter(), collections.Counter()
    finds: dict[str, int] = {}

    def work(folder: Path) -> None:
        worker = Worker(folder, options.seed, names)
        while time.monotonic() - began_s < 60 * options.minutes:
            with lock:
                number = next(numbers, None)
            if number is None:
                break
            found = worker.attempt(number)
            with lock:
                name = names[number % len(names)]
                done[name] += 1
                if isinstance(found, str):
                    report(number, name, "", found, None)
                else:
                    refused[name] += found.is_refused
                    if found.fault:
                        report(number, name, found.call, found.fault, found.content)
        worker.stop()

    def report(number: int, name: str, call: str, fault: str, content: bytes | None) -> None:
        key = f"{name} {fault[:60]}"
        finds[key] = finds.get(key, 0) + 1
        if finds[key] > 1:
            return
        kept = ""
        if content is not None:
            options.finds.mkdir(parents=True, exist_ok=True)
            path = options.finds / f"{name}-{options.seed}-{number}{Path(FORMATS[name].file).suffix}"
            path.write_bytes(content)
            kept = f" ({path})"
        click.echo(f"FAILED try {number}, {name}, {call}: {fault}{kept}")

    root = Path(tempfile.mkdtemp(prefix="psotrack-fuzz-"))
    try:
        threads = [threading.Thread(target=work, args=(root / f"{job}",)) for job in range(options.jobs)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        shutil.rmtree(root, ignore_errors=True)
    click.echo(
        f"{sum(done.values())} tries of {len(names)} formats with seed {options.seed}, from try {options.first} on, in "
        f"{time.monotonic() - began_s:.0f} s: {sum(refused.values())} files refused, {sum(finds.values())} failures"
    )
    sys.exit(bool(finds))


if __name__ == "__main__":
    main()
