"""Forged datasets for all known attacks; the marks of a forgery are consistent, see `forged_datasets.py`."""

import json
import os
import socket
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tcmrl_data.store.manifest import MANIFEST
from tcmrl_data.store.part_table import HEADER, PARTS_TABLE, PartEntry
from tcmrl_data.store.task_table import TASKS
from tests import forged_archives
from tests.forged_datasets import OTHER, PART, Forge, Values, offsets, rle_frame, with_checksum

ESCAPE = "\x1b]0;owned\x07\x1b[2J"
Stage = Literal["open", "tables", "read", "verify"]
Damage = Callable[[Forge], object]


@dataclass(frozen=True)
class Case:
    """One forgery.

    Attributes:
        damage: makes it.
        file: end of the path that the error and a finding must name.
        words: what error and finding must say, at least the field.
        stage: the first stage that must refuse: the manifest, the tables, reading arrays and policy, or
            deep verification.
    """

    name: str
    damage: Damage
    file: str
    words: tuple[str, ...]
    stage: Stage


def _manifest(name: str, damage: Damage, words: str, stage: Stage = "open") -> Case:
    return Case(name, damage, MANIFEST, (words,), stage)


def _tasks(name: str, damage: Damage, words: str, stage: Stage = "tables") -> Case:
    return Case(f"tasks: {name}", damage, TASKS, (words,), stage)


def _parts(name: str, damage: Damage, words: str, stage: Stage = "tables") -> Case:
    return Case(f"parts: {name}", damage, PARTS_TABLE, (words,), stage)


def _part(name: str, damage: Damage, member: str, words: str, stage: Stage = "read") -> Case:
    """A forgery within the archive; error and finding must name the member too."""
    return Case(name, damage, PART, (member, words), stage)


def _file(name: str, damage: Damage, file: str, words: str, stage: Stage = "verify") -> Case:
    return Case(name, damage, file, (words,), stage)


def _field(**fields: Any) -> Damage:
    return lambda forge: forge.manifest(lambda values: values.update(fields))


def _recipe(change: Callable[[Values], object]) -> Damage:
    return lambda forge: forge.manifest(lambda values: change(values["runs"][0]["recipe"]))


def _run(**fields: Any) -> Damage:
    return lambda forge: forge.manifest(lambda values: values["runs"][0].update(fields))


def _name(name: str) -> Damage:
    return lambda forge: forge.manifest(
        lambda values: (
            values.update(name=name),
            values["runs"][0]["recipe"]["environment"].update(name=name),
        )
    )


def _more_tasks(forge: Forge) -> None:
    forge.manifest(lambda values: values["tasks"].update(lines=90_000))


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


def _array_name(name: str) -> Damage:
    """A further array of this name in the record."""
    return _identity(lambda values: values["arrays"].update({name: values["arrays"]["rewards"]}))


def _identity(change: Callable[[Values], object]) -> Damage:
    return lambda forge: forge.record(lambda values: change(values["identity"]))


def _zarr(array: str = "rewards", **fields: Any) -> Damage:
    return lambda forge: forge.zarr(array, **fields)


def _chunk(data: bytes) -> Damage:
    return lambda forge: forge.write("rewards/c/0", data)


def _link(name: str) -> Damage:
    """A symbolic link to the original file, which is moved outside the dataset."""

    def damage(forge: Forge) -> None:
        path = forge.folder / name
        path.rename(forge.outside / "moved")
        path.symlink_to(forge.outside / "moved")

    return damage


def _special(name: str, make: Callable[[Path], object]) -> Damage:
    def damage(forge: Forge) -> None:
        (forge.folder / name).unlink()
        make(forge.folder / name)

    return damage


def _device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def _two_names(name: str) -> Damage:
    return lambda forge: os.link(forge.folder / name, forge.outside / "same")


def _socket(path: Path) -> None:
    here = Path.cwd()
    os.chdir(path.parent)  # a socket's address must be short
    try:
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(path.name)
    finally:
        os.chdir(here)


def _bomb(forge: Forge) -> None:
    """Every array claims 2**26 steps; one array really decodes to that many."""
    forge.lengthen(2**26)
    forge.write("terminated/c/0", rle_frame(2**26))


def _many_arrays(forge: Forge) -> None:
    forge.record(
        lambda values: values["identity"]["arrays"].update(
            {f"extra{i}": values["identity"]["arrays"]["rewards"] for i in range(40)}
        )
    )


def _swap(forge: Forge) -> None:
    """Two parts at each other's places, of which the table tells the truth."""
    files = [forge.folder / PART, forge.folder / OTHER]
    contents = [file.read_bytes() for file in files]
    for file, content in zip(files, reversed(contents), strict=True):
        file.write_bytes(content)

    def change(rows: list[Any]) -> None:
        for column in ("id", "sha256", "size"):
            place = PartEntry._fields.index(column)
            rows[1][place], rows[2][place] = rows[2][place], rows[1][place]

    forge.rows(PARTS_TABLE, change)


def _nan_array(forge: Forge) -> None:
    """NaN rewards with consistent digests."""
    forge.values("rewards", lambda array: array.__setitem__(7, np.nan))


def _offsets(values: list[int]) -> Damage:
    return lambda forge: forge.encode(offsets(values))


def _manifest_file(data: bytes) -> Damage:
    return lambda forge: (forge.folder / MANIFEST).write_bytes(data)


