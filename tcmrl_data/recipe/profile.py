"""The profiles of a recipe; a module of its own, so that the command line can read it at once."""

from typing import Literal, get_args

Profile = Literal["paper", "quick", "reduced"]
"""`paper` is the recipe itself; the other profiles are smaller."""

PROFILES: tuple[Profile, ...] = get_args(Profile)
