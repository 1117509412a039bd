"""The tensors of a learner by name, for checkpoints."""

from collections.abc import Mapping
from typing import Any, final

from torch import Tensor, nn

from tcmrl_algo.networks.optimizer import Adam


@final
class TrainedModules:
    """Modules and their optimisers as one flat set of named tensors, for `Algorithm.tensors`."""

    def __init__(self, modules: Mapping[str, nn.Module], optimizers: Mapping[str, Adam]) -> None:
        self._modules, self._optimizers = modules, optimizers

    def tensors(self) -> dict[str, Tensor]:
        """Detached tensors, named `module/…` and `optimizer/…`."""
        found: dict[str, Any] = {}
        for name, module in self._modules.items():
            found.update({f"module/{name}/{key}": value for key, value in module.state_dict().items()})
        for name, optimizer in self._optimizers.items():
            found.update({f"optimizer/{name}/{key}": value for key, value in optimizer.tensors().items()})
        return {name: value.detach() for name, value in found.items()}

    def load_tensors(self, tensors: Mapping[str, Tensor]) -> None:
        """Takes over what `tensors` returned."""
        for name, module in self._modules.items():
            module.load_state_dict(_below(tensors, f"module/{name}/"))
        for name, optimizer in self._optimizers.items():
            optimizer.load_tensors(_below(tensors, f"optimizer/{name}/"))


def _below(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
