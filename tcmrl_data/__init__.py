"""tcmrl_data makes, keeps and serves datasets for offline meta-reinforcement learning.

This is the whole public API; names load on first use, so that looking at a dataset needs neither torch
nor Stable-Baselines3.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tcmrl_data.behavior.base import BEHAVIOR_SOURCES
    from tcmrl_data.behavior.snapshot import import_sac
    from tcmrl_data.build.build import BuildReport, build_dataset
    from tcmrl_data.build.events import BuildEvent, BuildStatus, build_status
    from tcmrl_data.build.plan import Plan, plan_build
    from tcmrl_data.dataset.dataset import Dataset, open_dataset
    from tcmrl_data.dataset.listing import list_datasets
    from tcmrl_data.dataset.returns import return_table
    from tcmrl_data.dataset.selection import Selection
    from tcmrl_data.engine.base import ENGINES, Unit
    from tcmrl_data.engine.worker import serve
    from tcmrl_data.envs.base import (
        ENVIRONMENTS,
        Environment,
        Lanes,
        make_environment,
    )
    from tcmrl_data.envs.controller import Controller, Transition, UniformController
    from tcmrl_data.envs.recorder import Recorder
    from tcmrl_data.envs.rollout import roll_out
    from tcmrl_data.envs.tasks import Task, draw_tasks
    from tcmrl_data.envs.trajectory import Trajectory
    from tcmrl_data.foundation.canonical import canonical_json, parse_json
    from tcmrl_data.foundation.errors import CheckpointError, SelectionError, TcmrlError, TrainingError
    from tcmrl_data.foundation.plugins import plugin
    from tcmrl_data.foundation.seeding import NO_TASK, Purpose, keyed_generator, keyed_seed
    from tcmrl_data.interchange.formats.base import FORMATS
    from tcmrl_data.recipe.recipe import (
        PROFILES,
        Recipe,
        apply_overrides,
        first_problem,
        list_environments,
        load_recipe,
    )
    from tcmrl_data.recipe.tasks import parse_indices
    from tcmrl_data.sampling.batch import Batch, BatchSizes, Moments, Steps
    from tcmrl_data.sampling.cache import (
        CacheEntry,
        cache_folder,
        cache_limit,
        clear_cache,
        list_cache,
        parse_bytes,
    )
    from tcmrl_data.sampling.prefetch import Prefetch
    from tcmrl_data.sampling.sampler import Sampler
    from tcmrl_data.store.manifest import Manifest
    from tcmrl_data.verification.garbage import Garbage, collect_garbage
    from tcmrl_data.verification.repair import RepairReport, repair_dataset
    from tcmrl_data.verification.replay import Replay
    from tcmrl_data.verification.verify import Finding, VerifyLevel, VerifyReport, verify_dataset

_HOMES = {
    "build.build": ("BuildReport", "build_dataset"),
    "foundation.canonical": ("canonical_json", "parse_json"),
    "dataset.dataset": ("Dataset", "open_dataset"),
    "foundation.plugins": ("plugin",),
    "engine.base": ("ENGINES", "Unit"),
    "engine.worker": ("serve",),
    "envs.base": (
        "ENVIRONMENTS",
        "Environment",
        "Lanes",
        "make_environment",
    ),
    "envs.controller": ("Controller", "Transition", "UniformController"),
    "envs.recorder": ("Recorder",),
    "foundation.errors": ("CheckpointError", "SelectionError", "TcmrlError", "TrainingError"),
    "build.events": ("BuildEvent", "BuildStatus", "build_status"),
    "dataset.listing": ("list_datasets",),
    "store.manifest": ("Manifest",),
    "build.plan": ("Plan", "plan_build"),
    "recipe.recipe": (
        "PROFILES",
        "Recipe",
        "apply_overrides",
        "first_problem",
        "list_environments",
        "load_recipe",
    ),
    "dataset.returns": ("return_table",),
    "envs.rollout": ("roll_out",),
    "sampling.sampler": ("Sampler",),
    "sampling.batch": ("Batch", "BatchSizes", "Moments", "Steps"),
    "sampling.cache": (
        "CacheEntry",
        "cache_folder",
        "cache_limit",
        "clear_cache",
        "list_cache",
        "parse_bytes",
    ),
    "sampling.prefetch": ("Prefetch",),
    "foundation.seeding": ("NO_TASK", "Purpose", "keyed_generator", "keyed_seed"),
    "dataset.selection": ("Selection",),
    "behavior.base": ("BEHAVIOR_SOURCES",),
    "interchange.formats.base": ("FORMATS",),
    "behavior.snapshot": ("import_sac",),
    "envs.tasks": ("Task", "draw_tasks"),
    "recipe.tasks": ("parse_indices",),
    "envs.trajectory": ("Trajectory",),
    "verification.garbage": ("Garbage", "collect_garbage"),
    "verification.repair": ("RepairReport", "repair_dataset"),
    "verification.replay": ("Replay",),
    "verification.verify": ("Finding", "VerifyLevel", "VerifyReport", "verify_dataset"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "BEHAVIOR_SOURCES",
    "ENGINES",
    "ENVIRONMENTS",
    "FORMATS",
    "NO_TASK",
    "PROFILES",
    "Batch",
    "BatchSizes",
    "BuildEvent",
    "BuildReport",
    "BuildStatus",
    "CacheEntry",
    "CheckpointError",
    "Controller",
    "Dataset",
    "Environment",
    "Finding",
    "Garbage",
    "Lanes",
    "Manifest",
    "Moments",
    "Plan",
    "Prefetch",
    "Purpose",
    "Recipe",
    "Recorder",
    "RepairReport",
    "Replay",
    "Sampler",
    "Selection",
    "SelectionError",
    "Steps",
    "Task",
    "TcmrlError",
    "TrainingError",
    "Trajectory",
    "Transition",
    "UniformController",
    "Unit",
    "VerifyLevel",
    "VerifyReport",
    "apply_overrides",
    "build_dataset",
    "build_status",
    "cache_folder",
    "cache_limit",
    "canonical_json",
    "clear_cache",
    "collect_garbage",
    "draw_tasks",
    "first_problem",
    "import_sac",
    "keyed_generator",
    "keyed_seed",
    "list_cache",
    "list_datasets",
    "list_environments",
    "load_recipe",
    "make_environment",
    "open_dataset",
    "parse_bytes",
    "parse_indices",
    "parse_json",
    "plan_build",
    "plugin",
    "repair_dataset",
    "return_table",
    "roll_out",
    "serve",
    "verify_dataset",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOME_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
