"""What is made from a store: folders, arrays, films, all of the same pictures with one brightness."""

import csv
import os
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from scsr_opt import InputError
from scsr_opt.report import read_picture
from scsr_opt.sequences import Plan, SequenceFormat, SequenceStore, export, write_sequence
from scsr_opt.sequences.outputs import real_time

KEYS = list(range(3, 40, 4))


@pytest.fixture
def store(tmp_path, recording, stand_in) -> SequenceStore:
    """A store whose white is 0.8."""
    plan = Plan.of(recording, range(3, 40, 4), scale=2, group=4, bad_pixels=None, white=0.8)
    write_sequence(plan, tmp_path / "a.zarr")
    return SequenceStore.open(tmp_path / "a.zarr")


def stack(store: SequenceStore) -> np.ndarray:
    return np.stack([store.picture(number) for number in range(len(store.keys))])


def test_export_npz_holds_pictures_motion_and_times(tmp_path, store):
    export(store, tmp_path / "b.npz")
    with np.load(tmp_path / "b.npz") as stored:
        np.testing.assert_array_equal(stored["image"], stack(store))
        assert stored["image"].dtype == np.float32
        np.testing.assert_array_equal(stored["velocity"][4], store.motion(4)[0])
        np.testing.assert_array_equal(stored["confidence"][4], store.motion(4)[1])
        assert stored["key_frame"].tolist() == KEYS and stored["motion_from"].tolist()[:5] == [3, 3, 3, 3, 19]
        np.testing.assert_allclose(stored["seconds"], np.array(KEYS) / 40_000)
        assert stored["scale"] == 2 and stored["white"] == 0.8 and set(stored["status"]) == {"converged"}