def _repeated_header(forge: Forge) -> None:
    size = len(forge.read("policy.safetensors"))
    forge.write("policy.safetensors", struct.pack("<Q", 2**62) + b"{" * (size - 8))


BIG = 2**63 - 1
CODECS = [{"name": "bytes", "configuration": {"endian": "little"}}]
SHARDS = {"name": "sharding_indexed", "configuration": {"chunk_shape": [1], "codecs": CODECS}}
SB3_ZIP = b"PK\x03\x04" + bytes(26) + b"data" + bytes(4096)

MANIFESTS = [
    _manifest("empty file", _manifest_file(b""), "not a manifest"),
    _manifest("NaN", lambda f: f.text(b'"seed":0', b'"seed":NaN'), "NaN is not allowed"),
    _manifest("infinity", lambda f: f.text(b'"seed":0', b'"seed":-Infinity'), "-Infinity is not"),
    _manifest("1e999", lambda f: f.text(b'"seed":0', b'"seed":1e999'), "too large"),
    _manifest("5000 digits", lambda f: f.text(b'"seed":0', b'"seed":' + b"9" * 5000), "digits"),
    _manifest("duplicate key", lambda f: f.text(b'"seed":0', b'"seed":0,"seed":1'), "key 'seed'"),
    _manifest(
        "duplicate escaped key", lambda f: f.text(b'"seed":0', b'"seed":0,"\\u0073eed":1'), "key 'seed'"
    ),
    _manifest("no UTF-8", lambda f: f.text(b'"seed":0', b'"seed":"\xff"'), "utf-8"),
    _manifest("byte order mark", lambda f: f.text(b"{", b"\xef\xbb\xbf{"), "not a manifest"),
    _manifest("surrogate", lambda f: f.text(b'"seed":0', b'"seed":"\\ud800"'), "seed holds control"),
    _manifest("extreme depth", _manifest_file(b"[" * 10**5), "nested deeper"),
    _manifest("extreme size", _manifest_file(b" " * (20 * 2**20)), "bytes"),
    _manifest("too many values", _manifest_file(b"[" + b"[]," * 200_000 + b"[]]"), "values"),
    _manifest(
        "many values", _manifest_file(b'{"schema_version":2,"x":[' + b"[]," * 60_000 + b"0]}"), "digest"
    ),
    _manifest("40000 bad runs", lambda f: f.text(b'"runs":[', b'"runs":[' + b"{}," * 40_000), "runs"),
    _manifest("900 bad runs", lambda f: f.text(b'"runs":[', b'"runs":[' + b"{}," * 900), "runs.0"),
    _manifest(
        "two runs of one name", lambda f: f.manifest(lambda v: v["runs"].append(v["runs"][0])), "names"
    ),
    _manifest("no run", _field(runs=[]), "runs"),
    _manifest("no recipe", _run(recipe=None), "recipe"),
    _manifest("run climbs", _run(name="../../etc"), "runs.0.name"),
    _manifest("run newline", _run(name="main\n"), "runs.0.name"),
    _manifest("run of another kind", _run(kind="stolen"), "runs.0.kind"),
    _manifest("recipe of lists", _run(recipe={"x": [[]] * 60_000}), "recipe."),
    _manifest("a list", _manifest_file(b"[1]"), "schema_version"),
    _manifest("edited", lambda f: f.text(b'"seed":0', b'"seed":1'), "digest"),
    _manifest("spaces", lambda f: f.text(b'"seed":0', b'"seed": 0'), "digest"),
    _manifest("an earlier version", _field(schema_version=1, name=ESCAPE, seed=ESCAPE), "schema_version 1"),
    _manifest("another version", _field(schema_version=3), "schema_version 3"),
    _manifest("a flag as version", _field(schema_version=True), "schema_version True"),
    _manifest("a text as version", _field(schema_version="1" * 5000), "schema_version '1111"),
    _manifest("unknown key", _field(surprise=1), "surprise"),
    _manifest("unknown key with escapes", _field(**{ESCAPE: 1}), "control characters"),
    _manifest("label escapes", _field(label=ESCAPE), "label holds control"),
    _manifest("label of 10,000", _field(label="a" * 10_000), "label"),
    _manifest("a flag as seed", _run(seed=True), "seed"),
    _manifest("a float as seed", _run(seed=0.0), "seed"),
    _manifest("a text as flag", _field(complete="yes"), "complete"),
    _manifest("null tasks", _field(tasks=None), "tasks"),
    _manifest("name climbs", _name("../../etc"), "name"),
    _manifest("name absolute", _name("/etc/passwd\x00"), "name"),
    _manifest("name drive", _name("C:\\x"), "name"),
    _manifest("name UNC", _name("\\\\server\\share"), "name"),
    _manifest("name NUL", _name("point\0robot"), "name"),
    _manifest("name newline", _name("point-robot\n"), "name"),
    _manifest("name escapes", _name(f"point{ESCAPE}"), "name"),
    _manifest("name 5000", _name("a" * 5000), "name"),
    _manifest("name case", _name("Point-Robot"), "name"),
    _manifest("name lookalike", _name("pοint-rοbοt"), "name"),
    _manifest("no source", _recipe(lambda v: v["behavior"].pop("source")), "source"),
    _manifest(
        "other environment",
        _recipe(lambda v: v["environment"].update(name="point-robot-wind")),
        "recipe.environment.name",
    ),
    _manifest(
        "description escapes", _recipe(lambda v: v["about"].update(description=f"x{ESCAPE}")), "description"
    ),
    _manifest(
        "platform escapes",
        lambda f: f.manifest(lambda v: v["platforms"][0].update(cpu=ESCAPE)),
        "platforms.0.cpu",
    ),
    _manifest(
        "platform of lists",
        lambda f: f.manifest(lambda v: v["platforms"][0].update(packages=[[]] * 60_000)),
        "platforms.0.packages",
    ),
    _manifest(
        "2,000 platforms",
        lambda f: f.manifest(lambda v: v.update(platforms=v["platforms"] * 2000)),
        "platforms",
    ),
    _manifest("dropped twice", _field(dropped=[3, 3]), "dropped"),
    _manifest("dropped below zero", _field(dropped=[-1]), "dropped"),
    _manifest("dropped beyond all", _field(dropped=[2**70]), "dropped"),
    _manifest("more dropped than there are", _field(dropped=[0, 1, 3]), "at most"),
    _manifest("steps in disorder", _run(steps=[150, 0]), "steps"),
    _manifest("step below zero", _run(steps=[-150]), "steps"),
    _manifest("step of 4000 digits", _run(steps=[10**3999]), "steps"),
    _manifest(
        "two million parts", lambda f: (_run(steps=list(range(30)))(f), _more_tasks(f)), "the runs call for"
    ),
    _manifest("root newline", _field(root="a" * 64 + "\n"), "root"),
    _manifest(
        "totals below zero", lambda f: f.manifest(lambda v: v["totals"].update(steps=-1)), "totals.steps"
    ),
    _manifest(
        "totals beyond all", lambda f: f.manifest(lambda v: v["totals"].update(bytes=2**70)), "totals.bytes"
    ),
    _manifest(
        "a seal below zero", lambda f: f.manifest(lambda v: v["parts"].update(bytes=-1)), "parts.bytes"
    ),
    _manifest(
        "a seal beyond all", lambda f: f.manifest(lambda v: v["tasks"].update(bytes=2**62)), "tasks.bytes"
    ),
    _manifest("a billion parts", lambda f: f.manifest(lambda v: v["parts"].update(lines=10**9)), "parts"),
    _manifest("a million tasks", lambda f: f.manifest(lambda v: v["tasks"].update(lines=10**6)), "tasks"),
    _manifest(
        "total of parts",
        lambda f: f.manifest(lambda v: v["totals"].update(parts=3)),
        "totals.parts",
        "verify",
    ),
    _manifest(
        "total of steps",
        lambda f: f.manifest(lambda v: v["totals"].update(steps=1)),
        "totals.steps",
        "verify",
    ),
    _manifest(
        "total of bytes",
        lambda f: f.manifest(lambda v: v["totals"].update(bytes=1)),
        "totals.bytes",
        "verify",
    ),
    _manifest("complete", _field(complete=False), "complete", "verify"),
    Case("a task dropped that is there", _field(dropped=[3]), "", ("root",), "tables"),
    Case("wrong root", _field(root="0" * 64), "", ("root",), "tables"),
    _manifest("a part too few", lambda f: f.rows(PARTS_TABLE, lambda r: r.pop()), "complete", "verify"),
    _manifest("a task dropped that is none", _field(dropped=[7]), "dropped names", "verify"),
]

