"""Networks: attention, masks, frozen calls, initial values, and the squashed policy."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn

from tcmrl_algo.algorithms.core.actor_critic.sac import PolicyNetwork
from tcmrl_algo.algorithms.core.context import ContextEncoder
from tcmrl_algo.algorithms.core.networks import (
    LARGEST_INPUT,
    Perceptron,
    PerceptronEnsemble,
    Standardizer,
    call_frozen,
    set_hidden_dtype,
)
from tcmrl_algo.algorithms.tcmrl import RewardEstimator, TaskExtractor, side_by_side
from tcmrl_algo.algorithms.tcmrl_variants import uniform_attention
from tests.made_up import problem, steps


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def random(*shape: int, seed: int = 1) -> Tensor:
    return torch.randn(*shape, generator=generator(seed))


def extractor(hidden: tuple[int, ...] = (8,)) -> TaskExtractor:
    return TaskExtractor(4, hidden=hidden, generator=generator())


MASK = torch.tensor([[True, True, True, False], [True, False, False, False]])


@pytest.mark.parametrize("hidden", [(8,), ()])
def test_attention_follows_equations_2_to_5(hidden: tuple[int, ...]) -> None:
    representations, network = random(1, 3, 4), extractor(hidden)
    attention = network(representations, torch.ones(1, 3, dtype=torch.bool))
    mean = representations[0].mean(dim=0)
    scores = torch.stack([network.perceptron(torch.cat([row, mean])) for row in representations[0]])
    weights = torch.softmax(scores.flatten(), dim=0)
    torch.testing.assert_close(attention.weights[0], weights)
    torch.testing.assert_close(attention.context[0], weights @ representations[0])


def test_order_of_transitions_changes_no_context() -> None:
    representations, order = random(1, 5, 4), torch.tensor([3, 0, 4, 1, 2])
    mask = torch.ones(1, 5, dtype=torch.bool)
    first, second = extractor()(representations, mask), extractor()(representations[:, order], mask)
    torch.testing.assert_close(first.context, second.context)
    torch.testing.assert_close(first.weights[:, order], second.weights)


def test_estimator_gives_each_task_its_own_context() -> None:
    estimator = RewardEstimator(5, latent=4, hidden=(16,), generator=generator())
    inputs, context = random(2, 6, 5), random(2, 4)
    together = estimator(inputs, context)
    assert together.shape == (2, 6)
    torch.testing.assert_close(together[1:], estimator(inputs[1:], context[1:]))
    assert not torch.allclose(estimator(inputs, context.flip(0)), together)


def test_steps_side_by_side_ignore_padding_and_its_length() -> None:
    steps, mask = random(2, 1, 5, 3), torch.tensor([[[True] * 5], [[True] * 3 + [False] * 2]])
    laid = side_by_side(steps, mask, horizon=7)
    assert laid.shape == (2, 1, 21)
    torch.testing.assert_close(laid[1, 0, :9], steps[1, 0, :3].flatten())
    assert not laid[1, 0, 9:].any()
    torch.testing.assert_close(side_by_side(steps[1:, :, :3], mask[1:, :, :3], horizon=7), laid[1:])


def test_uniform_attention_is_the_mean_of_real_steps() -> None:
    representations = random(2, 4, 3)
    found = uniform_attention(representations, MASK)
    torch.testing.assert_close(found.weights[0], torch.tensor([1 / 3, 1 / 3, 1 / 3, 0.0]))
    torch.testing.assert_close(found.context[0], representations[0, :3].mean(dim=0))
    torch.testing.assert_close(found.context[1], representations[1, 0])


def test_frozen_call_passes_gradients_to_inputs_alone() -> None:
    network, inputs = Perceptron((3, 4, 1), generator=generator()), random(5, 3).requires_grad_()
    output = call_frozen(network, inputs)
    torch.testing.assert_close(output, network(inputs))
    output.sum().backward()
    assert inputs.grad is not None
    assert inputs.grad.abs().sum() > 0
    assert all(parameter.grad is None for parameter in network.parameters())


def test_ensemble_members_are_separate_perceptrons() -> None:
    ensemble, inputs = PerceptronEnsemble(2, (3, 8), generator=generator()), random(5, 3)
    values = ensemble(inputs)
    for member, network in enumerate(ensemble.members):
        hidden = torch.relu(network.layers[0](inputs))
        torch.testing.assert_close(values[member], network.layers[1](hidden).squeeze(-1))
    assert not torch.allclose(values[0], values[1])


def test_hidden_layers_in_bfloat16_round_and_leave_parameters_and_outputs_in_float32() -> None:
    network, inputs = Perceptron((3, 32, 32, 1), generator=generator()), random(5, 2, 3).requires_grad_()
    exact = network(inputs)
    set_hidden_dtype(nn.ModuleDict({"inner": network}), torch.bfloat16)
    rounded = network(inputs)
    assert rounded.dtype == torch.float32
    assert not torch.equal(rounded, exact)
    torch.testing.assert_close(rounded, exact, atol=0.02, rtol=0.02)
    rounded.sum().backward()
    for tensor in (inputs, *network.parameters()):
        assert tensor.grad is not None
        assert tensor.grad.dtype == torch.float32
        assert tensor.grad.abs().sum() > 0


def test_starts_depend_on_the_generator_alone() -> None:
    torch.manual_seed(0)
    before = torch.get_rng_state()
    first = Perceptron((3, 4, 1), generator=generator(5))
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(1)
    second = Perceptron((3, 4, 1), generator=generator(5))
    for one, other in zip(first.parameters(), second.parameters(), strict=True):
        assert torch.equal(one, other)


def test_standardizer_leaves_constant_dimensions_undivided_and_bounds_the_rest() -> None:
    scaling = Standardizer(torch.tensor([1.0, 5.0]), torch.tensor([2.0, 0.0]))
    result = scaling(torch.tensor([[5.0, 5.0], [1e9, 5.5]]))
    torch.testing.assert_close(result, torch.tensor([[2.0, 0.0], [LARGEST_INPUT, 0.5]]))


def test_log_std_stays_in_range_and_keeps_its_gradient() -> None:
    policy = PolicyNetwork(1, 1, hidden=(), log_std_range=(-5.0, 0.0), generator=generator())
    with torch.no_grad():
        policy.perceptron.layers[0].weight.copy_(torch.tensor([[0.0], [1.0]]))
        policy.perceptron.layers[0].bias.zero_()
    free = torch.tensor([[-30.0], [-2.5], [3.0], [30.0]], requires_grad=True)
    _, log_std = policy(free)
    assert log_std.min() >= -5.0
    assert log_std.max() <= 0.01  # one softplus above the lower bound
    log_std.sum().backward()
    assert free.grad is not None
    assert free.grad[1] > 0.8  # nearly the identity inside
    assert free.grad[2] > 0.01  # a hard clamp has no gradient there


def test_log_probability_is_that_of_the_squashed_action() -> None:
    """By change of variables, with the density of tanh(u) checked against a numerical integral."""
    policy = PolicyNetwork(1, 1, hidden=(), log_std_range=(-20.0, 0.0), generator=generator())
    inputs = torch.full((20_001, 1), 0.3)
    mean, log_std = policy(inputs[:1])
    actions = torch.linspace(-0.99999, 0.99999, 20_001).unsqueeze(-1)
    noise = (torch.atanh(actions) - mean) / log_std.exp()
    sample = policy.sample(inputs, noise)
    torch.testing.assert_close(sample.actions, actions, atol=1e-4, rtol=0)
    total = torch.trapezoid(sample.log_probabilities.exp(), actions.squeeze(-1))
    assert total.item() == pytest.approx(1.0, abs=5e-3)


def test_log_probability_is_finite_far_out() -> None:
    policy = PolicyNetwork(1, 1, hidden=(), log_std_range=(-20.0, 0.0), generator=generator())
    sample = policy.sample(torch.full((2, 1), 0.0), torch.tensor([[60.0], [-60.0]]))
    assert torch.isfinite(sample.log_probabilities).all()
    assert math.isclose(sample.actions.abs().max().item(), 1.0)


def test_encoder_reads_every_part_of_a_transition() -> None:
    encoder = ContextEncoder(problem(), latent=5, hidden=(16,), generator=generator())
    values = steps(2, 1, 3, seed=1)
    (start,) = encoder(encoder.read(values))
    assert start.shape == (2, 1, 3, 5)
    assert start.abs().max() < 1
    for name in ("observations", "actions", "rewards", "next_observations"):
        (moved,) = encoder(encoder.read(replace(values, **{name: getattr(values, name) + 1.0})))
        assert not torch.allclose(moved, start), name


def test_encoder_reads_standardised_differences() -> None:
    encoder = ContextEncoder(problem(), latent=5, hidden=(), generator=generator())
    values = steps(2, 1, 3, seed=1)
    read = encoder.read(values)
    torch.testing.assert_close(read.state_actions, torch.cat([values.observations, values.actions], dim=-1))
    torch.testing.assert_close(read.rewards, values.rewards)
    change = values.next_observations - values.observations  # of standard deviation 0.5
    torch.testing.assert_close(read.inputs[..., 6:], (2 * change).clamp(-LARGEST_INPUT, LARGEST_INPUT))


def test_groups_of_transitions_are_encoded_as_each_alone() -> None:
    encoder = ContextEncoder(problem(), latent=5, hidden=(16,), generator=generator())
    groups = [encoder.read(steps(*shape, seed=1)) for shape in ((2, 3, 4), (2, 1, 4), (2, 5, 2))]
    for group, found in zip(groups, encoder(*groups), strict=True):
        torch.testing.assert_close(found, encoder(group)[0])
