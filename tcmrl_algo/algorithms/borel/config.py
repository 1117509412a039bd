"""The `[training.borel]` table."""

from typing import Literal

from pydantic import Field

from tcmrl_algo.methods.base import MethodConfig


class BorelConfig(MethodConfig):
    """The `[training.borel]` table.

    Attributes:
        belief: dimensions of the task variable; the context is its mean and log variance (published code: 5).
        recurrent_hidden: state of the GRU (published code: 128).
        action_embedding: width of embedded actions (published code: 16).
        state_embedding: width of embedded states (published code: 32).
        reward_embedding: width of embedded rewards (published code: 16).
        decoder_hidden: widths of the decoders (published code: 32 x 2).
        kl_weight: of the divergences between successive beliefs (published code: 0.05).
        decode_state: also predicts changes of the state, without which a belief cannot tell tasks that pay
            alike (published code: off everywhere; ours: on where tasks differ in their dynamics).
        elbo_terms: drawn steps t per lane whose z_t is decoded (ours; published code: all).
        reconstruction: whether a prediction's errors are a `mean` over steps (published code) or their `sum`
            (paper), which makes the divergences weigh less.
        episodes_per_belief: episodes of a task that are filtered one after the other (published code: 2).
        explore: who collects the first episodes: the `policy`, whose belief starts from the prior, and later
            from that after the first episode (published code), or `uniform` actions (ours).
        vae_share: share of all steps that train the belief; the others train the policy (ours).
    """

    belief: int = Field(default=5, ge=1)
    recurrent_hidden: int = Field(default=128, ge=1)
    action_embedding: int = Field(default=16, ge=1)
    state_embedding: int = Field(default=32, ge=1)
    reward_embedding: int = Field(default=16, ge=1)
    decoder_hidden: tuple[int, ...] = (32, 32)
    kl_weight: float = Field(default=0.05, ge=0)
    decode_state: bool = False
    elbo_terms: int = Field(default=8, ge=1)
    reconstruction: Literal["mean", "sum"] = "mean"
    episodes_per_belief: int = Field(default=2, ge=2)
    explore: Literal["policy", "uniform"] = "policy"
    vae_share: float = Field(default=0.25, gt=0, lt=1)
