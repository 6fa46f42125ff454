"""The reference of the command line as Markdown, generated from the commands themselves."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator

import click

#: Width that keeps Click from breaking lines: the browser breaks them.
WIDTH = 10_000


def reference() -> str:
    """Every command with its help and its options."""
    from psotrack.cli import cli

    return "\n\n".join(_command(cli, "psotrack", None, 2))


def _command(command: click.Command, name: str, parent: click.Context | None, level: int) -> Iterator[str]:
    settings = command.context_settings | {"terminal_width": WIDTH, "max_content_width": WIDTH}
    context = click.Context(command, info_name=name, parent=parent, **settings)
    path = context.command_path
    yield f"{'#' * level} {path} {{ #{path.replace(' ', '-')} }}"
    yield f"```console\n$ {path} {' '.join(command.collect_usage_pieces(context))}\n```"
    yield _text(command.help or "")
    yield _options(command, context)
    if isinstance(command, click.Group):
        for inner in command.list_commands(context):
            found = command.get_command(context, inner)
            assert found is not None, "a command that is listed exists"
            yield from _command(found, inner, context, min(level + 1, 3))


def _text(text: str) -> str:
    """Help as Markdown: paragraphs that begin with Click's `\\b` keep their line breaks, as code."""
    parts = []
    for paragraph in re.split(r"\n\s*\n", inspect.cleandoc(text)):
        if paragraph.startswith("\b"):
            title, _, rest = paragraph.removeprefix("\b").strip("\n").partition("\n")
            if title.rstrip().endswith(":") and rest:
                parts.append(f"{title}\n\n```text\n{inspect.cleandoc(rest)}\n```")
            else:
                parts.append(f"```text\n{paragraph.removeprefix(chr(8)).strip(chr(10))}\n```")
        else:
            parts.append(" ".join(paragraph.split()))
    return "\n\n".join(parts)


def _options(command: click.Command, context: click.Context) -> str:
    records = [
        record
        for param in command.get_params(context)
        if isinstance(param, click.Option) and (record := param.get_help_record(context)) is not None
    ]
    lines = [f"| `{_one_line(names)}` | {_escaped(_one_line(words))} |" for names, words in records]
    return "\n".join(["| option | meaning |", "|---|---|", *lines])


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _escaped(text: str) -> str:
    """Text whose bars, brackets and angles Markdown takes literally."""
    return text.replace("|", "\\|").replace("[", "\\[").replace("<", "&lt;")
