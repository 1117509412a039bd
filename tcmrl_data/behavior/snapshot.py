"""Behavior policies as files: `policy.json` and, for networks, `policy.safetensors`; no pickles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Literal, Protocol, final

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from tcmrl_data.envs.base import Environment, Parameters
from tcmrl_data.envs.controller import Controller, FloatArray, ObservationView
from tcmrl_data.foundation.canonical import canonical_json, digest, parse_json, sha256
from tcmrl_data.foundation.errors import SnapshotError, StoreError
from tcmrl_data.foundation.plain_files import one_line, printable

if TYPE_CHECKING:
    import torch
    from stable_baselines3 import SAC

LOG_STD_RANGE = (-20.0, 2.0)
"""Limits of the log standard deviation in Stable-Baselines3's SAC actor."""

DESCRIPTION_BYTES = 2**16
"""Maximum size of `policy.json`."""

HEADER_BYTES = 2**16
"""Maximum size of the header of `policy.safetensors`."""


class _Description(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    observation: ObservationView


class GaussianDescription(_Description):
    """A squashed Gaussian policy with ReLU layers; its weights are in the safetensors file."""

    kind: Literal["squashed_gaussian"] = "squashed_gaussian"
    observation_dim: int = Field(ge=1, le=2**16)
    action_dim: int = Field(ge=1, le=2**16)
    hidden: tuple[Annotated[int, Field(ge=1, le=2**16)], ...] = Field(max_length=16)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of all tensors, by name."""
        widths = (self.observation_dim, *self.hidden)
        layers = {f"hidden.{i}": (out, into) for i, (into, out) in enumerate(pairwise(widths))}
        layers |= dict.fromkeys(("mean", "log_std"), (self.action_dim, widths[-1]))
        return {f"{name}.weight": shape for name, shape in layers.items()} | {
            f"{name}.bias": shape[:1] for name, shape in layers.items()
        }


class ScriptedDescription(_Description):
    """The environment's expert with N(0, noise) added to actions."""

    kind: Literal["scripted"] = "scripted"
    noise: float = Field(ge=0, le=10, allow_inf_nan=False)


PolicyDescription = Annotated[GaussianDescription | ScriptedDescription, Field(discriminator="kind")]
_DESCRIPTION: TypeAdapter[GaussianDescription | ScriptedDescription] = TypeAdapter(PolicyDescription)


class ReadFile(Protocol):
    """Reads a file by its name."""

    def __call__(self, name: str, *, limit: int) -> bytes:
        """The content of a file of at most `limit` bytes."""


@dataclass(frozen=True)
class Snapshot:
    """A behavior policy of one task at one training step.

    Attributes:
        step: environment steps of training; for scripted policies the index of the noise level.
        tensors: float32 weights by name; empty for scripted policies.
    """

    step: int
    description: GaussianDescription | ScriptedDescription
    tensors: Mapping[str, npt.NDArray[np.float32]] = field(default_factory=dict)

    @classmethod
    def of_network(
        cls, step: int, observation: ObservationView, tensors: Mapping[str, npt.NDArray[np.float32]]
    ) -> "Snapshot":
        """A snapshot of a Gaussian policy with the sizes of its tensors."""
        biases = [name for name in tensors if name.startswith("hidden.") and name.endswith(".bias")]
        description = GaussianDescription(
            observation=observation,
            observation_dim=tensors["hidden.0.weight"].shape[1],
            action_dim=tensors["mean.bias"].size,
            hidden=tuple(tensors[f"hidden.{index}.bias"].size for index in range(len(biases))),
        )
        return cls(step, description, tensors)

    def digest(self) -> str:
        """The sha256 of the description and of the dtype, shape and bytes of every tensor."""
        tensors = {
            name: [str(array.dtype), list(array.shape), sha256(np.ascontiguousarray(array).data)]
            for name, array in self.tensors.items()
        }
        return digest({"policy": self.description.model_dump(mode="json"), "tensors": tensors})

    def controller(self, environment: Environment, parameters: Sequence[Parameters]) -> Controller:
        """The policy as a controller for lanes with the given tasks.

        Raises:
            SnapshotError: the policy is scripted and the environment has no expert.
        """
        if isinstance(self.description, GaussianDescription):
            return GaussianController(self.description, self.tensors)
        controller = environment.scripted(parameters, self.description.noise)
        if controller is None:
            raise SnapshotError(f"{environment.name} has no scripted policy; use --behavior sac")
        return controller

    def files(self) -> dict[str, bytes]:
        """The content of the policy's files, by name."""
        from safetensors.numpy import save

        files = {"policy.json": canonical_json(self.description.model_dump(mode="json"))}
        if self.tensors:
            files["policy.safetensors"] = save(dict(self.tensors))
        return files


def read_snapshot(read: ReadFile, step: int, *, place: str) -> Snapshot:
    """Reads a snapshot; error messages begin with `place`.

    Raises:
        SnapshotError: a file is missing or malformed, tensors do not have the names, shapes and dtypes of
            the description, or weights are not finite.
    """
    try:
        values = parse_json(read("policy.json", limit=DESCRIPTION_BYTES))
        description = _DESCRIPTION.validate_json(canonical_json(values))
    except (OSError, ValueError, StoreError) as error:
        raise SnapshotError(f"{place}: policy.json: not a policy description ({one_line(error)})") from None
    if isinstance(description, ScriptedDescription):
        return Snapshot(step, description)
    return Snapshot(step, description, _read_tensors(read, place, description.shapes()))


def _read_tensors(
    read: ReadFile, place: str, shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, npt.NDArray[np.float32]]:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    file = f"{place}: policy.safetensors"
    weights = sum(int(np.prod(shape)) for shape in shapes.values())
    try:
        data = read("policy.safetensors", limit=4 * weights + HEADER_BYTES)
        if len(data) < 4 * weights:
            raise SnapshotError(f"{file}: {len(data)} bytes, the policy needs {4 * weights}")
        tensors = load(data)
    except (OSError, ValueError, KeyError, TypeError, StoreError, SafetensorError) as error:
        raise SnapshotError(f"{file}: cannot be read as safetensors ({one_line(error)})") from None
    found = {name: array.shape for name, array in tensors.items()}
    if found != dict(shapes):
        names = printable(str(sorted(found)))[:200]
        raise SnapshotError(f"{file}: tensors {names} do not have the policy's names and shapes")
    for name, array in tensors.items():
        if array.dtype != np.float32 or not np.isfinite(array).all():
            raise SnapshotError(f"{file}: tensor {name!r} must be finite float32")
    return tensors


def snapshot_of_sac(model: "SAC", *, step: int, observation: ObservationView) -> Snapshot:
    """Makes a snapshot of a Stable-Baselines3 SAC's actor."""
    actor = model.policy.actor
    layers = [layer for layer in actor.latent_pi if hasattr(layer, "weight")]
    named = {f"hidden.{i}": layer for i, layer in enumerate(layers)} | {
        "mean": actor.mu,
        "log_std": actor.log_std,
    }
    tensors = {
        f"{name}.{kind}": getattr(layer, kind).detach().cpu().numpy().copy()
        for name, layer in named.items()
        for kind in ("weight", "bias")
    }
    return Snapshot.of_network(step, observation, tensors)


@final
class GaussianController(Controller):
    """Acts by tanh(mean + std * noise), computed like Stable-Baselines3's SAC actor."""

    def __init__(
        self, description: GaussianDescription, tensors: Mapping[str, npt.NDArray[np.float32]]
    ) -> None:
        import torch

        self.view = description.observation
        self._hidden = range(len(description.hidden))
        self._tensors = {name: torch.tensor(array) for name, array in tensors.items()}

    def act(self, observations: FloatArray, noise: FloatArray) -> FloatArray:
        import torch

        with torch.inference_mode():
            features = torch.tensor(observations, dtype=torch.float32)
            for i in self._hidden:
                features = torch.relu(self._linear(f"hidden.{i}", features))
            mean = self._linear("mean", features)
            std = torch.clamp(self._linear("log_std", features), *LOG_STD_RANGE).exp()
            squashed = torch.tanh(mean + torch.from_numpy(noise) * std).numpy()
        # Stable-Baselines3 scales actions to [-1, 1]; here that can only change the last bit
        return -1.0 + 0.5 * (squashed + 1.0) * 2.0

    def _linear(self, name: str, features: "torch.Tensor") -> "torch.Tensor":
        from torch.nn.functional import linear

        return linear(features, self._tensors[f"{name}.weight"], self._tensors[f"{name}.bias"])
