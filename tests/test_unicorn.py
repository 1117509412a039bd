"""UNICORN: what its two variants train, noise, decoders, and the distances between them."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from tcmrl_algo.algorithms.core.losses import distance_metric_loss
from tcmrl_algo.algorithms.core.networks import mean_representation
from tcmrl_algo.algorithms.unicorn import GaussianPerceptron, UnicornLearner
from tcmrl_data import Batch
from tests.context_learners import algorithm_of, gradients, learner_of, losses_of, moved
from tests.made_up import TASKS, batch, with_steps

SMALL: dict[str, Any] = {
    "latent": 4,
    "encoder_hidden": (8,),
    "decoder_hidden": (8,),
    "classifier_hidden": (8,),
}
SS = ("encoder", "noise_log_variance", "reward_decoder", "change_decoder")
SUP = ("encoder", "noise_log_variance", "classifier")


def learner(**config: Any) -> UnicornLearner:
    return learner_of(UnicornLearner, "unicorn", SMALL | config)


@pytest.mark.parametrize(("mode", "parts"), [("ss", SS), ("sup", SUP)])
def test_a_variant_holds_and_trains_its_own_parts_all_of_them(mode: str, parts: tuple[str, ...]) -> None:
    made = algorithm_of("unicorn", SMALL | {"mode": mode})
    found = gradients(made.learner, losses_of(made.learner).total, parts)
    assert min(found.values()) > 1e-7
    assert moved(made) == set(parts)


def test_the_loss_is_reconstruction_and_the_weighted_distances_of_single_trajectories() -> None:
    made = learner(beta=0.7, bound_weight=0.01)
    found = losses_of(made)
    terms = {name.removeprefix("loss/"): value for name, value in found.metrics.items()}
    expected = terms["reward"] + terms["change"] + 0.7 * terms["distance"] + 0.01 * terms["bounds"]
    torch.testing.assert_close(found.total, expected)
    assert "loss/distance" not in losses_of(learner(beta=0.0)).metrics
    quiet = learner()
    quiet.noise_std = lambda: torch.zeros(4)  # type: ignore[method-assign]
    groups = [quiet.encoder.read(batch()[name]) for name in ("context", "execution")]
    representations = torch.cat(quiet.encoder(*groups), dim=1)
    mask = torch.cat([group.mask for group in groups], dim=1)
    single = mean_representation(representations.flatten(0, 1), mask.flatten(0, 1)).unflatten(0, (TASKS, 3))
    torch.testing.assert_close(losses_of(quiet).metrics["loss/distance"], distance_metric_loss(single))


def test_without_beta_no_distance_trains_the_encoder() -> None:
    with_distance, without = learner(beta=1.0), learner(beta=0.0)
    parts = ("reward_decoder", "change_decoder", "encoder", "noise_log_variance")
    distance = losses_of(with_distance).metrics["loss/distance"]
    assert gradients(with_distance, distance, parts)["encoder"] > 1e-6
    both, alone = losses_of(with_distance), losses_of(without)
    torch.testing.assert_close(both.total - both.metrics["loss/distance"], alone.total)


def test_decoders_never_see_what_they_predict() -> None:
    """Another reward or next state of an execution step changes no prediction, only the error."""
    made, values = learner(reconstruction="execution"), batch()
    seen: list[Tensor] = []
    made.reward_decoder.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    made.change_decoder.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    changed = replace(
        values["execution"],
        rewards=values["execution"].rewards + 1.0,
        next_observations=values["execution"].next_observations + 1.0,
    )
    first = losses_of(made, values)
    second = losses_of(made, with_steps(values, execution=changed))
    assert all(torch.equal(seen[0], other) for other in seen[1:])
    assert first.metrics["loss/reward"] != second.metrics["loss/reward"]
    assert first.metrics["loss/change"] != second.metrics["loss/change"]


@pytest.mark.parametrize("reconstruction", ["context", "execution"])
def test_the_steps_to_decode_are_a_choice(reconstruction: str) -> None:
    made, values = learner(reconstruction=reconstruction, beta=0.0), batch()
    changed = replace(values["execution"], rewards=values["execution"].rewards + 1.0)
    first, second = losses_of(made, values), losses_of(made, with_steps(values, execution=changed))
    assert torch.equal(first.total, second.total) is (reconstruction == "context")


def test_log_variances_lie_between_learnt_bounds_that_cost_their_distance() -> None:
    network = GaussianPerceptron((3, 8, 2), generator=torch.Generator().manual_seed(0))
    extremes = torch.tensor([[1e4], [-1e4]]) * torch.ones(2, 3)
    _, found = network(torch.cat([extremes, torch.randn(50, 3)]))
    assert found.min() >= -10.0 - 1e-4 and found.max() <= 0.5 + 1e-3
    assert 0.01 * network.width().item() == pytest.approx(2 * 0.105)
    _, inner = network(torch.zeros(1, 3))
    inner.sum().backward()
    assert network.highest.grad is not None and network.lowest.grad is not None


def test_contexts_are_the_mean_over_the_noise_that_training_adds() -> None:
    made, steps = learner(), batch()["context"]
    with torch.no_grad():
        (free,) = made.encoder.unbounded(made.encoder.read(steps))
        noise = torch.randn(20_000, *free.shape, generator=torch.Generator().manual_seed(0))
        drawn = torch.tanh(free + made.noise_std() * noise).mean(dim=0)
        expected = mean_representation(drawn.flatten(1, 2), steps.mask.flatten(1, 2))
        torch.testing.assert_close(made.context(steps), expected, atol=0.02, rtol=0.0)
    assert torch.equal(made.context(steps), made.context(steps))


def test_the_variance_of_the_noise_has_bounds() -> None:
    made = learner()
    torch.testing.assert_close(made.noise_std(), torch.ones(4))
    for value, expected in ((-9.0, 0.1), (9.0, 10.0)):
        with torch.no_grad():
            made.noise_log_variance.fill_(value)
        torch.testing.assert_close(made.noise_std().square(), torch.full((4,), expected))


def test_the_classifier_tells_training_tasks_by_their_dense_index() -> None:
    made = learner(mode="sup")
    order = torch.tensor([1, 2, 0])
    plain = batch()
    turned = Batch(plain.task_indices[order], plain.steps)
    seen: list[Tensor] = []
    made.classifier.register_forward_hook(lambda module, inputs, output: seen.append(output))
    found = losses_of(made, turned).metrics["loss/classification"]
    expected = -torch.log_softmax(seen[0], dim=-1)[torch.arange(TASKS), order].mean()
    torch.testing.assert_close(found, expected)
    for parameter in made.classifier.parameters():
        torch.nn.init.zeros_(parameter)
    assert losses_of(made).total.item() == pytest.approx(1.098612)  # log 3
