"""The command `scsr`.

Only the standard library and the parser are imported here and at the head of the commands' modules: `scsr --help`
answers at once, and a mistyped argument is found before seconds are spent on importing JAX.
"""

from scsr_opt.cli.app import main

__all__ = ["main"]
