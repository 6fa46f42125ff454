"""Settings of silhouettes, checked when they are made. Importing this module is fast: `--help` needs the defaults."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, get_args

import msgspec
from msgspec import Meta

from psotrack.errors import SettingsError, check_positive
from psotrack.support import Share, check_types

#: Names of the background models of this package.
MOG2, LIVING = "mog2", "living"

#: Smallest coverage of a cell that belongs to a blob, out of 255.
MIN_COVERAGE = 64

#: Longer side of an image over the width of a drone, where the drones' size in the images is not given: 40 pixels in an
#: image of 1920 pixels.
_DRONES_ACROSS = 48
#: A drone that is this many pixels wide in the reduced image keeps its shape.
_LEAST_DRONE_PX = 20
#: Narrower drones are not reduced for storing either, pixels.
_LEAST_STORED_PX = 8
#: Where the rig is known: a drone whose usual width is this many stored values or more keeps its shape, even if the
#: background model sees no finer image than what is stored.
_LEAST_DRONE_CELLS = 6
#: Of narrower drones no pixel is given away: in small images they have few, and the background model takes little time.
_LEAST_USUAL_PX = 24
#: Speckle: blobs narrower than this share of a drone's width; a blob has 4 pixels at least.
_SPECKLE, _LEAST_BLOB_PX = 0.2, 4
#: Smallest blob where the drones' size is not given, pixels: a distant drone of 5 x 2 pixels. All background models but
#: "mog2" tell speckle from objects themselves.
_LEAST_OBJECT_PX = 9

#: Settings that the background model "living" does not use; only this model uses `first_look`.
_UNUSED_BY_LIVING = ("learning_rate", "var_threshold", "shadows", "shadow_weight")

#: Numbers of frames or pixels.
_OneOrMore = Annotated[int, Meta(ge=1)]
_NoneOrMore = Annotated[int, Meta(ge=0)]
#: Meaning of MOG2's shadow label: foreground, background, or foreground with a smaller weight.
Shadows = Literal["keep", "drop", "weight"]


def check_whole(name: str, value: object, *, lowest: int) -> None:
    """Raise `SettingsError` unless `value` is a whole number of at least `lowest`."""
    if not isinstance(value, int) or isinstance(value, bool) or value < lowest:
        raise SettingsError(name, expected=f"a whole number of at least {lowest}", found=f"{value}")


class _CommonSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings that do not depend on the size of the images; the docstrings of the subclasses describe them."""

    num_learning_frames: _OneOrMore = 50
    learning_rate: Share = 0.0
    var_threshold: float = 8.0
    shadows: Shadows = "keep"
    shadow_weight: Share = 0.5
    first_look: bool = True

    def __post_init__(self) -> None:
        check_types(self)
        check_positive("var_threshold", self.var_threshold)
        if self.shadows not in get_args(Shadows):
            expected = f"one of {', '.join(get_args(Shadows))}"
            raise SettingsError("shadows", expected=expected, found=f"{self.shadows}")


