"""Stages of training: order, optimisers, schedules, and frozen networks."""

import pytest
import torch
from torch import Tensor

from tcmrl_algo.algorithms.core.optimizer import ParameterGroup, StagedOptimizer
from tcmrl_algo.algorithms.core.problem import Stage, StagePlan
from tcmrl_algo.algorithms.core.settings import OptimizerSettings
from tcmrl_data import BatchRequest, TrainingError, Transitions

REQUEST = BatchRequest(2, {"rows": Transitions(1)})


def plan(**steps: int) -> StagePlan:
    stages = [Stage(name, number, REQUEST) for name, number in steps.items()]
    return StagePlan(stages, steps=sum(steps.values()))


def networks() -> torch.nn.ModuleDict:
    return torch.nn.ModuleDict({name: torch.nn.Linear(1, 1, bias=False) for name in ("a", "b")})


def loss_of(layers: torch.nn.ModuleDict) -> Tensor:
    return torch.stack([layer.weight.sum() for layer in layers.values()]).sum()


def weights(layers: torch.nn.ModuleDict) -> dict[str, float]:
    return {name: layer.weight.item() for name, layer in layers.items()}


def test_steps_count_from_one_in_every_stage_and_the_last_one_goes_on() -> None:
    made = plan(first=2, second=3)
    places = [tuple(made.at(step)) for step in (1, 2, 3, 5, 7)]
    assert places == [
        ("first", 1, 2), ("first", 2, 2), ("second", 1, 3), ("second", 3, 3), ("second", 5, 3)
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("names", "steps", "expected"),
    [
        (("a", "b"), (4, 5), r"\(a 4, b 5\).*sum to run.steps, 10"),
        (("a", "b"), (11, -1), r"positive"),
        (("a", "a"), (5, 5), r"share a name"),
        ((), (), r"sum to run.steps, 10"),
    ],
)
def test_stages_that_make_no_run_are_refused(names: tuple[str], steps: tuple[int], expected: str) -> None:
    stages = [Stage(name, number, REQUEST) for name, number in zip(names, steps, strict=True)]
    with pytest.raises(TrainingError, match=expected):
        StagePlan(stages, steps=10)


def test_every_stage_trains_its_parts_by_its_own_adam_and_freezes_the_others() -> None:
    layers, stages = networks(), plan(first=2, second=2)
    parts = {"first": ("a",), "second": ("b",)}
    settings = OptimizerSettings(learning_rate=1.0, final_share=0.0)
    made = StagedOptimizer(layers, stages, settings, parts=parts)
    moved = []
    for step in (1, 2, 3, 4):
        before = weights(layers)
        made.begin(step)
        made.step(loss_of(layers), step)
        moved.append({name: before[name] - value for name, value in weights(layers).items()})
        frozen = {name for name, layer in layers.items() if not layer.weight.requires_grad}
        assert frozen == ({"b"} if step < 3 else {"a"})
    # Under a constant gradient, the length of Adam's steps is its rate, which decays within every stage.
    assert [found["a"] for found in moved] == pytest.approx([1.0, 0.5, 0.0, 0.0], rel=1e-4)
    assert [found["b"] for found in moved] == pytest.approx([0.0, 0.0, 1.0, 0.5], rel=1e-4)
    assert {name: sorted(adam.tensors()) for name, adam in made.adams.items()} == {
        stage: [f"{part}.weight/{kind}" for kind in ("exp_avg", "exp_avg_sq", "step")]
        for stage, part in (("first", "a"), ("second", "b"))
    }


def test_a_group_holds_in_the_stages_that_train_it() -> None:
    layers, stages = networks(), plan(first=1, second=1)
    made = StagedOptimizer(
        layers,
        stages,
        OptimizerSettings(learning_rate=1.0),
        parts={"first": ("a",)},
        groups={"b": ParameterGroup(learning_rate=0.25)},
    )
    before = weights(layers)
    for step in (1, 2):
        made.begin(step)
        made.step(loss_of(layers), step)
    after = weights(layers)
    assert before["a"] - after["a"] == pytest.approx(2.0, rel=1e-4)
    assert before["b"] - after["b"] == pytest.approx(0.25, rel=1e-4)
