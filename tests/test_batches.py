"""The stream of batches that a run learns from."""

from dataclasses import fields

import pytest
import torch

from tcmrl_algo import resolve
from tcmrl_algo.algorithms.core.problem import Stage, StagePlan
from tcmrl_algo.algorithms.core.settings import RunSettings
from tcmrl_algo.training.batches import JoinedBatches, StagedBatches, split_request
from tcmrl_algo.training.config import stage_plan
from tcmrl_data import (
    BatchRequest,
    Dataset,
    Sampler,
    Trajectories,
    Transitions,
    Windows,
    open_sampler,
)
from tests.small_training import small_batches


def open_with(dataset: Dataset, *overrides: str, algorithm: str = "tcmrl") -> StagedBatches:
    table = dataset.manifest.training["quick"]
    config = resolve(table, place="quick", algorithm=algorithm, overrides=overrides)
    return small_batches(dataset, config.settings.run, stage_plan(config))


def test_joined_batches_take_each_kind_from_its_selection(tiny: Dataset) -> None:
    last, whole = (tiny.select(split="train", snapshots=rule) for rule in ("last", "all"))
    stored = [trajectory for task in last.tasks for trajectory in last.trajectories(task.index)]
    own = {float(reward) for trajectory in stored for reward in trajectory.rewards}
    request = BatchRequest(
        tasks=3,
        kinds={
            "policy": Transitions(9),
            "context": Trajectories((1, 2)),
            "execution": Trajectories(1, apart_from="context"),
            "windows": Windows(2, length=2),
        },
    )
    samplers = zip((last, whole), split_request(request), strict=True)
    transitions, contexts = (open_sampler(selection, half, seed=0) for selection, half in samplers)
    joined = JoinedBatches(transitions, contexts)
    batches = [joined.batch(n) for n in range(10)]
    assert all(batch["policy"].rewards.shape == (3, 9) for batch in batches)
    assert all(set(batch["policy"].rewards.flatten().tolist()) <= own for batch in batches)
    for part in ("context", "execution", "windows"):
        seen = {value for batch in batches for value in batch[part].rewards.flatten().tolist()}
        assert not seen <= own, part
    assert joined.moments().reward_mean == transitions.moments().reward_mean


@pytest.mark.parametrize("rule", ["all", "last"])
def test_contexts_from_the_same_snapshots_are_those_of_one_selection(tiny: Dataset, rule: str) -> None:
    one = open_with(tiny, f"run.snapshots={rule}")
    two = open_with(tiny, f"run.snapshots={rule}", f"run.context_snapshots={rule}")
    assert isinstance(two._batches, JoinedBatches)
    for n in range(70):  # more than one block of draws
        first, second = one.batch(n), two.batch(n)
        assert set(first.names()) == set(second.names())
        for part in first.names():
            for field in fields(first[part]):
                found = [getattr(batch[part], field.name) for batch in (first, second)]
                assert found == [None, None] or torch.equal(*found), (n, part, field.name)


def test_a_policy_that_learns_from_trajectories_alone_sees_all_snapshots(tiny: Dataset) -> None:
    one = open_with(tiny, algorithm="borel")
    two = open_with(tiny, "run.context_snapshots=last", algorithm="borel")
    assert isinstance(two._batches, Sampler)
    for n in range(10):
        assert torch.equal(*(found.batch(n)["episodes"].rewards for found in (one, two)))


def test_an_algorithm_without_contexts_draws_none(tiny: Dataset) -> None:
    alone = open_with(tiny, "run.context_snapshots=last", algorithm="no_context")
    assert isinstance(alone._batches, Sampler)
    assert alone.batch(0).names() == ["policy"]


@pytest.mark.parametrize("context_snapshots", [None, "last"])
def test_every_stage_gets_what_it_requests_of_one_stream(
    tiny: Dataset, context_snapshots: str | None
) -> None:
    rows, episodes = {"rows": Transitions(3)}, {"episodes": Trajectories(1)}
    kinds = {"first": rows, "second": episodes, "third": rows | episodes}
    stages = [Stage(name, 2, BatchRequest(3, kind)) for name, kind in kinds.items()]
    run = RunSettings(context_snapshots=context_snapshots)

    def opened(chosen: list[Stage]) -> StagedBatches:
        return small_batches(tiny, run, StagePlan(chosen, steps=2 * len(chosen)))

    staged, whole = opened(stages), opened(stages[2:])
    names = [["rows"], ["rows"], ["episodes"], ["episodes"], ["rows", "episodes"], ["rows", "episodes"]]
    assert [sorted(staged.batch(n).names()) for n in range(6)] == [sorted(found) for found in names]
    assert torch.equal(staged.batch(4)["episodes"].rewards, whole.batch(4)["episodes"].rewards)
    assert staged.moments().reward_mean == whole.moments().reward_mean
