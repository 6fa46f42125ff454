"""Archives: tracks are computed again, a damaged or malicious archive writes nothing, old archives stay readable."""

from __future__ import annotations

import json
import shutil
import stat
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from psotrack.cli import cli
from psotrack.errors import InputError, OutputError, PsotrackError, SettingsError
from psotrack.foreground.silhouettes import SilhouetteSettings, compute
from psotrack.pipeline.archives import compare_with_archive, pack_tracks, read_manifest, unpack
from psotrack.recordings.datasets import open_recording
from psotrack.settings import TrackSettings
from psotrack.trajectories import read_trajectories, write_trajectories

#: An archive of format version 1; tests/data/README.md says how it was made.
OLD = Path(__file__).parents[1] / "data" / "version_1.psotrack"
CONTENT = OLD.read_bytes()
FILES = {"tracks.csv": b"frame,drone,x_m,y_m,z_m\n", "tracks.json": b"{}"}


def run(*arguments: object) -> str:
    """Stdout of a command; raises its error."""
    result = CliRunner().invoke(cli, [str(one) for one in arguments], standalone_mode=False)
    if result.exception is not None:
        raise result.exception
    return result.stdout


def psotrack(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command in a process of its own."""
    command = [sys.executable, "-m", "psotrack", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def crafted(
    path: Path, entries: list[tuple[str | zipfile.ZipInfo, bytes]] | None = None, **manifest: Any
) -> Path:
    """An archive with some files, which is right but for what the arguments say."""
    entries = list(FILES.items()) if entries is None else entries
    names = [name if isinstance(name, str) else name.filename for name, _ in entries]
    described = {
        "format": "psotrack archive", "version": 1, "psotrack": "0.2.0", "sequence": "S", "tracks": "tracks.csv",
        "settings": {}, "files": names, **manifest,
    }  # fmt: skip
    with zipfile.ZipFile(path, "w") as zipped:
        zipped.writestr("psotrack.json", json.dumps(described))
        for name, content in entries:
            zipped.writestr(name, content)
    return path


def assert_refused(archive: Path, *words: str) -> None:
    """Unpacking fails with one line that contains the words, and leaves nothing behind."""
    folder = archive.parent / "unpacked" / "folder"
    with pytest.raises(InputError) as error:
        unpack(archive, folder)
    assert "\n" not in str(error.value)
    for word in words:
        assert word in str(error.value), error.value
    assert not folder.parent.exists() or not list(folder.parent.iterdir())


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the old archive; tests must not change it."""
    folder = tmp_path_factory.mktemp("old") / "S02_D4_A"
    unpack(OLD, folder)
    return folder


@pytest.fixture
def own_flight(flight: Path, tmp_path: Path) -> Path:
    """A copy of the folder of the old archive, which a test may change."""
    return shutil.copytree(flight, tmp_path / "S02_D4_A")


class TestOldArchives:
    def test_commands_that_show_and_hand_on_take_an_archive_as_sequence(
        self, flight: Path, tmp_path: Path
    ) -> None:
        tracks = flight / "tracks.csv"
        run("report", tracks, OLD, "--out", tmp_path / "r.html")
        assert "<h2>Cameras</h2>" in (tmp_path / "r.html").read_text(encoding="utf-8")
        run("export", tracks, OLD, "--to", "mot", "--out", tmp_path / "mot")
        assert list((tmp_path / "mot").rglob("*cam8*"))
        run("view", tracks, OLD, "--save", tmp_path / "f.rrd")
        assert (tmp_path / "f.rrd").stat().st_size > 10_000

    def test_the_old_archive_has_what_was_packed(self, flight: Path) -> None:
        manifest, recording = read_manifest(flight), open_recording(flight)
        assert (manifest.version, manifest.sequence, manifest.frames) == (1, "S02_D4_A", 10)
        assert recording.rig.names == tuple(f"cam{number}" for number in range(1, 9))
        assert recording.num_frames == 10
        assert not recording.videos
        assert all(each.silhouettes and each.detections for each in recording.placed)
        assert recording.truth is not None
        assert recording.truth.drones == ("dron1", "dron2", "dron3", "dron4")
        assert {video.frames for video in manifest.videos.values()} == {10}
        assert {video.packed_as for video in manifest.videos.values()} == {None}
        assert read_trajectories(flight / "tracks.csv").num_drones == 4
        record = json.loads((flight / "tracks.json").read_text())
        made = compute(recording, SilhouetteSettings(), cache=flight / "no cache is needed")
        assert dict(made.keys) == record["input_keys"]
        assert made.reduction == 2

    def test_commands_take_the_archive_as_a_sequence(self, flight: Path, tmp_path: Path) -> None:
        errors = json.loads(run("evaluate", flight / "tracks.csv", OLD, "--json", "-"))
        assert errors["drones"] == 4
        # A pixel is 2 to 3 cm at the drones, as in tests/test_cli.py.
        assert errors["mean_error_m"] < 0.15
        described = json.loads(run("init", "--show", OLD, "--json", "-"))
        assert described["name"] == "S02_D4_A"
        assert described["cameras"]["cam1"]["video"] is None
        assert described["cameras"]["cam1"]["silhouettes"].endswith("cam1")
        assert not Path(described["folder"]).exists(), "the archive is unpacked for the time of the command"

    @pytest.mark.slow
    def test_the_old_archive_is_tracked_again(self, flight: Path, tmp_path: Path) -> None:
        again = tmp_path / "again.csv"
        shown = run("track", OLD, "--out", again, "--cache", tmp_path)
        record = json.loads(again.with_suffix(".json").read_text())
        assert "version_1.psotrack" in shown
        assert record["archive"]["unlike"] is None
        # A later tracker numbers the drones otherwise, and its tracks differ by less than a cell of 4 to 6 cm.
        earlier, later = (read_trajectories(path).position_m for path in (flight / "tracks.csv", again))
        distance_m = np.linalg.norm(later[:, :, None] - earlier[:, None], axis=-1).max(axis=0)
        assert sorted(distance_m.argmin(axis=1).tolist()) == [0, 1, 2, 3]
        assert distance_m.min(axis=1).max() < 0.05
        assert "swarm.particles" not in record["archive"]["differences"]
        assert record["settings"]["swarm"]["particles"] == 20


class TestDamage:
    @given(place=st.integers(0, len(CONTENT) - 1), bit=st.integers(0, 7))
    def test_a_changed_bit_changes_no_file(
        self, tmp_path_factory: pytest.TempPathFactory, place: int, bit: int
    ) -> None:
        """It is refused, or it is in a date or an attribute of the zip file, which nothing reads."""
        folder = tmp_path_factory.mktemp("changed")
        changed = bytearray(CONTENT)
        changed[place] ^= 1 << bit
        (folder / "flight.psotrack").write_bytes(changed)
        try:
            unpack(folder / "flight.psotrack", folder / "out")
        except InputError:
            assert [path.name for path in folder.iterdir()] == ["flight.psotrack"]
        else:
            with zipfile.ZipFile(OLD) as zipped:
                for name in zipped.namelist():
                    assert (folder / "out" / name).read_bytes() == zipped.read(name)

    @pytest.mark.parametrize("length", [0, 1, 3, 4, 44, 45, 1000, len(CONTENT) // 2, len(CONTENT) - 1])
    def test_an_archive_that_was_cut_short(self, tmp_path: Path, length: int) -> None:
        (tmp_path / "flight.psotrack").write_bytes(CONTENT[:length])
        assert_refused(tmp_path / "flight.psotrack", "flight.psotrack: expected a")

    def test_the_command_says_it_in_one_line(self, tmp_path: Path) -> None:
        archive = tmp_path / "flight.psotrack"
        archive.write_bytes(CONTENT[:-100])
        for words in (["archive", archive, "--out", tmp_path / "out"], ["init", "--show", archive]):
            result = psotrack(*words)
            assert (result.returncode, result.stdout) == (2, "")
            assert result.stderr.count("\n") == 1
            assert (
                "expected a whole archive of psotrack, found another file, or one that was cut short or changed"
                in result.stderr
            )
        assert [path.name for path in tmp_path.iterdir()] == ["flight.psotrack"]


class TestMaliciousArchives:
    def test_a_crafted_archive_without_a_fault_is_unpacked(self, tmp_path: Path) -> None:
        unpack(crafted(tmp_path / "a.psotrack"), tmp_path / "out")
        assert {path.name for path in (tmp_path / "out").iterdir()} == {*FILES, "psotrack.json"}

    @pytest.mark.parametrize(
        "name",
        [
            "../x",
            "a/../../x",
            "/x",
            "//x",
            "a//x",
            "./x",
            "a/./x",
            "..",
            "C:x",
            "C:\\x",
            "a\\..\\x",
            "a/",
            "a\nx",
        ],
    )
    def test_a_name_that_leads_out_of_the_folder(self, tmp_path: Path, name: str) -> None:
        archive = crafted(tmp_path / "a.psotrack", [*FILES.items(), (name, b"")])
        assert_refused(archive, "names of files inside of the folder")
        assert not (tmp_path / "x").exists()

    def test_a_link_becomes_a_file(self, tmp_path: Path) -> None:
        entry = zipfile.ZipInfo("out")
        entry.create_system, entry.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
        unpack(crafted(tmp_path / "a.psotrack", [*FILES.items(), (entry, b"/")]), tmp_path / "out")
        unpacked = tmp_path / "out" / "out"
        assert (unpacked.is_symlink(), unpacked.read_bytes()) == (False, b"/")

    @pytest.mark.filterwarnings("ignore:Duplicate name")
    @pytest.mark.parametrize("name", ["tracks.csv", "Tracks.CSV", "psotrack.json"])
    def test_two_files_of_one_name(self, tmp_path: Path, name: str) -> None:
        archive = crafted(tmp_path / "a.psotrack", [*FILES.items(), (name, b"2")])
        assert_refused(archive, f"expected each file once, found {name} twice")

    @pytest.mark.parametrize("files", [[], [*FILES, "more"], ["tracks.csv"]])
    def test_files_that_the_manifest_does_not_list(self, tmp_path: Path, files: list[str]) -> None:
        words = "expected the files that psotrack.json lists, found a difference: "
        assert_refused(crafted(tmp_path / "a.psotrack", files=files), words)

    def test_a_file_that_is_longer_than_it_says(self, tmp_path: Path) -> None:
        """The directory of the zip file states a small size; the compressed content is larger."""
        large, small = b"1" * 3_000_000, b"1" * 10
        entry = zipfile.ZipInfo("tracks.csv")
        entry.compress_type = zipfile.ZIP_DEFLATED
        archive = crafted(tmp_path / "a.psotrack", [(entry, large), ("tracks.json", b"{}")])
        content = archive.read_bytes()
        sizes = (len(large).to_bytes(4, "little"), len(small).to_bytes(4, "little"))
        assert content.count(sizes[0]) == 2, "the file's own header, and the directory"
        archive.write_bytes(content.replace(*sizes))
        assert_refused(archive, "a.psotrack")

    def test_a_newer_version_names_both_versions(self, tmp_path: Path) -> None:
        archive = crafted(tmp_path / "a.psotrack", version=7, psotrack="3.1.4", tracks={"new": "form"})
        assert_refused(
            archive, "version 1 or older, found version 7, written by psotrack 3.1.4", "newer psotrack"
        )

    def test_other_zip_files_and_other_files(self, tmp_path: Path) -> None:
        archive = tmp_path / "a.psotrack"
        with zipfile.ZipFile(archive, "w") as zipped:
            zipped.writestr("readme.txt", "of another program" * 10)
        assert_refused(archive, "psotrack.json: expected a file to read, found no such file")
        archive.write_bytes(b"RIFF, a video")
        assert_refused(archive, "found another file")
        archive.unlink()
        assert_refused(archive, "found no such file")
        archive.mkdir()
        assert_refused(archive, "expected an archive of psotrack")
        assert_refused(
            crafted(tmp_path / "b.psotrack", format="cakes"),
            "psotrack.json: expected the manifest of an archive",
        )
        assert_refused(crafted(tmp_path / "c.psotrack", tracks="t.csv"), "found a difference: t.csv")


class TestUnpacking:
    def test_a_folder_is_not_replaced(self, tmp_path: Path) -> None:
        folder = tmp_path / "mine"
        folder.mkdir()
        (folder / "thesis.tex").write_text("years of work")
        for force in (False, True):
            with pytest.raises(OutputError, match="mine: expected a"):
                unpack(OLD, folder, force=force)
        assert [path.name for path in folder.iterdir()] == ["thesis.tex"]

    def test_with_force_an_unpacked_archive_is(self, own_flight: Path) -> None:
        (own_flight / "later.csv").write_text("")
        with pytest.raises(OutputError, match="--force"):
            unpack(OLD, own_flight)
        unpack(OLD, own_flight, force=True)
        assert not (own_flight / "later.csv").exists()


class TestPacking:
    def test_the_same_input_gives_the_same_bytes(
        self, flight: Path, own_flight: Path, tmp_path: Path
    ) -> None:
        for name, folder in (("a", flight), ("b", own_flight)):
            run("archive", folder / "tracks.csv", folder, "--out", tmp_path / f"{name}.psotrack")
        assert (tmp_path / "a.psotrack").read_bytes() == (tmp_path / "b.psotrack").read_bytes()

    def test_what_was_unpacked_is_packed_again(self, flight: Path, tmp_path: Path) -> None:
        run("archive", flight / "tracks.csv", OLD, "--out", tmp_path / "again.psotrack")
        with zipfile.ZipFile(OLD) as old, zipfile.ZipFile(tmp_path / "again.psotrack") as new:
            assert new.testzip() is None
            assert new.namelist() == old.namelist()
            for name in set(old.namelist()) - {"psotrack.json"}:
                assert new.read(name) == old.read(name), name

    def test_calibrations_keep_every_bit(self, own_flight: Path, tmp_path: Path) -> None:
        """With a rig whose rotations a Rodrigues vector would change, and with a fisheye beside other lenses."""
        recording = open_recording(own_flight)
        rng = np.random.default_rng(1)
        cams = recording.rig.cameras
        R, _ = np.linalg.qr(cams.T_cam_world[:, :3, :3] + 1e-3 * rng.normal(size=(8, 3, 3)))
        R *= np.sign(np.einsum("nij,nij->nj", R, cams.T_cam_world[:, :3, :3]))[:, None]
        T = cams.T_cam_world.copy()
        T[:, :3, :3], T[:, :3, 3] = R, rng.normal(size=(8, 3))
        fisheye = np.arange(8) == 3
        dist = rng.normal(scale=1e-3, size=(8, 5))
        dist[3, 4:] = 0
        cameras = replace(cams, T_cam_world=T, dist=dist, fisheye=fisheye)
        turned = replace(
            recording.with_rig(replace(recording.rig, cameras=cameras)),
            bounds_m=(-1.0, 2.0, 0.0, 1.0, 0.0, 1 / 3),
        )
        pack_tracks(own_flight / "tracks.csv", turned, tmp_path / "a.psotrack", cache=tmp_path)
        unpack(tmp_path / "a.psotrack", tmp_path / "out")
        packed = open_recording(tmp_path / "out")
        for name in ("T_cam_world", "K", "dist", "image_size_wh", "fisheye"):
            np.testing.assert_array_equal(getattr(packed.rig.cameras, name), getattr(cameras, name), name)
        assert packed.bounds_m == turned.bounds_m
        assert packed.exposed == recording.exposed

    def test_listed_times_keep_every_bit(self, own_flight: Path, tmp_path: Path) -> None:
        """The record is not that of this recording: its rate differs by less than a record can show."""
        file = own_flight / "recording.toml"
        time_s = np.arange(10) / 25 + 1e-13 * np.arange(10) ** 2
        rows = "".join(f"{frame},{value!r}\n" for frame, value in enumerate(time_s.tolist()))
        (own_flight / "times.csv").write_text(f"frame,time_s\n{rows}")
        file.write_text(file.read_text().replace("fps = 25.0\n", 'timestamps = "times.csv"\n'))
        recording = open_recording(own_flight)
        pack_tracks(own_flight / "tracks.csv", recording, tmp_path / "a.psotrack", cache=tmp_path)
        unpack(tmp_path / "a.psotrack", tmp_path / "out")
        assert open_recording(tmp_path / "out").exposed == recording.exposed
        assert recording.exposed["cam1"].listed_s == tuple(time_s.tolist())

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda folder: _swap_silhouettes(folder), "other content of cam1"),
            (lambda folder: _replace(folder, "[cameras.cam8]", "[cameras.other]"), "no camera cam8"),
            (lambda folder: _replace(folder, "fps = 25.0", "fps = 30.0"), "10 frames at 30 Hz"),
            (
                lambda folder: (folder / "tracks.json").unlink(),
                "tracks.json: expected the record of the tracks",
            ),
            (
                lambda folder: (folder / "tracks.json").write_text("{}"),
                "expected the record of the tracks, which `track` writes",
            ),
            (
                lambda folder: _drop_last_frame(folder),
                "tracks.csv: expected 10 frames, as tracks.json says, found 9",
            ),
        ],
        ids=["silhouettes", "camera", "rate", "no record", "other record", "rows"],
    )
    def test_tracks_of_another_sequence(
        self, own_flight: Path, tmp_path: Path, change: Callable[[Path], None], words: str
    ) -> None:
        change(own_flight)
        with pytest.raises(InputError) as error:
            run("archive", own_flight / "tracks.csv", own_flight, "--out", tmp_path / "out" / "a.psotrack")
        assert "\n" not in str(error.value)
        assert words in str(error.value)
        assert not (tmp_path / "out").exists()

    def test_tracks_without_the_future_are_computed_again_without_it(
        self, own_flight: Path, tmp_path: Path
    ) -> None:
        """The silhouettes of the old archive need the future, so that a run without the future refuses them."""
        record = json.loads((own_flight / "tracks.json").read_text())
        (own_flight / "tracks.json").write_text(json.dumps({**record, "causal": True, "most_drones": 6}))
        archive = tmp_path / "a.psotrack"
        run("archive", own_flight / "tracks.csv", own_flight, "--out", archive)
        with pytest.raises(SettingsError, match="first_look: expected True"):
            run("track", archive, "--out", tmp_path / "t.csv", "--cache", tmp_path)
        unpack(archive, tmp_path / "out")
        manifest = read_manifest(tmp_path / "out")
        assert (manifest.causal, manifest.most_drones) == (True, 6)

    def test_corrected_clocks_may_end_an_instant_earlier(self, own_flight: Path, tmp_path: Path) -> None:
        """Found: 299 instants were taken for the first 299 frames of 300, and other tracks were computed again."""
        record = json.loads((own_flight / "tracks.json").read_text())
        (own_flight / "tracks.json").write_text(json.dumps({**record, "frames": 9}))
        _drop_last_frame(own_flight)
        manifest = pack_tracks(
            own_flight / "tracks.csv", open_recording(own_flight), tmp_path / "a.psotrack", cache=tmp_path
        )
        assert manifest.frames == 10

    def test_the_archive_is_not_overwritten(self, flight: Path, tmp_path: Path) -> None:
        archive = tmp_path / "a.psotrack"
        archive.write_text("mine")
        with pytest.raises(OutputError, match="--force"):
            run("archive", flight / "tracks.csv", flight, "--out", archive)
        assert archive.read_text() == "mine"
        run("archive", flight / "tracks.csv", flight, "--out", archive, "--force")
        unpack(archive, tmp_path / "out")
        with pytest.raises(SettingsError, match=r"ends in \.psotrack, found a\.zip"):
            run("archive", flight / "tracks.csv", flight, "--out", tmp_path / "a.zip")

    def test_other_functions_say_that_it_is_an_archive(self) -> None:
        with pytest.raises(
            InputError, match=r"found an archive; `psotrack archive .*version_1.psotrack --out FOLDER`"
        ):
            open_recording(OLD)


