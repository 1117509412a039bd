"""What a part records of its episodes: returns, and moments that merge over parts."""

from collections.abc import Sequence

import numpy as np

from tcmrl_data.envs.trajectory import Trajectory
from tcmrl_data.store.manifest import Statistics

QUANTILES = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)


def statistics(trajectories: Sequence[Trajectory]) -> Statistics:
    """Return statistics and mergeable moments of a part."""
    returns = np.array([each.undiscounted_return for each in trajectories])
    success = [bool(np.any(each.extras["success"])) for each in trajectories if "success" in each.extras]
    moments = {}
    for name in ("observations", "actions"):
        rows = np.concatenate([getattr(each, name) for each in trajectories]).astype(np.float64)
        moments[name] = {
            "count": len(rows),
            "sum": rows.sum(axis=0).tolist(),
            "sum_of_squares": np.square(rows).sum(axis=0).tolist(),
        }
    return Statistics(
        episodes=len(trajectories),
        steps=sum(len(each) for each in trajectories),
        mean=float(returns.mean()),
        std=float(returns.std()),
        min=float(returns.min()),
        max=float(returns.max()),
        quantiles=tuple(float(each) for each in np.quantile(returns, QUANTILES)),
        success_rate=float(np.mean(success)) if success else None,
        moments=moments,
    )
