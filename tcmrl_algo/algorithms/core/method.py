"""What a method is: a plug-in (`Method`) that makes a learner (`Algorithm`) for a problem."""

import abc
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from tcmrl_algo.algorithms.core.optimizer import Adam, ParameterGroup, StagedOptimizer
from tcmrl_algo.algorithms.core.problem import Problem, Stage
from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_data import Batch, BatchRequest, Controller, Trajectory, UniformController
from tcmrl_data.foundation.plugins import Registry
from tcmrl_data.foundation.records import Frozen

ConfigT = TypeVar("ConfigT", bound="MethodConfig")

Metrics = dict[str, Tensor]
"""Scalars of one training step, by flat names such as `loss/reward`."""

SettingValue = bool | int | float | str
"""A value of a training table that may be searched for."""


@dataclass(frozen=True)
class Options:
    """Some values of a setting; that of the training table is always among them.

    Attributes:
        values: the others, or all of them.
    """

    values: tuple[SettingValue, ...]


@dataclass(frozen=True)
class Factors:
    """A positive number of the training table times a factor, so that one space fits every environment.

    Attributes:
        low, high: range of the factor, around 1, which is drawn on a logarithmic scale.
    """

    low: float
    high: float


Search = Mapping[str, Options | Factors]
"""What is searched, by `section.key` as `--set` names it."""

SHARED_SEARCH: Search = {
    "optimizer.learning_rate": Factors(1 / 3, 3.0),
    "actor_critic.entropy": Factors(0.1, 10.0),
}
"""What all methods search that train the shared actor-critic, by equal ranges; a method may add to it."""


class MethodConfig(Frozen):
    """A method's own settings, `[training.<name>]`: none, or the fields of a subclass."""


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

    Its networks descend one loss per step; a method adds `loss` and `adapt`. Training, checkpoints and
    evaluation know no more of a method than this class and its `Method`.

    Args:
        networks: everything that is trained; moved to the problem's device.
        parts: what a stage trains, as of `StagedOptimizer`.
        groups: learning rates and bounds of their own, as of `StagedOptimizer`.
        optimizers: those that the method steps itself within `loss`, by name; checkpoints hold them too.
    """

    def __init__(
        self,
        problem: Problem,
        settings: TrainingSettings,
        networks: nn.Module,
        *,
        parts: Mapping[str, Collection[str]] | None = None,
        groups: Mapping[str, ParameterGroup] | None = None,
        optimizers: Mapping[str, Adam] | None = None,
    ) -> None:
        self.problem, self.networks = problem, networks.to(problem.device)
        self._optimizer = StagedOptimizer(
            self.networks, problem.stages, settings.optimizer, parts=parts, groups=groups
        )
        self._optimizers = {**self._optimizer.adams, **(optimizers or {})}

    @abc.abstractmethod
    def loss(self, batch: Batch, step: int) -> tuple[Float[Tensor, ""], Metrics]:
        """The loss of the networks in a step, and the metrics of the step.

        Args:
            step: counted from 1 over all stages; `Problem.stages` tells the stage.
        """

    def after_step(self, step: int) -> None:
        """Updates what no optimiser trains, such as momentum copies; does nothing unless overridden."""

    def update(self, batch: Batch, step: int) -> Metrics:
        """Does one training step, a function of the current tensors, the batch and the step's number."""
        self._optimizer.begin(step)
        loss, metrics = self.loss(batch, step)
        self._optimizer.step(loss, step)
        self.after_step(step)
        return {name: value.detach() for name, value in metrics.items()}

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

    def tensors(self) -> dict[str, Tensor]:
        """Everything that training changes: parameters, buffers, optimiser state, by name."""
        found = {f"module/all/{name}": value for name, value in self.networks.state_dict().items()}
        for name, optimizer in self._optimizers.items():
            found.update({f"optimizer/{name}/{key}": value for key, value in optimizer.tensors().items()})
        return {name: value.detach() for name, value in found.items()}

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        """Takes over what `tensors` returned, for evaluation or for going on with training."""
        self.networks.load_state_dict(_below(tensors, "module/all/"))
        for name, optimizer in self._optimizers.items():
            optimizer.load_tensors(_below(tensors, f"optimizer/{name}/"))


def _below(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


class FunctionController(Controller):
    """Acts by a function of observations, without exploration.

    Args:
        policy: actions (lanes, action_dim) in [-1, 1] for observations (lanes, observation_dim); called
            without gradients.
    """

    def __init__(self, policy: Callable[[Tensor], Tensor], device: torch.device) -> None:
        self._policy, self._device = policy, device

    def act(
        self, observations: np.typing.NDArray[np.floating], noise: np.typing.NDArray[np.floating]
    ) -> np.typing.NDArray[np.floating]:
        states = torch.as_tensor(observations, dtype=torch.float32, device=self._device)
        with torch.no_grad():
            actions: np.typing.NDArray[np.floating] = self._policy(states).cpu().numpy()
        return actions


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
