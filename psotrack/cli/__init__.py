"""The command line: every command says what it needs and what it writes, and shows an example.

In: arguments and files. Out: files, text on stdout, and one line on stderr where something is wrong. Commands contain
no numerics; they import the functions they call when they run, so that `--help` is quick. The exit code is 0 only
when everything was done, and 2 for every error.
"""

from __future__ import annotations

import logging
import os
import sys

import click

from psotrack import __version__
from psotrack.cli.as_real import as_real
from psotrack.cli.calibrate import calibrate
from psotrack.cli.demo import demo
from psotrack.cli.detect import detect
from psotrack.cli.doctor import doctor
from psotrack.cli.evaluate import evaluate
from psotrack.cli.fly import fly
from psotrack.cli.fuse import fuse
from psotrack.cli.info import info
from psotrack.cli.labels import labels
from psotrack.cli.localise import localise
from psotrack.cli.map_markers import map_markers
from psotrack.cli.silhouettes import silhouettes
from psotrack.cli.simulate import simulate
from psotrack.cli.sweep import sweep, table
from psotrack.cli.synchronise import synchronise
from psotrack.cli.track import track
from psotrack.errors import PsotrackError

__all__ = ["cli", "main"]


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="psotrack")
@click.option("--verbose", "-v", is_flag=True, help="Log what is done.")
def cli(verbose: bool) -> None:
    """3D positions of several drones, in every frame, from calibrated camera videos alone.

    \b
    Try it:          psotrack demo
    Step by step:    psotrack simulate S02_D4_A --out data
                     psotrack track data/Simulated_Data/S02_D4_A --out tracks.csv
                     psotrack evaluate tracks.csv data/Simulated_Data/S02_D4_A --plot
    """
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING,
        format="%(levelname)s %(name)s: %(message)s",
        stream=sys.stderr,
    )


for _command in (
    as_real,
    calibrate,
    demo,
    detect,
    doctor,
    evaluate,
    fly,
    fuse,
    info,
    labels,
    localise,
    map_markers,
    silhouettes,
    simulate,
    sweep,
    synchronise,
    table,
    track,
):
    cli.add_command(_command)


def main() -> None:
    """Run the command line; what psotrack raises on purpose becomes one line and exit code 2."""
    try:
        # Not `cli.main`, which would make two lines of Ctrl-C.
        with cli.make_context("psotrack", sys.argv[1:]) as started:
            cli.invoke(started)
    except click.exceptions.Exit as done:
        sys.exit(done.exit_code)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        sys.exit(2)
    except click.ClickException as error:
        # Not `error.show`, which says it in four lines.
        context = error.ctx if isinstance(error, click.UsageError) else None
        remedy = f"; see `{context.command_path} --help`" if context else ""
        sys.stderr.write(f"psotrack: {error.format_message().rstrip('.')}{remedy}\n")
        sys.exit(2)
    except KeyboardInterrupt:
        sys.stderr.write(
            "psotrack: interrupted; earlier results are unchanged, and the same command goes on\n"
        )
        sys.exit(2)
    except PsotrackError as error:
        sys.stderr.write(f"psotrack: {error}\n")
        sys.exit(2)
    except BrokenPipeError:
        # Whoever read our output has left, as `head` does.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(2)
