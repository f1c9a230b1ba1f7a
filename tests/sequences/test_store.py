"""Stores of sequences: what is in them, going on where a run ended, and what is refused."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scsr_opt import InputError, Options, Recording, Status
from scsr_opt.calibration.bad_pixels import BadPixels
from scsr_opt.camera.white import White
from scsr_opt.motion import Global, Motion, Still
from scsr_opt.priors import HuberTotalVariation
from scsr_opt.sequences import Plan, SequenceStore, write_sequence
from scsr_opt.sequences.files import held
from scsr_opt.sequences.plan import described, differences, versions

KEYS = range(3, 40, 4)  # of the fixture `plan`
GROUPS = [range(0, 4), range(4, 8), range(8, 10)]


def test_store_holds_pictures_motion_and_what_is_known_of_them(tmp_path, plan, stand_in):
    done = write_sequence(plan, tmp_path / "a.zarr")
    assert done.there == 0 and not done.failed and done.estimated == [3, 19, 35]
    store = SequenceStore.open(tmp_path / "a.zarr")
    assert store.keys == KEYS and store.scale == 2 and store.shape == (10, 16, 24)
    expected = list(stand_in(plan.recording, list(KEYS)[4:8], scale=2, options=plan.options))
    for number, solution in enumerate(expected, 4):
        np.testing.assert_array_equal(store.picture(number), solution.image)
        velocity, confidence = store.motion(number)
        np.testing.assert_array_equal(velocity, solution.velocity)
        np.testing.assert_array_equal(confidence, solution.confidence)
        assert store.bad_pixels(number).numbers == {**BadPixels.none((8, 12)).numbers, "given": 1}
        np.testing.assert_array_equal(store.bad_pixels(number).kind, solution.bad_pixels.kind)
    known = store.pictures()[5]
    assert known.key == 23 and known.seconds == pytest.approx(23 / 40_000) and known.motion_from == 19
    assert known.status is Status.converged


def test_store_opens_in_zarr_and_xarray(tmp_path, plan, stand_in):
    import xarray
    import zarr

    write_sequence(plan, tmp_path / "a.zarr")
    group = zarr.open_group(tmp_path / "a.zarr", mode="r")
    image = group["image"]
    assert isinstance(image, zarr.Array) and image.chunks == (1, 16, 24) and image.metadata.zarr_format == 3
    assert {name for name, _ in group.members()} >= {"velocity", "confidence", "key_frame", "status", "motion_from"}
    with xarray.open_zarr(tmp_path / "a.zarr", consolidated=False) as opened:
        picture = opened["image"].sel(t=23 / 40_000, method="nearest")
        assert int(opened["key_frame"].sel(t=23 / 40_000, method="nearest")) == 23
        np.testing.assert_array_equal(picture, SequenceStore.open(tmp_path / "a.zarr").picture(5))
        assert picture.dims == ("y", "x")


def test_store_places_pixels_in_seconds_and_sensor_pixels(tmp_path, recording, stand_in):
    """Of OME-Zarr 0.5; the centre of a sensor pixel is a whole number, also with a crop."""
    plan = Plan.of(recording, range(10, 50, 20), scale=4, crop=(2, 3, 4, 6), bad_pixels=None, white=0.7)
    write_sequence(plan, tmp_path / "a.zarr")
    attributes = json.loads((tmp_path / "a.zarr" / "zarr.json").read_text())["attributes"]["ome"]
    assert attributes["version"] == "0.5"
    (scales,) = attributes["multiscales"]
    assert [(axis["name"], axis["type"]) for axis in scales["axes"]] == [("t", "time"), ("y", "space"), ("x", "space")]
    assert scales["axes"][0]["unit"] == "second"
    (dataset,) = scales["datasets"]
    scale, translation = dataset["coordinateTransformations"]
    assert dataset["path"] == "image"
    assert scale == {"type": "scale", "scale": [20 / 40_000, 0.25, 0.25]}
    # The first four pixels of a row share a sensor pixel, whose centre is in their middle.
    assert translation == {"type": "translation", "translation": [10 / 40_000, 2 - 0.375, 3 - 0.375]}
    (channel,) = attributes["omero"]["channels"]
    assert channel["window"] == {"min": 0.0, "max": 1.0, "start": 0.0, "end": 0.7}
    opened = SequenceStore.open(tmp_path / "a.zarr")
    np.testing.assert_allclose(np.mean(opened._read("x", slice(4))), 3)
    np.testing.assert_allclose(opened._read("t", slice(None)), [10 / 40_000, 30 / 40_000])


@pytest.mark.parametrize("stop_after", [0, 1, 3, 4, 6, 9])
def test_a_run_that_was_ended_goes_on_to_the_same_bits(tmp_path, plan, stand_in, files, stop_after):
    """Only groups that were not finished are solved again, from their beginning."""
    write_sequence(plan, tmp_path / "whole.zarr")
    stand_in.solved.clear()
    stand_in.stop_after = stop_after
    with pytest.raises(KeyboardInterrupt):
        write_sequence(plan, tmp_path / "a.zarr")
    assert (
        sum(one.status is not None for one in SequenceStore.open(tmp_path / "a.zarr").pictures()) == stop_after // 4 * 4
    )
    stand_in.solved.clear()
    stand_in.stop_after = None
    done = write_sequence(plan, tmp_path / "a.zarr")
    assert done.there == stop_after // 4 * 4 and stand_in.solved == list(KEYS)[done.there :]
    assert files(tmp_path / "a.zarr") == files(tmp_path / "whole.zarr")
    assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]


def test_a_store_that_is_whole_is_left_as_it_is(tmp_path, plan, stand_in, files):
    write_sequence(plan, tmp_path / "a.zarr")
    before = {name: os.stat(tmp_path / "a.zarr" / name).st_mtime_ns for name in files(tmp_path / "a.zarr")}
    stand_in.solved.clear()
    assert write_sequence(plan, tmp_path / "a.zarr", overwrite=True).there == 10
    assert stand_in.solved == []
    assert before == {name: os.stat(tmp_path / "a.zarr" / name).st_mtime_ns for name in files(tmp_path / "a.zarr")}


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("chunk", "damage"),
    [
        ("image/c/5/0/0", flip),
        ("image/c/5/0/0", lambda path: path.write_bytes(path.read_bytes()[:10])),
        ("image/c/5/0/0", lambda path: path.write_bytes(b"")),
        ("image/c/5/0/0", Path.unlink),
        ("velocity/c/6/0/0/0", flip),
        ("velocity/c/6/0/0/0", Path.unlink),
        ("confidence/c/7/0/0", flip),
        ("confidence/c/7/0/0", Path.unlink),
        ("status/c/1", flip),
        ("status/c/1", Path.unlink),
        ("iterations/c/1", flip),
        ("iterations/c/1", Path.unlink),
        ("motion_from/c/1", Path.unlink),
        ("strength/c/1", Path.unlink),
    ],
)
def test_a_damaged_chunk_is_found_and_its_group_solved_again(tmp_path, plan, stand_in, files, chunk, damage):
    write_sequence(plan, tmp_path / "a.zarr")
    whole = files(tmp_path / "a.zarr")
    damage(tmp_path / "a.zarr" / chunk)
    stand_in.solved.clear()
    assert write_sequence(plan, tmp_path / "a.zarr").there == 6
    assert stand_in.solved == list(KEYS)[4:8]
    assert files(tmp_path / "a.zarr") == whole


@pytest.mark.parametrize("name", ["status", "strength"])
def test_a_damaged_chunk_of_the_last_group_is_found(tmp_path, plan, stand_in, files, name):
    """That group is smaller than a chunk."""
    write_sequence(plan, tmp_path / "a.zarr")
    whole = files(tmp_path / "a.zarr")
    flip(tmp_path / "a.zarr" / name / "c" / "2")
    assert write_sequence(plan, tmp_path / "a.zarr").there == 8
    assert files(tmp_path / "a.zarr") == whole


@pytest.mark.parametrize("damage", [flip, Path.unlink, lambda path: path.write_bytes(b"")])
@pytest.mark.parametrize("chunk", ["t/c/0", "y/c/0", "x/c/0", "key_frame/c/0"])
def test_a_damaged_array_of_no_picture_is_mended(tmp_path, recording, stand_in, files, chunk, damage):
    plan = Plan.of(recording, range(3, 20, 4), scale=1, group=4)
    write_sequence(plan, tmp_path / "a.zarr")
    whole = files(tmp_path / "a.zarr")
    damage(tmp_path / "a.zarr" / chunk)
    assert write_sequence(plan, tmp_path / "a.zarr").there == 5
    assert files(tmp_path / "a.zarr") == whole


def test_a_lost_chunk_is_found_where_nothing_is_known(tmp_path, plan, stand_in, monkeypatch, files):
    """Of motion that was not estimated there are chunks, too."""

    def without_motion(*arguments, **options):
        return (replace(one, motion=None) for one in stand_in(*arguments, **options))

    monkeypatch.setattr("scsr_opt.sequences.run.reconstruct_sequence", without_motion)
    write_sequence(plan, tmp_path / "a.zarr")
    whole = files(tmp_path / "a.zarr")
    assert np.isnan(SequenceStore.open(tmp_path / "a.zarr").motion(6)[0]).all()
    assert write_sequence(plan, tmp_path / "a.zarr").there == 10
    (tmp_path / "a.zarr" / "velocity" / "c" / "6" / "0" / "0" / "0").unlink()
    assert write_sequence(plan, tmp_path / "a.zarr").there == 6
    assert files(tmp_path / "a.zarr") == whole


def test_chunks_that_were_half_written_are_removed(tmp_path, plan, stand_in, files):
    """Those that zarr writes before it renames them."""
    write_sequence(plan, tmp_path / "a.zarr")
    whole = files(tmp_path / "a.zarr")
    (tmp_path / "a.zarr" / "image" / "c" / "3" / "0" / "0.123abc.partial").write_bytes(b"half")
    write_sequence(plan, tmp_path / "a.zarr")
    assert files(tmp_path / "a.zarr") == whole


def test_a_creation_that_was_ended_leaves_nothing(tmp_path, plan, stand_in, monkeypatch):
    """Its folder has another name until it is whole."""

    def half(path, *_):
        path.mkdir()
        (path / "zarr.json").write_text("{")
        raise KeyboardInterrupt

    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr("scsr_opt.sequences.store.lay_out", half)
        write_sequence(plan, tmp_path / "a.zarr")
    assert not (tmp_path / "a.zarr").exists()
    write_sequence(plan, tmp_path / "a.zarr")
    assert not [name for name in os.listdir(tmp_path) if name.startswith(".")]


def other_plan(recording: Recording, which: str) -> tuple[Plan, str]:
    """A plan that is not the fixture's, and what is said of the first difference."""
    spikes, near = recording.spikes.copy(), recording.spikes.copy()
    spikes[23, 0, 0] ^= 1  # of a key frame
    near[41, 0, 0] ^= 1  # of a frame that is none, but the pictures before use it
    usual = {"scale": 2, "group": 4, "bad_pixels": None, "frames": 11}

    def made(keys=KEYS, source=recording, **others) -> Plan:
        return Plan.of(source, keys, **{**usual, **others})

    plans: dict[str, tuple[Callable[[], Plan], str]] = {
        "scale": (lambda: made(scale=3), "scale is 2 there and 3 here"),
        "start": (lambda: made(range(7, 40, 4)), "the first key frame is 3 there and 7 here"),
        "stop": (lambda: made(range(3, 36, 4)), "the last key frame is 39 there and 35 here"),
        "every": (lambda: made(range(3, 40, 2)), "one key frame to the next is 4 there and 2 here"),
        "group": (lambda: made(group=5), "group is 4 there and 5 here"),
        "white": (lambda: made(white=0.5), "white is None there and 0.5 here"),
        "frames": (lambda: made(frames=13), "frames is 11 there and 13 here"),
        "strength": (lambda: made(strength=0.1), "strength is None there and 0.1 here"),
        "motion": (lambda: made(motion=Still()), "motion is None there and Still here"),
        "setting": (
            lambda: made(prior=HuberTotalVariation()),
            "prior is RidgeRegulariser there and Huber",
        ),
        "bad pixels": (lambda: made(bad_pixels="auto"), "bad_pixels is None there and 'auto' here"),
        "gain": (lambda: made(gain=np.ones((8, 12))), "gain is 'auto' there and 'float"),
        "spikes": (lambda: made(source=Recording.from_array(spikes)), "it is of another recording"),
        "near": (lambda: made(source=Recording.from_array(near)), "it is of another recording"),
        "rate": (lambda: made(source=replace(recording, white_rate=0.5)), "white_rate is 0.6 there and 0.5 here"),
        "length": (lambda: made(source=Recording.from_array(recording.spikes[:50])), "shape is [61, 8, 12] there"),
    }
    make, message = plans[which]
    return make(), message


