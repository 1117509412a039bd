"""tcmrl_data makes, keeps and serves datasets for offline meta-reinforcement learning.

This is the whole public API; names load on first use, so that looking at a dataset needs neither torch
nor Stable-Baselines3.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tcmrl_data.build import BuildReport, build_dataset
    from tcmrl_data.canonical import canonical_json, parse_json
    from tcmrl_data.dataset import Dataset, Selection, list_datasets, open_dataset
    from tcmrl_data.discovery import plugin
    from tcmrl_data.environment import (
        Controller,
        Environment,
        Lanes,
        UniformController,
        environment_types,
        make_environment,
    )
    from tcmrl_data.errors import CheckpointError, SelectionError, TcmrlError, TrainingError
    from tcmrl_data.events import BuildEvent, BuildStatus, build_status
    from tcmrl_data.manifest import Manifest
    from tcmrl_data.plan import Plan, plan_build
    from tcmrl_data.recipe import (
        PROFILES,
        Recipe,
        apply_overrides,
        first_problem,
        list_environments,
        load_recipe,
    )
    from tcmrl_data.returns import return_table
    from tcmrl_data.rollout import roll_out
    from tcmrl_data.sampler import Batch, BatchSizes, Moments, Sampler, Steps
    from tcmrl_data.seeding import NO_TASK, Purpose, keyed_generator, keyed_seed
    from tcmrl_data.tasks import Task, draw_tasks, parse_indices
    from tcmrl_data.trajectory import Trajectory

_HOMES = {
    "build": ("BuildReport", "build_dataset"),
    "canonical": ("canonical_json", "parse_json"),
    "dataset": ("Dataset", "Selection", "list_datasets", "open_dataset"),
    "discovery": ("plugin",),
    "environment": (
        "Controller",
        "Environment",
        "Lanes",
        "UniformController",
        "environment_types",
        "make_environment",
    ),
    "events": ("BuildEvent", "BuildStatus", "build_status"),
    "errors": ("CheckpointError", "SelectionError", "TcmrlError", "TrainingError"),
    "manifest": ("Manifest",),
    "plan": ("Plan", "plan_build"),
    "recipe": ("PROFILES", "Recipe", "apply_overrides", "first_problem", "list_environments", "load_recipe"),
    "returns": ("return_table",),
    "rollout": ("roll_out",),
    "sampler": ("Batch", "BatchSizes", "Moments", "Sampler", "Steps"),
    "seeding": ("NO_TASK", "Purpose", "keyed_generator", "keyed_seed"),
    "tasks": ("Task", "draw_tasks", "parse_indices"),
    "trajectory": ("Trajectory",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "NO_TASK",
    "PROFILES",
    "Batch",
    "BatchSizes",
    "BuildEvent",
    "BuildReport",
    "BuildStatus",
    "CheckpointError",
    "Controller",
    "Dataset",
    "Environment",
    "Lanes",
    "Manifest",
    "Moments",
    "Plan",
    "Purpose",
    "Recipe",
    "Sampler",
    "Selection",
    "SelectionError",
    "Steps",
    "Task",
    "TcmrlError",
    "TrainingError",
    "Trajectory",
    "UniformController",
    "apply_overrides",
    "build_dataset",
    "build_status",
    "canonical_json",
    "draw_tasks",
    "environment_types",
    "first_problem",
    "keyed_generator",
    "keyed_seed",
    "list_datasets",
    "list_environments",
    "load_recipe",
    "make_environment",
    "open_dataset",
    "parse_indices",
    "parse_json",
    "plan_build",
    "plugin",
    "return_table",
    "roll_out",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
