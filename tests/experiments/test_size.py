"""`make size` counts lines with code, and nothing else."""

import runpy
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
CODE = '''"""A module.

Its docstring has three lines."""

# A comment.
import os  # and a comment behind code

TEXT = """a text
that is no docstring

"""


class Empty:
    """A docstring."""


def join(*parts):
    """A docstring
    of two lines."""
    "A second text is code."
    return os.path.join(
        *parts,
    )


async def later():
    """A docstring."""  ; return 1


LINE = f"{TEXT!r} and {join('a', f'{TEXT}')}"
'''


def test_docstrings_comments_and_blank_lines_are_not_counted() -> None:
    size_of = runpy.run_path(str(ROOT / "experiments" / "size.py"))["size_of"]
    # import 1, TEXT 4, class 1, def 1, the second text 1, return 3, async def 1, LINE 1; a line that begins with a
    # docstring does not count.
    assert size_of(CODE).lines == 13
    # import os = 2, TEXT = """...""" 3, class Empty: 3, def join(*parts): 7, the text 1, return os.path.join(*parts,)
    # 11, async def later(): 6, LINE = f"..." 3.
    assert size_of(CODE).tokens == 36
    assert size_of("") == (0, 0)


def test_the_table_adds_up() -> None:
    script = ROOT / "experiments" / "size.py"
    # `-I -S`: no package but Python's own.
    done = subprocess.run([sys.executable, "-I", "-S", script], capture_output=True, text=True, check=True)
    lines = {row[:20].strip(): row[20:].replace(",", "").split() for row in done.stdout.splitlines()[1:]}
    sums = {name: lines.pop(name) for name in ("package", "video to tracks", "tests", "experiments")}
    assert {"tracking", "cli", "settings", "errors"} <= lines.keys()
    assert sum(int(row[0]) for row in lines.values()) == int(sums["package"][0])
    assert [int(row[1]) for row in sums.values()] == [36_000, 7_200, 25_000, 4_000]
