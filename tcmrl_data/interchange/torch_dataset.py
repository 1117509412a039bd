"""A selection as a map-style PyTorch dataset of whole episodes."""

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence
from itertools import accumulate
from typing import TYPE_CHECKING, final

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from torch.utils.data import Dataset

from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.interchange.exporting import episode_arrays
from tcmrl_data.store.tables import PartKey

if TYPE_CHECKING:
    from tcmrl_data.dataset.selection import Selection

Item = dict[str, Tensor]


@final
class TrajectoryDataset(Dataset[Item]):
    """Episodes task by task, snapshot by snapshot; a part is read when one of its episodes is used.

    An item holds new tensors: `observations` (T + 1, observation_dim), one more than actions;
    `actions` (T, action_dim); `rewards`, `terminated` and `truncated` (bool, a time limit is only the
    latter) and further arrays such as `success`, all (T,); `task` and `step` (of the snapshot), int64
    scalars. Lengths differ where episodes end early: `collate` pads.

    Args:
        kept_parts: parts that stay in memory after they were read, the least recently used dropped first;
            all of them where None.

    Example:
        >>> from torch.utils.data import DataLoader
        >>> episodes = TrajectoryDataset(dataset.select(split="train"))  # doctest: +SKIP
        >>> DataLoader(episodes, batch_size=16, shuffle=True, collate_fn=episodes.collate)  # doctest: +SKIP
    """

    def __init__(self, selection: "Selection", *, kept_parts: int | None = None) -> None:
        self._dataset, self._kept_parts = selection.dataset, kept_parts
        self._parts = [key for task in selection.tasks for key in selection.parts[task.index]]
        self._ends = list(accumulate(self._dataset.entry(key).episodes for key in self._parts))
        self._read: OrderedDict[PartKey, list[Trajectory]] = OrderedDict()

    def __len__(self) -> int:
        return self._ends[-1]

    def __getitem__(self, index: int) -> Item:
        if not -len(self) <= index < len(self):
            raise IndexError(f"episode {index} of {len(self)}")
        index %= len(self)
        part = bisect_right(self._ends, index)
        key = self._parts[part]
        return _item(self._trajectories(key)[index - self._ends[part]], key.task, key.step)

    def _trajectories(self, key: PartKey) -> list[Trajectory]:
        found = self._read.pop(key, None) or self._dataset.trajectories(*key)
        self._read[key] = found
        if self._kept_parts is not None and len(self._read) > self._kept_parts:
            self._read.popitem(last=False)
        return found

    @staticmethod
    def collate(items: Sequence[Item]) -> Item:
        """Items as one batch: arrays padded with zeros at the end; `mask` (N, longest) is False there."""
        batch = {
            name: torch.stack([item[name] for item in items])
            if items[0][name].ndim == 0
            else pad_sequence([item[name] for item in items], batch_first=True)
            for name in items[0]
        }
        lengths = torch.tensor([len(item["actions"]) for item in items])
        batch["mask"] = torch.arange(int(lengths.max())) < lengths[:, None]
        return batch


def _item(trajectory: Trajectory, task: int, step: int) -> Item:
    item = {name: torch.from_numpy(np.array(array)) for name, array in episode_arrays(trajectory).items()}
    return item | {"task": torch.tensor(task), "step": torch.tensor(step)}
