"""JSON Schemas (2020-12) of the JSON that a dataset consists of, from the models that read it.

A schema knows names, types and bounds. What it cannot say, such as that a digest is the right one, is checked
when a file is read.
"""

from typing import Any, Literal

from pydantic import TypeAdapter

from tcmrl_data.recipe.document import RECIPE_SCHEMA
from tcmrl_data.recipe.recipe import Recipe
from tcmrl_data.store.manifest import MANIFEST_SCHEMA, Manifest
from tcmrl_data.store.part import PART_SCHEMA, PartRecord

SchemaKind = Literal["manifest", "part", "recipe"]

DIALECT = "https://json-schema.org/draft/2020-12/schema"

_MODELS: dict[SchemaKind, tuple[TypeAdapter[Any], int, str]] = {
    "manifest": (TypeAdapter(Manifest), MANIFEST_SCHEMA, "manifest.json of a dataset"),
    "part": (TypeAdapter(PartRecord), PART_SCHEMA, "part.json in the archive of a part"),
    "recipe": (TypeAdapter(Recipe), RECIPE_SCHEMA, "A resolved recipe, as a manifest records it"),
}


def json_schema(kind: SchemaKind) -> dict[str, Any]:
    """The JSON Schema of a kind of file.

    Example:
        >>> json_schema("manifest")["$id"]
        'urn:tcmrl:schema:manifest:2'
    """
    adapter, version, title = _MODELS[kind]
    schema = adapter.json_schema() | {
        "$schema": DIALECT,
        "$id": f"urn:tcmrl:schema:{kind}:{version}",
        "title": title,
    }
    if "schema_version" in schema.get("properties", {}):
        schema["properties"]["schema_version"]["const"] = version
    return schema


def schema_file(kind: SchemaKind) -> str:
    """The name under which a schema is published: a schema that has changed gets another one."""
    return f"{kind}-{_MODELS[kind][1]}.json"
