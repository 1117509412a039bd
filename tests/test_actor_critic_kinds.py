"""`actor_critic.kind`: equations of `iql` and `bc`, what trains what, and that every method takes both."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tcmrl_cli.train import tcmrl
from torch import Tensor

from tcmrl_algo.algorithms.core.actor_critic.bc import BehaviorCloning
from tcmrl_algo.algorithms.core.actor_critic.iql import ImplicitQLearning, advantage_weights, expectile_loss
from tcmrl_algo.algorithms.core.actor_critic.sac import value_loss
from tcmrl_algo.algorithms.core.context import KINDS
from tcmrl_algo.algorithms.core.losses import gaussian_log_likelihood, likelihood_loss
from tcmrl_algo.algorithms.core.networks import LIKELIHOOD_LOG_STD, LikelihoodPolicy
from tcmrl_algo.algorithms.core.settings import ActorCriticSettings
from tests.commands import in_process
from tests.made_up import TASKS, random, steps
from tests.test_actor_critic import made, metrics_of, rows_of

NEW_KINDS = ["iql", "bc"]


def test_expectile_loss_weighs_targets_above_by_tau_and_below_by_the_rest() -> None:
    values, targets = torch.tensor([0.0, 2.0, 1.0]), torch.tensor([2.0, 1.0, 1.0])
    loss = expectile_loss(values, targets, expectile=0.7)
    assert loss.item() == pytest.approx((0.7 * 4 + 0.3 * 1 + 0.0) / 3)
    half = expectile_loss(values, targets, expectile=0.5)
    assert half.item() == pytest.approx(value_loss(values, targets).item() / 2)


def test_the_expectile_of_two_targets_is_where_its_gradient_vanishes() -> None:
    """With targets 0 and 1: 0.7 (1 - v) = 0.3 v, hence v = 0.7."""
    value = torch.tensor(0.7, requires_grad=True)
    expectile_loss(value.expand(2), torch.tensor([0.0, 1.0]), expectile=0.7).backward()  # type: ignore[no-untyped-call]
    assert value.grad is not None
    assert value.grad.item() == pytest.approx(0.0, abs=1e-7)


def test_advantage_weights_are_exponential_in_standard_deviations_and_capped() -> None:
    """Advantages -1 and 1 have the unbiased standard deviation sqrt(2)."""
    found = advantage_weights(torch.tensor([-1.0, 1.0]), inverse_temperature=2.0, largest=100.0)
    assert found.tolist() == pytest.approx([math.exp(-math.sqrt(2)), math.exp(math.sqrt(2))], rel=1e-5)
    scaled = advantage_weights(torch.tensor([-50.0, 50.0]), inverse_temperature=2.0, largest=100.0)
    assert scaled.tolist() == pytest.approx(found.tolist(), rel=1e-5)  # the unit of rewards is gone
    shifted = advantage_weights(torch.tensor([0.0, 2.0]), inverse_temperature=2.0, largest=100.0)
    assert shifted.tolist() == pytest.approx([1.0, math.exp(2 * math.sqrt(2))], rel=1e-5)  # not centered
    capped = advantage_weights(torch.tensor([0.0, 2.0]), inverse_temperature=2.0, largest=3.0)
    assert capped.tolist() == pytest.approx([1.0, 3.0], rel=1e-5)
    equal = advantage_weights(torch.zeros(4), inverse_temperature=3.0, largest=100.0)
    assert equal.tolist() == [1.0] * 4


def test_gaussian_log_likelihood_sums_dimensions_and_is_finite_at_the_bounds() -> None:
    actions, means = torch.tensor([[1.0, -1.0]]), torch.tensor([[0.0, -1.0]])
    found = gaussian_log_likelihood(actions, means, torch.tensor([0.0, math.log(0.5)]))
    # -(1/2) - log(2 pi)/2, and log 2 - log(2 pi)/2
    assert found.item() == pytest.approx(-0.5 + math.log(2.0) - math.log(2 * math.pi))
    expected = torch.distributions.Normal(means, torch.tensor([1.0, 0.5])).log_prob(actions).sum()
    torch.testing.assert_close(found.sum(), expected)


def test_likelihood_loss_is_the_weighted_mean_and_weights_get_no_gradient() -> None:
    weights = torch.tensor([2.0, 0.0], requires_grad=True)
    likelihoods = torch.tensor([-1.0, -9.0], requires_grad=True)
    loss = likelihood_loss(likelihoods, weights)
    assert loss.item() == 1.0  # -(2 * -1 + 0) / 2
    loss.backward()  # type: ignore[no-untyped-call]
    assert weights.grad is None
    assert likelihoods.grad is not None and likelihoods.grad.tolist() == [-1.0, 0.0]


DIFFERENTIABLE: dict[str, tuple[Any, tuple[Tensor, ...]]] = {
    "expectile": (
        lambda v: expectile_loss(v, random(5, seed=3).detach(), expectile=0.7),
        (random(5),),
    ),
    "gaussian": (
        lambda m, s: gaussian_log_likelihood(random(3, 2, seed=3).detach(), m, s),
        (random(3, 2), random(2, seed=1)),
    ),
    "likelihood": (
        lambda p: likelihood_loss(p, random(4, seed=1).detach().exp()),
        (random(4),),
    ),
}


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_gradients_are_right(name: str) -> None:
    function, inputs = DIFFERENTIABLE[name]
    assert torch.autograd.gradcheck(function, inputs)


def test_no_gradient_reaches_targets_or_advantages() -> None:
    targets, advantages = random(4), random(4, seed=1)
    expectile_loss(random(4, seed=2), targets, expectile=0.7).backward()  # type: ignore[no-untyped-call]
    assert targets.grad is None
    assert not advantage_weights(advantages, inverse_temperature=1.0, largest=9.0).requires_grad


def test_the_likelihood_policy_starts_at_a_standard_deviation_of_one_and_stays_within_bounds() -> None:
    policy = LikelihoodPolicy(3, 2, hidden=(8,), generator=torch.Generator().manual_seed(0))
    inputs = 10.0 * random(7, 3).detach().float()
    means, log_std = policy(inputs)
    assert means.abs().max() < 1 and torch.equal(means, policy.most_likely(inputs))
    assert log_std.exp().tolist() == pytest.approx([1.0, 1.0], abs=0.15)  # softplus bends the middle a little
    low, high = LIKELIHOOD_LOG_STD
    for extreme in (-1e3, 1e3):
        with torch.no_grad():
            policy.free_log_std.fill_(extreme)
        assert all(low <= value <= high + 0.01 for value in policy(inputs)[1].tolist())


def test_every_kind_has_its_class_and_the_default_is_the_published_one() -> None:
    assert ActorCriticSettings().kind == "sac"
    assert set(KINDS) == {"sac", "iql", "bc"}
    for kind, expected in KINDS.items():
        assert isinstance(made(kind), expected)


def test_iql_follows_its_equations() -> None:
    """Networks replaced by constants: Q' = 3 and 2, V = 1 everywhere, means 0, log std 0."""
    actor_critic = made("iql", gamma=0.5, reward_scale=2.0, clip_targets=False, latent=0)
    assert isinstance(actor_critic, ImplicitQLearning)
    with torch.no_grad():
        for parameter in actor_critic.parameters():
            parameter.zero_()
        for member, bias in zip(actor_critic.target_critics.members, (3.0, 2.0), strict=True):
            member.layers[-1].bias.fill_(bias)  # type: ignore[union-attr, operator]
        actor_critic.value.layers[-1].bias.fill_(1.0)  # type: ignore[operator]
    plain = rows_of(actor_critic)
    rows = replace(plain, terminated=torch.tensor([1.0] + [0.0] * (len(plain.rewards) - 1)))
    found = metrics_of(actor_critic, rows)
    # Q = 0 for both critics; targets r + 0.5 V(s'), the first without V
    targets = rows.rewards + 0.5 * (1.0 - rows.terminated)
    torch.testing.assert_close(found["loss/critic"], 2 * targets.square().mean())
    torch.testing.assert_close(found["loss/value"], torch.tensor(0.7))  # 0.7 (min(3, 2) - 1)^2
    assert found["actor_critic/advantage_std"].item() == 0.0  # A = 1 everywhere: beyond the cap of 100
    std = found["actor_critic/policy_std"].item()
    assert std == pytest.approx(1.0, abs=0.15)
    exact = torch.distributions.Normal(0.0, std).log_prob(rows.actions).sum(dim=-1).mean()
    torch.testing.assert_close(found["loss/policy"], -100.0 * exact, rtol=1e-4, atol=1e-4)


