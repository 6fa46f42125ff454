"""Write the README's figures from the result files.

    python docs/readme.py            # write the text between the comment markers of README.md anew
    python docs/readme.py --check    # exit code 1 if README.md differs from the result files

The marker `<!-- figures: NAME -->` begins a part that the function NAME of `figures.py` writes; `<!-- end -->` ends it.
"""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path

import figures

README = Path(__file__).resolve().parents[1] / "README.md"
PART = re.compile(r"(<!-- figures: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)


def rewritten(text: str) -> str:
    """A text whose marked parts are written anew."""
    return PART.sub(lambda match: f"{match[1]}{getattr(figures, match[2])()}\n{match[3]}", text)


def main() -> None:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="write nothing")
    options = parser.parse_args()
    text = README.read_text(encoding="utf-8")
    if not PART.search(text):
        sys.exit("README.md: expected a part `<!-- figures: NAME -->` ... `<!-- end -->`, found none")
    new = rewritten(text)
    if options.check and new != text:
        sys.exit("README.md: its figures differ from the result files; run `python docs/readme.py`")
    if not options.check:
        README.write_text(new, encoding="utf-8")


if __name__ == "__main__":
    main()
