"""Training settings that make a run take seconds."""

from tcmrl_algo import TrainingConfig, resolve
from tcmrl_data import Dataset

SMALL = (
    "run.log_every=10",
    "run.checkpoint_every=25",
    "batch.transitions=8",
    "actor_critic.hidden=[8]",
    "tcmrl.latent=4",
    "tcmrl.encoder_hidden=[8]",
    "tcmrl.tce_hidden=[8]",
    "tcmrl.estimator_hidden=[8]",
)


def config_of(dataset: Dataset, *overrides: str, algorithm: str | None = None) -> TrainingConfig:
    table = dataset.manifest.training["quick"]
    return resolve(table, place="quick", algorithm=algorithm, overrides=(*SMALL, *overrides))
