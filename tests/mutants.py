"""Mutation runs: how many faults in the package the tests find. `make mutants` runs this program.

A mutant is the package with one line changed, as Cosmic Ray changes lines. tests/data/mutants.csv holds the mutants, so
that two versions of the tests meet the same faults; `sample` drew them. `cover` measures which tests execute which
lines of the package. `run` then runs, for each mutant, the tests that execute the changed line, the quickest first. A
mutant is killed if one of them fails or takes far too long. Results are written after each mutant, and a second call
goes on from there.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

ROOT = Path(__file__).parents[1]
MUTANTS = ROOT / "tests" / "data" / "mutants.csv"
#: Folder of what is measured.
BUILD = ROOT / "build" / "mutants"
#: Room -> number of mutants.
ROOMS = {
    **{"tracking": 40, "recordings": 32, "inside_out": 32, "calibration": 32, "foreground": 28},
    **{"simulation": 28, "geometry": 28, "evaluation": 24, "cli": 24, "show": 18, "trajectories": 16},
    **{"pipeline": 14, "sweeps": 14, "support": 14, "live": 12},
}
#: Parts of the names of Cosmic Ray's operators that change types, names or decorators: most of these are no faults.
LEFT_OUT = ("Decorator", "Variable", "Exception", "BitOr", "BitXor", "RShift", "LShift", "_Is")
#: Most seconds of the tests, by their own time, that one mutant meets.
MOST_S = 60.0


def sample(seed: int) -> pd.DataFrame:
    """One mutant per row: room, path, line number, operator, and the line before and after."""
    from cosmic_ray import plugins
    from cosmic_ray.ast import ast_nodes, get_ast_from_path
    from cosmic_ray.mutating import mutate_code

    names = [name for name in plugins.operator_names() if not any(part in name for part in LEFT_OUT)]
    operators = {name: plugins.get_operator(name)() for name in names}
    rng, rows = random.Random(seed), []
    for room, count in ROOMS.items():
        places: dict[tuple[Any, ...], list[tuple[str, int]]] = defaultdict(list)
        for path in sorted((ROOT / "psotrack" / room).rglob("*.py")):
            nodes = list(ast_nodes(get_ast_from_path(path)))
            lines = lines_of_functions(path.read_text(encoding="utf-8"))
            for name, operator in operators.items():
                found = [place for node in nodes for place in operator.mutation_positions(node)]
                for index, (start, end) in enumerate(found):
                    if start[0] in lines:
                        places[path, start, end].append((name, index))
        order = sorted(places)
        rng.shuffle(order)
        drawn = []
        while len(drawn) < count:
            place = order.pop()
            name, index = rng.choice(places[place])
            code = place[0].read_text(encoding="utf-8")
            changed = one_changed_line(code, mutate_code(code, operators[name], index))
            if changed:
                path = place[0].relative_to(ROOT).as_posix()
                drawn.append((room, path, changed[0], name.removeprefix("core/"), *changed[1:]))
        rows += drawn
    return pd.DataFrame(rows, columns=["room", "path", "line", "operator", "before", "after"])


def lines_of_functions(code: str) -> set[int]:
    """Numbers of the lines within functions, without signatures and docstrings."""
    inside: set[int] = set()
    outside: set[int] = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            documented = ast.get_docstring(node) is not None
            first = node.body[0].end_lineno + 1 if documented else node.body[0].lineno
            inside |= set(range(first, node.end_lineno + 1))
            outside |= set(range(node.lineno, first))
    return inside - outside


def one_changed_line(before: str, after: str | None) -> tuple[int, str, str] | None:
    """Number and both texts of the only line that differs; None if the program is the same, or none."""
    if after is None or len(before.splitlines()) != len(after.splitlines()):
        return None
    try:
        same = ast.dump(ast.parse(before)) == ast.dump(ast.parse(after))
    except SyntaxError:
        return None
    pairs = zip(before.splitlines(), after.splitlines(), strict=True)
    changed = [(number, old, new) for number, (old, new) in enumerate(pairs, 1) if old != new]
    return changed[0] if len(changed) == 1 and not same else None


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
    line: tuple[str, int | None], tests: dict[tuple[str, int], set[str]], seconds: pd.Series
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
        line = line_of(mutant, (copy / mutant["path"]).read_text(encoding="utf-8"))
        chosen = chosen_tests((mutant["path"], line), tests, seconds)
        outcome = {"outcome": "line is gone" if line is None else "not executed", "by": ""}
        if chosen:
            outcome = outcome_of(mutant, line, chosen, copy, limit_s=60 + 5 * seconds[chosen].sum())
        row = pd.DataFrame([{"mutant": number, "room": mutant["room"], "tests": len(chosen)} | outcome])
        row.to_csv(results, mode="a", header=not results.exists(), index=False)
    return pd.read_csv(results)


def line_of(mutant: pd.Series, code: str) -> int | None:
    """Number of the mutant's line in a file that may have changed since; None if the line is gone."""
    same = [number for number, line in enumerate(code.split("\n"), 1) if line == mutant["before"]]
    return min(same, key=lambda number: abs(number - mutant["line"]), default=None)


def outcome_of(mutant: pd.Series, line: int, chosen: list[str], copy: Path, limit_s: float) -> dict[str, str]:
    """Whether the tests kill a mutant, and which test does."""
    path = copy / mutant["path"]
    code = path.read_text(encoding="utf-8")
    lines = code.split("\n")
    lines[line - 1] = mutant["after"]
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
    failed = [text.split()[1] for text in done.stdout.splitlines() if text.startswith(("FAILED", "ERROR"))]
    if bool(failed) != bool(done.returncode):
        raise RuntimeError(f"expected tests that fail or pass, found:\n{done.stdout[-2000:]}")
    return {"outcome": "killed" if failed else "survived", "by": failed[0] if failed else ""}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("sample", help=f"draw mutants into {MUTANTS}").add_argument(
        "--seed", type=int, default=43
    )
    commands.add_parser(
        "cover", help="measure which tests execute which lines: as long as all tests, and half more"
    )
    commands.add_parser("run", help="run the mutants that have no result yet: hours")
    arguments = parser.parse_args()
    if arguments.command == "sample":
        sample(arguments.seed).to_csv(MUTANTS, index=False)
    elif arguments.command == "cover":
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
