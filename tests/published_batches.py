"""Five fixed batches on which the losses of published codes were computed, and ours are."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
BATCHES = 5
STEPS, LATENT, ACTION_DIM = 6, 6, 2
"""Steps of a task's trajectory, size of a representation, size of an action."""
TASKS: tuple[tuple[int, ...], ...] = (
    (0, 1, 2, 0, 1, 2),
    (0, 1, 0, 1),
    (3, 1, 2, 0),
    (0, 0, 1, 1),
    (2, 0, 1, 1, 0, 2),
)
"""Tasks of the meta-batches; the third holds every task once, as by FOCAL's default."""


@dataclass(frozen=True)
class PublishedBatch:
    """What the networks of both codes give for a meta-batch, and its data; rows are tasks times steps.

    Attributes:
        tasks: (tasks,), the task of every entry of the meta-batch.
        representations: (tasks, steps, latent), c_t.
        score_weights, score_bias: (2 latent,) and a number, of the linear layer that scores [c_t, mean].
        similarity: (latent, latent), W.
        rows: (rows,) by name, and (rows, action) for those of actions.
        predicted: (tasks, steps), r_hat under c, then under c_neg.
        noise: (tasks, steps), added to the rewards of L_neg.
        alpha: weight of BRAC's divergence.
    """

    tasks: tuple[int, ...]
    representations: Array
    score_weights: Array
    score_bias: float
    similarity: Array
    rows: dict[str, Array]
    predicted: tuple[Array, Array]
    noise: Array
    alpha: float


def published_batch(index: int) -> PublishedBatch:
    """A batch by its number; `RandomState` gives the same numbers under every version of NumPy."""
    random = np.random.RandomState(1000 + index)
    tasks = TASKS[index]
    shape, rows = (len(tasks), STEPS), len(tasks) * STEPS
    values: dict[str, Any] = {
        name: random.randn(rows)
        for name in (
            "q1", "q2", "v", "target_v", "acted_q1", "acted_q2", "log_probability",
            "dual_behavior", "dual_policy", "dual_between", "reward",
        )
    }  # fmt: skip
    values["terminated"] = (random.rand(rows) < 0.2).astype(float)
    values |= {name: random.randn(rows, ACTION_DIM) for name in ("mean", "log_std")}
    size = 0.4 if index < 4 else 3.0  # errors of the last batch exceed 1, where the published loss is linear
    rewards = values["reward"].reshape(shape)
    return PublishedBatch(
        tasks,
        np.tanh(random.randn(*shape, LATENT)),
        random.randn(2 * LATENT),
        float(random.randn()),
        random.rand(LATENT, LATENT),
        values,
        (
            rewards + size * np.tanh(random.randn(*shape)),
            rewards + size * np.tanh(random.randn(*shape)),
        ),
        0.5 * np.tanh(random.randn(*shape)),
        alpha=float(5 * index),
    )
