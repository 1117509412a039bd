"""TCMRL on synthetic batches: which loss trains which network, masks, contexts, and switches."""

import sys
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
import torch
from torch import Tensor

import tcmrl_data
from tcmrl_algo import resolve
from tcmrl_algo.algorithms import tcmrl
from tcmrl_algo.algorithms.core.context import ContextAlgorithm, ContextLosses
from tcmrl_algo.algorithms.core.networks import call_frozen
from tcmrl_algo.algorithms.tcmrl import negative_reward_loss, reverse_context, task_contrastive_loss
from tcmrl_algo.experiment.spec import load_experiment
from tcmrl_data import Batch, Steps, TrainingError
from tests.made_up import EPISODE, TASKS, batch, problem, settings, steps, with_steps

SMALL: dict[str, Any] = {"latent": 4, "encoder_hidden": (8,), "tce_hidden": (8,), "estimator_hidden": (8,)}
ONLY = dict.fromkeys(tcmrl.Weights.model_fields, 0.0)


def method(
    config: dict[str, Any] | None = None, *, sparse: bool = False, seed: int = 0, **more: Any
) -> ContextAlgorithm:
    made = tcmrl.Tcmrl().create(
        problem(sparse=sparse, seed=seed),
        settings(**more),
        tcmrl.TcmrlConfig.model_validate(SMALL | (config or {})),
    )
    assert isinstance(made, ContextAlgorithm)
    return made


def learner(config: dict[str, Any] | None = None, *, sparse: bool = False) -> tcmrl.TcmrlLearner:
    made = method(config, sparse=sparse).learner
    assert isinstance(made, tcmrl.TcmrlLearner)
    return made


def losses_of(made: tcmrl.TcmrlLearner, values: Batch | None = None, seed: int = 0) -> ContextLosses:
    return made.losses(values or batch(), 1, torch.Generator().manual_seed(seed))


def terms_of(found: ContextLosses) -> set[str]:
    return {name.removeprefix("loss/") for name in found.metrics if name.startswith("loss/")}


def gradients(weights: dict[str, float]) -> dict[str, float]:
    """Largest gradient of every part of the context learner under a single loss term."""
    made = learner({"weights": ONLY | weights})
    losses_of(made).total.backward()  # type: ignore[no-untyped-call]
    found: dict[str, float] = {}
    for name, parameter in made.named_parameters():
        size = 0.0 if parameter.grad is None else parameter.grad.abs().max().item()
        part = name.split(".")[0]
        found[part] = max(found.get(part, 0.0), size)
    return found


def test_a_training_step_is_read_in_at_most_twelve_files() -> None:
    made, values, files = method(), batch(), set[Path]()
    made.update(values, 1)  # what happens in the first step alone does not count

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            files.add(Path(frame.f_code.co_filename))

    sys.setprofile(note)
    try:
        made.update(values, 2)
    finally:
        sys.setprofile(None)
    root = Path(tcmrl_data.__file__).parents[1]
    own = {str(file.relative_to(root)) for file in files if file.is_relative_to(root)}
    assert len([name for name in own if name.startswith(("tcmrl_algo", "tcmrl_data"))]) <= 12, sorted(own)


def test_positive_loss_trains_encoder_extractor_and_estimator() -> None:
    found = gradients({"positive": 1.0})
    assert min(found["encoder"], found["extractor"], found["estimator"]) > 1e-6
    assert found["similarity"] == 0.0


@pytest.mark.parametrize("sparse", [False, True])
def test_negative_loss_leaves_the_estimator_untouched(sparse: bool) -> None:
    made = learner({"weights": ONLY | {"negative": 1.0}, "estimator_training": "positive"}, sparse=sparse)
    found = losses_of(made)
    assert terms_of(found) == {"negative"}
    found.total.backward()  # type: ignore[no-untyped-call]
    for parameter in made.estimator.parameters():
        assert parameter.grad is None or not parameter.grad.any()
    for part in (made.encoder, made.extractor):
        assert (
            max(parameter.grad.abs().max() for parameter in part.parameters() if parameter.grad is not None)
            > 1e-7
        )


