"""What every method keeps: determinism, tensors, adaptation; and what FOCAL and the control are."""

from dataclasses import replace
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from tcmrl_algo.actor_critic.actor_critic import ActorCritic
from tcmrl_algo.algorithms import focal, no_context
from tcmrl_algo.context_methods.learner import (
    ContextAlgorithm,
    ContextController,
    ContextLearner,
    ContextLosses,
    pack,
)
from tcmrl_algo.losses import context as losses
from tcmrl_algo.methods.problem import Algorithm
from tcmrl_algo.networks.optimizer import Adam
from tcmrl_algo.training.config import ALGORITHMS
from tcmrl_data import (
    Batch,
    BatchRequest,
    Controller,
    Steps,
    Trajectories,
    Transitions,
    UniformController,
)
from tcmrl_data.foundation.plugins import modules
from tests.made_up import EPISODE, TASKS, batch, problem, settings, steps, trajectory, with_steps

FOUND = modules(ALGORITHMS)
BLIND = ("no_context",)
every = pytest.mark.parametrize("module", FOUND, ids=lambda module: module.NAME)


def make(module: ModuleType, *, seed: int = 0, **actor_critic: Any) -> Algorithm:
    made: Algorithm = module.create(problem(seed=seed), settings(**actor_critic), module.Config())
    return made


def request_of(module: ModuleType) -> BatchRequest:
    made: BatchRequest = module.batch_request(settings(), module.Config())
    return made


def batch_for(module: ModuleType) -> Batch:
    """What the sampler gives for the method's request: nothing beyond."""
    found: dict[str, Steps] = {}
    for seed, (name, kind) in enumerate(request_of(module).kinds.items()):
        length = EPISODE if isinstance(kind, Trajectories) else kind.length
        shape = (TASKS, kind.number) if isinstance(kind, Transitions) else (TASKS, kind.number, length)
        found[name] = steps(*shape, seed=seed)
    return Batch(torch.arange(TASKS), found)


@every
def test_a_method_is_one_file_with_four_names(module: ModuleType) -> None:
    assert module.__name__.rpartition(".")[2] == module.NAME
    assert module.Config.model_config == {"frozen": True, "extra": "forbid"}
    assert isinstance(request_of(module), BatchRequest)
    assert isinstance(make(module), Algorithm)


@every
def test_settings_are_documented(module: ModuleType) -> None:
    for name in module.Config.model_fields:
        assert f"{name}:" in (module.Config.__doc__ or "")


@every
def test_updates_are_a_function_of_seed_and_step(module: ModuleType) -> None:
    results = []
    for global_seed in (0, 1):
        torch.manual_seed(global_seed)
        method = make(module)
        for step in (1, 2, 3):
            metrics = method.update(batch_for(module), step)
            assert all(each.shape == () and torch.isfinite(each) for each in metrics.values())
        results.append(method.tensors())
    for name, each in results[0].items():
        assert torch.equal(each, results[1][name]), name
    other = make(module, seed=1).tensors()
    assert any(not torch.equal(each, results[0][name]) for name, each in other.items())


@every
@pytest.mark.parametrize("mode", ["off", "policy", "value"])
def test_a_learner_goes_on_from_its_tensors(module: ModuleType, mode: str) -> None:
    straight, first, second = (make(module, brac={"mode": mode}) for _ in range(3))
    for step in (1, 2, 3, 4):
        straight.update(batch_for(module), step)
    for step in (1, 2):
        first.update(batch_for(module), step)
    second.load_tensors({name: each.clone() for name, each in first.tensors().items()})
    for step in (3, 4):
        second.update(batch_for(module), step)
    expected, found = straight.tensors(), second.tensors()
    assert expected.keys() == found.keys()
    for name, each in expected.items():
        assert torch.equal(each, found[name]), name


@every
def test_adapted_controller_acts_by_each_lanes_trajectories(module: ModuleType) -> None:
    lanes = [[trajectory(6, 0)], [trajectory(4, 1), trajectory(2, 2)]]
    method = make(module)
    assert isinstance(method.explore([[], []]), UniformController)
    controller = method.adapt(lanes)
    states, noise = np.zeros((2, 3), dtype=np.float32), np.zeros((2, 2), dtype=np.float32)
    actions = controller.act(states, noise)
    assert actions.shape == (2, 2)
    assert np.abs(actions).max() <= 1
    assert np.allclose(actions[0], actions[1]) is (module.NAME in BLIND)
    np.testing.assert_array_equal(controller.act(states, noise + 1.0), actions)  # no exploration
    alone = [method.adapt([lane]).act(states[:1], noise[:1])[0] for lane in lanes]
    np.testing.assert_allclose(np.array(alone), actions, rtol=1e-4, atol=1e-6)  # neighbours play no part


