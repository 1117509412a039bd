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
    _manifest("infinity", lambda f: f.text(b'"seed":0', b'"seed":-Infinity'), "-Infinity is not"),
    _manifest("1e999", lambda f: f.text(b'"seed":0', b'"seed":1e999'), "too large"),
    _manifest("5000 digits", lambda f: f.text(b'"seed":0', b'"seed":' + b"9" * 5000), "digits"),
    _manifest("duplicate key", lambda f: f.text(b'"seed":0', b'"seed":0,"seed":1'), "key 'seed'"),
    _manifest(
        "duplicate escaped key", lambda f: f.text(b'"seed":0', b'"seed":0,"\\u0073eed":1'), "key 'seed'"
    ),
    _manifest("no UTF-8", lambda f: f.text(b'"seed":0', b'"seed":"\xff"'), "utf-8"),
    _manifest("byte order mark", lambda f: f.text(b"{", b"\xef\xbb\xbf{"), "not a manifest"),
    _manifest("surrogate", with_run(seed="\ud800"), "seed holds control"),
    _manifest("extreme depth", _manifest_file(b"[" * 10**5), "nested deeper"),
    _manifest("extreme size", _manifest_file(b" " * (20 * 2**20)), "bytes"),
    _manifest("too many values", _manifest_file(b"[" + b"[]," * 200_000 + b"[]]"), "values"),
    _manifest(
        "many values", _manifest_file(b'{"schema_version":2,"x":[' + b"[]," * 60_000 + b"0]}"), "digest"
    ),
    _manifest("40000 bad runs", with_field(runs=[{}] * 40_000), "runs"),
    _manifest("900 bad runs", with_field(runs=[{}] * 900), "runs.0"),
    _manifest(
        "two runs of one name", lambda f: f.manifest(lambda v: v["runs"].append(v["runs"][0])), "names"
    ),
    _manifest("no run", with_field(runs=[]), "runs"),
    _manifest("no recipe", with_run(recipe=None), "recipe"),
    _manifest("run climbs", with_run(name="../../etc"), "runs.0.name"),
    _manifest("run newline", with_run(name="main\n"), "runs.0.name"),
    _manifest("run of another kind", with_run(kind="stolen"), "runs.0.kind"),
    _manifest("recipe of lists", with_run(recipe={"x": [[]] * 60_000}), "recipe."),
    _manifest("a list", _manifest_file(b"[1]"), "schema_version"),
    _manifest("edited", lambda f: f.text(b'"seed":0', b'"seed":1'), "digest"),
    _manifest("spaces", lambda f: f.text(b'"seed":0', b'"seed": 0'), "digest"),
    _manifest(
        "an earlier version", with_field(schema_version=1, name=ESCAPE, seed=ESCAPE), "schema_version 1"
    ),
    _manifest("another version", with_field(schema_version=3), "schema_version 3"),
    _manifest("a flag as version", with_field(schema_version=True), "schema_version True"),
    _manifest("a text as version", with_field(schema_version="1" * 5000), "schema_version '1111"),
    _manifest("unknown key", with_field(surprise=1), "surprise"),
    _manifest("unknown key with escapes", with_field(**{ESCAPE: 1}), "control characters"),
    _manifest("label escapes", with_field(label=ESCAPE), "label holds control"),
    _manifest("label of 10,000", with_field(label="a" * 10_000), "label"),
    _manifest("a flag as seed", with_run(seed=True), "seed"),
    _manifest("a float as seed", with_run(seed=0.0), "seed"),
    _manifest("a text as flag", with_field(complete="yes"), "complete"),
    _manifest("null tasks", with_field(tasks=None), "tasks"),
    _manifest("name climbs", with_name("../../etc"), "name"),
    _manifest("name absolute", with_name("/etc/passwd\x00"), "name"),
    _manifest("name drive", with_name("C:\\x"), "name"),
    _manifest("name UNC", with_name("\\\\server\\share"), "name"),
    _manifest("name NUL", with_name("point\0robot"), "name"),
    _manifest("name newline", with_name("point-robot\n"), "name"),
    _manifest("name escapes", with_name(f"point{ESCAPE}"), "name"),
    _manifest("name 5000", with_name("a" * 5000), "name"),
    _manifest("name case", with_name("Point-Robot"), "name"),
    _manifest("name lookalike", with_name("pοint-rοbοt"), "name"),
    _manifest("no source", with_recipe(lambda v: v["behavior"].pop("source")), "source"),
    _manifest(
        "other environment",
        with_recipe(lambda v: v["environment"].update(name="point-robot-wind")),
        "recipe.environment.name",
    ),
    _manifest(
        "description escapes",
        with_recipe(lambda v: v["about"].update(description=f"x{ESCAPE}")),
        "description",
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
    _manifest("dropped twice", with_field(dropped=[3, 3]), "dropped"),
    _manifest("dropped below zero", with_field(dropped=[-1]), "dropped"),
    _manifest("dropped beyond all", with_field(dropped=[2**70]), "dropped"),
    _manifest("more dropped than there are", with_field(dropped=[0, 1, 3]), "at most"),
    _manifest("steps in disorder", with_run(steps=[150, 0]), "steps"),
    _manifest("step below zero", with_run(steps=[-150]), "steps"),
    _manifest("step of 4000 digits", with_run(steps=[10**3999]), "steps"),
    _manifest(
        "two million parts",
        lambda f: (with_run(steps=list(range(30)))(f), _more_tasks(f)),
        "the runs call for",
    ),
    _manifest("root newline", with_field(root="a" * 64 + "\n"), "root"),
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
    _manifest("complete", with_field(complete=False), "complete", "verify"),
    Case("a task dropped that is there", with_field(dropped=[3]), "", ("root",), "tables"),
    Case("wrong root", with_field(root="0" * 64), "", ("root",), "tables"),
    _manifest("a part too few", lambda f: f.rows(PARTS_TABLE, lambda r: r.pop()), "complete", "verify"),
    _manifest("a task dropped that is none", with_field(dropped=[7]), "dropped names", "verify"),
]
