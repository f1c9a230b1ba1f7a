"""Names that `scsr_opt.camera` lists, whatever was imported before."""

import subprocess
import sys


def test_no_public_name_is_hidden_by_a_module_of_the_same_name():
    """Importing a module puts it into its package, in front of what is looked up when it is asked for."""
    said = subprocess.run(
        [
            sys.executable,
            "-c",
            "import types, scsr_opt, scsr_opt.camera as c, scsr_opt.solvers as s, learned.training.gain\n"
            "print([n for p in (c, s) for n in p.__all__ if isinstance(getattr(p, n), types.ModuleType)])",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    assert said.stdout.strip() == "[]"
