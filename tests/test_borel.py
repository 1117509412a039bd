"""BOReL: beliefs along joined episodes, the losses that train them, relabelled states, and the controller."""

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tcmrl_algo import create_algorithm, open_run, resolve_for, train_run
from tcmrl_algo.algorithms.borel import (
    Borel,
    BorelConfig,
    BorelLearner,
    StepValues,
    belief_divergence,
    belief_reconstruction,
    joined_episodes,
    recurrent,
)
from tcmrl_algo.algorithms.core.context import ContextAlgorithm
from tcmrl_algo.algorithms.core.problem import StagePlan, pad_trajectories
from tcmrl_data import (
    Batch,
    Dataset,
    LaneTransition,
    TrainingError,
    Trajectories,
    Trajectory,
    UniformController,
)
from tests.context_learners import gradients, losses_of
from tests.made_up import batch_for, problem, random, settings, steps, trajectory

SMALL: dict[str, Any] = {"belief": 2, "recurrent_hidden": 6, "decoder_hidden": (4,)}
MASK = torch.tensor([[True, True, True], [True, True, False]])
STATES, NOISE = np.ones((2, 3), dtype=np.float32), np.zeros((2, 2), dtype=np.float32)


def algorithm(**config: Any) -> ContextAlgorithm:
    """Ten steps, of which the first four train the belief."""
    chosen = BorelConfig.model_validate(SMALL | {"vae_share": 0.4} | config)
    shared = settings(steps=10)
    stages = StagePlan(Borel().stages(shared, chosen), steps=10)
    made = Borel().create(problem(stages=stages), shared, chosen)
    assert isinstance(made, ContextAlgorithm)
    return made


def learner(**config: Any) -> BorelLearner:
    made = algorithm(**config).learner
    assert isinstance(made, BorelLearner)
    return made


def batch(*, seed: int = 0) -> Batch:
    return batch_for(Borel().batch_request(settings(), BorelConfig()), seed=seed)


def test_gradients_of_both_losses_are_right() -> None:
    given = (random(2, 4, 3), random(2, 4, 3, seed=1))
    assert torch.autograd.gradcheck(lambda m, v: belief_divergence(m, v, MASK), given)
    pair = (random(2, 5, 3, 2), random(2, 3, 2, seed=1))
    for over_steps in (False, True):
        assert torch.autograd.gradcheck(
            lambda p, t, over=over_steps: belief_reconstruction(p, t, MASK, over_steps=over), pair
        )


def test_divergence_by_hand() -> None:
    """b_0 = N(1, 1) is 0.5 from N(0, 1), b_1 = N(0, 1) then 0.5 from b_0; b_2 = N(0, 2) 0.153426 from b_1."""
    means = torch.tensor([[[1.0], [0.0], [0.0], [9.0]]])
    log_variances = torch.tensor([[[0.0], [0.0], [2.0], [9.0]]])
    log_variances[0, 2] = log_variances[0, 2].log()
    mask = torch.tensor([[True, True, False]])
    assert belief_divergence(means, log_variances, mask).item() == pytest.approx(1.153426, abs=1e-6)
    equal = torch.zeros(1, 4, 2)
    assert belief_divergence(equal, equal, mask).item() == 0.0


def test_reconstruction_by_hand() -> None:
    """Two draws err by 1 and 3 in both real steps: 3 beliefs times 5, or times 10 with sums over steps."""
    predicted = torch.tensor([1.0, 3.0]).view(1, 2, 1, 1).expand(1, 2, 3, 1)
    targets, mask = torch.tensor([[[0.0], [0.0], [77.0]]]), torch.tensor([[True, True, False]])
    assert belief_reconstruction(predicted, targets, mask, over_steps=False).item() == 15.0
    assert belief_reconstruction(predicted, targets, mask, over_steps=True).item() == 30.0


def test_the_recurrence_starts_orthogonal_without_biases() -> None:
    network = recurrent(8, 4, torch.Generator().manual_seed(0))
    torch.testing.assert_close(network.weight_hh_l0.T @ network.weight_hh_l0, torch.eye(4))
    assert not network.bias_ih_l0.any() and not network.bias_hh_l0.any()
    again = recurrent(8, 4, torch.Generator().manual_seed(0))
    assert torch.equal(network.weight_ih_l0, again.weight_ih_l0)


def test_episodes_of_a_group_follow_one_another_without_their_padding() -> None:
    given = steps(1, 4, 3, seed=0)
    mask = torch.tensor(
        [[[True, True, False], [True, False, False], [True, True, True], [True, True, False]]]
    )
    found = joined_episodes(replace(given, mask=mask), 2)
    assert found.mask[0].sum(dim=-1).tolist() == [3, 5] and found.observations.shape == (1, 2, 6, 3)
    expected = torch.cat([given.observations[0, 2], given.observations[0, 3, :2]])
    assert torch.equal(found.observations[0, 1, :5], expected)
    assert torch.equal(found.rewards[0, 0, :3], given.rewards[0, [0, 0, 1], [0, 1, 0]])
    ended = torch.zeros(1, 4, 3)
    ended[0, 0, 1] = ended[0, 3, 1] = 1.0  # within the first lane, and at the end of the second
    joined = joined_episodes(replace(given, mask=mask, terminated=ended), 2).terminated
    assert joined[0].nonzero().tolist() == [[0, 1], [1, 4]]
    assert found.returns_to_go is None


