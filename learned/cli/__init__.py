"""Commands of `scsr` that need the networks: `train` and `compare` (entry points of the group `scsr.commands`)."""
