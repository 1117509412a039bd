"""The stacked update against autograd and against Stable-Baselines3."""

import math
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import Tensor

from tcmrl_data import load_recipe
from tcmrl_data.behavior.sac import SacSettings
from tcmrl_data.behavior.stacked_learner import (
    ReplayBatch,
    StackedNetwork,
    StackedSac,
    head_gradient,
    sample_policy,
)

CPU = torch.device("cpu")
OBSERVATION_DIM, ACTION_DIM, BATCH = 5, 3, 32
SETTINGS = SacSettings(
    hidden=(24, 16),
    steps=1,
    warmup=0,
    snapshots=(0, 1),
    learning_rate=1e-3,
    batch_size=BATCH,
    gamma=0.95,
    tau=0.02,
    buffer_size=1,
)


@pytest.fixture(autouse=True, scope="module")
def one_torch_thread() -> Iterator[None]:
    """One torch thread, as in a worker: reductions split by thread round differently."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def learner(num_agents: int, settings: SacSettings = SETTINGS, device: torch.device = CPU) -> StackedSac:
    made = StackedSac(num_agents, OBSERVATION_DIM, ACTION_DIM, settings=settings, device=device)
    for agent in range(num_agents):
        generator = torch.Generator().manual_seed(agent)
        made.initialize(agent, lambda shape, g=generator: 2 * torch.rand(shape, generator=g) - 1)
    return made


def draws(agents: list[int], number: int) -> tuple[ReplayBatch, Tensor]:
    """Batch and noise number `number` of the given agents; each agent has its own stream."""
    rows = []
    for agent in agents:
        random = np.random.default_rng([agent, number])
        rows.append(
            (
                random.normal(size=(BATCH, OBSERVATION_DIM)),
                random.uniform(-1, 1, (BATCH, ACTION_DIM)),
                random.normal(size=(BATCH, OBSERVATION_DIM)),
                random.normal(size=BATCH),
                random.random(BATCH) < 0.1,
                random.normal(size=(2 * BATCH, ACTION_DIM)),
            )
        )
    tensors = [torch.tensor(np.stack(column), dtype=torch.float32) for column in zip(*rows, strict=True)]
    return ReplayBatch(*tensors[:5]), tensors[5]


def test_a_networks_gradients_are_autograds() -> None:
    random = torch.Generator().manual_seed(0)
    network = StackedNetwork(3, (4, 7, 6, 2), CPU)
    network.parameters.copy_(torch.randn(network.parameters.shape, generator=random))
    inputs = torch.randn(3, 11, 4, generator=random)
    towards = torch.randn(3, 11, 2, generator=random)
    outputs, deltas = network.buffers(11), network.buffers(11)
    network.forward(inputs, outputs)
    deltas[-1].copy_(towards)
    network.propagate(outputs, deltas)
    network.fill_gradient(inputs, outputs, deltas)

    leaves = [
        (layer.weight.clone().requires_grad_(), layer.bias.clone().requires_grad_())
        for layer in network.layers
    ]
    seen = inputs.clone().requires_grad_()
    features = seen
    for index, (weight, bias) in enumerate(leaves):
        features = features @ weight.transpose(1, 2) + bias
        features = features if index == len(leaves) - 1 else features.relu()
    torch.testing.assert_close(features, outputs[-1])
    (features * towards).sum().backward()
    for layer, (weight, bias) in zip(network.layers, leaves, strict=True):
        torch.testing.assert_close(layer.weight_gradient, weight.grad)
        torch.testing.assert_close(layer.bias_gradient, bias.grad)
    assert seen.grad is not None
    torch.testing.assert_close(network.input_gradient(deltas, 1), seen.grad[..., 1:])


def test_the_policys_gradient_is_autograds_within_the_clamp_and_beyond() -> None:
    random = torch.Generator().manual_seed(0)
    head = torch.randn(2, 9, 6, generator=random, dtype=torch.float64)
    head[0, 0, 3], head[1, 1, 5] = 3.0, -25.0
    head.requires_grad_()
    noise = torch.randn(2, 9, 3, generator=random, dtype=torch.float64)
    entropy = torch.tensor([0.3, 1.7], dtype=torch.float64)[:, None, None]
    slope = torch.randn(2, 9, 3, generator=random, dtype=torch.float64)
    sample = sample_policy(head, noise)
    (entropy[..., 0] * sample.log_probs - (slope * sample.actions).sum(-1)).mean(dim=1).sum().backward()
    assert head.grad is not None
    with torch.no_grad():
        torch.testing.assert_close(head_gradient(sample, entropy, slope), head.grad)
    assert head.grad[0, 0, 3] == 0
    assert head.grad[1, 1, 5] == 0


def test_log_probs_are_those_of_the_squashed_gaussian() -> None:
    sample = sample_policy(torch.tensor([0.5, math.log(2.0)]), torch.tensor([-1.0]))
    action = math.tanh(0.5 - 2.0)
    density = -0.5 - math.log(2.0) - 0.5 * math.log(2 * math.pi) - math.log(1 - action**2 + 1e-6)
    assert sample.actions.tolist() == pytest.approx([action])
    assert sample.log_probs.item() == pytest.approx(density, rel=1e-5)


class Box(gymnasium.Env[np.ndarray, np.ndarray]):
    """Spaces for a model that is trained on given batches only."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (OBSERVATION_DIM,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)