TASK_TABLES = [
    _tasks("missing", lambda f: (f.folder / TASKS).unlink(), "missing"),
    _tasks("linked", _link(TASKS), "a link"),
    _tasks("linked to a device", _special(TASKS, _device), "a link"),
    _tasks("of two names", _two_names(TASKS), "hard links"),
    _tasks("a FIFO", _special(TASKS, os.mkfifo), "a FIFO"),
    _tasks("a socket", _special(TASKS, _socket), "a socket"),
    _tasks("a folder", _special(TASKS, Path.mkdir), "a folder"),
    _tasks("truncated", _raw(TASKS, lambda data: data[:-1]), "manifest seals"),
    _tasks("empty", _raw(TASKS, lambda data: b""), "manifest seals"),
    _tasks("longer", _raw(TASKS, lambda data: data + data), "does not seal", "verify"),
    _tasks("no newline at the end", _sealed(TASKS, lambda data: data[:-1]), ""),
    _tasks("lines lie", _sealed(TASKS, lambda data: data, lines=3), "manifest seals"),
    _tasks("bytes lie", _sealed(TASKS, lambda data: data, bytes=2**30), "manifest seals"),
    _tasks("two lines in one", _sealed(TASKS, lambda data: data.replace(b"\n", b",", 1)), ""),
    _tasks("duplicate key", _sealed(TASKS, lambda data: data.replace(b"{", b'{"index":0,', 1)), "canonical"),
    _tasks("spaces", _sealed(TASKS, lambda data: data.replace(b":", b": ", 1)), "canonical"),
    _tasks("no UTF-8", _sealed(TASKS, lambda data: data.replace(b"goal", b"\xff", 1)), ""),
    _tasks("NaN", _sealed(TASKS, lambda data: data.replace(b"1.0", b"NaN", 1)), ""),
    _tasks("1e999", _sealed(TASKS, lambda data: data.replace(b"1.0", b"1e999", 1)), ""),
    _tasks("5000 digits", _sealed(TASKS, lambda data: data.replace(b"1.0", b"9" * 5000, 1)), ""),
    _tasks("surrogate", _sealed(TASKS, lambda data: data.replace(b"goal", b"\\ud800", 1)), ""),
    _tasks("deep", _sealed(TASKS, lambda data: data.replace(b"1.0", b"[" * 10**5, 1)), ""),
    _tasks(
        "deep and closed",
        _parameters(goal=json.loads("[" * 150 + "]" * 150)),
        "parameters of task 0",
        "verify",
    ),
    _tasks("a huge line", _sealed(TASKS, lambda data: b"x" * 2**22 + b"\n"), "bytes"),
    _tasks("a long line", _parameters(goal="a" * 2**17), "bytes"),
    _tasks("a million commas", _sealed(TASKS, lambda data: b"," * 10**6 + b"\n"), ""),
    _tasks("200,000 lists", _sealed(TASKS, lambda data: b"[" + b"[]," * 200_000 + b"[]]\n"), ""),
    _tasks("40,000 bad lines", _sealed(TASKS, lambda data: b"{}\n" * 40_000), "index"),
    _tasks("40,000 lists", _sealed(TASKS, lambda data: b"[]\n" * 40_000), ""),
    _tasks("index -1", _task(index=-1), "index"),
    _tasks("index 2**70", _task(index=2**70), "index"),
    _tasks("index as path", _task(index="../7"), "index"),
    _tasks("index as float", _task(index=0.0), "index"),
    _tasks("index as flag", _task(index=True), "index"),
    _tasks("split unknown", _task(split="both"), "split"),
    _tasks("unknown key", _task(surprise=1), "surprise"),
    _tasks("parameters a list", _task(parameters=[]), "parameters"),
    _tasks("a task twice", lambda f: f.rows(TASKS, lambda rows: rows.append(rows[0])), "twice"),
    _tasks("parameter escapes", _parameters(**{"\x9b2J": 1}), "control characters"),
    _tasks("parameter escapes as text", _parameters(goal=ESCAPE), "goal holds control"),
    _tasks("parameter turns text", _parameters(goal="\u202ekcatta"), "goal holds control"),
    _tasks("parameter deletes", _parameters(goal="\x7f"), "goal holds control"),
    _tasks("parameters edited", _parameters(goal=[0.0, 2.0]), "parameters of task 0", "verify"),
    _tasks("split edited", _task(split="test"), "split of task 0", "verify"),
    _tasks(
        "trillion tasks",
        _recipe(lambda v: v["environment"].update(tasks=10**12)),
        "environment.tasks",
        "verify",
    ),
    _tasks("environment unknown", _name("no-such-environment"), "no-such-environment", "verify"),
    _tasks(
        "unknown setting",
        _recipe(lambda v: v["environment"].update(plugin="evil.py")),
        "recipe.environment",
        "verify",
    ),
]

