"""An extension of Griffe for the style of the package's docstrings.

- The package writes `Example:` sections, and short examples without a section; Google's style knows `Examples:` only.
- Attributes or parameters with one description stand on one line, `x, y: text`; Google's style has one name per line.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

#: An item of a section with several names before the colon, and the lines that continue its description.
_SHARED = re.compile(r"^ {4}(\*{0,2}\w+(?:, \*{0,2}\w+)+):(.*(?:\n {5,}\S.*)*)", re.MULTILINE)
_BLOCK = re.compile(r"(?:^>>> .*\n?(?:^(?!\s*$).*\n?)*)", re.MULTILINE)


def split_shared_items(docstring: str) -> str:
    """A docstring in which every item of a section has one name: `x, y: text` becomes two items with the same text."""
    return _SHARED.sub(
        lambda match: "\n".join(f"    {name}:{match[2]}" for name in match[1].split(", ")), docstring
    )


class Examples(griffe.Extension):
    """Rewrites the examples and the shared items in every docstring."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Name sections and items as Griffe expects them, and fence examples that stand outside of sections."""
        if obj.docstring is None:
            return
        text = split_shared_items(obj.docstring.value)
        text = re.sub(r"^Example:\s*$", "Examples:", text, flags=re.MULTILINE)
        obj.docstring.value = _BLOCK.sub(lambda match: f"```pycon\n{match[0].rstrip()}\n```\n", text)
