"""Advantage-weighted regression and weight-linear layers against numbers and steps computed by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import functional_call, grad, vmap

from tcmrl_algo.algorithms.core.problem import pad_trajectories
from tcmrl_algo.algorithms.macaw import (
    advantage_weights,
    bootstrapped_return,
    gaussian_log_likelihood,
    return_regression,
    weighted_likelihood,
)
from tcmrl_algo.algorithms.macaw_networks import WeightLinear, WeightPerceptron, apply_layer
from tests.made_up import problem, random, trajectory

MASK = torch.tensor([[True, True, True], [True, True, False]])


def weights_of(*advantages: float, largest: float = 20.0, temperature: float = 1.0) -> list[float]:
    given = torch.tensor(advantages)
    real = torch.ones(len(advantages)) > 0
    found: list[float] = advantage_weights(given, real, temperature=temperature, largest=largest).tolist()
    return found


def test_gradients_are_right() -> None:
    values, others = random(2, 3), random(2, 3, seed=1)
    assert torch.autograd.gradcheck(lambda v, g: return_regression(v, g, MASK), (values, others))
    assert torch.autograd.gradcheck(lambda v, w: weighted_likelihood(v, w, MASK), (values, others))
    assert torch.autograd.gradcheck(
        lambda a: advantage_weights(a, MASK, temperature=0.7, largest=20.0), values
    )
    pairs = (random(2, 3, 2), random(2, 3, 2, seed=1))
    assert torch.autograd.gradcheck(lambda a, m: gaussian_log_likelihood(a, m, std=0.2), pairs)
    three = (values, others, random(2, 3, seed=2))
    assert torch.autograd.gradcheck(bootstrapped_return, three)


def test_weights_of_advantages_by_hand() -> None:
    """(1, -1): A' = +-1/sqrt(2). (0, 0, 0, 4): A' = -1/2 three times and 3/2."""
    assert weights_of(1.0, -1.0) == pytest.approx([2.028115, 0.493069], rel=1e-5)
    assert weights_of(0.0, 0.0, 0.0, 4.0) == pytest.approx([0.606531] * 3 + [4.481689], rel=1e-5)
    assert weights_of(10.0, -10.0, temperature=0.5) == pytest.approx(
        [math.exp(math.sqrt(2)), math.exp(-math.sqrt(2))], rel=1e-5
    )


def test_weights_have_a_bound_and_equal_advantages_weigh_one() -> None:
    assert max(weights_of(*[0.0] * 99, 1.0)) == pytest.approx(20.0)
    assert max(weights_of(0.0, 0.0, 0.0, 4.0, largest=3.0)) == pytest.approx(3.0)
    assert weights_of(0.3, 0.3, 0.3) == pytest.approx([1.0] * 3, abs=1e-1)
    assert weights_of(0.3) == [1.0]


def test_padding_and_other_lanes_change_no_weight() -> None:
    advantages = random(2, 3).detach()
    found = advantage_weights(advantages, MASK, temperature=1.0, largest=20.0)
    other = torch.where(MASK, advantages, 1e9)
    again = advantage_weights(other, MASK, temperature=1.0, largest=20.0)
    torch.testing.assert_close(again[MASK], found[MASK])
    alone = advantage_weights(advantages[1, :2], MASK[1, :2], temperature=1.0, largest=20.0)
    torch.testing.assert_close(alone, found[1, :2])


def test_likelihood_of_a_gaussian_by_hand() -> None:
    """std 0.2: a = mu gives 0.690499 per dimension, one std away 0.190499."""
    actions = torch.tensor([[0.5, 0.5], [0.5, 0.3]])
    found = gaussian_log_likelihood(actions, torch.full((2, 2), 0.5), std=0.2)
    assert found.tolist() == pytest.approx([2 * 0.690499, 0.690499 + 0.190499], abs=1e-5)


def test_losses_by_hand() -> None:
    values, targets = torch.tensor([1.0, 2.0, 9.0]), torch.tensor([0.0, 4.0, 0.0])
    real = torch.tensor([True, True, False])
    assert return_regression(values, targets, real).item() == 2.5
    assert weighted_likelihood(torch.tensor([-1.0, 2.0, 9.0]), torch.tensor([2.0, 3.0, 1.0]), real) == -2.0


@pytest.mark.parametrize(("ended", "expected"), [(False, 12.52), (True, 5.23)])
def test_returns_of_an_episode_of_three_steps_by_hand(ended: bool, expected: float) -> None:
    """r = (1, 2, 3), gamma = 0.9: G_0 = 5.23; V(s_T) = 10 adds 7.29, unless the task ended the episode."""
    rewards = np.array([1.0, 2.0, 3.0], dtype=np.float32)
    episode = replace(trajectory(3, 0), rewards=rewards, terminated=np.array([False, False, ended]))
    steps = pad_trajectories([[episode]], problem(), gamma=0.9)
    assert steps.returns_to_go is not None and steps.discounts_to_end is not None
    found = bootstrapped_return(steps.returns_to_go, steps.discounts_to_end, torch.full((1, 1, 3), 10.0))
    assert found[0, 0, 0].item() == pytest.approx(expected)


def layer(inputs: int = 3, outputs: int = 2, code: int = 4) -> WeightLinear:
    return WeightLinear(inputs, outputs, code=code, generator=torch.Generator().manual_seed(0))


def test_a_weight_linear_layer_is_the_linear_layer_of_its_generated_weights() -> None:
    made, inputs = layer(), random(5, 3).detach().float()
    plain = torch.nn.Linear(3, 2)
    generated = made.factors.weight @ made.code + made.factors.bias
    with torch.no_grad():
        plain.weight.copy_(generated[:6].view(3, 2).T)
        plain.bias.copy_(generated[6:])
    torch.testing.assert_close(apply_layer(made(), inputs, 2), plain(inputs))
    assert made.code.std().item() < 1.0  # N(0, 1 / outputs^2)
    both = torch.stack([made(), 2 * made()])
    found = apply_layer(both, inputs.expand(2, -1, -1), 2)
    torch.testing.assert_close(found[1], 2 * plain(inputs))


def test_an_inner_step_on_a_quadratic_by_hand() -> None:
    """0.5 (b - 3)^2 at b = 1 and rate 0.1 gives 1.2; 0.5 (b' - 5)^2 then has -3.42 and, by the rate, -7.6."""
    made = layer(1, 1, 1)
    for parameter in made.parameters():
        torch.nn.init.zeros_(parameter)
    with torch.no_grad():
        made.factors.bias[1] = 1.0

    def inner_loss(weights: Tensor) -> Tensor:
        return 0.5 * (apply_layer(weights, torch.zeros(1, 1), 1) - 3.0).square().sum()

    rates = torch.tensor([0.0, 0.0, 0.1], requires_grad=True)
    for first_order, expected in ((False, -3.42), (True, -3.8)):
        gradient = grad(inner_loss)(made())
        stepped = made.descended((gradient.detach() if first_order else gradient).unsqueeze(0), rates)
        assert stepped[0, 1].item() == pytest.approx(1.2)
        outer = 0.5 * (stepped[0, 1] - 5.0).square()
        by_bias, by_rate = torch.autograd.grad(outer, [made.factors.bias, rates])
        assert by_bias[1].item() == pytest.approx(expected, rel=1e-5)
        assert by_rate[2].item() == pytest.approx(-7.6, rel=1e-5)


def test_descended_weights_and_all_their_derivatives_are_those_of_a_step_on_every_parameter() -> None:
    """Two lanes; the reference copies every parameter for a lane and steps it with `autograd.grad`."""
    network = WeightPerceptron((3, 5, 2), code=4, generator=torch.Generator().manual_seed(0)).double()
    inputs, targets = random(2, 6, 3).detach(), random(2, 6, 2, seed=1).detach()
    rates = (0.1 * random(2, 3, seed=2).detach().abs()).requires_grad_()
    names = ("code", "factors.weight", "factors.bias")
    everything = [*network.parameters(), rates]

    def inner_loss(weights: tuple[Tensor, ...], states: Tensor, goals: Tensor) -> Tensor:
        return (network.run(weights, states)[0] - goals).square().mean()

    gradients = vmap(grad(inner_loss), in_dims=(None, 0, 0))(network(), inputs, targets)
    found = network.descended(gradients, rates)
    for lane in range(2):
        own = dict(network.named_parameters())
        loss = inner_loss(network(), inputs[lane], targets[lane])
        steps = torch.autograd.grad(loss, list(own.values()), create_graph=True)
        moved = {}
        for (name, value), step in zip(own.items(), steps, strict=True):
            _, place, rest = name.split(".", 2)
            moved[name] = value - rates[int(place), names.index(rest)] * step
        expected = functional_call(network, moved, ())
        for left, right in zip(found, expected, strict=True):
            torch.testing.assert_close(left[lane], right)
        plain = [
            outer_loss(network, weights, inputs[lane]) for weights in (expected, [w[lane] for w in found])
        ]
        wanted, got = (torch.autograd.grad(value, everything, retain_graph=True) for value in plain)
        for left, right in zip(got, wanted, strict=True):
            torch.testing.assert_close(left, right)


def outer_loss(network: WeightPerceptron, weights: list[Tensor], states: Tensor) -> Tensor:
    return (network.run(weights, states)[0] - 1.0).square().sum()
