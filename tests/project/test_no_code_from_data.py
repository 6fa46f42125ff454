"""Files of strangers are data: no reader runs what is in them."""

import ast
import contextlib
import pickle
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
#: Modules whose readers run code, and calls that do. Written as parts of dotted names.
MODULES = {
    *("pickle", "cPickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "torch", "runpy", "code"),
}
CALLS = {"eval", "exec", "compile", "__import__", "execfile"}
ARGUMENTS = {"allow_pickle", "shell"}
#: `yaml.load` takes a loader; only safe loaders build no objects.
LOADERS = {"load", "load_all", "full_load", "unsafe_load", "FullLoader", "UnsafeLoader", "Loader"}


def suspects(tree: ast.AST) -> set[str]:
    """What in a module could run code from data."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {one.name for one in node.names if one.name.partition(".")[0] in MODULES}
        elif isinstance(node, ast.ImportFrom) and (node.module or "").partition(".")[0] in MODULES:
            found.add(str(node.module))
        elif isinstance(node, ast.Call):
            if isinstance(node.func, ast.Name) and node.func.id in CALLS:
                found.add(node.func.id)
            of = node.func.value if isinstance(node.func, ast.Attribute) else None
            if isinstance(of, ast.Name) and of.id == "yaml" and node.func.attr in LOADERS:
                found.add(f"yaml.{node.func.attr}")
            if isinstance(of, ast.Name) and (of.id, node.func.attr) in {("os", "system"), ("os", "popen")}:
                found.add(f"os.{node.func.attr}")
            for word in node.keywords:
                if word.arg in ARGUMENTS and not (
                    isinstance(word.value, ast.Constant) and word.value.value is False
                ):
                    found.add(str(word.arg))
    return found


def test_the_package_calls_nothing_that_runs_data():
    found = {
        (path.relative_to(PACKAGE).as_posix(), name)
        for path in PACKAGE.rglob("*.py")
        for name in suspects(ast.parse(path.read_text(encoding="utf-8")))
    }
    assert not found


@pytest.mark.parametrize(
    "text",
    [
        "import pickle",
        "from joblib import load",
        "import torch.serialization",
        "eval('1')",
        "exec(text)",
        "np.load(path, allow_pickle=True)",
        "np.load(path, allow_pickle=trusted)",
        "subprocess.run(text, shell=True)",
        "yaml.load(text)",
        "yaml.unsafe_load(text)",
        "os.system(text)",
    ],
)
def test_the_search_finds(text):
    assert suspects(ast.parse(text))


class Bomb:
    """Makes a file when it is unpickled."""

    def __init__(self, mark: Path) -> None:
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
    path = tmp_path / name
    path.write_bytes(pickle.dumps(Bomb(mark)))
    assert_refused(lambda: read(path), unchanged=tmp_path)


@pytest.mark.parametrize("suffix", [".npy", ".npz"])
def test_arrays_of_objects(suffix, tmp_path, mark):
    path = tmp_path / f"rig{suffix}"
    objects = np.array([Bomb(mark)], object)
    np.save(path, objects) if suffix == ".npy" else np.savez(path, K=objects)
    assert_refused(lambda: read_any_rig(path), unchanged=tmp_path)


@pytest.mark.parametrize("tag", ["python/object/apply:os.mkdir", "python/object/new:os.mkdir"])
@pytest.mark.parametrize("text", ["{call}", "cam0:\n  intrinsics: {call}\n  resolution: [320, 240]\n"])
def test_tags_of_yaml(tag, text, tmp_path, mark):
    path = tmp_path / "camchain.yaml"
    path.write_text(text.format(call=f"!!{tag} ['{mark}']"))
    assert_refused(lambda: read_rig(path, (320, 240)), path, unchanged=tmp_path)


@pytest.mark.parametrize("key", [b"pandas", b"ARROW:schema", b"psotrack.units", b"PANDAS_ATTRS"])
def test_metadata_of_parquet(key, tmp_path, mark):
    """Tracks with a pickle in the metadata of file and column are read as tracks."""
    columns = {"frame": [0], "time_s": [0.0], "drone": ["a"], "x_m": [0.0], "y_m": [0.0], "z_m": [1.0]}
    table = pa.table(columns)
    path = tmp_path / "t.parquet"
    pq.write_table(table.replace_schema_metadata({key: pickle.dumps(Bomb(mark))}), path, store_schema=False)
    # Refused is right, too: Arrow cannot decode such a schema.
    with contextlib.suppress(InputError):
        assert read_trajectories(path).drones == ("a",)
    assert not mark.exists()


def test_an_extension_type_of_parquet(tmp_path, mark):
    """Arrow had a type that was stored as a pickle, and loaded with its file."""
    storage = pa.field("x_m", pa.float64(), metadata={
        b"ARROW:extension:name": b"arrow.py_extension_type",
        b"ARROW:extension:metadata": pickle.dumps(Bomb(mark)),
    })  # fmt: skip
    names = [pa.field("frame", pa.int64()), pa.field("time_s", pa.float64()), pa.field("drone", pa.string())]
    schema = pa.schema([*names, storage, pa.field("y_m", pa.float64()), pa.field("z_m", pa.float64())])
    values = [[0], [0.0], ["a"], [0.0], [0.0], [1.0]]
    pq.write_table(pa.table(values, schema=schema), tmp_path / "t.parquet")
    assert read_trajectories(tmp_path / "t.parquet").drones == ("a",)
    assert not mark.exists()
