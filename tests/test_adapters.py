"""Objects of other libraries; the library itself reads them in every test."""

import os
import pickle
import sys
from collections.abc import Callable
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import data_equivalence
from stable_baselines3.common.buffers import ReplayBuffer
from torch.utils.data import DataLoader

from tcmrl_data import (
    BatchRequest,
    Dataset,
    Purpose,
    Selection,
    Trajectory,
    Transitions,
    export_dataset,
    import_dataset,
    keyed_seed,
    open_sampler,
)
from tcmrl_data.foundation.errors import MissingPackageError, SelectionError
from tcmrl_data.interchange.sb3 import to_sb3_buffer
from tcmrl_data.interchange.tensordict import to_tensordict, view_steps
from tcmrl_data.interchange.torch_dataset import TrajectoryDataset
from tests.conftest import TASKS


def terminated_early(original: Callable[..., list[Trajectory]]) -> Callable[..., list[Trajectory]]:
    """Cuts episode e of a part to 20 - e steps; odd episodes are terminated, even ones truncated."""

    def trajectories(self: Dataset, task: int, step: int, run: str = "main") -> list[Trajectory]:
        result = []
        for index, episode in enumerate(original(self, task, step, run)):
            steps = len(episode) - index
            ended = np.arange(steps) == steps - 1
            result.append(
                Trajectory(
                    episode.observations[: steps + 1],
                    episode.actions[:steps],
                    episode.rewards[:steps],
                    ended & (index % 2 == 1),
                    ended & (index % 2 == 0),
                    {"success": ended & (index == 2)},
                )
            )
        return result

    return trajectories


@pytest.fixture
def uneven(monkeypatch: pytest.MonkeyPatch) -> None:
    """Episodes of 20 to 15 steps, half of them terminated, instead of the tiny dataset's even ones."""
    monkeypatch.setattr(Dataset, "trajectories", terminated_early(Dataset.trajectories))


def episodes_of(selection: Selection) -> list[tuple[int, Trajectory]]:
    return [
        (task.index, episode) for task in selection.tasks for episode in selection.trajectories(task.index)
    ]


def test_torch_dataset_serves_every_episode_in_order(tiny: Dataset, uneven: None) -> None:
    selection = tiny.select(split="train", snapshots="steps>=100")
    served = TrajectoryDataset(selection)
    expected = episodes_of(selection)
    assert len(served) == len(expected) == 4 * 2 * 6
    for index, (task, trajectory) in enumerate(expected):
        item = served[index]
        assert (item["task"].item(), len(item["actions"])) == (task, len(trajectory))
        for name in ("observations", "actions", "rewards", "terminated", "truncated"):
            np.testing.assert_array_equal(item[name].numpy(), getattr(trajectory, name))
        np.testing.assert_array_equal(item["success"].numpy(), trajectory.extras["success"])
    assert [served[index]["step"].item() for index in (0, 5, 6, 11, 12)] == [100, 100, 150, 150, 100]
    assert torch.equal(served[-1]["observations"], served[len(served) - 1]["observations"])
    for outside in (len(served), -len(served) - 1):
        with pytest.raises(IndexError, match="48"):
            served[outside]


def test_torch_dataset_items_are_the_users_own(tiny: Dataset) -> None:
    served = TrajectoryDataset(tiny.select(tasks=[0]))
    served[0]["observations"].zero_()
    assert served[0]["observations"].abs().sum() > 0


@pytest.mark.parametrize(("kept_parts", "reads"), [(None, 3), (3, 3), (2, 6), (0, 36)])
def test_torch_dataset_reads_lazily_and_keeps_what_it_may(
    tiny: Dataset, monkeypatch: pytest.MonkeyPatch, kept_parts: int | None, reads: int
) -> None:
    read: list[tuple[int, int]] = []
    original = Dataset.trajectories

    def count(self: Dataset, task: int, step: int, run: str = "main") -> list[Trajectory]:
        read.append((task, step))
        return original(self, task, step, run)

    monkeypatch.setattr(Dataset, "trajectories", count)
    served = TrajectoryDataset(tiny.select(tasks=[40]), kept_parts=kept_parts)
    assert (len(served), read) == (18, [])
    for _ in range(2):
        for index in range(18):
            served[index]
    assert len(read) == reads