def test_there_is_one_belief_more_than_steps_and_it_begins_with_the_prior() -> None:
    made, lanes = learner(), joined_episodes(batch()["episodes"], 2)
    values, beliefs = made.beliefs(lanes)
    assert beliefs.means.shape == (3, 13, 2) and values.actions.shape[1] == 12
    start = made.encoder.beliefs(made.encoder.start(1)).context
    torch.testing.assert_close(beliefs.context[:, 0], start.expand(3, -1))


def test_filtering_step_by_step_equals_one_pass_and_goes_on_behind_an_episode() -> None:
    made, first, second = learner(), trajectory(4, 0), trajectory(6, 1)
    lanes = joined_episodes(pad_trajectories([[first, second]], problem()), 2)
    expected = made.beliefs(lanes)[1].context[0]
    hidden, found = made.encoder.start(1), []
    for episode in (first, second):
        for t in range(len(episode)):
            found.append(made.encoder.beliefs(hidden).context[0])
            hidden = made.encoder.following(hidden, values_at(made, episode, t), torch.ones(1) > 0)
    torch.testing.assert_close(torch.stack(found), expected[:10], rtol=1e-4, atol=1e-6)


def values_at(made: BorelLearner, episode: Trajectory, t: int) -> StepValues:
    step = pad_trajectories([[episode]], problem())
    names = ("observations", "actions", "rewards", "next_observations")
    return made.read(*(getattr(step, name)[:, 0, t] for name in names))


def test_a_controller_follows_its_episode_from_the_belief_after_the_one_before() -> None:
    made, first, second = algorithm(), trajectory(4, 0), trajectory(6, 1)
    begun, after = made.adapt([[]]), made.adapt([[first]])
    for t in range(4):
        begun.observe(transition(first, t))
    for t in range(6):
        np.testing.assert_allclose(begun.act(STATES[:1], NOISE), after.act(STATES[:1], NOISE), rtol=1e-4)
        for controller in (begun, after):
            controller.observe(transition(second, t))
    prior = made.adapt([[]]).act(STATES[:1], NOISE)
    assert not np.allclose(prior, after.act(STATES[:1], NOISE))


def transition(episode: Trajectory, t: int) -> LaneTransition:
    """Step t of an episode in a single lane."""
    row = slice(t, t + 1)
    ended = np.zeros(1, dtype=bool)
    return LaneTransition(
        episode.observations[row],
        episode.actions[row],
        episode.rewards[row],
        episode.observations[t + 1 : t + 2],
        ended,
        ended,
        np.ones(1, dtype=bool),
    )


def test_only_the_first_episodes_are_filtered_as_many_as_in_training() -> None:
    episodes = [trajectory(4, 0), trajectory(6, 1), trajectory(5, 2)]
    made = algorithm()
    assert torch.equal(made.context([episodes]), made.context([episodes[:1]]))
    longer = algorithm(episodes_per_belief=3)
    torch.testing.assert_close(longer.context([episodes]), longer.context([episodes[:2]]))
    assert not torch.allclose(longer.context([episodes]), longer.context([episodes[:1]]))


def test_the_first_stage_trains_the_belief_alone_and_the_second_the_actor_critic_alone() -> None:
    made, first, last = algorithm(decode_state=True), 1, 5
    for step, frozen in ((first, "policy"), (last, "belief")):
        before = {name: value.detach().clone() for name, value in made.learner.named_parameters()}
        policy = [value.detach().clone() for value in made.actor_critic.policy.parameters()]
        made.update(batch(seed=step), step)
        changed = {name for name, value in made.learner.named_parameters() if (value != before[name]).any()}
        acted = any(
            (old != new).any() for old, new in zip(policy, made.actor_critic.policy.parameters(), strict=True)
        )
        assert acted is (frozen == "belief")
        if frozen == "belief":
            assert not changed
        else:
            assert {name.split(".")[0] for name in changed} == {"encoder", "decoder"}


def test_the_loss_is_the_weighed_sum_and_reaches_every_network() -> None:
    made = learner(decode_state=True, kl_weight=0.5)
    found = losses_of(made, batch())
    expected = found.metrics["loss/reconstruction"] + 0.5 * found.metrics["loss/divergence"]
    torch.testing.assert_close(found.total, expected)
    assert found.context is None
    parts = (
        "encoder",
        "decoder.reward",
        "decoder.change",
        "decoder.states",
        "decoder.next_states",
        "decoder.actions",
    )
    assert min(gradients(made, found.total, parts).values()) > 0