@pytest.mark.parametrize(
    "which",
    [
        "scale", "start", "stop", "every", "group", "white", "frames", "strength", "motion", "setting", "bad pixels",
        "gain", "spikes", "near", "rate", "length",
    ],
)  # fmt: skip
def test_a_store_of_another_plan_is_refused_and_kept(tmp_path, recording, plan, stand_in, files, which):
    write_sequence(plan, tmp_path / "a.zarr")
    whole = files(tmp_path / "a.zarr")
    other, message = other_plan(recording, which)
    with pytest.raises(InputError) as refused:
        write_sequence(other, tmp_path / "a.zarr")
    assert "a.zarr holds another sequence: " in str(refused.value) and message in str(refused.value)
    assert files(tmp_path / "a.zarr") == whole


def test_a_store_of_another_version_is_refused(tmp_path, plan, stand_in, monkeypatch):
    write_sequence(plan, tmp_path / "a.zarr")
    monkeypatch.setattr("scsr_opt.sequences.store.versions", lambda: versions() | {"jax": "9.9.9"})
    with pytest.raises(InputError, match="jax is '[0-9.]+' there and '9.9.9' here"):
        write_sequence(plan, tmp_path / "a.zarr")


def test_overwrite_replaces_a_store_of_another_plan(tmp_path, recording, plan, stand_in, files):
    write_sequence(plan, tmp_path / "whole.zarr")
    write_sequence(other_plan(recording, "scale")[0], tmp_path / "a.zarr")
    write_sequence(plan, tmp_path / "a.zarr", overwrite=True)
    assert files(tmp_path / "a.zarr") == files(tmp_path / "whole.zarr")