def test_a_loader_with_a_worker_pads_to_the_longest(tiny: Dataset, uneven: None) -> None:
    served = TrajectoryDataset(tiny.select(tasks=[40], snapshots="last"))
    pickle.loads(pickle.dumps(served))  # a worker that is spawned gets it so
    (batch,) = DataLoader(served, batch_size=6, collate_fn=served.collate, num_workers=1)
    assert batch["observations"].shape == (6, 21, 2)
    assert batch["rewards"].shape == batch["mask"].shape == (6, 20)
    assert batch["mask"].sum(1).tolist() == [20, 19, 18, 17, 16, 15]
    assert not batch["rewards"][~batch["mask"]].any()
    assert batch["task"].tolist() == [40] * 6


def test_sb3_buffer_is_what_adding_every_step_gives(tiny: Dataset, uneven: None) -> None:
    selection = tiny.select(snapshots="steps>=100")
    filled = to_sb3_buffer(selection, 3)
    added = ReplayBuffer(2 * 105, filled.observation_space, filled.action_space, device="cpu")
    for episode in selection.trajectories(3):
        for t in range(len(episode)):
            added.add(
                episode.observations[t],
                episode.observations[t + 1],
                episode.actions[t],
                episode.rewards[t],
                np.array(episode.terminated[t] or episode.truncated[t]),
                [{"TimeLimit.truncated": bool(episode.truncated[t])}],
            )
    assert (filled.size(), filled.full, filled.pos) == (added.size(), added.full, added.pos)
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(getattr(filled, name), getattr(added, name))


def test_sb3_buffer_bootstraps_at_time_limits_only(tiny: Dataset, uneven: None) -> None:
    buffer = to_sb3_buffer(tiny.select(snapshots="last"), 3)
    samples = buffer._get_samples(np.arange(105))
    ends = np.cumsum([20, 19, 18, 17, 16, 15]) - 1
    assert np.flatnonzero(samples.dones.numpy()).tolist() == ends[1::2].tolist()


def test_sb3_buffer_refuses_a_task_outside_the_selection(tiny: Dataset) -> None:
    with pytest.raises(SelectionError, match="task 3"):
        to_sb3_buffer(tiny.select(split="train"), 3)


def test_tensordict_holds_every_transition(tiny: Dataset, uneven: None) -> None:
    pytest.importorskip("tensordict")
    selection = tiny.select(snapshots="last")
    data = to_tensordict(selection)
    episodes = episodes_of(selection)
    assert data.batch_size == torch.Size([5 * 105])
    assert data["next", "reward"].shape == data["done"].shape == (5 * 105, 1)
    for number, (task, episode) in enumerate(episodes):
        part = data[data["episode"] == number]
        assert (len(part), part["task"].unique().item(), part["step"].unique().item()) == (
            len(episode),
            task,
            150,
        )
        np.testing.assert_array_equal(part["observation"], episode.observations[:-1])
        np.testing.assert_array_equal(part["next", "observation"], episode.observations[1:])
        np.testing.assert_array_equal(part["action"], episode.actions)
        np.testing.assert_array_equal(part["next", "reward"][:, 0], episode.rewards)
        np.testing.assert_array_equal(part["next", "terminated"][:, 0], episode.terminated)
        np.testing.assert_array_equal(part["next", "truncated"][:, 0], episode.truncated)
    assert data["next", "done"].sum() == len(episodes)
    assert not any(data[name].any() for name in ("done", "terminated", "truncated"))


def test_a_batch_is_seen_as_a_tensordict_without_copying(tiny: Dataset) -> None:
    pytest.importorskip("tensordict")
    request = BatchRequest(tasks=3, kinds={"policy": Transitions(7)})
    steps = open_sampler(tiny.select(split="train"), request, seed=0).batch(0)["policy"]
    view = view_steps(steps)
    assert view.batch_size == torch.Size([3, 7])
    assert view["next", "reward"].shape == view["next", "done"].shape == (3, 7, 1)
    assert view["observation"].data_ptr() == steps.observations.data_ptr()
    torch.testing.assert_close(view["next", "observation"], steps.next_observations)


