"""Recordings by URL: the same as from a file, from a copy that does not stay."""

import contextlib
import functools
import http.server
import io
import pickle
import sys
import tempfile
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path

import fsspec
import numpy as np
import pytest

from scsr_opt.camera import Recording, read_recording, write_recording
from scsr_opt.camera.remote import RemoteSource, file_name, shown_url
from scsr_opt.errors import InputError
from scsr_opt.sequences import Plan

NAMES = ["ramp.npz", "ramp.npy", "ramp.h5", "ramp_40x24.dat"]


@pytest.fixture(autouse=True)
def temporary(tmp_path, monkeypatch) -> Path:
    """The folder of temporary files, which the test has for itself."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


@pytest.fixture
def files(tmp_path) -> Path:
    """A folder with one recording in all formats, which is the content of `memory://` as well."""
    folder = tmp_path / "files"
    folder.mkdir()
    rate = np.linspace(0.0, 0.6, 40)
    charge = np.floor(np.arange(32)[:, None] * rate + 1e-9)
    spikes = np.broadcast_to(np.diff(charge, axis=0)[:, None, :], (31, 24, 40)).astype(np.uint8)
    memory = fsspec.filesystem("memory")
    for name in NAMES:
        write_recording(folder / name, Recording.from_array(spikes, white_rate=0.5))
        memory.pipe_file(f"/{name}", (folder / name).read_bytes())
    return folder


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    """A server of the files of a folder by HTTP; its address."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

        def do_GET(self):
            if "secret.npz" in self.path:
                self.send_error(403)
            else:
                super().do_GET()

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder))) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


@pytest.mark.parametrize("name", NAMES)
def test_recording_by_url_is_that_of_the_file(files, temporary, name):
    expected = read_recording(files / name)
    for url in (f"memory://{name}", f"file://{files}/{name}"):
        recording = read_recording(url)
        np.testing.assert_array_equal(recording.spikes, expected.spikes)
        assert (recording.name, recording.white_rate) == (expected.name, expected.white_rate)
        assert Plan.of(recording, range(0, 31, 10), scale=2).description == (
            Plan.of(expected, range(0, 31, 10), scale=2).description
        )
    del recording
    assert not list(temporary.iterdir())


def test_copy_stays_as_long_as_the_recording_and_its_parts(files, temporary):
    recording = read_recording("memory://ramp.npy")
    part = recording.crop(1, 2, 3, 4)
    expected = recording.spikes[:, 1:4, 2:6]
    assert len(list(temporary.iterdir())) == 1
    del recording
    np.testing.assert_array_equal(part.spikes, expected)
    del part
    assert not list(temporary.iterdir())


def test_file_of_this_machine_is_not_copied(files, temporary):
    recording = read_recording(f"file://{files}/ramp.npy")
    assert not isinstance(recording.source, RemoteSource) and not list(temporary.iterdir())


def test_settings_hold_for_urls(files):
    recording = read_recording("memory://ramp_40x24.dat", flip=False, white_rate=0.25)
    np.testing.assert_array_equal(recording.spikes, read_recording(files / "ramp_40x24.dat", flip=False).spikes)
    assert recording.white_rate == 0.25 and not recording.flipped


def test_another_process_uses_the_copy_or_makes_its_own(files, temporary):
    """As workers do on the same machine, and on another one."""
    recording = read_recording("memory://ramp.npy")
    expected, sent = recording.spikes, pickle.dumps(recording)
    same = pickle.loads(sent)
    np.testing.assert_array_equal(same.spikes, expected)
    assert len(list(temporary.iterdir())) == 1
    del recording  # and its copy
    np.testing.assert_array_equal(pickle.loads(sent).spikes, expected)
    np.testing.assert_array_equal(pickle.loads(sent).window(3, 9), expected[3:9])
    assert len(list(temporary.iterdir())) == 1


def test_another_process_refuses_what_was_replaced_or_removed(files):
    sent = [pickle.dumps(read_recording(f"memory://{name}")) for name in ("ramp.npy", "ramp.h5")]
    memory = fsspec.filesystem("memory")
    memory.pipe_file("/ramp.npy", (files / "ramp.npy").read_bytes() + b"more")
    memory.rm_file("/ramp.h5")
    with pytest.raises(InputError, match=r"memory://ramp.npy holds 29,892 bytes, but held 29,888 when it was opened"):
        pickle.loads(sent[0]).window(0, 1)
    with pytest.raises(InputError, match=r"There is no file memory://ramp.h5"):
        pickle.loads(sent[1]).window(0, 1)


def test_recording_in_an_archive_behind_a_url(files):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.write(files / "ramp.npy", "in/ramp.npy")
    fsspec.filesystem("memory").pipe_file("/all.zip", content.getvalue())
    recording = read_recording("zip://in/ramp.npy::memory://all.zip")
    np.testing.assert_array_equal(recording.spikes, np.load(files / "ramp.npy"))
    assert recording.name == "ramp"


