"""The source `sac`: one Stable-Baselines3 SAC per task.

SB3's `save` omits the replay buffer and the random generators, and its `load` seeds them again. With the
state that `capture` takes at the start of an episode, a training continues bit for bit.
"""

import random
from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Literal, SupportsFloat, final

import gymnasium
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, model_validator

from tcmrl_data.behavior.base import BehaviorContext, BehaviorSource, Snapshot, TrainingState
from tcmrl_data.envs.base import Environment, Task
from tcmrl_data.envs.rollout import ObservationView
from tcmrl_data.foundation.seeding import Purpose, keyed_seed

if TYPE_CHECKING:
    from stable_baselines3 import SAC
    from torch.optim import Optimizer

REPORT_EVERY = 100
"""Updates between two reports of progress."""

REPLAY_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class SacSettings(BaseModel):
    """The `[behavior.sac]` table; names as in Stable-Baselines3's SAC, defaults of the SAC paper (Table 1).

    Attributes:
        hidden: widths of the actor's and the critics' ReLU layers.
        warmup: uniform random steps before the first update (published code of CSRO: 2,000).
        snapshots: steps at which the policy is stored: 0, then steps after the warm-up (in which the policy
            does not change), up to `steps`.
        train_frequency: environment steps between updates.
        gradient_steps: gradient steps per update.
        entropy: the entropy coefficient, above 0, or `auto` to learn it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    hidden: tuple[int, ...] = Field(default=(256, 256), min_length=1)
    steps: int = Field(ge=1)
    warmup: int = Field(default=2_000, ge=0)
    snapshots: tuple[int, ...] = Field(min_length=2)
    learning_rate: float = Field(default=3e-4, gt=0)
    batch_size: int = Field(default=256, ge=1)
    gamma: float = Field(default=0.99, gt=0, lt=1)
    tau: float = Field(default=0.005, gt=0, le=1)
    buffer_size: int = Field(default=1_000_000, ge=1)
    train_frequency: int = Field(default=1, ge=1)
    gradient_steps: int = Field(default=1, ge=1)
    entropy: Literal["auto"] | Annotated[float, Field(gt=0, allow_inf_nan=False)] = "auto"

    @model_validator(mode="after")
    def _snapshots_fit(self) -> "SacSettings":
        steps = self.snapshots
        if steps[0] != 0 or list(steps) != sorted(set(steps)) or steps[-1] != self.steps:
            raise ValueError(f"snapshots must rise from 0 to steps ({self.steps}), got {list(steps)}")
        if steps[1] <= self.warmup:
            raise ValueError(f"snapshot {steps[1]} lies within the warm-up of {self.warmup} random steps")
        if any(step % self.train_frequency for step in steps):
            raise ValueError(f"snapshots must be multiples of train_frequency ({self.train_frequency})")
        return self


class SacTraining(BehaviorSource):
    """Base class of the sources that train SAC agents, alone or together."""

    settings: SacSettings

    @property
    def steps(self) -> tuple[int, ...]:
        return self.settings.snapshots

    @property
    def training_steps(self) -> int:
        return self.settings.steps

    @property
    def warmup_steps(self) -> int:
        return self.settings.warmup

    def with_warmup(self, steps: int) -> "SacTraining":
        warmup = min(steps, self.settings.warmup)
        return type(self)(self.settings.model_copy(update={"warmup": warmup}))

    def agents_bytes(self, environment: Environment, *, num_agents: int) -> int:
        """Maximum memory in bytes for training `num_agents` agents at the same time.

        The content of a checkpoint (replay buffers, weights and moments) counts three times: as the
        training's state, as the checkpoint and as the file's bytes.
        """
        settings = self.settings
        observation_dim, action_dim = environment.observation_dim, environment.action_dim
        row = 2 * observation_dim + action_dim + 3
        replay = min(settings.buffer_size, settings.steps) * row
        actor = _parameters(observation_dim, settings.hidden, 2 * action_dim)
        critic = _parameters(observation_dim + action_dim, settings.hidden, 1)
        kept = replay + 3 * actor + 2 * 4 * critic  # weights and two moments; the critics' targets
        gradients = actor + 2 * critic
        # both critics, forward and backward
        activations = 8 * settings.batch_size * (row + sum(settings.hidden))
        return 4 * num_agents * (3 * kept + gradients + activations)


def _parameters(inputs: int, hidden: tuple[int, ...], outputs: int) -> int:
    return sum((before + 1) * after for before, after in pairwise((inputs, *hidden, outputs)))


@final
class SacSource(SacTraining):
    """Trains the tasks of a unit one after another."""

    name = "sac"
    Settings = SacSettings

    def training_bytes(self, environment: Environment, num_tasks: int) -> int:
        return self.agents_bytes(environment, num_agents=1)

    def snapshots(self, context: BehaviorContext) -> Iterator[tuple[Task, Snapshot]]:
        for task in context.tasks:
            yield from ((task, snapshot) for snapshot in self._train(context, task))

    def _train(self, context: BehaviorContext, task: Task) -> Iterator[Snapshot]:
        """Trains in chunks of steps and writes checkpoints between chunks, at the start of an episode.

        Several calls of SB3's `learn` give the same bits as one call.
        """
        settings, checkpoints = self.settings, context.checkpoints([task])
        episodes = KeyedResets(context, task)
        seed = keyed_seed(context.seed, context.environment.name, task.index, Purpose.BEHAVIOR)
        model = make_model(settings, episodes, seed=seed)
        steps_done = -1
        checkpoint = checkpoints.load()
        if checkpoint is not None:
            steps_done = restore(model, episodes, checkpoint)
            context.report(steps_done)
        for step in settings.snapshots:
            with checkpoints.training():
                while model.num_timesteps < step:
                    chunk = min(REPORT_EVERY * settings.train_frequency, step - model.num_timesteps)
                    if checkpoints.is_due():
                        if episodes.at_border:
                            checkpoints.save(capture(model, episodes))
                        else:
                            chunk = settings.train_frequency
                    model.learn(chunk, reset_num_timesteps=False)
                    context.report(chunk)
            if step > steps_done:
                yield snapshot_of_sac(model, step=step, observation=context.observation)


def make_model(settings: SacSettings, environment: gymnasium.Env[Any, Any], *, seed: int) -> "SAC":
    """Makes an untrained SAC; SB3 seeds the global generators of Python, NumPy and torch."""
    from stable_baselines3 import SAC
    from stable_baselines3.common.logger import Logger

    model = SAC(
        "MlpPolicy",
        environment,
        learning_rate=settings.learning_rate,
        buffer_size=min(settings.buffer_size, settings.steps),
        learning_starts=settings.warmup,
        batch_size=settings.batch_size,
        tau=settings.tau,
        gamma=settings.gamma,
        train_freq=settings.train_frequency,
        gradient_steps=settings.gradient_steps,
        ent_coef=settings.entropy,
        policy_kwargs={"net_arch": list(settings.hidden)},
        seed=seed,
        device="cpu",
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def snapshot_of_sac(model: "SAC", *, step: int, observation: ObservationView) -> Snapshot:
    """Makes a snapshot of a Stable-Baselines3 SAC's actor."""
    actor = model.policy.actor
    layers = [layer for layer in actor.latent_pi if hasattr(layer, "weight")]
    named = {f"hidden.{i}": layer for i, layer in enumerate(layers)} | {
        "mean": actor.mu,
        "log_std": actor.log_std,
    }
    tensors = {
        f"{name}.{kind}": getattr(layer, kind).detach().cpu().numpy().copy()
        for name, layer in named.items()
        for kind in ("weight", "bias")
    }
    return Snapshot.of_network(step, observation, tensors)


