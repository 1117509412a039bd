"""The published JSON Schemas: equal to the code's, satisfied by what datasets hold, and strict."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import jsonschema
import pytest

import tcmrl_data
from tcmrl_data import Dataset
from tcmrl_data.describe.schema import SchemaKind, json_schema, schema_file
from tcmrl_data.store.manifest import MANIFEST
from tcmrl_data.store.part import RECORD
from tests.workers import ROOT

pytestmark = pytest.mark.usefixtures("module_in_process")

Copy = Callable[[], Path]
KINDS = get_args(SchemaKind)
PUBLISHED = ROOT / "docs" / "schema"


def validator(kind: str) -> jsonschema.Draft202012Validator:
    schema = json_schema(kind)  # type: ignore[arg-type]
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def documents(dataset: Dataset) -> dict[str, Any]:
    """A document of every kind."""
    manifest = json.loads((dataset.folder / MANIFEST).read_text(encoding="utf-8"))
    with dataset.open_part(next(iter(dataset.parts))) as archive:
        part = json.loads(archive.read(RECORD))
    return {"manifest": manifest, "part": part, "recipe": manifest["runs"][0]["recipe"]}


@pytest.mark.parametrize("kind", KINDS)
def test_a_published_schema_is_that_of_the_code(kind: SchemaKind) -> None:
    text = json.dumps(json_schema(kind), indent=2) + "\n"
    assert text == (PUBLISHED / schema_file(kind)).read_text(encoding="utf-8"), (
        f"write json_schema({kind!r}) to docs/schema/{schema_file(kind)} again, with indent=2, and raise the "
        "schema's version if files that were written before do not satisfy it"
    )


def test_files_of_a_dataset_satisfy_their_schemas_and_unknown_keys_do_not(tiny: Dataset) -> None:
    for kind, document in documents(tiny).items():
        schema = validator(kind)
        schema.validate(document)
        with pytest.raises(jsonschema.ValidationError, match="'surprise' was unexpected"):
            schema.validate({**document, "surprise": 1})


@pytest.mark.parametrize(
    ("kind", "table"),
    [("manifest", "totals"), ("part", "identity"), ("part", "platform"), ("recipe", "rollouts")],
)
def test_unknown_keys_of_tables_are_refused(tiny: Dataset, kind: str, table: str) -> None:
    document = documents(tiny)[kind]
    assert not validator(kind).is_valid({**document, table: {**document[table], "surprise": 1}})


def test_a_manifest_of_another_schema_version_is_refused(tiny: Dataset) -> None:
    manifest = documents(tiny)["manifest"]
    with pytest.raises(jsonschema.ValidationError, match="2 was expected"):
        validator("manifest").validate({**manifest, "schema_version": 3})


def test_manifests_of_derived_merged_and_imported_datasets_satisfy_the_schema(
    tiny: Dataset, tmp_path: Path
) -> None:
    tcmrl_data.derive_dataset(tiny, tmp_path / "derived", episodes=3, seed=0, tasks=[0, 99])
    tcmrl_data.merge_datasets([tmp_path / "derived", tiny], tmp_path / "merged", names=["cut", "whole"])
    exported = tcmrl_data.export_dataset(tiny, "hdf5", tmp_path / "hdf5", tasks=[0]).files
    tcmrl_data.import_dataset("hdf5", exported, tmp_path / "imported", url="https://example.org")
    schema = validator("manifest")
    for name in ("derived", "merged", "imported"):
        schema.validate(documents(tcmrl_data.open_dataset(tmp_path / name))["manifest"])


@pytest.mark.check
def test_manifests_of_extended_and_relabelled_datasets_satisfy_the_schema(
    tiny: Dataset, tiny_copy: Copy, tmp_path: Path
) -> None:
    extended = tiny_copy()
    tcmrl_data.extend_dataset(extended, episodes=3, tasks=[0], snapshots="last", run="more", workers=1)
    tcmrl_data.relabel_dataset(tiny, tmp_path / "relabelled", to="nearest:1", workers=1)
    for folder in (extended, tmp_path / "relabelled"):
        validator("manifest").validate(documents(tcmrl_data.open_dataset(folder))["manifest"])


def test_recipes_of_all_profiles_satisfy_the_schema() -> None:
    schema = validator("recipe")
    for name in ("point-robot", "walker-rand-params", "ml1/reach"):
        for profile in ("paper", "quick"):
            recipe = tcmrl_data.load_recipe(name, profile=profile)
            schema.validate(recipe.model_dump(mode="json"))