PART_TABLES = [
    _parts("missing", lambda f: (f.folder / PARTS_TABLE).unlink(), "missing"),
    _parts("linked", _link(PARTS_TABLE), "a link"),
    _parts("linked to a device", _special(PARTS_TABLE, _device), "a link"),
    _parts("of two names", _two_names(PARTS_TABLE), "hard links"),
    _parts("a FIFO", _special(PARTS_TABLE, os.mkfifo), "a FIFO"),
    _parts("a socket", _special(PARTS_TABLE, _socket), "a socket"),
    _parts("a folder", _special(PARTS_TABLE, Path.mkdir), "a folder"),
    _parts("truncated", _raw(PARTS_TABLE, lambda data: data[:-1]), "manifest seals"),
    _parts("empty", _raw(PARTS_TABLE, lambda data: b""), "manifest seals"),
    _parts("an empty one sealed", _sealed(PARTS_TABLE, lambda data: b""), "columns"),
    _parts("longer", _raw(PARTS_TABLE, lambda data: data + data), "does not seal", "verify"),
    _parts("lines lie", _sealed(PARTS_TABLE, lambda data: data, lines=99), "manifest seals"),
    _parts("bytes lie", _sealed(PARTS_TABLE, lambda data: data, bytes=2**10), "manifest seals"),
    _parts("no header", _sealed(PARTS_TABLE, lambda data: data[len(HEADER) :]), "columns"),
    _parts("another header", _sealed(PARTS_TABLE, lambda data: data.replace(b"step", b"stop", 1)), "columns"),
    _parts("a header twice", _sealed(PARTS_TABLE, lambda data: HEADER + data), ""),
    _parts(
        "two parts in a line", _sealed(PARTS_TABLE, lambda data: b"]\n,[".join(data.rsplit(b"]\n[", 1))), ""
    ),
    _parts(
        "one line of two parts",
        _sealed(PARTS_TABLE, lambda data: b"],[".join(data.rsplit(b"]\n[", 1))),
        "line",
    ),
    _parts("an object", _sealed(PARTS_TABLE, lambda data: data + b'{"task":0}\n'), ""),
    _parts("NaN", _sealed(PARTS_TABLE, lambda data: data.replace(b"null", b"NaN", 1)), ""),
    _parts("1e999", _sealed(PARTS_TABLE, lambda data: data.replace(b"null", b"1e999", 1)), ""),
    _parts("no UTF-8", _sealed(PARTS_TABLE, lambda data: data.replace(b'"main"', b'"\xff"', 1)), ""),
    _parts("deep", _sealed(PARTS_TABLE, lambda data: data + b"[" * 10**5 + b"\n"), ""),
    _parts("a huge line", _sealed(PARTS_TABLE, lambda data: data + b"x" * 2**22 + b"\n"), "bytes"),
    _parts("a million commas", _sealed(PARTS_TABLE, lambda data: data + b"," * 10**6 + b"\n"), ""),
    _parts("300,000 lists", _sealed(PARTS_TABLE, lambda data: data + b"[" + b"[]," * 300_000 + b"[]]\n"), ""),
    _parts("40,000 bad lines", _sealed(PARTS_TABLE, lambda data: data + b"[]\n" * 40_000), ""),
    _parts("40,000 objects", _sealed(PARTS_TABLE, lambda data: data + b"{}\n" * 40_000), ""),
    _parts("a part twice", lambda f: f.rows(PARTS_TABLE, lambda rows: rows.append(rows[1])), "twice"),
    _parts("a value too few", lambda f: f.rows(PARTS_TABLE, lambda rows: rows[1].pop()), ""),
    _parts("a value too many", lambda f: f.rows(PARTS_TABLE, lambda rows: rows[1].append(0)), ""),
    _parts("task -1", _cell("task", -1), "0.0"),
    _parts("task 2**70", _cell("task", 2**70), "0.0"),
    _parts("task as path", _cell("task", "../7"), "0.0"),
    _parts("task as float", _cell("task", 0.0), "0.0"),
    _parts("step of 4000 digits", _cell("step", 10**3999), "0.1"),
    _parts("step as flag", _cell("step", True), "0.1"),
    _parts("run climbs", _cell("run", "../../../etc"), "0.2"),
    _parts("run newline", _cell("run", "main\n"), "0.2"),
    _parts("run NUL", _cell("run", "main\0"), "0.2"),
    _parts("run escapes", _cell("run", ESCAPE), "0.2"),
    _parts("run of 5000", _cell("run", "a" * 5000), "0.2"),
    _parts("run that is none", _cell("run", "other"), "run"),
    _parts("id newline", _cell("id", "a" * 64 + "\n"), "0.3"),
    _parts("id climbs", _cell("id", "../" * 20), "0.3"),
    _parts("sha256 in capitals", _cell("sha256", "A" * 64), "0.4"),
    _parts("size below zero", _cell("size", -1), "0.5"),
    _parts("size 2**62", _cell("size", 2**62), "0.5"),
    _parts("platform -1", _cell("platform", -1), "0.6"),
    _parts("platform 10**6", _cell("platform", 10**6), "0.6"),
    _parts("platform that is none", _cell("platform", 1), "platform", "verify"),
    _parts("mean as text", _cell("mean", "high"), "0.9"),
    _parts("oracle as text", _cell("oracle", "high"), "0.15"),
    _parts("part of no task", lambda f: f.rows(TASKS, lambda rows: rows.pop()), "names a task", "verify"),
    _parts("of no task at all", _sealed(TASKS, lambda data: b""), "names a task", "verify"),
]

