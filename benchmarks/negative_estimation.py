"""What L_neg trains, on a dataset: `python benchmarks/negative_estimation.py data/point-robot --steps 600`.

Trains TCMRL and prints JSON. For every number of transitions in a context: the lowest cosine of a task's
negative context with its mean context, and how many times as long as the mean context the undivided negative
context is. For one batch: the mean of L_neg over draws of the noise, beside L_neg with the true rewards; and
the distance of the mean gradient from that with the true rewards, beside what chance leaves of so many draws,
as shares of its norm.
"""

import argparse
import json
import tempfile

import torch
from torch import Tensor
from torch.nn import functional

import tcmrl_algo
import tcmrl_data
from tcmrl_algo.algorithms.core.networks import call_frozen, mean_representation
from tcmrl_algo.algorithms.tcmrl import TcmrlLearner, negative_reward_loss, reverse_context
from tcmrl_data import Batch, Steps


def trained(dataset: tcmrl_data.Dataset, arguments: argparse.Namespace) -> TcmrlLearner:
    """TCMRL's context learner after some steps."""
    changes = [f"run.steps={arguments.steps}", *arguments.overrides]
    config = tcmrl_algo.resolve_for(dataset, profile="quick", algorithm="tcmrl", overrides=changes)
    with tempfile.TemporaryDirectory() as folder:
        run = tcmrl_algo.train_run(dataset, f"{folder}/run", config=config, profile="quick").run
        algorithm = tcmrl_algo.create_algorithm(run.record, dataset)
        algorithm.load_tensors(run.newest().tensors())
    assert isinstance(algorithm, tcmrl_algo.ContextAlgorithm)
    assert isinstance(algorithm.learner, TcmrlLearner)
    return algorithm.learner


def distance_from_mean(learner: TcmrlLearner, steps: Steps) -> dict[str, float]:
    """How the negative contexts of a batch lie to the mean contexts."""
    with torch.no_grad():
        found = learner.attention(steps)
        mean = mean_representation(found.representations, found.mask)
        parts = (found.representations, found.weights, found.mask)
        cosine = functional.cosine_similarity(reverse_context(*parts), mean).min()
        length = reverse_context(*parts, literal=True).norm(dim=-1) / mean.norm(dim=-1)
    return {"lowest_cosine": round(float(cosine), 6), "undivided_length": round(float(length.mean()), 1)}


def negative_loss(learner: TcmrlLearner, batch: Batch, noise: Tensor | float) -> tuple[float, Tensor]:
    """L_neg of a batch under some noise, and its gradient."""
    found, execution = learner.attention(batch["context"]), learner.encoder.read(batch["execution"])
    reverse = reverse_context(found.representations, found.weights, found.mask)
    misled = call_frozen(learner.estimator, execution.state_actions.flatten(1, 2), reverse)
    loss = negative_reward_loss(misled.view(execution.mask.shape), execution.rewards + noise, execution.mask)
    learner.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    gradients = [value.grad for value in learner.parameters() if value.grad is not None]
    return loss.item(), torch.cat([gradient.flatten() for gradient in gradients])


def main() -> None:
    """Prints the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset")
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--draws", type=int, default=1_000)
    parser.add_argument("--set", dest="overrides", action="append", default=[])
    arguments = parser.parse_args()
    dataset = tcmrl_data.open_dataset(arguments.dataset)
    learner = trained(dataset, arguments)
    settings = tcmrl_algo.resolve_for(
        dataset, profile="quick", algorithm="tcmrl", overrides=arguments.overrides
    ).settings
    request = tcmrl_algo.METHODS.get("tcmrl")().batch_request(settings, learner.config)
    sampler = tcmrl_data.open_sampler(dataset.select(split="train"), request, seed=0)
    batches = [sampler.batch(number) for number in range(20)]
    contexts = {int(batch["context"].mask[0].sum()): batch["context"] for batch in batches}
    true_loss, true = negative_loss(learner, batches[0], 0.0)
    generator, scale = torch.Generator().manual_seed(0), learner.config.negative_noise
    drawn = [
        negative_loss(
            learner,
            batches[0],
            scale * torch.randn(batches[0]["execution"].rewards.shape, generator=generator),
        )
        for _ in range(arguments.draws)
    ]
    gradients = torch.stack([gradient for _, gradient in drawn])
    chance = gradients.var(dim=0).sum().sqrt() / arguments.draws**0.5
    document = {
        "contexts": {size: distance_from_mean(learner, contexts[size]) for size in sorted(contexts)},
        "loss_of_true_rewards": round(true_loss, 4),
        "mean_loss": round(sum(loss for loss, _ in drawn) / len(drawn), 4),
        "variance_of_noise": scale**2,
        "gradient_distance": round(float((gradients.mean(dim=0) - true).norm() / true.norm()), 4),
        "gradient_chance": round(float(chance / true.norm()), 4),
    }
    print(json.dumps(document, indent=2))


if __name__ == "__main__":
    main()
