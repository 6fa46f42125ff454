"""Files of strangers are data: no reader runs what is in them."""

import contextlib
import pickle
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from helpers import assert_refused

import psotrack
from psotrack.errors import InputError
from psotrack.geometry.rig_files import read_rig
from psotrack.recordings.datasets import open_recording
from psotrack.recordings.exchange import read_tracks
from psotrack.simulation import load
from psotrack.sweeps import read_grid
from psotrack.trajectories import read_trajectories

PACKAGE = Path(psotrack.__file__).parent
#: Modules whose readers run code, functions that do, and arguments that allow it. `yaml.load` takes a loader, and only
#: safe loaders build no objects.
SUSPECT = re.compile(
    r"""^\s*(?:import|from)\ (?:pickle|cPickle|dill|cloudpickle|joblib|marshal|shelve|torch|runpy|code)\b
    | (?<![\w.])(?<!def\ )(?:eval|exec|compile|__import__|execfile)\(
    | \b(?:allow_pickle|shell)=(?!False\b)
    | \byaml\.(?:load|load_all|full_load|unsafe_load|FullLoader|UnsafeLoader|Loader)\b
    | \bos\.(?:system|popen)\b""",
    re.MULTILINE | re.VERBOSE,
)


def test_the_package_calls_nothing_that_runs_data():
    for path in PACKAGE.rglob("*.py"):
        assert SUSPECT.search(path.read_text(encoding="utf-8")) is None, path


@pytest.mark.parametrize(
    "text",
    [
        "    from joblib import load",
        "value = eval('1')",
        "np.load(path, allow_pickle=trusted)",
        "subprocess.run(text, shell=True)",
        "yaml.load(text)",
        "os.system(text)",
    ],
)
def test_the_search_finds(text):
    assert SUSPECT.search(text)


class Bomb:
    """Makes a file when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return Path.touch, (self.mark,)


@pytest.fixture
def mark(tmp_path):
    """A file that exists if code of a file has run."""
    return tmp_path / "it_ran"


def test_the_bomb_works(mark):
    pickle.loads(pickle.dumps(Bomb(mark)))
    assert mark.exists()


def read_any_rig(path):
    return read_rig(path, (320, 240))


@pytest.mark.parametrize(
    ("name", "read"),
    [
        *((f"t.{ending}", read_trajectories) for ending in ("csv", "parquet")),
        *((f"t.{ending}", read_tracks) for ending in ("json", "tum", "txt", "c3d", "mcap")),
        *((f"r.{ending}", read_any_rig) for ending in ("toml", "yml", "csv", "json", "npz")),
        ("recording.toml", open_recording),
        ("grid.toml", read_grid),
        ("scenario.toml", load),
    ],
)
def test_a_pickle_in_the_place_of_a_file(name, read, tmp_path, mark):
    (tmp_path / name).write_bytes(pickle.dumps(Bomb(mark)))
    assert_refused(lambda: read(tmp_path / name), unchanged=tmp_path)


@pytest.mark.parametrize("name", ["rig.npy", "rig.npz"])
def test_arrays_of_objects(name, tmp_path, mark):
    objects = np.array([Bomb(mark)], object)
    if name == "rig.npy":
        np.save(tmp_path / name, objects)
    else:
        np.savez(tmp_path / name, K=objects)
    assert_refused(lambda: read_any_rig(tmp_path / name), unchanged=tmp_path)


@pytest.mark.parametrize("text", ["{call}", "cam0:\n  intrinsics: {call}\n  resolution: [320, 240]\n"])
def test_tags_of_yaml(text, tmp_path, mark):
    path = tmp_path / "camchain.yaml"
    path.write_text(text.format(call=f"!!python/object/apply:os.mkdir ['{mark}']"))
    assert_refused(lambda: read_rig(path, (320, 240)), path, unchanged=tmp_path)


@pytest.mark.parametrize("key", [b"pandas", b"ARROW:schema", b"psotrack.units", b"PANDAS_ATTRS"])
def test_metadata_of_parquet(key, tmp_path, mark):
    """Tracks with a pickle in the metadata of file and column are read as tracks.

    Arrow had a type of columns that was stored as a pickle, and loaded with its file.
    """
    bomb = pickle.dumps(Bomb(mark))
    extension = {b"ARROW:extension:name": b"arrow.py_extension_type", b"ARROW:extension:metadata": bomb}
    columns = {"frame": [0], "time_s": [0.0], "drone": ["a"], "y_m": [0.0], "z_m": [1.0]}
    x_m = pa.field("x_m", pa.float64(), metadata=extension)
    table = pa.table(columns).append_column(x_m, [[0.0]]).replace_schema_metadata({key: bomb})
    pq.write_table(table, tmp_path / "t.parquet", store_schema=key != b"ARROW:schema")
    # Refused is right, too: Arrow cannot decode such a schema.
    with contextlib.suppress(InputError):
        assert read_trajectories(tmp_path / "t.parquet").drones == ("a",)
    assert not mark.exists()
