"""FOCAL++: its attention and gate, the momentum of its keys, and what its variants hold."""

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from tcmrl_algo.algorithms.core.losses import info_nce
from tcmrl_algo.algorithms.core.method import METHODS
from tcmrl_algo.algorithms.focal_plus import (
    FocalPlusConfig,
    FocalPlusLearner,
    StepAttention,
    TransformerBlock,
    TransitionGate,
    TransitionTransformer,
    dropout,
)
from tests.context_learners import algorithm_of, gradients, learner_of, losses_of, moved
from tests.made_up import batch

SMALL: dict[str, Any] = {"latent": 4, "hidden": 8, "heads": 2, "layers": 2, "reduction": 4}
REAL = torch.tensor([[True] * 5, [True, True, False, False, False]])


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def values(seed: int = 1) -> Tensor:
    return torch.randn(2, 5, 8, generator=generator(seed))


def small(**changes: Any) -> FocalPlusConfig:
    return FocalPlusConfig.model_validate(SMALL | changes)


def attention(tokens: Any = "steps") -> StepAttention:
    return StepAttention(small(tokens=tokens), generator=generator())


def block(kind: Any = "both", *, share: float = 0.0) -> TransformerBlock:
    return TransformerBlock(small(attention=kind, dropout=share), generator=generator())


def network(tokens: Any = "steps") -> TransitionTransformer:
    return TransitionTransformer(8, small(tokens=tokens), generator=generator())


def learner(**config: Any) -> FocalPlusLearner:
    return learner_of(FocalPlusLearner, "focal_plus", SMALL | config)


def test_attention_over_steps_is_softmax_of_scaled_products_by_heads() -> None:
    made, given = attention(), values()[:1]
    query, key, value = made.inputs(given[0]).split(8, dim=-1)
    parts = []
    for head in (slice(0, 4), slice(4, 8)):
        weights = torch.softmax(query[:, head] @ key[:, head].T / 4**0.5, dim=-1)
        parts.append(weights @ value[:, head])
    expected = made.outputs(torch.cat(parts, dim=-1))
    torch.testing.assert_close(made(given, REAL[:1])[0], expected)


def test_a_literal_token_sees_no_other_and_its_attention_is_affine() -> None:
    made, given, other = attention("literal"), values(), values(2)
    changed = torch.cat([given[:, :1], other[:, 1:]], dim=1)
    torch.testing.assert_close(made(changed, REAL)[:, 0], made(given, REAL)[:, 0])
    middle = made((given + other) / 2, REAL)
    torch.testing.assert_close(middle, (made(given, REAL) + made(other, REAL)) / 2)
    mixing = attention("steps")
    assert (mixing(changed, REAL)[:, 0] - mixing(given, REAL)[:, 0]).abs().min() > 1e-4


@pytest.mark.parametrize("tokens", ["steps", "literal"])
def test_representations_follow_the_order_of_steps_and_no_padding(tokens: str) -> None:
    made, given, order = network(tokens), values(), torch.tensor([3, 0, 4, 1, 2])
    plain = made(given, REAL)
    torch.testing.assert_close(made(given[:, order], REAL[:, order]), plain[:, order])
    scrambled = torch.where(REAL.unsqueeze(-1), given, given + 3.0)
    torch.testing.assert_close(made(scrambled, REAL)[REAL], plain[REAL])
    torch.testing.assert_close(made(given[1:, :2], REAL[1:, :2]), plain[1:, :2])


def test_the_gate_is_one_weight_per_transition_between_0_and_1() -> None:
    made = TransitionGate(small(), generator=generator())
    gates = made(values() * 10)
    assert gates.shape == (2, 5, 1)
    assert gates.min() > 0 and gates.max() < 1
    row = values()[0, 0]
    expected = torch.sigmoid(made.wide(torch.tanh(made.narrow(row)))).mean()
    torch.testing.assert_close(made(row).squeeze(), expected)


def test_a_gate_without_weights_halves() -> None:
    made = block("batch")
    assert made.gate is not None
    for parameter in made.gate.wide.parameters():
        torch.nn.init.zeros_(parameter)
    torch.testing.assert_close(made.mix(values(), REAL), 0.5 * values())


