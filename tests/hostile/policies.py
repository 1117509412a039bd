"""Forged policies."""

import struct

import numpy as np

from tests.hostile.case import ESCAPE, in_part
from tests.hostile.datasets import Forge


def _repeated_header(forge: Forge) -> None:
    size = len(forge.read("policy.safetensors"))
    forge.write("policy.safetensors", struct.pack("<Q", 2**62) + b"{" * (size - 8))


SB3_ZIP = b"PK\x03\x04" + bytes(26) + b"data" + bytes(4096)

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
        "SB3 zip",
        lambda f: f.write("policy.safetensors", SB3_ZIP),
        "policy.safetensors",
        "safetensors",
    ),
    in_part(
        "overlapping",
        lambda f: f.header(lambda h: h["mean.bias"].update(data_offsets=h["log_std.bias"]["data_offsets"])),
        "policy.safetensors",
        "safetensors",
    ),
    in_part(
        "huge offsets",
        lambda f: f.header(lambda h: h["mean.bias"].update(data_offsets=[0, 2**60])),
        "policy.safetensors",
        "safetensors",
    ),
    in_part(
        "negative offsets",
        lambda f: f.header(lambda h: h["mean.bias"].update(data_offsets=[-8, 0])),
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
        "unknown dtype",
        lambda f: f.header(lambda h: h["mean.bias"].update(dtype="F8_E4M3")),
        "policy.safetensors",
        "safetensors",
    ),
    in_part(
        "NaN weights",
        lambda f: f.weights(lambda t: t["mean.bias"].fill(np.nan)),
        "policy.safetensors",
        "mean.bias",
    ),
    in_part(
        "infinite weights",
        lambda f: f.weights(lambda t: t["mean.bias"].fill(np.inf)),
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
        "whole numbers",
        lambda f: f.weights(lambda t: t.update({"mean.bias": np.zeros(2, np.int32)})),
        "policy.safetensors",
        "mean.bias",
    ),
    in_part(
        "tensor escapes",
        lambda f: f.weights(lambda t: t.update({ESCAPE: t["mean.bias"]})),
        "policy.safetensors",
        "names",
    ),
    in_part(
        "tensor missing",
        lambda f: f.weights(lambda t: t.pop("mean.bias")),
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
    in_part("layer of 10**9", lambda f: f.policy(hidden=[10**9]), "policy.json", "hidden"),
    in_part("thousand layers", lambda f: f.policy(hidden=[1] * 1000), "policy.json", "hidden"),
    in_part("kind pickle", lambda f: f.policy(kind="pickle"), "policy.json", "kind"),
    in_part(
        "noise 1e999",
        lambda f: f.write("policy.json", b'{"kind":"scripted","observation":"full","noise":1e999}'),
        "policy.json",
        "too large",
    ),
    in_part("policy deep", lambda f: f.write("policy.json", b"[" * 10**4), "policy.json", "nested"),
    in_part("policy big", lambda f: f.write("policy.json", b" " * 10**6), "policy.json", "bytes"),
    in_part(
        "scripted with weights",
        lambda f: f.write("policy.json", b'{"kind":"scripted","observation":"full","noise":0.1}'),
        "policy.json",
        "digest",
        "verify",
    ),
]
