"""The actor of a SAC from a Stable-Baselines3 zip file, without running code of the file.

`data` is JSON. Its `:serialized:` texts are pickles and are never looked at; what is needed stands beside
them as plain text. `policy.pth` is read by torch with `weights_only`, which knows tensors alone. Nothing is
unpacked to disk, and what is unpacked in memory takes at most a stated multiple of the file's size.
"""

import io
import pickle
import zipfile
import zlib
from collections.abc import Mapping
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from tcmrl_data.behavior.base import GaussianDescription, Snapshot
from tcmrl_data.envs.rollout import ObservationView
from tcmrl_data.foundation.disk import make_folders, write_tree
from tcmrl_data.foundation.errors import SnapshotError
from tcmrl_data.foundation.files import one_line, open_plain_file, printable
from tcmrl_data.foundation.records import first_problem, parse_json

LARGEST_FILE = 2**29
FLOOR_BYTES = 2**20
LARGEST_RATIO = 2
"""Bytes that may be unpacked per byte of a file, in addition to the floor; weights hardly compress."""

RELU = "<class 'torch.nn.modules.activation.ReLU'>"
FLATTEN = "stable_baselines3.common.torch_layers.FlattenExtractor"


def import_sac(file: Path, out: Path, *, observation: ObservationView) -> Snapshot:
    """Imports the actor of a Stable-Baselines3 zip file into a new folder with `policy.json` and its weights.

    Runs no code of the file.

    Args:
        observation: the view that the policy was trained with.

    Raises:
        SnapshotError: the file holds no SAC with ReLU layers and actions in [-1, 1], is damaged or unpacks to
            too much; or the folder exists.
        StorageError: a file cannot be written.
    """
    if out.exists():
        raise SnapshotError(f"{out} exists; choose another folder")
    snapshot = read_sac(file, observation=observation)
    make_folders(out.parent)
    write_tree(out, snapshot.files())
    return snapshot


def read_sac(file: Path, *, observation: ObservationView) -> Snapshot:
    """The actor of a Stable-Baselines3 zip file; arguments and errors as of `import_sac`."""
    try:
        with open_plain_file(file.resolve(), limit=LARGEST_FILE) as opened:
            data = opened.read()
        members = _unpack(data, ("data", "policy.pth"))
        step = _check_model(parse_json(members["data"]))
        snapshot = Snapshot.of_network(step, observation, _actor(_load_tensors(members["policy.pth"])))
        assert isinstance(snapshot.description, GaussianDescription)
        if {name: array.shape for name, array in snapshot.tensors.items()} != snapshot.description.shapes():
            raise ValueError("its layers do not fit each other")
    except ValidationError as error:
        raise SnapshotError(f"{file}: holds no SAC of Stable-Baselines3 ({first_problem(error)})") from None
    except (OSError, ValueError) as error:
        raise SnapshotError(f"{file}: holds no SAC of Stable-Baselines3 ({one_line(error)})") from None
    return snapshot


def _unpack(data: bytes, names: tuple[str, ...]) -> dict[str, bytes]:
    """Members of a zip file; raises `ValueError` for no zip file, or more inside than its size justifies."""
    left = FLOOR_BYTES + LARGEST_RATIO * len(data)
    found: dict[str, bytes] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for name in names:
                with archive.open(name) as member:
                    found[name] = member.read(left + 1)
                left -= len(found[name])
                if left < 0:
                    raise ValueError(f"{name} is larger than the file's size justifies")
    except KeyError:
        raise ValueError(f"{names[len(found)]} is missing") from None
    except (zipfile.BadZipFile, zlib.error, RuntimeError, NotImplementedError, EOFError) as error:
        raise ValueError(f"no whole zip file: {one_line(error)}") from None
    return found


