"""Links, commands and Python on the pages: commands are understood, and the newcomer's pages run as they stand.

`make docs` follows the links of the pages of the documentation, and refuses those that lead nowhere.
"""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import click
import pytest
from helpers import Output

from psotrack.cli import cli
from psotrack.settings import TrackSettings

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "pages"
#: Pages outside of the documentation, and all pages with commands.
OUTSIDE = [*ROOT.glob("*.md"), *ROOT.glob("notebooks/*.md"), *ROOT.glob("experiments/**/*.md")]
WRITTEN = [*OUTSIDE, *PAGES.rglob("*.md")]
#: The pages of the newcomer's path, in their order: those after the installation.
NEWCOMER = [PAGES / "start" / f"{name}.md" for name in ("own_cameras", "look", "evaluate", "python")]
BLOCK = re.compile(r"^```(console|sh|python)\n(.*?)^```", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)
LINK = re.compile(r"\]\((?!\w+:)([^()\s#]*)#?([^()\s]*)\)")
#: Pages of which a program writes the headings.
GENERATED = re.compile(r"\{\{ (?:cli_reference|struct_tables)")


def anchors(page: Path) -> set[str]:
    """Anchors of the headings of a page, as MkDocs and GitHub make them."""
    titles = re.findall(
        r"^#+ (.*)$", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL), re.MULTILINE
    )
    return {re.sub(r"[^\w -]", "", title.lower()).strip().replace(" ", "-") for title in titles}


def broken_links(page: Path) -> list[str]:
    """Relative links of a page that lead to no file, or to no heading."""
    found = []
    for target, anchor in LINK.findall(CODE.sub("", page.read_text(encoding="utf-8"))):
        path = page.parent / target if target else page
        is_read = anchor and path.is_file() and not GENERATED.search(path.read_text(encoding="utf-8"))
        if not path.exists() or (is_read and anchor not in anchors(path)):
            found.append(f"{page}: {target}#{anchor}")
    return found


def test_every_relative_link_leads_to_a_file_and_a_heading(tmp_path: Path) -> None:
    assert [link for page in OUTSIDE for link in broken_links(page)] == []
    page = tmp_path / "a.md"
    (tmp_path / "b.md").write_text("# Part one\n")
    page.write_text(
        "[a](b.md) [b](b.md#part-one) `[c](c.md)` [d](c.md) [e](b.md#part-two) [f](#g) [h](https://i)"
    )
    assert broken_links(page) == [f"{page}: {link}" for link in ("c.md#", "b.md#part-two", "#g")]


def test_nothing_links_to_an_address_of_the_package() -> None:
    """Found: links to a repository, a package and pages that nobody has published."""
    command = ["git", "grep", "-nIE", "https?://[^ ]*psotrack", "--", ":!tests"]
    found = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True)
    # Git's exit code where it finds nothing.
    assert (found.returncode, found.stdout) == (1, "")


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


def complaint(words: list[str], *, whole: bool = True) -> str | None:
    """What is wrong with a command: an unknown name, a value that no option takes, or something that is missing.

    Of commands within a sentence, which are not whole, the names and the options count.
    """
    try:
        context, rest = inner_command(words)
        params = context.command.get_params(context)
        if not whole:
            options = [word for word in rest if word.startswith("--")]
            unknown = set(options) - {name for param in params for name in param.opts}
            return f"{words}: {unknown}" if unknown else None
        values, _, _ = context.command.make_parser(context).parse_args(list(rest))
        for param in params:
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


def test_every_command_on_a_page_and_in_a_help_is_understood() -> None:
    shells = [text for page in WRITTEN for language, text in blocks(page) if language != "python"]
    for command in all_commands(cli, click.Context(cli, info_name="psotrack")):
        shells += re.split(r"\n *Examples?:\n", command.help or "")[1:]
    found = [words for text in shells for words in commands(text)]
    assert len(found) > 80
    assert [said for words in found if (said := complaint(words))] == []


