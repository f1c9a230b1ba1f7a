"""Strictness that only tests need, and where recordings of real cameras are.

Under test every annotated shape and type of the packages is checked, and arithmetic may not promote dtypes or ranks by
itself.
"""

import gc
import os
import sys
from pathlib import Path

# Before anything imports matplotlib or a BLAS: no display is needed, and with one worker process per core a pool of
# threads in each of them only gets in the others' way.
os.environ.setdefault("MPLBACKEND", "Agg")
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Compilation is most of the time of most tests. A reconstruction at the default settings (78 programs, 12×16 pixels)
# took 31.7 core seconds, 17.9 without most optimisations, 9.3 also without XLA's MLIR-based emitters of fused loops,
# 6.4 also with one module per program, and 3.4 with compiled programs read from the cache, which workers, modules and
# runs share. These are variables rather than settings of JAX, so that processes that tests start inherit them.
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
os.environ["XLA_FLAGS"] = " ".join(
    [
        os.environ.get("XLA_FLAGS", ""),
        "--xla_cpu_use_fusion_emitters=false",
        "--xla_cpu_parallel_codegen_split_count=1",
    ]
)
os.environ["JAX_COMPILATION_CACHE_DIR"] = str(Path(__file__).parent.parent / ".pytest_cache" / "compiled")
os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"

import hypothesis
import jax
import jaxtyping
import pytest

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
# The processes that tests start, some forty, find the packages compiled to bytecode.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# Has to come before the first import of the packages: modules that are loaded already stay unchecked.
jaxtyping.install_import_hook(["scsr_opt", "learned"], "beartype.beartype")

hypothesis.settings.register_profile(
    "default",
    deadline=None,  # the first example of a shape compiles
    suppress_health_check=[hypothesis.HealthCheck.too_slow, hypothesis.HealthCheck.function_scoped_fixture],
)
hypothesis.settings.register_profile("ci", hypothesis.settings.get_profile("default"), derandomize=True)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "default")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings, which is not part of the project; tests that need it are skipped without it."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("SCSR_SHARED_DATA", beside))
    if not folder.is_dir():
        pytest.skip(f"there is no folder {folder} of real recordings: set SCSR_SHARED_DATA to it")
    return folder


# Linux lets a process have 65,530 mappings of memory, and a compiled program takes some tens: XLA aborts beyond that.
_MANY_MAPPINGS = 20_000


@pytest.fixture(scope="module", autouse=True)
def compiled_programs_are_let_go():
    """After a module, where there are many: a worker that runs half of all tests would compile too much to keep."""
    yield
    mappings = Path("/proc/self/maps")
    if mappings.exists() and mappings.read_bytes().count(b"\n") > _MANY_MAPPINGS:
        jax.clear_caches()
        gc.collect()
