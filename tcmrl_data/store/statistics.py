"""What a part records of its episodes: returns, and moments that merge over parts."""

from collections.abc import Sequence

import numpy as np

from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.store.part_record import Statistics

QUANTILES = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)


def statistics(trajectories: Sequence[Trajectory]) -> Statistics:
    """Return statistics and mergeable moments of a part."""
    returns = np.array([trajectory.undiscounted_return for trajectory in trajectories])
    success = [
        bool(np.any(trajectory.extras["success"]))
        for trajectory in trajectories
        if "success" in trajectory.extras
    ]
    moments = {}
    for name in ("observations", "actions"):
        rows = np.concatenate([getattr(trajectory, name) for trajectory in trajectories]).astype(np.float64)
        moments[name] = {
            "count": len(rows),
            "sum": rows.sum(axis=0).tolist(),
            "sum_of_squares": np.square(rows).sum(axis=0).tolist(),
        }
    return Statistics(
        episodes=len(trajectories),
        steps=sum(len(trajectory) for trajectory in trajectories),
        mean=float(returns.mean()),
        std=float(returns.std()),
        min=float(returns.min()),
        max=float(returns.max()),
        quantiles=tuple(float(quantile) for quantile in np.quantile(returns, QUANTILES)),
        success_rate=float(np.mean(success)) if success else None,
        moments=moments,
    )
