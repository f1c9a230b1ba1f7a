"""Memory that glibc's malloc keeps, in processes of their own."""

import subprocess
import sys

import pytest

from scsr_opt._kernels.memory import ARENAS, give_memory_back

# Eight threads at once, each with small pieces of memory; then the pools that malloc has.
THREADS = """
import ctypes, sys, threading
from scsr_opt._kernels.memory import use_few_arenas
if sys.argv[1] == "few":
    use_few_arenas()
ready = threading.Barrier(8)
def work():
    ready.wait()
    kept = [bytearray(1000 + n) for n in range(1000)]
    ready.wait()
threads = [threading.Thread(target=work) for _ in range(8)]
for thread in threads: thread.start()
for thread in threads: thread.join()
libc = ctypes.CDLL(None)
libc.fopen.restype = ctypes.c_void_p
libc.malloc_info.argtypes, libc.fclose.argtypes = (ctypes.c_int, ctypes.c_void_p), (ctypes.c_void_p,)
file = libc.fopen(sys.argv[2].encode(), b"w")
libc.malloc_info(0, file)
libc.fclose(file)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc is of Linux")
def test_use_few_arenas_bounds_the_pools_of_memory(tmp_path):
    pools = {}
    for which in ("few", "usual"):
        told = tmp_path / which
        subprocess.run([sys.executable, "-c", THREADS, which, str(told)], check=True, timeout=60)
        pools[which] = told.read_text().count("<heap nr=")
    assert pools["few"] <= ARENAS < pools["usual"]


def test_give_memory_back_can_be_called_at_any_time():
    give_memory_back()
    give_memory_back()
