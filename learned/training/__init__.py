"""Data, loss loop, checkpoints and configurations with which the networks are trained."""
