"""The `[training.actor_critic.brac]` table."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class BracSettings(BaseModel):
    """The `[training.actor_critic.brac]` table: behavior regularisation by a dual KL estimate (BRAC, FOCAL).

    Attributes:
        mode: `off`; `policy` adds alpha D to the policy loss; `value` also subtracts alpha D(s) from the
            target of V(s) (published code: on for MuJoCo and Meta-World, off for the point robots; from the
            target of Q, with the D of the state before).
        alpha: start of the divergence's weight (published code: 50).
        largest_alpha: its bound (published code: 2e3; 1e4 for Hopper and Walker).
        alpha_learning_rate: step of alpha's dual descent (published code: 1); 0 keeps alpha at its start
            (Wu et al., 2019, BRAC's paper, compares both).
        target: divergence that alpha's dual descent aims at (published code: 0.05).
        learning_rate: of the dual critic (paper, F.2: 1e-4).
        steps: dual critic steps per training step (published code: 3).
        penalty: weight of the gradient penalty (published code: 5).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    mode: Literal["off", "policy", "value"] = "off"
    alpha: float = Field(default=50.0, ge=0)
    largest_alpha: float = Field(default=2000.0, gt=0)
    alpha_learning_rate: float = Field(default=1.0, ge=0)
    target: float = Field(default=0.05, ge=0)
    learning_rate: float = Field(default=1e-4, gt=0)
    steps: int = Field(default=3, ge=1)
    penalty: float = Field(default=5.0, ge=0)
