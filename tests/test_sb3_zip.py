"""Policies from Stable-Baselines3's zip files, whose pickles are never run."""

import base64
import io
import json
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import SAC
from tcmrl_cli.data import data
from tcmrl_cli.frame import run

import tcmrl_data
from tcmrl_data.behavior.base import read_snapshot
from tcmrl_data.behavior.sac import snapshot_of_sac
from tcmrl_data.behavior.sb3_zip import read_sac
from tcmrl_data.foundation.errors import SnapshotError

Members = dict[str, bytes]


def model(**policy: Any) -> SAC:
    environment = tcmrl_data.load_recipe("point-robot").make_environment()
    task = environment.make({"goal": [0.0, 1.0], "wind": [0.0, 0.0]})
    return SAC(
        "MlpPolicy", task, seed=0, device="cpu", policy_kwargs={"net_arch": [8, 5]} | policy, buffer_size=10
    )


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sac") / "sac.zip"
    model().save(path)
    return path


def forged(saved: Path, path: Path, change: Callable[[Members], object], *, packed: bool = False) -> Path:
    with zipfile.ZipFile(saved) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_the_actor_comes_in_without_trust(
    saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    trained, out = SAC.load(saved, device="cpu"), tmp_path / "policies" / "sac"
    command = ["import-policy", str(saved), "--out", str(out)]
    assert run(data, [*command, "--json"]) == 0
    files = {file.name: file.read_bytes() for file in out.iterdir()}
    snapshot = read_snapshot(lambda name, *, limit: files[name], 0, place=str(out))
    assert json.loads(capsys.readouterr().out)["digest"] == snapshot.digest()
    assert snapshot.digest() == snapshot_of_sac(trained, step=0, observation="stored").digest()
    environment = tcmrl_data.load_recipe("point-robot").make_environment()
    observations = np.random.default_rng(0).normal(size=(9, 2)).astype(np.float32)
    acted = snapshot.controller(environment, []).act(observations, np.zeros((9, 2), np.float32))
    assert np.array_equal(acted, trained.predict(observations, deterministic=True)[0])
    assert run(data, command) == 2
    assert "exists; choose another folder" in capsys.readouterr().err


class RunsCode:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, (f"touch {self.marker}",)


def described(**changes: Any) -> Callable[[Members], None]:
    def change(members: Members) -> None:
        members["data"] = json.dumps(json.loads(members["data"]) | changes).encode()

    return change


def weights(values: Any) -> Callable[[Members], None]:
    buffer = io.BytesIO()
    torch.save(values, buffer)
    return lambda members: members.update({"policy.pth": buffer.getvalue()})


def packed_weights(members: Members) -> None:
    """Weights that torch would unpack: 64 MiB of zeros in a few kilobytes."""
    buffer, packed = io.BytesIO(), io.BytesIO()
    torch.save({"actor.mu.weight": torch.zeros(2**24)}, buffer)
    with zipfile.ZipFile(buffer) as source, zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as target:
        for name in source.namelist():
            target.writestr(name, source.read(name))
    members["policy.pth"] = packed.getvalue()


HOSTILE: dict[str, tuple[Callable[[Members], object], str]] = {
    "no data": (lambda members: members.pop("data"), "data is missing"),
    "no weights": (lambda members: members.pop("policy.pth"), "policy.pth is missing"),
    "data is no JSON": (lambda members: members.update(data=b"\x80\x04."), "utf-8"),
    "deep JSON": (lambda members: members.update(data=b"[" * 100_000), "nested"),
    "data is a list": (lambda members: members.update(data=b"[]"), "data is no table"),
    "another algorithm": (described(policy_class={"__module__": "evil"}), "policy_class is not SAC's"),
    "no bounds": (described(action_space={"low": "[a]"}), "action_space has no bounds"),
    "another extractor": (described(policy_kwargs={"features_extractor_class": "CNN"}), "plain observations"),
    "exploration by states": (described(use_sde=True), "state-dependent exploration"),
    "time runs backwards": (described(num_timesteps=-1), "num_timesteps"),
    "weights are a pickle": (
        lambda members: members.update({"policy.pth": b"\x80\x04N."}),
        "no tensors alone",
    ),
    "weights of another kind": (weights({"actor.mu.weight": torch.zeros(3, dtype=torch.float64)}), "float32"),
    "a tensor without bytes": (weights({"x": torch.zeros(1).expand(2**40)}), "larger than its size"),
    "no layers": (weights({"actor.mu.weight": torch.zeros(2, 2)}), "no stack of layers"),
    "packed weights": (packed_weights, "policy.pth is compressed"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_forged_zip_is_refused_by_name(case: str, saved: Path, tmp_path: Path) -> None:
    change, message = HOSTILE[case]
    file = forged(saved, tmp_path / "forged.zip", change)
    with pytest.raises(SnapshotError) as refused:
        tcmrl_data.import_sac(file, tmp_path / "out", observation="stored")
    assert str(refused.value).startswith(f"{file}: holds no SAC of Stable-Baselines3 (")
    assert message in str(refused.value)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["forged.zip"]


def test_pickles_are_never_run(saved: Path, tmp_path: Path) -> None:
    code = pickle.dumps(RunsCode(tmp_path / "ran"))
    text = {":type:": "x", ":serialized:": base64.b64encode(code).decode()}
    hidden = forged(saved, tmp_path / "hidden.zip", described(ep_info_buffer=text, lr_schedule=text))
    assert read_sac(hidden, observation="stored").digest() == read_sac(saved, observation="stored").digest()
    open_ = forged(saved, tmp_path / "open.zip", weights({"actor.mu.weight": RunsCode(tmp_path / "ran")}))
    with pytest.raises(SnapshotError, match="no tensors alone"):
        read_sac(open_, observation="stored")
    assert not (tmp_path / "ran").exists()


def test_a_bomb_is_not_unpacked(saved: Path, tmp_path: Path) -> None:
    bomb = forged(
        saved, tmp_path / "bomb.zip", lambda members: members.update(data=b" " * 2**28), packed=True
    )
    assert bomb.stat().st_size < 2**20
    with pytest.raises(SnapshotError, match="data is larger than the file's size justifies"):
        read_sac(bomb, observation="stored")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_a_truncated_zip_is_refused(share: float, saved: Path, tmp_path: Path) -> None:
    content = saved.read_bytes()
    (tmp_path / "short.zip").write_bytes(content[: int(share * len(content))])
    with pytest.raises(SnapshotError, match=r"short.zip: holds no SAC"):
        read_sac(tmp_path / "short.zip", observation="stored")


def test_another_activation_is_refused(tmp_path: Path) -> None:
    model(activation_fn=torch.nn.Tanh).save(tmp_path / "tanh.zip")
    with pytest.raises(SnapshotError, match="only policies with ReLU layers"):
        read_sac(tmp_path / "tanh.zip", observation="stored")


def test_a_policy_with_other_action_bounds_is_not_imported(tmp_path: Path) -> None:
    """Stable-Baselines3 scales the actor's output to the bounds; those of Pendulum are -2 and 2."""
    SAC("MlpPolicy", "Pendulum-v1", device="cpu", buffer_size=10).save(tmp_path / "pendulum.zip")
    with pytest.raises(
        SnapshotError, match=r"actions lie in \[-2.0, 2.0\], .* in \[-1, 1\]; .*RescaleAction"
    ):
        tcmrl_data.import_sac(tmp_path / "pendulum.zip", tmp_path / "out", observation="stored")
    assert not (tmp_path / "out").exists()
