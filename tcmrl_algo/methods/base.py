"""What a method is: a plug-in (`Method`) that makes a learner (`Algorithm`) for a problem."""

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

from pydantic import BaseModel, ConfigDict
from torch import Tensor

from tcmrl_algo.methods.problem import Problem
from tcmrl_algo.methods.search import SHARED_SEARCH, Search
from tcmrl_algo.methods.stages import Stage
from tcmrl_algo.settings.training import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Controller, Trajectory, UniformController
from tcmrl_data.foundation.plugins import Registry

ConfigT = TypeVar("ConfigT", bound="MethodConfig")
Metrics = dict[str, Tensor]
"""Scalars of one training step, by flat names such as `loss/reward`."""


class MethodConfig(BaseModel):
    """A method's own settings, `[training.<name>]`: none, or the fields of a subclass."""

    model_config = ConfigDict(frozen=True, extra="forbid")


@dataclass(frozen=True)
class Capabilities:
    """What evaluation and the conformance tests may expect of a method.

    Attributes:
        blind: trajectories do not change how it acts.
        explores: it can collect its first episodes in its own way instead of uniformly.
        explores_by_default: one that explores does so under its default settings.
        noisy_contexts: the contexts that it trains on are drawn with noise.
        stateful: its controllers adapt within an episode.
        privileged: it may see task parameters, as a control; every record of its runs says so.
        needs_trajectories: it cannot adapt without a trajectory.
    """

    blind: bool = False
    explores: bool = False
    explores_by_default: bool = True
    noisy_contexts: bool = False
    stateful: bool = False
    privileged: bool = False
    needs_trajectories: bool = True


class Algorithm(abc.ABC):
    """A meta-learner: trained on batches, then adapted to a task by trajectories of that task.

    Training, checkpoints and evaluation know no more of a method than this class and its `Method`.
    """

    @abc.abstractmethod
    def update(self, batch: Batch, step: int) -> Metrics:
        """Does one training step, a function of the current tensors, the batch and the step's number.

        Args:
            batch: holds what the step's stage requested.
            step: counted from 1 over all stages; `Problem.stages` tells the stage.
        """

    def limits(self) -> Mapping[str, float]:
        """Size beyond which a metric says that learning diverges, for some of them; training stops there."""
        return {}

    @abc.abstractmethod
    def adapt(
        self, trajectories: Sequence[Sequence[Trajectory]], *, privileged: Tensor | None = None
    ) -> Controller:
        """A controller without exploration; lane i is adapted to the task that `trajectories[i]` show.

        Args:
            trajectories: at least one per lane, unless `Capabilities.needs_trajectories` is False.
            privileged: (lanes, parameters) standardised task parameters; None for methods without that
                capability.
        """

    def explore(self, trajectories: Sequence[Sequence[Trajectory]]) -> Controller:
        """Acts in the first stage of the protocol `paper`; uniformly, unless a method collects otherwise.

        Args:
            trajectories: those that lane i has collected so far; none at first.
        """
        return UniformController()

    def latents(self, trajectories: Sequence[Sequence[Trajectory]]) -> Tensor | None:
        """Contexts of lanes as vectors (lanes, latent), whose distances a protocol may compare.

        None for a method that does not adapt through such a vector.
        """
        return None

    @abc.abstractmethod
    def tensors(self) -> dict[str, Tensor]:
        """Everything that training changes: parameters, buffers, optimiser state, by name."""

    @abc.abstractmethod
    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        """Takes over what `tensors` returned, for evaluation or for going on with training."""


class Method(abc.ABC, Generic[ConfigT]):
    """A method as a plug-in: a stateless object, created without arguments.

    A package declares it as an entry point of the group `tcmrl.algorithms`, under `name`.

    Attributes:
        name: as `--algo` and a recipe's `[training.<name>]` table spell it.
        Config: the method's own settings; its docstring documents every field.
        capabilities: what evaluation may expect.
        search: the settings that `tcmrl tune` searches, by their place in the training table.

    Example:
        >>> METHODS.get("focal").name
        'focal'
    """

    name: ClassVar[str]
    Config: ClassVar[type[MethodConfig]] = MethodConfig
    capabilities: ClassVar[Capabilities] = Capabilities()
    search: ClassVar[Search] = SHARED_SEARCH

    @abc.abstractmethod
    def batch_request(self, settings: TrainingSettings, config: ConfigT) -> BatchRequest:
        """What a batch holds in training; with several stages, in the last one."""

    def stages(self, settings: TrainingSettings, config: ConfigT) -> tuple[Stage, ...]:
        """The stages of training, whose steps sum to `settings.run.steps`; one, unless overridden."""
        return (Stage("train", settings.run.steps, self.batch_request(settings, config)),)

    @abc.abstractmethod
    def create(self, problem: Problem, settings: TrainingSettings, config: ConfigT) -> Algorithm:
        """A new learner, its networks at their start."""


METHODS: Registry[Method[Any]] = Registry(
    "tcmrl.algorithms",
    "algorithm",
    Method,
)
