"""The methods on made-up batches: who trains whom, masks, contexts, the actor-critic, BRAC."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tcmrl_algo.actor_critic import ActorCritic, ActorCriticSettings, value_bounds
from tcmrl_algo.algorithms import no_context, tcmrl
from tcmrl_algo.config import TrainingSettings
from tcmrl_algo.context_algorithm import pack
from tcmrl_algo.problem import Problem
from tcmrl_data import Batch, BatchSizes, Steps, Trajectory

TASKS, EPISODE = 3, 6
SMALL: dict[str, Any] = {"latent": 4, "encoder_hidden": (8,), "tce_hidden": (8,), "estimator_hidden": (8,)}
ONLY = dict.fromkeys(tcmrl.Weights.model_fields, 0.0)


def problem(*, sparse: bool = False, seed: int = 0) -> Problem:
    return Problem(
        environment="made-up",
        observation_dim=3,
        action_dim=2,
        horizon=EPISODE,
        reward_density="sparse" if sparse else "dense",
        observation_mean=torch.zeros(3),
        observation_std=torch.ones(3),
        change_mean=torch.zeros(3),
        change_std=torch.full((3,), 0.5),
        action_mean=torch.zeros(2),
        action_std=torch.ones(2),
        reward_mean=0.0,
        reward_std=1.0,
        reward_range=(-2.0, 1.0),
        seed=seed,
        steps=100,
        device=torch.device("cpu"),
    )


def settings(**actor_critic: Any) -> TrainingSettings:
    return TrainingSettings.model_validate(
        {
            "batch": {"tasks": TASKS, "transitions": 5, "execution_trajectories": 1, "window_length": 2},
            "optimizer": {"learning_rate": 1e-2},
            "actor_critic": {"hidden": (8,), **actor_critic},
        }
    )


def learner(config: dict[str, Any] | None = None, *, sparse: bool = False, **more: Any) -> tcmrl.Tcmrl:
    made = tcmrl.create(
        problem(sparse=sparse), settings(**more), tcmrl.Config.model_validate(SMALL | (config or {}))
    )
    assert isinstance(made, tcmrl.Tcmrl)
    return made


def steps(*shape: int, seed: int, lengths: tuple[int, ...] | None = None) -> Steps:
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *more: torch.randn(*shape, *more, generator=generator)  # noqa: E731
    mask = torch.ones(shape, dtype=torch.bool)
    for task, length in enumerate(lengths or ()):
        mask[task, :, length:] = False
    return Steps(draw(3), draw(2).tanh(), draw(), draw(3), torch.zeros(shape), mask)


def batch(*, lengths: tuple[int, ...] | None = (6, 4, 5), trajectories: int = 2) -> Batch:
    return Batch(
        task_indices=torch.arange(TASKS),
        transitions=steps(TASKS, 5, seed=1),
        context=steps(TASKS, trajectories, EPISODE, seed=2, lengths=lengths),
        execution=steps(TASKS, 1, EPISODE, seed=3, lengths=lengths),
        windows=steps(TASKS, 0, 2, seed=4),
    )


def scramble(values: Steps) -> Steps:
    """The same real steps with other padding."""

    def other(each: Tensor) -> Tensor:
        mask = values.mask.reshape(values.mask.shape + (1,) * (each.ndim - values.mask.ndim))
        return torch.where(mask, each, each + 3.0)

    return replace(
        values,
        observations=other(values.observations),
        actions=other(values.actions),
        rewards=other(values.rewards),
        next_observations=other(values.next_observations),
    )


def gradients(weights: dict[str, float]) -> dict[str, float]:
    """Largest gradient of each part of the context learner under one loss term alone."""
    method = learner({"weights": ONLY | weights})
    total, _, _ = method.context_losses(batch(), torch.Generator().manual_seed(0))
    total.backward()  # type: ignore[no-untyped-call]
    found: dict[str, float] = {}
    for name, parameter in method.learner.named_parameters():
        size = 0.0 if parameter.grad is None else parameter.grad.abs().max().item()
        part = name.split(".")[0]
        found[part] = max(found.get(part, 0.0), size)
    return found


def test_positive_loss_trains_encoder_extractor_and_estimator() -> None:
    found = gradients({"positive": 1.0})
    assert min(found["encoder"], found["extractor"], found["estimator"]) > 1e-6
    assert found["similarity"] == 0.0


@pytest.mark.parametrize("sparse", [False, True])
def test_negative_loss_leaves_the_estimator_untouched(sparse: bool) -> None:
    method = learner({"weights": ONLY | {"negative": 1.0}}, sparse=sparse)
    total, _, _ = method.context_losses(batch(), torch.Generator().manual_seed(0))
    total.backward()  # type: ignore[no-untyped-call]
    for parameter in method.learner.estimator.parameters():
        assert parameter.grad is None or not parameter.grad.any()
    for part in (method.learner.encoder, method.learner.extractor):
        assert max(each.grad.abs().max() for each in part.parameters() if each.grad is not None) > 1e-7


def test_sparsity_and_contrastive_train_what_they_should() -> None:
    found = gradients({"sparsity": 1.0})
    assert min(found["encoder"], found["extractor"]) > 1e-6
    assert found["estimator"] == found["similarity"] == 0.0
    found = gradients({"contrastive": 1.0})
    assert min(found["encoder"], found["similarity"]) > 1e-6
    assert found["estimator"] == 0.0
    found = gradients({"distance": 1.0})
    assert min(found["encoder"], found["extractor"]) > 1e-6


def test_actor_critic_losses_never_reach_the_context() -> None:
    method = learner({"weights": ONLY})
    before = {name: each.clone() for name, each in method.learner.state_dict().items()}
    method.update(batch(), 1)
    for name, each in method.learner.state_dict().items():
        assert torch.equal(each, before[name]), name


def test_an_update_moves_everything_that_learns_w_included() -> None:
    method = learner()
    torch.testing.assert_close(method.learner.similarity.detach(), torch.eye(4))
    before = {name: each.clone() for name, each in method.tensors().items() if name.startswith("module/")}
    metrics = method.update(batch(), 1)
    assert all(torch.isfinite(each) for each in metrics.values())
    after = method.tensors()
    parameters = [name for name, _ in method.learner.named_parameters()]
    for name in parameters:
        assert not torch.equal(after[f"module/all/context.{name}"], before[f"module/all/context.{name}"]), (
            name
        )
    assert not torch.allclose(method.learner.similarity, torch.eye(4))


@pytest.mark.parametrize("sparse", [False, True])
def test_padding_changes_neither_losses_nor_contexts(sparse: bool) -> None:
    method = learner({"negative_noise": 0.0, "weights": {"orthogonality": 1.0}}, sparse=sparse)
    plain, padded = batch(), batch()
    padded = replace(padded, context=scramble(padded.context), execution=scramble(padded.execution))
    first, context, terms = method.context_losses(plain, torch.Generator())
    second, other, _ = method.context_losses(padded, torch.Generator())
    torch.testing.assert_close(context, other)
    torch.testing.assert_close(first, second)
    assert {"positive", "negative", "sparsity", "contrastive", "distance", "orthogonality"} == {
        name.removeprefix("loss/") for name in terms if name.startswith("loss/")
    }


def test_contexts_never_see_execution_trajectories() -> None:
    method = learner({"weights": ONLY | {"positive": 1.0}})
    plain = batch()
    other = replace(plain, execution=steps(TASKS, 1, EPISODE, seed=33))
    first, context, _ = method.context_losses(plain, torch.Generator())
    second, same, _ = method.context_losses(other, torch.Generator())
    torch.testing.assert_close(context, same)
    assert first.item() != second.item()  # rewards are estimated on them


def test_order_of_tasks_changes_no_context_and_no_loss() -> None:
    method, order = learner({"negative_noise": 0.0}), torch.tensor([2, 0, 1])
    plain = batch()

    def permuted(values: Steps) -> Steps:
        return Steps(*(getattr(values, name)[order] for name in values.__dataclass_fields__))

    moved = replace(plain, context=permuted(plain.context), execution=permuted(plain.execution))
    first, context, _ = method.context_losses(plain, torch.Generator())
    second, other, _ = method.context_losses(moved, torch.Generator())
    torch.testing.assert_close(context[order], other)
    torch.testing.assert_close(first, second)


def test_literal_equation_6_adds_nothing_to_any_gradient() -> None:
    method = learner({"sparsity": "literal", "weights": ONLY | {"sparsity": 1.0}})
    total, _, _ = method.context_losses(batch(), torch.Generator())
    total.backward()  # type: ignore[no-untyped-call]
    assert total.item() == pytest.approx(1.0)
    grads = [each.grad for each in method.learner.parameters() if each.grad is not None]
    assert max(each.abs().max() for each in grads) < 1e-7


def test_sampled_windows_replace_those_of_the_context() -> None:
    made = settings()
    made = made.model_copy(update={"batch": made.batch.model_copy(update={"windows": 4})})
    method = tcmrl.Tcmrl(problem(), made, tcmrl.Config.model_validate(SMALL))
    windows = replace(batch(), windows=steps(TASKS, 4, 2, seed=7))
    other = replace(batch(), windows=steps(TASKS, 4, 2, seed=8))
    first = method.context_losses(windows, torch.Generator())[2]["loss/contrastive"]
    second = method.context_losses(other, torch.Generator())[2]["loss/contrastive"]
    assert first.item() != second.item()


def test_updates_are_a_function_of_seed_and_step() -> None:
    results = []
    for global_seed in (0, 1):
        torch.manual_seed(global_seed)
        method = learner()
        for step in (1, 2, 3):
            method.update(batch(), step)
        results.append(method.tensors())
    for name, each in results[0].items():
        assert torch.equal(each, results[1][name]), name
    other = tcmrl.Tcmrl(problem(seed=1), settings(), tcmrl.Config.model_validate(SMALL))
    assert not torch.equal(
        other.learner.encoder.perceptron.layers[0].weight,
        results[0]["module/all/context.encoder.perceptron.layers.0.weight"],
    )


def test_every_step_has_its_own_generator() -> None:
    draws = [torch.rand(3, generator=problem().generator(step)) for step in (1, 2, 1)]
    assert torch.equal(draws[0], draws[2])
    assert not torch.equal(draws[0], draws[1])
    assert not torch.equal(torch.rand(3, generator=problem(seed=1).generator(1)), draws[0])


@pytest.mark.parametrize("mode", ["off", "policy", "value"])
def test_a_learner_goes_on_from_its_tensors(mode: str) -> None:
    straight, first, second = (learner(brac={"mode": mode}) for _ in range(3))
    for step in (1, 2, 3, 4):
        straight.update(batch(), step)
    for step in (1, 2):
        first.update(batch(), step)
    second.load_tensors({name: each.clone() for name, each in first.tensors().items()})
    for step in (3, 4):
        second.update(batch(), step)
    expected, found = straight.tensors(), second.tensors()
    assert expected.keys() == found.keys()
    for name, each in expected.items():
        assert torch.equal(each, found[name]), name


def trajectory(length: int, seed: int) -> Trajectory:
    random = np.random.default_rng(seed)
    ended = np.zeros(length, dtype=bool)
    return Trajectory(
        random.normal(size=(length + 1, 3)).astype(np.float32),
        random.uniform(-1, 1, (length, 2)).astype(np.float32),
        random.normal(size=length).astype(np.float32),
        ended,
        ended,
    )


def test_packed_trajectories_keep_their_steps_and_mask_the_rest() -> None:
    lanes = [[trajectory(6, 0)], [trajectory(4, 1), trajectory(2, 2)]]
    packed = pack(lanes, torch.device("cpu"))
    assert packed.mask.sum(dim=-1).tolist() == [[6, 0], [4, 2]]
    expected = torch.from_numpy(lanes[1][1].observations[1:])
    torch.testing.assert_close(packed.next_observations[1, 1, :2], expected)


def test_contexts_of_lanes_do_not_depend_on_their_neighbours() -> None:
    method = learner()
    lanes = [[trajectory(6, 0)], [trajectory(4, 1), trajectory(2, 2)]]
    together = method.context(lanes)
    for lane, context in zip(lanes, together, strict=True):
        torch.testing.assert_close(method.context([lane])[0], context)
    assert not torch.allclose(together[0], together[1])


def test_adapted_controller_acts_by_each_lanes_context() -> None:
    method = learner()
    controller = method.adapt([[trajectory(6, 0)], [trajectory(6, 1)]])
    noise = np.zeros((2, 2), dtype=np.float32)
    actions = controller.act(np.zeros((2, 3), dtype=np.float32), noise)
    assert actions.shape == (2, 2)
    assert np.abs(actions).max() <= 1
    assert not np.allclose(actions[0], actions[1])
    np.testing.assert_array_equal(controller.act(np.zeros((2, 3), np.float32), noise + 1.0), actions)


def test_no_context_needs_no_trajectories_and_ignores_them() -> None:
    made = settings()
    assert no_context.batch_sizes(made) == BatchSizes(
        tasks=TASKS, transitions=5, context_trajectories=(1,), execution_trajectories=0, window_length=2
    )
    method = no_context.create(problem(), made, no_context.Config())
    metrics = method.update(batch(), 1)
    assert all(torch.isfinite(each) for each in metrics.values())
    actions = method.adapt([[trajectory(6, 0)], [trajectory(6, 1)]]).act(
        np.zeros((2, 3), dtype=np.float32), np.zeros((2, 2), dtype=np.float32)
    )
    np.testing.assert_array_equal(actions[0], actions[1])


def test_value_bounds_are_geometric_sums_of_the_extreme_rewards() -> None:
    bounds = value_bounds(ActorCriticSettings(gamma=0.5, reward_scale=3.0, entropy=0.0), problem())
    assert bounds == pytest.approx((-12.0, 6.0))  # 3 * -2 * 2 and 3 * 1 * 2


@pytest.mark.parametrize(("clip", "same"), [(True, True), (False, False)])
def test_next_values_beyond_the_bounds_count_as_the_bound(clip: bool, same: bool) -> None:
    made = ActorCriticSettings(hidden=(8,), clip_targets=clip)
    actor_critic = ActorCritic(made, problem(), latent=2, generator=torch.Generator().manual_seed(0))
    rows = actor_critic.rows(steps(TASKS, 5, seed=1), torch.zeros(TASKS, 2))
    found = []
    for factor in (2.0, 3.0):
        with torch.no_grad():
            actor_critic.target_value.layers[-1].bias.fill_(factor * actor_critic.bounds[1] + 1e3)
        found.append(actor_critic.losses(rows, torch.Generator().manual_seed(0))[1]["loss/critic"].item())
    assert (found[0] == found[1]) is same


def test_each_loss_trains_its_own_network() -> None:
    actor_critic = ActorCritic(
        ActorCriticSettings(hidden=(8,), mean_regularization=0.0, std_regularization=0.0),
        problem(),
        latent=2,
        generator=torch.Generator().manual_seed(0),
    )
    rows = actor_critic.rows(steps(TASKS, 5, seed=1), torch.zeros(TASKS, 2))
    own = {"loss/critic": "critics", "loss/value": "value", "loss/policy": "policy"}
    for loss, network in own.items():
        actor_critic.zero_grad()
        _, metrics = actor_critic.losses(rows, torch.Generator().manual_seed(0))
        metrics[loss].backward()  # type: ignore[no-untyped-call]
        touched = {
            name.split(".")[0]
            for name, each in actor_critic.named_parameters()
            if each.grad is not None and each.grad.any()
        }
        assert touched == {network}


def test_target_follows_by_tau() -> None:
    made = ActorCriticSettings(hidden=(8,), tau=0.25)
    actor_critic = ActorCritic(made, problem(), latent=0, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        actor_critic.value.layers[-1].bias.fill_(4.0)
        actor_critic.target_value.layers[-1].bias.fill_(0.0)
    actor_critic.after_step()
    assert actor_critic.target_value.layers[-1].bias.item() == pytest.approx(1.0)


def test_dual_critic_tells_a_far_policy_from_behavior_and_alpha_rises() -> None:
    brac = {"mode": "policy", "alpha": 1.0, "learning_rate": 1e-2, "steps": 3, "penalty": 0.1}
    made = ActorCriticSettings.model_validate({"hidden": (16,), "brac": brac})
    actor_critic = ActorCritic(made, problem(), latent=0, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():  # the policy acts near (1, 1), the data near (0, 0)
        actor_critic.policy.perceptron.layers[-1].bias.copy_(torch.tensor([3.0, 3.0, -3.0, -3.0]))
    data = steps(TASKS, 50, seed=1)
    rows = actor_critic.rows(replace(data, actions=data.actions * 0.1), torch.zeros(TASKS, 0))
    for step in range(100):
        actor_critic.train_dual(rows, torch.Generator().manual_seed(step))
    _, metrics = actor_critic.losses(rows, torch.Generator().manual_seed(0))
    assert metrics["actor_critic/divergence"].item() > 0.5
    actor_critic.after_step()
    assert actor_critic.brac is not None
    assert actor_critic.brac.alpha.item() > 1.0
