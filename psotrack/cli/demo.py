"""`psotrack demo`: simulate, track and evaluate once, without any data."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import click

from psotrack.cli.options import FORCE, JOBS, compiled_folder, reporting
from psotrack.cli.output import report_to


@click.command()
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=Path("psotrack-demo"),
    show_default=True,
    help="Folder of the results.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of flights, noise and swarm.")
@JOBS
@FORCE
@reporting
def demo(out: Path, seed: int, jobs: int | None, force: bool, quiet: bool) -> None:
    """Simulate four drones, track them in eight videos, print the errors and save a picture.

    \b
    Example:
      psotrack demo --out demo
    """
    from rich.console import Console

    from psotrack.demo import run
    from psotrack.support import keep_compiled

    keep_compiled(compiled_folder(None))
    result = run(out, seed=seed, jobs=jobs, force=force, report=report_to(quiet))
    if not quiet:
        console = Console()
        console.print(result.errors)
        console.print(result.stages)
        console.print(f"picture: {result.picture}", soft_wrap=True)
        # A command of an environment that is not activated is typed with its path.
        program = "psotrack" if shutil.which("psotrack") else os.path.relpath(sys.argv[0])
        flight = f"{result.tracks} --sequence {result.sequence}"
        console.print(f"next: {program} view {flight}", soft_wrap=True, markup=False, highlight=False)
