"""CORRO: its stages and what every one of them trains, negatives, representations, and the aggregator."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tcmrl_algo.algorithms.core.context import ContextAlgorithm
from tcmrl_algo.algorithms.core.networks import mean_representation
from tcmrl_algo.algorithms.core.problem import StagePlan
from tcmrl_algo.algorithms.core.settings import RunSettings
from tcmrl_algo.algorithms.corro import (
    Corro,
    CorroConfig,
    CorroLearner,
    outcome_error,
    relabelled_contrastive_loss,
)
from tcmrl_data import Batch, Dataset, Steps, TrainingError
from tests.context_learners import algorithm_of, gradients, learner_of, losses_of, moved
from tests.made_up import (
    ACTION_DIM,
    OBSERVATION_DIM,
    TASKS,
    batch,
    batch_for,
    problem,
    random,
    settings,
)
from tests.small_training import small_batches

SMALL: dict[str, Any] = {"latent": 4, "encoder_hidden": (8,), "cvae_latent": 3, "cvae_hidden": (8,)}
PARTS = ("encoder", "aggregator", "cvae")
KINDS = ("cvae", "reward_noise", "change_noise")
STATE_ACTION = OBSERVATION_DIM + ACTION_DIM
FIRST = {"cvae": 1, "encoder": 11, "policy": 51}
"""The first step of every stage: 10, 40 and 50 of 100 steps."""


def made(negatives: str = "cvae", **config: Any) -> ContextAlgorithm:
    return algorithm_of("corro", SMALL | {"negatives": negatives} | config)


def learner(negatives: str = "cvae", **config: Any) -> CorroLearner:
    return learner_of(CorroLearner, "corro", SMALL | {"negatives": negatives} | config)


def stages_of(negatives: str = "cvae", *, steps: int = 100, **config: Any) -> StagePlan:
    own = CorroConfig.model_validate({"negatives": negatives, **config})
    return StagePlan(Corro().stages(settings(steps=steps), own), steps=steps)


def batch_of(stage: str, negatives: str = "cvae") -> Batch:
    (request,) = [found.request for found in stages_of(negatives) if found.name == stage]
    return batch_for(request, seed=1)


def contrast(*cosines: float, temperature: float = 0.1) -> float:
    """The loss of one query whose key has the first cosine, and its negatives the others."""
    angles = torch.tensor(cosines, dtype=torch.float64).acos()
    others = torch.stack([angles.cos(), angles.sin()], dim=-1)
    query = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    found = relabelled_contrastive_loss(query, others[:1], others[None, 1:], temperature=temperature)
    return found.item()


def test_contrast_by_hand() -> None:
    """log(1 + n e^((cos_negative - cos_key) / tau))."""
    assert contrast(1.0, *[1.0] * 16) == pytest.approx(2.833213, rel=1e-6)  # log 17
    assert contrast(1.0, *[-1.0] * 16) == pytest.approx(3.2978e-8, rel=1e-4)
    assert contrast(1.0, *[0.0] * 16) == pytest.approx(7.2614e-4, rel=1e-4)
    assert contrast(0.0, 1.0, temperature=0.5) == pytest.approx(2.126928, rel=1e-6)  # log(1 + e^2)


def test_errors_of_outcomes_by_hand() -> None:
    """Reward wrong by 1, changes by 3 and 4: 1 + (9 + 16) / 2."""
    outcomes = torch.tensor([[1.0, 3.0, 4.0]])
    assert outcome_error(torch.zeros(1, 3), outcomes).item() == pytest.approx(13.5)
    assert outcome_error(outcomes, outcomes).item() == 0.0


def test_gradients_are_right() -> None:
    given = (random(2, 3), random(2, 3, seed=1), random(2, 4, 3, seed=2))
    assert torch.autograd.gradcheck(
        lambda query, key, other: relabelled_contrastive_loss(query, key, other, temperature=0.5), given
    )
    assert torch.autograd.gradcheck(outcome_error, (random(4, 3), random(4, 3, seed=1)))


def test_stages_share_the_steps_and_variants_have_the_same_for_the_policy() -> None:
    found = {kind: {stage.name: stage.steps for stage in stages_of(kind)} for kind in KINDS}
    assert found["cvae"] == {"cvae": 10, "encoder": 40, "policy": 50}
    assert found["reward_noise"] == found["change_noise"] == {"encoder": 50, "policy": 50}
    short = stages_of(steps=3, cvae_share=0.01, encoder_share=0.01)
    assert [stage.steps for stage in short] == [1, 1, 1]


def test_steps_that_leave_none_for_the_policy_are_refused() -> None:
    with pytest.raises(TrainingError, match=r"\(cvae 1, encoder 1, policy 0\).*run.steps, 2"):
        stages_of(steps=2)
    with pytest.raises(ValueError, match=r"cvae_share, 0.6, and encoder_share, 0.4, must sum to less than 1"):
        CorroConfig(cvae_share=0.6)


@pytest.mark.parametrize("negatives", KINDS)
def test_every_stage_trains_its_own_network_alone(negatives: str) -> None:
    algorithm = made(negatives)
    trained = {"cvae": "cvae", "encoder": "encoder", "policy": "aggregator"}
    for stage in stages_of(negatives):
        before = {name: value.clone() for name, value in algorithm.actor_critic.state_dict().items()}
        step = FIRST[stage.name]
        assert moved(algorithm, batch_of(stage.name, negatives), step=step) == {trained[stage.name]}
        learning = {name for name, value in algorithm.learner.named_parameters() if value.requires_grad}
        assert {name.split(".")[0] for name in learning} == {trained[stage.name]}
        after = algorithm.actor_critic.state_dict()
        same = all(torch.equal(value, after[name]) for name, value in before.items())
        assert same is (stage.name != "policy")
    optimized = {
        name.split("/")[1]
        for name in algorithm.tensors()
        if name.startswith("optimizer/") and "/context." in name
    }
    assert optimized == {stage.name for stage in stages_of(negatives)}
    for stage in optimized:
        prefix = f"optimizer/{stage}/context."
        names = {name.removeprefix(prefix).split(".")[0] for name in algorithm.tensors() if prefix in name}
        assert names == {trained[stage]}, stage


def test_q_trains_the_aggregator_and_v_and_the_policy_do_not() -> None:
    algorithm = made()
    values, generator = batch_of("policy"), torch.Generator().manual_seed(0)
    found = losses_of(algorithm.learner, values, step=FIRST["policy"])
    assert found.context is not None
    rows = algorithm.actor_critic.rows(values["policy"], found.context, critic_gradient=found.critic_gradient)
    _, metrics = algorithm.actor_critic.losses(rows, generator)
    reached = gradients(algorithm.learner, metrics["loss/critic"], PARTS)
    assert reached["aggregator"] > 1e-7
    assert reached["encoder"] == reached["cvae"] == 0.0
    for name in ("loss/value", "loss/policy"):
        assert not any(gradients(algorithm.learner, metrics[name], PARTS).values()), name


def queries() -> Tensor:
    return torch.randn(5, STATE_ACTION + 1 + OBSERVATION_DIM, generator=torch.Generator().manual_seed(3))


@pytest.mark.parametrize("negatives", KINDS)
def test_negatives_share_state_and_action_and_differ_from_each_other(negatives: str) -> None:
    given = queries()
    found = learner(negatives).negatives(given, torch.Generator().manual_seed(0))
    assert found.shape == (5, 16, given.shape[1])
    assert torch.equal(found[..., :STATE_ACTION], given[:, None, :STATE_ACTION].expand(-1, 16, -1))
    outcomes = found[..., STATE_ACTION:]
    assert (outcomes[:, 0] - outcomes[:, 1]).abs().amax(dim=-1).min() > 1e-4
    kept = {"reward_noise": slice(1, None), "change_noise": slice(0, 1), "cvae": slice(0, 0)}[negatives]
    assert torch.equal(outcomes[..., kept], given[:, None, STATE_ACTION:].expand(-1, 16, -1)[..., kept])


@pytest.mark.parametrize(
    ("negatives", "unit", "expected"),
    [
        ("reward_noise", "std", [0.5, 0, 0, 0]),
        ("change_noise", "std", [0, 0.5, 0.5, 0.5]),
        ("reward_noise", "raw", [0.125, 0, 0, 0]),
        ("change_noise", "raw", [0, 1.0, 1.0, 1.0]),
    ],
)
def test_noise_has_the_given_standard_deviation_in_its_unit(
    negatives: str, unit: str, expected: list[float]
) -> None:
    """Rewards of the data have the standard deviation 4 here, changes of state 0.5."""
    config = CorroConfig(negatives=negatives, noise=0.5, noise_unit=unit, num_negatives=4000)  # type: ignore[arg-type]
    scaled = replace(problem(stages=stages_of(negatives)), reward_std=4.0)
    maker = CorroLearner(scaled, config, generator=torch.Generator().manual_seed(0))
    given = queries()
    drawn = maker.negatives(given, torch.Generator().manual_seed(0))[..., STATE_ACTION:]
    noise = drawn - given[:, None, STATE_ACTION:]
    torch.testing.assert_close(noise.mean(dim=(0, 1)), torch.zeros(4), atol=0.03, rtol=0.0)
    torch.testing.assert_close(noise.std(dim=(0, 1)), torch.tensor(expected), atol=0.0, rtol=0.03)


def test_noise_in_the_datas_unit_leaves_alone_what_hardly_varies_there() -> None:
    config = CorroConfig(negatives="change_noise")
    constant = replace(problem(stages=stages_of("change_noise")), change_std=torch.tensor([0.5, 0.5, 1e-6]))
    maker = CorroLearner(constant, config, generator=torch.Generator().manual_seed(0))
    given = queries()
    drawn = maker.negatives(given, torch.Generator().manual_seed(0))
    varies = (drawn != given.unsqueeze(1)).flatten(0, 1).any(dim=0)
    assert varies.tolist() == [False] * (STATE_ACTION + 1) + [True, True, False]


@pytest.mark.parametrize("negatives", KINDS)
def test_the_gradient_comes_through_queries_keys_and_negatives_and_never_through_the_vae(
    negatives: str,
) -> None:
    maker, values = learner(negatives), batch_of("encoder", negatives)
    found = losses_of(maker, values, step=FIRST["encoder"])
    rows = maker.encoder.read(values["pairs"]).inputs.squeeze(2)
    query, key = (part.flatten(0, 1) for part in (rows[:, :4], rows[:, 4:]))
    others = maker.negatives(query, torch.Generator().manual_seed(FIRST["encoder"])).detach()
    expected = relabelled_contrastive_loss(
        *(maker.represent(part) for part in (query, key, others)), temperature=0.1
    )
    torch.testing.assert_close(found.total, expected)
    names, parameters = zip(*maker.encoder.named_parameters(), strict=True)
    gradient = torch.autograd.grad(found.total, parameters, retain_graph=True)
    torch.testing.assert_close(gradient, torch.autograd.grad(expected, parameters))
    assert names
    parts = PARTS if negatives == "cvae" else PARTS[:2]
    reached = gradients(maker, found.total, parts)
    assert {part for part, largest in reached.items() if largest} == {"encoder"}


def test_the_loss_of_the_vae_is_the_error_of_outcomes_and_the_weighed_divergence() -> None:
    maker, values = learner(kl_weight=0.3), batch_of("cvae")
    found = losses_of(maker, values)
    rows = maker.encoder.read(values["transitions"]).inputs.flatten(0, 2)
    mean, log_variance = maker.cvae.posterior(rows)
    noise = torch.randn(mean.shape, generator=torch.Generator().manual_seed(1))
    predicted = maker.cvae.decode(mean + (log_variance / 2).exp() * noise, rows[:, :STATE_ACTION])
    divergence = 0.5 * (log_variance.exp() + mean.square() - 1 - log_variance).sum(dim=-1).mean()
    expected = outcome_error(predicted, rows[:, STATE_ACTION:]) + 0.3 * divergence
    torch.testing.assert_close(found.total, expected)
    assert gradients(maker, found.total, PARTS)["cvae"] > 1e-6


def test_representations_have_length_one() -> None:
    attention = learner().attention(batch()["context"])
    lengths = attention.representations[attention.mask].norm(dim=-1)
    torch.testing.assert_close(lengths, torch.ones(len(lengths)))
    assert not attention.representations.requires_grad


def test_equal_scores_make_the_aggregator_the_mean_and_others_a_softmax() -> None:
    maker, steps = learner(), batch()["context"]
    found = maker.attention(steps)
    assert torch.equal(found.weights > 0, found.mask)
    for lane, real in enumerate(found.mask):
        values = found.representations[lane][real]
        weights = torch.softmax(values @ maker.aggregator.direction, dim=0)
        torch.testing.assert_close(found.context[lane], weights @ values)
    torch.nn.init.zeros_(maker.aggregator.direction)
    even = maker.attention(steps)
    torch.testing.assert_close(even.context, mean_representation(even.representations, even.mask))


def test_all_stages_read_training_tasks_alone(tiny: Dataset) -> None:
    """The published code trains the VAE on test tasks too."""
    stages = stages_of(steps=10)
    batches = small_batches(tiny, RunSettings(steps=10, context_snapshots="last"), stages)
    known = {task.index for task in tiny.train_tasks}
    assert known != {task.index for task in tiny.tasks}
    names = []
    for n in range(10):
        found = batches.batch(n)
        assert set(found.task_indices.tolist()) <= known
        names.append(found.names())
    assert names == [["transitions"]] + 4 * [["pairs"]] + 5 * [["policy", "context"]]


def test_it_tells_tasks_by_rewards_whatever_states_they_visit() -> None:
    """Rewards are about -2, 0 and 2, and states differ by task; at test they are those of other tasks."""
    config = SMALL | {"negatives": "reward_noise", "encoder_hidden": (32,), "noise": 2.0, "pairs_per_task": 8}
    algorithm, signs = algorithm_of("corro", config), torch.arange(TASKS).view(TASKS, 1, 1) - 1.0
    request = stages_of(**config).stages[0].request

    def of(steps: Steps, shift: Tensor) -> Steps:
        by = shift.unsqueeze(-1)
        return replace(
            steps,
            observations=steps.observations + by,
            next_observations=steps.next_observations + by,
            rewards=2.0 * signs + 0.1 * steps.rewards,
        )

    for step in range(1, 46):
        algorithm.update(
            Batch(torch.arange(TASKS), {"pairs": of(batch_for(request, seed=step)["pairs"], signs)}), step
        )
    with torch.no_grad():
        own, elsewhere = (
            algorithm.learner.context(of(batch()["context"], shift)) for shift in (signs, signs.flip(0))
        )
    assert torch.equal(torch.cdist(elsewhere, own).argmin(dim=1), torch.arange(TASKS))
