"""Compiled programs kept from one call of `scsr` to the next: compiling takes longer than most solves."""

import hashlib
import os
import platform
from pathlib import Path


def keep_compiled() -> None:
    """Tells JAX, before it is imported, to keep what it compiles in the user's cache folder.

    JAX's own environment variables come first: `JAX_COMPILATION_CACHE_DIR` names another folder,
    `JAX_ENABLE_COMPILATION_CACHE=0` keeps nothing. Where the folder cannot be written, nothing is kept.
    """
    base = os.environ.get("XDG_CACHE_HOME", "")
    try:
        folder = (Path(base) if base else Path.home() / ".cache") / "scsr-opt" / _processor()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # the latter where there is no home
        return
    if not os.access(folder, os.W_OK):
        return
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(folder))
    # Of the hundred programs of a solve the quick ones are compiled as fast as they are read.
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")


def _processor() -> str:
    """A name for this kind of processor: a home may be shared by machines whose programs the others cannot run."""
    known = [platform.machine(), platform.processor()]
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
        known += sorted({line for line in lines if line.startswith(("flags", "Features", "model name"))})
    except OSError:
        pass  # elsewhere than on Linux
    return hashlib.sha256("\n".join(known).encode()).hexdigest()[:12]
