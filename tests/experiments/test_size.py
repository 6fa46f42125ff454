"""`make size` counts lines with code, and nothing else."""

import runpy
import shutil
from pathlib import Path

from helpers import Run

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


def test_the_table_adds_up(run_program: Run, tmp_path: Path) -> None:
    """A room, a module of its own, and rooms that count for the videos."""
    files = {
        "psotrack/tracking/swarm.py": 5,
        "psotrack/tracking/camera_errors/model.py": 2,
        "psotrack/pipeline/archives/zipped.py": 1,
        **{f"psotrack/{name}/__init__.py": 1 for name in ("foreground", "pipeline", "live", "cli")},
        **{f"psotrack/{name}.py": 1 for name in ("settings", "api")},
        "tests/test_one.py": 20,
    }
    for name, lines in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("a = 1\n" * lines)
    (tmp_path / "experiments").mkdir()
    done = run_program(Path(shutil.copy(PROGRAM, tmp_path / "experiments")))
    rows = {row[:20].strip(): row[20:].replace(",", "").split() for row in done.out.splitlines()[1:]}
    sizes = {"tracking": 7, "pipeline": 2, "live": 1, "api": 1}
    sizes |= {"package": 14, "video to tracks": 10, "tests": 20}
    assert {name: int(rows[name][0]) for name in sizes} == sizes
    assert int(rows["tests"][1]) == 25_000
