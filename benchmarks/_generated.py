"""Writes datasets of random numbers in any size with the code that writes real ones, for benchmarks."""

from pathlib import Path

import numpy as np

import tcmrl_data
from tcmrl_data.behavior.base import GaussianDescription, Snapshot
from tcmrl_data.building.ledger import Ledger
from tcmrl_data.building.plan import BuildPlan
from tcmrl_data.envs.base import Environment, Task
from tcmrl_data.envs.rollout import Trajectory
from tcmrl_data.foundation.disk import STAGING, make_folders, replace_file
from tcmrl_data.foundation.records import sealed, sha256
from tcmrl_data.parts.making import Published, make_part
from tcmrl_data.parts.operation import WantedPart
from tcmrl_data.recipe.recipe import choose_tasks
from tcmrl_data.store.manifest import MANIFEST, read_manifest
from tcmrl_data.store.part import PartRecord, References
from tcmrl_data.store.part_table import HEADER, PARTS_TABLE, PartEntry, PartTable, part_line
from tcmrl_data.store.tables import PartKey, TableWriter, part_file, part_folder

STEPS = 10_000
"""Environment steps between two snapshots."""

HIDDEN = (64, 64)
"""Widths of the layers of the parts' policies."""

TASKS_AT_ONCE = 500
"""Tasks whose made-up lines are in memory at the same time."""


def generate_dataset(
    folder: Path, environment_name: str, *, tasks: int, snapshots: int, episodes: int, seed: int = 0
) -> int:
    """Writes a dataset of training tasks whose episodes are white noise of the full horizon.

    The code that builds datasets creates, hashes and publishes every file; only simulation and policy
    training are omitted. Noise compresses worse than the data of a simulator.

    Args:
        folder: folder of the dataset; a dataset of the same arguments is kept.
        environment_name: gives observation and action size and the horizon.
        tasks: number of training tasks, the first of the task set.
        snapshots: number of parts per task.
        episodes: number of episodes per part.
        seed: seed of the noise.

    Returns:
        The number of transitions.
    """
    plan = plan_noise(environment_name, tasks=tasks, snapshots=snapshots, episodes=episodes, seed=seed)
    make_folders(folder)
    ledger = Ledger(plan, folder)
    ledger.begin()
    for task in plan.tasks:
        for key in ledger.missing(task.index):
            record, archive = noise_part(plan, task, key.step)
            replace_file(folder / part_file(key), archive, staging=folder / STAGING)
            ledger.take_in(Published.of_record(record, run=key.run, archive=archive))
    ledger.seal()
    return tasks * snapshots * episodes * plan.environment.settings.horizon


def plan_noise(
    environment_name: str, *, tasks: int, snapshots: int, episodes: int, seed: int = 0
) -> BuildPlan:
    """The plan of `generate_dataset`; arguments as there."""
    steps = [STEPS * i for i in range(snapshots)]
    overrides = (
        f"behavior.sac.snapshots={steps}",
        f"behavior.sac.steps={max(steps[-1], STEPS)}",
        f"rollouts.episodes={episodes}",
        "rollouts.lanes=1",
    )
    recipe = tcmrl_data.load_recipe(environment_name, overrides=overrides, behavior="sac")
    chosen = [task for task in choose_tasks(recipe) if task.split == "train"][:tasks]
    return BuildPlan(recipe, seed, tuple(chosen))


def noise_part(plan: BuildPlan, task: Task, step: int) -> tuple[PartRecord, bytes]:
    """The record and the archive of a part whose episodes are white noise."""
    random = np.random.default_rng([plan.seed, task.index, step])
    trajectories = [_noise(random, plan.environment) for _ in range(plan.recipe.rollouts.episodes)]
    description = GaussianDescription(
        observation="stored",
        observation_dim=plan.environment.observation_dim,
        action_dim=plan.environment.action_dim,
        hidden=HIDDEN,
    )
    tensors = {
        name: random.standard_normal(shape, dtype=np.float32) for name, shape in description.shapes().items()
    }
    snapshot = Snapshot(step, description, tensors)
    return make_part(
        WantedPart(plan.recipe.unit_settings(), task, step, plan.seed, snapshot),
        trajectories,
        references=References(uniform=-1.0, oracle=0.0, scripted=None),
        behavior={"generated": "white noise"},
        platform=plan.platform,
    )


