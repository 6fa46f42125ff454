"""Compile cache on disk: entries are reused, damaged entries are replaced, and an unusable folder is no error."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import environment_without_jax_settings

from psotrack.support import compiled, drop_programs_if_many

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
#: What the program prints: 2 sin(0.5).
RESULT = "0.958851"


def run(folder: Path, **environment: str) -> list[str]:
    """Run the program without any output on stderr; return the number and the folder that it prints."""
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
    assert run(folder) == [RESULT, str(folder)]
    written = entry(folder).stat().st_mtime_ns
    assert run(folder) == [RESULT, str(folder)]
    assert entry(folder).stat().st_mtime_ns == written


@pytest.mark.parametrize("size", [pytest.param(0, marks=pytest.mark.slow), 300])
def test_a_truncated_entry_is_replaced(tmp_path: Path, size: int) -> None:
    """JAX by itself never replaces an entry: each run would compile again and warn."""
    run(tmp_path)
    whole = entry(tmp_path).stat().st_size
    os.truncate(entry(tmp_path), size)
    assert run(tmp_path)[0] == RESULT
    assert entry(tmp_path).stat().st_size == whole > 300


def test_a_folder_that_cannot_be_created_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert run(tmp_path / "file" / "compiled")[0] == RESULT


def test_a_users_own_cache_folder_is_kept(tmp_path: Path) -> None:
    own = tmp_path / "own"
    assert run(tmp_path / "default", JAX_COMPILATION_CACHE_DIR=str(own)) == [RESULT, str(own)]
    assert not (tmp_path / "default").exists()


@pytest.mark.parametrize(("limit", "dropped"), [("1000000", False), ("100", True)])
def test_programs_are_dropped_when_the_process_has_many_memory_maps(monkeypatch, tmp_path, limit, dropped):
    """The limit is replaced, and so is the dropping: other tests of this process use their programs again."""
    calls = []
    (tmp_path / "limit").write_text(f"{limit}\n")
    (tmp_path / "maps").write_text("a map\n" * 60)
    monkeypatch.setattr(compiled, "_MAP_LIMIT", tmp_path / "limit")
    monkeypatch.setattr(compiled, "_MAPS", tmp_path / "maps")
    monkeypatch.setattr(compiled.jax, "clear_caches", lambda: calls.append("cleared"))
    assert drop_programs_if_many() == dropped
    assert calls == ["cleared"] * dropped
    assert drop_programs_if_many(most_maps=60) is False
    assert drop_programs_if_many(most_maps=59) is True


def test_nothing_is_dropped_where_the_system_has_no_limit(monkeypatch, tmp_path):
    monkeypatch.setattr(compiled, "_MAPS", tmp_path / "absent")
    assert not drop_programs_if_many(most_maps=0)