def _replace(folder: Path, old: str, new: str) -> None:
    file = folder / "recording.toml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


def _swap_silhouettes(folder: Path) -> None:
    _replace(folder, '"silhouettes/cam1"', '"silhouettes/cam0"')
    _replace(folder, '"silhouettes/cam2"', '"silhouettes/cam1"')
    _replace(folder, '"silhouettes/cam0"', '"silhouettes/cam2"')


def _drop_last_frame(folder: Path) -> None:
    rows = (folder / "tracks.csv").read_text().splitlines(keepends=True)
    (folder / "tracks.csv").write_text("".join(row for row in rows if not row.startswith("9,")))


class TestStoredSilhouettes:
    @pytest.mark.parametrize(
        ("settings", "words"),
        [
            ({"reduction": 4}, "silhouettes.reduction: expected 2, as in .*, found 4"),
            ({"drone_px": 80.0}, "silhouettes.working_reduction: expected 1, .*, found 4"),
            ({"first_look": False}, "silhouettes.first_look: expected True, .*, found False"),
            ({"num_learning_frames": 7}, "silhouettes.num_learning_frames: expected 50, .*, found 7"),
            ({"background": "mog2"}, "silhouettes.background: expected .*Living, as in .*, found .*Mog2"),
        ],
    )
    def test_other_settings_are_refused(self, flight: Path, settings: dict[str, Any], words: str) -> None:
        recording = open_recording(flight)
        with pytest.raises(SettingsError, match=words) as error:
            compute(recording, SilhouetteSettings(**settings), cache=flight / "none")
        stored = recording.by_name["cam1"].silhouettes.path
        assert f"as in {stored}" in str(error.value)
        assert "other silhouettes need the video of camera cam1" in str(error.value)

    def test_the_settings_with_which_they_were_made_are_accepted(self, flight: Path) -> None:
        recording = open_recording(flight)
        one, other = (
            compute(recording, SilhouetteSettings(reduction=reduction), cache=flight / "none")
            for reduction in (None, 2)
        )
        assert one.keys == other.keys

    def test_the_first_frames_are_those_of_all(self, flight: Path) -> None:
        recording = open_recording(flight)
        every = compute(recording, cache=flight / "none")
        first = compute(recording.usable(num_frames=4, silhouettes=True), cache=flight / "none")
        assert first.num_frames == 4
        np.testing.assert_array_equal(first.read(0, 4), every.read(0, 4))
        assert set(first.keys.values()).isdisjoint(every.keys.values())
        with pytest.raises(SettingsError, match="frames"):
            first.read(0, 5)

    def test_some_cameras_have_the_silhouettes_that_they_had_among_all(self, flight: Path) -> None:
        recording = open_recording(flight)
        some = compute(recording.usable(["cam2", "cam5"], silhouettes=True), cache=flight / "none")
        every = compute(recording, cache=flight / "none")
        np.testing.assert_array_equal(some.read(0, 10), every.read(0, 10)[:, [1, 4]])

    def test_work_that_needs_the_images_says_so(self, flight: Path) -> None:
        with pytest.raises(
            InputError,
            match=r"expected a video for each of the cameras .*; stored silhouettes do not show the images",
        ):
            open_recording(flight).usable()

    def test_damaged_silhouettes(self, own_flight: Path) -> None:
        (own_flight / "silhouettes" / "cam3" / "c" / "0" / "0" / "0").unlink()
        with pytest.raises(InputError, match="silhouettes of camera cam3: 10 frames"):
            compute(open_recording(own_flight), cache=own_flight / "none")
        (own_flight / "silhouettes" / "cam3" / "zarr.json").write_text(
            '{"shape": [10, 2, 2], "attributes": {}}'
        )
        with pytest.raises(InputError, match=r"zarr.json: expected .* say what they were made of"):
            open_recording(own_flight)
        shutil.rmtree(own_flight / "silhouettes" / "cam3")
        with pytest.raises(InputError, match=r"cameras.cam3.silhouettes: expected a file that exists"):
            open_recording(own_flight)

    @pytest.mark.parametrize(
        ("line", "words"),
        [
            ("frames = 10", "silhouettes or frames"),
            ("rvec = [0, 0, 0]", "rvec or R"),
            ('timestamps = "times.csv"', "timestamps or fps"),
        ],
    )
    def test_keys_that_exclude_each_other(self, own_flight: Path, line: str, words: str) -> None:
        _replace(own_flight, "[cameras.cam1]\n", f"[cameras.cam1]\n{line}\n")
        with pytest.raises(InputError, match=f"cameras.cam1: expected {words}, found both"):
            open_recording(own_flight)


