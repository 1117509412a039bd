"""Croissant 1.0 (https://docs.mlcommons.org/croissant): what programs that search for data read of a dataset.

Croissant reads neither Zarr nor rows that are lists, so its records are those of two tables written beside
`croissant.json`: a line per task and a line per part. The episodes stay in the archives that it names.
"""

import json
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from tcmrl_data.building.work_files import CROISSANT, CROISSANT_PARTS, CROISSANT_TASKS
from tcmrl_data.dataset.dataset import Dataset
from tcmrl_data.describe.cite import citation_of, citation_text
from tcmrl_data.foundation.disk import STAGING, replace_file
from tcmrl_data.foundation.records import canonical_json, sha256
from tcmrl_data.recipe.document import is_listed
from tcmrl_data.store.manifest import MANIFEST
from tcmrl_data.store.part_table import PartEntry
from tcmrl_data.store.tables import PARTS, part_file

CONFORMS_TO = ("http://mlcommons.org/croissant/1.0", "http://mlcommons.org/croissant/RAI/1.0")

_CR_TERMS = (
    "citeAs column conformsTo equivalentProperty extract field fileObject fileProperty fileSet format "
    "includes isLiveDataset jsonPath key md5 parentField path recordSet references regex repeated replace "
    "samplingRate separator source subField transform"
)
CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    **{name: f"cr:{name}" for name in _CR_TERMS.split()},
    "conformsTo": "dct:conformsTo",
}
"""The context that the specification prescribes."""

TASK_FIELDS = {
    "index": ("sc:Integer", "Index of the task."),
    "split": ("sc:Text", "train or test."),
    "parameters": ("sc:Text", "Parameters of the task, as JSON."),
}
PART_FIELDS = {
    "task": ("sc:Integer", "Index of the task."),
    "step": ("sc:Integer", "Training steps of the policy that acted."),
    "run": ("sc:Text", "Name of the way in which the part was made."),
    "id": ("sc:Text", "Digest of the part's identity."),
    "file": ("sc:Text", "The part's archive, relative to the dataset."),
    "sha256": ("sc:Text", "Digest of the archive."),
    "size": ("sc:Integer", "Size of the archive in bytes."),
    "episodes": ("sc:Integer", "Number of episodes."),
    "steps": ("sc:Integer", "Number of environment steps."),
    "mean": ("sc:Float", "Mean undiscounted return of the episodes."),
    "std": ("sc:Float", "Standard deviation of the returns."),
    "min": ("sc:Float", "Smallest return."),
    "max": ("sc:Float", "Largest return."),
    "success_rate": ("sc:Float", "Share of episodes with a success; empty without a success signal."),
    "uniform": ("sc:Float", "Mean return of uniform actions on the task; empty where it is not known."),
    "oracle": ("sc:Float", "Mean return of a controller that knows the task; empty where there is none."),
    "scripted": ("sc:Float", "Mean return of the environment's expert; empty where there is none."),
}


def write_croissant(dataset: Dataset, folder: Path | None = None) -> Path:
    """Writes `croissant.json` and its two tables; returns the path of `croissant.json`.

    Args:
        dataset: a dataset, or a view if `folder` is another one than that of its source.
        folder: where to; the dataset's own where it is None.
    """
    target = dataset.folder if folder is None else folder
    files = {CROISSANT_TASKS: _task_lines(dataset), CROISSANT_PARTS: _part_lines(dataset)}
    document = croissant_document(dataset, {name: sha256(data) for name, data in files.items()})
    files[CROISSANT] = (json.dumps(document, indent=2, ensure_ascii=False) + "\n").encode()
    target.mkdir(parents=True, exist_ok=True)
    staging = target / STAGING if target == dataset.folder else None
    for name, data in files.items():
        replace_file(target / name, data, staging=staging)
    return target / CROISSANT


