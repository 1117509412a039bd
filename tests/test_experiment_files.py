"""The experiments that come with the package."""

import pytest

import tcmrl_data
from tcmrl_algo import experiment_names, load_experiment
from tcmrl_algo.experiment.plan import resolve_method
from tcmrl_algo.experiment.results import Tuned

TUNED = Tuned(
    environment="",
    root="",
    profile="quick",
    trials=1,
    steps=1,
    seeds=(0,),
    score=0.0,
    overrides=("tcmrl.weights.negative=0.02",),
)
"""Experiments that compare tuned settings with others have two methods alike without them."""


@pytest.mark.parametrize("name", experiment_names())
def test_every_shipped_experiment_resolves_on_the_recipes_of_its_environments(name: str) -> None:
    experiment = load_experiment(name)
    assert experiment.name == name
    assert len(experiment.seeds) * len(experiment.fold_numbers) >= 5
    for environment, choice in experiment.environments.items():
        table = dict(tcmrl_data.load_recipe(environment).training)[choice.profile or "paper"]  # type: ignore[index]
        configs = [
            resolve_method(
                experiment,
                table,
                environment=environment,
                label=label,
                place=name,
                tuned=TUNED if method.algorithm == "tcmrl" else None,
            )
            for label, method in experiment.methods.items()
            if method.runs_in(environment)
        ]
        assert len({config.model_dump_json() for config in configs}) == len(configs)  # no two are the same