def test_states_are_relabelled_by_the_belief_before_and_the_next_ones_by_the_belief_after_a_step() -> None:
    made = learner()
    found = losses_of(made, batch(), step=5)
    assert found.context is not None and found.next_context is not None and found.steps is not None
    assert found.context.shape == (3, 1, 12, 4) and not found.context.requires_grad
    torch.testing.assert_close(found.context[:, :, 1:], found.next_context[:, :, :-1])
    assert torch.equal(found.steps.mask, joined_episodes(batch()["episodes"], 2).mask)


def test_beliefs_are_those_of_every_lane_alone_whatever_the_order_of_tasks() -> None:
    """Two lanes of two episodes for each of three tasks."""
    made, given = learner(), steps(3, 4, 6, seed=7, lengths=(6, 4, 5))
    everything = Batch(torch.tensor([0, 1, 2]), {"episodes": given})
    found = losses_of(made, everything, step=5).context
    assert found is not None and found.shape == (3, 2, 12, 4)
    for task, lane in itertools.product(range(3), range(2)):
        alone = given.map(lambda values, t=task, n=lane: values[t : t + 1, 2 * n : 2 * n + 2])
        expected = made.beliefs(joined_episodes(alone, 2))[1].context[0, :-1]
        torch.testing.assert_close(found[task, lane], expected)
    order = torch.tensor([2, 0, 1])
    turned = Batch(order, {"episodes": given.map(lambda values: values[order])})
    turned_context = losses_of(made, turned, step=5).context
    assert turned_context is not None
    torch.testing.assert_close(turned_context, found[order])


def test_a_changes_decoder_does_not_read_what_it_predicts() -> None:
    made, lanes = learner(decode_state=True), joined_episodes(batch()["episodes"], 2)
    values, _ = made.beliefs(lanes)
    drawn = torch.zeros(3, 1, 2)
    plain = made.decoder(drawn, values)
    other = made.decoder(drawn, values._replace(next_states=values.next_states + 1.0))
    assert torch.equal(plain[..., 1:], other[..., 1:]) and not torch.equal(plain[..., :1], other[..., :1])
    assert made.decoder.targets(values).shape == (3, 12, 4)


@pytest.mark.parametrize(("contexts", "expected"), [((1,), 2), ((4, 8, 12), 12), ((3, 7), 8)])
def test_batches_hold_whole_lanes(contexts: tuple[int, ...], expected: int) -> None:
    shared = settings()
    shared = shared.model_copy(
        update={"batch": shared.batch.model_copy(update={"context_trajectories": contexts})}
    )
    assert Borel().batch_request(shared, BorelConfig()).kinds == {"episodes": Trajectories(expected)}


def test_dense_rewards_are_refused() -> None:
    shared, config = settings(steps=10, rewards="dense"), BorelConfig.model_validate(SMALL)
    stages = StagePlan(Borel().stages(shared, config), steps=10)
    with pytest.raises(TrainingError, match="dense"):
        Borel().create(problem(stages=stages), shared, config)


def test_it_collects_by_the_policy_under_the_belief_or_by_uniform_actions() -> None:
    made, lanes = algorithm(), [[trajectory(6, 0)], []]
    found = made.explore(lanes).act(STATES, NOISE)
    np.testing.assert_array_equal(found, made.adapt(lanes).act(STATES, NOISE))
    assert isinstance(algorithm(explore="uniform").explore(lanes), UniformController)


@pytest.mark.check
def test_beliefs_narrow_along_stored_episodes_and_predict_rewards_of_their_own_task(
    tiny: Dataset, tmp_path: Path
) -> None:
    steps = 400
    overrides = (f"run.steps={steps}", f"run.checkpoint_every={steps}", "batch.context_trajectories=[4]")
    chosen = (*overrides, "borel.vae_share=0.95", "optimizer.learning_rate=3e-3", "actor_critic.hidden=[8]")
    config = resolve_for(tiny, profile="quick", algorithm="borel", overrides=chosen)
    train_run(tiny, tmp_path / "run", config=config, profile="quick")
    run = open_run(tmp_path / "run")
    made = create_algorithm(run.record, tiny)
    made.load_tensors(run.newest().tensors())
    assert isinstance(made, ContextAlgorithm) and isinstance(made.learner, BorelLearner)
    stored = [tiny.select(tasks=[task.index]).trajectories(task.index)[:2] for task in tiny.train_tasks]
    with torch.no_grad():
        lanes = joined_episodes(made.pack(stored), 2)
        values, beliefs = made.learner.beliefs(lanes)
        variances = beliefs.log_variances.exp().mean(dim=(0, 2))
        assert variances[-1] < 0.7 * variances[0]
        last = beliefs.means[:, -1:]
        errors = [
            (made.learner.decoder(means, values)[:, 0] - values.rewards).square().mean()
            for means in (last, last.roll(1, dims=0))
        ]
        assert errors[0] < 0.5 * errors[1]