def test_minari_opens_iterates_and_samples_what_was_exported(
    tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uneven: None
) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "elsewhere"))
    report = export_dataset(tiny, "minari", tmp_path / "out", snapshots="steps>=100")
    assert os.environ["MINARI_DATASETS_PATH"] == str(tmp_path / "elsewhere")
    assert not (tmp_path / "elsewhere").exists()
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "out"))
    names = [f"tcmrl/point-robot/task{task:05d}-steps-ge-100-v0" for task in TASKS]
    assert list(minari.list_local_datasets()) == names
    assert set(report.files) == {path for path in (tmp_path / "out").rglob("*") if path.is_file()}
    for name, task in zip(names, TASKS, strict=True):
        opened = minari.load_dataset(name)
        expected = tiny.select(snapshots="steps>=100").trajectories(task)
        assert (opened.total_episodes, opened.total_steps) == (12, 2 * 105)
        for episode, original in zip(opened.iterate_episodes(), expected, strict=True):
            np.testing.assert_array_equal(episode.observations, original.observations)
            np.testing.assert_array_equal(episode.actions, original.actions)
            np.testing.assert_array_equal(episode.rewards, original.rewards)
            np.testing.assert_array_equal(episode.terminations, original.terminated)
            np.testing.assert_array_equal(episode.truncations, original.truncated)
            np.testing.assert_array_equal(episode.infos["success"][1:], original.extras["success"])
        assert len(opened.sample_episodes(5)) == 5
        steps = [entry["snapshot_step"] for entry in opened.storage.get_episode_metadata(range(12))]
        assert steps == [100] * 6 + [150] * 6


def test_minari_knows_the_scores_and_makes_the_task_again(
    tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.chdir(tmp_path)
    export_dataset(tiny, "minari", Path("out"), snapshots="last")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "out"))
    opened = minari.load_dataset("tcmrl/point-robot/task00040-last-v0")
    references = tiny.references(40)
    assert references.oracle is not None
    scores = minari.get_normalized_score(opened, np.array([references.uniform, references.oracle]))
    np.testing.assert_allclose(scores, [0, 1])
    metadata = opened.storage.metadata
    assert metadata["ref_max_score_source"] == "oracle"
    assert metadata["algorithm_name"] == "sac"
    assert tiny.manifest.root in metadata["description"]
    assert [one.partition("==")[0] for one in metadata["requirements"]] == ["tcmrl", "gymnasium"]
    environment = opened.recover_environment(eval_env=True)
    episode = opened[0]
    seeds = [entry["seed"] for entry in opened.storage.get_episode_metadata(range(6))]
    assert seeds == [
        keyed_seed(0, "point-robot", 40, Purpose.ROLLOUT_RESET, 150, index) for index in range(6)
    ]
    np.testing.assert_allclose(environment.reset(seed=seeds[0])[0], episode.observations[0], atol=1e-6)
    for action, observation, reward in zip(
        episode.actions, episode.observations[1:], episode.rewards, strict=True
    ):
        seen, received, *_ = environment.step(action)
        np.testing.assert_allclose(seen, observation, atol=1e-5)
        np.testing.assert_allclose(received, reward, atol=1e-5)


def test_minari_recovers_an_environment_with_the_spaces_of_the_data(
    tiny: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The assertions of `check_env_recovery` in Minari's tests; observations also lie in their space."""
    minari = pytest.importorskip("minari")
    export_dataset(tiny, "minari", tmp_path / "out", snapshots="last")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "out"))
    opened = minari.load_dataset("tcmrl/point-robot/task00040-last-v0")
    original = gymnasium.make(opened.spec.env_spec)
    for recovered in (opened.recover_environment(), opened.recover_environment(eval_env=True)):
        assert recovered.spec == original.spec
        for name in ("observation_space", "action_space"):
            assert data_equivalence(getattr(recovered, name), getattr(original, name))
            assert data_equivalence(getattr(opened.spec, name), getattr(original, name))
        assert recovered.reset(seed=0)[0] in recovered.observation_space
        assert recovered.step(recovered.action_space.sample())[0] in recovered.observation_space
        assert gymnasium.make(recovered.spec).observation_space == opened.spec.observation_space


@pytest.mark.parametrize(
    ("package", "extra", "use"),
    [
        ("minari", "minari", lambda data, out: export_dataset(data, "minari", out)),
        ("pyarrow", "parquet", lambda data, out: export_dataset(data, "parquet", out)),
        ("pyarrow", "parquet", lambda data, out: import_dataset("parquet", [out], out)),
        ("tensordict", "tensordict", lambda data, out: to_tensordict(data.select())),
    ],
)
def test_a_missing_package_is_named_with_its_extra(
    package: str,
    extra: str,
    use: Callable[[Dataset, Path], object],
    tiny: Dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingPackageError, match=rf"{package}.*pip install 'tcmrl\[{extra}\]'"):
        use(tiny, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []
