"""`psotrack --help`: speed and agreement with the commands; completion of commands and options in shells."""

from __future__ import annotations

import os
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from psotrack import cli
from psotrack.cli.calibrate import calibrate
from psotrack.cli.lazy import LazyGroup

#: Largest user time of `psotrack --help`, seconds.
MAX_HELP_S = 0.3
#: Packages that only commands need.
HEAVY = ("cv2", "jax", "matplotlib", "msgspec", "numpy", "pandas", "rich", "scipy", "trimesh", "zarr")

#: Runs `psotrack` with the arguments of the process, then prints the heavy packages that were imported.
REPORT_IMPORTS = f"""
import sys
from psotrack.cli import main
try:
    main()
finally:
    print("imported:", *sorted(set({HEAVY!r}) & set(sys.modules)))
"""


def psotrack(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `psotrack` in a new process."""
    return subprocess.run(
        [sys.executable, "-m", "psotrack", *arguments],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("group", [cli.cli, calibrate], ids=["psotrack", "calibrate"])
def test_summaries_are_the_first_sentences_of_the_commands(group: LazyGroup) -> None:
    assert len(group.places) >= 2
    for name in group.places:
        command = group.commands[name]
        assert command.name == name
        assert group.summary(name) == command.get_short_help_str(limit=1000), name


def every_command(group: click.Group = cli.cli, words: str = "") -> Iterator[tuple[str, click.Command]]:
    """Every command with what is typed for it, groups included."""
    yield words.strip() or "psotrack", group
    for name, command in ((name, group.commands[name]) for name in group.list_commands(click.Context(group))):
        if isinstance(command, click.Group):
            yield from every_command(command, f"{words} {name}")
        else:
            yield f"{words} {name}".strip(), command


EVERY_COMMAND = dict(every_command())


@pytest.mark.parametrize("words", EVERY_COMMAND)
def test_help_fits_two_screens(words: str) -> None:
    command = EVERY_COMMAND[words]
    context = click.Context(command, info_name=f"psotrack {words}", terminal_width=100, max_content_width=100)
    assert len(command.get_help(context).splitlines()) <= 80


@pytest.mark.parametrize("words", EVERY_COMMAND)
def test_help_names_the_default_that_an_option_has(words: str) -> None:
    context = click.Context(EVERY_COMMAND[words], resilient_parsing=True)
    for option in EVERY_COMMAND[words].params:
        if not isinstance(option, click.Option) or option.is_eager:
            continue
        shown = (option.get_help_record(context) or ("", ""))[1]
        stated = re.findall(r"\[(?:.*; )?default: (.*?)(?:;.*)?\]", shown)
        default = option.get_default(context)
        if option.is_flag:
            default = option.opts[0] if default is True else None
        if isinstance(default, tuple):
            default = ",".join(map(str, default))
        if default is not None and default is not False and default not in ("", click.core.UNSET):
            assert stated == [str(default)], option.name
        elif option.callback is None:
            # Words say what happens without the option: never a number that the program does not have.
            assert not any(re.fullmatch(r"[\d.]+", each) for each in stated), option.name


def test_init_alone_asks() -> None:
    asking = {
        path.name
        for path in Path(cli.__file__).parent.rglob("*.py")
        if re.search(r"(\binput|click\.prompt|click\.confirm)\(", path.read_text(encoding="utf-8"))
    }
    assert asking == {"init.py"}


def test_help_lists_every_command_with_its_whole_summary() -> None:
    result = psotrack("--help")
    assert result.returncode == 0
    words = " ".join(result.stdout.split())
    for name in cli.cli.places:
        assert f" {name} {cli.cli.summary(name)}" in words


def test_help_and_names_of_commands_import_no_heavy_package() -> None:
    for arguments, environment in (
        (["--help"], {}),
        (["--version"], {}),
        (["calibrate", "--help"], {}),
        ([], {"_PSOTRACK_COMPLETE": "bash_complete", "COMP_WORDS": "psotrack s", "COMP_CWORD": "1"}),
    ):
        result = subprocess.run(
            [sys.executable, "-c", REPORT_IMPORTS, *arguments],
            env=os.environ | environment,
            capture_output=True,
            text=True,
            check=True,
        )
        assert result.stdout.splitlines()[-1] == "imported:", arguments


@pytest.mark.parametrize("command", ["onboard localise", "detect", "simulate sequence", "sweep", "track"])
def test_help_of_a_command_imports_the_defaults_of_settings_alone(command: str) -> None:
    result = subprocess.run(
        [sys.executable, "-c", REPORT_IMPORTS, *command.split(), "--help"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout.splitlines()[-1] == "imported: msgspec"


def test_help_is_quick() -> None:
    seconds = []
    for _ in range(3):
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        assert psotrack("--help").returncode == 0
        seconds.append(resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before)
    # The shortest of three times counts, because other work on the machine makes a process slower.
    assert min(seconds) <= MAX_HELP_S


def test_the_error_for_a_mistyped_command_suggests_a_command() -> None:
    result = psotrack("evalute")
    assert result.returncode == 2
    assert result.stderr.count("\n") == 1
    assert "'evaluate'" in result.stderr


def test_help_says_how_to_switch_completion_on() -> None:
    text = psotrack("--help").stdout
    for shell in ("bash", "zsh", "fish"):
        assert f"_PSOTRACK_COMPLETE={shell}_source psotrack" in text


@pytest.mark.parametrize(
    ("shell", "switch"), [("bash", "complete "), ("zsh", "compdef "), ("fish", "complete ")]
)
def test_the_script_that_switches_completion_on(shell: str, switch: str) -> None:
    if shell == "bash" and shutil.which("bash") is None:
        pytest.skip("click runs bash to find its version")
    result = psotrack(_PSOTRACK_COMPLETE=f"{shell}_source")
    assert result.returncode == 0, result.stderr
    assert f"_PSOTRACK_COMPLETE={shell}_complete" in result.stdout
    assert any(line.strip().startswith(switch) and "psotrack" in line for line in result.stdout.splitlines())


def completions(shell: str, words: list[str], incomplete: str) -> set[str]:
    """Completions of `psotrack` in a shell after `words` and the first characters `incomplete` of the next word."""
    if shell == "fish":
        typed = {"COMP_WORDS": " ".join(words), "COMP_CWORD": incomplete}
    else:
        typed = {"COMP_WORDS": " ".join([*words, incomplete]), "COMP_CWORD": str(len(words))}
    result = psotrack(_PSOTRACK_COMPLETE=f"{shell}_complete", **typed)
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    if shell == "zsh":
        # Each completion has three lines: type, value, help.
        return set(lines[1::3])
    # bash: `type,value`; fish: `type,value<tab>help`.
    return {line.split(",", 1)[1].split("\t")[0] for line in lines}


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shells_complete_commands_and_options(shell: str) -> None:
    assert completions(shell, ["psotrack"], "s") == {"simulate", "sweep"}
    assert completions(shell, ["psotrack", "calibrate"], "c") == {"convert"}
    assert completions(shell, ["psotrack", "simulate", "sequence"], "--s") == {
        "--scenario",
        "--set",
        "--show",
        "--scale",
        "--seed",
    }
    assert completions(shell, ["psotrack", "onboard", "fuse", "--at"], "") == {"camera", "middle"}


#: Switches completion on in a shell, presses Tab after `psotrack sim`, and prints the completions.
TAB = {
    "bash": 'eval "$(_PSOTRACK_COMPLETE=bash_source psotrack)"; COMP_WORDS=(psotrack sim); COMP_CWORD=1; '
    '_psotrack_completion psotrack sim psotrack; echo "${COMPREPLY[@]}"',
    # zsh has no command that prints completions; its completion functions are replaced by functions that print.
    "zsh": "compdef() { :; }; _describe() { print -r -- $completions_with_descriptions; }; "
    'eval "$(_PSOTRACK_COMPLETE=zsh_source psotrack)"; words=(psotrack sim); CURRENT=2; '
    "_psotrack_completion",
    "fish": "_PSOTRACK_COMPLETE=fish_source psotrack | source; complete -C 'psotrack sim'",
}


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_tab_key_in_a_shell(tmp_path: Path, shell: str) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    program = tmp_path / "psotrack"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m psotrack "$@"\n', encoding="utf-8")
    program.chmod(0o755)
    result = subprocess.run(
        [shell, "-c", TAB[shell]],
        env=os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}", "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert re.match(r"simulate\b", result.stdout), result


def test_an_unknown_shell_is_one_line() -> None:
    result = psotrack(_PSOTRACK_COMPLETE="tcsh_source")
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr.count("\n") == 1
    assert "bash_source, zsh_source or fish_source" in result.stderr


def test_hints_about_pip_are_those_of_a_checkout() -> None:
    """The package is on no index, so messages and help say `pip install '.[EXTRA]'`."""
    hints = [
        line
        for path in Path(cli.__file__).parents[1].rglob("*.py")
        for line in path.read_text(encoding="utf-8").splitlines()
        if "pip install" in line
    ]
    assert len(hints) >= 4
    assert not [line for line in hints if not re.search(r"pip install '\.\[[\w{}]+\]'", line)]
