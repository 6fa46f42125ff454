"""Write the README's figures from the result files, and check that all figures are of today's version of tracking.

    python docs/readme.py            # write the text between the comment markers of README.md anew
    python docs/readme.py --check    # exit code 1 if README.md differs, or if a figure is of another version

The marker `<!-- figures: NAME -->` begins a part that the function NAME of `figures.py` writes; `<!-- end -->` ends it.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

import figures

README = Path(__file__).resolve().parents[1] / "README.md"
PART = re.compile(r"(<!-- figures: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def main() -> None:
    """Read the command line."""
    text = README.read_text(encoding="utf-8")
    new, count = PART.subn(lambda match: f"{match[1]}{getattr(figures, match[2])()}\n{match[3]}", text)
    if count == 0:
        sys.exit("README.md: expected a part `<!-- figures: NAME -->` ... `<!-- end -->`, found none")
    if "--check" not in sys.argv:
        README.write_text(new, encoding="utf-8")
        return
    faults = figures.outdated()
    if new != text:
        faults.append("README.md: expected the stored figures, found others; run `python docs/readme.py`")
    if faults:
        sys.exit("\n".join(faults))


if __name__ == "__main__":
    main()
