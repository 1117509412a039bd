"""The environment loop of all rollouts, of behavior policies in builds and learned policies in evaluation."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from tcmrl_data.envs.base import Environment, Lanes
from tcmrl_data.envs.controller import Controller, Transition
from tcmrl_data.envs.recorder import Recorder
from tcmrl_data.envs.trajectory import Trajectory


def roll_out(
    environment: Environment,
    lanes: Lanes,
    controller: Controller,
    *,
    reset_seeds: Sequence[int],
    noise: Sequence[np.random.Generator],
) -> list[Trajectory]:
    """Rolls out one episode per lane, with one batched call of the controller per step.

    The controller receives all lanes at every step, including finished ones, because the results of a
    batched network call depend on the batch size in their last bits. Actions are clipped to [-1, 1] before
    they are executed and stored. The returned observations are the environment's stored view.

    Args:
        environment: defines the horizon, the action size and the stored view.
        lanes: L lanes; may be used for several rollouts.
        controller: acts for all L lanes and observes every step.
        reset_seeds: L seeds, one per episode.
        noise: L generators, one per episode; the noise of an episode is drawn at once.

    Returns:
        L trajectories in lane order; float32 observations, actions and rewards.
    """
    horizon, action_dim = environment.settings.horizon, environment.action_dim
    draws = np.stack([controller.draw_noise(generator, horizon, action_dim) for generator in noise])
    recorder = Recorder()
    active = np.ones(lanes.num_lanes, dtype=bool)
    full = lanes.reset(reset_seeds)
    stored = environment.stored_view(full)
    for t in range(horizon):
        seen = full if controller.view == "full" else stored
        actions = np.clip(controller.act(seen, draws[:, t]), -1.0, 1.0).astype(np.float32)
        step = lanes.step(actions, active)
        next_stored = environment.stored_view(step.observations)
        transition = Transition(
            stored, actions, step.rewards, next_stored, step.terminated, step.truncated, active
        )
        extras = {name: step.extras[name].astype(kind) for name, kind in environment.extras.items()}
        recorder.record(transition, extras)
        if controller.view == "full":
            transition = dataclasses.replace(
                transition, observations=full, next_observations=step.observations
            )
        controller.observe(transition)
        full, stored = step.observations, next_stored
        active = active & ~(step.terminated | step.truncated)
        if not active.any():
            break
    return recorder.trajectories()
