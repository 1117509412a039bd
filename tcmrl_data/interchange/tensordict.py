"""TensorDicts with TorchRL's keys."""

from typing import TYPE_CHECKING, Any

import numpy as np

from tcmrl_data.dataset.selection import Selection
from tcmrl_data.interchange.exporting import require_packages, transitions
from tcmrl_data.interchange.reader import EPISODE_ARRAYS

if TYPE_CHECKING:
    import torch
    from tensordict import TensorDict

    from tcmrl_data.sampling.gather import Steps


def to_tensordict(selection: Selection) -> "TensorDict":
    """All selected transitions in memory, episodes behind one another, batch size (N,).

    Keys as in TorchRL's offline datasets: `observation`, `action`, `done`, `terminated`, `truncated` (False:
    no transition starts where an episode ended), `("next", "observation")`, `("next", "reward")`,
    `("next", "done")`, `("next", "terminated")`, `("next", "truncated")`; rewards and flags are (N, 1).
    Beside them, (N,) int64: `episode`, which numbers episodes over all tasks (the `traj_key` of TorchRL's
    slice samplers), `task`, and `step`, that of the episode's snapshot.

    Raises:
        MissingPackageError: tensordict is not installed.

    Example:
        >>> from tcmrl_data.interchange.tensordict import to_tensordict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer, SliceSampler  # doctest: +SKIP
        >>> data = to_tensordict(dataset.select(snapshots="last"))  # doctest: +SKIP
        >>> sampler = SliceSampler(slice_len=10, traj_key="episode")  # doctest: +SKIP
        >>> buffer = ReplayBuffer(storage=LazyTensorStorage(len(data)), sampler=sampler)  # doctest: +SKIP
        >>> buffer.extend(data)  # doctest: +SKIP
    """
    import torch

    parts: list[dict[str, Any]] = []
    episodes = 0
    for key in (key for task in selection.tasks for key in selection.parts[task.index]):
        arrays = transitions(selection.dataset.trajectories(*key), first=episodes, step=key.step)
        parts.append(arrays | {"task": np.full_like(arrays["step"], key.task)})
        episodes += selection.dataset.entry(key).episodes
    data = {name: torch.from_numpy(np.concatenate([part[name] for part in parts])) for name in _ROWS}
    size = len(data["rewards"])
    result: TensorDict = _tensordict_type()(
        {
            "observation": data["observations"],
            "action": data["actions"],
            "next": _outcome(
                data["next_observations"], data["rewards"], data["terminated"], data["truncated"]
            ),
            **{name: torch.zeros(size, 1, dtype=torch.bool) for name in _FLAGS},
            **{name: data[name] for name in ("episode", "task", "step")},
        },
        batch_size=[size],
    )
    return result


def view_steps(steps: "Steps") -> "TensorDict":
    """Steps of a batch under TorchRL's keys, sharing their memory; the batch size is their leading shape.

    A batch does not know time limits, so `("next", "done")` is `("next", "terminated")` and
    `("next", "truncated")` is False. `mask` is False on padding.

    Raises:
        MissingPackageError: tensordict is not installed.
    """
    import torch

    kind = _tensordict_type()
    terminated = steps.terminated.bool()
    result: TensorDict = kind(
        {
            "observation": steps.observations,
            "action": steps.actions,
            "next": _outcome(
                steps.next_observations, steps.rewards, terminated, torch.zeros_like(terminated)
            ),
            **{name: torch.zeros_like(terminated).unsqueeze(-1) for name in _FLAGS},
            "mask": steps.mask,
        },
        batch_size=steps.rewards.shape,
    )
    return result


_FLAGS = ("done", "terminated", "truncated")
_ROWS = (*EPISODE_ARRAYS, "next_observations", "episode", "task", "step")


def _outcome(
    observations: "torch.Tensor",
    rewards: "torch.Tensor",
    terminated: "torch.Tensor",
    truncated: "torch.Tensor",
) -> dict[str, "torch.Tensor"]:
    """The `next` entries: observation, reward and flags after an action."""
    return {
        "observation": observations,
        "reward": rewards.unsqueeze(-1),
        "done": (terminated | truncated).unsqueeze(-1),
        "terminated": terminated.unsqueeze(-1),
        "truncated": truncated.unsqueeze(-1),
    }


def _tensordict_type() -> Any:
    require_packages("a TensorDict", ("tensordict",), "tcmrl[tensordict]")
    from tensordict import TensorDict

    return TensorDict