def sb3_model(settings: SacSettings) -> SAC:
    model = SAC(
        "MlpPolicy",
        Box(),
        learning_rate=settings.learning_rate,
        buffer_size=1,
        gamma=settings.gamma,
        tau=settings.tau,
        ent_coef=settings.entropy,
        policy_kwargs={"net_arch": list(settings.hidden)},
        seed=3,
        device="cpu",
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def sb3_layers(model: SAC) -> dict[str, list[Tensor]]:
    """Weights and biases in the order of the stacked networks' layers; the actor's two heads as one."""

    def flat(network: torch.nn.Module) -> list[Tensor]:
        return [parameter.detach() for parameter in network.parameters()]

    actor = model.policy.actor
    heads = [torch.cat(pair) for pair in zip(flat(actor.mu), flat(actor.log_std), strict=True)]
    layers = {"actor": [*flat(actor.latent_pi), *heads]}
    for name in ("critic", "critic_target"):
        for index, network in enumerate(getattr(model, name).q_networks):
            layers[f"{name}.{index}"] = flat(network)
    return layers


def stacked_layers(made: StackedSac, agent: int) -> dict[str, list[Tensor]]:
    places = {"actor": (made.actors, agent)}
    for name, stack in (("critic", made.critics), ("critic_target", made.targets)):
        places |= {f"{name}.{k}": (stack, k * made.num_agents + agent) for k in range(2)}
    return {
        name: [tensor for layer in stack.layers for tensor in (layer.weight[index], layer.bias[index, 0])]
        for name, (stack, index) in places.items()
    }


@pytest.mark.parametrize("entropy", ["auto", 0.2])
def test_a_lone_agent_follows_stable_baselines3(entropy: float | str) -> None:
    """Same weights, batches and noise: after 100 updates every parameter agrees to 1e-5."""
    settings = SETTINGS.model_copy(update={"entropy": entropy})
    model, made = sb3_model(settings), learner(1, settings)
    for name, tensors in stacked_layers(made, 0).items():
        for ours, theirs in zip(tensors, sb3_layers(model)[name], strict=True):
            ours.copy_(theirs)
    start = made.actors.parameters.clone()
    for number in range(100):
        batch, _ = draws([0], number)
        torch.manual_seed(number)
        model.replay_buffer.sample = lambda *_, batch=batch, **__: ReplayBufferSamples(  # type: ignore[union-attr,method-assign]
            batch.observations[0],
            batch.actions[0],
            batch.next_observations[0],
            batch.terminated[0][:, None],
            batch.rewards[0][:, None],
        )
        model.train(1, BATCH)
        torch.manual_seed(number)
        zeros, ones = torch.zeros(BATCH, ACTION_DIM), torch.ones(BATCH, ACTION_DIM)
        noise = torch.cat([torch.normal(zeros, ones), torch.normal(zeros, ones)])
        made.update(batch, noise[None])
    theirs = sb3_layers(model)
    for name, tensors in stacked_layers(made, 0).items():
        for ours, other in zip(tensors, theirs[name], strict=True):
            torch.testing.assert_close(ours, other, rtol=0, atol=1e-5)
    if entropy == "auto":
        assert model.log_ent_coef is not None
        torch.testing.assert_close(made.log_entropy, model.log_ent_coef.detach(), rtol=0, atol=1e-5)
        assert made.log_entropy.item() < -0.05
    assert (made.actors.parameters - start).abs().max() > 0.02


def trained(agents: list[int], num_updates: int) -> StackedSac:
    """Agents with weights and draws of their own, in a group of just these."""
    made = learner(max(agents) + 1)
    group = learner(len(agents))
    for place, agent in enumerate(agents):
        for name, tensors in stacked_layers(group, place).items():
            for ours, theirs in zip(tensors, stacked_layers(made, agent)[name], strict=True):
                ours.copy_(theirs)
    for number in range(num_updates):
        group.update(*draws(agents, number))
    return group


@pytest.mark.check
def test_an_agent_does_not_depend_on_its_group() -> None:
    """400 updates alone, in a pair and among seven: what differs is rounding at most."""
    alone = stacked_layers(trained([2], 400), 0)
    for agents in ([2, 5], [6, 5, 4, 3, 2, 1, 0]):
        together = stacked_layers(trained(agents, 400), agents.index(2))
        for name, tensors in alone.items():
            for ours, theirs in zip(tensors, together[name], strict=True):
                torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-5)


