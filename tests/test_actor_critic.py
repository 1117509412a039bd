"""The offline actor-critics: bounds, which loss trains which network, targets, BRAC."""

from dataclasses import replace
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

from tcmrl_algo.algorithms.core.actor_critic import sac as sac_module
from tcmrl_algo.algorithms.core.actor_critic.base import ActorCritic, ConditionedRows, value_bounds
from tcmrl_algo.algorithms.core.actor_critic.sac import SoftActorCritic
from tcmrl_algo.algorithms.core.context import make_actor_critic
from tcmrl_algo.algorithms.core.settings import ActorCriticSettings
from tests.made_up import TASKS, problem, steps

CRITICS = pytest.mark.parametrize("kind", ["sac", "iql"])
TARGETS = {"sac": ("value", "target_value"), "iql": ("critics", "target_critics")}


def made(kind: str, latent: int = 2, **table: Any) -> ActorCritic:
    settings = ActorCriticSettings.model_validate({"kind": kind, "hidden": (8,), **table})
    return make_actor_critic(settings, problem(), latent=latent, generator=torch.Generator().manual_seed(0))


def soft(latent: int = 0, **table: Any) -> SoftActorCritic:
    actor_critic = made("sac", latent, **table)
    assert isinstance(actor_critic, SoftActorCritic)
    return actor_critic


def rows_of(actor_critic: ActorCritic, number: int = 5) -> ConditionedRows:
    return actor_critic.rows(
        steps(TASKS, number, seed=1), torch.ones(TASKS, actor_critic.latent) * torch.arange(3.0).view(3, 1)
    )


def metrics_of(actor_critic: ActorCritic, rows: ConditionedRows) -> dict[str, Tensor]:
    return actor_critic.losses(rows, torch.Generator().manual_seed(0))[1]


def last_bias(network: Any) -> Tensor:
    """The bias of the last layer of a perceptron, or of the first of several."""
    found: Tensor = getattr(network, "members", [network])[0].layers[-1].bias
    return found


def test_value_bounds_are_geometric_sums_of_the_extreme_rewards() -> None:
    bounds = value_bounds(ActorCriticSettings(gamma=0.5, reward_scale=3.0, entropy=0.0), problem())
    assert bounds == pytest.approx((-12.0, 6.0))  # 3 * -2 * 2 and 3 * 1 * 2
    settings = ActorCriticSettings(kind="iql", gamma=0.5, reward_scale=3.0)
    assert value_bounds(settings, problem()) == pytest.approx((-12.0, 6.0))  # no bonus where none is paid
    assert value_bounds(ActorCriticSettings(gamma=0.5, reward_scale=3.0), problem())[1] > 6.5


@CRITICS
@pytest.mark.parametrize("clip", [True, False])
def test_next_values_beyond_the_bounds_count_as_the_bound(kind: str, clip: bool) -> None:
    actor_critic, found = made(kind, clip_targets=clip), []
    value = getattr(actor_critic, {"sac": "target_value", "iql": "value"}[kind])
    for factor in (2.0, 3.0):
        with torch.no_grad():
            last_bias(value).fill_(factor * actor_critic.bounds[1] + 1e3)  # type: ignore[operator, index]
        found.append(metrics_of(actor_critic, rows_of(actor_critic))["loss/critic"].item())
    assert (found[0] == found[1]) is clip


@CRITICS
def test_each_loss_trains_its_own_network_and_never_the_targets(kind: str) -> None:
    actor_critic = made(kind)
    own = {"loss/critic": "critics", "loss/value": "value", "loss/policy": "policy"}
    for loss, network in own.items():
        actor_critic.zero_grad()
        metrics_of(actor_critic, rows_of(actor_critic))[loss].backward()  # type: ignore[no-untyped-call]
        touched = {
            name.split(".")[0]
            for name, parameter in actor_critic.named_parameters()
            if parameter.grad is not None and parameter.grad.any()
        }
        assert touched == {network}


@CRITICS
def test_targets_follow_by_tau(kind: str) -> None:
    actor_critic = made(kind, latent=0, tau=0.25)
    network, target = (last_bias(getattr(actor_critic, name)) for name in TARGETS[kind])
    with torch.no_grad():
        network.fill_(4.0)
        target.fill_(0.0)
    actor_critic.after_step()
    assert target[0].item() == pytest.approx(1.0)
    assert not actor_critic.optimizers()


