"""Files that are no recordings, are damaged, or are asked for what they do not hold: one sentence each."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from scsr_opt.camera.formats import read_recording, write_recording
from scsr_opt.errors import InputError


def _file(path: Path, content: bytes | bytearray = b"\0" * 100) -> Path:
    path.write_bytes(content)
    return path


def _npz(path: Path, *arrays, **named) -> Path:
    np.savez(path, *arrays, **named)
    return path


def _npy(path: Path, array) -> Path:
    np.save(path, array)
    return path


def _h5(path: Path, **named) -> Path:
    with h5py.File(path, "w") as file:
        for name, value in named.items():
            file[name] = value
    return path


def _config(folder: Path, text: str) -> Path:
    (folder / "config.yaml").write_text(text)
    return _file(folder / "r.dat")


SPIKES = (np.random.default_rng(0).random((12, 5, 7)) < 0.5).astype(np.uint8)

# What is done in an empty folder, and what is to be said of it.
MISTAKES = {
    "missing": (lambda f: read_recording(f / "no.dat"), r"There is no file .*no\.dat"),
    "folder": (lambda f: read_recording(_dir(f / "r.dat")), r"is a folder.*name one file in it"),
    "empty": (lambda f: read_recording(_file(f / "r_16x12.dat", b"")), r"is empty \(0 bytes\).*copy it again"),
    "ending": (lambda f: read_recording(_file(f / "r.mp4")), r"ends in '\.mp4', .*\.dat, \.npy, \.npz, \.h5, \.hdf5"),
    "no ending": (lambda f: read_recording(_file(f / "r")), r"ends in 'nothing'"),
    "no size": (lambda f: read_recording(_file(f / "r.dat")), r"size .* not known.*size='WIDTHxHEIGHT'.*config\.yaml"),
    "config without size": (lambda f: read_recording(_config(f, "spike_w: none\n")), r"size .* not known"),
    "two sizes": (lambda f: read_recording(_file(f / "r_16x12_8x8_32x24.dat")), r"holds 2 sizes \(16x12, 32x24\)"),
    "unreadable size": (lambda f: read_recording(_file(f / "r.dat"), size="big"), r"'big' cannot be read.*400x250"),
    "shorter than a frame": (
        lambda f: read_recording(_file(f / "r.dat"), size="400x250"),
        r"holds 100 bytes, which is less than one frame of 400x250 \(12,500 bytes each\): check the size",
    ),
    "size against the name": (
        lambda f: read_recording(_file(f / "r_16x12.dat", b"\0" * 240), size="16x11"),
        r"no whole number of frames of 16x11 \(22 bytes each\): size=16x12 would fit",
    ),
    "size against the usual": (
        lambda f: read_recording(_file(f / "r.dat", b"\0" * 25_000), size="401x250"),
        r"no whole number of frames of 401x250 .*: size=400x250 would fit",
    ),
    "row_bits that do not fit": (
        lambda f: read_recording(_file(f / "r.dat", b"\0" * 25_000), size="400x250", row_bits=416),
        r"no whole number of frames of 400x250 \(13,000 bytes each\): row_bits=400 would fit",
    ),
    "row_bits too few": (
        lambda f: read_recording(_file(f / "r.dat"), size="16x2", row_bits=8),
        r"row_bits=8 is less than the 16 columns",
    ),
    "row_bits elsewhere": (lambda f: read_recording(_npy(f / "r.npy", SPIKES), row_bits=8), r"only flat \.dat files"),
    "key elsewhere": (lambda f: read_recording(_npy(f / "r.npy", SPIKES), key="spk"), r"one array without a name"),
    "key missing in npz": (
        lambda f: read_recording(_npz(f / "r.npz", video=SPIKES, label=1)),
        r"no array 'spikes' or 'spk' or 'raw_spike' or 'arr_0', but video, label: say which",
    ),
    "wrong key": (lambda f: read_recording(_npz(f / "r.npz", a=SPIKES), key="b"), r"no array 'b', but a: say which"),
    "key missing in h5": (lambda f: read_recording(_h5(f / "r.h5", dsft=SPIKES)), r"no array 'raw_spike', but dsft"),
    "nothing in h5": (lambda f: read_recording(_h5(f / "r.h5")), r"no array 'raw_spike', but nothing at all"),
    "dimensions": (lambda f: read_recording(_npy(f / "r.npy", SPIKES[0])), r"r\.npy has 2 dimensions \(5, 7\)"),
    "dimensions in npz": (lambda f: read_recording(_npz(f / "r.npz", spk=SPIKES[0])), r"array 'spk', has 2 dimensions"),
    "dimensions in h5": (lambda f: read_recording(_h5(f / "r.h5", raw_spike=3)), r"'raw_spike', has 0 dimensions"),
    "intervals": (
        lambda f: read_recording(_h5(f / "r.h5", raw_spike=SPIKES * 9)),
        r"'raw_spike', holds values from 0 to 9.*spike intervals",
    ),
    "grey npy": (lambda f: read_recording(_npy(f / "r.npy", SPIKES * 255)), r"r\.npy holds values from 0 to 255"),
    "grey npz": (lambda f: read_recording(_npz(f / "r.npz", spk=SPIKES * 255)), r"'spk', holds values from 0 to 255"),
    "floats": (lambda f: read_recording(_npy(f / "r.npy", SPIKES * 1.0)), r"type float64.*bool or integer"),
    "objects": (lambda f: read_recording(_npy(f / "r.npy", np.array([None]))), r"no readable numpy array"),
    "order of arr_0": (
        lambda f: read_recording(_npz(f / "r.npz", np.zeros((3, 250, 400), bool))),
        r"'arr_0', has the shape \(3, 250, 400\), which is 3 frames of 400x250 .* or 400 frames of 250x3 .*: "
        r"pass size='400x250' or size='250x3'",
    ),
    "another size": (
        lambda f: read_recording(_npy(f / "r.npy", SPIKES), size="5x7"),
        r"r\.npy has 12 frames of 7x5, not of the given size 5x7: leave the size out",
    ),
    "no zip": (lambda f: read_recording(_file(f / "r.npz")), r"is no readable numpy archive"),
    "no npy": (lambda f: read_recording(_file(f / "r.npy")), r"is no readable numpy array"),
    "no h5": (lambda f: read_recording(_file(f / "r.h5")), r"is no readable HDF5 file"),
    "npy named npz": (
        lambda f: read_recording(_npy(f / "r.npy", SPIKES).rename(f / "r.npz")),
        r"a single array without a name.*\.npy file",
    ),
    "npz named npy": (
        lambda f: read_recording(_npz(f / "r.npz", SPIKES).rename(f / "r.npy")),
        r"holds named arrays.*\.npz file",
    ),
    "mask of another shape": (
        lambda f: read_recording(_npz(f / "r.npz", spk=SPIKES, bad_pixels=np.zeros((4, 7), bool))),
        r"bad_pixels has shape \(4, 7\), but the sensor has 5 rows and 7 columns",
    ),
    "missing mask": (
        lambda f: read_recording(_npz(f / "r.npz", spk=SPIKES), bad_pixels=f / "no.npy"),
        r"There is no file .*no\.npy with bad pixels",
    ),
    "damaged mask": (
        lambda f: read_recording(_npz(f / "r.npz", spk=SPIKES), bad_pixels=_file(f / "m.npy")),
        r"m\.npy is no readable numpy array",
    ),
    "white rate of the file": (
        lambda f: read_recording(_npz(f / "r.npz", spk=SPIKES, white_rate=-0.5)),
        r"white_rate is -0\.5, but it must be a number from 1e-06",
    ),
    "write: ending": (lambda f: write_recording(f / "r.mp4", SPIKES), r"ends in '\.mp4', .*choose one of \.dat, "),
    "write: flip elsewhere": (lambda f: write_recording(f / "r.npz", SPIKES, flip=True), r"only flat \.dat files have"),
    "write: folder": (lambda f: write_recording(_dir(f / "r.npz"), SPIKES), r"it is a folder; name a file in it"),
    "write: no folder": (lambda f: write_recording(f / "no" / "r.npz", SPIKES), r"folder .*no does not exist; make it"),
    "write: row_bits": (lambda f: write_recording(f / "r.dat", SPIKES, row_bits=6), r"row_bits=6 is less than the 7"),
    "write: name": (
        lambda f: write_recording(f / "r_400x250.dat", SPIKES),
        r"would be read back as frames of 400x250, .* but the recording is 7x5: put that into the name",
    ),
}  # fmt: skip


def _dir(path: Path) -> Path:
    path.mkdir()
    return path


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_said_in_one_sentence(tmp_path, mistake):
    call, message = MISTAKES[mistake]
    with pytest.raises(InputError, match=message) as caught:
        call(tmp_path)
    assert "\n" not in str(caught.value) and str(caught.value).endswith(".")


@pytest.mark.parametrize("ending", [".npy", ".npz", ".h5"])
def test_a_file_cut_anywhere_is_an_error_of_ours(tmp_path, ending):
    whole = write_recording(tmp_path / f"r{ending}", SPIKES).read_bytes()
    for length in range(0, len(whole), max(1, len(whole) // 60)):
        path = _file(tmp_path / f"cut{ending}", whole[:length])
        with pytest.raises(InputError):
            read_recording(path).window(0, 12)


@pytest.mark.parametrize("ending", [".npy", ".npz"])
@pytest.mark.parametrize("bits", [0x01, 0x20, 0xFF])
def test_a_damaged_byte_gives_no_other_error(tmp_path, ending, bits):
    whole = write_recording(tmp_path / f"r{ending}", SPIKES[:2]).read_bytes()
    refused = 0
    for position in range(0, len(whole), 4):
        content = bytearray(whole)
        content[position] ^= bits
        path = _file(tmp_path / f"damaged{ending}", content)
        try:
            read_recording(path).window(0, 1)
        except InputError:
            refused += 1
    assert refused > len(whole) // 16