def test_settings_of_other_recordings_are_not_taken(files, temporary):
    (temporary / "config.yaml").write_text("spike_w: 24\nspike_h: 40\n")
    fsspec.filesystem("memory").pipe_file("/ramp.dat", (files / "ramp_40x24.dat").read_bytes())
    with pytest.raises(InputError, match=r"The size of the frames in memory://ramp.dat is not known"):
        read_recording("memory://ramp.dat")


BAD = {
    "memory://none.npz": r"There is no file memory://none.npz: check the URL\.",
    "memory://ramp.txt": r"ends in '.txt', which is no known format",
    "memory://": r"ends in 'nothing'",
    "memory://folder.npz": r"memory://folder.npz is a folder, not a recording",
    "memory://empty.npz": r"memory://empty.npz is empty \(0 bytes\)",
    "memory://page.npz": r"memory://page.npz is a web page",
    "nothing://host/ramp.npz": r"nothing://host/ramp.npz cannot be fetched \(Protocol not known: nothing\)",
}


@pytest.mark.parametrize("url", BAD)
def test_bad_urls_are_refused_and_nothing_stays(temporary, url):
    memory = fsspec.filesystem("memory")
    memory.pipe_file("/empty.npz", b"")
    memory.pipe_file("/folder.npz/a.npz", b"")
    memory.pipe_file("/page.npz", b"<!DOCTYPE html>" * 9)
    with pytest.raises(InputError, match=BAD[url]) as caught:
        read_recording(url)
    assert "\n" not in str(caught.value) and str(temporary) not in str(caught.value).partition(": check")[0]
    assert not list(temporary.iterdir())


def test_full_disk_is_one_sentence(files, temporary, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(fsspec.get_filesystem_class("memory"), "get_file", full)
    with pytest.raises(InputError, match=r"cannot be fetched \(No space left on device\): .* variable TMPDIR"):
        read_recording("memory://ramp.npy")
    assert not list(temporary.iterdir())


def test_url_without_fsspec_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(InputError, match=r"needs the package fsspec, .* pip install 'scsr-opt\[sequence\]'"):
        read_recording("memory://ramp.npy")


def test_url_without_the_package_of_its_protocol_says_which(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(InputError, match=r"s3://bucket/ramp.npy needs a package .*s3fs.*: install it with pip"):
        read_recording("s3://bucket/ramp.npy")


def test_recordings_are_not_written_to_urls(files):
    with pytest.raises(InputError, match=r"memory://new.npz is a URL, but outputs and stores are files"):
        write_recording("memory://new.npz", read_recording(files / "ramp.npy"))


@pytest.mark.parametrize(
    ("url", "name"),
    [
        ("https://host/a/car_40x24.dat?signature=a/b.c#top", "car_40x24.dat"),
        ("https://host/two%20words.npz", "two words.npz"),
        ("https://host/%2F..%2Fa.npz", "a.npz"),
        ("s3://bucket/what?.npz", "what?.npz"),
        ("zip://in/a.npz::https://host/b.zip", "a.npz"),
        ("simplecache::s3://bucket/a.npz", "a.npz"),
        ("https://host", ""),
        ("https://[host/a.npz", "a.npz"),
    ],
)
def test_name_of_the_file_behind_a_url(url, name):
    assert file_name(url) == Path(name)


def test_secrets_of_a_url_are_not_shown():
    assert shown_url("https://me:word@host:80/a.npz?signature=1") == "https://host:80/a.npz"
    assert shown_url("ftp://me:word@host/a.npz") == "ftp://host/a.npz"
    assert shown_url("s3://bucket/what?.npz") == "s3://bucket/what?.npz"
    assert shown_url("zip://a@b.npz::https://me:word@host/b.zip?s=1#t") == "zip://a@b.npz::https://host/b.zip"
    assert shown_url("simplecache::s3://bucket/a.npz") == "simplecache::s3://bucket/a.npz"


@pytest.mark.filterwarnings("ignore::ResourceWarning")  # of aiohttp, when its loop ends with the process
def test_recording_by_http(files, temporary):
    pytest.importorskip("aiohttp")
    expected = np.load(files / "ramp.npy")
    with served(files) as address:
        for name in NAMES:
            np.testing.assert_array_equal(read_recording(f"{address}/{name}?signature=1").spikes, expected)
        with pytest.raises(InputError, match=rf"There is no file {address}/none.npz: check the URL"):
            read_recording(f"{address}/none.npz?signature=1")
        with pytest.raises(InputError, match=rf"{address}/secret.npz cannot be fetched \(403 Forbidden\)"):
            read_recording(f"{address}/secret.npz?signature=1")
    with pytest.raises(InputError, match=rf"{address}/ramp.npy cannot be fetched \(") as caught:
        read_recording(f"{address}/ramp.npy?signature=1")
    assert "signature" not in str(caught.value)
    assert not list(temporary.iterdir())
