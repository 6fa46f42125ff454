"""Links, commands and Python on the pages: commands are understood, and the newcomer's pages run as they stand.

`make docs` follows the links of the pages of the documentation, also to headings.
"""

import os
import re
import shlex
import subprocess
import sys
from functools import partial
from pathlib import Path

import click
import pytest

from psotrack.cli import cli
from psotrack.settings import TrackSettings

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "pages"
#: Pages outside of the documentation, and all pages with commands.
OUTSIDE = [*ROOT.glob("*.md"), *ROOT.glob("notebooks/*.md"), *ROOT.glob("experiments/**/*.md")]
WRITTEN = [*OUTSIDE, *PAGES.rglob("*.md")]
#: The pages of the newcomer's path, in their order: those after the installation.
NEWCOMER = [PAGES / "start" / f"{name}.md" for name in ("own_cameras", "look", "evaluate", "python")]
#: A command whose flight is made shorter.
SIMULATED = "psotrack simulate"
BLOCK = re.compile(r"^```(console|sh|python)\n(.*?)^```", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)
LINK = re.compile(r"\]\((?!\w+:)([^()\s#]+)")


def test_every_relative_link_leads_to_a_file():
    found = []
    for page in OUTSIDE:
        text = CODE.sub("", page.read_text(encoding="utf-8"))
        found += [page.parent / target for target in LINK.findall(text)]
    assert len(found) > 50
    assert [path for path in found if not path.exists()] == []


def test_nothing_links_to_an_address_of_the_package():
    """Found: links to a repository, a package and pages that nobody has published."""
    command = ["git", "grep", "-nIE", "https?://[^ ]*psotrack", "--", ":!tests"]
    found = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True)
    # Git's exit code where it finds nothing.
    assert (found.returncode, found.stdout) == (1, "")


def blocks(page):
    """Blocks of code of a page: the language, and the text; of commands, one per line and without the prompt."""
    for language, text in BLOCK.findall(page.read_text(encoding="utf-8")):
        if language == "console":
            text = "\n".join(re.findall(r"^\$ (.*)", text.replace("\\\n", " "), re.MULTILINE))
        yield language, text


def commands(text):
    """Words after `psotrack` of each command in some lines of a shell."""
    for line in text.replace("\\\n", " ").splitlines():
        if re.match(r"\s*psotrack ", line):
            words = shlex.split(line, comments=True)[1:]
            ends = [index for index, word in enumerate(words) if word in ("|", ">", "&&", ";")]
            yield words[: min(ends, default=len(words))]


def inner_command(words):
    """The context of the command that some words name, and the words behind the name."""
    context, words = click.Context(cli, info_name="psotrack"), list(words)
    while isinstance(context.command, click.Group) and words:
        default = getattr(context.command, "default", "")
        if default and words[0] not in context.command.commands:
            words.insert(0, default)
        if words[0].startswith("-"):
            break
        found = context.command.get_command(context, words[0])
        if found is None:
            raise click.UsageError(f"no command {words[0]}")
        context = click.Context(found, parent=context, info_name=words.pop(0))
    return context, words


def complaint(words):
    """What is wrong with a command: an unknown name, a value that no option takes, or something that is missing."""
    try:
        context, rest = inner_command(words)
        values, _, _ = context.command.make_parser(context).parse_args(rest)
        for param in context.command.get_params(context):
            given = values.get(param.name)
            if given is None and param.required and "config" not in values:
                raise click.UsageError(f"{param.name} is missing")
            if isinstance(given, str) and isinstance(param.type, click.Choice):
                param.type_cast_value(context, given)
    except click.UsageError as error:
        return f"psotrack {shlex.join(words)}: {error.format_message()}"
    return None


def unknown_options(words):
    """Options that the named command does not have."""
    context, rest = inner_command(words)
    known = {name for param in context.command.get_params(context) for name in param.opts}
    return {word for word in rest if word.startswith("--")} - known


