"""Compiled programs of this library: how they are made, kept and let go."""
