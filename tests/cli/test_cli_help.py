"""`psotrack --help`: what it imports, agreement with the commands; completion of commands and options in shells."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import pytest
from helpers import Output, assert_refused

from psotrack import cli
from psotrack.cli.lazy import LazyGroup

Run = Callable[..., Output]

#: Packages that only commands need.
HEAVY = ("cv2", "jax", "matplotlib", "msgspec", "numpy", "pandas", "rich", "scipy", "trimesh", "zarr")

#: Runs `psotrack` with the words of each argument, and prints the heavy packages that are imported after each.
REPORT_IMPORTS = f"""
import contextlib, io, sys
from psotrack.cli import main
for words in sys.argv[1:]:
    sys.argv = ["psotrack", *words.split()]
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        main()
    print(*sorted(set({HEAVY!r}) & set(sys.modules)), sep=" ")
"""


def every_command(group: click.Group = cli.cli, words: str = "") -> Iterator[tuple[str, click.Command]]:
    """Every command with what is typed for it, groups included."""
    yield words.strip() or "psotrack", group
    for name, command in ((name, group.commands[name]) for name in group.list_commands(click.Context(group))):
        if isinstance(command, click.Group):
            yield from every_command(command, f"{words} {name}")
        else:
            yield f"{words} {name}".strip(), command


EVERY_COMMAND = dict(every_command())


def test_summaries_are_the_first_sentences_of_the_commands(run_psotrack: Run) -> None:
    """They are written a second time, because help must not import the commands."""
    groups = [command for command in EVERY_COMMAND.values() if isinstance(command, LazyGroup)]
    assert cli.cli in groups
    for group in groups:
        assert len(group.places) >= 2
        for name in group.places:
            command = group.commands[name]
            assert command.name == name
            assert group.summary(name) == command.get_short_help_str(limit=1000), name
    result = run_psotrack("--help")
    assert result.code == 0
    words = " ".join(result.out.split())
    for name in cli.cli.places:
        assert f" {name} {cli.cli.summary(name)}" in words
    for shell in ("bash", "zsh", "fish"):
        assert f"_PSOTRACK_COMPLETE={shell}_source psotrack" in result.out


@pytest.mark.parametrize("words", EVERY_COMMAND)
def test_help_fits_two_screens_and_has_an_example(words: str) -> None:
    command = EVERY_COMMAND[words]
    context = click.Context(command, info_name=f"psotrack {words}", terminal_width=100, max_content_width=100)
    text = command.get_help(context)
    assert len(text.splitlines()) <= 80
    if not isinstance(command, click.Group):
        assert re.search(rf"Examples?:\n +psotrack {words.removesuffix(' sequence')}\b", text)


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


def test_help_and_names_of_commands_import_no_heavy_package() -> None:
    """Help of a command imports the defaults of settings alone. Each process imports what came before."""
    light, settings = ["--help", "--version", "calibrate --help"], ["onboard localise", "simulate sequence"]
    words = [*light, *(f"{command} --help" for command in (*settings, "detect", "sweep", "track"))]
    result = subprocess.run(
        [sys.executable, "-c", REPORT_IMPORTS, *words], capture_output=True, text=True, check=True
    )
    assert result.stdout.splitlines() == [""] * len(light) + ["msgspec"] * (len(words) - len(light))


# --- completion

SHELLS = ("bash", "zsh", "fish")


@pytest.fixture
def complete(monkeypatch: pytest.MonkeyPatch, run_psotrack: Run) -> Run:
    """Runs `psotrack` as a shell does that wants completions."""

    def call(shell: str, **environment: str) -> Output:
        monkeypatch.setenv("_PSOTRACK_COMPLETE", shell)
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        return run_psotrack()

    return call


def test_an_unknown_shell_is_one_line(complete: Run, tmp_path: Path) -> None:
    shells = "bash_source, zsh_source or fish_source"
    assert_refused(lambda: complete("tcsh_source"), shells, unchanged=tmp_path)


@pytest.mark.parametrize("shell", SHELLS)
def test_shells_complete_commands_and_options(complete: Run, shell: str) -> None:
    """The script of a shell runs psotrack with what was typed in variables of the environment."""
    if shell != "bash" or shutil.which("bash"):  # click runs bash to find its version
        script = complete(f"{shell}_source").out
        assert f"_PSOTRACK_COMPLETE={shell}_complete" in script
        switch = "compdef " if shell == "zsh" else "complete "
        assert re.search(rf"^\s*{switch}.*psotrack", script, re.MULTILINE)

    def completions(words: list[str], incomplete: str) -> set[str]:
        """Completions after `words` and the first characters of the next word."""
        if shell == "fish":
            typed = {"COMP_WORDS": " ".join(words), "COMP_CWORD": incomplete}
        else:
            typed = {"COMP_WORDS": " ".join([*words, incomplete]), "COMP_CWORD": str(len(words))}
        result = complete(f"{shell}_complete", **typed)
        assert result.code == 0, result
        lines = result.out.splitlines()
        if shell == "zsh":
            # Each completion has three lines: type, value, help.
            return set(lines[1::3])
        # bash: `type,value`; fish: `type,value<tab>help`.
        return {line.split(",", 1)[1].split("\t")[0] for line in lines}

    assert completions(["psotrack"], "s") == {"simulate", "sweep"}
    assert completions(["psotrack", "calibrate"], "c") == {"convert"}
    options = {"--scenario", "--set", "--show", "--scale", "--seed"}
    assert completions(["psotrack", "simulate", "sequence"], "--s") == options
    assert completions(["psotrack", "onboard", "fuse", "--at"], "") == {"camera", "middle"}


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
