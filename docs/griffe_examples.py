"""An extension of Griffe: examples in docstrings are shown as code.

The package writes `Example:` sections, and short examples without a section; Google's style knows `Examples:` only.
"""

from __future__ import annotations

import re
from typing import Any

import griffe

_BLOCK = re.compile(r"(?:^>>> .*\n?(?:^(?!\s*$).*\n?)*)", re.MULTILINE)


class Examples(griffe.Extension):
    """Rewrites the examples in every docstring."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Name sections as Griffe expects them, and fence examples that stand outside of sections."""
        if obj.docstring is None:
            return
        text = re.sub(r"^Example:\s*$", "Examples:", obj.docstring.value, flags=re.MULTILINE)
        obj.docstring.value = _BLOCK.sub(lambda match: f"```pycon\n{match[0].rstrip()}\n```\n", text)
