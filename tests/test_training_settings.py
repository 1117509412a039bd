"""Settings of a training: where they come from, what goes over what, and that all are documented."""

import re

import pytest
from pydantic import BaseModel

from tcmrl_algo import TrainingConfig, resolve
from tcmrl_algo.algorithms import tcmrl as tcmrl_module
from tcmrl_algo.algorithms.core.settings import (
    ActorCriticSettings,
    BatchSettings,
    BracSettings,
    IqlSettings,
    OptimizerSettings,
    RunSettings,
    TrainingSettings,
)
from tcmrl_data import Dataset, TcmrlError
from tests.small_training import config_of


def test_recipe_values_reach_the_run(tiny: Dataset) -> None:
    settings = resolve(tiny.manifest.training["quick"], place="quick").settings
    assert settings.actor_critic.gamma == 0.9
    assert settings.batch.context_trajectories == (1, 2, 4)
    paper = resolve(tiny.manifest.training["paper"], place="paper").settings
    assert paper.run.steps == 100_000
    assert paper.actor_critic.hidden == (256, 256, 256)


def test_an_empty_table_resolves_to_sourced_defaults() -> None:
    config = resolve({}, place="nothing")
    assert config.settings == TrainingSettings()
    assert config.method["latent"] == 20
    assert TrainingConfig.model_validate_json(config.model_dump_json()) == config


def test_overrides_come_last_and_keep_their_types(tiny: Dataset) -> None:
    config = config_of(
        tiny, "tcmrl.weights.negative=0", "actor_critic.brac.mode=policy", "batch.context_trajectories=[2]"
    )
    assert config.method["weights"]["negative"] == 0.0
    assert config.method["weights"]["positive"] == 1.0
    assert config.settings.actor_critic.brac.mode == "policy"
    assert config.settings.batch.context_trajectories == (2,)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("tcmrl.latent=many", "latent"),
        ("tcmrl.latent=2.5", "latent"),
        ("tcmrl.latnet=3", "latnet"),
        ("run.steps=true", "steps"),
        ("actor_critic.gamma=1.5", "gamma"),
        ("actor_critc.gamma=0.5", "actor_critc"),
        ("batch.tasks=1", "tasks"),
        ("nonsense", "nonsense"),
    ],
)
def test_bad_overrides_are_named(tiny: Dataset, override: str, expected: str) -> None:
    with pytest.raises(TcmrlError, match=expected) as caught:
        config_of(tiny, override)
    assert len(str(caught.value).splitlines()) == 1


def test_unknown_algorithm_names_the_nearest(tiny: Dataset) -> None:
    with pytest.raises(TcmrlError, match=r"tcmlr.*tcmrl"):
        config_of(tiny, algorithm="tcmlr")


@pytest.mark.parametrize(
    "table",
    [
        RunSettings,
        OptimizerSettings,
        BatchSettings,
        ActorCriticSettings,
        BracSettings,
        IqlSettings,
        tcmrl_module.TcmrlConfig,
        tcmrl_module.Weights,
    ],
    ids=lambda table: table.__name__,
)
def test_every_setting_is_documented(table: type[BaseModel]) -> None:
    documented = re.findall(r"^\s+([\w, ]+): ", table.__doc__ or "", re.MULTILINE)
    assert set(table.model_fields) <= {name for line in documented for name in line.split(", ")}
