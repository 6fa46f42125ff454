"""What all commands have: help, completion in shells, --progress, --log, --config and --save-config."""

import json
import re
import subprocess
import sys
from pathlib import Path

import click
import cv2
import numpy as np
import pytest
from helpers import assert_refused
from hypothesis import given, settings
from hypothesis import strategies as st

from psotrack import cli
from psotrack.cli.lazy import LazyGroup
from psotrack.cli.output import Output as Printer
from psotrack.cli.settings import config_text, read_config
from psotrack.settings import TrackSettings
from psotrack.trajectories import Status, Trajectories

#: A line of a log: local time with its offset, level, and what was said.
LINE = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[+-]\d{4} (info|warning|error) (.*)")
#: Packages that only commands need.
HEAVY = ("cv2", "jax", "matplotlib", "msgspec", "numpy", "pandas", "rich", "scipy", "trimesh", "zarr")

#: Shows the help of the command of each argument, and prints the heavy packages that are imported after each.
REPORT_IMPORTS = f"""
import contextlib, io, sys
from psotrack.cli import main
for words in sys.argv[1:]:
    sys.argv = ["psotrack", *words.split(), "--help"]
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        main()
    print(*sorted(set({HEAVY!r}) & set(sys.modules)), sep=" ")
"""


def commands_of(group, typed):
    """A group and every command in it, each with what is typed for it."""
    yield typed, group
    for name in group.list_commands(click.Context(group)):
        command = group.commands[name]
        words = f"{typed} {name}"
        if isinstance(command, click.Group):
            yield from commands_of(command, words)
        else:
            yield words, command


#: Lists the scenarios; meanwhile NumPy, a library and psotrack warn.
WARN = """
import logging, sys
import numpy as np
from psotrack import cli
invoke = cli.cli.invoke
def warning(context):
    invoke(context)
    np.nanmean([np.nan])
    logging.getLogger("trimesh").warning("of a mesh")
    logging.getLogger("psotrack.any").warning("of psotrack")
cli.cli.invoke = warning
cli.main()
"""


EVERY_COMMAND = dict(commands_of(cli.cli, "psotrack"))


def test_summaries_are_the_first_sentences_of_the_commands(run_psotrack):
    """They are written a second time, because help must not import the commands."""
    groups = [command for command in EVERY_COMMAND.values() if isinstance(command, LazyGroup)]
    assert cli.cli in groups
    for group in groups:
        assert len(group.places) >= 2
        for name in group.places:
            command = group.commands[name]
            assert command.name == name
            assert group.summary(name) == command.get_short_help_str(limit=1000), name
    result = run_psotrack("--help").ended()
    words = " ".join(result.out.split())
    for name in cli.cli.places:
        assert f" {name} {cli.cli.summary(name)}" in words
    for shell in ("bash", "zsh", "fish"):
        assert f"_PSOTRACK_COMPLETE={shell}_source psotrack" in result.out


@pytest.mark.parametrize("words", EVERY_COMMAND)
def test_help_fits_two_screens_and_has_an_example(words):
    command = EVERY_COMMAND[words]
    context = click.Context(command, info_name=words, terminal_width=100, max_content_width=100)
    text = command.get_help(context)
    assert len(text.splitlines()) <= 80
    if not isinstance(command, click.Group):
        typed = words.removesuffix(" sequence")
        assert re.search(rf"Examples?:\n +{typed}\b", text)


@pytest.mark.parametrize("words", EVERY_COMMAND)
def test_help_names_the_default_that_an_option_has(words):
    context = click.Context(EVERY_COMMAND[words], resilient_parsing=True)
    for option in EVERY_COMMAND[words].params:
        if not isinstance(option, click.Option) or option.is_eager:
            continue
        shown = (option.get_help_record(context) or ("", ""))[1]
        stated = re.findall(r"\[(?:.*; )?default: (.*?)(?:;.*)?\]", shown)
        default = option.get_default(context)
        if option.is_flag:
            default = option.opts[0] if default is True else None
        if isinstance(default, tuple):
            default = ",".join(map(str, default))
        if default is not None and default is not False and default not in ("", click.core.UNSET):
            assert stated == [str(default)], option.name
        elif option.callback is None:
            # Words say what happens without the option: never a number that the program does not have.
            assert not any(re.fullmatch(r"[\d.]+", each) for each in stated), option.name


