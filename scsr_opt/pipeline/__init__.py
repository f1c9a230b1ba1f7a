"""Stages from a recording to a picture, in the order of Eq. 4."""
