"""The source `stacked`: trains the SAC agents of a group of tasks in lockstep.

Algorithm and settings are those of the source `sac`. Every agent has its own replay buffer, entropy
coefficient and random streams, so that only rounding may depend on the group.
"""

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any, Literal, final

import numpy as np
from pydantic import Field

from tcmrl_data.behavior.base import BehaviorContext, Snapshot
from tcmrl_data.behavior.sac import SacSettings, SacTraining
from tcmrl_data.envs.base import Environment, Task
from tcmrl_data.foundation.errors import BuildError

REPORT_EVERY = 20
"""Environment steps of the group between two reports of progress; a checkpoint is written between them."""


class StackedSettings(SacSettings):
    """The `[behavior.stacked]` table: that of `sac`, and the grouping of tasks.

    Attributes:
        group: task indices per group, by default ours, since larger groups gain little; part of the data's
            identity, because it may change rounding.
        device: device of networks and replay buffers; devices round differently.
        matmul_precision: torch's precision of float32 matrix products in training. `medium` multiplies in
            bfloat16 on processors that support it: faster, with errors up to about 1e-2 of a product's
            standard deviation, which are measured and recorded with every part.
    """

    group: int = Field(default=10, ge=1)
    device: Literal["cpu", "cuda"] = "cpu"
    matmul_precision: Literal["highest", "medium"] = "highest"


@final
class StackedSource(SacTraining):
    """Trains all tasks of a unit together."""

    name = "stacked"
    Settings = StackedSettings
    extends = "sac"
    settings: StackedSettings

    @property
    def group_size(self) -> int:
        return self.settings.group

    def training_bytes(self, environment: Environment, num_tasks: int) -> int:
        return self.agents_bytes(environment, num_agents=num_tasks)

    def provenance(self) -> Mapping[str, Any]:
        settings = self.settings
        if settings.matmul_precision == "highest":
            return {}
        with _matmul_precision(settings.matmul_precision):
            error = _matmul_error(settings.batch_size, settings.hidden[-1], settings.device)
        return {"matmul_precision": settings.matmul_precision, "matmul_error": error}

    def snapshots(self, context: BehaviorContext) -> Iterator[tuple[Task, Snapshot]]:
        """Yields every (task, snapshot) of the unit, except policies with weights that are not finite.

        Raises:
            BuildError: the device does not exist; or, after the last snapshot, a task's training diverged.
        """
        from tcmrl_data.behavior.stacked_training import GroupTraining

        checkpoints = context.checkpoints(context.tasks)
        diverged: dict[int, int] = {}
        with contextlib.closing(GroupTraining(context, self.settings)) as training:
            checkpoint = checkpoints.load()
            steps_done = -1
            if checkpoint is not None:
                training.restore(checkpoint)
                steps_done = training.steps
                diverged |= {int(task): step for task, step in checkpoint.values["failed"].items()}
                context.report(steps_done * len(context.tasks))
            for step in self.settings.snapshots:
                with checkpoints.training():
                    while training.steps < step:
                        if checkpoints.is_due():
                            checkpoints.save(training.capture(failed=diverged))
                        chunk = min(REPORT_EVERY, step - training.steps)
                        with _matmul_precision(self.settings.matmul_precision):
                            for _ in range(chunk):
                                training.advance()
                        context.report(chunk * len(context.tasks))
                for agent, task in enumerate(context.tasks if step > steps_done else ()):
                    snapshot = training.snapshot(agent)
                    if all(np.isfinite(array).all() for array in snapshot.tensors.values()):
                        yield task, snapshot
                    else:
                        diverged.setdefault(task.index, step)
        if diverged:
            places = ", ".join(f"task {index} by step {step}" for index, step in diverged.items())
            raise BuildError(f"behavior training diverged: {places}; use a smaller behavior learning_rate")


@contextlib.contextmanager
def _matmul_precision(precision: str) -> Iterator[None]:
    import torch

    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision(precision)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def _matmul_error(rows: int, width: int, device: str) -> float:
    """Largest error of a product of standard normal matrices, in standard deviations of the product."""
    import torch

    generator = torch.Generator().manual_seed(0)
    left = torch.randn(1, rows, width, generator=generator)
    right = torch.randn(1, width, width, generator=generator)
    product = torch.bmm(left.to(device), right.to(device)).cpu().double()
    exact = torch.bmm(left.double(), right.double())
    return float((product - exact).abs().max() / exact.std())