PLACES = [
    _file("another id", _cell("id", "0" * 64), PART, "manifest", "read"),
    _file("another sha256", _cell("sha256", "0" * 64), PART, "sha256"),
    _file("another size", _cell("size", 1), PART, "instead of 1", "read"),
    _file("oracle edited", _cell("oracle", 1e9), PART, "references.oracle"),
    _file("mean edited in the table", _cell("mean", 1e9), PART, "statistics.mean"),
    _file("success of nothing", _cell("success_rate", 1.0), PART, "statistics.success_rate"),
    _file(
        "another task in the table", _cell("task", 99, row=1), "parts/main/00099", "cannot be read", "read"
    ),
    _file("another step", _cell("step", 7), "0000007.zip", "is missing", "read"),
    _file(
        "billion lanes",
        _recipe(lambda v: v["rollouts"].update(lanes=10**9, episodes=10**9)),
        PART,
        "identity.settings",
    ),
    _file("seed edited", _run(seed=9), PART, "identity.seed"),
    _file("data version edited", _field(data_version=1), PART, "identity.data_version"),
    _file(
        "platform edited",
        lambda f: f.manifest(lambda v: v["platforms"][0].update(cpu="another")),
        PART,
        "another platform",
    ),
]

RECORDS = [
    _part(
        "20000 bad arrays",
        _identity(lambda v: v["arrays"].update({str(i): {} for i in range(20_000)})),
        "part.json",
        "arrays",
    ),
    _part("array climbs", _array_name("../../../../../outside/secret"), "part.json", "no array name"),
    _part("array absolute", _array_name("/etc"), "part.json", "no array name"),
    _part("array case", _array_name("Rewards"), "part.json", "no array name"),
    _part("array lookalike", _array_name("rеwards"), "part.json", "no array name"),
    _part("array newline", _array_name("rewards\n"), "part.json", "control characters"),
    _part("array NUL", _array_name("rewards\0"), "part.json", "control characters"),
    _part("array 5000", _array_name("a" * 5000), "part.json", "no array name"),
    _part("array drive", _array_name("c:\\x"), "part.json", "no array name"),
    _part("array without files", _array_name("success"), "arrays/success/zarr.json", "missing"),
    _part("40 arrays", _many_arrays, "part.json", "identity.arrays"),
    _part("record missing", lambda f: f.take("part.json"), "part.json", "missing"),
    _part("record empty", lambda f: f.write("part.json", b""), "part.json", "not a part record"),
    _part("record a list", lambda f: f.write("part.json", b"[]"), "part.json", "schema_version"),
    _part("record deep", lambda f: f.write("part.json", b"[" * 10**5), "part.json", "nested"),
    _part(
        "record of many values",
        lambda f: f.write("part.json", b"[" + b"[]," * 200_000 + b"[]]"),
        "part.json",
        "values",
    ),
    _part(
        "record of an earlier version",
        lambda f: f.record(lambda v: v.update(schema_version=1)),
        "part.json",
        "schema_version 1",
    ),
    _part(
        "id of another",
        lambda f: f.record(lambda v: None, text=lambda t: t.replace('"step":150', '"step":151')),
        "part.json",
        "id",
    ),
    _part("member unrecorded", lambda f: f.write("rewards/c/1", b""), "arrays/rewards/c/1", "agree"),
    _part("chunk missing", lambda f: f.take("rewards/c/0"), "arrays/rewards/c/0", "agree"),
    _part("policy missing", lambda f: f.take("policy.json"), "policy.json", "agree"),
    _part("weights missing", lambda f: f.take("policy.safetensors"), "policy.safetensors", "missing"),
    _part("code beside data", lambda f: f.write("policy.py", b"import os"), "policy.py", "agree"),
    _part("pickle beside data", lambda f: f.write("policy.pkl", f.payload()), "policy.pkl", "agree"),
    _part(
        "object array",
        _identity(lambda v: v["arrays"]["rewards"].update(dtype="object")),
        "part.json",
        "dtype",
    ),
    _part(
        "float offsets",
        _identity(lambda v: v["arrays"]["episode_offsets"].update(dtype="float32")),
        "part.json",
        "episode_offsets",
    ),
    _part(
        "negative shape",
        _identity(lambda v: v["arrays"]["actions"].update(shape=[-120, 2])),
        "part.json",
        "shape",
    ),
    _part(
        "huge shape", _identity(lambda v: v["arrays"]["rewards"].update(shape=[2**80])), "part.json", "shape"
    ),
    _part(
        "no episodes",
        _identity(lambda v: v["arrays"]["episode_offsets"].update(shape=[1])),
        "part.json",
        "shape",
    ),
    _part("no rewards", _identity(lambda v: v["arrays"].pop("rewards")), "part.json", "rewards is missing"),
    _part(
        "mean 1e999",
        lambda f: f.record(lambda v: None, text=lambda t: t.replace('"mean":', '"mean":1e999,"x":')),
        "part.json",
        "too large",
    ),
    _part(
        "duplicate key in the record",
        lambda f: f.record(lambda v: None, text=lambda t: t.replace('"mean":', '"mean":1,"mean":')),
        "part.json",
        "duplicate key 'mean'",
    ),
    _part(
        "mean edited",
        lambda f: f.record(lambda v: v["statistics"].update(mean=1e6)),
        "part.json",
        "statistics.mean",
        "verify",
    ),
    _part(
        "record of 2 MB",
        lambda f: f.record(lambda v: v["behavior"].update(x="x" * 2**21)),
        "part.json",
        "bytes",
    ),
    _part(
        "host escapes",
        lambda f: f.record(lambda v: v["platform"].update(cpu=ESCAPE)),
        "part.json",
        "platform.cpu",
    ),
    _part("another seed", _identity(lambda v: v.update(seed=9)), "", "identity.seed", "verify"),
    _part("another task", _identity(lambda v: v.update(task=7)), "", "the manifest"),
    _part("parts swapped", _swap, "", "the manifest"),
]

