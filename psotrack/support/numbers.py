"""Numbers in files of others and in records of settings: their limits."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

#: Types of numbers in records, whose limits `convert` and `check_types` check.
Positive = Annotated[float, Meta(gt=0)]
NotNegative = Annotated[float, Meta(ge=0)]
Share = Annotated[float, Meta(ge=0, le=1)]

#: Largest size of a number. Nothing that is measured is larger, and sums of products of five such numbers are finite.
LARGEST = 1e60
#: What is expected, for messages.
MODERATE = f"a number of at most {LARGEST:g} in size"
#: Largest number of digits of a whole number: such a number is exact as a float, too.
_MOST_DIGITS = 15


def whole_number(word: str) -> int | None:
    """Value of a word of digits; None for another word, and for one that has more digits than any count."""
    is_number = word.isascii() and word.isdecimal() and len(word) <= _MOST_DIGITS
    return int(word) if is_number else None


def is_moderate(value: float) -> bool:
    """Whether a number is finite and not so large that computing with it overflows."""
    return abs(value) <= LARGEST
