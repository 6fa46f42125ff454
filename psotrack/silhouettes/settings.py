"""Settings of silhouettes, checked when they are made. Importing this module is fast: `--help` needs the defaults."""

from __future__ import annotations

from typing import Literal, get_args

import msgspec

from psotrack.errors import SettingsError, check_positive
from psotrack.support import check_types

#: Meaning of MOG2's shadow label: foreground, background, or foreground with a smaller weight.
Shadows = Literal["keep", "drop", "weight"]


def check_whole(name: str, value: object, *, lowest: int) -> None:
    """Raise `SettingsError` unless `value` is a whole number of at least `lowest`."""
    if not isinstance(value, int) or isinstance(value, bool) or value < lowest:
        raise SettingsError(name, expected=f"a whole number of at least {lowest}", found=f"{value}")


class ForegroundSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings that separate foreground from background.

    Attributes:
        working_reduction: whole factor by which the image is reduced, by area, before MOG2; 1 is the full image.
        num_learning_frames: largest number of frames, spread over the video, from which the background is learned.
        learning_rate: learning rate per frame in the second pass, in [0, 1]; 0 keeps the learned background.
        var_threshold: squared Mahalanobis distance from the background beyond which a pixel is foreground.
        shadows: meaning of MOG2's shadow label.
        shadow_weight: weight of a shadow pixel in [0, 1], for `shadows="weight"`.
        min_blob_px: 8-connected blobs with fewer pixels of the full image are removed.

    Raises:
        SettingsError: a value is out of range.
    """

    working_reduction: int = 2
    num_learning_frames: int = 50
    learning_rate: float = 0.0
    var_threshold: float = 8.0
    shadows: Shadows = "keep"
    shadow_weight: float = 0.5
    min_blob_px: int = 64

    def __post_init__(self) -> None:
        check_types(self)
        for name in ("working_reduction", "num_learning_frames"):
            check_whole(name, getattr(self, name), lowest=1)
        check_whole("min_blob_px", self.min_blob_px, lowest=0)
        for name in ("learning_rate", "shadow_weight"):
            if not 0 <= getattr(self, name) <= 1:
                raise SettingsError(name, expected="a number from 0 to 1", found=f"{getattr(self, name):g}")
        check_positive("var_threshold", self.var_threshold)
        if self.shadows not in get_args(Shadows):
            raise SettingsError(
                "shadows", expected=f"one of {', '.join(get_args(Shadows))}", found=f"{self.shadows}"
            )


class SilhouetteSettings(ForegroundSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of silhouettes: `ForegroundSettings` and the reduction.

    Attributes:
        reduction: each stored value covers `reduction` x `reduction` pixels; a multiple of `working_reduction`.

    Raises:
        SettingsError: a value is out of range.
    """

    reduction: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        check_whole("reduction", self.reduction, lowest=1)
        if self.reduction % self.working_reduction:
            raise SettingsError(
                "reduction",
                expected=f"a multiple of working_reduction, {self.working_reduction}",
                found=f"{self.reduction}",
            )
