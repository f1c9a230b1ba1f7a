"""Memory that glibc's malloc keeps from the system, of a process in which several threads hand large arrays on."""

import ctypes
import functools
import sys
from typing import Any

ARENAS = 2
"""Pools of memory of a process."""
# Number of the parameter of `mallopt` (malloc.h).
_M_ARENA_MAX = -8


def use_few_arenas() -> None:
    """Has malloc serve all threads from two pools of memory, instead of eight for each core: pools fill and empty one
    by one, and what is free in one serves no other. In a sequence of 400×250 pictures at ×2, 0.4 of 2.7 GB were free
    memory of this kind. For processes of our own: it holds for whatever runs in one."""
    if (glibc := _glibc()) is not None:
        glibc.mallopt(_M_ARENA_MAX, ARENAS)


def give_memory_back() -> None:
    """Gives free memory back to the system, where glibc would keep it: the threads of a sequence of 400×250 pictures at
    ×2 left 1.6 GB of 3.6 GB behind that way, for no use. Takes milliseconds."""
    if (glibc := _glibc()) is not None:
        glibc.malloc_trim(0)


@functools.cache
def _glibc() -> Any:
    """The C library, where it is glibc; None elsewhere."""
    library = ctypes.CDLL(None) if sys.platform == "linux" else None
    return library if hasattr(library, "malloc_trim") else None