def _check_model(values: Any) -> int:
    """The model's number of time steps; raises `ValueError` unless it is a SAC that can be imported."""
    if not isinstance(values, dict):
        raise ValueError("data is no table")
    kind = values.get("policy_class")
    if not isinstance(kind, dict) or kind.get("__module__") != "stable_baselines3.sac.policies":
        raise ValueError("policy_class is not SAC's")
    given = values.get("policy_kwargs")
    if not isinstance(given, dict):
        raise ValueError("policy_kwargs is no table")
    if given.get("activation_fn", RELU) != RELU:
        raise ValueError("only policies with ReLU layers can be imported")
    if values.get("use_sde") is not False or given.get("use_sde", False) is not False:
        raise ValueError("only policies without state-dependent exploration can be imported")
    if FLATTEN not in str(given.get("features_extractor_class", FLATTEN)):
        raise ValueError("only policies on plain observations can be imported")
    _check_actions(values.get("action_space"))
    step = values.get("num_timesteps")
    if not isinstance(step, int) or isinstance(step, bool) or step < 0:
        raise ValueError("num_timesteps is no number of steps")
    return step


def _check_actions(space: Any) -> None:
    """Raises `ValueError` unless all actions lie in [-1, 1]."""
    bounds = []
    for name in ("low", "high"):
        text = space.get(name) if isinstance(space, dict) else None
        try:
            bounds.append({float(word) for word in str(text).strip("[] ").split() if word != "..."})
        except ValueError:
            raise ValueError("action_space has no bounds") from None
    if bounds != [{-1.0}, {1.0}]:
        low, high = (sorted(bound) for bound in bounds)
        raise ValueError(
            f"its actions lie in [{low[0] if low else '?'}, {high[-1] if high else '?'}], those of a stored "
            "policy in [-1, 1]; train it on gymnasium.wrappers.RescaleAction(environment, -1, 1)"
        )


def _load_tensors(data: bytes) -> Mapping[str, Any]:
    """The tensors of a file of torch, a zip file too; raises `ValueError` if it holds anything else."""
    import torch

    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = archive.infolist()
            if any(member.compress_type != zipfile.ZIP_STORED for member in members):
                raise ValueError("policy.pth is compressed, which torch's files are not")
            if sum(member.file_size for member in members) > len(data):
                raise ValueError("policy.pth is larger inside than its size")
        loaded = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except (zipfile.BadZipFile, pickle.UnpicklingError, RuntimeError, EOFError, KeyError, TypeError) as error:
        raise ValueError(f"policy.pth holds no tensors alone: {one_line(error)}") from None
    except (AttributeError, IndexError, AssertionError, MemoryError, NotImplementedError) as error:
        raise ValueError(f"policy.pth is damaged: {one_line(error)}") from None
    if not isinstance(loaded, Mapping):
        raise ValueError("policy.pth holds no tensors")
    left = len(data)
    for name, tensor in loaded.items():
        if not isinstance(name, str) or not isinstance(tensor, torch.Tensor) or tensor.dtype != torch.float32:
            raise ValueError(f"policy.pth: {printable(str(name))[:80]} is no tensor of float32")
        left -= 4 * tensor.numel()
        if left < 0:
            raise ValueError("policy.pth has tensors that are larger than its size")
    return loaded


def _actor(loaded: Mapping[str, Any]) -> dict[str, npt.NDArray[np.float32]]:
    """The actor's weights by the names of a snapshot; raises `ValueError` unless it is a plain actor."""
    own = {
        name.removeprefix("actor."): tensor for name, tensor in loaded.items() if name.startswith("actor.")
    }
    layers = list(takewhile(lambda index: f"latent_pi.{2 * index}.weight" in own, count()))
    named = {f"hidden.{index}": f"latent_pi.{2 * index}" for index in layers}
    named |= {"mean": "mu", "log_std": "log_std"}
    wanted = {f"{new}.{kind}": f"{old}.{kind}" for new, old in named.items() for kind in ("weight", "bias")}
    if not layers or set(wanted.values()) != set(own):
        raise ValueError("its actor is no stack of layers with a mean and a log_std")
    tensors = {name: own[old].detach().numpy().copy() for name, old in wanted.items()}
    for name, array in tensors.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{name} is not finite")
    return tensors
