"""Recipes: what a dataset is built from. Here are the names of their profiles, which import nothing."""

from typing import Literal, get_args

Profile = Literal["paper", "quick", "reduced"]
"""`paper` is the recipe itself; the other profiles are smaller."""

PROFILES: tuple[Profile, ...] = get_args(Profile)
