"""A group of commands that imports a command's module only when the command is used."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, MutableMapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

import click

if TYPE_CHECKING:
    from click.shell_completion import CompletionItem


class LazyCommand(NamedTuple):
    """Place and summary of a command that is not imported yet.

    Attributes:
        module: module that defines the command, as a function of the command's name with `_` for `-`.
        summary: first sentence of the command's help; repeated here so that `--help` need not import the module.
    """

    module: str
    summary: str


class LazyGroup(click.Group):
    """Group whose `--help` and completion of names import no command.

    Args:
        lazy_commands: module and summary of each command, by the command's name.
        attributes: all other arguments of `click.Group`.
    """

    def __init__(self, *, lazy_commands: Mapping[str, LazyCommand], **attributes: Any) -> None:
        super().__init__(**attributes)
        self.lazy_commands = lazy_commands
        self.commands = _Importer(lazy_commands)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the list of commands with their summaries."""
        with formatter.section("Commands"):
            formatter.write_dl([(name, self.lazy_commands[name].summary) for name in self.list_commands(ctx)])

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
            module = import_module(self._lazy[name].module)
            self._added[name] = getattr(module, name.replace("-", "_"))
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