ARCHIVES = [
    Case(f"archive: {name}", lambda forge, data=data: forge.archive(data), PART, (), "read")
    for name, data in forged_archives.FORGED.items()
]

LAYOUTS = [
    _part("Zarr v2", _zarr(zarr_format=2), "rewards/zarr.json", "zarr_format"),
    _part("no metadata", lambda f: f.take("rewards/zarr.json"), "rewards/zarr.json", "missing"),
    _part("group as array", _zarr(node_type="group"), "rewards/zarr.json", "node_type"),
    _part("object dtype", _zarr(data_type="|O"), "rewards/zarr.json", "data_type"),
    _part("string dtype", _zarr(data_type="string"), "rewards/zarr.json", "data_type"),
    _part("bytes dtype", _zarr(data_type="variable_length_bytes"), "rewards/zarr.json", "data_type"),
    _part("structured dtype", _zarr(data_type={"name": "structured"}), "rewards/zarr.json", "data_type"),
    _part("unknown codec", _zarr(codecs=[*CODECS, {"name": "evil"}]), "rewards/zarr.json", "codecs"),
    _part("pickle codec", _zarr(codecs=[{"name": "numcodecs.pickle"}]), "rewards/zarr.json", "codecs"),
    _part("sharding", _zarr(codecs=[SHARDS]), "rewards/zarr.json", "codecs"),
    _part("storage transformer", _zarr(storage_transformers=[{"name": "x"}]), "rewards/zarr.json", "storage"),
    _part("negative rows", _zarr(shape=[-1]), "rewards/zarr.json", "shape"),
    _part("overflowing rows", _zarr(shape=[BIG]), "rewards/zarr.json", "shape"),
    _part("rows beyond int64", _zarr(shape=[2**70]), "rewards/zarr.json", "shape"),
    _part("ten axes", _zarr(shape=[1] * 10), "rewards/zarr.json", "shape"),
    _part("rows as float", _zarr(shape=[120.0]), "rewards/zarr.json", "shape"),
    _part("petabytes", lambda f: f.lengthen(2**39), "", "shape asks for"),
    _part(
        "huge chunks",
        _zarr(chunk_grid={"name": "regular", "configuration": {"chunk_shape": [2**39]}}),
        "rewards/zarr.json",
        "chunk_grid",
    ),
    _part(
        "empty chunks",
        _zarr(chunk_grid={"name": "regular", "configuration": {"chunk_shape": [0]}}),
        "rewards/zarr.json",
        "chunk_shape",
    ),
    _part("chunk names", _zarr(chunk_key_encoding={"name": "v2"}), "rewards/zarr.json", "chunk_key_encoding"),
    _part("attributes", _zarr(attributes={ESCAPE: 1}), "rewards/zarr.json", "attributes"),
    _part("fill value", _zarr(fill_value="0x7fc00000"), "rewards/zarr.json", "fill_value"),
    _part(
        "axes of another array", _zarr(dimension_names=["episode"]), "rewards/zarr.json", "dimension_names"
    ),
    _part("unknown field", _zarr(must_understand=True), "rewards/zarr.json", "must_understand"),
    _part(
        "metadata NaN", lambda f: f.write("rewards/zarr.json", b'{"shape":NaN}'), "rewards/zarr.json", "NaN"
    ),
    _part(
        "metadata deep", lambda f: f.write("rewards/zarr.json", b"[" * 10**4), "rewards/zarr.json", "nested"
    ),
    _part("metadata big", lambda f: f.write("rewards/zarr.json", b" " * 10**6), "rewards/zarr.json", "bytes"),
    _part(
        "group attributes",
        lambda f: f.write("zarr.json", b'{"zarr_format":3,"node_type":"group","attributes":{"x":1}}'),
        "arrays/zarr.json",
        "attributes",
    ),
]

