"""The platform of a part: what it consists of, when two are equal, and how differences are said."""

import os
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

import pytest

from tcmrl_data.foundation.records import canonical_json
from tcmrl_data.store.part import Platform, this_platform
from tests.environments import environment_of
from tests.platforms import AVX2, BASELINE

SHOW = """
import json
from tcmrl_data import load_recipe
from tcmrl_data.store.part import this_platform
found = this_platform(load_recipe("hopper-rand-params").make_environment(), "stacked")
print(json.dumps(found.model_dump(mode="json")))
"""


def platform_of(**variables: str) -> Platform:
    """The platform of a process with further environment variables."""
    done = subprocess.run(
        [sys.executable, "-c", SHOW], env=os.environ | variables, capture_output=True, text=True, check=True
    )
    return Platform.model_validate_json(done.stdout)


@pytest.mark.check
def test_two_processes_on_a_machine_have_the_same_platform() -> None:
    first, second = platform_of(), this_platform(environment_of("hopper-rand-params"), "stacked")
    assert first == second
    assert (first.digest(), first.differences(second)) == (second.digest(), [])
    assert set(first.packages) == {
        "gymnasium", "metaworld", "mujoco", "numpy", "stable-baselines3", "torch",
    }  # fmt: skip


@pytest.mark.check
@pytest.mark.parametrize("variables", [AVX2, BASELINE, {"MKL_CBWR": "AVX2"}])
def test_instruction_sets_and_variables_make_another_platform(variables: Mapping[str, str]) -> None:
    here = this_platform(environment_of("hopper-rand-params"), "stacked")
    there = platform_of(**variables)
    assert here.digest() != there.digest()
    assert f"MKL_CBWR {variables['MKL_CBWR']} there, unset here" in here.differences(there)


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("cpu", "Old One", "cpu Old One there, {cpu} here"),
        ("packages", {"torch": "0.1"}, "torch 0.1 there, {packages[torch]} here"),
        ("instructions", {"torch": "X"}, "instruction sets of torch X there, {instructions[torch]} here"),
        ("physics", {"timestep": 1.0}, "physics.timestep 1.0 there, 0.004 here"),
    ],
)
def test_a_difference_is_said_in_words(field: str, value: Any, expected: str) -> None:
    here = this_platform(environment_of("hopper-rand-params"))
    values = here.model_dump(mode="json")
    changed = values[field] | value if isinstance(value, dict) else value
    there = Platform.model_validate_json(canonical_json(values | {field: changed}))
    assert here.differences(there) == [expected.format(**values)]
