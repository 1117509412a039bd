import json
from pathlib import Path

import numpy as np
import pytest
import tensorstore
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tcmrl_data import Dataset, Trajectory
from tcmrl_data.foundation.disk import write_tree
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.store import arrays as store_module
from tcmrl_data.store.arrays import array_files, encode_arrays, pack, read_arrays, unpack
from tests.strategies import trajectories


def same(left: Trajectory, right: Trajectory) -> bool:
    names = ("observations", "actions", "rewards", "terminated", "truncated")
    return all(np.array_equal(getattr(left, name), getattr(right, name)) for name in names) and all(
        np.array_equal(left.extras[name], right.extras[name]) for name in left.extras
    )


@given(st.lists(trajectories(), min_size=1, max_size=5), st.sampled_from([16, 100, 10**6]))
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_episodes_survive_disk_at_any_chunk_size(
    tmp_path_factory: pytest.TempPathFactory, episodes: list[Trajectory], chunk_bytes: int
) -> None:
    folder = tmp_path_factory.mktemp("part") / "part"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store_module, "CHUNK_BYTES", chunk_bytes)
        write_tree(folder, encode_arrays(pack(episodes)))
    back = unpack(read_arrays(folder, pack(episodes)))
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
    write_tree(tmp_path / "part", encode_arrays(pack([episode])))
    (tmp_path / "part" / "terminated" / "c" / "0").unlink()
    with pytest.raises(StoreError, match="terminated/c/0 is missing"):
        read_arrays(tmp_path / "part", ["terminated"])


def test_tensorstore_reads_the_same_bytes(tiny: Dataset) -> None:
    folder = tiny.folder_of(0, 150)
    for name, array in tiny.arrays(0, 150).items():
        spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": str(folder / name)}}
        other = tensorstore.open(spec).result().read().result()
        assert (other.dtype, other.shape) == (array.dtype, array.shape)
        assert other.tobytes() == array.tobytes(), name


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("zarr_format", 2),
        ("data_type", "float16"),
        ("shape", [-1, 2]),
        ("shape", [2**50, 2]),
        ("attributes", {"x": 1}),
        ("codecs", [{"name": "bytes", "configuration": {"endian": "little"}}, {"name": "gzip"}]),
        ("chunk_grid", {"name": "regular", "configuration": {"chunk_shape": [0, 2]}}),
        ("chunk_key_encoding", {"name": "v2"}),
        ("storage_transformers", [{"name": "x"}]),
        ("dimension_names", None),
        ("dimension_names", ["step"]),
        ("dimension_names", ["step", "observation"]),
        ("surprise", 1),
    ],
)
def test_metadata_outside_the_allow_list_is_refused(tmp_path: Path, field: str, value: object) -> None:
    write_tree(tmp_path / "part", encode_arrays({"actions": np.ones((3, 2), dtype=np.float32)}))
    assert array_files(tmp_path / "part", "actions") == ["actions/zarr.json", "actions/c/0/0"]
    file = tmp_path / "part" / "actions" / "zarr.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {field: value}))
    with pytest.raises(StoreError, match=field):
        read_arrays(tmp_path / "part", ["actions"])


def test_every_array_names_its_axes(tiny: Dataset) -> None:
    folder = tiny.folder_of(0, 150)
    names = {
        name: json.loads((folder / name / "zarr.json").read_text())["dimension_names"]
        for name in tiny.arrays(0, 150)
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
    write_tree(tmp_path / "part", encode_arrays(pack(episodes)))
    opened = xarray.open_zarr(tmp_path / "part", consolidated=False, zarr_format=3)
    assert dict(opened.sizes) == {
        "observation_row": 7,
        "observation": 4,
        "step": 5,
        "action": 2,
        "episode_boundary": 3,
    }
    assert opened["rewards"].sum() == 5


def test_the_whole_dataset_is_one_zarr_hierarchy(tiny: Dataset) -> None:
    import zarr

    group = zarr.open_group(tiny.folder, mode="r", zarr_format=3)
    array = group["tasks/00000/snapshots/step_0000100/rewards"]
    assert np.array_equal(array[...], tiny.arrays(0, 100)["rewards"])
