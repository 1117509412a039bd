"""Adam with a linear decay, whose whole state is named tensors."""

from collections.abc import Mapping
from typing import final

import torch
from torch import Tensor, nn

MOMENTS = ("step", "exp_avg", "exp_avg_sq")


@final
class Adam:
    """Adam over a module's trainable parameters.

    Args:
        module: what to train.
        learning_rate: at the first step.
        final_share: share of it that is left after `decay_steps`; it falls linearly and stays there.
        decay_steps: length of the decay.
        gradient_norm: gradients above this norm are scaled down to it; None leaves them.
    """

    def __init__(
        self,
        module: nn.Module,
        *,
        learning_rate: float,
        final_share: float = 1.0,
        decay_steps: int = 1,
        gradient_norm: float | None = None,
    ) -> None:
        self._parameters = {name: each for name, each in module.named_parameters() if each.requires_grad}
        self._learning_rate, self._final_share = learning_rate, final_share
        self._decay_steps, self._gradient_norm = decay_steps, gradient_norm
        self._adam = torch.optim.Adam(self._parameters.values(), lr=learning_rate, fused=True)

    def step(self, loss: Tensor, *, steps_done: int = 0) -> None:
        """One descent step of `loss`; the learning rate is a function of `steps_done` alone."""
        progress = min(steps_done / self._decay_steps, 1.0)
        self._adam.param_groups[0]["lr"] = self._learning_rate * (1.0 - (1.0 - self._final_share) * progress)
        self._adam.zero_grad(set_to_none=True)
        loss.backward()
        if self._gradient_norm is not None:
            nn.utils.clip_grad_norm_(self._parameters.values(), self._gradient_norm)
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
