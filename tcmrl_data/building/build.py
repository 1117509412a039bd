"""Building a dataset: choose tasks, refuse what cannot work, run units on an engine, keep what is done."""

import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from tcmrl_data.building.driver import Driver
from tcmrl_data.building.events import BuildEvent, EventLog
from tcmrl_data.building.ledger import Ledger
from tcmrl_data.building.plan import plan_build
from tcmrl_data.building.work_files import ASSEMBLY, WORK_FILES, WORK_FOLDERS, check_work_files
from tcmrl_data.engine.base import BaseEngine, make_engine
from tcmrl_data.foundation.canonical import differences
from tcmrl_data.foundation.disk import LOCK, lock_file, make_folders, remove_abandoned
from tcmrl_data.foundation.errors import BuildError, ReadOnlyError, StorageError
from tcmrl_data.foundation.machine import size
from tcmrl_data.recipe.recipe import Recipe, full_settings
from tcmrl_data.store.keys import PARTS
from tcmrl_data.store.manifest import MANIFEST, MANIFEST_COPY, read_manifest
from tcmrl_data.store.part import DATA_VERSION
from tcmrl_data.store.part_table import PARTS_TABLE
from tcmrl_data.store.tables import TASKS

SEEDS = 2**63
"""Seeds are stored as int64, in exports too."""

OWN_FILES = {MANIFEST, TASKS, PARTS_TABLE, PARTS} | WORK_FILES | WORK_FOLDERS


@dataclass(frozen=True)
class BuildReport:
    """What a build did.

    Attributes:
        built: parts made now.
        present: parts that were there, with the recorded sizes.
        failed: one line per unit that failed.
        root: Merkle root of the dataset as it now stands.
        read_only: the folder cannot be written, and nothing had to be.
    """

    dataset: Path
    built: int
    present: int
    failed: tuple[str, ...]
    seconds: float
    root: str
    read_only: bool


def build_dataset(
    recipe: Recipe,
    out: Path,
    *,
    seed: int = 0,
    tasks: Sequence[int] | None = None,
    dropped: Sequence[int] = (),
    workers: int | None = None,
    engine: str | BaseEngine = "local",
    address: str | None = None,
    progress: Callable[[BuildEvent], None] = lambda event: None,
) -> BuildReport:
    """Builds what is missing of a dataset; a finished one is left as it is.

    Args:
        recipe: what to build.
        out: dataset folder: new, empty, or a dataset of the same recipe and seed, which is extended.
        seed: root seed of behavior training and rollouts.
        tasks: indices of the full task set instead of the profile's choice.
        dropped: indices of tasks that the dataset is to do without; their parts stay on disk, and a later
            build that names them in `tasks` takes them up again.
        workers: units run at the same time; as many as the engine has cores where None.
        engine: an engine's name, or an engine, which has its own workers and address.
        address: of the engine's cluster, where it has one.
        progress: called as the build goes on.

    Raises:
        BuildError: a seed outside [0, 2**63), `out` is no dataset, or one of other settings or another seed.
        LockedError: another process builds this dataset.
        StoreError: a published part is damaged.
        ReadOnlyError: the folder cannot be written, and something is missing.
        StorageError: too little free space, or the disk refused; what was published stands.
    """
    started = time.monotonic()
    if not 0 <= seed < SEEDS:
        raise BuildError(f"seed {seed} is not in [0, 2**63); choose a smaller --seed")
    runner = make_engine(engine, workers, address)
    plan = plan_build(recipe, seed=seed, tasks=tasks, dropped=dropped)
    _check_folder(out, recipe, seed)
    plan.check_limits()
    make_folders(out)
    failed: tuple[str, ...] = ()
    read_only = False
    try:
        with lock_file(out / LOCK, f"dataset {out}"):
            remove_abandoned(out)
            ledger = Ledger(plan, out, taken_up=tasks or ())
            ledger.plan.check_limits()
            _check_space(out, ledger.num_missing * plan.part_bytes, ledger.num_missing)
            present = ledger.num_parts
            if ledger.num_missing:
                with EventLog(out, progress) as log:
                    failed = Driver(ledger, out.resolve()).run(runner, log)
            elif not ledger.is_sealed():
                ledger.begin()
    except ReadOnlyError:
        ledger = Ledger(plan, out, taken_up=tasks or ())
        present, read_only = ledger.num_parts, True
        if ledger.num_missing or not ledger.is_sealed():
            raise
    seconds = time.monotonic() - started
    return BuildReport(out, ledger.num_parts - present, present, failed, seconds, ledger.root, read_only)


def _check_folder(out: Path, recipe: Recipe, seed: int) -> None:
    """Refuses a folder that is neither new nor a dataset of this recipe and seed."""
    if not out.exists():
        return
    is_dataset = (out / MANIFEST).is_file()  # files of others beside the data are `verify`'s to name
    if not out.is_dir() or (not is_dataset and {entry.name for entry in out.iterdir()} - OWN_FILES):
        raise BuildError(f"--out {out} exists and is no dataset; choose another folder")
    check_work_files(out)
    if (out / ASSEMBLY).exists() and not is_dataset:
        raise BuildError(f"{out} holds the beginning of a derived dataset; use another --out")
    if not is_dataset and (out / MANIFEST_COPY).exists():
        raise BuildError(f"{out} has lost its {MANIFEST}; `tcmrl-data repair {out}` restores it")
    if not is_dataset:
        return
    manifest = read_manifest(out)
    if manifest.derivation is not None or manifest.runs[0].kind != "built":
        raise BuildError(f"{out} holds parts that no build makes; use another --out")
    if manifest.data_version != DATA_VERSION:
        raise BuildError(
            f"{out} has data version {manifest.data_version}, not {DATA_VERSION}; use another --out"
        )
    if manifest.seed != seed:
        raise BuildError(f"{out} was built with seed {manifest.seed}, not {seed}; use another --out")
    old, new = (full_settings(of.unit_settings()) for of in (manifest.recipe, recipe))
    for place, there, here in differences(old, new):
        raise BuildError(
            f"{out} was built with other settings: {place} is {there} there and {here} here; "
            "use another --out"
        )


def _check_space(out: Path, needed: int, num_parts: int) -> None:
    """Refuses a build that the disk has no room for, arrays counted before compression."""
    free = shutil.disk_usage(out).free
    if needed > free:
        raise StorageError(
            f"{out}: {num_parts} parts take up to {size(needed)}, {size(free)} are free; "
            "make room or build fewer --tasks at a time"
        )
