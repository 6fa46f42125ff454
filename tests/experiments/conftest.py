"""Runs the programs of the experiments."""

import runpy
import sys

import pytest
from helpers import Output


@pytest.fixture
def run_program(monkeypatch, capfd):
    """Runs a program with some words in this process; the programs append folders to the path of imports."""

    def call(program, *words):
        monkeypatch.setattr(sys, "argv", [*map(str, (program, *words))])
        monkeypatch.setattr(sys, "path", [str(program.parent), *sys.path])
        capfd.readouterr()
        said = ""
        try:
            runpy.run_path(str(program), run_name="__main__")
            code = 0
        except SystemExit as stop:
            # Python prints a text with which a program ends.
            code, said = (1, f"{stop.code}\n") if isinstance(stop.code, str) else (int(stop.code or 0), "")
        out, err = capfd.readouterr()
        return Output(code, out, err + said)

    return call