def croissant_document(dataset: Dataset, digests: Mapping[str, str]) -> dict[str, Any]:
    """The JSON-LD of `croissant.json`.

    Args:
        digests: sha256 of the two tables, by file name.
    """
    manifest = dataset.manifest
    citation = citation_of(manifest)
    about = manifest.recipe.about
    fields = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": list(CONFORMS_TO),
        "name": re.sub(r"[^A-Za-z0-9_.-]+", "-", citation.name),
        "description": f"{about.description} {citation.title}.",
        "license": [_licence(name) for name in manifest.licences],
        "url": about.url or (f"https://doi.org/{about.doi}" if about.doi else f"urn:sha256:{manifest.root}"),
        # semantic versioning allows digits and letters behind the plus sign
        "version": f"{manifest.data_version}.0.0+{citation.version}",
        "creator": [_creator(name) for name in citation.authors],
        "citeAs": citation_text(manifest, "bibtex"),
        "isLiveDataset": False,
        "keywords": ["reinforcement learning", "offline RL", "meta-RL", manifest.name],
        "rai:dataCollection": _collection(dataset),
        "rai:dataCollectionType": ["Simulations"],
        "rai:personalSensitiveInformation": ["None: the data come from simulations of machines and points."]
        if manifest.is_drawn
        else None,
        "distribution": [*_distribution(dataset, digests)],
        "recordSet": [
            _record_set("tasks", "A record per task.", TASK_FIELDS, CROISSANT_TASKS),
            _record_set("parts", "A record per policy and its episodes.", PART_FIELDS, CROISSANT_PARTS),
        ],
    }
    return {name: value for name, value in fields.items() if value is not None}


def _licence(name: str) -> str:
    return f"https://spdx.org/licenses/{name}.html" if is_listed(name) else name


def _creator(name: str) -> dict[str, str]:
    family, comma, given = (part.strip() for part in name.partition(","))
    if comma and given:
        return {"@type": "sc:Person", "name": f"{given} {family}", "familyName": family, "givenName": given}
    return {"@type": "sc:Organization", "name": name}


def _collection(dataset: Dataset) -> str:
    recipe, kinds = dataset.manifest.recipe, sorted({run.kind for run in dataset.manifest.runs})
    return (
        f"Runs of the kinds {', '.join(kinds)}; behavior policies: {recipe.behavior.source}; environment: "
        f"{dataset.name}, {len(dataset.train_tasks)} training and {len(dataset.test_tasks)} test tasks."
    )


def _distribution(dataset: Dataset, digests: Mapping[str, str]) -> Iterable[dict[str, Any]]:
    """The tables that Croissant reads, and the files that the dataset consists of."""
    for name, digest in digests.items():
        yield _file(name, "application/jsonlines", digest)
    yield _file(MANIFEST, "application/json", sha256((dataset.folder / MANIFEST).read_bytes()))
    yield {
        "@type": "cr:FileSet",
        "@id": "archives",
        "description": "A part each: a stored ZIP with a Zarr v3 group, a policy and a record.",
        "encodingFormat": "application/zip",
        "includes": f"{PARTS}/**/*.zip",
    }


def _file(name: str, encoding: str, digest: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "encodingFormat": encoding,
        "sha256": digest,
    }


def _record_set(
    name: str, description: str, fields: Mapping[str, tuple[str, str]], file: str
) -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": description,
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"{name}/{field}",
                "name": field,
                "description": meaning,
                "dataType": kind,
                "source": {"fileObject": {"@id": file}, "extract": {"column": field}},
            }
            for field, (kind, meaning) in fields.items()
        ],
    }


def _task_lines(dataset: Dataset) -> bytes:
    return b"".join(
        canonical_json(
            {
                "index": task.index,
                "split": task.split,
                "parameters": canonical_json(dict(task.parameters)).decode().strip(),
            }
        )
        for task in dataset.tasks
    )


def _part_lines(dataset: Dataset) -> bytes:
    return b"".join(canonical_json(part_row(entry)) for entry in dataset.parts.entries())


def part_row(entry: PartEntry) -> dict[str, Any]:
    """The fields of `PART_FIELDS`; what is not known is None."""
    values = {name: getattr(entry, name, None) for name in PART_FIELDS} | {"file": part_file(entry.key)}
    return {
        name: None if isinstance(value, float) and math.isnan(value) else value
        for name, value in values.items()
    }
