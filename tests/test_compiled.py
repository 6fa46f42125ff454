"""Compiled programs on disk: found again, renewed where they are spoilt, and never in anybody's way."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import environment_without_jax_settings

#: One program, kept however quickly it compiles; prints what it computes and where JAX keeps programs.
PROGRAM = """
import sys
from pathlib import Path
import jax
from psotrack.support import compiled
compiled.WORTH_KEEPING_S = 0.0
compiled.keep_compiled(Path(sys.argv[1]))
def twice_the_sine(x):
    return 2 * jax.numpy.sin(x)
print(f"{jax.jit(twice_the_sine)(0.5):.6f}", jax.config.jax_compilation_cache_dir)
"""
ANSWER = "0.958851"


def run(folder: Path, **environment: str) -> list[str]:
    """What the program prints, a number and a folder; nothing must come on stderr."""
    result = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(folder)],
        capture_output=True,
        text=True,
        env=environment_without_jax_settings() | environment,
        check=True,
    )
    assert result.stderr == ""
    return result.stdout.rstrip("\n").split(" ", 1)


def entry(folder: Path) -> Path:
    (found,) = folder.glob("jit_twice_the_sine-*-cache")
    return found


def test_a_program_is_compiled_once(tmp_path: Path) -> None:
    folder = tmp_path / "compiled"
    assert run(folder) == [ANSWER, str(folder)]
    written = entry(folder).stat().st_mtime_ns
    assert run(folder) == [ANSWER, str(folder)]
    assert entry(folder).stat().st_mtime_ns == written


@pytest.mark.parametrize("size", [0, 300])
def test_an_entry_that_was_cut_off_is_renewed(tmp_path: Path, size: int) -> None:
    """JAX by itself never replaces an entry: each run would compile again, and warn."""
    run(tmp_path)
    whole = entry(tmp_path).stat().st_size
    os.truncate(entry(tmp_path), size)
    assert run(tmp_path)[0] == ANSWER
    assert entry(tmp_path).stat().st_size == whole > 300


def test_a_folder_that_cannot_be_made_is_no_obstacle(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert run(tmp_path / "file" / "compiled")[0] == ANSWER


def test_what_a_user_told_jax_is_respected(tmp_path: Path) -> None:
    theirs = tmp_path / "theirs"
    assert run(tmp_path / "ours", JAX_COMPILATION_CACHE_DIR=str(theirs)) == [ANSWER, str(theirs)]
    assert not (tmp_path / "ours").exists()