def all_gradients(config: dict[str, Any], *, sparse: bool = False) -> dict[str, Tensor]:
    """The gradient of every parameter of the context learner; zeros where there is none."""
    made = learner(config, sparse=sparse)
    losses_of(made).total.backward()  # type: ignore[no-untyped-call]
    return {
        name: torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        for name, parameter in made.named_parameters()
    }


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("others", [{}, {"sparsity": 0.3}], ids=["negative alone", "without positive"])
def test_without_l_pos_the_estimator_learns_from_detached_contexts(
    sparse: bool, others: dict[str, float]
) -> None:
    """It gets the gradient that L_pos gives it; encoder and extractor get that of the other losses alone."""
    weights = ONLY | {"negative": 0.7} | others
    made = learner({"weights": weights}, sparse=sparse)
    assert terms_of(losses_of(made)) == {"negative", "estimator", *others}
    found = all_gradients({"weights": weights}, sparse=sparse)
    alone = all_gradients({"weights": weights, "estimator_training": "positive"}, sparse=sparse)
    by_positive = all_gradients({"weights": ONLY | {"positive": 1.0}}, sparse=sparse)
    assert any(name.startswith("estimator.") for name in found)
    for name, gradient in found.items():
        expected = by_positive[name] if name.startswith("estimator.") else alone[name]
        torch.testing.assert_close(gradient, expected, msg=name)
        assert gradient.any() or name == "similarity" or name.endswith("bias"), name


def test_the_estimator_is_not_trained_where_nothing_reads_it() -> None:
    for config in (
        {"weights": ONLY | {"sparsity": 1.0}},
        {"weights": ONLY | {"negative": 1.0}, "extractor": "mean"},
    ):
        assert "estimator" not in terms_of(losses_of(learner(config)))


def test_sparsity_and_contrastive_train_what_they_should() -> None:
    found = gradients({"sparsity": 1.0})
    assert min(found["encoder"], found["extractor"]) > 1e-6
    assert found["estimator"] == found["similarity"] == 0.0
    found = gradients({"contrastive": 1.0})
    assert min(found["encoder"], found["similarity"]) > 1e-6
    assert found["estimator"] == 0.0
    found = gradients({"distance": 1.0})
    assert min(found["encoder"], found["extractor"]) > 1e-6


def test_actor_critic_losses_never_reach_the_context() -> None:
    made = method({"weights": ONLY})
    before = {name: value.clone() for name, value in made.learner.state_dict().items()}
    made.update(batch(), 1)
    for name, value in made.learner.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_an_update_moves_everything_that_learns_w_included() -> None:
    made = method()
    before = {name: parameter.detach().clone() for name, parameter in made.learner.named_parameters()}
    torch.testing.assert_close(before["similarity"], torch.eye(4))
    metrics = made.update(batch(), 1)
    assert all(torch.isfinite(value) for value in metrics.values())
    for name, parameter in made.learner.named_parameters():
        assert not torch.equal(parameter, before[name]), name


def test_contexts_never_see_execution_trajectories() -> None:
    made = learner({"weights": ONLY | {"positive": 1.0}})
    plain = batch()
    other = with_steps(plain, execution=steps(TASKS, 1, EPISODE, seed=33))
    first, second = losses_of(made, plain), losses_of(made, other)
    torch.testing.assert_close(first.context, second.context)
    assert first.total.item() != second.total.item()  # rewards are estimated on them


def test_literal_equation_6_adds_nothing_to_any_gradient() -> None:
    made = learner({"sparsity": "literal", "weights": ONLY | {"sparsity": 1.0}})
    total = losses_of(made).total
    total.backward()  # type: ignore[no-untyped-call]
    assert total.item() == pytest.approx(1.0)
    grads = [parameter.grad for parameter in made.parameters() if parameter.grad is not None]
    assert max(grad.abs().max() for grad in grads) < 1e-7


def test_negative_estimation_with_noise_of_mean_zero_fits_the_true_rewards() -> None:
    """Over noise e and -e the gradient of L_neg is that of no noise, exactly, as is then its expectation."""

    def gradient(sign: float) -> Tensor:
        made = learner({"weights": ONLY | {"negative": 1.0}, "estimator_training": "positive"})
        attention = made.attention(batch()["context"])
        execution = made.encoder.read(batch()["execution"])
        noise = sign * torch.randn(execution.rewards.shape, generator=torch.Generator().manual_seed(5))
        wrong = execution.rewards + noise
        reverse = reverse_context(attention.representations, attention.weights, attention.mask)
        misled = call_frozen(made.estimator, execution.state_actions.flatten(1, 2), reverse)
        loss = negative_reward_loss(misled.view(execution.mask.shape), wrong, execution.mask)
        loss.backward()  # type: ignore[no-untyped-call]
        gradients = [value.grad for value in made.parameters() if value.grad is not None]
        return torch.cat([value.flatten() for value in gradients])

    positive, none, negative = gradient(1.0), gradient(0.0), gradient(-1.0)
    torch.testing.assert_close((positive + negative) / 2, none, atol=1e-6, rtol=1e-4)
    assert (positive - none).abs().max() > 0.01 * none.abs().max()


