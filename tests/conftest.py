"""Strictness that only tests need, and where recordings of real cameras are.

Under test every annotated shape and type of the packages is checked, and arithmetic may not promote dtypes or ranks by
itself.
"""

import gc
import os
from pathlib import Path

# Before anything imports matplotlib or a BLAS: no display is needed, and with one worker process per core a pool of
# threads in each of them only gets in the others' way.
os.environ.setdefault("MPLBACKEND", "Agg")
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import hypothesis
import jax
import jaxtyping
import pytest

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
# What one worker has compiled the others read, and the next run, too: compiling is most of the time of most tests.
jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parent.parent / ".pytest_cache" / "compiled"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
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


@pytest.fixture(scope="module")
def quick_compilation():
    """For modules whose pictures are so small that nearly all the time is compilation."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
