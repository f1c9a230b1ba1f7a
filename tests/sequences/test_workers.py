"""Sequences by the workers of a Dask cluster, and what is said where it is lost."""

import subprocess
import sys
from contextlib import contextmanager

import pytest

from benchmarks.killing import Cluster, simulated
from scsr_opt import InputError
from scsr_opt.sequences import SequenceStore, Workers, write_sequence
from scsr_opt.sequences.cluster import _cluster

distributed = pytest.importorskip("distributed")
LoopRunner, sync = distributed.utils.LoopRunner, distributed.utils.sync
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::DeprecationWarning")


@pytest.fixture
def cluster():
    """A scheduler with two workers in threads of this process, so that they use the stand-in."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, protocol="tcp", dashboard_address=":0", memory_limit=0
    ) as started:
        yield started


def test_workers_of_a_scheduler_write_the_same_store(tmp_path, plan, stand_in, files, cluster):
    write_sequence(plan, tmp_path / "alone.zarr")
    dashboards = []
    workers = Workers(scheduler=cluster.scheduler_address, started=dashboards.append)
    done = write_sequence(plan, tmp_path / "a.zarr", workers=workers)
    assert done.there == 0 and not done.failed and dashboards[0].startswith("http://")
    assert files(tmp_path / "a.zarr") == files(tmp_path / "alone.zarr")


def test_workers_go_on_with_a_store(tmp_path, plan, stand_in, files, cluster):
    write_sequence(plan, tmp_path / "alone.zarr")
    stand_in.solved.clear()
    stand_in.stop_after, stand_in.error = 6, InputError("enough")
    workers = Workers(scheduler=cluster.scheduler_address)
    with pytest.raises(InputError, match="enough"):
        write_sequence(plan, tmp_path / "a.zarr", workers=workers)
    there = sum(one.status is not None for one in SequenceStore.open(tmp_path / "a.zarr").pictures())
    assert there < 10
    stand_in.stop_after = None
    # Workers of a scheduler outlive the run that failed: one may end a group in between.
    assert there <= write_sequence(plan, tmp_path / "a.zarr", workers=workers).there < 10
    assert files(tmp_path / "a.zarr") == files(tmp_path / "alone.zarr")


def test_a_scheduler_that_is_not_there_is_said(tmp_path, plan, stand_in, monkeypatch):
    monkeypatch.setattr("scsr_opt.sequences.cluster._PATIENCE", 1)
    with pytest.raises(InputError, match="No scheduler with workers answered at"):
        write_sequence(plan, tmp_path / "a.zarr", workers=Workers(scheduler="tcp://127.0.0.1:1"))
    assert stand_in.solved == []


@pytest.mark.parametrize("address", ["nonsense", "tcp://127.0.0.1:notaport", "", "http://x:3", "tcp://a:b:1"])
def test_workers_with_an_address_that_is_none_is_refused(address):
    with pytest.raises(InputError, match="which is no address: give one such as tcp://10.0.0.1:8786"):
        Workers(scheduler=address)


@pytest.mark.parametrize("address", ["tcp://127.0.0.1:8786", "tls://node-3.local:1", "tcp://[::1]:8786"])
def test_workers_with_an_address_takes_it(address):
    assert Workers(scheduler=address).scheduler == address


def test_a_scheduler_without_workers_is_said(tmp_path, plan, stand_in, monkeypatch):
    monkeypatch.setattr("scsr_opt.sequences.cluster._PATIENCE", 1)
    with distributed.LocalCluster(n_workers=0, processes=False, protocol="tcp", dashboard_address=":0") as empty:
        with pytest.raises(InputError, match="No scheduler with workers answered at tcp"):
            write_sequence(plan, tmp_path / "a.zarr", workers=Workers(scheduler=empty.scheduler_address))


@contextmanager
def worker_of(address):
    """A worker of a scheduler in a thread of this process, so that it uses the stand-in."""
    runner = LoopRunner(asynchronous=False)
    runner.start()

    async def begin():
        return await distributed.Worker(address, nthreads=1, memory_limit=0, dashboard=False)

    worker = sync(runner.loop, begin)
    try:
        yield
    finally:
        sync(runner.loop, worker.close)
        runner.stop()


def test_a_scheduler_that_is_killed_is_said_and_the_same_command_goes_on(tmp_path, plan, stand_in, files, monkeypatch):
    write_sequence(plan, tmp_path / "alone.zarr")
    stand_in.solved.clear()

    def killing(*given, **named):
        for solution in stand_in(*given, **named):
            if len(stand_in.solved) == 6:
                cluster.processes[0].kill()
            yield solution

    with Cluster(workers=0) as cluster:
        workers = Workers(scheduler=cluster.address)
        with monkeypatch.context() as patched, worker_of(cluster.address):
            patched.setattr("scsr_opt.sequences.run.reconstruct_sequence", killing)
            with pytest.raises(InputError, match="The scheduler was lost: give the command again"):
                write_sequence(plan, tmp_path / "a.zarr", workers=workers)
        cluster.processes[0].wait()
        cluster.mend()
        with worker_of(cluster.address):
            assert write_sequence(plan, tmp_path / "a.zarr", workers=workers).there in (4, 8, 10)  # whole groups
    assert files(tmp_path / "a.zarr") == files(tmp_path / "alone.zarr")


def test_a_connection_that_is_lost_while_results_come_is_said(tmp_path, plan, stand_in, cluster, monkeypatch):
    """A scheduler that is killed between the end of a group and its answer closes the connection."""

    def lost(*given):
        raise distributed.comm.CommClosedError("Connection reset by peer")

    monkeypatch.setattr("scsr_opt.sequences.cluster._result", lost)
    with pytest.raises(InputError, match="The scheduler was lost: give the command again"):
        write_sequence(plan, tmp_path / "a.zarr", workers=Workers(scheduler=cluster.scheduler_address))


def failing(times):
    """In the place of LocalCluster: as many starts in which a worker is lost, then one in this process."""
    calls = []

    def started(**given):
        calls.append(given)
        if len(calls) <= times:
            raise RuntimeError("Nanny failed to start.")
        return real(n_workers=0, processes=False, protocol="tcp", dashboard_address=":0")

    real = distributed.LocalCluster
    return started


@pytest.mark.parametrize("times", [1, 2])
def test_workers_that_are_lost_while_they_start_are_started_again(monkeypatch, times):
    monkeypatch.setattr(distributed, "LocalCluster", failing(times))
    with _cluster(2) as cluster:
        assert cluster.scheduler_address.startswith("tcp://")


def test_workers_that_never_start_are_said(tmp_path, plan, stand_in, monkeypatch):
    monkeypatch.setattr(distributed, "LocalCluster", failing(100))
    with pytest.raises(InputError, match="2 workers were started 3 times, and each time one of them ended at once"):
        write_sequence(plan, tmp_path / "a.zarr", workers=Workers(number=2))
    assert stand_in.solved == []


@pytest.mark.parametrize("given", [{}, {"number": 2, "scheduler": "tcp://a:1"}, {"number": 0}, {"number": -1}])
def test_workers_that_cannot_be_are_refused(given):
    with pytest.raises(InputError):
        Workers(**given)


def test_workers_without_dask_are_refused_in_a_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"need the package distributed.*pip install 'scsr-opt\[sequence\]'"):
        Workers(1)


_PROGRAM = """
import sys
from scsr_opt.cli import main
if __name__ == "__main__":
    sys.exit(main())
"""


@pytest.mark.slow  # each worker is a process that imports JAX
def test_one_to_ten_workers_write_identical_stores(tmp_path, files):
    """Of real solves, in ten groups; and so does one process without workers."""
    file = simulated(tmp_path / "object.npy", 61)
    script = tmp_path / "scsr.py"
    script.write_text(_PROGRAM)
    options = ["--start", "20", "--stop", "40", "--every", "2", "--group", "1", "--scale", "2", "--frames", "31"]
    stores = {}
    for workers in (None, 1, 2, 5, 10):
        store = tmp_path / f"{workers}.zarr"
        many = [] if workers is None else ["--workers", str(workers)]
        command = [sys.executable, str(script), "sequence", str(file), *options, *many, "-o", str(store), "--quiet"]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0 and done.stderr == "", done.stderr
        stores[workers] = files(store)
    assert all(store == stores[None] for store in stores.values())
