"""Forged tables of tasks and parts, and parts at places where they do not belong."""

import json
import os
from collections.abc import Callable
from typing import Any

from tcmrl_data.store.part_table import HEADER, PARTS_TABLE
from tcmrl_data.store.tables import TASKS
from tests.hostile.case import (
    ESCAPE,
    Case,
    Damage,
    Stage,
    in_file,
    special_file,
    with_name,
    with_recipe,
    with_run,
)
from tests.hostile.datasets import PART, Forge


def _tasks(name: str, damage: Damage, words: str, stage: Stage = "tables") -> Case:
    return Case(f"tasks: {name}", damage, TASKS, (words,), stage)


def _parts(name: str, damage: Damage, words: str, stage: Stage = "tables") -> Case:
    return Case(f"parts: {name}", damage, PARTS_TABLE, (words,), stage)


def _raw(table: str, change: Callable[[bytes], bytes]) -> Damage:
    """Other bytes in a table, which the manifest still seals as they were."""

    def damage(forge: Forge) -> None:
        file = forge.folder / table
        file.write_bytes(change(file.read_bytes()))

    return damage


def _sealed(table: str, change: Callable[[bytes], bytes], **lies: int) -> Damage:
    """Other bytes in a table, which the manifest seals."""
    return lambda forge: forge.table(table, change((forge.folder / table).read_bytes()), **lies)


def _task(**fields: Any) -> Damage:
    return lambda forge: forge.rows(TASKS, lambda rows: rows[0].update(fields))


def _parameters(**fields: Any) -> Damage:
    return lambda forge: forge.rows(TASKS, lambda rows: rows[0]["parameters"].update(fields))


def _cell(column: str, value: Any, row: int = 0) -> Damage:
    return lambda forge: forge.cell(row, column, value)


TASK_TABLES = [
    _tasks("missing", lambda f: (f.folder / TASKS).unlink(), "missing"),
    _tasks("a FIFO", special_file(TASKS, os.mkfifo), "a FIFO"),
    _tasks("truncated", _raw(TASKS, lambda data: data[:-1]), "manifest seals"),
    _tasks("longer", _raw(TASKS, lambda data: data + data), "does not seal", "verify"),
    _tasks("no newline at the end", _sealed(TASKS, lambda data: data[:-1]), ""),
    _tasks("lines lie", _sealed(TASKS, lambda data: data, lines=3), "manifest seals"),
    _tasks("two lines in one", _sealed(TASKS, lambda data: data.replace(b"\n", b",", 1)), ""),
    _tasks("duplicate key", _sealed(TASKS, lambda data: data.replace(b"{", b'{"index":0,', 1)), "canonical"),
    _tasks("NaN", _sealed(TASKS, lambda data: data.replace(b"1.0", b"NaN", 1)), ""),
    _tasks(
        "deep and closed",
        _parameters(goal=json.loads("[" * 150 + "]" * 150)),
        "parameters of task 0",
        "verify",
    ),
    _tasks("a huge line", _sealed(TASKS, lambda data: b"x" * 2**22 + b"\n"), "bytes"),
    _tasks("200,000 lists", _sealed(TASKS, lambda data: b"[" + b"[]," * 200_000 + b"[]]\n"), ""),
    _tasks("40,000 bad lines", _sealed(TASKS, lambda data: b"{}\n" * 40_000), "index"),
    _tasks("index 2**70", _task(index=2**70), "index"),
    _tasks("split unknown", _task(split="both"), "split"),
    _tasks("unknown key", _task(surprise=1), "surprise"),
    _tasks("a task twice", lambda f: f.rows(TASKS, lambda rows: rows.append(rows[0])), "twice"),
    _tasks("parameter escapes as text", _parameters(goal=ESCAPE), "goal holds control"),
    _tasks("parameters edited", _parameters(goal=[0.0, 2.0]), "parameters of task 0", "verify"),
    _tasks("split edited", _task(split="test"), "split of task 0", "verify"),
    _tasks(
        "trillion tasks",
        with_recipe(lambda v: v["environment"].update(tasks=10**12)),
        "environment.tasks",
        "verify",
    ),
    _tasks("environment unknown", with_name("no-such-environment"), "no-such-environment", "verify"),
    _tasks(
        "unknown setting",
        with_recipe(lambda v: v["environment"].update(plugin="evil.py")),
        "recipe.environment",
        "verify",
    ),
]

