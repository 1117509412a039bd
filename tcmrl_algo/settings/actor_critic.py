"""The `[training.actor_critic]` table."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from tcmrl_algo.settings.brac import BracSettings
from tcmrl_algo.settings.iql import IqlSettings


class ActorCriticSettings(BaseModel):
    """The `[training.actor_critic]` table.

    Attributes:
        kind: `sac` (published codes of FOCAL, IDAQ and TCMRL), `iql` (implicit Q-learning) or `bc` (behavior
            cloning, without a critic). `sac` alone reads `entropy`, both regularizations, `log_std_range`,
            `cloning` and `brac`; `bc` reads none but `hidden`.
        hidden: widths of all networks here (published code: 256 x 3).
        gamma: discount factor (paper, F.2: 0.99; published code: 0.9 for the point robots).
        rewards: that the actor-critic learns from. `dense` takes the shaped rewards that a dataset stores
            beside sparse ones, while contexts and evaluation keep the sparse ones (published code of IDAQ and
            TCMRL on sparse-point-robot; paper: not said). Deviation from that code: TCMRL's reward estimator
            learns from the stored rewards with either.
        reward_scale: multiplies rewards (published code: 5; 100 for the point robots).
        entropy: alpha in front of log pi (published code: 1, beside rewards scaled by 5 or 100).
        tau: step of the target network, V's in `sac` and Q's in `iql`, towards its network (published codes
            of both: 0.005).
        mean_regularization: weight of the squared policy means (published code: 1e-3).
        std_regularization: weight of the squared policy log standard deviations (published code: 1e-3).
        log_std_range: bounds of the policy's log standard deviation (published code: [-20, 0]).
        clip_targets: hold V(s') within what the data's rewards allow (ours: critics trained on narrow data
            believe in states outside it).
        divergence_factor: training stops where some |Q| exceeds what the data's rewards allow this many times
            (ours; Q that diverges grows without end, so that the number hardly matters).
        cloning: weight of the policy's squared distance from the stored actions, in units of mean |Q| (ours,
            after TD3+BC, whose own is 0.4; 0: off).
        brac: behavior regularisation.
        iql: implicit Q-learning.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["sac", "iql", "bc"] = "sac"
    hidden: tuple[int, ...] = (256, 256, 256)
    gamma: float = Field(default=0.99, ge=0, lt=1)
    rewards: Literal["stored", "dense"] = "stored"
    reward_scale: float = Field(default=5.0, gt=0)
    entropy: float = Field(default=1.0, ge=0)
    tau: float = Field(default=0.005, gt=0, le=1)
    mean_regularization: float = Field(default=1e-3, ge=0)
    std_regularization: float = Field(default=1e-3, ge=0)
    log_std_range: tuple[float, float] = (-20.0, 0.0)
    clip_targets: bool = True
    divergence_factor: float = Field(default=100.0, gt=1)
    cloning: float = Field(default=0.0, ge=0)
    brac: BracSettings = BracSettings()
    iql: IqlSettings = IqlSettings()
