"""Commands and Python on the pages: every command line is understood, and the newcomer's pages run as they stand."""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import click
import pytest
from helpers import Output

from psotrack.cli import cli

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "pages"
WRITTEN = [
    *ROOT.glob("*.md"),
    *PAGES.rglob("*.md"),
    *ROOT.glob("notebooks/*.md"),
    *ROOT.glob("experiments/**/*.md"),
]
#: The pages of the newcomer's path, in their order: those after the installation.
NEWCOMER = [PAGES / "start" / f"{name}.md" for name in ("own_cameras", "look", "evaluate", "python")]
BLOCK = re.compile(r"^```(console|sh|python)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def blocks(page: Path) -> Iterator[tuple[str, str]]:
    """Blocks of code of a page: the language, and the text; of commands, one per line and without the prompt."""
    for language, text in BLOCK.findall(page.read_text(encoding="utf-8")):
        if language == "console":
            text = "\n".join(re.findall(r"^\$ (.*)", text.replace("\\\n", " "), re.MULTILINE))
        yield language, text


def commands(text: str) -> Iterator[list[str]]:
    """Words after `psotrack` of each command in some lines of a shell."""
    for line in text.replace("\\\n", " ").splitlines():
        if re.match(r"\s*psotrack ", line):
            words = shlex.split(line, comments=True)[1:]
            ends = [index for index, word in enumerate(words) if word in ("|", ">", "&&", ";")]
            yield words[: min(ends, default=len(words))]


def inner_command(words: list[str]) -> tuple[click.Context, list[str]]:
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


def complaint(words: list[str]) -> str | None:
    """What is wrong with a command: an unknown name, a value that no option takes, or something that is missing."""
    try:
        context, rest = inner_command(words)
        values, _, _ = context.command.make_parser(context).parse_args(list(rest))
        for param in context.command.get_params(context):
            given = values.get(param.name)
            if given is None and param.required and "config" not in values:
                raise click.UsageError(f"{param.name} is missing")
            if isinstance(given, str) and isinstance(param.type, click.Choice):
                param.type_cast_value(context, given)
    except click.UsageError as error:
        return f"psotrack {shlex.join(words)}: {error.format_message()}"
    return None


def all_commands(group: click.Group, context: click.Context) -> Iterator[click.Command]:
    yield group
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield from all_commands(command, context) if isinstance(command, click.Group) else [command]


def test_every_command_on_a_page_is_understood() -> None:
    found = [
        (page, words)
        for page in WRITTEN
        for language, text in blocks(page)
        if language != "python"
        for words in commands(text)
    ]
    assert len(found) > 50
    wrong = {f"{page.relative_to(ROOT)}: {said}" for page, words in found if (said := complaint(words))}
    assert wrong == set()


def test_every_command_within_a_sentence_has_its_name_and_its_options() -> None:
    wrong = set()
    for page in WRITTEN:
        text = BLOCK.sub("", page.read_text(encoding="utf-8"))
        for said in re.findall(r"`psotrack ([a-z][^`]*)`", text):
            try:
                context, rest = inner_command(re.findall(r"[^\s\[\]|]+", said))
                known = {name for param in context.command.get_params(context) for name in param.opts}
                options = re.findall(r"(?<![\w-])--[a-z][\w-]*", " ".join(rest))
                wrong |= {
                    f"{page.relative_to(ROOT)}: psotrack {said}: {name}" for name in set(options) - known
                }
            except click.UsageError as error:
                wrong.add(f"{page.relative_to(ROOT)}: psotrack {said}: {error.format_message()}")
    assert wrong == set()


def test_every_example_of_a_help_is_understood() -> None:
    context = click.Context(cli, info_name="psotrack")
    helps = [re.split(r"\n *Examples?:\n", command.help or "")[1:] for command in all_commands(cli, context)]
    examples = [words for parts in helps for text in parts for words in commands(text)]
    assert len(examples) > 20
    assert [said for words in examples if (said := complaint(words))] == []


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("psotrack track flight --out tracks.csv --smooth | head", None),
        ("psotrack trak flight", "no command trak"),
        ("psotrack track flight --out tracks.csv --smoth", "--smoth"),
        ("psotrack export tracks.csv", "to is missing"),
        ("psotrack export tracks.csv --to docx --out tracks.docx", "docx"),
    ],
)
def test_a_wrong_command_is_found(line: str, what: str | None) -> None:
    (words,) = commands(line)
    said = complaint(words)
    assert said is None if what is None else what in str(said)


