"""Compile cache on disk: programs are found again, damaged entries are renewed, and trouble is no error."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import environment_without_jax_settings

#: A program that is stored although it compiles fast; it prints its result and the folder of JAX's compile cache.
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
    """Run the program; return the number and the folder that it prints; stderr must be empty."""
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


@pytest.mark.parametrize("size", [pytest.param(0, marks=pytest.mark.slow), 300])
def test_a_truncated_entry_is_renewed(tmp_path: Path, size: int) -> None:
    """JAX alone never replaces an entry: each run would compile again and warn."""
    run(tmp_path)
    whole = entry(tmp_path).stat().st_size
    os.truncate(entry(tmp_path), size)
    assert run(tmp_path)[0] == ANSWER
    assert entry(tmp_path).stat().st_size == whole > 300


def test_a_folder_that_cannot_be_created_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert run(tmp_path / "file" / "compiled")[0] == ANSWER


def test_a_users_own_cache_folder_is_kept(tmp_path: Path) -> None:
    theirs = tmp_path / "theirs"
    assert run(tmp_path / "ours", JAX_COMPILATION_CACHE_DIR=str(theirs)) == [ANSWER, str(theirs)]
    assert not (tmp_path / "ours").exists()
