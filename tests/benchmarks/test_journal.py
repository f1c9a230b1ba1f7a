"""What a benchmark keeps of a run that is stopped: whole parts of the same request, and nothing else."""

import pytest

from benchmarks.journal import Journal

ASKED = {"commit": "0123456789ab", "seed": 0, "only": ["a"], "size": {"frames": (1, 2)}}


def stopped(path, asked, *, cut=0):
    """A run killed after two parts, `cut` bytes before the end of the second record."""
    with pytest.raises(KeyboardInterrupt), Journal(path, asked) as journal:
        journal.add("a", [1, 2])
        journal.add("b", {"c": float("nan")})
        raise KeyboardInterrupt
    if cut:
        path.write_bytes(path.read_bytes()[:-cut])


def test_the_same_request_goes_on(tmp_path):
    path = tmp_path / "kept"
    stopped(path, ASKED)
    with Journal(path, dict(ASKED)) as journal:
        assert list(journal.found) == ["a", "b"] and journal.found["a"] == [1, 2]
        journal.add("c", 3)
    assert not path.exists()


@pytest.mark.parametrize("cut", range(1, 30, 4))
def test_a_record_that_was_cut_off_is_made_again(tmp_path, cut):
    path = tmp_path / "kept"
    stopped(path, ASKED, cut=cut)
    with pytest.raises(KeyboardInterrupt), Journal(path, ASKED) as journal:
        assert list(journal.found) == ["a"]
        journal.add("b", "anew")
        raise KeyboardInterrupt
    assert Journal(path, ASKED).found == {"a": [1, 2], "b": "anew"}


@pytest.mark.parametrize(
    "asked", [{**ASKED, "seed": 1}, {**ASKED, "commit": "0123456789ab-dirty"}, {**ASKED, "commit": None}]
)
def test_another_request_begins_anew(tmp_path, asked):
    path = tmp_path / "kept"
    stopped(path, ASKED)
    assert Journal(path, asked).found == {}


def test_changes_on_top_of_a_commit_are_not_gone_on_from(tmp_path):
    dirty = {**ASKED, "commit": "0123456789ab-dirty"}
    stopped(tmp_path / "kept", dirty)
    assert Journal(tmp_path / "kept", dirty).found == {}


def test_without_a_file_it_only_remembers():
    with Journal(None, ASKED) as journal:
        journal.add("a", 1)
    assert journal.found == {"a": 1}


def test_a_file_of_something_else_is_begun_anew(tmp_path):
    (tmp_path / "kept").write_bytes(b"not a journal")
    assert Journal(tmp_path / "kept", ASKED).found == {}