class Shell:
    """Runs the blocks of pages in a folder, with a cache of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        settings = {
            "PSOTRACK_CACHE": str(folder / "users_cache"),
            "PYTHONPATH": str(ROOT),
            "PSOTRACK_PROGRESS": "none",
        }
        self.environment = os.environ | settings

    def run(self, language: str, text: str) -> str:
        """What a program prints; it must end well, except the doctor, which may find something."""
        if language == "python":
            (self.folder / "page.py").write_text(text)
            program = [sys.executable, "page.py"]
        else:
            function = f'psotrack() {{ {shlex.quote(sys.executable)} -m psotrack "$@"; }}'
            program = ["bash", "-c", f"{function}\n{text}"]
        ran = subprocess.run(
            program, cwd=self.folder, env=self.environment, capture_output=True, text=True, check=False
        )
        finding = text.startswith("psotrack doctor") and ran.returncode == 1 and ran.stdout
        assert ran.returncode == 0 or finding, f"{text}\n{ran.stdout}{ran.stderr}"
        return ran.stdout


@pytest.mark.nightly
def test_the_newcomers_pages_run_as_they_stand(tmp_path: Path) -> None:
    """From the simulated laboratory with its board to tracks, pictures, errors and Python."""
    shell = Shell(tmp_path)
    for page in NEWCOMER:
        for language, text in blocks(page):
            lines = [text] if language == "python" else text.splitlines()
            for line in lines:
                if line.startswith("psotrack simulate"):
                    line += " --frames 50"
                # A window and a page need somebody who looks.
                if language == "python" or (line.startswith("psotrack ") and not is_shown(line)):
                    shell.run(language, line)
    for name in ("rig.toml", "recording.toml", "tracks.csv", "tracks.png", "errors.json"):
        assert (tmp_path / "my_lab" / name).stat().st_size > 0, name
    for name in ("flight.rrd", "report.html", "videos/mosaic.mp4"):
        assert (tmp_path / name).stat().st_size > 0, name


def is_shown(line: str) -> bool:
    return line.startswith("psotrack view") and "--save" not in line


@pytest.mark.nightly
def test_the_python_of_the_readme_uses_the_silhouettes_that_track_has_stored(tmp_path: Path) -> None:
    shell = Shell(tmp_path)
    section = (ROOT / "README.md").read_text(encoding="utf-8").partition("## Python")[2]
    for language, text in BLOCK.findall(section):
        if language == "console":
            lines = text.replace("$ ", "").replace("--no-onboard", "--no-onboard --scale 0.5 --frames 40")
            shell.run(language, lines)
        else:
            said = shell.run(language, f"{text}    print(tracked.record['seconds'])\n")
            assert "'decode': 0.0, 'foreground': 0.0" in said


@pytest.mark.slow
def test_the_demonstration_ends_with_a_command_that_is_understood(
    run_psotrack: Callable[..., Output], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("psotrack.cli.demo.NUM_FRAMES", 6)
    monkeypatch.setattr("psotrack.cli.demo.SCALE", 0.25)
    code, out, _ = run_psotrack("demo", "--out", "demo", "--jobs", "1")
    assert code == 0
    words = shlex.split(out.splitlines()[-1].removeprefix("next: "))[1:]
    assert complaint(words) is None
    paths = [word for word in words if "/" in word]
    assert len(paths) == 2
    assert all(os.path.exists(path) for path in paths)
