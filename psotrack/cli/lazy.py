"""A group of commands that imports a command's module only when the command is used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, MutableMapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

import click

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem

#: Settings of the contexts of groups and of their commands.
SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 110}


class LazyCommand(NamedTuple):
    """Place and summary of a command that is not imported yet.

    Attributes:
        place: module and function of the command, such as `psotrack.cli.track:track`.
        summary: first sentence of the command's help; repeated here so that `--help` need not import the module.
        heading: heading of the command in the group's help.
    """

    place: str
    summary: str
    heading: str = "Commands"


def commands_in(package: str, summaries: Mapping[str, Mapping[str, str]]) -> dict[str, LazyCommand]:
    """Commands each of which is a function in a module of its own name.

    Args:
        package: package of the modules.
        summaries: summaries of the commands by their names, below headings.
    """
    return {
        name: LazyCommand(f"{package}.{name}:{name}", summary, heading)
        for heading, below in summaries.items()
        for name, summary in below.items()
    }


class LazyGroup(click.Group):
    """Group whose `--help` and completion of names import no command.

    Args:
        lazy_commands: place and summary of each command, by the command's name.
        default: command that is meant where the first argument names no command; "" for none.
        renamed: what replaces commands that there were once, by their names.
        attributes: all other arguments of `click.Group`.
    """

    def __init__(
        self,
        *,
        lazy_commands: Mapping[str, LazyCommand],
        default: str = "",
        renamed: Mapping[str, str] | None = None,
        **attributes: Any,
    ) -> None:
        super().__init__(**attributes)
        self.lazy_commands, self.default, self.renamed = lazy_commands, default, renamed or {}
        self.commands = _Importer(lazy_commands)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put the default command before arguments that name no command."""
        if self.default and args and args[0] not in {*self.lazy_commands, *ctx.help_option_names}:
            args = [self.default, *args]
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: click.Context, args: list[str]) -> Any:
        """Find the command; the error for one that has another name now says the name."""
        if args[0] in self.renamed and not ctx.resilient_parsing:
            raise click.UsageError(f"{args[0]} is `psotrack {self.renamed[args[0]]}` now", ctx)
        return super().resolve_command(ctx, args)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names in the order in which they were given."""
        return list(self.lazy_commands)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the commands with their summaries, under their headings."""
        for heading in dict.fromkeys(each.heading for each in self.lazy_commands.values()):
            with formatter.section(heading):
                formatter.write_dl(
                    [
                        (name, each.summary)
                        for name, each in self.lazy_commands.items()
                        if each.heading == heading
                    ]
                )

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Commands and options whose names begin with `incomplete`."""
        from click.shell_completion import CompletionItem

        names = [name for name in self.list_commands(ctx) if name.startswith(incomplete)]
        commands = [CompletionItem(name, help=self.lazy_commands[name].summary) for name in names]
        return commands + click.Command.shell_complete(self, ctx, incomplete)


class _Importer(MutableMapping[str, click.Command]):
    """Commands by name; a command's module is imported when the command is looked up."""

    def __init__(self, lazy_commands: Mapping[str, LazyCommand]) -> None:
        self._lazy = lazy_commands
        self._added: dict[str, click.Command] = {}

    def __getitem__(self, name: str) -> click.Command:
        if name not in self._added:
            module, _, function = self._lazy[name].place.partition(":")
            self._added[name] = getattr(import_module(module), function)
        return self._added[name]

    def __setitem__(self, name: str, command: click.Command) -> None:
        self._added[name] = command

    def __delitem__(self, name: str) -> None:
        del self._added[name]

    def __contains__(self, name: object) -> bool:
        return name in self._lazy

    def __iter__(self) -> Iterator[str]:
        return iter(self._lazy)

    def __len__(self) -> int:
        return len(self._lazy)