def all_commands(group, context):
    yield group
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield from all_commands(command, context) if isinstance(command, click.Group) else [command]


def test_every_command_on_a_page_and_in_a_help_is_understood():
    shells = [text for page in WRITTEN for language, text in blocks(page) if language != "python"]
    for command in all_commands(cli, click.Context(cli, info_name="psotrack")):
        shells += re.split(r"\n *Examples?:\n", command.help or "")[1:]
    found = [words for text in shells for words in commands(text)]
    assert len(found) > 80
    assert [said for said in map(complaint, found) if said] == []


def test_every_command_within_a_sentence_has_its_name_and_its_options():
    found = []
    for page in WRITTEN:
        text = BLOCK.sub("", page.read_text(encoding="utf-8"))
        found += re.findall(r"`psotrack ([a-z][^`]*)`", text)
    assert len(found) > 50
    for line in found:
        assert unknown_options(re.findall(r"[^\s\[\]|]+", line)) == set(), line


@pytest.fixture
def shell(tmp_path):
    """Runs a block of a page in the folder, with a cache of its own: what it prints."""
    environment = os.environ | {"PSOTRACK_CACHE": str(tmp_path / "users_cache"), "PYTHONPATH": str(ROOT)}

    def shell(language, text):
        if language == "python":
            # Worker processes import the file again.
            (tmp_path / "page.py").write_text(text)
            program = [sys.executable, "page.py"]
        else:
            function = f'psotrack() {{ {shlex.quote(sys.executable)} -m psotrack "$@"; }}'
            program = ["bash", "-c", f"{function}\n{text}"]
        ran = subprocess.run(
            program, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        # It must end well, except the doctor, which may find something.
        finding = text.startswith("psotrack doctor") and ran.returncode == 1 and ran.stdout
        assert ran.returncode == 0 or finding, f"{text}\n{ran.stdout}{ran.stderr}"
        return ran.stdout

    return shell


@pytest.mark.nightly
def test_the_newcomers_pages_run_as_they_stand(shell, tmp_path):
    """From the simulated laboratory with its board to tracks, pictures, errors and Python."""
    for language, text in (block for page in NEWCOMER for block in blocks(page)):
        if language == "python":
            shell(language, text)
            continue
        for line in text.splitlines():
            # A window and a page need somebody who looks.
            is_shown = line.startswith("psotrack view") and "--save" not in line
            if line.startswith("psotrack ") and not is_shown:
                shell(language, line.replace(SIMULATED, f"{SIMULATED} --frames 50"))
    assert (tmp_path / "my_lab" / "errors.json").exists()


@pytest.mark.nightly
def test_the_python_of_the_readme_uses_the_silhouettes_that_track_has_stored(shell):
    section = (ROOT / "README.md").read_text(encoding="utf-8").partition("## Python")[2]
    for language, text in BLOCK.findall(section):
        if language == "console":
            lines = text.replace("$ ", "").replace("--no-onboard", "--no-onboard --scale 0.5 --frames 40")
            shell(language, lines)
        else:
            said = shell(language, f"{text}    print(tracked.record['seconds'])\n")
            assert "'decode': 0.0, 'foreground': 0.0" in said


@pytest.mark.slow
def test_the_demonstration_ends_with_a_command_that_is_understood(run_psotrack, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("psotrack.cli.start.NUM_FRAMES", 6)
    monkeypatch.setattr("psotrack.cli.start.SCALE", 0.25)
    # For six frames, compiling the swarm would take longer than everything else.
    monkeypatch.setattr("psotrack.settings.TrackSettings", partial(TrackSettings, method="projection-lines"))
    _, out, _ = run_psotrack("demo", "--out", "demo", "--jobs", "1").ended()
    words = shlex.split(out.splitlines()[-1].removeprefix("next: "))[1:]
    assert complaint(words) is None
    paths = [Path(word) for word in words if "/" in word]
    assert [path.exists() for path in paths] == [True, True]
