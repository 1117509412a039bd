"""What the parts of foreign files have in common, found before any of them is stored."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tcmrl_data.envs.tasks import Task
from tcmrl_data.foundation.errors import StoreError
from tcmrl_data.foundation.plain_files import printable
from tcmrl_data.foundation.records import hidden_text
from tcmrl_data.interchange.readers.base import ReadPart
from tcmrl_data.store.keys import MAX_ARRAYS, MAX_INDEX, PartKey
from tcmrl_data.store.part import STANDARD_ARRAYS


@dataclass
class Survey:
    """Sums and sizes of the parts that were added.

    Attributes:
        keys: of the parts.
        tasks: as the files describe them, by index.
        horizon: steps of the longest episode.
        extras: dtypes of the per-step arrays that all episodes have, by name.
    """

    keys: set[PartKey] = field(default_factory=set)
    tasks: dict[int, Task] = field(default_factory=dict)
    episodes: int = 0
    steps: int = 0
    horizon: int = 0
    observation_dim: int = 0
    action_dim: int = 0
    _extras: dict[str, str] | None = None

    @property
    def extras(self) -> dict[str, str]:
        """Dtypes of the per-step arrays that all episodes have, by name."""
        return dict(sorted((self._extras or {}).items()))

    def steps_of_tasks(self) -> list[int]:
        """Number of snapshot steps of every task."""
        return list(Counter(key.task for key in self.keys).values())

    def add(self, part: ReadPart) -> None:
        """Adds a part.

        Raises:
            StoreError: it stands in the files twice, or does not fit the parts before it.
        """
        assert part.task is not None
        key = PartKey(part.task, part.step)
        if not 0 <= min(key.task, key.step) <= max(key.task, key.step) < MAX_INDEX:
            raise StoreError(f"{key}: task and step must be from 0 to {MAX_INDEX - 1}")
        if key in self.keys:
            raise StoreError(
                f"{key} is in the files twice; give every file its task, or import them apart and merge"
            )
        self.keys.add(key)
        self._add_task(part)
        for trajectory in part.trajectories:
            sizes = (trajectory.observations.shape[1], trajectory.actions.shape[1])
            if min(sizes) < 1:
                raise StoreError(f"{key}: observations and actions have {sizes} columns, 1 is the least")
            if self.episodes and sizes != (self.observation_dim, self.action_dim):
                raise StoreError(
                    f"{key}: observations and actions have {sizes} columns, those of the parts before "
                    f"{(self.observation_dim, self.action_dim)}"
                )
            self.observation_dim, self.action_dim = sizes
            self.episodes += 1
            self.steps += len(trajectory)
            self.horizon = max(self.horizon, len(trajectory))
            found = self.named_types({name: array.dtype for name, array in trajectory.extras.items()})
            before = found if self._extras is None else self._extras
            self._extras = dict(found.items() & before.items())
            if len(self._extras) > MAX_ARRAYS - len(STANDARD_ARRAYS):
                raise StoreError(
                    f"{key}: has {len(found)} further arrays, a part has at most {MAX_ARRAYS} in all"
                )

    @staticmethod
    def named_types(types: Mapping[str, Any]) -> dict[str, str]:
        """The names of dtypes."""
        return {name: str(np.dtype(dtype)) for name, dtype in types.items()}

    def _add_task(self, part: ReadPart) -> None:
        assert part.task is not None
        hidden = hidden_text(dict(part.about.parameters))
        if hidden is not None:
            place = printable(hidden)[:200]
            raise StoreError(f"task {part.task}: parameters {place} hold control characters")
        task = Task(part.task, part.about.split or "train", dict(part.about.parameters))
        known = self.tasks.setdefault(part.task, task)
        if known != task:
            raise StoreError(f"task {part.task}: two files give it different parameters or splits")
