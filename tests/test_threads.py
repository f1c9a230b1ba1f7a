"""How many threads there are."""

import os

import pytest

from scsr_opt._threads import cores


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system does not hold a process to some cores")
def test_cores_are_those_on_which_the_process_may_run(monkeypatch):
    monkeypatch.delenv("NPROC", raising=False)
    allowed = os.sched_getaffinity(0)
    assert cores() == len(allowed)
    try:
        os.sched_setaffinity(0, {min(allowed)})
        assert cores() == 1
    finally:
        os.sched_setaffinity(0, allowed)


@pytest.mark.parametrize("number", ["", "0", "-1", "many"])
def test_nproc_that_is_no_number_of_cores_does_not_count(monkeypatch, number):
    monkeypatch.delenv("NPROC", raising=False)
    usual = cores()
    monkeypatch.setenv("NPROC", number)
    assert cores() == usual


def test_nproc_is_the_number_of_cores(monkeypatch):
    monkeypatch.setenv("NPROC", "3")
    assert cores() == 3