def test_export_npy_can_be_mapped_and_has_a_table(tmp_path, store):
    export(store, tmp_path / "b.npy")
    np.testing.assert_array_equal(np.load(tmp_path / "b.npy", mmap_mode="r"), stack(store))
    with open(tmp_path / "b.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["key_frame"]) for row in rows] == KEYS and float(rows[1]["seconds"]) == 7 / 40_000


@pytest.mark.parametrize(("bits", "ending"), [(8, ".png"), (16, ".png"), (32, ".tif")])
def test_export_folder_has_constant_brightness(tmp_path, store, bits, ending):
    """Mean brightness as that of the stack, to 1/255 of white."""
    export(store, SequenceFormat.of(tmp_path / "b", bits=bits))
    names = sorted(os.listdir(tmp_path / "b" / "images"))
    assert names == [f"{key:06d}{ending}" for key in KEYS]
    with open(tmp_path / "b" / "times.csv", newline="") as file:
        assert [row["file"] for row in csv.DictReader(file)] == names
    white = 0.8 if bits == 8 else 1.0
    for name, image in zip(names, stack(store), strict=True):
        shown = white * read_picture(tmp_path / "b" / "images" / name)
        assert shown.mean() == pytest.approx(image.mean(), abs=1 / 255)
    assert sorted(os.listdir(tmp_path / "b")) == ["images", "times.csv"]


def test_export_gif_has_a_picture_for_each(tmp_path, store):
    export(store, SequenceFormat.of(tmp_path / "a.gif"))
    with Image.open(tmp_path / "a.gif") as film:
        assert film.info["duration"] == 200  # ten pictures in 2 s
    export(store, SequenceFormat.of(tmp_path / "b.gif", rate=10.0))
    with Image.open(tmp_path / "b.gif") as film:
        assert film.info["duration"] == 100
        assert film.n_frames == 10  # pyright: ignore[reportAttributeAccessIssue]
        film.seek(9)
        assert np.asarray(film.convert("L")).mean() == pytest.approx(255 / 0.8 * store.picture(9).mean(), abs=1)


def test_export_mp4_has_a_picture_for_each(tmp_path, store):
    """By the encoder that the package brings."""
    from imageio_ffmpeg import count_frames_and_secs

    export(store, SequenceFormat.of(tmp_path / "b.mp4", rate=10.0))
    frames, seconds = count_frames_and_secs(str(tmp_path / "b.mp4"))
    assert frames == 10 and seconds == pytest.approx(1.0)


def test_outputs_other_than_a_store_leave_no_store(tmp_path, plan, stand_in):
    done = write_sequence(plan, tmp_path / "b.npz")
    assert done.path == tmp_path / "b.npz" and sorted(os.listdir(tmp_path)) == ["b.npz", "noise.npy"]


@pytest.mark.parametrize("chunk", ["image/c/5/0/0", "confidence/c/5/0/0", "motion_from/c/1", "status/c/1"])
def test_export_of_a_store_with_a_lost_chunk_is_refused(tmp_path, store, chunk):
    """zarr reads NaN, or another value for what is not there."""
    (tmp_path / "a.zarr" / chunk).unlink()
    with pytest.raises(InputError, match=r"is not complete: [14] of its 10 pictures are missing, the first is frame"):
        export(store, tmp_path / "b.npz")
    assert not (tmp_path / "b.npz").exists()


@pytest.mark.parametrize("output", ["a.zarr/images", "a.zarr/image/b.npz"])
def test_export_into_a_store_is_refused(tmp_path, store, files, output):
    """Other programs could not read that store any more."""
    before = files(tmp_path / "a.zarr")
    with pytest.raises(InputError, match=r"is in the store .*a\.zarr: give a name outside of it"):
        export(store, tmp_path / output, overwrite=True)
    assert files(tmp_path / "a.zarr") == before


@pytest.mark.parametrize("output", ["b", "b.npz", "b.gif"])
def test_a_store_of_a_like_name_stays(tmp_path, plan, stand_in, output):
    """The store b.zarr is not what the folder b is made from, and removed with."""
    write_sequence(plan, tmp_path / f"{output}.zarr")
    write_sequence(plan, tmp_path / output)
    assert sorted(os.listdir(tmp_path)) == sorted([output, f"{output}.zarr", "noise.npy"])
    assert SequenceStore.open(tmp_path / f"{output}.zarr").picture(0).max() > 0


def test_an_output_that_was_interrupted_goes_on_from_its_store(tmp_path, plan, stand_in):
    stand_in.stop_after = 6
    with pytest.raises(KeyboardInterrupt):
        write_sequence(plan, tmp_path / "b.gif")
    assert sorted(os.listdir(tmp_path)) == ["b.gif.unfinished.zarr", "noise.npy"]
    stand_in.stop_after = None
    assert write_sequence(plan, tmp_path / "b.gif").there == 4
    assert sorted(os.listdir(tmp_path)) == ["b.gif", "noise.npy"]


OUTPUTS = ["b.npz", "b.npy", "b", "b.gif"]


@pytest.mark.parametrize("output", OUTPUTS)
def test_a_kill_before_the_store_is_removed_is_gone_on_from(tmp_path, plan, stand_in, monkeypatch, files, output):
    """The output is there, and its store proves that it is of this plan. Of a .npy, the table may be missing."""
    (tmp_path / "whole").mkdir()
    write_sequence(plan, tmp_path / "whole" / output)
    (tmp_path / "killed").mkdir()
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr("scsr_opt.sequences.run.remove", killed)
        write_sequence(plan, tmp_path / "killed" / output)
    assert {output, f"{output}.unfinished.zarr"} <= set(os.listdir(tmp_path / "killed"))
    (tmp_path / "killed" / "b.csv").unlink(missing_ok=True)
    stand_in.solved.clear()
    assert write_sequence(plan, tmp_path / "killed" / output).there == 10 and stand_in.solved == []
    if output == "b.npz":  # the archive holds the time at which it was written
        assert arrays(tmp_path / "killed" / output) == arrays(tmp_path / "whole" / output)
        assert os.listdir(tmp_path / "killed") == [output]
    else:
        assert files(tmp_path / "killed") == files(tmp_path / "whole")


def killed(*_) -> None:
    raise KeyboardInterrupt


def arrays(path) -> dict[str, bytes]:
    with np.load(path) as stored:
        return {name: stored[name].tobytes() for name in stored.files}


def test_an_output_that_another_run_wrote_is_not_replaced(tmp_path, recording, plan, stand_in, monkeypatch):
    """Neither where the unfinished store had not begun to write one, nor where it is of another plan."""
    stand_in.stop_after = 6
    with pytest.raises(KeyboardInterrupt):
        write_sequence(plan, tmp_path / "b.gif")
    (tmp_path / "b.gif").write_text("holiday")
    stand_in.stop_after = None
    with pytest.raises(InputError, match=r"b\.gif is there already: give --overwrite"):
        write_sequence(plan, tmp_path / "b.gif")
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr("scsr_opt.sequences.run.remove", killed)
        write_sequence(plan, tmp_path / "c.gif")
    (tmp_path / "c.gif").write_text("holiday")
    other = Plan.of(recording, range(3, 40, 4), scale=1, group=4, bad_pixels=None, frames=11)
    with pytest.raises(InputError, match="holds another sequence"):
        write_sequence(other, tmp_path / "c.gif")
    assert (tmp_path / "b.gif").read_text() == (tmp_path / "c.gif").read_text() == "holiday"


@pytest.mark.parametrize("output", OUTPUTS)
def test_a_full_disk_leaves_the_store_and_nothing_else(tmp_path, plan, stand_in, monkeypatch, output):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched, pytest.raises(InputError, match="no space left on device"):
        patched.setattr("scsr_opt.sequences.outputs._write_array", full)
        patched.setattr("scsr_opt.sequences.outputs._write_table", full)
        patched.setattr("scsr_opt.report.pictures._write_gif", full)
        write_sequence(plan, tmp_path / output)
    assert sorted(os.listdir(tmp_path)) == sorted([f"{output}.unfinished.zarr", "noise.npy"])
    assert write_sequence(plan, tmp_path / output).there == 10


def test_a_plan_with_another_white_is_another_sequence_but_an_export_may_have_its_own(tmp_path, store):
    export(store, SequenceFormat.of(tmp_path / "b.gif", white=0.4))
    with Image.open(tmp_path / "b.gif") as film:
        assert np.asarray(film.convert("L")).mean() == pytest.approx(255 / 0.4 * store.picture(0).mean(), abs=1)
    assert replace(SequenceFormat.of("b.gif"), white=0.4).store.name == "b.gif.unfinished.zarr"


@pytest.mark.parametrize(
    ("every", "rate", "words"),
    [(1, 1.0, "25 µs"), (10, 25.0, "6.25 ms"), (40_000, 25.0, "25 s"), (1, 0.01, "250 ns")],
)
def test_real_time_of_a_film(every, rate, words):
    assert real_time(40_000.0, every, rate) == f"1 s of the film is {words} of the recording."


@pytest.mark.parametrize("name", ["images/holiday.jpg", "images/000003.jpg", "notes.txt", "images/000003/000003.png"])
def test_folder_with_a_users_file_is_not_replaced(tmp_path, plan, stand_in, name):
    write_sequence(plan, tmp_path / "a.zarr")
    file = tmp_path / "made" / name
    file.parent.mkdir(parents=True)
    file.write_text("mine")
    with pytest.raises(InputError, match="is a folder with a file .*, which is not of a sequence: give another name"):
        export(tmp_path / "a.zarr", tmp_path / "made", overwrite=True)
    assert file.read_text() == "mine"


def test_folder_through_a_link_is_replaced_where_the_link_leads(tmp_path, plan, stand_in):
    write_sequence(plan, tmp_path / "a.zarr")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "made").symlink_to(tmp_path / "elsewhere")
    for _ in range(2):
        export(tmp_path / "a.zarr", tmp_path / "made", overwrite=True)
    assert (tmp_path / "made").is_symlink() and len(list((tmp_path / "elsewhere" / "images").iterdir())) == 10


