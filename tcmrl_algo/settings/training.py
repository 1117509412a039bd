"""What all methods share of the `[training]` table."""

from pydantic import BaseModel, ConfigDict

from tcmrl_algo.settings.actor_critic import ActorCriticSettings
from tcmrl_algo.settings.optimizer import OptimizerSettings
from tcmrl_algo.settings.run import RunSettings
from tcmrl_data import BatchSizes


class TrainingSettings(BaseModel):
    """What all methods share. `batch` is the sampler's own table; K is its `window_length`."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    run: RunSettings = RunSettings()
    batch: BatchSizes = BatchSizes(execution_trajectories=1)
    optimizer: OptimizerSettings = OptimizerSettings()
    actor_critic: ActorCriticSettings = ActorCriticSettings()