def test_the_same_recording_from_another_file_goes_on(tmp_path, recording, plan, stand_in):
    """What counts is its spikes, not where they lie."""
    write_sequence(plan, tmp_path / "a.zarr")
    other = replace(plan, recording=Recording.from_array(recording.spikes, name="copy"))
    assert write_sequence(other, tmp_path / "a.zarr").there == 10


def test_a_second_run_is_refused_until_the_first_one_ends(tmp_path, plan, stand_in):
    with held(tmp_path / "a.zarr"), pytest.raises(InputError, match="being written by another run"):
        write_sequence(plan, tmp_path / "a.zarr")
    assert not (tmp_path / "a.zarr").exists()
    write_sequence(plan, tmp_path / "a.zarr")


def test_a_killed_process_holds_no_lock(tmp_path):
    program = (
        "import sys, time\nfrom pathlib import Path\nfrom scsr_opt.sequences.files import held\n"
        "with held(Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", program, str(tmp_path / "a.zarr")], stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdout.readline() == b"held\n"
    with pytest.raises(InputError, match="being written"), held(tmp_path / "a.zarr"):
        pass
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    with held(tmp_path / "a.zarr"):
        assert os.listdir(tmp_path) == [".a.zarr.lock"]
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("writes", [0, 3, 13])
def test_a_full_disk_is_said_and_loses_nothing(tmp_path, plan, stand_in, files, monkeypatch, writes):
    write_sequence(plan, tmp_path / "whole.zarr")
    from zarr.storage import _local

    put, done = _local._put, []

    def full(path, value, exclusive=False):
        if path.name[0].isdigit() and "image" in str(path):
            done.append(path)
            if len(done) > writes:
                raise OSError(28, "No space left on device")
        return put(path, value, exclusive)

    with monkeypatch.context() as patched:
        patched.setattr(_local, "_put", full)
        if writes < 10:
            with pytest.raises(InputError, match=r"Cannot write .*a\.zarr: no space left on device; what is"):
                write_sequence(plan, tmp_path / "a.zarr")
    write_sequence(plan, tmp_path / "a.zarr")
    assert files(tmp_path / "a.zarr") == files(tmp_path / "whole.zarr")


