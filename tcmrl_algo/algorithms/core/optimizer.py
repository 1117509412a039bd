"""Adam with a linear decay, whose whole state is named tensors, and one Adam for every stage of training."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import final

import torch
from torch import Tensor, nn

from tcmrl_algo.algorithms.core.problem import StagePlan
from tcmrl_algo.algorithms.core.settings import OptimizerSettings


@dataclass(frozen=True)
class ParameterGroup:
    """How some parameters learn, where they differ from the others.

    Attributes:
        learning_rate: at the first step; it decays as that of the others does.
        gradient_norm: bound of the norm of these parameters' gradient; None for none.
    """

    learning_rate: float
    gradient_norm: float | None = None


@dataclass
class _Memory:
    """What Adam remembers of a parameter: its steps, and the averages of its gradient and of the square."""

    parameter: nn.Parameter
    steps: int = 0
    average: Tensor = field(default_factory=lambda: torch.empty(0))
    square: Tensor = field(default_factory=lambda: torch.empty(0))


@final
class Adam:
    """Adam over named parameters.

    Args:
        parameters: as of `Module.named_parameters`; those without a gradient are left out.
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
        self._memories = {name: _Memory(value) for name, value in parameters if value.requires_grad}
        if not self._memories:
            raise ValueError("there is no parameter to train")
        self._final_share, self._decay_steps = final_share, decay_steps
        settings = {"": ParameterGroup(learning_rate, gradient_norm), **(groups or {})}
        members: dict[str, list[str]] = {prefix: [] for prefix in settings}
        for name in self._memories:
            members[max((prefix for prefix in settings if is_below(name, prefix)), key=len)].append(name)
        for prefix, group in members.items():
            if prefix and not group:
                raise ValueError(f"no parameter to train is named {prefix!r} or lies below it")
        self._groups = [
            (settings[prefix], [self._memories[name] for name in group])
            for prefix, group in members.items()
            if group
        ]

    def rates(self, steps_done: int) -> list[float]:
        """The learning rate of every group after so many steps."""
        progress = min(steps_done / self._decay_steps, 1.0)
        share = 1.0 - (1.0 - self._final_share) * progress
        return [own.learning_rate * share for own, _ in self._groups]

    def step(self, loss: Tensor, *, steps_done: int = 0) -> None:
        """One descent step of `loss`; the learning rates are a function of `steps_done` alone."""
        for memory in self._memories.values():
            memory.parameter.grad = None
        loss.backward()
        for (own, group), rate in zip(self._groups, self.rates(steps_done), strict=True):
            if own.gradient_norm is not None:
                nn.utils.clip_grad_norm_([memory.parameter for memory in group], own.gradient_norm)
            _descend([memory for memory in group if memory.parameter.grad is not None], rate)

    def tensors(self) -> dict[str, Tensor]:
        """Moments and step counts by parameter name; empty before the first step."""
        found = {}
        for name, memory in self._memories.items():
            if memory.steps:
                found[f"{name}/step"] = torch.tensor(float(memory.steps), device=memory.average.device)
                found[f"{name}/exp_avg"], found[f"{name}/exp_avg_sq"] = memory.average, memory.square
        return found

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        """Takes over what `tensors` returned."""
        for name, memory in self._memories.items():
            if f"{name}/step" in tensors:
                memory.steps = int(tensors[f"{name}/step"])
                memory.average, memory.square = (
                    tensors[f"{name}/{moment}"].to(memory.parameter.device, copy=True)
                    for moment in ("exp_avg", "exp_avg_sq")
                )


@torch.no_grad()
def _descend(memories: Sequence[_Memory], rate: float) -> None:
    """One step along the gradients, to the bit that of `torch.optim.Adam(fused=True)`.

    That class counts the steps of every parameter in a tensor of its own and reads its options anew in every
    step, which takes longer than the step itself where networks are small.
    """
    if not memories:
        return
    for memory in memories:
        if not memory.steps:
            memory.average, memory.square = (torch.zeros_like(memory.parameter) for _ in range(2))
        memory.steps += 1
    device = memories[0].parameter.device
    counts = {steps: torch.tensor(float(steps), device=device) for steps in {one.steps for one in memories}}
    torch._fused_adam_(
        [memory.parameter for memory in memories],
        [gradient for memory in memories if (gradient := memory.parameter.grad) is not None],
        [memory.average for memory in memories],
        [memory.square for memory in memories],
        [],
        [counts[memory.steps] for memory in memories],
        lr=rate,
        beta1=0.9,
        beta2=0.999,
        weight_decay=0.0,
        eps=1e-8,
        amsgrad=False,
        maximize=False,
    )


def is_below(name: str, prefix: str) -> bool:
    """Whether a parameter has a name or lies below the module of that name; "" is above all."""
    return not prefix or name == prefix or name.startswith(f"{prefix}.")


@final
class StagedOptimizer:
    """One Adam per stage over the parameters that the stage trains; all others are frozen meanwhile.

    Args:
        stages: the run's; the learning rate decays anew over every stage.
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
        self._stages, self._begun = stages, ""
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
        stage = self._stages.at(step).stage
        if stage != self._begun:
            for name, parameter in self._parameters.items():
                parameter.requires_grad_(name in self._trained[stage])
            self._begun = stage

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
