"""Background models by name."""

from __future__ import annotations

from psotrack.silhouettes.foreground import BackgroundModel
from psotrack.silhouettes.living_background import Living
from psotrack.silhouettes.settings import LIVING, MOG2, ScaledSettings
from psotrack.support import make_plugin


def find_background(name: str, settings: ScaledSettings) -> BackgroundModel | None:
    """The background model of a name: "mog2", "living" or a plugin; None for MOG2, as `key_of` takes it.

    Raises:
        SettingsError: there is no background model of this name.
    """
    if name == MOG2:
        return None
    if name == LIVING:
        return Living(settings)
    model: BackgroundModel = make_plugin(
        "background", name, settings, interface=BackgroundModel, setting="background", built_in=[MOG2, LIVING]
    )
    return model
