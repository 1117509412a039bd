"""Commands that make datasets of others, killed at random: `python -m tests.killed_commands --kills 50`."""

import argparse
import json
import shutil
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

import tcmrl_data
from tcmrl_data import derive_dataset, export_dataset
from tests.conftest import TASKS, TINY
from tests.kill_sweep import Case, run_sweep

SNAPSHOTS, SECONDS = 3, 0.1


def cases(folder: Path, tiny: Path) -> dict[str, Case]:
    """The commands by name.

    Args:
        folder: for what they read.
        tiny: the built dataset that all of it is made of.
    """
    for name, tasks in (("left", TASKS[:3]), ("right", TASKS[2:])):
        derive_dataset(tiny, folder / name, tasks=tasks)
    files = export_dataset(tiny, "hdf5", folder / "hdf5").files
    derive_dataset(tiny, folder / "two", tasks=TASKS[:2])
    parts = len(TASKS) * SNAPSHOTS
    extend = ("--episodes", 3, "--snapshots", "all", "--workers", 2)
    return {
        "derive": Case(lambda out: ["derive", tiny, "--tier", "mixed", "--out", out], parts, SECONDS),
        "cut": Case(lambda out: ["derive", tiny, "--episodes", 2, "--out", out], parts, SECONDS),
        "merge": Case(lambda out: ["merge", folder / "left", folder / "right", "--out", out], parts, SECONDS),
        "extend": Case(
            lambda out: ["extend", out, *extend],
            4 * SNAPSHOTS,
            SECONDS,
            has_workers=True,
            begin=lambda out: shutil.copytree(folder / "two", out),
        ),
        "extend to a new dataset": Case(
            lambda out: ["extend", folder / "two", *extend, "--out", out],
            4 * SNAPSHOTS,
            SECONDS,
            has_workers=True,
        ),
        "import": Case(lambda out: ["import", "hdf5", *files, "--out", out], parts, SECONDS),
    }


def main() -> None:
    """Parses, sweeps, prints one line of JSON per command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50, help="of every command")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recipe = tcmrl_data.load_recipe("point-robot", profile="quick", overrides=TINY)
        tcmrl_data.build_dataset(recipe, folder / "tiny", tasks=TASKS, workers=2)
        for command, case in cases(folder, folder / "tiny").items():
            started = time.monotonic()
            figures = run_sweep(case, options.kills, seed=options.seed)
            seconds = round(time.monotonic() - started)
            print(json.dumps({"command": command, **asdict(figures), "seconds": seconds}), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
