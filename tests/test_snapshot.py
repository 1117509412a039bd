import json
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.numpy import load, save
from stable_baselines3 import SAC

from tcmrl_data import Dataset, load_recipe
from tcmrl_data.behavior.base import LOG_STD_RANGE, Snapshot, read_snapshot
from tcmrl_data.behavior.sac import snapshot_of_sac
from tcmrl_data.foundation.errors import SnapshotError
from tcmrl_data.foundation.files import read_plain_file


@pytest.fixture(scope="module")
def model() -> SAC:
    environment = load_recipe("point-robot").make_environment()
    task = {"goal": [0.0, 1.0], "wind": [0.0, 0.0]}
    model = SAC(
        "MlpPolicy",
        environment.make(task),
        seed=0,
        learning_starts=20,
        device="cpu",
        policy_kwargs={"net_arch": [16, 8]},
    )
    return model.learn(60)


@pytest.fixture
def snapshot(model: SAC) -> Snapshot:
    return snapshot_of_sac(model, step=60, observation="stored")


def write(snapshot: Snapshot, folder: Path) -> Path:
    for name, content in snapshot.files().items():
        (folder / name).write_bytes(content)
    return folder


def read_back(folder: Path) -> Snapshot:
    def read(name: str, *, limit: int) -> bytes:
        return read_plain_file(folder / name, limit=limit)

    return read_snapshot(read, 60, place=str(folder))


def test_a_snapshot_acts_exactly_like_its_sb3_model(model: SAC, snapshot: Snapshot, tmp_path: Path) -> None:
    environment = load_recipe("point-robot").make_environment()
    controller = read_back(write(snapshot, tmp_path)).controller(environment, [])
    observations = np.random.default_rng(0).normal(size=(50, 2)).astype(np.float32)

    deterministic, _ = model.predict(observations, deterministic=True)
    assert np.array_equal(controller.act(observations, np.zeros((50, 2), np.float32)), deterministic)

    torch.manual_seed(7)
    stochastic, _ = model.predict(observations, deterministic=False)
    torch.manual_seed(7)
    noise = torch.randn(50, 2).numpy()
    assert np.array_equal(controller.act(observations, noise), stochastic)


def test_the_clamp_of_log_std_is_sb3s() -> None:
    from stable_baselines3.sac import policies

    assert LOG_STD_RANGE == (policies.LOG_STD_MIN, policies.LOG_STD_MAX)


def test_digest_changes_with_any_weight(snapshot: Snapshot) -> None:
    tensors = {name: array.copy() for name, array in snapshot.tensors.items()}
    assert Snapshot(60, snapshot.description, tensors).digest() == snapshot.digest()
    tensors["mean.bias"][0] += 1e-6
    assert Snapshot(60, snapshot.description, tensors).digest() != snapshot.digest()


def test_hostile_snapshots_are_refused(snapshot: Snapshot, tmp_path: Path) -> None:
    weights, policy = tmp_path / "policy.safetensors", tmp_path / "policy.json"
    good = snapshot.files()

    def refuse(pattern: str) -> None:
        with pytest.raises(SnapshotError, match=pattern):
            read_back(tmp_path)
        write(snapshot, tmp_path)

    write(snapshot, tmp_path)
    weights.write_bytes(pickle.dumps({"mean": 1}))
    refuse("safetensors")
    tensors = load(good["policy.safetensors"])
    weights.write_bytes(save(tensors | {"mean.bias": np.array([np.nan, 0], np.float32)}))
    refuse("mean.bias.*finite")
    weights.write_bytes(save({name: array for name, array in tensors.items() if name != "mean.bias"}))
    refuse("names and shapes")
    weights.write_bytes(good["policy.safetensors"] + b"\0" * 10**6)
    refuse("bytes")
    policy.write_text(json.dumps(json.loads(good["policy.json"]) | {"hidden": [10**9]}))
    refuse("hidden")
    policy.write_text(json.dumps(json.loads(good["policy.json"]) | {"kind": "pickle"}))
    refuse("kind")
    weights.unlink()
    refuse("safetensors")


def test_stored_snapshots_reproduce_the_stored_actions(tiny: Dataset) -> None:
    """The stored observation, policy and keyed noise determine the last action of an episode."""
    from tcmrl_data.foundation.seeding import Purpose, keyed_generator

    lanes = tiny.manifest.recipe.rollouts.lanes
    episodes = tiny.trajectories(3, 100)[:lanes]
    controller = tiny.snapshot(3, 100).controller(tiny.environment, [])
    noise = np.stack(
        [
            controller.draw_noise(keyed_generator(0, tiny.name, 3, Purpose.ROLLOUT_NOISE, 100, lane), 20, 2)
            for lane in range(lanes)
        ]
    )
    for t in (0, 19):
        seen = np.stack([episode.observations[t] for episode in episodes])
        expected = np.stack([episode.actions[t] for episode in episodes])
        np.testing.assert_allclose(controller.act(seen, noise[:, t]), expected, atol=1e-6)
