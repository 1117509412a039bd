"""The offline actor-critic: bounds, which loss trains which network, targets, BRAC."""

from dataclasses import replace
from types import ModuleType

import pytest
import torch

from tcmrl_algo.algorithms.core.actor_critic import sac as sac_module
from tcmrl_algo.algorithms.core.actor_critic.base import value_bounds
from tcmrl_algo.algorithms.core.actor_critic.sac import SoftActorCritic
from tcmrl_algo.algorithms.core.settings import ActorCriticSettings
from tests.made_up import TASKS, problem, steps


def test_value_bounds_are_geometric_sums_of_the_extreme_rewards() -> None:
    bounds = value_bounds(ActorCriticSettings(gamma=0.5, reward_scale=3.0, entropy=0.0), problem())
    assert bounds == pytest.approx((-12.0, 6.0))  # 3 * -2 * 2 and 3 * 1 * 2


@pytest.mark.parametrize(("clip", "same"), [(True, True), (False, False)])
def test_next_values_beyond_the_bounds_count_as_the_bound(clip: bool, same: bool) -> None:
    made = ActorCriticSettings(hidden=(8,), clip_targets=clip)
    actor_critic = SoftActorCritic(made, problem(), latent=2, generator=torch.Generator().manual_seed(0))
    rows = actor_critic.rows(steps(TASKS, 5, seed=1), torch.zeros(TASKS, 2))
    found = []
    for factor in (2.0, 3.0):
        with torch.no_grad():
            actor_critic.target_value.layers[-1].bias.fill_(factor * actor_critic.bounds[1] + 1e3)
        found.append(actor_critic.losses(rows, torch.Generator().manual_seed(0))[1]["loss/critic"].item())
    assert (found[0] == found[1]) is same


def test_each_loss_trains_its_own_network() -> None:
    actor_critic = SoftActorCritic(
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
            for name, parameter in actor_critic.named_parameters()
            if parameter.grad is not None and parameter.grad.any()
        }
        assert touched == {network}


