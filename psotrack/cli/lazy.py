"""A group of commands that imports a command's module only when the command is used."""

from __future__ import annotations

import re
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

#: Settings of the contexts of groups and of their commands.
SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 110}


class LazyGroup(click.Group):
    """OptionGroup whose `--help` and completion of names import no command.

    Args:
        package: package of the commands' modules.
        below: the commands, below the headings of the group's help: module and function of each by its name.
        default: command that is meant where the first argument names no command; "" for none.
        attributes: all other arguments of `click.Group`.
    """

    def __init__(
        self,
        *,
        package: str,
        below: Mapping[str, Mapping[str, str]],
        default: str = "",
        **attributes: Any,
    ) -> None:
        super().__init__(context_settings=SETTINGS, **attributes)
        self.below, self.default = below, default
        places = [each for places in below.values() for each in places.items()]
        self.places = {name: f"{package}.{place}" for name, place in places}
        self.commands = _Importer(self.places)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put the default command before arguments that name no command."""
        if self.default and args and args[0] not in {*self.places, *ctx.help_option_names}:
            args = [self.default, *args]
        return super().parse_args(ctx, args)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order in which they were given."""
        return list(self.places)

    def summary(self, name: str) -> str:
        """First sentence of a command's help, from the text of its module."""
        module, _, function = self.places[name].rpartition(".")
        file = Path(__file__).parents[2].joinpath(*module.split("."))
        text = (file / "__init__.py" if file.is_dir() else file.with_suffix(".py")).read_text("utf-8")
        found = re.search(rf'\ndef {function}\(.*?"""(.*?\.)\s', text, re.DOTALL)
        return " ".join(found[1].split()) if found else ""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands with their summaries, under their headings."""
        for heading, names in self.below.items():
            with formatter.section(heading):
                formatter.write_dl([(name, self.summary(name)) for name in names])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Commands and options whose names begin with `incomplete`."""
        from click.shell_completion import CompletionItem

        names = [name for name in self.places if name.startswith(incomplete)]
        commands = [CompletionItem(name, help=self.summary(name)) for name in names]
        return commands + click.Command.shell_complete(self, ctx, incomplete)


class _Importer(dict[str, Any]):
    """Commands by name, from the places of their modules; a module is imported when its command is looked up."""

    def __getitem__(self, name: str) -> click.Command:
        module, _, function = super().__getitem__(name).rpartition(".")
        return getattr(import_module(module), function)

    def get(self, name: str, default: Any = None) -> Any:
        """As of a dict."""
        return self[name] if super().get(name) else default
