"""Compiled programs of this library: how they are made, kept and let go, and how XLA is led to make them fast."""