def test_help_and_names_of_commands_import_no_heavy_package():
    """Help of a command imports the defaults of settings alone. What a line imports, the next ones have too."""
    light = ["", "--version", "calibrate"]
    with_settings = ["onboard localise", "simulate sequence", "detect", "sweep", "track"]
    command = [sys.executable, "-c", REPORT_IMPORTS, *light, *with_settings]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    lines = result.stdout.splitlines()
    assert lines[:3] == ["", "", ""]
    assert lines[3:] == ["msgspec"] * len(with_settings)


def test_warnings_of_libraries_are_for_the_log_and_verbose(tmp_path):
    """In this process all warnings are errors, in all commands of all tests."""

    def said(*words):
        command = [sys.executable, "-c", WARN, *map(str, words), "simulate", "--list"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stderr

    assert said() == "psotrack: warning: of psotrack\n"
    of_all = said("--verbose")
    for words in ("RuntimeWarning: Mean of empty slice", "trimesh: of a mesh", "psotrack.any: of psotrack"):
        assert words in of_all


# --- completion


def test_commands_and_options_are_completed(monkeypatch, run_psotrack, tmp_path):
    """The script of a shell runs psotrack with what was typed in variables of the environment."""

    def complete(shell, **environment):
        monkeypatch.setenv("_PSOTRACK_COMPLETE", shell)
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        return run_psotrack()

    def completions(typed):
        """Completions of the last word that is typed."""
        last = typed.count(" ")
        result = complete("bash_complete", COMP_WORDS=typed, COMP_CWORD=str(last)).ended()
        return sorted(line.partition(",")[2] for line in result.out.splitlines())

    assert completions("psotrack s") == ["simulate", "sweep"]
    assert completions("psotrack calibrate c") == ["convert"]
    options = ["--scale", "--scenario", "--seed", "--set", "--show"]
    assert completions("psotrack simulate sequence --s") == options
    assert completions("psotrack onboard fuse --at ") == ["camera", "middle"]
    shells = "bash_source, zsh_source or fish_source"
    assert_refused(lambda: complete("tcsh_source"), shells, unchanged=tmp_path)


# --- --progress, --log, --config and --save-config, and the table of `track`


@pytest.fixture
def run(monkeypatch, run_psotrack):
    """Runs `psotrack` with some arguments, with the progress that users see."""
    monkeypatch.delenv("PSOTRACK_PROGRESS", raising=False)
    return run_psotrack


@pytest.fixture
def command(tmp_path):
    """Arguments of a command that takes a moment: `onboard detect` in a photograph of a marker."""
    path = tmp_path / "photograph.png"
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 7, 100)
    cv2.imwrite(str(path), np.pad(marker, 40, constant_values=255))
    return ["onboard", "detect", path, "--out", tmp_path / "markers.csv", "--force", "--json", "-"]


def said_in(log):
    """Level and text of each line of a log."""
    matches = [LINE.fullmatch(line) for line in log.read_text(encoding="utf-8").splitlines()]
    assert all(matches)
    return [(match[1], match[2]) for match in matches if match]


def test_progress(run, command, monkeypatch):
    """Short work is quiet, lines say what was done, --quiet has precedence, and a variable chooses."""
    assert run(*command).err == run(*command, "--progress", "none").err == ""
    _, out, err = run(*command, "--progress", "lines").ended()
    assert json.loads(out)
    assert re.fullmatch(r"psotrack: markers: 1 of 1 in \d+\.\d s\n", err)
    assert "1/1" in run(*command, "--progress", "bar").err
    assert run(*command, "--progress", "lines", "--quiet").err == ""
    monkeypatch.setenv("PSOTRACK_PROGRESS", "lines")
    assert "markers: 1 of 1" in run(*command).err
    assert run(*command, "--progress", "none").err == ""


