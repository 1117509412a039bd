"""The profiles of a recipe; a module of its own, so that the command line can read it at once."""

from typing import Literal, get_args

Profile = Literal["paper", "quick", "reduced"]
"""`paper` is a recipe as written; the others are its smaller forms."""

PROFILES: tuple[Profile, ...] = get_args(Profile)