class ForegroundSettings(_CommonSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings that separate foreground from background and reduce it, for images of a known size.

    Attributes:
        num_learning_frames, learning_rate, var_threshold, shadows, shadow_weight, first_look: as in
            `SilhouetteSettings`.
        working_reduction: whole factor by which the image is reduced, by area, before the background model sees the
            image; 1 is the full image.
        min_blob_px: 8-connected blobs with fewer pixels of the full image are removed.
        reduction: each stored value covers `reduction` x `reduction` pixels; a multiple of `working_reduction`.

    Raises:
        SettingsError: a value is out of range.
    """

    working_reduction: _OneOrMore = 2
    min_blob_px: _NoneOrMore = 64
    reduction: _OneOrMore = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_multiple(self.reduction, self.working_reduction)

    @property
    def soft_edges(self) -> bool:
        """Whether a mask tells the share of each pixel at a contour, instead of foreground or background.

        Where masks are stored as they are, no mean of finer pixels tells the shares.
        """
        return self.reduction == self.working_reduction > 1


class SilhouetteSettings(_CommonSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of silhouettes.

    Attributes:
        background: name of the background model: "living", "mog2", "network" (the network that comes with the
            package), the path of a file of `psotrack train`, or a plugin.
        drone_px: width of the smallest drone in the images, pixels; sets the next three where they are None. None: the
            longer side of the images / 48, which is 40 pixels in an image of 1920; smaller drones are found as well.
        reduction: each stored value covers `reduction` x `reduction` pixels; a multiple of `working_reduction`;
            None: from `drone_px`.
        working_reduction: whole factor by which the image is reduced, by area, before the background model sees the
            image; 1 is the full image. None: from `drone_px`; where the rig says that drones of 0.3 m are wide in the
            images (see `usual_drone_px`), the reduction.
        min_blob_px: 8-connected blobs with fewer pixels of the full image are removed; None: from
            `drone_px`; 9 without `drone_px`, except for "mog2".
        num_learning_frames: largest number of frames, spread over the video, from which the background is learned.
        learning_rate: learning rate per frame in the second pass of "mog2", in [0, 1]; 0 keeps the learned background.
        var_threshold: squared Mahalanobis distance from the background beyond which a pixel is foreground, for "mog2".
        shadows: meaning of MOG2's shadow label, for "mog2".
        shadow_weight: weight of a shadow pixel in [0, 1], for `shadows="weight"` of "mog2".
        first_look: whether the background is first learned from frames of the whole video; False: the first frame is
            the background, and the rest is learned as the frames come, as from a live camera (only "living").

    Raises:
        SettingsError: a value is out of range, or belongs to another background model.
    """

    background: Annotated[str, Meta(extra={"metavar": "living|mog2|network|NAME"})] = LIVING
    drone_px: float | None = None
    reduction: _OneOrMore | None = None
    working_reduction: _OneOrMore | None = None
    min_blob_px: _NoneOrMore | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.drone_px is not None:
            check_positive("drone_px", self.drone_px)
        if self.reduction is not None and self.working_reduction is not None:
            _check_multiple(self.reduction, self.working_reduction)
        others = MOG2 if self.background == LIVING else LIVING
        for name in _UNUSED_BY_LIVING if self.background == LIVING else ("first_look",):
            default, value = getattr(_CommonSettings(), name), getattr(self, name)
            if value != default:
                raise SettingsError(
                    name,
                    expected=f"{default}, because the background model {self.background} does not use this setting",
                    found=f"{value}",
                    remedy=f"or choose the background model {others}",
                )

    def scaled(
        self, image_sizes_wh: Sequence[tuple[int, int]], usual_px: float | None = None
    ) -> ForegroundSettings:
        """These settings for images of given sizes.

        Args:
            image_sizes_wh: widths and heights of the images, pixels, at least one.
            usual_px: usual width of a drone in the images, pixels (see `usual_drone_px`); None where it is not known.
        """
        across_px = self.drone_px or max(map(max, image_sizes_wh)) / _DRONES_ACROSS
        working, reduction = self.working_reduction, self.reduction
        if working is None:
            factors = range(max(1, int(across_px / _LEAST_DRONE_PX)), 0, -1)
            working = next(factor for factor in factors if reduction is None or reduction % factor == 0)
        if reduction is None:
            reduction = working * (2 if across_px >= _LEAST_STORED_PX else 1)
        given = self.drone_px is not None or self.working_reduction is not None
        wide_px = max(_LEAST_DRONE_CELLS * reduction, _LEAST_USUAL_PX)
        if not given and usual_px is not None and usual_px >= wide_px:
            working = reduction
        least_px = self.min_blob_px
        if least_px is None:
            speckle_px = max(_LEAST_BLOB_PX, round((_SPECKLE * across_px) ** 2))
            least_px = _LEAST_OBJECT_PX if self.drone_px is None and self.background != MOG2 else speckle_px
        common = {name: getattr(self, name) for name in _CommonSettings.__struct_fields__}
        return ForegroundSettings(
            working_reduction=working, reduction=reduction, min_blob_px=least_px, **common
        )


def _check_multiple(reduction: int, working_reduction: int) -> None:
    if reduction % working_reduction:
        raise SettingsError(
            "reduction",
            expected=f"a multiple of working_reduction, {working_reduction}",
            found=f"{reduction}",
        )
