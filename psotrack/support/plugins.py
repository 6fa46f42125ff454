"""Plugins: parts of tracking that the caller or other packages add by name.

There are five kinds: searches, scores, methods, background models and detectors. A plugin is a function (or a class)
that maps a part of the settings to an object with the kind's interface:

| kind         | group of entry points  | called with          | makes             |
|--------------|------------------------|----------------------|-------------------|
| "search"     | `psotrack.searches`    | `SwarmSettings`      | `Search`          |
| "score"      | `psotrack.scores`      | `ScoreSettings`      | `Score`           |
| "method"     | `psotrack.methods`     | `TrackSettings`      | `Method`          |
| "background" | `psotrack.backgrounds` | `ForegroundSettings` | `BackgroundModel` |
| "detector"   | `psotrack.detectors`   | `DetectorSettings`   | `Detector`        |

Installed packages add plugins as entry points, which all commands find. `register_plugin` adds a plugin to this Python
process only, for scripts, notebooks and sweeps in them.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Sequence
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Literal, get_args

from psotrack.errors import SettingsError
from psotrack.support.schema import did_you_mean

PluginKind = Literal["search", "score", "method", "background", "detector"]

#: Group of entry points of each kind.
GROUPS: dict[PluginKind, str] = {
    "search": "psotrack.searches",
    "score": "psotrack.scores",
    "method": "psotrack.methods",
    "background": "psotrack.backgrounds",
    "detector": "psotrack.detectors",
}

#: Plugins of this process, by kind and name.
_registered: dict[tuple[PluginKind, str], Callable[[Any], Any]] = {}


def register_plugin(kind: PluginKind, name: str, make: Callable[[Any], Any]) -> None:
    """Add a search, score, method, background model or detector by name, for this Python process.

    Settings and the grids of sweeps can then use the name, for example `{"swarm.search": "cma-es"}`. The name goes
    before an entry point of the same name, and a second call replaces the plugin. Worker processes of a cluster do not
    know registered plugins: install an entry point there.

    Args:
        kind: "search", "score", "method", "background" or "detector".
        name: name of the plugin in settings.
        make: function or class that makes the object from its part of the settings: `SwarmSettings` (search),
            `ScoreSettings` (score), `TrackSettings` (method), `ForegroundSettings` (background), `DetectorSettings`
            (detector).

    Raises:
        SettingsError: there is no such kind of plugins, or `make` cannot be called.
    """
    if kind not in GROUPS:
        raise SettingsError("kind", expected=f"one of {', '.join(get_args(PluginKind))}", found=f"{kind}")
    if not callable(make):
        found = f"an object of {type(make).__name__}"
        raise SettingsError(f"{kind} {name}", expected="a function of the settings, or a class", found=found)
    _registered[kind, name] = make


def plugin_names(kind: PluginKind) -> tuple[str, ...]:
    """Names of the registered plugins of a kind, and of those that installed packages add, sorted."""
    registered = {name for of, name in _registered if of == kind}
    return tuple(sorted(registered | {point.name for point in entry_points(group=GROUPS[kind])}))


def make_plugin(
    kind: PluginKind,
    name: str,
    settings: object,
    *,
    interface: type,
    setting: str,
    built_in: Sequence[str] = (),
) -> Any:
    """Make the object that a plugin's name stands for.

    Args:
        kind: kind of the plugin.
        name: name of the plugin.
        settings: part of the settings with which the plugin is called.
        interface: protocol that the object must have.
        setting: setting or option that names the plugin, for messages.
        built_in: names or values that `setting` takes without any plugin, for messages.

    Raises:
        SettingsError: there is no such plugin, it cannot be imported, or its object lacks the interface.
    """
    made = _load(kind, name, setting, built_in)(settings)
    check_interface(f"{setting} {name}", made, interface)
    return made


def plugin_source(kind: PluginKind, name: str) -> Path | None:
    """The file with the code that makes a plugin; None where no plugin has this name, or its code is in no file.

    Raises:
        SettingsError: the plugin cannot be imported.
    """
    if name not in plugin_names(kind):
        return None
    try:
        source = inspect.getsourcefile(_load(kind, name, kind, ()))
    except TypeError:  # an object that can be called, whose class is what has a file
        source = inspect.getsourcefile(type(_load(kind, name, kind, ())))
    return Path(source) if source and Path(source).is_file() else None


def check_interface(where: str, part: object, interface: type) -> None:
    """Raise `SettingsError` unless `part` has the attributes and methods of `interface`, a protocol."""
    if not isinstance(part, interface):
        raise SettingsError(
            where,
            expected=f"an object with the attributes of psotrack.{interface.__name__}",
            found=f"an object of {type(part).__name__}",
        )


def lasting_name(name: str) -> str:
    """The dotted name of a class without the rooms of this package, which may move: `psotrack.Living`."""
    package, _, rest = name.partition(".")
    return f"{package}.{rest.rpartition('.')[2]}" if package == __name__.partition(".")[0] else name


def identify(part: Any) -> dict[str, Any]:
    """Identity of a plugged-in part, fit for JSON: its class, and its `key` where the part has a key.

    Raises:
        SettingsError: the key is no plain data.
    """
    name = lasting_name(f"{type(part).__module__}.{type(part).__qualname__}")
    if not hasattr(part, "key"):
        return {"class": name}
    try:
        key = json.loads(json.dumps(dict(part.key)))
    except (TypeError, ValueError) as error:
        raise SettingsError(
            f"key of {name}", expected="a mapping of plain data, fit for JSON", found=f"{error}"
        ) from error
    return {"class": name, "key": key}


def _load(kind: PluginKind, name: str, setting: str, built_in: Sequence[str]) -> Callable[[Any], Any]:
    if (kind, name) in _registered:
        return _registered[kind, name]
    for point in entry_points(group=GROUPS[kind], name=name):
        try:
            make = point.load()
        except (ImportError, AttributeError) as error:
            raise SettingsError(
                f"{setting} {name}", expected=f"{point.value} to be importable", found=f"{error}"
            ) from error
        if not callable(make):
            found = f"an object of {type(make).__name__}"
            expected = f"{point.value} to be a function of the settings, or a class"
            raise SettingsError(f"{setting} {name}", expected=expected, found=found)
        return make
    installed = plugin_names(kind)
    none = "" if installed else f"no installed package adds more (entry points {GROUPS[kind]})"
    raise SettingsError(
        setting,
        expected=f"one of {', '.join([*built_in, *installed])}",
        found=name,
        remedy=did_you_mean(name, [*built_in, *installed]) or none,
    )
