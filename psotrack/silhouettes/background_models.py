"""Background models by name."""

from __future__ import annotations

from psotrack.silhouettes.foreground import BackgroundModel, Mog2
from psotrack.silhouettes.living_background import Living
from psotrack.silhouettes.settings import LIVING, MOG2, ForegroundSettings
from psotrack.support import make_plugin


def find_background(name: str, settings: ForegroundSettings) -> BackgroundModel:
    """The background model of a name: "mog2", "living" or a plugin.

    Raises:
        SettingsError: there is no background model of this name.
    """
    if name == MOG2:
        return Mog2(settings)
    if name == LIVING:
        return Living(settings)
    model: BackgroundModel = make_plugin(
        "background", name, settings, interface=BackgroundModel, setting="background", built_in=[MOG2, LIVING]
    )
    return model