def test_every_command_within_a_sentence_has_its_name_and_its_options() -> None:
    sentences = [BLOCK.sub("", page.read_text(encoding="utf-8")) for page in WRITTEN]
    said = [words for text in sentences for words in re.findall(r"`psotrack ([a-z][^`]*)`", text)]
    assert len(said) > 50
    found = [re.findall(r"[^\s\[\]|]+", words) for words in said]
    assert [wrong for words in found if (wrong := complaint(words, whole=False))] == []


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


@pytest.fixture
def shell(tmp_path: Path) -> Callable[[str, str], str]:
    """Runs a block of a page in the folder, with a cache of its own: what it prints."""
    environment = os.environ | {"PSOTRACK_CACHE": str(tmp_path / "users_cache"), "PYTHONPATH": str(ROOT)}

    def shell(language: str, text: str) -> str:
        (tmp_path / "page.py").write_text(text)
        function = f'psotrack() {{ {shlex.quote(sys.executable)} -m psotrack "$@"; }}'
        program = (
            [sys.executable, "page.py"] if language == "python" else ["bash", "-c", f"{function}\n{text}"]
        )
        ran = subprocess.run(
            program, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        # It must end well, except the doctor, which may find something.
        finding = text.startswith("psotrack doctor") and ran.returncode == 1 and ran.stdout
        assert ran.returncode == 0 or finding, f"{text}\n{ran.stdout}{ran.stderr}"
        return ran.stdout

    return shell


@pytest.mark.nightly
def test_the_newcomers_pages_run_as_they_stand(shell: Callable[[str, str], str], tmp_path: Path) -> None:
    """From the simulated laboratory with its board to tracks, pictures, errors and Python."""
    for language, text in (block for page in NEWCOMER for block in blocks(page)):
        for line in [text] if language == "python" else text.splitlines():
            if line.startswith("psotrack simulate"):
                line += " --frames 50"
            # A window and a page need somebody who looks.
            is_shown = line.startswith("psotrack view") and "--save" not in line
            if language == "python" or (line.startswith("psotrack ") and not is_shown):
                shell(language, line)
    results = [
        f"my_lab/{name}" for name in ("rig.toml", "recording.toml", "tracks.csv", "tracks.png", "errors.json")
    ]
    for name in (*results, "flight.rrd", "report.html", "videos/mosaic.mp4"):
        assert (tmp_path / name).stat().st_size > 0, name


@pytest.mark.nightly
def test_the_python_of_the_readme_uses_the_silhouettes_that_track_has_stored(
    shell: Callable[[str, str], str],
) -> None:
    section = (ROOT / "README.md").read_text(encoding="utf-8").partition("## Python")[2]
    for language, text in BLOCK.findall(section):
        if language == "console":
            lines = text.replace("$ ", "").replace("--no-onboard", "--no-onboard --scale 0.5 --frames 40")
            shell(language, lines)
        else:
            said = shell(language, f"{text}    print(tracked.record['seconds'])\n")
            assert "'decode': 0.0, 'foreground': 0.0" in said


@pytest.mark.slow
def test_the_demonstration_ends_with_a_command_that_is_understood(
    run_psotrack: Callable[..., Output], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("psotrack.cli.demo.NUM_FRAMES", 6)
    monkeypatch.setattr("psotrack.cli.demo.SCALE", 0.25)
    # For six frames, compiling the swarm would take longer than everything else.
    monkeypatch.setattr("psotrack.settings.TrackSettings", partial(TrackSettings, method="projection-lines"))
    code, out, _ = run_psotrack("demo", "--out", "demo", "--jobs", "1")
    assert code == 0
    words = shlex.split(out.splitlines()[-1].removeprefix("next: "))[1:]
    assert complaint(words) is None
    paths = [word for word in words if "/" in word]
    assert len(paths) == 2
    assert all(map(os.path.exists, paths))