def test_variants_hold_the_parameters_of_their_own_attention_alone() -> None:
    held = {kind: {name.split(".")[0] for name, _ in block(kind).named_parameters()} for kind in KINDS}
    common = {"norm", "wide", "narrow"}
    assert held["none"] == common
    assert held["batch"] == common | {"mix_norm", "gate"}
    assert held["sequence"] == common | {"mix_norm", "steps"}
    assert held["both"] == held["batch"] | held["sequence"]


KINDS = ("both", "sequence", "batch", "none")


def test_both_attentions_with_one_silenced_are_the_other() -> None:
    made, alone = block("both"), block("batch")
    assert made.steps is not None
    for parameter in made.steps.outputs.parameters():
        torch.nn.init.zeros_(parameter)
    torch.testing.assert_close(made(values(), REAL, None), alone(values(), REAL, None))


def test_a_block_is_two_residuals_behind_layer_norms() -> None:
    made, given = block(), values()[:1]
    assert made.steps is not None and made.gate is not None and made.mix_norm is not None
    normed = functional.layer_norm(given, (8,), eps=1e-6)
    middle = given + made.steps(normed, REAL[:1]) + normed * made.gate(normed)
    inner = functional.gelu(made.wide(functional.layer_norm(middle, (8,), eps=1e-6)), approximate="tanh")
    torch.testing.assert_close(made(given, REAL[:1], None), middle + made.narrow(inner))


def test_dropout_keeps_the_mean_and_draws_from_the_given_generator() -> None:
    ones = torch.ones(10_000)
    dropped = dropout(ones, 0.25, generator())
    assert dropped.unique().tolist() == pytest.approx([0.0, 4 / 3])
    assert dropped.mean().item() == pytest.approx(1.0, abs=0.02)
    assert torch.equal(dropped, dropout(ones, 0.25, generator()))
    assert dropout(ones, 0.25, None) is ones


def test_dropout_works_in_training_and_not_in_adaptation() -> None:
    made = learner(dropout=0.5)
    first, second = losses_of(made).context, losses_of(made, step=2).context
    assert first is not None and second is not None
    assert (first - second).abs().max() > 1e-3
    steps = batch()["context"]
    torch.testing.assert_close(made.context(steps), learner(dropout=0.0).context(steps))


@pytest.mark.parametrize("similarity", ["cosine", "dot"])
def test_the_loss_tells_the_tasks_of_queries_by_keys_of_other_trajectories(similarity: str) -> None:
    made, values = learner(similarity=similarity, temperature=0.5), batch()
    queries, keys = made.context(values["context"]), made.key_encoder(values["execution"])
    if similarity == "cosine":
        queries, keys = (part / part.norm(dim=-1, keepdim=True) for part in (queries, keys))
    expected = info_nce(queries, keys, torch.ones(3, dtype=torch.bool), temperature=0.5)
    found = losses_of(made, values)
    torch.testing.assert_close(found.total, expected)
    torch.testing.assert_close(found.context, made.context(values["context"]))


def test_keys_get_no_gradient_and_an_update_moves_both_encoders() -> None:
    made = algorithm_of("focal_plus", SMALL)
    found = gradients(made.learner, losses_of(made.learner).total, ("encoder",))
    assert found["encoder"] > 1e-6
    assert not any(parameter.requires_grad for parameter in made.learner.key_encoder.parameters())
    assert moved(made) == {"encoder", "key_encoder"}
    assert not [name for name in made.tensors() if name.startswith("optimizer") and "key_encoder" in name]


@pytest.mark.parametrize("momentum", [0.0, 0.75])
def test_keys_follow_by_momentum(momentum: float) -> None:
    made = algorithm_of("focal_plus", SMALL | {"momentum": momentum})
    before = [value.clone() for value in made.learner.key_encoder.parameters()]
    made.update(batch(), 1)
    encoders = (made.learner.key_encoder.parameters(), made.learner.encoder.parameters())
    for key, now, query in zip(before, *encoders, strict=True):
        torch.testing.assert_close(now, momentum * key + (1 - momentum) * query)
        assert momentum or torch.equal(now, query)


def test_heads_that_do_not_divide_the_width_are_refused() -> None:
    with pytest.raises(ValueError, match="hidden, 10, must be a multiple of heads, 4"):
        FocalPlusConfig(hidden=10)
    assert METHODS.get("focal_plus").Config is FocalPlusConfig