def test_sampled_windows_replace_those_of_the_context() -> None:
    made = learner()
    plain = losses_of(made).metrics["loss/contrastive"].item()
    drawn = [
        losses_of(made, with_steps(batch(), windows=steps(TASKS, 4, 2, seed=seed))).metrics for seed in (7, 8)
    ]
    assert len({plain, *(metrics["loss/contrastive"].item() for metrics in drawn)}) == 3
    assert drawn[0]["loss/distance"].item() == drawn[1]["loss/distance"].item()


TERM_WEIGHTS = {"positive": 1.0, "negative": 0.5, "sparsity": 0.3, "contrastive": 0.7, "distance": 0.2}


@pytest.mark.parametrize("name", TERM_WEIGHTS)
def test_a_term_of_weight_zero_is_gone_and_the_others_stay(name: str) -> None:
    """The loss of every perspective, the contrastive and the distance-metric loss: removed, and alone."""
    whole = losses_of(learner({"weights": TERM_WEIGHTS}))
    without = losses_of(learner({"weights": TERM_WEIGHTS | {name: 0.0}}))
    alone = losses_of(learner({"weights": ONLY | {name: TERM_WEIGHTS[name]}}))
    replaced = {"estimator"} if name == "positive" else set()  # trains the estimator in its place
    assert terms_of(without) == set(TERM_WEIGHTS) - {name} | replaced
    assert terms_of(alone) == {name} | ({"estimator"} if name == "negative" else set())
    for key in without.metrics:
        before = "loss/positive" if key == "loss/estimator" else key
        torch.testing.assert_close(without.metrics[key], whole.metrics[before], msg=key)
    added = sum(found.metrics.get("loss/estimator", torch.zeros(())) for found in (without, alone))
    torch.testing.assert_close(without.total + alone.total - added, whole.total)
    torch.testing.assert_close(without.context, whole.context)


@pytest.mark.parametrize(
    ("change", "changed"),
    [
        ({"negative_reward": "max"}, {"loss/negative"}),
        ({"negative_reward": "min"}, {"loss/negative"}),
        ({"reverse_scale": "sum"}, {"loss/negative"}),
        ({"sparsity": "literal"}, {"loss/sparsity"}),
        ({"sparsity": "centered"}, {"loss/sparsity"}),
        ({"sparsity": "entropy"}, {"loss/sparsity"}),
        ({"estimator_training": "positive"}, set()),
        ({"temperature": 2.0}, {"loss/contrastive"}),
        ({"reward_estimation": "trajectory"}, {"loss/positive", "loss/negative"}),
    ],
    ids=lambda value: "-".join(map(str, value.items() if isinstance(value, dict) else sorted(value))),
)
def test_a_switch_changes_its_own_terms_and_nothing_else(change: dict[str, Any], changed: set[str]) -> None:
    first, second = losses_of(learner()), losses_of(learner(change))
    assert first.metrics.keys() == second.metrics.keys()
    different = {
        name for name, value in first.metrics.items() if not torch.equal(value, second.metrics[name])
    }
    assert different == changed
    torch.testing.assert_close(first.context, second.context)


@pytest.mark.parametrize("level", ["transition", "trajectory"])
def test_more_execution_trajectories_are_more_targets_and_change_no_other_loss(level: str) -> None:
    many = steps(TASKS, 3, EPISODE, seed=4)

    def metrics(config: dict[str, Any], chosen: slice) -> dict[str, Tensor]:
        fields = {name: None if value is None else value[:, chosen] for name, value in vars(many).items()}
        made = learner({"reward_estimation": level, "negative_noise": 0.0} | config)
        return losses_of(made, with_steps(batch(), execution=Steps(**fields))).metrics

    first, second = metrics({}, slice(1)), metrics({}, slice(3))
    different = {name for name, value in first.items() if not torch.equal(value, second[name])}
    assert different == {"loss/positive", "loss/negative"}
    singles = [metrics({}, slice(place, place + 1))["loss/positive"] for place in range(3)]
    torch.testing.assert_close(second["loss/positive"], torch.stack(singles).mean())
    more = metrics({"distance_examples": 3}, slice(3))
    assert not torch.equal(more["loss/distance"], second["loss/distance"])


