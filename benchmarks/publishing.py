"""Measures the shares of fsync and of hashing in the time of a unit of work. Prints JSON.

`python benchmarks/publishing.py [ENV]`; one task of the quick profile, in this process.
"""

import hashlib
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch

import tcmrl_data
from tcmrl_data.building.plan import BuildPlan, UnitSpec, run_unit
from tcmrl_data.foundation import disk as publish
from tcmrl_data.foundation import records
from tcmrl_data.foundation.disk import Disk, make_folders
from tcmrl_data.recipe.recipe import choose_tasks


class Stopwatch:
    """Adds up the time spent in the functions that it wraps."""

    def __init__(self) -> None:
        self.seconds, self.calls = 0.0, 0

    def __call__(self, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            started = time.perf_counter()
            try:
                return function(*arguments)
            finally:
                self.seconds += time.perf_counter() - started
                self.calls += 1

        return timed


def main() -> None:
    """Runs one unit with every sync and every hash timed."""
    torch.set_num_threads(1)
    recipe = tcmrl_data.load_recipe(sys.argv[1] if len(sys.argv) > 1 else "point-robot-wind", profile="quick")
    (task,) = choose_tasks(recipe)[:1]
    syncs, hashes = Stopwatch(), Stopwatch()
    disk = Disk()
    disk.sync = syncs(disk.sync)  # type: ignore[method-assign]
    publish.disk = disk
    records.hashlib = SimpleNamespace(sha256=hashes(hashlib.sha256))  # type: ignore[assignment]
    with tempfile.TemporaryDirectory(dir=".") as folder:
        dataset = Path(folder).resolve() / "data"
        make_folders(dataset)
        started = time.perf_counter()
        run_unit(UnitSpec(dataset, BuildPlan(recipe, 0, (task,))), lambda message: None)
        seconds = time.perf_counter() - started
        size = sum(path.stat().st_size for path in dataset.rglob("*") if path.is_file())
    shares = {
        name: {
            "calls": watch.calls,
            "seconds": round(watch.seconds, 4),
            "share": round(watch.seconds / seconds, 5),
        }
        for name, watch in (("fsync", syncs), ("sha256", hashes))
    }
    document = {"environment": recipe.environment.name, "unit_seconds": round(seconds, 2), "bytes": size}
    print(json.dumps(document | shares))


if __name__ == "__main__":
    main()