def test_a_recording_that_vanishes_is_said_and_loses_nothing(tmp_path, recording, plan, stand_in):
    file = tmp_path / "noise.npy"
    stand_in.stop_after, stand_in.error = 6, OSError("gone")
    with pytest.raises(OSError):
        write_sequence(plan, tmp_path / "a.zarr")
    stand_in.stop_after = None
    content = file.read_bytes()
    file.unlink()
    # The description of the plan is read before; one of a new command would be refused at once.
    with pytest.raises(InputError, match=r"noise\.npy cannot be read"):
        write_sequence(plan, tmp_path / "a.zarr")
    file.write_bytes(content)
    assert write_sequence(plan, tmp_path / "a.zarr").there == 4


def test_a_store_that_is_replaced_meanwhile_is_left_alone(tmp_path, recording, plan, stand_in):
    """A worker that was lost may come back when another sequence has taken the place of its own."""
    store = SequenceStore.create(tmp_path / "a.zarr", plan, White())
    SequenceStore.create(tmp_path / "a.zarr", other_plan(recording, "group")[0], White())
    (solution,) = stand_in(recording, [3], scale=2, options=plan.options)
    with pytest.raises(InputError, match="was removed or replaced while it was written"):
        store.write_picture(0, solution)
    shutil.rmtree(tmp_path / "a.zarr")
    with pytest.raises(InputError, match="was removed or replaced while it was written"):
        store.write_picture(0, solution)