CHUNKS = [
    _part("bomb beyond the chunk", _chunk(rle_frame(2**24, declared=2**24)), "rewards/c/0", "declares"),
    _part("bomb declared small", _chunk(rle_frame(2**24, declared=480)), "rewards", "does not decode"),
    _part("frame of 2**63", _chunk(rle_frame(2**17, declared=2**63)), "rewards/c/0", "declares"),
    _part(
        "frame without size",
        _chunk(with_checksum(b"\x28\xb5\x2f\xfd\x00\x58" + b"\x03\x00\x00\x00")),
        "rewards/c/0",
        "zstd frame",
    ),
    _part(
        "two frames",
        lambda f: f.write("rewards/c/0", with_checksum(2 * rle_frame(480)[:-4])),
        "rewards",
        "does not decode",
    ),
    _part("justified by nothing", _bomb, "", "shape asks for"),
    _part(
        "a pickle as chunk",
        lambda f: f.write("rewards/c/0", f.payload()),
        "rewards/c/0",
        "zstd frame",
    ),
    _part("empty chunk", _chunk(b""), "rewards/c/0", "zstd frame"),
    _part("wrong checksum", _chunk(rle_frame(480)[:-4] + b"\0\0\0\0"), "rewards", "does not decode"),
    _part("other values", _chunk(rle_frame(480)), "rewards", "sha256", "verify"),
    _part("NaN rewards", _nan_array, "rewards", "not finite", "verify"),
    _part("offsets fall", _offsets([0, 20, 40, 30, 80, 100, 120]), "", "episode_offsets"),
    _part(
        "offsets wrap",
        _offsets([0, BIG, -BIG - 1, -1, 80, 100, 120]),
        "",
        "episode_offsets",
    ),
    _part("offsets short", _offsets([0, 20, 40, 60, 80, 100, 119]), "", "episode_offsets"),
    _part(
        "episodes moved",
        _offsets([0, 20, 40, 60, 80, 101, 120]),
        "terminated",
        "last step",
        "verify",
    ),
]

