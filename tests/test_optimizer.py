"""Adam: its decay, the bound on gradients, groups; and momentum copies."""

import pytest
import torch

from tcmrl_algo.algorithms.core.networks import follow, momentum_copy
from tcmrl_algo.algorithms.core.optimizer import Adam, ParameterGroup


def test_the_learning_rate_falls_linearly_to_its_share() -> None:
    layer = torch.nn.Linear(1, 1)
    adam = Adam(layer.named_parameters(), learning_rate=1.0, final_share=0.2, decay_steps=10)
    rates = [rate for done in (0, 5, 10, 30) for rate in adam.rates(done)]
    assert rates == pytest.approx([1.0, 0.6, 0.2, 0.2])


def test_steps_are_those_of_torchs_adam_to_the_bit_also_where_a_gradient_is_missing() -> None:
    own, other = torch.nn.Linear(3, 2), torch.nn.Linear(3, 2)
    other.load_state_dict(own.state_dict())
    adam, reference = (
        Adam(own.named_parameters(), learning_rate=0.1),
        torch.optim.Adam(other.parameters(), lr=0.1, fused=True),
    )
    inputs = torch.linspace(-1.0, 1.0, 12).view(4, 3)
    for step in range(6):
        losses = [
            (layer.weight.sum() ** 2 if step == 2 else layer(inputs).square().sum()) for layer in (own, other)
        ]
        adam.step(losses[0])
        reference.zero_grad()
        losses[1].backward()
        reference.step()
        for name, value in other.named_parameters():
            assert torch.equal(own.get_parameter(name), value)
            for moment in ("step", "exp_avg", "exp_avg_sq"):
                assert torch.equal(adam.tensors()[f"{name}/{moment}"], reference.state[value][moment])


def test_the_whole_state_lies_where_the_parameters_do() -> None:
    """A checkpoint's tensors are looked through together, which a GPU does for its own alone."""
    bias = torch.nn.Parameter(torch.empty(2, device="meta"))
    adam = Adam([("bias", bias)], learning_rate=1.0)
    zeros = torch.zeros(2)
    adam.load_tensors({"bias/step": torch.tensor(1.0), "bias/exp_avg": zeros, "bias/exp_avg_sq": zeros})
    assert [value.device for value in adam.tensors().values()] == 3 * [bias.device]


def test_gradients_are_bounded_where_asked() -> None:
    layer = torch.nn.Linear(1, 1, bias=False)
    adam = Adam(layer.named_parameters(), learning_rate=1e-3, gradient_norm=0.5)
    adam.step(100.0 * layer.weight.sum())
    assert layer.weight.grad is not None
    assert layer.weight.grad.item() == pytest.approx(0.5, rel=1e-4)


def two_layers() -> torch.nn.ModuleDict:
    return torch.nn.ModuleDict({name: torch.nn.Linear(1, 1, bias=False) for name in ("slow", "slower")})


def test_a_group_has_its_own_rate_and_bound_and_the_common_decay() -> None:
    layers = two_layers()
    groups = {"slow": ParameterGroup(learning_rate=0.5, gradient_norm=0.25)}
    adam = Adam(
        layers.named_parameters(),
        learning_rate=1.0,
        final_share=0.0,
        decay_steps=2,
        gradient_norm=2.0,
        groups=groups,
    )
    before = {name: layer.weight.item() for name, layer in layers.items()}
    adam.step(100.0 * (layers["slow"].weight + layers["slower"].weight).sum(), steps_done=1)
    moved = {name: before[name] - layer.weight.item() for name, layer in layers.items()}
    assert moved == pytest.approx({"slow": 0.25, "slower": 0.5})  # a first step's length is the rate
    norms = {name: layer.weight.grad.item() for name, layer in layers.items()}
    assert norms == pytest.approx({"slow": 0.25, "slower": 2.0}, rel=1e-4)  # "slower" is not below "slow"


def test_a_group_without_a_parameter_is_an_error() -> None:
    with pytest.raises(ValueError, match="'slowest'"):
        Adam(two_layers().named_parameters(), learning_rate=1.0, groups={"slowest": ParameterGroup(1.0)})


def test_a_momentum_copy_follows_and_no_optimiser_takes_it() -> None:
    layer = torch.nn.Linear(2, 1)
    networks = torch.nn.ModuleDict({"query": layer, "key": momentum_copy(layer)})
    adam = Adam(networks.named_parameters(), learning_rate=1.0)
    before = layer.weight.detach().clone()
    adam.step(layer.weight.sum() + layer.bias.sum())
    assert torch.equal(networks["key"].weight, before)
    follow(networks["key"], layer, step=0.25)
    torch.testing.assert_close(networks["key"].weight, 0.75 * before + 0.25 * layer.weight)
    assert all(name.startswith("query.") for name in adam.tensors())
