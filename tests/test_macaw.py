"""MACAW: inner steps, the gradients through them, what each outer loss trains, rows, and how it collects."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import functional_call
from torch.nn import functional

from tcmrl_algo import create_algorithm, open_run, resolve_for, train_run
from tcmrl_algo.algorithms.core.problem import pad_trajectories
from tcmrl_algo.algorithms.core.settings import ActorCriticSettings
from tcmrl_algo.algorithms.macaw import (
    LaneRows,
    Macaw,
    MacawConfig,
    MacawLearner,
    MacawNetworks,
    evenly_spaced_rows,
    gaussian_log_likelihood,
    largest_return,
)
from tcmrl_algo.algorithms.macaw_networks import WeightPerceptron
from tcmrl_algo.evaluation.arena import Arena
from tcmrl_data import Batch, Dataset, UniformController
from tests.context_learners import gradients
from tests.made_up import ACTION_DIM, OBSERVATION_DIM, batch_for, problem, settings, trajectory

SMALL: dict[str, Any] = {"hidden": (8, 8), "code": 4, "head_hidden": 4, "inner_learning_rate": 0.3}
PARTS = ("value", "policy", "head", "inner.value_rates", "inner.policy_rates", "inner.head_weight")
STATES, NOISE = np.ones((2, OBSERVATION_DIM), dtype=np.float32), np.ones((2, ACTION_DIM), dtype=np.float32)


def learner(**config: Any) -> MacawLearner:
    return MacawLearner(problem(), settings(), MacawConfig.model_validate(SMALL | config))


def batch() -> Batch:
    return batch_for(Macaw().batch_request(settings(), MacawConfig()), seed=0)


def rows_of(made: MacawLearner) -> tuple[LaneRows, LaneRows]:
    values = batch()
    return made.inner_rows(values["context"]), made.rows(values["policy"])


def losses(made: MacawLearner) -> tuple[Tensor, Tensor]:
    """Of the value network and of the policy."""
    inner, outer = rows_of(made)
    return made.outer_losses(made.adapted(inner), outer)


def test_each_outer_loss_trains_its_network_and_the_settings_of_its_inner_step() -> None:
    made = learner()
    by_value, by_policy = (gradients(made.networks, loss, PARTS) for loss in losses(made))
    assert {part for part, size in by_value.items() if size > 0} == {"value", "inner.value_rates"}
    assert {part for part, size in by_policy.items() if size > 0} == {
        "policy", "head", "inner.policy_rates", "inner.head_weight",
    }  # fmt: skip


def test_an_update_moves_every_parameter_group_at_its_own_rate() -> None:
    rates = {"value": 1e-3, "policy": 1e-4, "head": 1e-4, "inner": 1e-2}
    made = learner(
        value_learning_rate=rates["value"],
        policy_learning_rate=rates["policy"],
        rate_learning_rate=rates["inner"],
    )
    before = {name: value.detach().clone() for name, value in made.networks.named_parameters()}
    made.update(batch(), 1)
    moved = dict.fromkeys(rates, 0.0)
    for name, value in made.networks.named_parameters():
        part, change = name.split(".")[0], (value.detach() - before[name]).abs().max()
        moved[part] = max(moved[part], float(change))
    assert moved == pytest.approx(rates, rel=1e-2)  # Adam's first step is its rate


def reference_losses(made: MacawLearner, config: MacawConfig) -> tuple[Tensor, Tensor]:
    """The method as an ordinary loop over tasks, with one copy of all parameters for each."""
    networks, (inner, outer) = made.networks, rows_of(made)
    lanes = [(lane_of(inner, lane), lane_of(outer, lane)) for lane in range(3)]
    pairs = [reference_task(networks, config, *lane) for lane in lanes]
    value, policy = (torch.stack(part).mean() for part in zip(*pairs, strict=True))
    return value, policy


def lane_of(rows: LaneRows, lane: int) -> LaneRows:
    """The real rows of one lane, as a lane alone."""
    real = rows.mask[lane]
    fields = {name: getattr(rows, name)[lane][real].unsqueeze(0) for name in rows.__dataclass_fields__}
    return LaneRows(**fields)


def stepped(network: WeightPerceptron, loss: Tensor, rates: Tensor) -> dict[str, Tensor]:
    names = ("code", "factors.weight", "factors.bias")
    parameters = dict(network.named_parameters())
    found = torch.autograd.grad(loss, list(parameters.values()), create_graph=True)
    changed = {}
    for (name, value), step in zip(parameters.items(), found, strict=True):
        _, place, rest = name.split(".", 2)
        changed[name] = value - functional.softplus(rates[int(place), names.index(rest)]) * step
    return changed


def reference_task(
    networks: MacawNetworks, config: MacawConfig, inner: LaneRows, outer: LaneRows
) -> tuple[Tensor, Tensor]:
    value, policy = networks.value, networks.policy

    def v(parameters: dict[str, Tensor], states: Tensor) -> Tensor:
        return value.run(functional_call(value, parameters, ()), states[0])[0][:, 0]

    def advantages(parameters: dict[str, Tensor], rows: LaneRows) -> tuple[Tensor, Tensor]:
        with torch.no_grad():
            final = v(parameters, rows.final_states)
            found = rows.returns[0] + rows.discounts[0] * final - v(parameters, rows.states)
            normalized = (found - found.mean()) / found.std() / config.temperature
            return found, normalized.exp().clamp(max=config.weight_cap)

    start = dict(value.named_parameters())
    inner_loss = (v(start, inner.states) - inner.returns[0]).square().mean()
    phi = stepped(value, inner_loss, networks.inner.value_rates)
    target = {name: 0.9 * start[name].detach() + 0.1 * phi[name].detach() for name in start}
    targets = outer.returns[0] + outer.discounts[0] * v(target, outer.final_states)
    value_loss = (v(phi, outer.states) - targets.detach()).square().mean()

    found, weights = advantages(phi, inner)
    outputs, features = policy.run(policy(), inner.states[0])
    likelihoods = gaussian_log_likelihood(inner.actions[0], torch.tanh(outputs), std=config.sigma)
    guesses = networks.head(torch.cat([features.relu(), inner.actions[0]], dim=-1))[:, 0]
    head_weight = functional.softplus(networks.inner.head_weight)
    loss = (-weights * likelihoods + head_weight * (guesses - found).square()).mean()
    theta = stepped(policy, loss, networks.inner.policy_rates)
    _, weights = advantages(phi, outer)
    means = torch.tanh(policy.run(functional_call(policy, theta, ()), outer.states[0])[0])
    likelihoods = gaussian_log_likelihood(outer.actions[0], means, std=config.sigma)
    return value_loss, -(weights * likelihoods).mean()


def test_losses_and_meta_gradients_are_those_of_a_loop_over_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tcmrl_algo.algorithms.macaw.SMALLEST_STD", 0.0)
    config = MacawConfig.model_validate(SMALL)
    made = learner()
    made.networks.double()
    for found, expected in zip(losses(made), reference_losses(made, config), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
        parameters = list(made.networks.parameters())
        pair = (
            torch.autograd.grad(loss, parameters, allow_unused=True, retain_graph=True)
            for loss in (found, expected)
        )
        for own, other in zip(*pair, strict=True):
            if other is None:
                assert own is None or not own.any()
            else:
                torch.testing.assert_close(own, other, rtol=1e-9, atol=1e-9)


def test_first_order_changes_gradients_and_no_loss() -> None:
    exact, short = learner(), learner(first_order=True)
    for own, other in zip(losses(exact), losses(short), strict=True):
        torch.testing.assert_close(own, other)
    left, right = (gradients(made.networks, losses(made)[1], PARTS) for made in (exact, short))
    assert left["policy"] != pytest.approx(right["policy"], rel=1e-4)
    assert left["head"] > 0 and right["head"] == 0.0  # reached by second derivatives alone


def test_rates_and_head_weight_start_at_the_published_values() -> None:
    inner = MacawLearner(problem(), settings(), MacawConfig()).networks.inner
    assert functional.softplus(inner.value_rates).mean().item() == pytest.approx(9.9950e-4, rel=1e-4)
    assert functional.softplus(inner.policy_rates).mean().item() == pytest.approx(9.9950e-4, rel=1e-4)
    assert functional.softplus(inner.head_weight).item() == pytest.approx(9.9503e-3, rel=1e-4)


def test_rows_of_a_long_context_are_evenly_spaced_and_padding_is_skipped() -> None:
    mask = torch.tensor([[True, True, False, True, True, True, True], [True] + [False] * 6, [False] * 7])
    places, real = evenly_spaced_rows(mask, 3)
    assert places[0].tolist() == [0, 3, 5]  # of the real rows 0, 1, 3, 4, 5, 6 every second
    assert real.tolist() == [[True] * 3, [True, False, False], [False] * 3]
    places, real = evenly_spaced_rows(mask, 99)
    assert places[0][real[0]].tolist() == [0, 1, 3, 4, 5, 6] and places[1][real[1]].tolist() == [0]


def test_returns_are_in_units_of_the_largest_return() -> None:
    """Rewards from -2 to 1 over 6 steps with gamma 0.5: 2 (1 + 0.5 + ... + 0.5^5) = 3.9375."""
    given = ActorCriticSettings(gamma=0.5)
    assert largest_return(problem(), given) == pytest.approx(3.9375)
    dense = replace(problem(), dense_reward_range=(0.0, 4.0))
    shaped = ActorCriticSettings(gamma=0.0, rewards="dense")
    assert largest_return(dense, shaped) == 4.0
    assert largest_return(replace(problem(), reward_range=(0.0, 0.0)), given) == 1.0


def test_a_lane_without_trajectories_keeps_the_start() -> None:
    made = learner()
    steps = pad_trajectories([[], [trajectory(6, 0)]], problem(), gamma=0.9)
    adapted = made.adapted(made.inner_rows(steps))
    for weights, start in zip(adapted.policy, made.networks.policy(), strict=True):
        torch.testing.assert_close(weights[0], start)
        assert not torch.allclose(weights[1], start)


def test_it_collects_by_uniform_actions_or_the_policy_of_the_start_with_noise() -> None:
    made = learner(explore="policy")
    start = made.adapt([[], []]).act(STATES, NOISE)
    lanes = [[trajectory(6, 0)], [trajectory(6, 1)]]
    found = made.explore(lanes).act(STATES, NOISE)
    np.testing.assert_allclose(found, np.clip(start + 0.2, -1, 1), rtol=1e-5)
    assert made.explore(lanes).act(STATES, 100 * NOISE).max() <= 1
    assert isinstance(learner().explore(lanes), UniformController)


@pytest.mark.check
def test_adaptation_to_stored_trajectories_raises_the_return(tiny: Dataset, tmp_path: Path) -> None:
    steps = 600
    overrides = (f"run.steps={steps}", f"run.checkpoint_every={steps}", "batch.context_trajectories=[4]")
    config = resolve_for(tiny, profile="quick", algorithm="macaw", overrides=overrides)
    train_run(tiny, tmp_path / "run", config=config, profile="quick")
    run = open_run(tmp_path / "run")
    algorithm = create_algorithm(run.record, tiny)
    algorithm.load_tensors(run.newest().tensors())
    arena = Arena(tiny, algorithm, config.settings.run, capabilities=Macaw.capabilities, seed=0)
    tasks = tiny.train_tasks
    found = []
    for contexts in ([[] for _ in tasks], [arena.stored(task, draw=0) for task in tasks]):
        episodes = [arena.adapted(tasks, contexts, episode=number) for number in range(3)]
        found.append(np.mean([one.undiscounted_return for episode in episodes for one in episode]))
    arena.close()
    before, after = found
    assert after > before + 1.0
