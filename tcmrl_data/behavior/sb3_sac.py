"""One Stable-Baselines3 SAC per task: its own replay buffer, entropy coefficient and seed."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Literal, final

import gymnasium
from pydantic import BaseModel, ConfigDict, Field, model_validator

from tcmrl_data.behavior import BehaviorContext, BehaviorSource
from tcmrl_data.seeding import Purpose, keyed_seed
from tcmrl_data.snapshot import Snapshot, snapshot_of_sac
from tcmrl_data.tasks import Task

NAME = "sac"
REPORT_EVERY = 100


class Settings(BaseModel):
    """The `[behavior.sac]` table; names as in Stable-Baselines3's SAC, defaults in the recipes.

    Attributes:
        hidden: widths of the actor's and the critics' ReLU layers.
        steps: environment steps of training.
        warmup: uniform random steps before the first update.
        snapshots: steps at which the policy is kept: 0 first, then none before the warm-up ends,
            since they would all be the same untrained policy, and `steps` last.
        train_frequency: environment steps between updates.
        gradient_steps: gradient steps per update.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    hidden: tuple[int, ...] = Field(min_length=1)
    steps: int = Field(ge=1)
    warmup: int = Field(ge=0)
    snapshots: tuple[int, ...] = Field(min_length=2)
    learning_rate: float = Field(gt=0)
    batch_size: int = Field(ge=1)
    gamma: float = Field(gt=0, lt=1)
    tau: float = Field(gt=0, le=1)
    buffer_size: int = Field(ge=1)
    train_frequency: int = Field(default=1, ge=1)
    gradient_steps: int = Field(default=1, ge=1)
    entropy: Literal["auto"] | float = "auto"

    @model_validator(mode="after")
    def _snapshots_fit(self) -> "Settings":
        steps = self.snapshots
        if steps[0] != 0 or list(steps) != sorted(set(steps)) or steps[-1] != self.steps:
            raise ValueError(f"snapshots must rise from 0 to steps ({self.steps}), got {list(steps)}")
        if steps[1] <= self.warmup:
            raise ValueError(f"snapshot {steps[1]} lies within the warm-up of {self.warmup} random steps")
        if any(step % self.train_frequency for step in steps):
            raise ValueError(f"snapshots must be multiples of train_frequency ({self.train_frequency})")
        return self


@final
class Source(BehaviorSource):
    """Trains the tasks of a unit one after another."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

    @property
    def steps(self) -> tuple[int, ...]:
        return self._settings.snapshots

    @property
    def training_steps(self) -> int:
        return self._settings.steps

    def snapshots(self, context: BehaviorContext) -> Iterator[tuple[Task, Snapshot]]:
        for task in context.tasks:
            yield from ((task, snapshot) for snapshot in self._train(context, task))

    def _train(self, context: BehaviorContext, task: Task) -> Iterator[Snapshot]:
        from stable_baselines3 import SAC
        from stable_baselines3.common.callbacks import ConvertCallback

        settings = self._settings
        model = SAC(
            "MlpPolicy",
            KeyedResets(context, task),
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
            seed=keyed_seed(context.seed, context.environment.name, task.index, Purpose.BEHAVIOR),
            device="cpu",
        )

        def count(values: dict[str, Any], _: dict[str, Any]) -> bool:
            if values["self"].num_timesteps % REPORT_EVERY == 0:
                context.report(REPORT_EVERY)
            return True

        yield snapshot_of_sac(model, step=0, observation=context.observation)
        for done, step in pairwise(settings.snapshots):
            model.learn(step - done, callback=ConvertCallback(count), reset_num_timesteps=False)
            yield snapshot_of_sac(model, step=step, observation=context.observation)


@final
class KeyedResets(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Resets the n-th training episode with its own keyed seed, so that episodes never depend on history."""

    def __init__(self, context: BehaviorContext, task: Task) -> None:
        super().__init__(
            context.environment.make(task.parameters, view=context.observation, reward=context.reward)
        )
        self._key = (context.seed, context.environment.name, task.index, Purpose.BEHAVIOR_RESET)
        self._episode = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        keyed = keyed_seed(*self._key, self._episode)
        self._episode += 1
        return super().reset(seed=keyed, options=options)
