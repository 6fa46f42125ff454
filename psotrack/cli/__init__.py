"""The command line: every command's help says what the command needs and writes, and shows an example.

In: arguments and files. Out: files, text on stdout, and one line on stderr where something is wrong. Commands contain
no numerics. A command's module is imported when the command runs, and rooms load what is called when it is called, so
that `--help` and shell completion are quick. The exit code is 0 if everything was done, and 2 for every error, and 1 if
`doctor` or `onboard map --check` finds a fault. No other room uses this room; `psotrack.__main__`, which the installed
script and `python -m psotrack` run, calls `main` and answers Ctrl-C and SIGTERM (`psotrack.support.interrupts`).
"""

from __future__ import annotations

import logging
import os
import sys

import click

from psotrack import __version__
from psotrack.cli.lazy import LazyGroup
from psotrack.errors import PsotrackError, SettingsError, one_short_line

__all__ = ["cli", "main"]

_COMMANDS = {
    "Start": {
        **{name: f"start.{name}" for name in ("demo", "run", "board", "init")},
        "calibrate": "calibrate.calibrate",
        "doctor": "calibrate.commands.doctor",
        "track": "track.track",
        "live": "live.live",
    },
    "Results": {
        "evaluate": "results.evaluate",
        **{name: f"showing.{name}" for name in ("view", "report", "overlay")},
        **{name: f"results.{name}" for name in ("export", "archive")},
    },
    "Research": {
        "simulate": "simulate.simulate",
        "train": "training.train",
        **{name: f"research.{name}" for name in ("sweep", "detect", "cache")},
    },
    "On-board": {"onboard": "onboard.onboard"},
}
#: Loggers of Python's warnings and of libraries.
_FOR_DEVELOPERS = ("py.warnings", "trimesh")
_COMPLETION_VARIABLE = "_PSOTRACK_COMPLETE"


@click.group(cls=LazyGroup, package=__name__, below=_COMMANDS)
@click.version_option(__version__, prog_name="psotrack")
@click.option("--verbose", "-v", is_flag=True, help="Log the steps of the work on stderr.")
def cli(verbose: bool) -> None:
    """3D positions of several drones, in every frame, from calibrated camera videos alone.

    \b
    Try it:          psotrack demo
    Own cameras:     psotrack run my_lab --square 0.035
    Step by step:    psotrack calibrate rig my_lab/board --square 0.035 --out my_lab/rig.toml
                     psotrack init my_lab
                     psotrack track my_lab
                     psotrack view my_lab/results/tracks.csv

    \b
    Completion with the Tab key needs one line in the start-up file of your shell:
      ~/.bashrc                   eval "$(_PSOTRACK_COMPLETE=bash_source psotrack)"
      ~/.zshrc                    eval "$(_PSOTRACK_COMPLETE=zsh_source psotrack)"
      ~/.config/fish/config.fish  _PSOTRACK_COMPLETE=fish_source psotrack | source
    """
    logging.addLevelName(logging.WARNING, "warning")
    handler = logging.StreamHandler(sys.stderr)
    level = logging.INFO if verbose else logging.WARNING
    # A log file takes more than stderr.
    handler.setLevel(level)
    # Warnings of Python and of libraries are for developers: what a user must know is said in the package's own words.
    logging.captureWarnings(True)
    if not verbose:
        handler.addFilter(lambda record: record.name not in _FOR_DEVELOPERS)
    logging.basicConfig(
        level=level,
        format="%(levelname)s %(name)s: %(message)s" if verbose else "psotrack: %(levelname)s: %(message)s",
        handlers=[handler],
    )


def main(started: float | None = None) -> None:
    """Run the command line; an error that psotrack raises on purpose becomes one line and exit code 2.

    Args:
        started: value of `time.perf_counter` when the program started; None is now.

    Raises:
        KeyboardInterrupt: Ctrl-C was pressed.
    """
    try:
        _complete()
        # `cli.main` would answer Ctrl-C itself.
        with cli.make_context("psotrack", sys.argv[1:], obj=started) as context:
            cli.invoke(context)
    except click.exceptions.Exit as done:
        sys.exit(done.exit_code)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        sys.exit(2)
    except click.ClickException as error:
        # `error.show` would print four lines.
        failed = error.ctx if isinstance(error, click.UsageError) else None
        remedy = f"; see `{failed.command_path} --help`" if failed else ""
        sys.stderr.write(f"psotrack: {one_short_line(error.format_message().rstrip('.'), remedy)}\n")
        sys.exit(2)
    except PsotrackError as error:
        sys.stderr.write(f"psotrack: {error}\n")
        try:
            sys.stdout.flush()
        except OSError:  # a full disk, which is the error that was said
            _drop_output()
        sys.exit(2)
    except BrokenPipeError:
        # The program that reads the output has ended, as `head` does.
        _drop_output()
        sys.exit(2)


def _drop_output() -> None:
    """Let the end of the interpreter write what stdout did not take to nowhere."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _complete() -> None:
    """Print completions and exit if a shell has started the program for them; otherwise do nothing."""
    instruction = os.environ.get(_COMPLETION_VARIABLE)
    if not instruction:
        return
    from click.shell_completion import shell_complete

    if shell_complete(cli, {}, "psotrack", _COMPLETION_VARIABLE, instruction) != 0:
        raise SettingsError(
            _COMPLETION_VARIABLE, expected="bash_source, zsh_source or fish_source", found=instruction
        )
    sys.exit(0)
