"""Plugins: objects that other packages add by name, as entry points of a group such as `psotrack.searches`."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any

from psotrack.errors import SettingsError


def plugin_names(group: str) -> tuple[str, ...]:
    """Names of the entry points that the installed packages offer in a group."""
    return tuple(sorted(point.name for point in entry_points(group=group)))


def load_plugin(group: str, name: str) -> Any | None:
    """The object behind an entry point; None where no installed package offers the name.

    Raises:
        SettingsError: the entry point is there, but cannot be imported.
    """
    for point in entry_points(group=group, name=name):
        try:
            return point.load()
        except (ImportError, AttributeError) as error:
            raise SettingsError(
                f"{group}: {name}", expected=f"{point.value} to be importable", found=f"{error}"
            ) from error
    return None