def broken(path: Path, how: str) -> None:
    """Damages a store on purpose."""
    metadata = path / "zarr.json"
    content = json.loads(metadata.read_text())
    if how == "empty":
        shutil.rmtree(path)
        path.mkdir()
    elif how == "file":
        shutil.rmtree(path)
        path.write_text("text")
    elif how == "no metadata":
        metadata.unlink()
    elif how == "cut":
        metadata.write_bytes(metadata.read_bytes()[:100])
    elif how == "no text":
        metadata.write_bytes(b"\xff\xfe\x00")
    elif how == "list":
        metadata.write_text("[]")
    elif how == "other zarr":
        metadata.write_text(json.dumps({"zarr_format": 3, "node_type": "group", "attributes": {}}))
    elif how == "format":
        content["attributes"]["scsr"]["format"] = 99
        metadata.write_text(json.dumps(content))
    elif how == "no keys":
        del content["attributes"]["scsr"]["sequence"]["every"]
        metadata.write_text(json.dumps(content))
    elif how == "no step":
        content["attributes"]["scsr"]["sequence"]["every"] = 0
        metadata.write_text(json.dumps(content))
    elif how == "no coordinate":
        shutil.rmtree(path / "x")
    elif how == "coordinate cut":
        (path / "y" / "zarr.json").write_text("{")
    elif how == "zarr 2":
        content["zarr_format"] = 2
        metadata.write_text(json.dumps(content))
    elif how == "no array":
        shutil.rmtree(path / "image")
    elif how == "array cut":
        (path / "velocity" / "zarr.json").write_text("{")
    elif how == "array short":
        array = json.loads((path / "status" / "zarr.json").read_text())
        array["shape"] = [3]
        (path / "status" / "zarr.json").write_text(json.dumps(array))
    elif how == "codec":
        array = json.loads((path / "image" / "zarr.json").read_text())
        array["codecs"][-1]["name"] = "nothing"
        (path / "image" / "zarr.json").write_text(json.dumps(array))


HOW_BROKEN = [
    "empty", "file", "no metadata", "cut", "no text", "list", "other zarr", "format", "no keys", "no step", "zarr 2",
    "no array", "array cut", "array short", "codec", "no coordinate", "coordinate cut",
]  # fmt: skip


