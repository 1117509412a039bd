"""Compares how fast two checkouts handle data: `python benchmarks/paired_speed.py OLD NEW`. Prints JSON.

Each checkout has its own `.venv`, as `make test` makes it. Both work on the same datasets, by turns, each
time in a new process. `ratio` is the median over the rounds of new / old, below 1 where the new one is
faster.
"""

import argparse
import json
import os
import subprocess
import tempfile
from pathlib import Path

from _generated import generate_dataset, plan_many, write_many
from _timing import Measured, median, rounded, seconds

SNAPSHOTS = 100
"""Parts of a task in the datasets of many parts."""

START = """
import contextlib, gc, json, pathlib, sys, tempfile, time
import tcmrl_data
from tcmrl_data.sampling.rows import read_rows
small, folder = sys.argv[1:]

def sampler():
    kinds = {"policy": tcmrl_data.Transitions(64), "context": tcmrl_data.Trajectories(2)}
    request = tcmrl_data.BatchRequest(tasks=4, kinds=kinds)
    return tcmrl_data.open_sampler(tcmrl_data.open_dataset(folder).select(), request, seed=0)

def measured(run):
    gc.collect()  # else what the imports left is collected within one side's measure by chance
    began, used = time.perf_counter(), time.process_time()
    run()
    return [time.perf_counter() - began, time.process_time() - used]
"""

OPEN = """
def run(place):
    dataset = tcmrl_data.open_dataset(place)
    return len(dataset.parts) + len(dataset.tasks)

run(small)
print(json.dumps(measured(lambda: run(folder))))
"""

WORK = {
    "read": """
selection = tcmrl_data.open_dataset(folder).select()
read_rows(selection)
print(json.dumps(measured(lambda: read_rows(selection))))
""",
    "sample": """
batches = sampler()
batches.batch(0)
print(json.dumps(measured(lambda: [batches.batch(n) for n in range(1, 500)])))
""",
    "publish": """
with tempfile.TemporaryDirectory(dir=pathlib.Path(folder).parent) as out:
    tcmrl_data.derive_dataset(small, pathlib.Path(out) / "small", episodes=1)
    target = pathlib.Path(out) / "cut"
    print(json.dumps(measured(lambda: tcmrl_data.derive_dataset(folder, target, episodes=9))))
""",
    "first batch": """
sampler().batch(0)
print(json.dumps([0.0, time.process_time()]))
""",
}
"""What is measured on a dataset of real parts. `first batch` is a whole process, with its imports."""


def main() -> None:
    """Makes the datasets and measures everything by turns."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--parts", type=int, nargs="+", default=[1_000, 225_000], help="of datasets to open")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--folder", type=Path, default=Path(), help="where to make datasets")
    asked = parser.parse_args()
    checkouts = [asked.old.resolve(), asked.new.resolve()]
    with tempfile.TemporaryDirectory(dir=asked.folder) as temporary:
        root = Path(temporary).resolve()
        generate_dataset(root / "small", "half-cheetah-vel", tasks=2, snapshots=2, episodes=2)
        generate_dataset(root / "real", "half-cheetah-vel", tasks=20, snapshots=4, episodes=10)
        found = {
            name: race(checkouts, code, root / "small", root / "real", asked.rounds)
            for name, code in WORK.items()
        }
        for parts in asked.parts:
            tasks = parts // SNAPSHOTS
            write_many(root / f"many-{parts}", plan_many(tasks, SNAPSHOTS), num_tasks=tasks)
            found[f"open {parts} parts"] = race(
                checkouts, OPEN, root / "small", root / f"many-{parts}", asked.rounds
            )
    load = [rounded(one) for one in os.getloadavg()]
    print(json.dumps({"benchmark": "paired_speed", **found, "load_average": load}, indent=1))


def race(checkouts: list[Path], code: str, small: Path, folder: Path, rounds: int) -> Measured:
    """Seconds of both checkouts by turns, after a round that does not count."""
    times = [[once(checkout, code, small, folder) for checkout in checkouts] for _ in range(rounds + 1)][1:]
    return {
        name: {
            "old": median([old[clock] for old, _ in times]),
            "new": median([new[clock] for _, new in times]),
            "ratio": median([new[clock] / old[clock] for old, new in times]),
        }
        for clock, name in enumerate(("s", "processor_s"))
    }


def once(checkout: Path, code: str, small: Path, folder: Path) -> list[float]:
    """Wall time and processor time of a measure, in a new process of a checkout."""
    command = [str(checkout / ".venv/bin/python"), "-c", START + code, str(small), str(folder)]
    printed = ""

    def run() -> None:
        nonlocal printed
        printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, cwd=checkout).stdout

    whole = seconds(run)
    wall, processor = json.loads(printed)
    return [wall or whole, processor]


if __name__ == "__main__":
    main()