def test_every_step_has_its_own_generator() -> None:
    places = [(1, 0), (2, 0), (1, 1), (1, 0)]
    draws = [torch.rand(3, generator=problem().generator(*each)) for each in places]
    assert torch.equal(draws[0], draws[3])
    assert not torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    assert not torch.equal(torch.rand(3, generator=problem(seed=1).generator(1)), draws[0])


def test_packed_trajectories_keep_their_steps_and_mask_the_rest() -> None:
    lanes = [[trajectory(6, 0)], [trajectory(4, 1), trajectory(2, 2)]]
    packed = pack(lanes, torch.device("cpu"))
    assert packed.mask.sum(dim=-1).tolist() == [[6, 0], [4, 2]]
    expected = torch.from_numpy(lanes[1][1].observations[1:])
    torch.testing.assert_close(packed.next_observations[1, 1, :2], expected)


def test_no_context_needs_no_trajectories() -> None:
    assert request_of(no_context) == BatchRequest(tasks=TASKS, kinds={"policy": Transitions(5)})


def focal_learner() -> ContextLearner:
    made = focal.create(problem(), settings(), focal.Config(latent=4, encoder_hidden=(8,)))
    assert isinstance(made, ContextAlgorithm)
    return made.learner


def test_focal_pulls_the_means_of_a_tasks_trajectories_together() -> None:
    made, values = focal_learner(), batch()
    assert isinstance(made, focal.FocalLearner)
    found = made.losses(values, 1, torch.Generator())
    groups = (made.encoder.read(values["context"]), made.encoder.read(values["execution"]))
    context, execution = made.encoder(*groups)
    single = torch.stack(
        [
            torch.stack([each[mask].mean(dim=0) for each, mask in zip(lane, real, strict=True)])
            for lane, real in zip(
                torch.cat([context, execution], dim=1),
                torch.cat([each.mask for each in groups], dim=1),
                strict=True,
            )
        ]
    )
    torch.testing.assert_close(found.total, losses.distance_metric_loss(single, epsilon=0.1))
    for lane, values_of in enumerate(context):
        torch.testing.assert_close(found.context[lane], values_of[groups[0].mask[lane]].mean(dim=0))


def test_focal_gathers_each_tasks_contexts() -> None:
    """The measured ratio of distances within and between tasks falls as it trains."""
    made = focal.create(problem(), settings(), focal.Config(latent=4, encoder_hidden=(16,)))
    assert isinstance(made, ContextAlgorithm)

    def shifted(values: Steps) -> Steps:
        offset = torch.arange(TASKS).view(TASKS, 1, 1) - 1.0
        return replace(values, rewards=values.rewards + offset)  # tasks differ in their reward

    values = batch(lengths=None)
    values = with_steps(values, context=shifted(values["context"]), execution=shifted(values["execution"]))

    def ratio() -> float:
        parts = (values["context"], values["execution"])
        contexts = torch.stack([made.learner.context(each) for each in parts]).detach()
        within = (contexts[0] - contexts[1]).norm(dim=-1).mean()
        between = (contexts[0].roll(1, 0) - contexts[1]).norm(dim=-1).mean()
        return float(within / between)

    before = ratio()
    for step in range(1, 60):
        made.update(values, step)
    assert ratio() < 0.5 * before


def test_a_learner_may_collect_and_optimise_in_its_own_way() -> None:
    """What CSRO needs: a network trained within `losses`, kept in checkpoints, and its own first episodes."""

    class Own(ContextLearner):
        latent = 0

        def __init__(self) -> None:
            super().__init__()
            self.inner = torch.nn.Linear(1, 1)
            self.adam = Adam(self.inner, learning_rate=0.1)

        def losses(self, batch: Batch, step: int, generator: torch.Generator) -> ContextLosses:
            self.adam.step(self.inner.weight.sum())
            zero = batch["policy"].rewards.new_zeros(())
            return ContextLosses(zero, zero.new_zeros(TASKS, 0), {})

        def context(self, steps: Steps) -> torch.Tensor:
            return steps.rewards.new_zeros(len(steps.rewards), 0)

        def optimizers(self) -> dict[str, Adam]:
            return {"inner": self.adam}

        def explore(self, actor_critic: ActorCritic, trajectories: Any) -> Controller:
            return ContextController(actor_critic, torch.zeros(len(trajectories), 0))

    method = ContextAlgorithm(problem(), settings(), learner=Own())
    before = method.learner.inner.weight.item()
    method.update(batch(), 1)
    assert method.learner.inner.weight.item() == pytest.approx(before - 0.1)  # one step of its own alone
    assert "optimizer/inner/weight/step" in method.tensors()
    assert isinstance(method.explore([[], []]), ContextController)
