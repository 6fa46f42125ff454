"""`--progress`, `--log`, `--config` and `--save-config`, and the table of `track`."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Callable
from pathlib import Path

import click
import cv2
import numpy as np
import pytest
from helpers import Output
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from psotrack import cli
from psotrack.cli.live import live
from psotrack.cli.output import print_drones
from psotrack.cli.run_files import config_text
from psotrack.cli.track import track
from psotrack.errors import InputError
from psotrack.trajectories import Status, Trajectories

#: A line of a log: local time with its offset, level, and what was said.
LINE = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[+-]\d{4} (info|warning|error) (.*)")

Run = Callable[..., Output]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, run_psotrack: Run) -> Run:
    """Runs `psotrack` with some arguments, with the progress that users see."""
    monkeypatch.delenv("PSOTRACK_PROGRESS", raising=False)
    return run_psotrack


@pytest.fixture
def command(tmp_path: Path) -> list[object]:
    """Arguments of a command that takes a moment: `detect-markers` in a photograph of a marker."""
    path = tmp_path / "photograph.png"
    marker = cv2.aruco.generateImageMarker(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 7, 100)
    cv2.imwrite(str(path), np.pad(marker, 40, constant_values=255))
    return ["detect-markers", path, "--out", tmp_path / "markers.csv", "--force", "--json", "-"]


def said_in(log: Path) -> list[tuple[str, str]]:
    """Level and text of each line of a log."""
    matches = [LINE.fullmatch(line) for line in log.read_text(encoding="utf-8").splitlines()]
    assert all(matches)
    return [(match[1], match[2]) for match in matches if match]


class TestProgress:
    def test_short_work_is_quiet_and_lines_say_what_was_done(self, run: Run, command: list[object]) -> None:
        assert run(*command)[2] == run(*command, "--progress", "none")[2] == ""
        code, out, err = run(*command, "--progress", "lines")
        assert code == 0
        assert json.loads(out)
        assert re.fullmatch(r"psotrack: markers: 1 of 1 in \d+\.\d s\n", err)
        assert "1/1" in run(*command, "--progress", "bar")[2]

    def test_quiet_has_precedence_and_a_variable_chooses(
        self, run: Run, command: list[object], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        assert run(*command, "--progress", "lines", "--quiet")[2] == ""
        monkeypatch.setenv("PSOTRACK_PROGRESS", "lines")
        assert "markers: 1 of 1" in run(*command)[2]
        assert run(*command, "--progress", "none")[2] == ""


class TestLog:
    def test_a_log_grows(self, run: Run, command: list[object], tmp_path: Path) -> None:
        log = tmp_path / "logs" / "all.log"
        command = [*command[:4], "--log", log]
        out = run(*command)[1]
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

    def test_nothing_is_logged_after_the_command(
        self, run: Run, command: list[object], tmp_path: Path
    ) -> None:
        log = tmp_path / "all.log"
        assert run(*command, "--log", log)[0] == 0
        before = log.read_bytes()
        assert run(*command)[0] == 0
        assert log.read_bytes() == before

    def test_wrong_options_after_the_log_are_logged(self, run: Run, tmp_path: Path) -> None:
        log = tmp_path / "all.log"
        code, _, err = run("track", tmp_path, "--log", log, "--out", "t.txt")
        assert code == 2
        assert said_in(log)[-1] == ("error", err.strip().removeprefix("psotrack: "))

    def test_results_are_no_logs(self, run: Run, command: list[object], tmp_path: Path) -> None:
        tracks = tmp_path / "tracks.csv"
        tracks.write_text("frame,drone\n", encoding="utf-8")
        code, _, err = run(*command, "--log", tracks)
        assert (code, err.count("\n")) == (2, 1)
        assert "expected a new file, or a log of psotrack" in err
        assert tracks.read_text(encoding="utf-8") == "frame,drone\n"

    def test_a_log_that_cannot_be_opened_is_one_line(
        self, run: Run, command: list[object], tmp_path: Path
    ) -> None:
        code, out, err = run(*command, "--log", tmp_path)
        assert (code, out, err.count("\n")) == (2, "", 1)
        assert "a log file that can be written" in err

    @pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
    def test_the_work_goes_on_where_the_disk_is_full(self, run: Run, command: list[object]) -> None:
        code, out, err = run(*command, "--log", "/dev/full")
        assert code == 0
        assert json.loads(out)
        assert err.splitlines() == [
            "psotrack: warning: /dev/full: No space left on device; the log ends here"
        ]


def parameters(command: click.Command, *arguments: object) -> dict[str, object]:
    """Parameters that a command gets from arguments."""
    with command.make_context(command.name, [str(argument) for argument in arguments]) as context:
        return dict(context.params)


def saved(command: click.Command, path: Path, *arguments: object) -> dict[str, object]:
    """Parameters of a command, which are saved to a file too."""
    with command.make_context(command.name, [str(argument) for argument in arguments]) as context:
        path.parent.mkdir(exist_ok=True)
        path.write_text(config_text(context, path.parent), encoding="utf-8")
        return dict(context.params)


numbers = st.floats(-1e9, 1e9)
texts = st.text(st.characters(exclude_categories=("Cs", "Cc")), min_size=1).filter(
    lambda text: not text.startswith("-")
)


@st.composite
def options_of_track(draw: st.DrawFn) -> list[str]:
    """Arguments of `track` with some options and any values that the command line takes."""
    values = {
        "--particles": st.integers(-5, 10**6),
        "--max-speed": numbers,
        # Files have no numbers above 1e60.
        "--rate": st.floats(1e-300, 1e60),
        "--drone-size": st.tuples(numbers, numbers, numbers).map(lambda each: ",".join(map(str, each))),
        "--bounds": st.tuples(*[numbers] * 6).map(lambda each: ",".join(map(str, each))),
        "--clocks": st.sampled_from(["given", "auto"]),
        "--method": texts,
        "--cameras": texts,
        "--jobs": st.integers(1, 64),
        "--most-drones": st.integers(1, 64),
        "--init": st.sampled_from(["auto", "truth"]),
        "--detections": st.sampled_from(["yolo", "blobs"]),
        "--progress": st.sampled_from(["auto", "bar", "lines", "none"]),
    }
    chosen = draw(st.lists(st.sampled_from(sorted(values)), unique=True))
    flags = draw(st.lists(st.sampled_from(["--smooth", "--causal", "--quiet"]), unique=True))
    typed = [f"{name}={draw(values[name])}" for name in chosen]
    return ["flight", "--out", "tracks.csv", *typed, *flags]


class TestConfig:
    @settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(arguments=options_of_track())
    def test_a_saved_run_has_the_same_parameters(self, tmp_path: Path, arguments: list[str]) -> None:
        file = Path("run.toml")
        before = Path.cwd()
        os.chdir(tmp_path)
        try:
            wanted = saved(track, file, *arguments)
            assert parameters(track, "--config", file) == wanted
        finally:
            os.chdir(before)

    def test_the_file_has_every_option_and_the_version(self, tmp_path: Path) -> None:
        saved(track, tmp_path / "run.toml", "flight", "--out", "tracks.csv", "--force")
        text = (tmp_path / "run.toml").read_text(encoding="utf-8")
        for param in track.params:
            name = max(param.opts, key=len).lstrip("-")
            typed = name in ("config", "save-config", "force")
            assert bool(re.search(rf"^(# )?{name} =", text, re.MULTILINE)) != typed, name
        assert tomllib.loads(text)["psotrack"] == cli.__version__

    def test_typed_options_have_precedence(self, tmp_path: Path) -> None:
        file = tmp_path / "run.toml"
        file.write_text('sequence = "a"\nout = "a.csv"\nparticles = 7\niterations = 8\n', encoding="utf-8")
        found = parameters(track, "b", "--config", file, "--particles", 9)
        assert (found["sequence"], found["particles"], found["iterations"]) == (Path("b"), 9, 8)

    def test_relative_paths_start_at_the_folder_of_the_file(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        (tmp_path / "here").mkdir()
        monkeypatch.chdir(tmp_path / "here")
        file = tmp_path / "runs" / "run.toml"
        typed = ["flight", "--out", "/tracks.csv", "--init", "start.csv", "--detections", "boxes"]
        typed += ["--detector", "net.onnx", "--json", "-"]
        saved(track, file, *typed)
        monkeypatch.chdir(tmp_path)
        found = parameters(track, "--config", "runs/run.toml")
        places = [Path(str(found[name])).resolve() for name in ("sequence", "init", "detections", "detector")]
        here = tmp_path / "here"
        assert places == [here / "flight", here / "start.csv", here / "boxes", here / "net.onnx"]
        assert (found["out"], found["json_path"]) == (Path("/tracks.csv"), Path("-"))
        # The name of a plugin is no path.
        saved(track, file, "flight", "--out", "a.csv", "--detector", "mine")
        assert parameters(track, "--config", file)["detector"] == "mine"

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("partcles = 3", "partcles: .*found partcles; did you mean particles?"),
            ("max_speed = 3", "found max_speed; did you mean max-speed?"),
            ("qqqq = 3", "see `psotrack track --help`"),
            ("force = true", "found force; it is typed for each run"),
            ('particles = "many"', 'particles: expected a whole number, found "many"'),
            ("smooth = 1", "smooth: expected true or false, found 1"),
            ("out = 7", "out: expected text, found 7"),
            ("drone-size = [1, 2]", "drone-size: expected a list of length 3"),
            ('clocks = "atomic"', "clocks: expected one of auto, given, found atomic"),
            ("jobs = 0", "jobs: expected a whole number of at least 1, found 0"),
            ("rate = inf", "rate: expected a finite number, found inf"),
            ('command = "live"', 'command: expected "track", found "live"'),
            ("rate = [", "expected valid TOML"),
        ],
    )
    def test_a_wrong_file_is_one_line(self, tmp_path: Path, text: str, message: str) -> None:
        file = tmp_path / "run.toml"
        file.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=message.replace("?", r"\?")) as caught:
            parameters(track, "--config", file)
        assert str(caught.value).startswith(str(file))
        assert "\n" not in str(caught.value)

    def test_another_version_is_a_warning(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        file = tmp_path / "run.toml"
        file.write_text('psotrack = "0.0.1"\nsequence = "a"\nout = "a.csv"\n', encoding="utf-8")
        assert parameters(track, "--config", file)["sequence"] == tmp_path / "a"
        assert "written by psotrack 0.0.1" in caplog.text

    def test_a_file_that_exists_is_kept(self, run: Run, tmp_path: Path) -> None:
        file = tmp_path / "run.toml"
        file.write_text("mine", encoding="utf-8")
        code, _, err = run("track", tmp_path, "--out", tmp_path / "t.csv", "--save-config", file)
        assert (code, err.count("\n")) == (2, 1)
        assert "run.toml: expected a path that does not exist yet" in err
        code, _, err = run("track", tmp_path, "--out", tmp_path / "t.csv", "--save-config", tmp_path / "run")
        assert code == 2
        assert "expected a file that ends in .toml" in err
        # A run that fails leaves no file.
        assert (
            run("track", tmp_path, "--out", tmp_path / "t.csv", "--save-config", tmp_path / "b.toml")[0] == 2
        )
        assert sorted(path.name for path in tmp_path.iterdir()) == ["run.toml"]

    def test_live_takes_a_file_too(self, tmp_path: Path) -> None:
        wanted = saved(live, tmp_path / "live.toml", tmp_path, "--udp", "localhost:9000", "--seconds", 3)
        assert parameters(live, "--config", tmp_path / "live.toml") == wanted


class TestTable:
    def test_eighty_columns_and_no_cell_is_cut(
        self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setenv("COLUMNS", "80")
        names = (*map(str, range(10)), "[red]a drone with a long name")
        drones, frames = len(names), 40
        status = np.full((frames, drones), Status.TRACKED)
        status[5:9, 1], status[20:, 2], status[:, 3] = Status.COASTING, Status.LOST, Status.LOST
        position_m = np.ones((frames, drones, 3))
        position_m[:, 3] = np.nan
        # 12 m of standard deviation, and times of more than a day.
        covariance_m2 = np.tile(144.0 * np.eye(3), (frames, drones, 1, 1))
        tracks = Trajectories(
            np.arange(frames),
            90_000 + np.arange(frames) / 25,
            names,
            position_m,
            status=status,
            covariance_m2=covariance_m2,
            num_cameras=np.full((frames, drones), 40),
        )
        size_m = np.full((drones, 3), 1.234)
        size_m[4] = np.nan
        print_drones(False, None, tracks, size_m)
        lines = capsys.readouterr().out.splitlines()
        assert max(map(len, lines)) <= 80
        assert not any("…" in line for line in lines)
        assert lines[0].split()[:5] == ["drone", "seen", "coasting", "lost", "cameras"]
        rows = {line.split()[0]: line.split()[1:] for line in lines if line[:1].isdigit()}
        assert rows["0"] == [
            "100.0%",
            "0.0%",
            "0.0%",
            "40.0",
            "12000",
            "123",
            "123",
            "123",
            "90000",
            "90002",
        ]
        assert rows["1"][:3] == ["100.0%", "10.0%", "0.0%"]
        assert rows["2"][:3] == ["50.0%", "0.0%", "50.0%"]
        # Never seen: all but the shares is unknown.
        assert rows["3"] == ["0.0%", "0.0%", "0.0%", "-", "-", "123", "123", "123", "-", "-"]
        # The long name is folded, not cut, and no part of it is a style.
        last = next(number for number, line in enumerate(lines) if line.startswith("9 "))
        folded = "".join(line[:5].strip() for line in lines[last + 1 :])
        assert folded == names[-1].replace(" ", "")

    def test_nothing_with_quiet_or_json_on_stdout(self, capsys: pytest.CaptureFixture[str]) -> None:
        tracks = Trajectories(np.arange(1), np.zeros(1), ("a",), np.zeros((1, 1, 3)))
        print_drones(True, None, tracks)
        print_drones(False, Path("-"), tracks)
        assert capsys.readouterr().out == ""
        print_drones(False, None, tracks)
        assert "100.0%" in capsys.readouterr().out
