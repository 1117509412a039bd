"""A small experiment on the tiny dataset, for the tests of experiments and of reports."""

from pathlib import Path
from typing import Any

SMALL = {
    "run": {"steps": 40, "log_every": 10, "checkpoint_every": 10, "episodes": 2, "random_episodes": 1},
    "batch": {"transitions": 8},
    "actor_critic": {"hidden": [8]},
    "tcmrl": {"latent": 4, "encoder_hidden": [8], "tce_hidden": [8], "estimator_hidden": [8]},
}


def tables(dataset: Path, **changes: Any) -> dict[str, Any]:
    """The tables of an experiment file: two methods, two seeds, a curve of two points."""
    return {
        "schema": 1,
        "name": "small",
        "title": "TCMRL and its control",
        "source": "Figure 4",
        "seeds": [0, 1],
        "environments": {"point-robot": {"dataset": str(dataset), "profile": "quick"}},
        "methods": {
            "TCMRL": {"algorithm": "tcmrl"},
            "no context": {"algorithm": "no_context", "training": {"run": {"log_every": 20}}},
        },
        "training": SMALL,
        "protocols": ["offline", "paper"],
        "curve_points": 2,
        "claims": [
            {"text": "TCMRL ends higher", "better": "TCMRL", "worse": "no context"},
            {
                "text": "It attends to rewards",
                "better": "TCMRL",
                "worse": "TCMRL",
                "metric": "attention_nonzero",
                "against": "attention_zero",
            },
        ],
    } | changes


def write_file(file: Path, content: dict[str, Any]) -> Path:
    """The tables as a TOML file."""
    file.write_text("\n".join(_lines(content, "")), encoding="utf-8")
    return file


def _lines(table: dict[str, Any], prefix: str) -> list[str]:
    import json

    found: list[str] = []
    for key, value in table.items():
        name = f"{prefix}{json.dumps(key)}"
        if isinstance(value, dict):
            found += _lines(value, f"{name}.") if value else [f"{name} = {{}}"]
        elif value and isinstance(value, list) and isinstance(value[0], dict):
            items = ", ".join("{" + ", ".join(_lines(entry, "")) + "}" for entry in value)
            found.append(f"{name} = [{items}]")
        else:
            found.append(f"{name} = {json.dumps(value)}")
    return found
