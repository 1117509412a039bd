"""Forged manifests."""

from tcmrl_data.store.manifest import MANIFEST
from tcmrl_data.store.part_table import PARTS_TABLE
from tests.hostile.case import ESCAPE, Case, Damage, Stage, with_field, with_name, with_recipe, with_run
from tests.hostile.datasets import Forge


def _manifest(name: str, damage: Damage, words: str, stage: Stage = "open") -> Case:
    return Case(name, damage, MANIFEST, (words,), stage)


def _more_tasks(forge: Forge) -> None:
    forge.manifest(lambda values: values["tasks"].update(lines=90_000))


def _manifest_file(data: bytes) -> Damage:
    return lambda forge: (forge.folder / MANIFEST).write_bytes(data)


MANIFESTS = [
    _manifest("empty file", _manifest_file(b""), "not a manifest"),
    _manifest("NaN", lambda f: f.text(b'"seed":0', b'"seed":NaN'), "NaN is not allowed"),
    _manifest("1e999", lambda f: f.text(b'"seed":0', b'"seed":1e999'), "too large"),
    _manifest("duplicate key", lambda f: f.text(b'"seed":0', b'"seed":0,"seed":1'), "key 'seed'"),
    _manifest("no UTF-8", lambda f: f.text(b'"seed":0', b'"seed":"\xff"'), "utf-8"),
    _manifest("extreme depth", _manifest_file(b"[" * 10**5), "nested deeper"),
    _manifest("extreme size", _manifest_file(b" " * (20 * 2**20)), "bytes"),
    _manifest("too many values", _manifest_file(b"[" + b"[]," * 200_000 + b"[]]"), "values"),
    _manifest("40000 bad runs", with_field(runs=[{}] * 40_000), "runs"),
    _manifest(
        "two runs of one name", lambda f: f.manifest(lambda v: v["runs"].append(v["runs"][0])), "names"
    ),
    _manifest("no run", with_field(runs=[]), "runs"),
    _manifest("no recipe", with_run(recipe=None), "recipe"),
    _manifest("run climbs", with_run(name="../../etc"), "runs.0.name"),
    _manifest("recipe of lists", with_run(recipe={"x": [[]] * 60_000}), "recipe."),
    _manifest("a list", _manifest_file(b"[1]"), "schema_version"),
    _manifest("edited", lambda f: f.text(b'"seed":0', b'"seed":1'), "digest"),
    _manifest(
        "an earlier version", with_field(schema_version=1, name=ESCAPE, seed=ESCAPE), "schema_version 1"
    ),
    _manifest("another version", with_field(schema_version=3), "schema_version 3"),
    _manifest("unknown key", with_field(surprise=1), "surprise"),
    _manifest("unknown key with escapes", with_field(**{ESCAPE: 1}), "control characters"),
    _manifest("label escapes", with_field(label=ESCAPE), "label holds control"),
    _manifest("name climbs", with_name("../../etc"), "name"),
    _manifest("name newline", with_name("point-robot\n"), "name"),
    _manifest(
        "other environment",
        with_recipe(lambda v: v["environment"].update(name="point-robot-wind")),
        "recipe.environment.name",
    ),
    _manifest(
        "platform of lists",
        lambda f: f.manifest(lambda v: v["platforms"][0].update(packages=[[]] * 60_000)),
        "platforms.0.packages",
    ),
    _manifest("dropped twice", with_field(dropped=[3, 3]), "dropped"),
    _manifest("more dropped than there are", with_field(dropped=[0, 1, 3]), "at most"),
    _manifest("steps in disorder", with_run(steps=[150, 0]), "steps"),
    _manifest(
        "two million parts",
        lambda f: (with_run(steps=list(range(30)))(f), _more_tasks(f)),
        "the runs call for",
    ),
    _manifest(
        "a seal beyond all", lambda f: f.manifest(lambda v: v["tasks"].update(bytes=2**62)), "tasks.bytes"
    ),
    _manifest("a million tasks", lambda f: f.manifest(lambda v: v["tasks"].update(lines=10**6)), "tasks"),
    _manifest(
        "total of parts",
        lambda f: f.manifest(lambda v: v["totals"].update(parts=3)),
        "totals.parts",
        "verify",
    ),
    _manifest("complete", with_field(complete=False), "complete", "verify"),
    Case("a task dropped that is there", with_field(dropped=[3]), "", ("root",), "tables"),
    Case("wrong root", with_field(root="0" * 64), "", ("root",), "tables"),
    _manifest("a part too few", lambda f: f.rows(PARTS_TABLE, lambda r: r.pop()), "complete", "verify"),
    _manifest("a task dropped that is none", with_field(dropped=[7]), "dropped names", "verify"),
]