def test_a_log_grows(run, command, tmp_path):
    log = tmp_path / "logs" / "all.log"
    command = [*command[:5], "--log", log]
    out = run(*command).out
    lines = said_in(log)
    assert lines[0][1].startswith("psotrack ")
    assert lines[0][1].endswith(f"--log {log}")
    assert any(re.fullmatch(r"markers: 1 of 1 in \d+\.\d s", text) for _, text in lines)
    assert lines[-1] == ("info", out.strip())
    code, _, err = run(*command, "--quiet")
    assert code == 2
    again = said_in(log)
    assert again[: len(lines)] == lines
    # The error on stderr without the name of the program.
    assert again[-1] == ("error", err.strip().removeprefix("psotrack: "))
    # Nothing is logged after the command; wrong options after the log are.
    assert run(*command[:5], "--force").code == 0
    assert said_in(log) == again
    assert run("track", tmp_path, "--log", log, "--out", "t.txt").code == 2
    assert said_in(log)[-1][0] == "error"


def test_results_and_folders_are_no_logs(run, command, tmp_path):
    tracks = tmp_path / "tracks.csv"
    tracks.write_text("frame,drone\n", encoding="utf-8")
    words = {tracks: "expected a new file, or a log of psotrack", tmp_path: "a log file that can be written"}
    for log in words:
        assert_refused(lambda log=log: run(*command, "--log", log), words[log], unchanged=tmp_path)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_the_work_goes_on_where_the_log_meets_a_full_disk(run, command):
    _, out, err = run(*command, "--log", "/dev/full").ended()
    assert json.loads(out)
    assert err == "psotrack: warning: /dev/full: No space left on device; the log ends here\n"


texts = st.text(st.characters(exclude_categories=("Cs", "Cc")), min_size=1).filter(
    lambda text: not text.startswith("-")
)


#: Any values that some settings may have.
SETTINGS = st.fixed_dictionaries(
    {},
    optional={
        "swarm.particles": st.integers(2, 100_000),
        # Files have no numbers above 1e60.
        "rate_hz": st.floats(1e-300, 1e60),
        "drones.size_m": st.tuples(*[st.floats(1e-3, 1e9)] * 3),
        "clocks": st.sampled_from(["given", "auto"]),
        "method": texts,
        "smooth": st.booleans(),
    },
)


# To read all settings takes a tenth of a second.
@settings(max_examples=10)
@given(values=SETTINGS)
def test_a_saved_config_has_all_settings(tmp_path_factory, values):
    saved = TrackSettings().changed(values)
    file = tmp_path_factory.getbasetemp() / "saved_config.toml"
    file.write_text(config_text(saved), encoding="utf-8")
    assert TrackSettings().changed(read_config(file)) == saved


def test_a_run_that_fails_saves_no_config(run, tmp_path):
    words = ("track", tmp_path, "--out", tmp_path / "t.csv", "--save-config", tmp_path / "b.toml")
    assert_refused(lambda: run(*words), unchanged=tmp_path)


def test_the_table_of_drones_has_eighty_columns_and_no_cell_is_cut(capsys):
    long_name = "[red]a drone with a long name"
    frames = 40
    tracks = Trajectories(
        np.arange(frames),
        # Times of more than a day, and 12 m of standard deviation.
        90_000 + np.arange(frames) / 25,
        ("0", long_name),
        np.ones((frames, 2, 3)),
        status=np.full((frames, 2), Status.TRACKED),
        covariance_m2=np.tile(144.0 * np.eye(3), (frames, 2, 1, 1)),
        num_cameras=np.full((frames, 2), 40),
    )
    Printer().drones(tracks, np.full((2, 3), 1.234))
    lines = capsys.readouterr().out.splitlines()
    for line in lines:
        assert len(line) <= 80
    number = next(number for number, line in enumerate(lines) if line.startswith("0 "))
    expected = "0 100.0% 0.0% 0.0% 40.0 12000 123 123 123 90000 90002"
    assert lines[number].split() == expected.split()
    # The long name is folded, not cut, and no part of it is a style.
    folded = "".join(line.partition("100.0%")[0] for line in lines[number + 1 :])
    assert folded.replace(" ", "") == long_name.replace(" ", "")
