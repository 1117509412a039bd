"""Context learners that say how much every step weighs in a context."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import torch

from tcmrl_algo.context_methods.learner import ContextAlgorithm
from tcmrl_algo.methods.base import Algorithm
from tcmrl_algo.networks.attention import Attention
from tcmrl_data import Steps, Trajectory


@runtime_checkable
class Attentive(Protocol):
    """A context learner with attention."""

    def attention(self, steps: Steps) -> Attention:
        """How the steps of every lane weigh in its context, trajectory after trajectory, padding included."""
        ...


def attention_of(algorithm: Algorithm, trajectories: Sequence[Sequence[Trajectory]]) -> Attention | None:
    """How the steps of every lane weigh in its context; None for a method without attention."""
    if not isinstance(algorithm, ContextAlgorithm) or not isinstance(algorithm.learner, Attentive):
        return None
    with torch.no_grad():
        return algorithm.learner.attention(algorithm.pack(trajectories))
