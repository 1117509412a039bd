"""The stream of batches that a run learns from."""

from dataclasses import fields

import pytest
import torch

from tcmrl_algo import resolve
from tcmrl_algo.training.batches import Batches, JoinedBatches, only_transitions, open_batches
from tcmrl_algo.training.train import batch_request
from tcmrl_data import (
    BatchRequest,
    Dataset,
    Sampler,
    Trajectories,
    Transitions,
    Windows,
    open_sampler,
)


def open_with(dataset: Dataset, *overrides: str, algorithm: str = "tcmrl") -> Batches:
    table = dataset.manifest.training["quick"]
    config = resolve(table, place="quick", algorithm=algorithm, overrides=overrides)
    return open_batches(
        dataset,
        config.settings.run,
        batch_request(config),
        seed=0,
        device=torch.device("cpu"),
        memory_limit=None,
        say=lambda message: None,
    )


def test_joined_batches_take_each_kind_from_its_selection(tiny: Dataset) -> None:
    last, whole = (tiny.select(split="train", snapshots=each) for each in ("last", "all"))
    stored = [each for task in last.tasks for each in last.trajectories(task.index)]
    own = {float(reward) for each in stored for reward in each.rewards}
    request = BatchRequest(
        tasks=3,
        kinds={
            "policy": Transitions(9),
            "context": Trajectories((1, 2)),
            "execution": Trajectories(1, apart_from="context"),
            "windows": Windows(2, length=2),
        },
    )
    transitions = open_sampler(last, only_transitions(request), seed=0)
    joined = JoinedBatches(transitions, open_sampler(whole, request, seed=0))
    batches = [joined.batch(n) for n in range(10)]
    assert all(each["policy"].rewards.shape == (3, 9) for each in batches)
    assert all(set(each["policy"].rewards.flatten().tolist()) <= own for each in batches)
    for part in ("context", "execution", "windows"):
        seen = {value for each in batches for value in each[part].rewards.flatten().tolist()}
        assert not seen <= own, part
    assert joined.moments().reward_mean == transitions.moments().reward_mean


@pytest.mark.parametrize("rule", ["all", "last"])
def test_contexts_from_the_same_snapshots_are_those_of_one_selection(tiny: Dataset, rule: str) -> None:
    one = open_with(tiny, f"run.snapshots={rule}")
    two = open_with(tiny, f"run.snapshots={rule}", f"run.context_snapshots={rule}")
    assert isinstance(two, JoinedBatches)
    for n in range(70):  # more than one block of draws
        first, second = one.batch(n), two.batch(n)
        assert set(first.names()) == set(second.names())
        for part in first.names():
            for each in fields(first[part]):
                found = [getattr(batch[part], each.name) for batch in (first, second)]
                assert torch.equal(*found), (n, part, each.name)


def test_an_algorithm_without_contexts_draws_none(tiny: Dataset) -> None:
    alone = open_with(tiny, "run.context_snapshots=last", algorithm="no_context")
    assert isinstance(alone, Sampler)
    assert alone.batch(0).names() == ["policy"]
