"""`make size` counts lines with code, and nothing else."""

import runpy
from pathlib import Path

PROGRAM = Path(__file__).parents[2] / "experiments" / "size.py"
CODE = '''"""A module.

Its docstring has three lines."""

# A comment.
import os  # and a comment behind code

TEXT = """a text
that is no docstring

"""


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
    size_of = runpy.run_path(str(PROGRAM))["size_of"]
    # import 1, TEXT 4, def 1, the second text 1, return 3, async def 1, LINE 1; a line that begins with a
    # docstring does not count.
    assert size_of(CODE).lines == 12
    # import os = 2, TEXT = """...""" 3, def join(*parts): 7, the text 1, return os.path.join(*parts,)
    # 11, async def later(): 6, LINE = f"..." 3.
    assert size_of(CODE).tokens == 33
    assert size_of("") == (0, 0)
