"""Settings that all methods share, and in which compared methods differ all the same.

What a short search found for them may be luck, and then decides more than the methods do.
"""

from typing import Any

from tcmrl_algo.algorithms.core.settings import TrainingSettings
from tcmrl_algo.experiment.results import RunResult
from tcmrl_data.foundation.canonical import differences

UNCOMPARED = frozenset({"run.algorithm", "run.threads"})
"""Settings by which two methods always differ, or which shape no more than last bits."""


def unequal_settings(left: RunResult, right: RunResult) -> dict[str, tuple[Any, Any]]:
    """Both values of the shared settings that differ in two runs, by key such as `actor_critic.entropy`."""
    found = differences(_shared(left), _shared(right))
    return {key: (ours, theirs) for key, ours, theirs in found if key not in UNCOMPARED}


def _shared(result: RunResult) -> dict[str, Any]:
    settings = result.config.settings
    return {name: getattr(settings, name).model_dump(mode="json") for name in TrainingSettings.model_fields}
