"""Momentum copies: networks that follow others and that no optimiser trains."""

import copy
from typing import TypeVar

import torch
from torch import nn

Network = TypeVar("Network", bound=nn.Module)


def momentum_copy(network: Network) -> Network:
    """A copy without gradients, so that no optimiser takes it; `follow` moves it."""
    return copy.deepcopy(network).requires_grad_(False)


def follow(copied: nn.Module, network: nn.Module, *, step: float) -> None:
    """Moves a momentum copy towards its network: copied + step (network - copied).

    Buffers are left alone; networks here keep only constants in them.
    """
    with torch.no_grad():
        torch._foreach_lerp_(list(copied.parameters()), list(network.parameters()), step)
