"""What the tests of methods with a context ask of all of them."""

from collections.abc import Collection
from typing import Any, TypeVar

import torch
from torch import Tensor

from tcmrl_algo.algorithms.core.context import ContextAlgorithm, ContextLearner, ContextLosses
from tcmrl_algo.algorithms.core.method import METHODS
from tcmrl_algo.algorithms.core.problem import StagePlan
from tcmrl_data import Batch
from tests.made_up import batch, problem, settings

LearnerT = TypeVar("LearnerT", bound=ContextLearner)


def algorithm_of(name: str, config: dict[str, Any], **actor_critic: Any) -> ContextAlgorithm:
    """A method on the made-up problem, with its own stages."""
    method, shared = METHODS.get(name)(), settings(**actor_critic)
    own = method.Config.model_validate(config)
    stages = StagePlan(method.stages(shared, own), steps=shared.run.steps)
    made = method.create(problem(stages=stages), shared, own)
    assert isinstance(made, ContextAlgorithm)
    return made


def learner_of(kind: type[LearnerT], name: str, config: dict[str, Any]) -> LearnerT:
    """The context learner of a method on the made-up problem."""
    made = algorithm_of(name, config).learner
    assert isinstance(made, kind)
    return made


def losses_of(learner: ContextLearner, values: Batch | None = None, *, step: int = 1) -> ContextLosses:
    """The losses of a made-up batch, with draws that `step` decides."""
    return learner.losses(values or batch(), step, torch.Generator().manual_seed(step))


def gradients(module: torch.nn.Module, loss: Tensor, parts: Collection[str]) -> dict[str, float]:
    """The largest gradient of every part of a module, 0 where there is none."""
    names = [name for name, value in module.named_parameters() if value.requires_grad]
    values = [value for value in module.parameters() if value.requires_grad]
    found = torch.autograd.grad(loss, values, allow_unused=True, retain_graph=True)
    largest = dict.fromkeys(parts, 0.0)
    for name, gradient in zip(names, found, strict=True):
        (part,) = (part for part in parts if name == part or name.startswith(f"{part}."))
        largest[part] = max(largest[part], 0.0 if gradient is None else float(gradient.abs().max()))
    return largest


def moved(algorithm: ContextAlgorithm, values: Batch | None = None, *, step: int = 1) -> set[str]:
    """The parts of a learner that change in one update, all of them in some parameter."""
    before = {name: value.clone() for name, value in algorithm.learner.state_dict().items()}
    algorithm.update(values or batch(), step)
    after = algorithm.learner.state_dict()
    return {name.split(".")[0] for name, value in before.items() if not torch.equal(value, after[name])}