def test_nan_of_one_agent_reaches_no_other() -> None:
    healthy, ill = learner(4), learner(4)
    for stack in (ill.actors, ill.critics):
        stack.layers[0].weight[1] = math.nan
    for number in range(20):
        healthy.update(*draws([0, 1, 2, 3], number))
        batch, noise = draws([0, 1, 2, 3], number)
        batch.rewards[1] = math.nan
        ill.update(batch, noise)
    for agent in (0, 2, 3):
        for name, tensors in stacked_layers(ill, agent).items():
            for ours, theirs in zip(tensors, stacked_layers(healthy, agent)[name], strict=True):
                assert torch.equal(ours, theirs)
    assert all(tensor.isnan().any() for tensor in stacked_layers(ill, 1)["actor"][:2])


def test_initial_weights_have_the_range_and_spread_of_torchs_linear() -> None:
    """Uniform within 1 / sqrt(inputs), as Stable-Baselines3 leaves its layers."""
    made = learner(50)
    for stack in (made.actors, made.critics):
        for layer in stack.layers:
            bound = 1 / math.sqrt(layer.weight.shape[2])
            linear = torch.nn.Linear(layer.weight.shape[2], layer.weight.shape[1])
            assert max(layer.weight.abs().max(), layer.bias.abs().max()) <= bound
            assert max(linear.weight.abs().max(), linear.bias.abs().max()) <= bound
            assert layer.weight.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.05)
    assert torch.equal(made.targets.parameters, made.critics.parameters)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_a_device_computes_the_same() -> None:
    on_cpu, on_device = learner(3), learner(3, device=torch.device("cuda"))
    for number in range(20):
        batch, noise = draws([0, 1, 2], number)
        on_cpu.update(batch, noise)
        on_device.update(ReplayBatch(*(tensor.cuda() for tensor in vars(batch).values())), noise.cuda())
    torch.testing.assert_close(on_device.actors.parameters.cpu(), on_cpu.actors.parameters, rtol=0, atol=1e-4)


def test_recipes_agree_on_both_sources() -> None:
    """`stacked` and `sac` train the same agents: every shared setting is equal."""
    for name in ("point-robot", "point-robot-wind", "half-cheetah-vel", "ml1/reach", "hopper-rand-params"):
        for profile in ("paper", "quick"):
            sac, stacked = (
                load_recipe(name, profile=profile, behavior=source).behavior.settings  # type: ignore[arg-type]
                for source in ("sac", "stacked")
            )
            assert {key: stacked[key] for key in sac} == sac
