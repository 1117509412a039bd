"""Methods that adapt through a context: packing, the interface of learners, FOCAL and the control."""

from dataclasses import replace

import numpy as np
import torch

from tcmrl_algo.algorithms import controls, focal, tcmrl
from tcmrl_algo.algorithms.core.context import ContextAlgorithm, ContextLearner, attention_of
from tcmrl_algo.algorithms.core.losses import distance_metric_loss
from tcmrl_algo.algorithms.core.method import MethodConfig
from tcmrl_algo.algorithms.core.problem import pad_trajectories
from tcmrl_data import BatchRequest, Transitions
from tests.made_up import TASKS, batch, problem, settings, trajectory


def test_every_step_has_its_own_generator() -> None:
    places = [(1, 0), (2, 0), (1, 1), (1, 0)]
    draws = [torch.rand(3, generator=problem().generator(*place)) for place in places]
    assert torch.equal(draws[0], draws[3])
    assert not torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    assert not torch.equal(torch.rand(3, generator=problem(seed=1).generator(1)), draws[0])


def test_packed_trajectories_keep_their_steps_and_mask_the_rest() -> None:
    lanes = [[trajectory(6, 0)], [trajectory(4, 1), trajectory(2, 2)]]
    packed = pad_trajectories(lanes, problem())
    assert packed.mask.sum(dim=-1).tolist() == [[6, 0], [4, 2]]
    expected = torch.from_numpy(lanes[1][1].observations[1:])
    torch.testing.assert_close(packed.next_observations[1, 1, :2], expected)
    assert packed.returns_to_go is None


def test_packed_trajectories_carry_what_lies_between_a_step_and_their_end() -> None:
    short = replace(trajectory(2, 0), rewards=np.array([1.0, 4.0], dtype=np.float32))
    packed = pad_trajectories([[trajectory(3, 1), short]], problem(), gamma=0.5)
    found = (packed.returns_to_go, packed.discounts_to_end, packed.times, packed.final_observations)
    returns, discounts, times, final = (value[0, 1] for value in found if value is not None)
    assert returns.tolist() == [3.0, 4.0, 0.0]
    assert discounts.tolist() == [0.25, 0.5, 0.0]
    assert times.tolist() == [0, 1, 0]
    np.testing.assert_array_equal(final, [short.observations[2], short.observations[2], np.zeros(3)])
    ended = replace(short, terminated=np.array([False, True]))
    packed = pad_trajectories([[ended], [short]], problem(), gamma=0.5)
    assert packed.discounts_to_end is not None
    assert packed.discounts_to_end.tolist() == [[[0.0, 0.0]], [[0.25, 0.5]]]


def test_no_context_needs_no_trajectories() -> None:
    request = controls.NoContext().batch_request(settings(), MethodConfig())
    assert request == BatchRequest(TASKS, {"policy": Transitions(5)})


def focal_learner() -> ContextLearner:
    made = focal.Focal().create(problem(), settings(), focal.FocalConfig(latent=4, encoder_hidden=(8,)))
    assert isinstance(made, ContextAlgorithm)
    return made.learner


def test_focal_pulls_the_means_of_a_tasks_trajectories_together() -> None:
    made, values = focal_learner(), batch()
    assert isinstance(made, focal.FocalLearner)
    found = made.losses(values, 1, torch.Generator())
    groups = (made.encoder.read(values["context"]), made.encoder.read(values["execution"]))
    context, execution = made.encoder(*groups)
    single = torch.stack(
        [
            torch.stack([row[mask].mean(dim=0) for row, mask in zip(lane, real, strict=True)])
            for lane, real in zip(
                torch.cat([context, execution], dim=1),
                torch.cat([group.mask for group in groups], dim=1),
                strict=True,
            )
        ]
    )
    torch.testing.assert_close(found.total, distance_metric_loss(single, epsilon=0.1))
    for lane, values_of in enumerate(context):
        torch.testing.assert_close(found.context[lane], values_of[groups[0].mask[lane]].mean(dim=0))


def test_attention_is_known_of_methods_that_have_it() -> None:
    lanes = [[trajectory(6, 0)], [trajectory(4, 1), trajectory(2, 2)]]
    config = tcmrl.TcmrlConfig(latent=4)
    found = attention_of(tcmrl.Tcmrl().create(problem(), settings(), config), lanes)
    assert found is not None
    torch.testing.assert_close(found.weights.sum(dim=-1), torch.ones(2))
    assert attention_of(focal.Focal().create(problem(), settings(), focal.FocalConfig()), lanes) is None
