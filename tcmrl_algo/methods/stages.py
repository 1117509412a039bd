"""The stages of training: the parts that a stage trains, the batches it reads, and its length."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple, final

from torch import Tensor, nn

from tcmrl_algo.networks.optimizer import Adam, ParameterGroup, is_below
from tcmrl_algo.settings.optimizer import OptimizerSettings
from tcmrl_data import BatchRequest, TrainingError


@dataclass(frozen=True)
class Stage:
    """One stage of training.

    Attributes:
        name: unique within a method.
        steps: how many training steps it lasts.
        request: what its batches hold.
    """

    name: str
    steps: int
    request: BatchRequest


class StagePosition(NamedTuple):
    """Where a training step lies.

    Attributes:
        stage: name of its stage.
        step: its number within the stage, from 1.
        steps: how many steps the stage has.
    """

    stage: str
    step: int
    steps: int


@final
class StagePlan:
    """The stages of a run, one after the other.

    Args:
        stages: in the order of training.
        steps: of the whole run.

    Raises:
        TrainingError: no stage, a stage without a step, a name twice, or another sum of steps.
    """

    def __init__(self, stages: Collection[Stage], *, steps: int) -> None:
        self.stages, self.steps = tuple(stages), steps
        names = [stage.name for stage in stages]
        if len(set(names)) < len(names):
            raise TrainingError(f"stages {names} share a name; give every stage its own")
        described = ", ".join(f"{stage.name} {stage.steps}" for stage in stages)
        if any(stage.steps < 1 for stage in stages) or sum(stage.steps for stage in stages) != steps:
            raise TrainingError(
                f"the stages' steps ({described}) must be positive and sum to run.steps, {steps}; change "
                "run.steps, or the method's own steps, with --set"
            )

    def __iter__(self) -> Iterator[Stage]:
        return iter(self.stages)

    def at(self, step: int) -> StagePosition:
        """The position of a training step, from 1; beyond the last stage's end, that stage goes on."""
        before = 0
        for stage in self.stages[:-1]:
            if step <= before + stage.steps:
                return StagePosition(stage.name, step - before, stage.steps)
            before += stage.steps
        last = self.stages[-1]
        return StagePosition(last.name, step - before, last.steps)


@final
class StagedOptimizer:
    """One Adam per stage over the parameters that the stage trains; all others are frozen meanwhile.

    Args:
        module: holds everything that is trained.
        stages: the run's; the learning rate decays anew over every stage.
        settings: `[training.optimizer]`.
        parts: what a stage trains, by its name: names of parameters, or of modules above them. A stage that
            is missing trains everything.
        groups: rates and bounds of their own, as of `Adam`, in the stages that train them.

    Attributes:
        adams: the optimisers by stage.
    """

    def __init__(
        self,
        module: nn.Module,
        stages: StagePlan,
        settings: OptimizerSettings,
        *,
        parts: Mapping[str, Collection[str]] | None = None,
        groups: Mapping[str, ParameterGroup] | None = None,
    ) -> None:
        self._stages = stages
        self._parameters = {name: value for name, value in module.named_parameters() if value.requires_grad}
        self._trained = {stage.name: self._below((parts or {}).get(stage.name, ("",))) for stage in stages}
        self.adams = {
            stage.name: Adam(
                self._trained[stage.name].items(),
                learning_rate=settings.learning_rate,
                final_share=settings.final_share,
                decay_steps=stage.steps,
                gradient_norm=settings.gradient_norm,
                groups=self._groups_of(stage.name, groups or {}),
            )
            for stage in stages
        }

    def begin(self, step: int) -> None:
        """Freezes what the step's stage does not train; call it before the step's losses are computed."""
        trained = self._trained[self._stages.at(step).stage]
        for name, parameter in self._parameters.items():
            parameter.requires_grad_(name in trained)

    def step(self, loss: Tensor, step: int) -> None:
        """One descent step of `loss` by the Adam of the stage in which `step` lies."""
        position = self._stages.at(step)
        self.adams[position.stage].step(loss, steps_done=position.step - 1)

    def _below(self, prefixes: Collection[str]) -> dict[str, nn.Parameter]:
        return {
            name: parameter
            for name, parameter in self._parameters.items()
            if any(is_below(name, prefix) for prefix in prefixes)
        }

    def _groups_of(self, stage: str, groups: Mapping[str, ParameterGroup]) -> dict[str, ParameterGroup]:
        trained = self._trained[stage]
        return {
            prefix: group
            for prefix, group in groups.items()
            if any(is_below(name, prefix) for name in trained)
        }
