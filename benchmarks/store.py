"""Measures the store, one archive a part, beside the earlier one, a folder a part. Prints a JSON document.

`python benchmarks/store.py [--parts N] [--quick] [--folder FOLDER]`; about ten minutes and 3 GB of disk,
`--quick` a minute. Datasets are made in a temporary folder in FOLDER and deleted.

`before` and `after` are measured in turns in one run; numbers are medians over the repetitions, `ratio` is
the median of before / after within a repetition. Small parts are of about 50 kB, large ones of about 2 MB;
they hold white noise and a policy, and are made by the code that makes real parts. The datasets of many parts
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

from _folders import folder_files, hash_folders, open_folders, publish_folder, read_folder_rows
from _generated import generate_dataset
from _many_parts import measure_many, measure_open
from _timing import REPEATS, Measured, forget, median, race, rounded, seconds

import tcmrl_data
from tcmrl_data.foundation.disk import STAGING, make_folders, replace_file
from tcmrl_data.foundation.machine import available_cores
from tcmrl_data.parts.making import Published
from tcmrl_data.sampling.rows import read_rows
from tcmrl_data.store.archive import pack_archive
from tcmrl_data.store.part import this_platform
from tcmrl_data.store.tables import part_file

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
        real = {name: measure_real(root / name, name, arguments.quick) for name in SIZES}
        document = {
            "benchmark": "store",
            **{key: {name: found[key] for name, found in real.items()} for key in real["small"]},
            "open": [measure_open(root / f"open-{count}", count) for count in opened],
            **measure_many(root / "few", 1_000, root / "many", parts),
        }
    document |= {"targets": targets(document), **machine(), "seconds": round(time.monotonic() - started)}
    print(json.dumps(document, indent=1))


def measure_real(folder: Path, name: str, is_quick: bool) -> Measured:
    """Publishing, opening, verifying and reading real parts, in both layouts."""
    tasks, snapshots, episodes = SIZES[name]
    folder.mkdir()
    after, before = folder / "after", folder / "before"
    generate_dataset(
        after, "half-cheetah-vel", tasks=2 if is_quick else tasks, snapshots=snapshots, episodes=episodes
    )
    dataset = tcmrl_data.open_dataset(after)
    places = copy_as_folders(dataset, before)
    return {
        "publish": measure_publish(dataset, folder / "published"),
        "open_part": race(
            lambda: open_folders(before, places),
            lambda: open_all(after),
            per=len(places),
        ),
        "resume_part": race(
            lambda: hash_folders(before, dict(zip(places, open_folders(before, places), strict=True))),
            lambda: tcmrl_data.build_dataset(
                dataset.manifest.recipe, after, tasks=[task.index for task in dataset.tasks]
            ),
            per=len(places),
        ),
        "verify": measure_verify(dataset),
        "rows": measure_rows(dataset, before, places),
    }


def open_all(folder: Path) -> None:
    """Opens a dataset, and then every part."""
    dataset = tcmrl_data.open_dataset(folder)
    for key in dataset.parts:
        dataset.part(*key)


def measure_publish(dataset: tcmrl_data.Dataset, folder: Path) -> Measured:
    """From the encoded arrays to the synced part; archives include their line of the table."""
    made = []
    for key in list(dataset.parts)[:20]:
        with dataset.open_part(key) as archive:
            made.append((key, dataset.part(*key), {name: archive.read(name) for name in archive.names}))
    (folder / "before").mkdir(parents=True)
    counter = iter(range(10**6))

    def publish_folders() -> None:
        for _, record, files in made:
            publish_folder(folder / "before" / str(next(counter)), record, folder_files(files))

    def publish_archives() -> None:
        out = folder / "after" / str(next(counter))
        for key, record, files in made:
            data = pack_archive(files)
            replace_file(out / part_file(key), data, staging=folder / "after" / STAGING)
            Published.of_record(record, run=key.run, archive=data)

    make_folders(folder / "after")
    found = race(publish_folders, publish_archives, per=len(made))
    stored = {
        side: [file for file in (folder / side).rglob("*") if file.is_file()] for side in ("before", "after")
    }
    rounds = len(made) * (REPEATS + 1)
    for side, files in stored.items():
        found[side] |= {
            "bytes": round(sum(file.stat().st_size for file in files) / rounds),
            "files": len(files) / rounds,
        }
    return found


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


def measure_rows(dataset: tcmrl_data.Dataset, before: Path, places: list[str]) -> Measured:
    """Milliseconds a part from a dataset's path to the rows of all its parts, and of reading alone."""
    records = open_folders(before, places)

    def from_path() -> None:
        read_rows(tcmrl_data.open_dataset(dataset.folder).select())

    selection = dataset.select()
    return {
        "opening_and_reading": race(
            lambda: read_folder_rows(before, places, open_folders(before, places)), from_path, per=len(places)
        ),
        "reading": race(
            lambda: read_folder_rows(before, places, records), lambda: read_rows(selection), per=len(places)
        ),
    }


def copy_as_folders(dataset: tcmrl_data.Dataset, folder: Path) -> list[str]:
    """Writes a dataset's parts as folders; returns their places."""
    places = []
    for key in dataset.parts:
        with dataset.open_part(key) as archive:
            files = {name: archive.read(name) for name in archive.names}
        place = f"tasks/{key.task:05d}/snapshots/step_{key.step:07d}"
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        publish_folder(folder / place, dataset.part(*key), folder_files(files))
        places.append(place)
    return places


def targets(document: Measured) -> list[Measured]:
    """What was aimed at: a value, its limit, and whether it holds."""
    few, many = document["driver"]
    reached = [
        *(
            (f"publish {name}, after / before", 1 / found["ratio"], 1 / 4)
            for name, found in document["publish"].items()
        ),
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
        *(
            (f"rows {name}, {what}, after / before", 1 / found[what]["ratio"], 1.05)
            for name, found in document["rows"].items()
            for what in found
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
