import numpy as np
import pytest

from tcmrl_data.foundation.seeding import (
    Purpose,
    environment_key,
    evenly_spread,
    keyed_generator,
    keyed_seed,
    keyed_sequence,
)


def test_environment_key_is_the_head_of_sha256() -> None:
    assert environment_key("point-robot") == 3318534686  # python: int(sha256(name).hexdigest()[:8], 16)
    assert environment_key("point-robot") != environment_key("point-robot-wind")


def test_streams_differ_in_every_coordinate() -> None:
    base = (0, "point-robot", 1, Purpose.ROLLOUT_RESET, 2, 3)
    others = [
        (1, "point-robot", 1, Purpose.ROLLOUT_RESET, 2, 3),
        (0, "point-robot-wind", 1, Purpose.ROLLOUT_RESET, 2, 3),
        (0, "point-robot", 2, Purpose.ROLLOUT_RESET, 2, 3),
        (0, "point-robot", 1, Purpose.ROLLOUT_NOISE, 2, 3),
        (0, "point-robot", 1, Purpose.ROLLOUT_RESET, 3, 3),
        (0, "point-robot", 1, Purpose.ROLLOUT_RESET, 2, 4),
    ]
    assert len({keyed_seed(*coordinates) for coordinates in [base, *others]}) == 7
    assert keyed_seed(*base) == keyed_seed(*base)


def test_generator_matches_its_sequence() -> None:
    key = (5, "ml1/reach", 7, Purpose.ROLLOUT_NOISE, 1)
    expected = np.random.default_rng(keyed_sequence(*key)).random(3)
    assert np.array_equal(keyed_generator(*key).random(3), expected)


def test_entries_beyond_uint32_are_refused() -> None:
    with pytest.raises(ValueError, match=r"2\*\*32"):
        keyed_seed(0, "point-robot", 2**32, Purpose.BEHAVIOR)


def test_purposes_keep_their_numbers() -> None:
    assert {purpose.name: purpose.value for purpose in Purpose} == {
        "SPLIT": 0,
        "BEHAVIOR": 1,
        "BEHAVIOR_RESET": 2,
        "ROLLOUT_RESET": 3,
        "ROLLOUT_NOISE": 4,
        "REFERENCE_RESET": 5,
        "REFERENCE_NOISE": 6,
        "SAMPLER": 7,
        "LEARNER": 8,
        "EVALUATION_RESET": 9,
        "EVALUATION_NOISE": 10,
        "EVALUATION_CONTEXT": 11,
        "BEHAVIOR_ACTION": 12,
        "BEHAVIOR_UPDATE": 13,
        "SUBSET": 14,
        "FOLDS": 15,
        "EXTENSION_NOISE": 16,
        "EVALUATION_CANDIDATES": 17,
        "CONTROL_RESET": 18,
        "TUNING": 19,
        "TRANSFER_RESET": 20,
        "TRANSFER_NOISE": 21,
        "VISIBILITY": 22,
        "OPERATION": 23,
    }


def test_evenly_spread_items_have_both_ends() -> None:
    items = list(range(15))
    assert evenly_spread(items, 1) == [0]
    assert evenly_spread(items, 3) == [0, 7, 14]
    assert evenly_spread(items, 4) == [0, 5, 9, 14]
    assert evenly_spread(items, 99) == items
    assert evenly_spread([], 3) == []
