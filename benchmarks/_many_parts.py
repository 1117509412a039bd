"""What the store does with very many parts, for `store.py`; as a script it opens one dataset."""

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path

from _generated import noise_part, plan_many, write_many
from _timing import REPEATS, Measured, median, memory, rounded, seconds

import tcmrl_data
from tcmrl_data.building.ledger import SEAL_SECONDS, SEAL_SHARE, Ledger
from tcmrl_data.foundation.disk import make_folders
from tcmrl_data.parts.making import Published
from tcmrl_data.store.tables import part_file

SNAPSHOTS = 100
NEW_TASKS = 2
"""Tasks whose parts the driver takes in, a hundred each."""

FILE_BYTES = 1_000


def measure_open(folder: Path, num_parts: int) -> Measured:
    """Opening a dataset of made-up parts in processes of their own."""
    num_tasks = num_parts // SNAPSHOTS
    write_many(folder, plan_many(num_tasks, SNAPSHOTS), num_tasks=num_tasks)
    command = [sys.executable, str(Path(__file__).resolve()), str(folder)]
    runs = [
        json.loads(subprocess.run(command, check=True, capture_output=True).stdout) for _ in range(REPEATS)
    ]
    shutil.rmtree(folder)
    found = {name: median([run[name] for run in runs]) for name in runs[0]}
    return {"parts": num_parts, **found, "us_a_part": rounded(1000 * found["ms"] / num_parts)}


def open_once(folder: Path) -> Measured:
    """Milliseconds to open a dataset and to read its tables, and the memory that they take."""
    small = folder.with_name("open-warm")
    if not small.exists():
        write_many(small, plan_many(3, 2), num_tasks=3)
    warm = tcmrl_data.open_dataset(small)
    assert len(warm.parts) and len(warm.tasks)  # loads and compiles what the first use loads
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts from here
    before = memory("VmRSS")
    began, used = time.perf_counter(), time.process_time()
    dataset = tcmrl_data.open_dataset(folder)
    opened = time.perf_counter()
    num_parts = len(dataset.parts) + 0 * len(dataset.tasks)
    ended = time.perf_counter()
    return {
        "manifest_ms": 1000 * (opened - began),
        "ms": 1000 * (ended - began),
        "processor_ms": 1000 * (time.process_time() - used),
        "resident_bytes_a_part": (memory("VmRSS") - before) / num_parts,
        "peak_bytes_a_part": (memory("VmHWM") - before) / num_parts,
    }


def measure_many(few: Path, num_few: int, many: Path, num_parts: int) -> Measured:
    """The driver beside few and many parts; commands and resuming beside many."""
    drivers = [measure_driver(few, num_few), measure_driver(many, num_parts)]
    recipe, num_tasks = tcmrl_data.open_dataset(many).manifest.recipe, num_parts // SNAPSHOTS + NEW_TASKS
    resumed = []
    for _ in range(3):
        report = None

        def resume() -> None:
            nonlocal report
            report = tcmrl_data.build_dataset(recipe, many, tasks=range(num_tasks))

        resumed.append(seconds(resume))
        assert report is not None and (report.built, report.present) == (0, num_tasks * SNAPSHOTS)
    return {
        "driver": drivers,
        "commands": {"parts": num_tasks * SNAPSHOTS, **measure_commands(many)},
        "resume": {"parts": num_tasks * SNAPSHOTS, "s": median(resumed)},
    }


def measure_driver(folder: Path, num_parts: int) -> Measured:
    """Taking in real parts beside parts that are there, and sealing the manifest."""
    num_tasks = num_parts // SNAPSHOTS
    plan = plan_many(num_tasks + NEW_TASKS, SNAPSHOTS)
    write_many(folder, plan, num_tasks=num_tasks, file_bytes=FILE_BYTES)
    began = time.perf_counter()
    ledger = Ledger(plan, folder)
    ledger.begin()
    read = time.perf_counter() - began
    messages = []
    for task in plan.tasks[num_tasks:]:
        for key in ledger.missing(task.index):
            record, archive = noise_part(plan, task, key.step)
            make_folders((folder / part_file(key)).parent)
            (folder / part_file(key)).write_bytes(archive)
            messages.append(Published.of_record(record, run=key.run, archive=archive).to_message())
    ledger.seal()
    taken = []
    for message in messages:
        began = time.perf_counter()
        assert ledger.take_in(Published.from_message(message))
        taken.append(time.perf_counter() - began)
    sealing = seconds(ledger.seal)
    return {
        "parts": num_parts,
        "read_s": rounded(read),
        "take_in_ms": median([1000 * second for second in taken]),
        "seal_ms": rounded(1000 * sealing),
        "seconds_between_seals": rounded(max(SEAL_SECONDS, sealing / SEAL_SHARE)),
    }


def measure_commands(folder: Path) -> Measured:
    """Seconds of whole commands; `start` is a command that reads nothing."""
    program = str(Path(sys.executable).with_name("tcmrl-data"))
    commands = {
        "start": ["--help"],
        "show": ["show", str(folder), "--json"],
        "list": ["list", str(folder.parent), "--json"],
    }

    def measure(words: list[str]) -> float:
        return seconds(lambda: subprocess.run([program, *words], check=True, capture_output=True))

    found: dict[str, list[float]] = {name: [] for name in commands}
    for _ in range(REPEATS):
        for name, words in commands.items():
            found[name].append(measure(words))
    return {f"{name}_s": median(values) for name, values in found.items()}


if __name__ == "__main__":
    print(json.dumps(open_once(Path(sys.argv[1]))))