def test_dual_critic_tells_a_far_policy_from_behavior_and_alpha_rises() -> None:
    brac = {"mode": "policy", "alpha": 1.0, "learning_rate": 1e-2, "steps": 3, "penalty": 0.1}
    actor_critic = soft(hidden=(16,), brac=brac)
    with torch.no_grad():  # the policy acts near (1, 1), the data near (0, 0)
        actor_critic.policy.perceptron.layers[-1].bias.copy_(torch.tensor([3.0, 3.0, -3.0, -3.0]))
    data = steps(TASKS, 50, seed=1)
    rows = actor_critic.rows(replace(data, actions=data.actions * 0.1), torch.zeros(TASKS, 0))
    for step in range(100):
        actor_critic.train_dual(rows, torch.Generator().manual_seed(step))
    assert metrics_of(actor_critic, rows)["actor_critic/divergence"].item() > 0.5
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
        actor_critic = soft(brac={"mode": mode, "alpha": 7.0})
        with torch.no_grad():
            actor_critic.target_value.layers[-1].bias.fill_(-1e6)
        metrics_of(actor_critic, rows_of(actor_critic))
    without, with_penalty = seen["value_loss"]
    divergences = seen["dual_divergence"][1]
    torch.testing.assert_close(without - with_penalty, 7.0 * divergences)
    assert divergences.std() > 0
    lowest = actor_critic.bounds[0]  # the lowest return of the rewards; a penalised value may be lower
    assert (seen["q_loss"][0] == lowest).all() and (seen["q_loss"][1] < lowest).all()


@CRITICS
def test_the_limit_of_q_is_a_multiple_of_what_rewards_allow(kind: str) -> None:
    shared = {"entropy": 0.0, "divergence_factor": 10.0}
    limits = made(kind, gamma=0.5, reward_scale=3.0, **shared).limits()
    assert limits == pytest.approx({"actor_critic/largest_q": 120.0})  # 10 * max(12, 6)
    assert made(kind, reward_scale=1e-9, **shared).limits() == {"actor_critic/largest_q": 10.0}


def test_the_largest_q_is_that_of_any_critic_and_row() -> None:
    actor_critic = soft()
    with torch.no_grad():
        last_bias(actor_critic.critics.members[1]).fill_(-500.0)
    metrics = metrics_of(actor_critic, rows_of(actor_critic))
    assert metrics["actor_critic/largest_q"].item() == pytest.approx(500.0, abs=5.0)


@pytest.mark.parametrize("critic_gradient", [False, True])
@pytest.mark.parametrize(("kind", "brac"), [("sac", "value"), ("iql", "off"), ("bc", "off")])
def test_the_gradient_reaches_contexts_only_where_asked(kind: str, brac: str, critic_gradient: bool) -> None:
    """Through Q's loss alone, and through the likelihood in `bc`, which has no Q."""
    actor_critic = made(kind, brac={"mode": brac})
    context = torch.ones(TASKS, 2, requires_grad=True)
    rows = actor_critic.rows(steps(TASKS, 5, seed=1), context, critic_gradient=critic_gradient)
    reached = set()
    for name, value in metrics_of(actor_critic, rows).items():
        if name.startswith("loss/") and value.requires_grad:
            (gradient,) = torch.autograd.grad(value, context, retain_graph=True, allow_unused=True)
            reached |= {name} if gradient is not None and bool(gradient.any()) else set()
    training = "loss/policy" if kind == "bc" else "loss/critic"
    assert reached == ({training} if critic_gradient else set())
    detached = actor_critic.rows(steps(TASKS, 5, seed=1), context.detach())
    torch.testing.assert_close(rows.critic_inputs, detached.inputs)


def test_a_context_of_every_step_stands_beside_its_step_and_padding_is_left_out() -> None:
    actor_critic = made("sac", latent=1)
    episodes = steps(TASKS, 2, 6, seed=1, lengths=(6, 4, 5))
    numbers = torch.arange(episodes.mask.numel()).view(*episodes.mask.shape, 1).float()
    rows = actor_critic.rows(episodes, numbers, numbers + 0.5)
    expected = numbers[episodes.mask]
    assert len(expected) == 30
    torch.testing.assert_close(rows.inputs[:, -1:], expected)
    torch.testing.assert_close(rows.next_inputs[:, -1:], expected + 0.5)
    torch.testing.assert_close(rows.actions, episodes.actions[episodes.mask])
    torch.testing.assert_close(
        rows.rewards, episodes.rewards[episodes.mask] * actor_critic.settings.reward_scale
    )
    same = actor_critic.rows(episodes, torch.zeros(TASKS, 1))
    torch.testing.assert_close(rows.inputs[:, :-1], same.inputs[:, :-1])
