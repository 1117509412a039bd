"""Adam: its decay, and the bound on gradients."""

import pytest
import torch

from tcmrl_algo.networks.optimizer import Adam


def test_the_learning_rate_falls_linearly_to_its_share() -> None:
    layer = torch.nn.Linear(1, 1)
    adam = Adam(layer, learning_rate=1.0, final_share=0.2, decay_steps=10)
    rates = []
    for done in (0, 5, 10, 30):
        adam.step(layer.weight.sum(), steps_done=done)
        rates.append(adam._adam.param_groups[0]["lr"])
    assert rates == pytest.approx([1.0, 0.6, 0.2, 0.2])


def test_gradients_are_bounded_where_asked() -> None:
    layer = torch.nn.Linear(1, 1, bias=False)
    adam = Adam(layer, learning_rate=1e-3, gradient_norm=0.5)
    adam.step(100.0 * layer.weight.sum())
    assert layer.weight.grad is not None
    assert layer.weight.grad.item() == pytest.approx(0.5, rel=1e-4)