class TestComparison:
    @pytest.fixture
    def compare(self, flight: Path, tmp_path: Path) -> Callable[..., Any]:
        """Compare changed tracks with those of the archive."""
        manifest, tracks = read_manifest(flight), read_trajectories(flight / "tracks.csv")

        def call(suffix: str = ".csv", settings: dict[str, Any] | None = None, **changes: Any) -> Any:
            record = json.loads((flight / "tracks.json").read_text())
            versions = changes.pop("versions", {})
            write_trajectories(tmp_path / f"again{suffix}", replace(tracks, **changes))
            return compare_with_archive(
                flight,
                manifest,
                tmp_path / f"again{suffix}",
                {**record, "versions": {**record["versions"], **versions}},
                manifest.track_settings().changed(settings or {}),
            )

        return call

    def test_the_same_tracks(self, compare: Callable[..., Any]) -> None:
        comparison = compare()
        assert comparison.same
        assert comparison.differences == {}
        assert comparison.sentence("a.psotrack") == "the same tracks as in a.psotrack"

    def test_parquet_and_csv_are_compared_in_the_precision_of_the_tracker(
        self, compare: Callable[..., Any]
    ) -> None:
        assert compare(".parquet").same

    def test_another_position(self, compare: Callable[..., Any], flight: Path) -> None:
        position_m = read_trajectories(flight / "tracks.csv").position_m.copy()
        position_m[7, 2] += [0.003, 0.0, 0.004]
        position_m[9, 1] += [0.0, 0.001, 0.0]
        comparison = compare(
            position_m=position_m, versions={"jax": "0.0.1"}, settings={"swarm.particles": 50, "smooth": True}
        )
        assert not comparison.same
        assert (comparison.from_frame, comparison.from_s) == (7, 0.28)
        assert comparison.max_distance_m == pytest.approx(0.005, rel=1e-6)
        sentence = comparison.sentence("a.psotrack")
        assert "other tracks from frame 7 (0.280 s) on, by at most 5 mm, than in a.psotrack" in sentence
        assert "swarm.particles 20 -> 50" in sentence
        assert "smooth False -> True" in sentence
        assert sentence.endswith("-> 0.0.1")
        assert json.loads(json.dumps(comparison.to_dict()))["differences"]["jax"]["now"] == "0.0.1"

    def test_a_value_that_is_no_position(self, compare: Callable[..., Any], flight: Path) -> None:
        fitness = np.array(read_trajectories(flight / "tracks.csv").fitness)
        fitness[3, 0] += 1e-3
        comparison = compare(fitness=fitness)
        assert (comparison.same, comparison.from_frame, comparison.max_distance_m) == (False, 3, 0.0)
        assert "nothing that is recorded" in comparison.sentence("a.psotrack")

    def test_other_drones(self, compare: Callable[..., Any]) -> None:
        assert "other drones than in a" in compare(drones=("a", "b", "c", "d")).sentence("a")

    def test_other_frames(self, compare: Callable[..., Any]) -> None:
        assert compare(frame=np.arange(10) + 5).unlike == "frames"


