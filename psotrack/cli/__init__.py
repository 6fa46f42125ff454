"""The command line. Every command says what it needs, what it writes, and shows an example.

Exit codes: 0 only when all was done; 2 for everything that went wrong, with one line on stderr that says what.
"""

from __future__ import annotations

import os
import sys

import click

from psotrack.cli.as_real import as_real
from psotrack.cli.calibrate import calibrate
from psotrack.cli.commands import cli
from psotrack.cli.detect import detect
from psotrack.cli.doctor import doctor
from psotrack.cli.fly import fly
from psotrack.cli.fuse import fuse
from psotrack.cli.labels import labels
from psotrack.cli.localise import localise
from psotrack.cli.map_markers import map_markers
from psotrack.cli.simulate import simulate
from psotrack.cli.sweep import sweep, table
from psotrack.cli.synchronise import synchronise
from psotrack.errors import PsotrackError

__all__ = ["cli", "main"]

cli.add_command(simulate)
cli.add_command(as_real)
cli.add_command(fly)
cli.add_command(sweep)
cli.add_command(table)
cli.add_command(calibrate)
cli.add_command(detect)
cli.add_command(doctor)
cli.add_command(fuse)
cli.add_command(labels)
cli.add_command(localise)
cli.add_command(map_markers)
cli.add_command(synchronise)


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
