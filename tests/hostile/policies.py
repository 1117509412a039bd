"""Forged policies."""

import struct

import numpy as np

from tests.hostile.case import in_part
from tests.hostile.datasets import Forge


def _repeated_header(forge: Forge) -> None:
    size = len(forge.read("policy.safetensors"))
    forge.write("policy.safetensors", struct.pack("<Q", 2**62) + b"{" * (size - 8))


POLICIES = [
    in_part(
        "pickle as weights",
        lambda f: f.write("policy.safetensors", f.payload()),
        "policy.safetensors",
        "bytes",
    ),
    in_part(
        "pickle as policy",
        lambda f: f.write("policy.json", f.payload()),
        "policy.json",
        "not a policy",
    ),
    in_part(
        "overlapping",
        lambda f: f.header(lambda h: h["mean.bias"].update(data_offsets=h["log_std.bias"]["data_offsets"])),
        "policy.safetensors",
        "safetensors",
    ),
    in_part(
        "huge tensor",
        lambda f: f.header(lambda h: h["mean.bias"].update(shape=[2**62])),
        "policy.safetensors",
        "safetensors",
    ),
    in_part("header of 2**62", _repeated_header, "policy.safetensors", "safetensors"),
    in_part(
        "NaN weights",
        lambda f: f.weights(lambda t: t["mean.bias"].fill(np.nan)),
        "policy.safetensors",
        "mean.bias",
    ),
    in_part(
        "wrong shapes",
        lambda f: f.weights(lambda t: t.update({"mean.bias": np.zeros((1, 2), np.float32)})),
        "policy.safetensors",
        "shapes",
    ),
    in_part(
        "other weights",
        lambda f: f.weights(lambda t: t["mean.bias"].fill(0.5)),
        "policy.json",
        "digest",
        "verify",
    ),
    in_part("terabyte layers", lambda f: f.policy(hidden=[65536] * 16), "policy.safetensors", "bytes"),
    in_part("kind pickle", lambda f: f.policy(kind="pickle"), "policy.json", "kind"),
    in_part(
        "scripted with weights",
        lambda f: f.write("policy.json", b'{"kind":"scripted","observation":"full","noise":0.1}'),
        "policy.json",
        "digest",
        "verify",
    ),
]
