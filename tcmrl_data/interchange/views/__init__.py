"""Selections as objects of other libraries, one library a file."""
