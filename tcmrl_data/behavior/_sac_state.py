"""Capture and restore of the complete state of a Stable-Baselines3 SAC training.

SB3's `save` omits the replay buffer and the random generators, and its `load` seeds them again. With the
state below, captured at the start of an episode, a training continues bit for bit.
"""

import random
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from tcmrl_data.behavior.checkpoints import TrainingState

if TYPE_CHECKING:
    from stable_baselines3 import SAC
    from torch.optim import Optimizer

REPLAY_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class EpisodeCounter(Protocol):
    """An environment that counts its training episodes; reset n has its own keyed seed."""

    episode: int


def capture(model: "SAC", episodes: EpisodeCounter) -> TrainingState:
    """Captures the state of a model whose current episode has no step yet."""
    import torch

    buffer = model.replay_buffer
    assert buffer is not None
    rows = buffer.buffer_size if buffer.full else buffer.pos
    arrays = {name: tensor.detach().numpy() for name, tensor in _tensors(model)}
    arrays |= {f"replay.{name}": getattr(buffer, name)[:rows] for name in REPLAY_ARRAYS}
    arrays["random.torch"] = torch.get_rng_state().numpy()
    version, words, gauss = random.getstate()
    legacy = np.random.get_state(legacy=False)
    assert isinstance(legacy, dict)
    values = {
        "steps": model.num_timesteps,
        "updates": model._n_updates,
        "episode": episodes.episode,
        "replay": {"position": buffer.pos, "full": buffer.full},
        "random": {
            "python": [version, list(words), gauss],
            "numpy": _plain(legacy),
            "actions": _plain(model.action_space.np_random.bit_generator.state),
        },
    }
    return TrainingState(values, {name: np.ascontiguousarray(array) for name, array in arrays.items()})


def restore(model: "SAC", episodes: EpisodeCounter, checkpoint: TrainingState) -> int:
    """Restores a checkpoint into a new model; returns the number of environment steps done."""
    import torch

    values, arrays = checkpoint.values, checkpoint.arrays
    buffer, environment = model.replay_buffer, model.env
    assert buffer is not None
    assert environment is not None
    if values["updates"]:
        _prepare_optimizers(model)
    with torch.no_grad():
        for name, tensor in _tensors(model):
            tensor.copy_(torch.from_numpy(arrays[name]).reshape(tensor.shape))
    for name in REPLAY_ARRAYS:
        getattr(buffer, name)[: len(arrays[f"replay.{name}"])] = arrays[f"replay.{name}"]
    buffer.pos, buffer.full = values["replay"]["position"], values["replay"]["full"]
    model.num_timesteps, model._n_updates = values["steps"], values["updates"]
    episodes.episode = values["episode"] - 1
    model._last_obs = environment.reset()  # type: ignore[assignment]
    model._last_episode_starts = np.ones((environment.num_envs,), dtype=bool)
    version, words, gauss = values["random"]["python"]
    random.setstate((version, tuple(words), gauss))
    np.random.set_state(_unplain(values["random"]["numpy"]))
    model.action_space.np_random.bit_generator.state = _unplain(values["random"]["actions"])
    torch.set_rng_state(torch.from_numpy(arrays["random.torch"].copy()))
    return model.num_timesteps


def _optimizers(model: "SAC") -> dict[str, "Optimizer"]:
    policy = model.policy
    named = {"actor": policy.actor.optimizer, "critic": policy.critic.optimizer}
    if model.ent_coef_optimizer is not None:
        named["entropy"] = model.ent_coef_optimizer
    return named


def _tensors(model: "SAC") -> Iterator[tuple[str, Any]]:
    """Names and tensors of all parameters and optimizer moments."""
    yield from ((f"policy.{name}", tensor) for name, tensor in model.policy.state_dict().items())
    if model.log_ent_coef is not None:
        yield "log_entropy_coefficient", model.log_ent_coef
    for name, optimizer in _optimizers(model).items():
        for index, state in optimizer.state_dict()["state"].items():
            yield from ((f"optimizer.{name}.{index}.{key}", value) for key, value in state.items())


def _prepare_optimizers(model: "SAC") -> None:
    """Creates the optimizers' moment tensors by a step with zero gradients."""
    import torch

    for optimizer in _optimizers(model).values():
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = torch.zeros_like(parameter)
        optimizer.step()
        optimizer.zero_grad()


def _plain(value: Any) -> Any:
    """A generator's state as JSON, with arrays as `{"uint32": [...]}`."""
    if isinstance(value, dict):
        return {key: _plain(member) for key, member in value.items()}
    if isinstance(value, np.ndarray):
        return {str(value.dtype): value.tolist()}
    return value


def _unplain(value: Any) -> Any:
    if isinstance(value, dict):
        if set(value) == {"uint32"}:
            words: npt.NDArray[np.uint32] = np.array(value["uint32"], dtype=np.uint32)
            return words
        return {key: _unplain(member) for key, member in value.items()}
    return value
