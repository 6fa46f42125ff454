"""Mutation runs: how many faults in the package the tests find. `make mutants` runs this program.

A mutant is the package with one line changed, as Cosmic Ray changes lines. tests/data/mutants.csv holds the mutants, so
that two versions of the tests meet the same faults; the program that drew them is this file in commit 35fb8eb2. `cover`
measures which tests execute which lines of the package. `run` then runs, for each mutant, the tests that execute the
changed line, the quickest first. A mutant is killed if one of them fails or takes far too long. Results are written
after each mutant, and a second call goes on from there.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest

ROOT = Path(__file__).parents[1]
MUTANTS = ROOT / "tests" / "data" / "mutants.csv"
#: Folder of what is measured.
BUILD = ROOT / "build" / "mutants"
#: Most seconds of the tests, by their own time, that one mutant meets.
MOST_S = 60.0


class Recorder:
    """Plugin of pytest that tells Coverage which test runs, and writes the seconds of each test."""

    module = ""

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """JAX traces functions anew in each module: otherwise the lines of a compiled function are not executed."""
        import coverage
        import jax

        if item.path.name != self.module:
            self.module = item.path.name
            jax.clear_caches()
        current = coverage.Coverage.current()
        if current:
            current.switch_context(item.nodeid)
        yield
        if current:
            current.switch_context("")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """One line per phase of a test, from the process to which the workers report."""
        if "PYTEST_XDIST_WORKER" not in os.environ:
            with (BUILD / "seconds.tsv").open("a", encoding="utf-8") as file:
                file.write(f"{function_of(report.nodeid)}\t{report.duration:.3f}\n")


def pytest_configure(config: pytest.Config) -> None:
    """This module is a plugin of pytest: `-p mutants`."""
    config.pluginmanager.register(Recorder())


def function_of(test: str) -> str:
    """The test function of a test, without its parameters; "" if the text is no test."""
    return test.partition("[")[0].partition(" (")[0] if test.startswith("tests/") else ""


def cover() -> None:
    """Measure the lines that each test executes, commands in other processes included, into `BUILD`."""
    shutil.rmtree(BUILD, ignore_errors=True)
    BUILD.mkdir(parents=True)
    config = BUILD / "coverage.ini"
    # The context of another process is the test that started the process.
    config.write_text(
        f"[run]\nsource = {ROOT / 'psotrack'}\nparallel = true\nconcurrency = multiprocessing,thread\n"
        f"context = ${{PYTEST_CURRENT_TEST-}}\ndata_file = {BUILD / 'data'}\n",
        encoding="utf-8",
    )
    environment = os.environ | {
        "COVERAGE_PROCESS_START": str(config),
        "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}",
    }
    words = ["-p", "mutants", "-n", "auto", "--dist", "worksteal", "-q", "-m", "not nightly"]
    subprocess.run([sys.executable, "-m", "pytest", *words], cwd=ROOT, env=environment, check=False)


def tests_by_line() -> tuple[dict[tuple[str, int], set[str]], pd.Series]:
    """(path, line) -> test functions that execute the line; and the seconds of each test function."""
    import coverage

    tests: dict[tuple[str, int], set[str]] = defaultdict(set)
    for file in BUILD.glob("data.*"):
        data = coverage.CoverageData(str(file))
        try:
            data.read()
        except coverage.CoverageException:
            continue  # of a process that a test killed
        for path in data.measured_files():
            name = Path(path).relative_to(ROOT).as_posix()
            for line, contexts in data.contexts_by_lineno(path).items():
                parts = {function_of(part) for context in contexts for part in context.split("|")}
                tests[name, line] |= parts - {""}
    table = pd.read_csv(BUILD / "seconds.tsv", sep="\t", names=["test", "seconds"])
    return tests, table.groupby("test")["seconds"].sum()


def chosen_tests(
    line: tuple[str, int], tests: dict[tuple[str, int], set[str]], seconds: pd.Series
) -> list[str]:
    """Tests that execute the line, then others of their modules, up to `MOST_S` seconds.

    A test may use a function that JAX compiled for an earlier test of its module.
    """
    hit = tests.get(line, set()) & set(seconds.index)
    modules = {test.partition("::")[0] for test in hit}
    beside = {test for test in seconds.index if test.partition("::")[0] in modules} - hit
    order = [
        *sorted(hit, key=lambda test: (seconds[test], test)),
        *sorted(beside, key=lambda test: seconds[test]),
    ]
    total_s = seconds[order].cumsum()
    return list(total_s.index[(total_s <= MOST_S) | (total_s == total_s.min())])


def run(results: Path, copy: Path) -> pd.DataFrame:
    """Run the mutants that have no result yet, in a copy of the repository; one row of results per mutant."""
    tests, seconds = tests_by_line()
    mutants = pd.read_csv(MUTANTS, keep_default_na=False)
    done = set(pd.read_csv(results)["mutant"]) if results.exists() else set()
    for number, mutant in mutants.iterrows():
        if number in done:
            continue
        chosen = chosen_tests((mutant["path"], mutant["line"]), tests, seconds)
        outcome = outcome_of(mutant, chosen, copy, limit_s=60 + 5 * seconds[chosen].sum())
        row = pd.DataFrame([{"mutant": number, "room": mutant["room"], "tests": len(chosen)} | outcome])
        row.to_csv(results, mode="a", header=not results.exists(), index=False)
    return pd.read_csv(results)


def outcome_of(mutant: pd.Series, chosen: list[str], copy: Path, limit_s: float) -> dict[str, str]:
    """Whether the tests kill a mutant, and which test does."""
    path = copy / mutant["path"]
    code = path.read_text(encoding="utf-8")
    lines = code.split("\n")
    if lines[mutant["line"] - 1] != mutant["before"]:
        return {"outcome": "another line", "by": ""}
    if not chosen:
        return {"outcome": "not executed", "by": ""}
    lines[mutant["line"] - 1] = mutant["after"]
    path.write_text("\n".join(lines), encoding="utf-8")
    words = ["-x", "-q", "-n", "0", "--tb=line", "-p", "no:cacheprovider", *chosen]
    try:
        done = subprocess.run(
            [sys.executable, "-m", "pytest", *words],
            cwd=copy,
            env=os.environ | {"PYTHONPATH": str(copy)},
            capture_output=True,
            text=True,
            timeout=limit_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"outcome": "killed", "by": f"more than {limit_s:.0f} s"}
    finally:
        path.write_text(code, encoding="utf-8")
    failed = [line.split()[1] for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return {"outcome": "killed" if done.returncode else "survived", "by": failed[0] if failed else ""}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser(
        "cover", help="measure which tests execute which lines: as long as all tests, and half more"
    )
    commands.add_parser("run", help="run the mutants that have no result yet: hours")
    arguments = parser.parse_args()
    if arguments.command == "cover":
        cover()
    else:
        copy = BUILD / "copy"
        shutil.rmtree(copy, ignore_errors=True)
        for part in ("psotrack", "tests", "experiments", "docs", "notebooks"):
            shutil.copytree(ROOT / part, copy / part)
        for file in ("pyproject.toml", "README.md", "CHANGELOG.md", "CONTRIBUTING.md", "Makefile"):
            shutil.copy(ROOT / file, copy / file)
        found = run(BUILD / "results.csv", copy)
        table = found.groupby(["room", "outcome"]).size().unstack(fill_value=0)
        sys.stdout.write(f"{table.to_string()}\n")


if __name__ == "__main__":
    main()