@pytest.mark.parametrize(
    ("rate", "stored"), [(1000.0, 100), (60.0, 50), (40.0, 50), (30.0, 100 / 3), (25.0, 25), (0.5, 0.5)]
)
def test_film_rate_of_a_gif_is_the_one_it_is_shown_with(tmp_path, plan, stand_in, rate, stored):
    chosen = SequenceFormat.of(tmp_path / "a.gif", rate=rate)
    assert chosen.film_rate(10) == pytest.approx(stored)
    assert SequenceFormat.of(tmp_path / "a.mp4", rate=rate).film_rate(10) == rate
    write_sequence(plan, tmp_path / "a.zarr")
    export(tmp_path / "a.zarr", chosen)
    with Image.open(tmp_path / "a.gif") as film:
        assert film.info["duration"] == pytest.approx(1000 / stored)


def test_npz_holds_bad_pixels_of_each_picture(tmp_path, plan, stand_in):
    write_sequence(plan, tmp_path / "a.zarr")
    export(tmp_path / "a.zarr", tmp_path / "a.npz")
    store = SequenceStore.open(tmp_path / "a.zarr")
    with np.load(tmp_path / "a.npz") as arrays:
        assert arrays["bad_pixels"].dtype == np.uint8
        for number in (0, 5):
            np.testing.assert_array_equal(arrays["bad_pixels"][number], store.bad_pixels(number).kind)
