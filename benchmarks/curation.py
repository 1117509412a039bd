"""Measures `derive` and `merge` against `cp -r` of the same files, and a view. Prints JSON.

`python benchmarks/curation.py [--tasks 100] [--repeats 3] [--folder FOLDER]`; parts are made up, of 180 kB.
A ratio is the time of `cp -r` divided by ours: 0.5 is half its speed. `cp -r` alone leaves data in memory;
with `sync` it forces them to disk, as ours does.
"""

import argparse
import json
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import tcmrl_data
from tcmrl_data import Dataset, Trajectory, open_dataset
from tcmrl_data.envs.base import draw_tasks
from tcmrl_data.foundation.disk import write_file
from tcmrl_data.parts.making import make_part
from tcmrl_data.parts.operation import WantedPart
from tcmrl_data.store.manifest import Run, write_dataset
from tcmrl_data.store.part import DATA_VERSION, UNKNOWN, References
from tcmrl_data.store.part_table import PartTable, part_entry
from tcmrl_data.store.tables import MAIN_RUN, PartKey, part_file

STEPS = tuple(range(0, 1_000, 100))


def make_dataset(folder: Path, *, tasks: int, rows: int, seed: int) -> Dataset:
    """A dataset of one made-up part per key; only means and ids differ between its parts."""
    recipe = tcmrl_data.load_recipe("point-robot", profile="quick", overrides=["rollouts.lanes=1"])
    drawn, generator = draw_tasks(recipe.make_environment()), np.random.default_rng(seed)
    entries = []
    for task in drawn[:tasks]:
        for step in STEPS:
            ended = np.arange(rows) == rows - 1
            episode = Trajectory(
                generator.normal(size=(rows + 1, 17)).astype(np.float32),
                generator.uniform(-1, 1, (rows, 6)).astype(np.float32),
                np.full(rows, step / 1_000, dtype=np.float32),
                np.zeros(rows, dtype=bool),
                ended,
            )
            record, data = make_part(
                WantedPart(settings=recipe.unit_settings(), task=task, step=step, seed=seed),
                [episode],
                references=References(uniform=0.0, oracle=float(rows), scripted=None),
            )
            file = folder / part_file(PartKey(task.index, step))
            file.parent.mkdir(parents=True, exist_ok=True)
            write_file(file, data)
            entries.append(part_entry(record, run=MAIN_RUN, platform=0, archive=data))
    write_dataset(
        folder,
        label=None,
        data_version=DATA_VERSION,
        runs=[Run(name=MAIN_RUN, kind="built", seed=seed, recipe=recipe, steps=STEPS)],
        derivation=None,
        platforms=[UNKNOWN],
        tasks=[replace(task, split="train") for task in drawn[:tasks]],
        table=PartTable.empty().with_entries(entries),
    )
    return open_dataset(folder)


def timed(function: Callable[[], Any], out: Path) -> float:
    """Seconds of a call that makes `out`, which is removed before."""
    shutil.rmtree(out, ignore_errors=True)
    subprocess.run(["sync"], check=True)
    started = time.perf_counter()
    function()
    return time.perf_counter() - started


def main() -> None:
    """Makes two datasets, measures, prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", type=int, default=100)
    parser.add_argument("--rows", type=int, default=2_000, help="steps of a part; 2,000 take about 200 kB")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--folder", type=Path, default=Path())
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as name:
        folder = Path(name)
        sources = [
            make_dataset(folder / f"seed{seed}", tasks=options.tasks, rows=options.rows, seed=seed)
            for seed in range(2)
        ]
        first, out = sources[0], folder / "out"

        def copy(*folders: Path, then: str = "true") -> Callable[[], Any]:
            places = " ".join(map(str, folders))
            return lambda: subprocess.run(
                ["sh", "-c", f"mkdir {out} && cp -r {places} {out} && {then}"], check=True
            )

        both = [source.folder for source in sources]
        calls: dict[str, Callable[[], Any]] = {
            "cp one": copy(first.folder),
            "cp one, sync": copy(first.folder, then=f"sync -f {out}"),
            "derive": lambda: tcmrl_data.derive_dataset(first, out),
            "cp two": copy(*both),
            "cp two, sync": copy(*both, then=f"sync -f {out}"),
            "merge": lambda: tcmrl_data.merge_datasets(both, out),
        }
        times: dict[str, list[float]] = {call: [] for call in calls}
        for _ in range(options.repeats):
            for call, function in calls.items():
                times[call].append(timed(function, out))
        seconds = {call: statistics.median(found) for call, found in times.items()}
        view = folder / "view.json"
        started = time.perf_counter()
        tcmrl_data.derive_dataset(first.folder, view=view, tier="medium")
        seconds["view of a tier"] = time.perf_counter() - started
        document = {
            "parts": len(first.parts),
            "bytes": first.manifest.totals.bytes,
            "seconds": {call: round(value, 3) for call, value in seconds.items()},
            "ratios": {
                "derive to cp": round(seconds["cp one"] / seconds["derive"], 2),
                "derive to cp with sync": round(seconds["cp one, sync"] / seconds["derive"], 2),
                "merge to cp": round(seconds["cp two"] / seconds["merge"], 2),
                "merge to cp with sync": round(seconds["cp two, sync"] / seconds["merge"], 2),
            },
        }
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
