"""The `[training.macaw]` table."""

from typing import Literal

from pydantic import Field

from tcmrl_algo.methods.base import MethodConfig


class MacawConfig(MethodConfig):
    """The `[training.macaw]` table.

    Attributes:
        hidden: widths of both networks (published code: 100 x 3).
        code: size of the code behind the weights of a layer (published code: 100).
        head_hidden: width of the advantage head (published code: 32).
        sigma: standard deviation of the policy, whose mean is squashed (published code: 0.2).
        inner_learning_rate: start of the inner rates (published code: 1e-3).
        rate_learning_rate: of Adam for the inner rates and the head's weight (published code: 1e-3).
        policy_learning_rate: of Adam for the policy and its head (published code: 1e-4, for 10^6 steps).
        value_learning_rate: of Adam for the value network (published code: 1e-5, for 10^6 steps).
        head_weight: start of c (published code: 0.01).
        temperature: by which normalised advantages are divided (published code: 1).
        weight_cap: largest weight of a transition (published code: 20).
        target_step: share of the adapted value network in the one of the outer targets (published code: 0.1).
        inner_rows: most steps of a context that an inner step reads (published code: 256).
        first_order: leaves out the derivative of inner gradients (ours, for speed).
        explore: who collects before there are data: `uniform` actions, or the unadapted `policy`.
    """

    hidden: tuple[int, ...] = Field(default=(100, 100, 100), min_length=1)
    code: int = Field(default=100, ge=1)
    head_hidden: int = Field(default=32, ge=1)
    sigma: float = Field(default=0.2, gt=0)
    inner_learning_rate: float = Field(default=1e-3, gt=0)
    rate_learning_rate: float = Field(default=1e-3, gt=0)
    policy_learning_rate: float = Field(default=1e-4, gt=0)
    value_learning_rate: float = Field(default=1e-5, gt=0)
    head_weight: float = Field(default=0.01, gt=0)
    temperature: float = Field(default=1.0, gt=0)
    weight_cap: float = Field(default=20.0, gt=0)
    target_step: float = Field(default=0.1, ge=0, le=1)
    inner_rows: int = Field(default=256, ge=2)
    first_order: bool = False
    explore: Literal["policy", "uniform"] = "uniform"