#: Runs whose archives must give the same bytes again: options of `track`, and options of `pack`.
RUNS = {
    "swarm": (["--frames", "10", "--init", "truth", "--max-speed", "5"], ["--videos"]),
    "lines": (
        ["--method", "projection-lines", "--rate", "40", "--frames", "9", "--cameras", "cam1,cam2,cam3,cam4"],
        [],
    ),
    "fused": (["--method", "fused", "--frames", "8"], []),
    "clocks": (["--clocks", "auto"], []),
}
USUAL = ["--particles", "15", "--iterations", "10", "--quiet"]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small sequence with videos, detections and a reference."""
    root = tmp_path_factory.mktemp("data")
    run("simulate", "S02_D4_A", "--out", root, "--scale", "0.35", "--frames", "12", "--no-onboard", "--quiet")
    return root / "Simulated_Data" / "S02_D4_A"


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_tracks_are_computed_again_bit_by_bit(simulated: Path, tmp_path: Path, name: str) -> None:
    """The archive alone gives the same bytes: with an empty store, and with the sequence out of the way."""
    options, pack_options = RUNS[name]
    tracks, archive, again = tmp_path / "tracks.csv", tmp_path / "flight.psotrack", tmp_path / "again.csv"
    sequence = shutil.copytree(simulated, tmp_path / "S02_D4_A")
    if name == "fused":
        # Detections of a folder of its own, and first positions of a file.
        shutil.move(sequence / "dl_data", tmp_path / "boxes")
        rows = (f"0,{i},{x},{y},{z}\n" for i, (x, y, z) in enumerate(_first_positions(simulated)))
        (tmp_path / "start.csv").write_text("frame,drone,x_m,y_m,z_m\n" + "".join(rows))
        options = [*options, "--detections", str(tmp_path / "boxes"), "--init", str(tmp_path / "start.csv")]
    run("track", sequence, "--out", tracks, "--cache", tmp_path / "cache", *USUAL, *options)
    errors = json.loads(run("evaluate", tracks, sequence, "--json", "-"))
    run("archive", tracks, sequence, "--out", archive, "--cache", tmp_path / "cache", *pack_options)
    for path in (sequence, tmp_path / "boxes", tmp_path / "start.csv", tmp_path / "cache"):
        if path.exists():
            path.rename(tmp_path / f"moved {path.name}")

    shown = run(
        "track", archive, "--out", again, "--cache", tmp_path / "empty", "--json", tmp_path / "again2.json"
    )
    assert again.read_bytes() == tracks.read_bytes()
    assert shown.splitlines()[0].endswith("; the same tracks as in flight.psotrack")
    was, now = (json.loads(path.with_suffix(".json").read_text()) for path in (tracks, again))
    assert now["archive"]["same"]
    assert now["archive"]["differences"] == {}
    assert json.loads((tmp_path / "again2.json").read_text())["archive"] == now["archive"]
    for key in ("sequence", "frames", "cameras", "rate_hz", "input_keys", "volume", "seed"):
        assert now[key] == was[key], key
    assert list((tmp_path / "empty").glob("*/zarr.json")) == [], "the stored silhouettes are used"
    # The reference of the archive is interpolated at the instants, which changes last digits.
    shown_again = json.loads(run("evaluate", again, archive, "--json", "-"))
    assert shown_again["mean_error_m"] == pytest.approx(errors["mean_error_m"], rel=1e-9)


def _first_positions(sequence: Path) -> np.ndarray:
    """(drones, 3), positions of the reference in the first frame that has some."""
    truth = open_recording(sequence).truth
    assert truth is not None
    return truth.position_m[int(truth.seen.all(axis=1).argmax())]


@pytest.mark.slow
def test_an_option_that_is_given_wins(tmp_path: Path) -> None:
    again = tmp_path / "again.csv"
    shown = run("track", OLD, "--out", again, "--cache", tmp_path, "--particles", "25", "--frames", "6")
    assert "swarm.particles 20 -> 25" in shown
    assert "frames 10 -> 6" in shown
    assert "other frames than in version_1.psotrack" in shown
    assert json.loads(again.with_suffix(".json").read_text())["settings"]["swarm"]["iterations"] == 15
    with pytest.raises(PsotrackError, match="first_look: expected True"):
        run("track", OLD, "--out", tmp_path / "causal.csv", "--cache", tmp_path, "--causal")


def test_settings_of_an_archive_are_known(flight: Path) -> None:
    settings = read_manifest(flight).track_settings()
    assert settings == TrackSettings().changed(
        {"swarm.particles": 20, "swarm.iterations": 15, "silhouettes.reduction": 2}
    )