@final
class KeyedResets(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Gives every training episode its own keyed seed, so that it does not depend on earlier episodes.

    Attributes:
        episode: number of the current episode; -1 before the first.
        at_border: True if the current episode has no step yet.
    """

    def __init__(self, context: BehaviorContext, task: Task) -> None:
        super().__init__(
            context.environment.make(task.parameters, view=context.observation, reward=context.reward)
        )
        self._key = (context.seed, context.environment.name, task.index, Purpose.BEHAVIOR_RESET)
        self.episode = -1
        self.at_border = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self.episode += 1
        self.at_border = True
        return super().reset(seed=keyed_seed(*self._key, self.episode), options=options)

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        self.at_border = False
        return super().step(action)


def capture(model: "SAC", episodes: KeyedResets) -> TrainingState:
    """The state of a model whose current episode has no step yet."""
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


def restore(model: "SAC", episodes: KeyedResets, checkpoint: TrainingState) -> int:
    """Restores a checkpoint into a new model; returns its number of environment steps."""
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
    yield from ((f"policy.{name}", tensor) for name, tensor in model.policy.state_dict().items())
    if model.log_ent_coef is not None:
        yield "log_entropy_coefficient", model.log_ent_coef
    for name, optimizer in _optimizers(model).items():
        for index, state in optimizer.state_dict()["state"].items():
            yield from ((f"optimizer.{name}.{index}.{key}", value) for key, value in state.items())


def _prepare_optimizers(model: "SAC") -> None:
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