def test_cloning_is_the_mean_negative_likelihood_and_has_no_critic() -> None:
    actor_critic = made("bc", latent=1)
    assert isinstance(actor_critic, BehaviorCloning)
    rows = rows_of(actor_critic)
    means, log_std = actor_critic.policy(rows.inputs)
    expected = -torch.distributions.Normal(means, log_std.exp()).log_prob(rows.actions).sum(dim=-1).mean()
    torch.testing.assert_close(metrics_of(actor_critic, rows)["loss/policy"], expected)
    assert {name.split(".")[0] for name, _ in actor_critic.named_parameters()} == {"policy"}
    assert not actor_critic.limits() and not actor_critic.optimizers()
    other = replace(rows, rewards=rows.rewards + 5.0, next_inputs=rows.next_inputs + 1.0)
    plain, changed = (metrics_of(actor_critic, found)["loss/policy"] for found in (rows, other))
    assert torch.equal(plain, changed)


def test_iql_learns_the_better_of_stored_actions_and_cloning_their_mean() -> None:
    """One step of reward a_0, on actions that are uniform in [-1, 1]."""
    generator = torch.Generator().manual_seed(0)
    chosen = {}
    for kind in NEW_KINDS:
        actor_critic = made(kind, latent=0, gamma=0.0, tau=0.1, clip_targets=False)
        optimizer = torch.optim.Adam(actor_critic.parameters(), lr=1e-2)
        for _ in range(200):
            plain = steps(TASKS, 40, seed=1)
            actions = 2.0 * torch.rand(plain.actions.shape, generator=generator) - 1.0
            data = replace(plain, actions=actions, rewards=actions[..., 0])
            rows = actor_critic.rows(data, torch.zeros(TASKS, 0))
            total, _ = actor_critic.losses(rows, generator)
            optimizer.zero_grad()
            total.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            actor_critic.after_step()
        chosen[kind] = actor_critic.act(plain.observations[0], torch.zeros(40, 0)).mean(dim=0)
    assert chosen["iql"][0] > 0.5 and chosen["iql"][1].abs() < 0.25
    assert chosen["bc"].abs().max() < 0.25


@pytest.mark.parametrize("kind", NEW_KINDS)
def test_a_run_of_any_kind_trains_and_is_evaluated(
    kind: str, tiny_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By the command line, cloning the better half of the snapshots under contexts of all of them."""
    call, out = in_process(tcmrl, capsys), tmp_path / "run"
    chosen = (f"actor_critic.kind={kind}", "actor_critic.hidden=[8]", "batch.transitions=8", "run.steps=4")
    snapshots = ("run.snapshots=return>=0.5", "run.context_snapshots=all", "run.log_every=1")
    changes = [text for value in (*chosen, *snapshots) for text in ("--set", value)]
    code, _, errors = call("train", tiny_folder, "--algo", "focal", "--json", "--out", out, *changes)
    assert code == 0, errors
    metrics = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert ("loss/critic" in metrics[-1]) is (kind == "iql") and "loss/policy" in metrics[-1]
    code, output, errors = call("evaluate", out, "--json", "--protocol", "offline")
    assert code == 0, errors
    assert "focal" in output
