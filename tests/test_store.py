import json
import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import tensorstore
import zarr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from zarr.storage import ZipStore

from tcmrl_data import Dataset, Trajectory
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.store import arrays as store_module
from tcmrl_data.store.archive import Archive, pack_archive
from tcmrl_data.store.arrays import encode_arrays, pack, read_arrays, unpack
from tcmrl_data.store.tables import PartKey
from tests.strategies import trajectories

PART = PartKey(0, 150)


def same(left: Trajectory, right: Trajectory) -> bool:
    names = ("observations", "actions", "rewards", "terminated", "truncated")
    return all(np.array_equal(getattr(left, name), getattr(right, name)) for name in names) and all(
        np.array_equal(left.extras[name], right.extras[name]) for name in left.extras
    )


def written(file: Path, files: dict[str, bytes]) -> Archive:
    """Files as an archive, opened."""
    file.write_bytes(pack_archive(files))
    return Archive(file)


@given(st.lists(trajectories(), min_size=1, max_size=5), st.sampled_from([16, 100, 10**6]))
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_episodes_survive_disk_at_any_chunk_size(
    tmp_path_factory: pytest.TempPathFactory, episodes: list[Trajectory], chunk_bytes: int
) -> None:
    file = tmp_path_factory.mktemp("part") / "part.zip"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store_module, "CHUNK_BYTES", chunk_bytes)
        files = encode_arrays(pack(episodes))
    with written(file, files) as archive:
        back = unpack(read_arrays(archive, pack(episodes)))
    assert len(back) == len(episodes)
    assert all(same(*pair) for pair in zip(back, episodes, strict=True))


def test_observations_hold_one_row_more_per_episode() -> None:
    flags = np.zeros(2, dtype=bool)
    episode = Trajectory(np.arange(3.0)[:, None], np.zeros((2, 1)), np.zeros(2), flags, flags)
    arrays = pack([episode, episode])
    assert arrays["observations"][:, 0].tolist() == [0, 1, 2, 0, 1, 2]
    assert arrays["episode_offsets"].tolist() == [0, 2, 4]


def test_a_missing_chunk_is_an_error_not_zeros(tmp_path: Path) -> None:
    flags = np.zeros(3, dtype=bool)
    episode = Trajectory(np.ones((4, 2)), np.ones((3, 1)), np.ones(3), flags, flags)
    files = encode_arrays(pack([episode]))
    del files["arrays/terminated/c/0"]
    with written(tmp_path / "part.zip", files) as archive:
        with pytest.raises(StoreError, match=r"part.zip: arrays/terminated/c/0 is missing"):
            read_arrays(archive, ["terminated"])
        assert read_arrays(archive, ["rewards"])["rewards"].tolist() == [1, 1, 1]


def test_every_array_names_its_axes(tiny: Dataset) -> None:
    with tiny.open_part(PART) as archive:
        names = {
            name: json.loads(archive.read(f"arrays/{name}/zarr.json"))["dimension_names"]
            for name in tiny.arrays(*PART)
        }
    assert names == {
        "observations": ["observation_row", "observation"],
        "actions": ["step", "action"],
        "rewards": ["step"],
        "terminated": ["step"],
        "truncated": ["step"],
        "episode_offsets": ["episode_boundary"],
    }


def test_xarray_opens_a_part_of_episodes_of_several_lengths(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray", reason="xarray is not installed; pip install xarray")
    flags = [np.zeros(length, dtype=bool) for length in (2, 3)]
    episodes = [
        Trajectory(np.ones((len(ended) + 1, 4)), np.ones((len(ended), 2)), np.ones(len(ended)), ended, ended)
        for ended in flags
    ]
    written(tmp_path / "part.zip", encode_arrays(pack(episodes))).close()
    with ZipStore(tmp_path / "part.zip", mode="r") as store:
        opened = xarray.open_zarr(store, group="arrays", consolidated=False, zarr_format=3).load()
    assert dict(opened.sizes) == {
        "observation_row": 7,
        "observation": 4,
        "step": 5,
        "action": 2,
        "episode_boundary": 3,
    }
    assert opened["rewards"].sum() == 5


def same_array(found: np.ndarray, ours: np.ndarray) -> bool:  # type: ignore[type-arg]
    return (found.dtype, found.shape, found.tobytes()) == (ours.dtype, ours.shape, ours.tobytes())


def test_zarr_python_reads_every_array_of_a_part(tiny: Dataset) -> None:
    ours = tiny.arrays(*PART)
    with ZipStore(tiny.file_of(PART), mode="r") as store:
        group = zarr.open_group(store, path="arrays", mode="r")
        assert sorted(group.array_keys()) == sorted(ours)
        assert list(group.group_keys()) == []
        assert all(same_array(np.asarray(group[name]), array) for name, array in ours.items())


def test_tensorstore_reads_every_array_of_a_part(tiny: Dataset) -> None:
    base = f"file://{tiny.file_of(PART)}"
    for name, array in tiny.arrays(*PART).items():
        kvstore = {"driver": "zip", "base": base, "path": f"arrays/{name}/"}
        found = tensorstore.open({"driver": "zarr3", "kvstore": kvstore}).result().read().result()
        assert same_array(found, array), name


ZARRITA = """
import { open as openFile } from "node:fs/promises";
import * as zarr from "zarrita";
import ZipFileStore from "@zarrita/storage/zip";

const [path, ...names] = process.argv.slice(2);
const file = await openFile(path);
const reader = {
  getLength: async () => (await file.stat()).size,
  read: async (offset, length) => {
    const buffer = new Uint8Array(length);
    if (length > 0) await file.read(buffer, 0, length, offset);
    return buffer;
  },
};
const group = await zarr.open(zarr.root(new ZipFileStore(reader)).resolve("arrays"), { kind: "group" });
const found = {};
for (const name of names) {
  const array = await zarr.open(group.resolve(name), { kind: "array" });
  const { data, shape } = await zarr.get(array);
  const { buffer, byteOffset, byteLength } = data;
  found[name] = [array.dtype, shape, Buffer.from(buffer, byteOffset, byteLength).toString("hex")];
}
await file.close();
console.log(JSON.stringify(found));
"""


def test_zarrita_reads_every_array_of_a_part(tiny: Dataset, tmp_path: Path) -> None:
    node = shutil.which("node")
    modules = Path(os.environ.get("NODE_PATH", "node_modules"))
    if node is None:
        pytest.skip("node is not installed")
    if not (modules / "@zarrita/storage").is_dir():
        pytest.skip("zarrita is not installed; run `npm install zarrita @zarrita/storage`, or set NODE_PATH")
    (tmp_path / "node_modules").symlink_to(modules.resolve())
    (tmp_path / "read.mjs").write_text(ZARRITA)
    ours = tiny.arrays(*PART)
    command = [node, tmp_path / "read.mjs", tiny.file_of(PART), *ours]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout) == {
        name: [str(array.dtype), list(array.shape), array.tobytes().hex()] for name, array in ours.items()
    }
