"""HDF5 files as others leave them: links, filters that are not installed, files that are open elsewhere."""

import subprocess
import sys

import h5py
import numpy as np
import pytest

from scsr_opt.camera.formats import read_recording
from scsr_opt.errors import InputError

SPIKES = (np.random.default_rng(0).random((12, 5, 7)) < 0.5).astype(np.uint8)


@pytest.mark.parametrize(
    ("target", "key"),
    [("data/spikes", None), ("/data/spikes", None), ("data/spikes", "raw_spike"), ("data/spikes", "data/spikes")],
)
def test_read_recording_soft_links_are_followed(tmp_path, target, key):
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["data/spikes"] = SPIKES
        file["raw_spike"] = h5py.SoftLink(target)
    recording = read_recording(tmp_path / "r.h5", key=key)
    np.testing.assert_array_equal(recording.window(2, 5), SPIKES[2:5])


@pytest.mark.parametrize("absolute", [True, False])
def test_read_recording_external_links_are_followed(tmp_path, absolute):
    (tmp_path / "sub").mkdir()
    with h5py.File(tmp_path / "sub" / "other.h5", "w") as file:
        file["data/spikes"] = SPIKES
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["raw_spike"] = h5py.ExternalLink(
            str(tmp_path / "sub" / "other.h5") if absolute else "sub/other.h5", "data/spikes"
        )
    np.testing.assert_array_equal(read_recording(tmp_path / "r.h5").spikes, SPIKES)


def test_read_recording_links_to_groups_are_followed_and_circles_end(tmp_path):
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["data/spikes"] = SPIKES
        file["data/again"] = h5py.SoftLink("/data")
        file["data/root"] = h5py.SoftLink("/")
        file["same"] = file["data"]
        file["link"] = h5py.SoftLink("/data")
    for key in ("data/spikes", "same/spikes", "link/spikes"):
        np.testing.assert_array_equal(read_recording(tmp_path / "r.h5", key=key).spikes, SPIKES)
    with pytest.raises(InputError, match=r"no array 'raw_spike', but data/spikes, link/spikes, same/spikes: say which"):
        read_recording(tmp_path / "r.h5")


@pytest.mark.parametrize(
    "link",
    [
        h5py.SoftLink("/nowhere"),
        h5py.ExternalLink("nowhere.h5", "/raw_spike"),
        h5py.ExternalLink("r.h5", "/nowhere"),
        h5py.SoftLink("/raw_spike"),
        h5py.ExternalLink("r.h5", "/raw_spike"),
    ],
)
def test_read_recording_links_that_lead_nowhere_are_said(tmp_path, link):
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["raw_spike"] = link
        file["other"] = SPIKES
    with pytest.raises(InputError, match="holds 'raw_spike' as a link that leads nowhere: there is no /"):
        read_recording(tmp_path / "r.h5")
    np.testing.assert_array_equal(read_recording(tmp_path / "r.h5", key="other").spikes, SPIKES)


def _filtered(path, code: int):
    """A file whose chunks say that they went through a filter that is not installed."""
    with h5py.File(path, "w") as file:
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_chunk(SPIKES.shape)
        plan.set_filter(code, h5py.h5z.FLAG_OPTIONAL, (0,))
        space = h5py.h5s.create_simple(SPIKES.shape)
        stored = h5py.h5d.create(file.id, b"raw_spike", h5py.h5t.NATIVE_UINT8, space, plan)
        stored.write_direct_chunk((0, 0, 0), SPIKES.tobytes(), filter_mask=0)
    return path


@pytest.mark.parametrize("code", [32001, 32004, 32008, 32015, 40000])
def test_read_recording_a_missing_filter_is_not_called_damaged(tmp_path, code):
    path = _filtered(tmp_path / "r.h5", code)
    message = "compressed with a filter that is not installed.*hdf5plugin.*h5repack"
    with pytest.raises(InputError, match=message) as caught:
        read_recording(path)
    assert "damaged" not in str(caught.value)


def test_read_recording_a_locked_file_is_not_called_damaged(tmp_path):
    path = tmp_path / "r.h5"
    with h5py.File(path, "w") as file:
        file["raw_spike"] = SPIKES
    code = "import sys, h5py; f = h5py.File(sys.argv[1], 'a'); print('open', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", code, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == "open\n"
        with pytest.raises(InputError, match="locked, another program has it open.*HDF5_USE_FILE_LOCKING") as caught:
            read_recording(path)
        assert other.stdin is not None
        other.stdin.close()
    assert "damaged" not in str(caught.value)
    np.testing.assert_array_equal(read_recording(path).spikes, SPIKES)