def test_target_follows_by_tau() -> None:
    made = ActorCriticSettings(hidden=(8,), tau=0.25)
    actor_critic = SoftActorCritic(made, problem(), latent=0, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        actor_critic.value.layers[-1].bias.fill_(4.0)
        actor_critic.target_value.layers[-1].bias.fill_(0.0)
    actor_critic.after_step()
    assert actor_critic.target_value.layers[-1].bias.item() == pytest.approx(1.0)


def test_dual_critic_tells_a_far_policy_from_behavior_and_alpha_rises() -> None:
    brac = {"mode": "policy", "alpha": 1.0, "learning_rate": 1e-2, "steps": 3, "penalty": 0.1}
    made = ActorCriticSettings.model_validate({"hidden": (16,), "brac": brac})
    actor_critic = SoftActorCritic(made, problem(), latent=0, generator=torch.Generator().manual_seed(0))
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


def test_value_mode_lowers_each_states_target_by_its_own_divergence(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, list[torch.Tensor]] = {}

    def spy(module: ModuleType, name: str, place: int) -> None:
        real = getattr(module, name)

        def call(*arguments: torch.Tensor, **named: float) -> torch.Tensor:
            result: torch.Tensor = real(*arguments, **named)
            seen.setdefault(name, []).append(result if place < 0 else arguments[place])
            return result

        monkeypatch.setattr(module, name, call)

    spy(sac_module, "value_loss", 1)  # the targets of V
    spy(sac_module, "q_loss", 3)  # V(s'), as Q's targets see it
    spy(sac_module, "dual_divergence", -1)
    for mode in ("policy", "value"):
        made = ActorCriticSettings.model_validate({"hidden": (8,), "brac": {"mode": mode, "alpha": 7.0}})
        actor_critic = SoftActorCritic(made, problem(), latent=0, generator=torch.Generator().manual_seed(0))
        with torch.no_grad():
            actor_critic.target_value.layers[-1].bias.fill_(-1e6)
        rows = actor_critic.rows(steps(TASKS, 5, seed=1), torch.zeros(TASKS, 0))
        actor_critic.losses(rows, torch.Generator().manual_seed(0))
    without, with_penalty = seen["value_loss"]
    divergences = seen["dual_divergence"][1]
    torch.testing.assert_close(without - with_penalty, 7.0 * divergences)
    assert divergences.std() > 0
    lowest = actor_critic.bounds[0]  # the lowest return of the rewards; a penalised value may be lower
    assert (seen["q_loss"][0] == lowest).all() and (seen["q_loss"][1] < lowest).all()


def test_the_limit_of_q_is_a_multiple_of_what_rewards_allow() -> None:
    made = ActorCriticSettings(gamma=0.5, reward_scale=3.0, entropy=0.0, divergence_factor=10.0, hidden=(8,))
    actor_critic = SoftActorCritic(made, problem(), latent=0, generator=torch.Generator())
    assert actor_critic.limits() == pytest.approx({"actor_critic/largest_q": 120.0})  # 10 * max(12, 6)
    small = ActorCriticSettings(reward_scale=1e-9, entropy=0.0, divergence_factor=10.0, hidden=(8,))
    limits = SoftActorCritic(small, problem(), latent=0, generator=torch.Generator()).limits()
    assert limits == {"actor_critic/largest_q": 10.0}


def test_the_largest_q_is_that_of_any_critic_and_row() -> None:
    made = ActorCriticSettings(hidden=(8,))
    actor_critic = SoftActorCritic(made, problem(), latent=0, generator=torch.Generator().manual_seed(0))
    rows = actor_critic.rows(steps(TASKS, 5, seed=1), torch.zeros(TASKS, 0))
    with torch.no_grad():
        actor_critic.critics.members[1].layers[-1].bias.fill_(-500.0)
    _, metrics = actor_critic.losses(rows, torch.Generator().manual_seed(0))
    assert metrics["actor_critic/largest_q"].item() == pytest.approx(500.0, abs=5.0)


@pytest.mark.parametrize("critic_gradient", [False, True])
def test_the_critics_gradient_reaches_contexts_only_where_asked(critic_gradient: bool) -> None:
    made = ActorCriticSettings.model_validate({"hidden": (8,), "brac": {"mode": "value"}})
    actor_critic = SoftActorCritic(made, problem(), latent=2, generator=torch.Generator().manual_seed(0))
    context = torch.ones(TASKS, 2, requires_grad=True)
    rows = actor_critic.rows(steps(TASKS, 5, seed=1), context, critic_gradient=critic_gradient)
    _, metrics = actor_critic.losses(rows, torch.Generator().manual_seed(0))
    reached = {}
    for name in ("loss/critic", "loss/value", "loss/policy"):
        (gradient,) = torch.autograd.grad(metrics[name], context, retain_graph=True, allow_unused=True)
        reached[name] = gradient is not None and bool(gradient.any())
    assert reached == {"loss/critic": critic_gradient, "loss/value": False, "loss/policy": False}
    detached = actor_critic.rows(steps(TASKS, 5, seed=1), context.detach())
    torch.testing.assert_close(rows.critic_inputs, detached.inputs)


def test_a_context_of_every_step_stands_beside_its_step_and_padding_is_left_out() -> None:
    made = ActorCriticSettings(hidden=(8,))
    actor_critic = SoftActorCritic(made, problem(), latent=1, generator=torch.Generator().manual_seed(0))
    episodes = steps(TASKS, 2, 6, seed=1, lengths=(6, 4, 5))
    numbers = torch.arange(episodes.mask.numel()).view(*episodes.mask.shape, 1).float()
    rows = actor_critic.rows(episodes, numbers, numbers + 0.5)
    expected = numbers[episodes.mask]
    assert len(expected) == 30
    torch.testing.assert_close(rows.inputs[:, -1:], expected)
    torch.testing.assert_close(rows.next_inputs[:, -1:], expected + 0.5)
    torch.testing.assert_close(rows.actions, episodes.actions[episodes.mask])
    torch.testing.assert_close(rows.rewards, episodes.rewards[episodes.mask] * made.reward_scale)
    same = actor_critic.rows(episodes, torch.zeros(TASKS, 1))
    torch.testing.assert_close(rows.inputs[:, :-1], same.inputs[:, :-1])
