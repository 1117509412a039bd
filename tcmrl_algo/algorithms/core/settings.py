"""The tables `[training.…]` that methods share: validated values, each with its source."""

from typing import Any, Literal

from pydantic import Field, PositiveInt

from tcmrl_data.foundation.records import Frozen

PROTOCOL_GROUP = "tcmrl.protocols"
"""The entry point group of protocols, which live in a room above this one."""

LOGGING_KEYS = frozenset({"log_every", "checkpoint_every"})
"""Settings of `RunSettings` that change no tensor."""


class RunSettings(Frozen):
    """The `[training.run]` table.

    Attributes:
        algorithm: a file of `tcmrl_algo/algorithms`.
        steps: training steps, and the length of all schedules.
        snapshots: which snapshots to learn from: `all`, `last`, `steps>=N`,
            `return>=Q` or `tier:NAME`.
        context_snapshots: which snapshots context and execution trajectories and windows come from, and
            stored contexts in evaluation; those of `snapshots` if left out. What a policy learns from is
            always of `snapshots`, also the trajectories of a method that requests nothing else (BOReL).
        threads: CPU threads of torch; results depend on it in their last bits.
        precision: in which hidden layers multiply; all else is float32. `bfloat16` is faster where the
            processor multiplies it in hardware, and changes results.
        log_every: steps between two lines of metrics.
        checkpoint_every: steps between two checkpoints.
        protocol: how to adapt to test tasks (paper, section 4.2: `paper`).
        episodes: adaptation episodes per test task, of all protocols and all methods.
        random_episodes: how many of them form the first stage: the method's exploration under `paper`, which
            is uniform actions unless it has one of its own, and tried contexts of training tasks under
            `idaq_literal` (published code: one setting for both). 0 begins `paper` with the prior of a
            method that needs no trajectories.
        candidates: how many training tasks are drawn for every episode of the first stage of `idaq_literal`,
            of which the one with the most distant context is tried.
        repeats: how many times a protocol with a random first stage is run, by independent seeds; results
            are means.
        offline_trajectories: stored trajectories in a context, under `offline` and of training tasks.
        final_episodes: episodes of the adapted policy that its final return averages over.
    """

    algorithm: str = "tcmrl"
    steps: int = Field(default=100_000, ge=1)
    snapshots: str = "all"
    context_snapshots: str | None = None
    threads: int = Field(default=1, ge=1)
    precision: Literal["float32", "bfloat16"] = "float32"
    log_every: int = Field(default=100, ge=1)
    checkpoint_every: int = Field(default=5_000, ge=1)
    protocol: str = "paper"
    episodes: int = Field(default=10, ge=1)
    random_episodes: int = Field(default=5, ge=0)
    candidates: int = Field(default=5, ge=1)
    repeats: int = Field(default=5, ge=1)
    offline_trajectories: int = Field(default=4, ge=1)
    final_episodes: int = Field(default=1, ge=1)


class BatchSettings(Frozen):
    """The `[training.batch]` table; a method requests what it reads of it.

    Attributes:
        tasks: tasks per batch, drawn without replacement; all training tasks where there are fewer.
        transitions: transitions per task for the actor-critic.
        context_trajectories: context trajectories per task; one of these numbers is drawn for every batch.
        execution_trajectories: execution trajectories per task, never among the context ones. TCMRL
            estimates rewards on them: 16 tasks with one trajectory of 20 steps are 320 targets per step for
            Eq. 7 and 16 for Eq. 17, so that 20 trajectories give Eq. 17 as many (paper: not said).
        windows: windows of K steps per task, uniform over all valid windows; 0 for none.
        window_length: K.
    """

    tasks: int = Field(default=16, ge=2)
    transitions: int = Field(default=256, ge=1)
    context_trajectories: tuple[PositiveInt, ...] = Field(default=(1,), min_length=1)
    execution_trajectories: int = Field(default=1, ge=1)
    windows: int = Field(default=0, ge=0)
    window_length: int = Field(default=2, ge=2)


class OptimizerSettings(Frozen):
    """The `[training.optimizer]` table.

    Attributes:
        learning_rate: of Adam (paper, F.2: 3e-4).
        final_share: share of it left at the last step, reached linearly (paper: constant, 1).
        gradient_norm: bound of the gradient's norm; absent for none (paper: none).
    """

    learning_rate: float = Field(default=3e-4, gt=0)
    final_share: float = Field(default=1.0, ge=0, le=1)
    gradient_norm: float | None = Field(default=None, gt=0)


class BracSettings(Frozen):
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

    mode: Literal["off", "policy", "value"] = "off"
    alpha: float = Field(default=50.0, ge=0)
    largest_alpha: float = Field(default=2000.0, gt=0)
    alpha_learning_rate: float = Field(default=1.0, ge=0)
    target: float = Field(default=0.05, ge=0)
    learning_rate: float = Field(default=1e-4, gt=0)
    steps: int = Field(default=3, ge=1)
    penalty: float = Field(default=5.0, ge=0)


class IqlSettings(Frozen):
    """The `[training.actor_critic.iql]` table: implicit Q-learning (Kostrikov, Nair & Levine, 2021).

    Attributes:
        expectile: of min Q that V fits; 0.5 is the mean, 1 the largest (its paper: 0.7; 0.9 for AntMaze).
        inverse_temperature: beta, which multiplies the advantages (its paper: 3 for MuJoCo, 10 for AntMaze).
            Deviation: of advantages in units of their standard deviation over the batch.
        largest_weight: cap of exp(beta A) (its published code: 100).
    """

    expectile: float = Field(default=0.7, gt=0, lt=1)
    inverse_temperature: float = Field(default=3.0, ge=0)
    largest_weight: float = Field(default=100.0, gt=0)


class ActorCriticSettings(Frozen):
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


UNREAD = {
    "sac": ("iql",),
    "iql": ("entropy", "mean_regularization", "std_regularization", "log_std_range", "cloning", "brac"),
    "bc": tuple(name for name in ActorCriticSettings.model_fields if name not in ("kind", "hidden")),
}
"""Settings of an actor-critic that a kind of it does not read, by kind."""


class TrainingSettings(Frozen):
    """What all methods share."""

    run: RunSettings = RunSettings()
    batch: BatchSettings = BatchSettings()
    optimizer: OptimizerSettings = OptimizerSettings()
    actor_critic: ActorCriticSettings = ActorCriticSettings()


TrainingSource = Literal["table", "recipe", "defaults"]
"""Whence a method's own settings: the given table, the installed recipe's, or the method's defaults."""


class TrainingConfig(Frozen):
    """A resolved run: the shared settings and the chosen method's own table.

    Attributes:
        settings: the shared tables.
        method: the table named after the algorithm, as the method's `Config` dumps it.
        training_source: where the method's own table comes from.
    """

    settings: TrainingSettings
    method: dict[str, Any]
    training_source: TrainingSource = "table"
