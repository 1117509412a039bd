"""What all methods share of the `[training]` table."""

from pydantic import BaseModel, ConfigDict

from tcmrl_algo.settings.actor_critic import ActorCriticSettings
from tcmrl_algo.settings.batch import BatchSettings
from tcmrl_algo.settings.optimizer import OptimizerSettings
from tcmrl_algo.settings.run import RunSettings


class TrainingSettings(BaseModel):
    """What all methods share."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    run: RunSettings = RunSettings()
    batch: BatchSettings = BatchSettings()
    optimizer: OptimizerSettings = OptimizerSettings()
    actor_critic: ActorCriticSettings = ActorCriticSettings()