@pytest.mark.parametrize("window_length", [2, 3, 4])
def test_k_is_the_length_of_the_windows(window_length: int) -> None:
    made = settings()
    sizes = made.batch.model_copy(update={"window_length": window_length})
    config = tcmrl.TcmrlConfig.model_validate(SMALL)
    changed = tcmrl.TcmrlLearner(problem(), made.model_copy(update={"batch": sizes}), config)
    (representations,) = changed.encoder(context := changed.encoder.read(batch()["context"]))
    expected = task_contrastive_loss(
        representations, context.mask, changed.similarity, window_length=window_length
    )
    found = losses_of(changed).metrics
    torch.testing.assert_close(found["loss/contrastive"], expected)
    first = losses_of(learner()).metrics
    different = {name for name, value in first.items() if not torch.equal(value, found[name])}
    assert different == ({"loss/contrastive"} if window_length != 2 else set())


def test_windows_longer_than_every_episode_are_refused() -> None:
    made = settings()
    sizes = made.batch.model_copy(update={"window_length": EPISODE + 1})
    longer = made.model_copy(update={"batch": sizes})
    with pytest.raises(TrainingError, match=rf"window_length {EPISODE + 1} .* an episode, {EPISODE} steps"):
        tcmrl.TcmrlLearner(problem(), longer, tcmrl.TcmrlConfig.model_validate(SMALL))
    tcmrl.TcmrlLearner(
        problem(), longer, tcmrl.TcmrlConfig.model_validate(SMALL | {"weights": {"contrastive": 0}})
    )


@pytest.mark.parametrize(
    ("level", "sparse", "whole"),
    [
        ("auto", False, False),
        ("auto", True, True),
        ("transition", True, False),
        ("trajectory", False, True),
    ],
)
def test_rewards_are_estimated_by_transition_or_by_trajectory(level: str, sparse: bool, whole: bool) -> None:
    """Moving a reward along a trajectory changes the first and not the second."""
    made = learner({"reward_estimation": level, "weights": ONLY | {"positive": 1.0}}, sparse=sparse)
    assert made.estimates_trajectories is whole
    plain = batch(lengths=None)
    moved = with_steps(
        plain, execution=replace(plain["execution"], rewards=plain["execution"].rewards.roll(1, 2))
    )
    first, second = losses_of(made, plain).total.item(), losses_of(made, moved).total.item()
    assert (first == pytest.approx(second, rel=1e-5)) is whole


def test_without_the_extractor_the_context_is_the_mean() -> None:
    made = learner({"extractor": "mean", "weights": {"orthogonality": 1.0}})
    found = losses_of(made)
    (representations,) = made.encoder(context := made.encoder.read(batch()["context"]))
    for lane, values in enumerate(representations):
        torch.testing.assert_close(found.context[lane], values[context.mask[lane]].mean(dim=0))
    assert terms_of(found) == {"positive", "contrastive", "distance"}
    with_it = losses_of(learner())
    torch.testing.assert_close(found.metrics["loss/contrastive"], with_it.metrics["loss/contrastive"])
    found.total.backward()  # type: ignore[no-untyped-call]
    assert all(parameter.grad is None for parameter in made.extractor.parameters())


def test_switches_of_the_context_leave_the_actor_critics_draws_alone() -> None:
    weights: dict[str, float] = ONLY
    first, second = method({"weights": weights}), method({"weights": weights, "extractor": "mean"})
    for name, value in first.actor_critic.state_dict().items():
        assert torch.equal(value, second.actor_critic.state_dict()[name]), name
    noisy = method({"weights": weights | {"negative": 1e-30}})
    expected = first.update(batch(), 1)["loss/policy"]
    torch.testing.assert_close(noisy.update(batch(), 1)["loss/policy"], expected, rtol=0, atol=0)


def test_sparse_rewards_are_estimated_by_trajectory_in_the_recipe_and_whatever_was_tuned_elsewhere() -> None:
    """Appendix F.3; a search on dense rewards may have found `transition`, which equals `auto` there."""
    recipe = tcmrl_data.load_recipe("sparse-point-robot", profile="quick")
    assert recipe.environment.reward_density == "sparse"
    for profile, table in recipe.training.items():
        assert resolve(table, place=profile, algorithm="tcmrl").method["reward_estimation"] == "auto"
    assert "tcmrl.reward_estimation" not in tcmrl.Tcmrl.search
    chosen = load_experiment("table2").overrides("sparse-point-robot", "TCMRL")
    assert 'tcmrl.reward_estimation="auto"' in chosen
