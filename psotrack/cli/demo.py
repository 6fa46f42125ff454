"""`psotrack demo`: simulate, track and evaluate once, without any data."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import click

from psotrack.cli.options import JOBS, compiled_folder, out_option, running
from psotrack.cli.output import Output
from psotrack.cli.records import HelpfulCommand


@click.command(cls=HelpfulCommand)
@out_option("Folder of the results.", default=Path("psotrack-demo"), show_default=True)
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of flights, noise and swarm.")
@JOBS
@running(json=False)
def demo(output: Output, out: Path, seed: int, jobs: int | None) -> None:
    """Simulate four drones, track them in eight videos, print the errors and save a picture.

    \b
    Example:
      psotrack demo --out demo
    """
    from psotrack.demo import run
    from psotrack.support import keep_compiled

    keep_compiled(compiled_folder(None))
    result = run(out, seed=seed, jobs=jobs, force=output.force, report=output.report)
    output.show(result.errors, result.stages)
    output.say(f"picture: {result.picture}")
    # A command of an environment that is not activated is typed with its path.
    program = "psotrack" if shutil.which("psotrack") else os.path.relpath(sys.argv[0])
    output.say(f"next: {program} view {result.tracks} {result.sequence}")
