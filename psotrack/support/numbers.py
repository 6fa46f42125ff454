"""Numbers in files of others."""

from __future__ import annotations

#: Largest size of a number. Nothing that is measured is larger, and sums of products of five such numbers are finite.
LARGEST = 1e60
#: What is expected, for messages.
MODERATE = f"a number of at most {LARGEST:g} in size"


def is_moderate(value: float) -> bool:
    """Whether a number is finite and not so large that computing with it overflows."""
    return abs(value) <= LARGEST
