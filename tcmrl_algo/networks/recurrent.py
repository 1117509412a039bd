"""Recurrent networks whose start a generator draws."""

import torch
from torch import nn


def recurrent(inputs: int, hidden: int, generator: torch.Generator) -> nn.GRU:
    """A GRU, batch first, with orthogonal weights and biases of 0 (published code of VariBAD and BOReL)."""
    network = nn.GRU(inputs, hidden, batch_first=True, device="meta").to_empty(device="cpu")
    for name, parameter in network.named_parameters():
        if name.startswith("bias"):
            nn.init.zeros_(parameter)
        else:
            nn.init.orthogonal_(parameter, generator=generator)
    return network
