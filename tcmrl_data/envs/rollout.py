"""The only environment loop: builds roll out behavior policies with it, evaluation rolls out learned ones."""

from collections.abc import Sequence

import numpy as np

from tcmrl_data.envs.base import Controller, Environment, Lanes
from tcmrl_data.envs.trajectory import Trajectory


def roll_out(
    environment: Environment,
    lanes: Lanes,
    controller: Controller,
    *,
    reset_seeds: Sequence[int],
    noise: Sequence[np.random.Generator],
) -> list[Trajectory]:
    """One episode per lane, with one batched call of the controller per step.

    The controller sees every lane at every step, finished lanes included, because rows of a batched
    network call differ in the last bit with the batch's size. Actions are clipped to [-1, 1] before
    they are executed and stored. Stored observations are the environment's stored view.

    Args:
        environment: names the horizon, the action size and what is hidden from storage.
        lanes: L episodes; may be reused from batch to batch.
        controller: acts for all L lanes.
        reset_seeds: L seeds, one per episode.
        noise: L generators, one per episode; each yields its episode's noise at once.

    Returns:
        L trajectories in lane order; float32 observations, actions and rewards.
    """
    horizon, action_dim = environment.settings.horizon, environment.action_dim
    draws = np.stack([controller.draw_noise(each, horizon, action_dim) for each in noise])
    num_lanes = lanes.num_lanes
    observations = np.zeros((num_lanes, horizon + 1, environment.observation_dim), np.float32)
    actions = np.zeros((num_lanes, horizon, action_dim), np.float32)
    rewards = np.zeros((num_lanes, horizon), np.float32)
    terminated, truncated = np.zeros((2, num_lanes, horizon), dtype=bool)
    extras = {name: np.zeros((num_lanes, horizon), dtype) for name, dtype in environment.extras.items()}
    lengths = np.zeros(num_lanes, dtype=np.int64)
    active = np.ones(num_lanes, dtype=bool)

    full = lanes.reset(reset_seeds)
    stored = environment.stored_view(full)
    observations[:, 0] = stored
    for t in range(horizon):
        seen = full if controller.view == "full" else stored
        chosen = np.clip(controller.act(seen, draws[:, t]), -1.0, 1.0).astype(np.float32)
        step = lanes.step(chosen, active)
        controller.observe(step.rewards, active)
        full, stored = step.observations, environment.stored_view(step.observations)
        actions[:, t], rewards[:, t], observations[:, t + 1] = chosen, step.rewards, stored
        terminated[:, t], truncated[:, t] = step.terminated, step.truncated
        for name, array in extras.items():
            array[:, t] = step.extras[name]
        lengths += active
        active = active & ~(step.terminated | step.truncated)
        if not active.any():
            break
    return [
        Trajectory(
            observations[lane, : length + 1],
            actions[lane, :length],
            rewards[lane, :length],
            terminated[lane, :length],
            truncated[lane, :length],
            {name: array[lane, :length] for name, array in extras.items()},
        )
        for lane, length in enumerate(lengths)
    ]