def _noise(random: np.random.Generator, environment: Environment) -> Trajectory:
    steps = environment.settings.horizon
    truncated = np.zeros(steps, dtype=bool)
    truncated[-1] = True
    return Trajectory(
        random.standard_normal((steps + 1, environment.observation_dim), dtype=np.float32),
        random.uniform(-1, 1, (steps, environment.action_dim)).astype(np.float32),
        random.standard_normal(steps, dtype=np.float32),
        np.zeros(steps, dtype=bool),
        truncated,
        {name: np.zeros(steps, dtype) for name, dtype in environment.extras.items()},
    )


def plan_many(num_tasks: int, snapshots: int) -> BuildPlan:
    """The plan of a dataset of many small parts: point-robot, one episode of 20 steps a part."""
    steps = [STEPS * i for i in range(snapshots)]
    overrides = (
        f"environment.tasks={num_tasks}",
        f"environment.train={num_tasks - 1}",
        f"behavior.sac.snapshots={steps}",
        f"behavior.sac.steps={max(steps[-1], STEPS)}",
        "rollouts.episodes=1",
        "rollouts.lanes=1",
    )
    recipe = tcmrl_data.load_recipe("point-robot", overrides=overrides, behavior="sac")
    return tcmrl_data.plan_build(recipe, tasks=range(num_tasks))


def write_many(folder: Path, plan: BuildPlan, *, num_tasks: int, file_bytes: int | None = None) -> PartTable:
    """Writes the tables and the manifest of a dataset whose parts are made up.

    Args:
        folder: of the dataset; new.
        plan: of the dataset.
        num_tasks: the first tasks, which have all parts; the others have none.
        file_bytes: size of a made-up file in the place of every archive; None for no files.

    Returns:
        The table of the parts.
    """
    make_folders(folder)
    Ledger(plan, folder).begin()
    content = bytes(file_bytes or 0)
    writer, table = TableWriter(folder / PARTS_TABLE, HEADER), PartTable.empty()
    for first in range(0, num_tasks, TASKS_AT_ONCE):
        tasks = plan.tasks[first : min(first + TASKS_AT_ONCE, num_tasks)]
        entries = [
            _made_up(PartKey(task.index, step), len(content)) for task in tasks for step in plan.source.steps
        ]
        writer.append(b"".join(map(part_line, entries)))
        table = table.with_entries(entries)
        if file_bytes is not None:
            for entry in entries:
                (folder / part_folder(entry.key)).mkdir(parents=True, exist_ok=True)
                (folder / part_file(entry.key)).write_bytes(content)
    writer.sync()
    fields = read_manifest(folder).model_dump(mode="json", exclude={"digest"})
    fields |= {
        "platforms": [plan.platform.model_dump(mode="json")],
        "parts": writer.seal.model_dump(),
        "totals": {"parts": len(table), "bytes": table.total("size")}
        | {name: table.total(name) for name in ("episodes", "steps")},
        "root": table.root,
        "complete": num_tasks == len(plan.tasks),
    }
    replace_file(folder / MANIFEST, sealed(fields))
    return table


def _made_up(key: PartKey, size: int) -> PartEntry:
    """The line of a part with digests and returns that differ from every other part's."""
    text = sha256(str(key).encode())
    mean = -int(text[:12], 16) / 2**48
    return PartEntry(
        *(*key, text, text[::-1], size, 0, 1, 20, mean, 0.0, mean, mean, None, -mean, 0.1 + mean, None)
    )
