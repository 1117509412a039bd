"""Equations as pure functions, which import torch only."""
