"""`make size`: lines of code per room, and their budgets. It needs no package but Python's own.

A line counts if it holds a token of code: blank lines, comments and docstrings do not count, and a text over several
lines counts with all of them. The mean number of tokens a line tells whether lines got fewer by being denser; an
f-string is one token, as Python until 3.11 has it.
"""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
#: Largest number of lines, and of tokens a line.
MOST_LINES = {"package": 36_000, "video to tracks": 7_200, "tests": 25_000, "experiments": 4_000}
MOST_TOKENS = 10.8
#: The rooms from videos to tracks, without what is in the rooms inside of them that follow.
VIDEO_TO_TRACKS = ("foreground", "tracking", "pipeline", "live", "settings.py", "api.py")
BESIDE_THEM = ("tracking/camera_errors", "pipeline/archives")
_NO_CODE = {
    *(tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
}
_F_STRING_START, _F_STRING_END = (getattr(tokenize, f"FSTRING_{end}", None) for end in ("START", "END"))


class Size(NamedTuple):
    """Lines of code and the tokens in them."""

    lines: int
    tokens: int


def size_of(code: str) -> Size:
    """Lines of code and tokens of a module."""
    lines: set[int] = set()
    documented: set[int] = set()
    tokens, in_f_strings = 0, 0
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            first = node.body[0] if ast.get_docstring(node, clean=False) is not None else None
            documented |= set(range(first.lineno, first.end_lineno + 1)) if first else set()
    for token in tokenize.generate_tokens(io.StringIO(code).readline):
        if token.type not in _NO_CODE:
            here = set(range(token.start[0], token.end[0] + 1)) - documented
            lines |= here
            tokens += bool(here) and not in_f_strings
            in_f_strings += (token.type == _F_STRING_START) - (token.type == _F_STRING_END)
    return Size(len(lines), tokens)


def size_below(path: Path) -> Size:
    """Lines of code and tokens of a module, or of all modules below a folder."""
    modules = sorted(path.rglob("*.py")) if path.is_dir() else [path]
    return total(size_of(module.read_text(encoding="utf-8")) for module in modules)


def total(sizes: Iterable[Size]) -> Size:
    """The sum of sizes."""
    sizes = list(sizes)
    return Size(sum(size.lines for size in sizes), sum(size.tokens for size in sizes))


def _video_to_tracks() -> Size:
    within, beside = (
        total(size_below(ROOT / "psotrack" / name) for name in names)
        for names in (VIDEO_TO_TRACKS, BESIDE_THEM)
    )
    return Size(within.lines - beside.lines, within.tokens - beside.tokens)


def main() -> None:
    """Print the table."""
    entries = sorted((ROOT / "psotrack").iterdir(), key=lambda path: (path.is_file(), path.name))
    sizes = {entry.stem: size_below(entry) for entry in entries if entry.is_dir() or entry.suffix == ".py"}
    rooms = {name: size for name, size in sizes.items() if size.lines}
    sums = {
        "package": total(rooms.values()),
        "video to tracks": _video_to_tracks(),
        **{name: size_below(ROOT / name) for name in ("tests", "experiments")},
    }
    print(f"{'':20} {'lines':>7} {'budget':>7}   tokens a line, budget {MOST_TOKENS}")
    for name, size in (*rooms.items(), *sums.items()):
        budget = f"{MOST_LINES[name]:,}" if name in MOST_LINES else ""
        print(f"{name:20} {size.lines:7,} {budget:>7}   {size.tokens / max(size.lines, 1):.1f}")


if __name__ == "__main__":
    main()
