"""Measures the store with very many parts, and how fast `verify` reads. Prints a JSON document.

`python benchmarks/store.py [--parts N] [--quick] [--folder FOLDER]`; about ten minutes and 3 GB of disk,
`--quick` a minute. Datasets are made in a temporary folder in FOLDER and deleted.

Numbers are medians over the repetitions. Small parts are of about 50 kB, large ones of about 2 MB; they
hold white noise and a policy, and are made by the code that makes real parts. The datasets of many parts
(`open`, `driver`, `commands`, `resume`) have made-up tables; where files are needed these are of 1 kB and
hold zeros, but for the parts that the driver takes in. Files are in the page cache, but for `cold_verify`
and `cold_read`, before which the system was asked to forget them. Times are wall time unless a name says
otherwise; `load_average` tells whether other programs disturbed them.
"""

import argparse
import hashlib
import json
import os
import tempfile
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from _generated import generate_dataset
from _many_parts import measure_many, measure_open
from _timing import REPEATS, Measured, forget, median, rounded, seconds

import tcmrl_data
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.store.part import this_platform

SIZES = {"small": (20, 10, 1), "large": (10, 4, 115)}
"""Tasks, snapshots and episodes of half-cheetah-vel in the datasets of real parts."""

OPENED = (1_000, 25_000, 225_000, 1_000_000)
"""Numbers of parts of the datasets that are opened."""


def main() -> None:
    """Measures everything and prints it."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--parts", type=int, default=225_000, help="of the datasets of many parts")
    parser.add_argument("--quick", action="store_true", help="few parts, to see that it runs")
    parser.add_argument("--folder", type=Path, default=Path(), help="where to make datasets")
    arguments = parser.parse_args()
    parts = 2_000 if arguments.quick else arguments.parts
    opened = (1_000, 5_000) if arguments.quick else OPENED
    started = time.monotonic()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as temporary:
        root = Path(temporary).resolve()
        verify = {name: measure_verify(real_dataset(root / name, name, arguments.quick)) for name in SIZES}
        document = {
            "benchmark": "store",
            "verify": verify,
            "open": [measure_open(root / f"open-{count}", count) for count in opened],
            **measure_many(root / "few", 1_000, root / "many", parts),
        }
    document |= {"targets": targets(document), **machine(), "seconds": round(time.monotonic() - started)}
    print(json.dumps(document, indent=1))


def real_dataset(folder: Path, name: str, is_quick: bool) -> tcmrl_data.Dataset:
    """A dataset of real parts."""
    tasks, snapshots, episodes = SIZES[name]
    generate_dataset(
        folder, "half-cheetah-vel", tasks=2 if is_quick else tasks, snapshots=snapshots, episodes=episodes
    )
    return tcmrl_data.open_dataset(folder)


def measure_verify(dataset: tcmrl_data.Dataset) -> Measured:
    """Megabytes a second of `verify`, of reading the archives, and of sha256 of the same bytes in memory."""
    files = [dataset.file_of(key) for key in dataset.parts]
    contents = [file.read_bytes() for file in files]
    megabytes = sum(map(len, contents)) / 1e6

    def verify() -> None:
        assert not tcmrl_data.verify_dataset(dataset.folder).findings

    def hash_all() -> None:
        with ThreadPoolExecutor(available_cores()) as pool:
            list(pool.map(lambda content: hashlib.sha256(content).digest(), contents))

    contestants: dict[str, Callable[[], object]] = {
        "verify": verify,
        "sha256": hash_all,
        "read": lambda: [file.read_bytes() for file in files],
    }
    rates: dict[str, list[float]] = {name: [] for name in (*contestants, "cold_verify", "cold_read")}
    for _ in range(REPEATS):
        for name, run in contestants.items():
            rates[name].append(megabytes / seconds(run))
        for name in ("verify", "read"):
            forget(files)
            rates[f"cold_{name}"].append(megabytes / seconds(contestants[name]))
    found = {name: median(values) for name, values in rates.items()}
    found["over_slower"] = median(
        [
            v / min(h, r)
            for v, h, r in zip(rates["cold_verify"], rates["sha256"], rates["cold_read"], strict=True)
        ]
    )
    found["over_sha256"] = median([v / h for v, h in zip(rates["verify"], rates["sha256"], strict=True)])
    return {"unit": "MB/s"} | found


def targets(document: Measured) -> list[Measured]:
    """What was aimed at: a value, its limit, and whether it holds."""
    few, many = document["driver"]
    reached = [
        *((f"open {row['parts']} parts, ms", row["ms"], 50 + row["parts"] / 200) for row in document["open"]),
        *(
            (f"open {row['parts']} parts, bytes a part", row["peak_bytes_a_part"], 1_000)
            for row in document["open"]
            if row["parts"] >= document["resume"]["parts"] / 2
        ),
        *((f"{name}, s", document["commands"][f"{name}_s"], 1) for name in ("show", "list")),
        ("driver, time a part beside many / few", many["take_in_ms"] / few["take_in_ms"], 1.5),
        ("resume, s", document["resume"]["s"], 60),
        *(
            (f"verify {name}, slower / verify", 1 / found["over_slower"], 2)
            for name, found in document["verify"].items()
        ),
    ]
    return [
        {"what": what, "value": rounded(value), "limit": limit, "holds": value <= limit}
        for what, value, limit in reached
    ]


def machine() -> Mapping[str, Any]:
    """Where it was measured, and how busy that was."""
    found = this_platform(tcmrl_data.load_recipe("point-robot").make_environment())
    return {
        "machine": {"cpu": found.cpu, "cores": available_cores(), "system": found.system},
        "load_average": [rounded(load) for load in os.getloadavg()],
        "repeats": REPEATS,
    }


if __name__ == "__main__":
    main()
