"""Equations, one pure function each: torch alone."""