@pytest.mark.parametrize(("name", "place"), [("raw_spike", "raw_spike"), ("inside", "/"), ("raw_spike", "/raw_spike")])
def test_read_recording_an_external_link_into_a_locked_file_is_said(tmp_path, name, place):
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["raw_spike"] = SPIKES
    with h5py.File(tmp_path / "link.h5", "w") as file:
        file[name] = h5py.ExternalLink("r.h5", place)
    code = "import sys, h5py; f = h5py.File(sys.argv[1], 'a'); print('open', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path / "r.h5")], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == "open\n"
        for key in (None, "inside/raw_spike" if name == "inside" else name):
            with pytest.raises(InputError, match=r"r\.h5 is locked, another program has it open for writing"):
                read_recording(tmp_path / "link.h5", key=key)
        assert other.stdin is not None
        other.stdin.close()


def test_read_recording_an_external_link_into_another_kind_of_file_is_said(tmp_path):
    (tmp_path / "r.h5").write_bytes(b"no HDF5 at all")
    with h5py.File(tmp_path / "link.h5", "w") as file:
        file["raw_spike"] = h5py.ExternalLink("r.h5", "raw_spike")
    with pytest.raises(InputError, match=r"r\.h5 is no readable HDF5 file"):
        read_recording(tmp_path / "link.h5")


def test_read_recording_a_damaged_chunk_is_still_called_so(tmp_path):
    path = tmp_path / "r.h5"
    with h5py.File(path, "w") as file:
        stored = file.create_dataset("raw_spike", SPIKES.shape, np.uint8, chunks=SPIKES.shape, compression="gzip")
        stored.id.write_direct_chunk((0, 0, 0), b"no gzip at all")
    with pytest.raises(InputError, match="damaged"):
        read_recording(path)


@pytest.mark.parametrize("kept", [0.1, 0.3, 0.5, 0.99])
def test_read_recording_a_file_cut_short_is_called_damaged_not_locked(tmp_path, kept):
    path = tmp_path / "r.h5"
    with h5py.File(path, "w") as file:
        file["raw_spike"] = np.zeros((12, 50, 50), np.uint8)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    with pytest.raises(InputError, match="truncated.*damaged") as caught:
        read_recording(path)
    assert "is locked" not in str(caught.value)


def test_read_recording_a_file_that_was_not_closed_is_said(tmp_path):
    path = tmp_path / "r.h5"
    code = """if True:
        import os, sys, h5py
        f = h5py.File(sys.argv[1], "w", libver="latest")
        f["raw_spike"] = [[[1]]]
        f.swmr_mode = True
        f.flush()
        os._exit(0)
    """
    subprocess.run([sys.executable, "-c", code, str(path)], check=True)
    with pytest.raises(InputError, match="was not closed by the program that wrote it: .* run h5clear -s on it"):
        read_recording(path)


@pytest.mark.parametrize("missing", [[], ["a.h5"], ["b.h5"], ["a.h5", "b.h5"]])
def test_read_recording_a_virtual_dataset_needs_its_files(tmp_path, missing):
    layout = h5py.VirtualLayout(SPIKES.shape, np.uint8)
    for name, part in (("a.h5", slice(0, 6)), ("b.h5", slice(6, 12))):
        with h5py.File(tmp_path / name, "w") as file:
            file["s"] = SPIKES[part]
        layout[part] = h5py.VirtualSource(name, "s", shape=SPIKES[part].shape)
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file.create_virtual_dataset("raw_spike", layout)
    for name in missing:
        (tmp_path / name).unlink()
    if missing:
        with pytest.raises(InputError, match=f"'raw_spike' as a view of {missing[0]}, which is not there"):
            read_recording(tmp_path / "r.h5")
    else:
        np.testing.assert_array_equal(read_recording(tmp_path / "r.h5").spikes, SPIKES)


def test_read_recording_a_virtual_dataset_of_its_own_file_is_read(tmp_path):
    layout = h5py.VirtualLayout(SPIKES.shape, np.uint8)
    layout[:] = h5py.VirtualSource(".", "s", shape=SPIKES.shape)
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["s"] = SPIKES
        file.create_virtual_dataset("raw_spike", layout)
    np.testing.assert_array_equal(read_recording(tmp_path / "r.h5").spikes, SPIKES)


@pytest.mark.parametrize("ending", ["npy", "npz", "h5"])
@pytest.mark.parametrize("kind", [[("a", "i4")], "f4", "c8", "S3", "M8[s]"])
def test_read_recording_values_of_another_type_are_refused(tmp_path, ending, kind):
    path, array = tmp_path / f"r.{ending}", np.zeros((12, 5, 7), kind)
    if ending == "h5":
        if kind == "M8[s]":
            pytest.skip("HDF5 has no such type")
        with h5py.File(path, "w") as file:
            file["raw_spike"] = array
    elif ending == "npz":
        np.savez(path, spikes=array)
    else:
        np.save(path, array)
    with pytest.raises(InputError, match="holds values of type .*, but spikes are bool or integer"):
        read_recording(path)