PART_TABLES = [
    _parts("missing", lambda f: (f.folder / PARTS_TABLE).unlink(), "missing"),
    _parts("a FIFO", special_file(PARTS_TABLE, os.mkfifo), "a FIFO"),
    _parts("truncated", _raw(PARTS_TABLE, lambda data: data[:-1]), "manifest seals"),
    _parts("an empty one sealed", _sealed(PARTS_TABLE, lambda data: b""), "columns"),
    _parts("longer", _raw(PARTS_TABLE, lambda data: data + data), "does not seal", "verify"),
    _parts("lines lie", _sealed(PARTS_TABLE, lambda data: data, lines=99), "manifest seals"),
    _parts("no header", _sealed(PARTS_TABLE, lambda data: data[len(HEADER) :]), "columns"),
    _parts("a header twice", _sealed(PARTS_TABLE, lambda data: HEADER + data), ""),
    _parts(
        "one line of two parts",
        _sealed(PARTS_TABLE, lambda data: b"],[".join(data.rsplit(b"]\n[", 1))),
        "line",
    ),
    _parts("an object", _sealed(PARTS_TABLE, lambda data: data + b'{"task":0}\n'), ""),
    _parts("NaN", _sealed(PARTS_TABLE, lambda data: data.replace(b"null", b"NaN", 1)), ""),
    _parts("a huge line", _sealed(PARTS_TABLE, lambda data: data + b"x" * 2**22 + b"\n"), "bytes"),
    _parts("300,000 lists", _sealed(PARTS_TABLE, lambda data: data + b"[" + b"[]," * 300_000 + b"[]]\n"), ""),
    _parts("40,000 bad lines", _sealed(PARTS_TABLE, lambda data: data + b"[]\n" * 40_000), ""),
    _parts("a part twice", lambda f: f.rows(PARTS_TABLE, lambda rows: rows.append(rows[1])), "twice"),
    _parts("a value too few", lambda f: f.rows(PARTS_TABLE, lambda rows: rows[1].pop()), ""),
    _parts("task -1", _cell("task", -1), "0.0"),
    _parts("run climbs", _cell("run", "../../../etc"), "0.2"),
    _parts("run that is none", _cell("run", "other"), "run"),
    _parts("id climbs", _cell("id", "../" * 20), "0.3"),
    _parts("size 2**62", _cell("size", 2**62), "0.5"),
    _parts("platform 10**6", _cell("platform", 10**6), "0.6"),
    _parts("platform that is none", _cell("platform", 1), "platform", "verify"),
    _parts("mean as text", _cell("mean", "high"), "0.9"),
    _parts("part of no task", lambda f: f.rows(TASKS, lambda rows: rows.pop()), "names a task"),
    _parts("of no task at all", _sealed(TASKS, lambda data: b""), "names a task"),
]

PLACES = [
    in_file("another id", _cell("id", "0" * 64), PART, "manifest", "read"),
    in_file("another sha256", _cell("sha256", "0" * 64), PART, "sha256"),
    in_file("another size", _cell("size", 1), PART, "instead of 1", "read"),
    in_file("oracle edited", _cell("oracle", 1e9), PART, "references.oracle"),
    in_file(
        "another task in the table", _cell("task", 99, row=1), PARTS_TABLE, "names a task that", "tables"
    ),
    in_file("another step", _cell("step", 7), "0000007.zip", "is missing", "read"),
    in_file(
        "billion lanes",
        with_recipe(lambda v: v["rollouts"].update(lanes=10**9, episodes=10**9)),
        PART,
        "identity.settings",
    ),
    in_file("seed edited", with_run(seed=9), PART, "identity.seed"),
    in_file(
        "platform edited",
        lambda f: f.manifest(lambda v: v["platforms"][0].update(cpu="another")),
        PART,
        "another platform",
    ),
]
