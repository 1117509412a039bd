"""Training settings that make a run take seconds."""

import torch

from tcmrl_algo import TrainingConfig, resolve
from tcmrl_algo.algorithms.core.problem import StagePlan
from tcmrl_algo.algorithms.core.settings import RunSettings
from tcmrl_algo.training.batches import StagedBatches, open_batches
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


def small_batches(dataset: Dataset, run: RunSettings, stages: StagePlan) -> StagedBatches:
    """The batches of a run on the CPU, from memory."""
    device = torch.device("cpu")
    return open_batches(dataset, run, stages, seed=0, device=device, memory_limit=None, say=lambda _: None)