POLICIES = [
    _part(
        "pickle as weights",
        lambda f: f.write("policy.safetensors", f.payload()),
        "policy.safetensors",
        "bytes",
    ),
    _part(
        "pickle as policy",
        lambda f: f.write("policy.json", f.payload()),
        "policy.json",
        "not a policy",
    ),
    _part(
        "SB3 zip",
        lambda f: f.write("policy.safetensors", SB3_ZIP),
        "policy.safetensors",
        "safetensors",
    ),
    _part(
        "overlapping",
        lambda f: f.header(lambda h: h["mean.bias"].update(data_offsets=h["log_std.bias"]["data_offsets"])),
        "policy.safetensors",
        "safetensors",
    ),
    _part(
        "huge offsets",
        lambda f: f.header(lambda h: h["mean.bias"].update(data_offsets=[0, 2**60])),
        "policy.safetensors",
        "safetensors",
    ),
    _part(
        "negative offsets",
        lambda f: f.header(lambda h: h["mean.bias"].update(data_offsets=[-8, 0])),
        "policy.safetensors",
        "safetensors",
    ),
    _part(
        "huge tensor",
        lambda f: f.header(lambda h: h["mean.bias"].update(shape=[2**62])),
        "policy.safetensors",
        "safetensors",
    ),
    _part("header of 2**62", _repeated_header, "policy.safetensors", "safetensors"),
    _part(
        "unknown dtype",
        lambda f: f.header(lambda h: h["mean.bias"].update(dtype="F8_E4M3")),
        "policy.safetensors",
        "safetensors",
    ),
    _part(
        "NaN weights",
        lambda f: f.weights(lambda t: t["mean.bias"].fill(np.nan)),
        "policy.safetensors",
        "mean.bias",
    ),
    _part(
        "infinite weights",
        lambda f: f.weights(lambda t: t["mean.bias"].fill(np.inf)),
        "policy.safetensors",
        "mean.bias",
    ),
    _part(
        "wrong shapes",
        lambda f: f.weights(lambda t: t.update({"mean.bias": np.zeros((1, 2), np.float32)})),
        "policy.safetensors",
        "shapes",
    ),
    _part(
        "whole numbers",
        lambda f: f.weights(lambda t: t.update({"mean.bias": np.zeros(2, np.int32)})),
        "policy.safetensors",
        "mean.bias",
    ),
    _part(
        "tensor escapes",
        lambda f: f.weights(lambda t: t.update({ESCAPE: t["mean.bias"]})),
        "policy.safetensors",
        "names",
    ),
    _part(
        "tensor missing",
        lambda f: f.weights(lambda t: t.pop("mean.bias")),
        "policy.safetensors",
        "shapes",
    ),
    _part(
        "other weights",
        lambda f: f.weights(lambda t: t["mean.bias"].fill(0.5)),
        "policy.json",
        "digest",
        "verify",
    ),
    _part("terabyte layers", lambda f: f.policy(hidden=[65536] * 16), "policy.safetensors", "bytes"),
    _part("layer of 10**9", lambda f: f.policy(hidden=[10**9]), "policy.json", "hidden"),
    _part("thousand layers", lambda f: f.policy(hidden=[1] * 1000), "policy.json", "hidden"),
    _part("kind pickle", lambda f: f.policy(kind="pickle"), "policy.json", "kind"),
    _part(
        "noise 1e999",
        lambda f: f.write("policy.json", b'{"kind":"scripted","observation":"full","noise":1e999}'),
        "policy.json",
        "too large",
    ),
    _part("policy deep", lambda f: f.write("policy.json", b"[" * 10**4), "policy.json", "nested"),
    _part("policy big", lambda f: f.write("policy.json", b" " * 10**6), "policy.json", "bytes"),
    _part(
        "scripted with weights",
        lambda f: f.write("policy.json", b'{"kind":"scripted","observation":"full","noise":0.1}'),
        "policy.json",
        "digest",
        "verify",
    ),
]
SB3_ZIP = b"PK\x03\x04" + bytes(26) + b"data" + bytes(4096)

FILES = [
    _file("part linked", _link(PART), PART, "a link", "read"),
    _file("part linked to a device", _special(PART, _device), PART, "a link", "read"),
    _file(
        "part linked to nothing", _special(PART, lambda p: p.symlink_to("/nothing")), PART, "a link", "read"
    ),
    _file("part linked to itself", _special(PART, lambda p: p.symlink_to(p.name)), PART, "a link", "read"),
    _file(
        "part linked to the other",
        _special(PART, lambda p: p.symlink_to(f"../../../{OTHER}")),
        PART,
        "a link",
        "read",
    ),
    _file("task linked", _link("parts/main/00000"), "parts/main/00000", "a link", "read"),
    _file("run linked", _link("parts/main"), "parts/main", "a link", "read"),
    _file("parts linked", _link("parts"), "parts", "a link", "read"),
    _file("manifest linked", _link(MANIFEST), MANIFEST, "a link", "open"),
    _file("part of two names", _two_names(PART), PART, "hard links", "read"),
    _file("manifest of two names", _two_names(MANIFEST), MANIFEST, "hard links", "open"),
    _file("part a FIFO", _special(PART, os.mkfifo), PART, "a FIFO", "read"),
    _file("manifest a FIFO", _special(MANIFEST, os.mkfifo), MANIFEST, "a FIFO", "open"),
    _file("part a socket", _special(PART, _socket), PART, "a socket", "read"),
    _file("part a folder", _special(PART, Path.mkdir), PART, "", "read"),
    _file("part missing", lambda f: f.part.unlink(), PART, "missing", "read"),
    _file(
        "part of the other",
        lambda f: f.archive((f.folder / OTHER).read_bytes()),
        PART,
        "the manifest",
        "read",
    ),
    _file("file of odd name", lambda f: (f.folder / "parts" / f"a{ESCAPE}").touch(), ESCAPE, "no part"),
    _file(
        "file of broken name",
        lambda f: Path(os.fsdecode(bytes(f.folder) + b"/\xff\xfe")).touch(),
        "\udcff\udcfe",
        "no part",
    ),
    _file(
        "code beside the part",
        lambda f: (f.part.parent / "sitecustomize.py").write_text("import os"),
        "sitecustomize.py",
        "no part",
    ),
    _file(
        "pickle beside the part",
        lambda f: (f.part.parent / "policy.pkl").write_bytes(f.payload()),
        "policy.pkl",
        "no part",
    ),
    _file(
        "part of an odd number",
        lambda f: (f.part.parent / "150.zip").write_bytes(f.part.read_bytes()),
        "150.zip",
        "no part",
    ),
    _file("lock linked", lambda f: (f.folder / ".lock").symlink_to(f.outside / "secret"), ".lock", "a link"),
]

CASES = [
    *(*MANIFESTS, *TASK_TABLES, *PART_TABLES, *PLACES, *RECORDS),
    *(*ARCHIVES, *LAYOUTS, *CHUNKS, *POLICIES, *FILES),
]
