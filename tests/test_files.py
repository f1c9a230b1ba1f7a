import os
import stat

import pytest

from scsr_opt._files import check_writable, whole_file
from scsr_opt.errors import InputError


def test_whole_file_replaces_only_when_all_went_well(tmp_path):
    target = tmp_path / "picture.png"
    target.write_text("old")
    with pytest.raises(RuntimeError), whole_file(target) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert target.read_text() == "old"
    with whole_file(target) as temporary:
        assert temporary.suffix == ".png" and temporary.parent == tmp_path
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert os.listdir(tmp_path) == ["picture.png"]


def test_whole_file_has_the_permissions_of_any_new_file(tmp_path):
    with whole_file(tmp_path / "a.txt") as temporary:
        temporary.write_text("a")
    (tmp_path / "b.txt").write_text("b")
    modes = {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("a.txt", "b.txt")}
    assert len(modes) == 1


def test_whole_file_without_a_folder(tmp_path):
    with pytest.raises(InputError, match=r"Cannot write .*missing/a\.png: the folder .*missing does not exist"):
        with whole_file(tmp_path / "missing" / "a.png"):
            pass


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("", "it is a folder; name a file in it"),
        ("missing/a.png", "the folder .*missing does not exist; make it first"),
    ],
)
def test_check_writable_says_why_not(tmp_path, name, message):
    with pytest.raises(InputError, match=message):
        check_writable(tmp_path / name)


def test_check_writable_asks_the_file_system(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.touch", refuse)
    with pytest.raises(InputError, match="permission denied"):
        check_writable(tmp_path / "a.png")


def test_check_writable_leaves_nothing_behind(tmp_path):
    (tmp_path / "a.png").write_text("kept")
    check_writable(tmp_path / "a.png")
    assert os.listdir(tmp_path) == ["a.png"] and (tmp_path / "a.png").read_text() == "kept"
