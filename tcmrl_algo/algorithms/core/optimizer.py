"""Adam with a linear decay, whose whole state is named tensors, and one Adam for every stage of training."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import final

import torch
from torch import Tensor, nn

from tcmrl_algo.algorithms.core.problem import StagePlan
from tcmrl_algo.algorithms.core.settings import OptimizerSettings

MOMENTS = ("step", "exp_avg", "exp_avg_sq")


@dataclass(frozen=True)
class ParameterGroup:
    """How some parameters learn, where they differ from the others.

    Attributes:
        learning_rate: at the first step; it decays as that of the others does.
        gradient_norm: bound of the norm of these parameters' gradient; None for none.
    """

    learning_rate: float
    gradient_norm: float | None = None


@final
class Adam:
    """Adam over named parameters.

    Args:
        parameters: as of `Module.named_parameters`; those without a gradient are left out.
        learning_rate: at the first step.
        final_share: share of it at and after `decay_steps`; the rate falls linearly until then.
        decay_steps: length of the decay.
        gradient_norm: gradients above this norm are scaled down to it; None leaves them.
        groups: rates and bounds of their own, by the name of a parameter or of a module above it. The longest
            name that fits decides. The bound above counts the parameters of no group alone.

    Raises:
        ValueError: there is no parameter to train, or a group without one.
    """

    def __init__(
        self,
        parameters: Iterable[tuple[str, nn.Parameter]],
        *,
        learning_rate: float,
        final_share: float = 1.0,
        decay_steps: int = 1,
        gradient_norm: float | None = None,
        groups: Mapping[str, ParameterGroup] | None = None,
    ) -> None:
        self._parameters = {name: value for name, value in parameters if value.requires_grad}
        self._final_share, self._decay_steps = final_share, decay_steps
        settings = {"": ParameterGroup(learning_rate, gradient_norm), **(groups or {})}
        members: dict[str, list[nn.Parameter]] = {prefix: [] for prefix in settings}
        for name, parameter in self._parameters.items():
            members[max((prefix for prefix in settings if is_below(name, prefix)), key=len)].append(parameter)
        for prefix, group in members.items():
            if prefix and not group:
                raise ValueError(f"no parameter to train is named {prefix!r} or lies below it")
        self._groups = [(settings[prefix], group) for prefix, group in members.items() if group]
        self._adam = torch.optim.Adam(
            [{"params": group, "lr": own.learning_rate} for own, group in self._groups], fused=True
        )

    def step(self, loss: Tensor, *, steps_done: int = 0) -> None:
        """One descent step of `loss`; the learning rates are a function of `steps_done` alone."""
        progress = min(steps_done / self._decay_steps, 1.0)
        share = 1.0 - (1.0 - self._final_share) * progress
        for values, (own, _) in zip(self._adam.param_groups, self._groups, strict=True):
            values["lr"] = own.learning_rate * share
        self._adam.zero_grad(set_to_none=True)
        loss.backward()
        for own, group in self._groups:
            if own.gradient_norm is not None:
                nn.utils.clip_grad_norm_(group, own.gradient_norm)
        self._adam.step()

    def tensors(self) -> dict[str, Tensor]:
        """Moments and step counts by parameter name; empty before the first step."""
        return {
            f"{name}/{moment}": self._adam.state[parameter][moment]
            for name, parameter in self._parameters.items()
            for moment in MOMENTS
            if parameter in self._adam.state
        }

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        """Takes over what `tensors` returned."""
        for name, parameter in self._parameters.items():
            if f"{name}/step" in tensors:
                self._adam.state[parameter] = {
                    moment: tensors[f"{name}/{moment}"].to(parameter.device, copy=True) for moment in MOMENTS
                }


def is_below(name: str, prefix: str) -> bool:
    """Whether a parameter has a name or lies below the module of that name; "" is above all."""
    return not prefix or name == prefix or name.startswith(f"{prefix}.")


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