@pytest.mark.parametrize("how", HOW_BROKEN)
def test_what_is_no_store_any_more_is_refused_and_kept(tmp_path, plan, stand_in, files, how):
    write_sequence(plan, tmp_path / "a.zarr")
    broken(tmp_path / "a.zarr", how)
    for refuse in (
        lambda: SequenceStore.open(tmp_path / "a.zarr"),
        lambda: write_sequence(plan, tmp_path / "a.zarr"),
    ):
        with pytest.raises(InputError, match=r"a\.zarr") as refused:
            refuse()
        assert "\n" not in str(refused.value)


def test_overwrite_never_replaces_what_is_no_store(tmp_path, plan, stand_in):
    (tmp_path / "a.zarr").mkdir()
    (tmp_path / "a.zarr" / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="is there already and is no store of a sequence"):
        write_sequence(plan, tmp_path / "a.zarr", overwrite=True)
    assert (tmp_path / "a.zarr" / "thesis.txt").read_text() == "years of work"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"keys": [3, 4]}, r"keys is \[3, 4\]; it must be a range of frames"),
        ({"keys": range(0)}, "it must be a range of frames"),
        ({"keys": range(40, 3, -4)}, "it must be a range of frames"),
        ({"keys": range(3, 62)}, "keys is 61"),
        ({"keys": range(-3, 9, 3)}, "keys is -3"),
        ({"scale": 0}, "scale"),
        ({"group": 0}, "group is 0"),
        ({"white": -1}, "white is -1"),
        ({"motion": Motion.constant((0.1, 0.2), (8, 12))}, "which holds at one key frame"),
        ({"keep_images": True}, "a sequence keeps no stages"),
        ({"strenght": 1}, r"no option 'strenght' \(did you mean strength\?\)"),
        ({"gain": np.ones((3, 3))}, "gain is an array of shape"),
    ],
)
def test_a_plan_that_cannot_be_is_refused(recording, change, message):
    given = {"keys": KEYS, "scale": 2, **change}
    with pytest.raises(InputError, match=message):
        Plan.of(recording, given.pop("keys"), **given)


def test_plan_describes_equal_options_alike_and_others_apart():
    """Arrays by their content, objects by their fields."""
    gain = np.ones((3, 4), np.float32)
    same = [described(Options(gain=gain.copy(), motion=Global(), prior=HuberTotalVariation())) for _ in range(2)]
    assert list(differences(*same)) == [] and json.loads(json.dumps(same[0])) == same[0]
    other = described(Options(gain=2 * gain, motion=Global(affine=False), prior=HuberTotalVariation()))
    assert {clause.split(" is ")[0] for clause in differences(same[0], other)} == {"gain", "motion.affine"}


def test_missing_package_is_said_before_the_work(tmp_path, plan, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(InputError, match=r"needs the package zarr.*pip install 'scsr-opt\[sequence\]'"):
        write_sequence(plan, tmp_path / "a.zarr")
    assert os.listdir(tmp_path) == ["noise.npy"]


def test_store_through_a_link_has_one_lock_and_is_replaced_where_the_link_leads(tmp_path, plan, recording, stand_in):
    link, place = tmp_path / "link.zarr", tmp_path / "elsewhere" / "real.zarr"
    place.parent.mkdir()
    write_sequence(plan, place)
    link.symlink_to(place)
    with held(place), pytest.raises(InputError, match="is being written by another run"):
        write_sequence(plan, link)
    assert write_sequence(plan, link).there == 10
    for which in ("group", "scale", "group"):
        write_sequence(other_plan(recording, which)[0], link, overwrite=True)
    assert link.is_symlink() and SequenceStore.open(place).path == place
    assert [one.name for one in place.parent.iterdir()] == ["real.zarr"]


def test_creation_that_fails_leaves_nothing(tmp_path, plan, stand_in, monkeypatch):
    def full(path, *_):
        path.mkdir()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("scsr_opt.sequences.store.lay_out", full)
    with pytest.raises(InputError, match="no space left on device"):
        write_sequence(plan, tmp_path / "a.zarr")
    assert [name for name in os.listdir(tmp_path) if name.startswith((".", "a."))] == []
