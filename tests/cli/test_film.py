"""`scsr film`."""

import os

import numpy as np
import pytest
from PIL import Image

import scsr_opt
from scsr_opt import Diagnostics, Solution, Status
from scsr_opt.report import read_picture

FRAMES, HEIGHT, WIDTH = 31, 24, 40  # of the fixture `spikes`


@pytest.fixture
def asked(monkeypatch) -> list[dict]:
    """Puts a quick stand-in in the place of `reconstruct_sequence`; returns what it was called with."""
    calls: list[dict] = []

    def stand_in(recording, keys, *, scale, **others):
        calls.append({"recording": recording, "keys": keys, "scale": scale, **others})
        for number, key in enumerate(keys):
            image = np.full((scale * HEIGHT, scale * WIDTH), key / FRAMES, np.float32)
            yield Solution(
                image=image,
                recording=recording,
                scale=scale,
                key=key,
                white_rate=recording.white_rate,
                status=Status.non_finite if key == 13 else Status.converged,
                diagnostics=Diagnostics(motion_carried=number not in (0, 2)),
            )

    monkeypatch.setattr(scsr_opt, "reconstruct_sequence", stand_in, raising=False)
    return calls


def test_film_of_one_picture_is_spoken_of_as_one(scsr, file, asked):
    said = scsr("film", file, "-o", "a.gif", "--scale", "2", "--start", "4", "--stop", "5").splitlines()
    assert said[0].startswith("a.gif: 1 picture of frames 4 to 4, ")
    assert said[1] == "Motion was estimated once, at frame 4, and carried on between."


def test_film_is_written_and_says_where_motion_was_found_anew(scsr, file, asked):
    said = scsr("film", file, "-o", "a.gif", "--scale", "2", "--start", "4", "--stop", "12", "--step", "2").splitlines()
    assert said[0].startswith("a.gif: 4 pictures of frames 4 to 10, every 2; ")
    assert said[1] == "Motion was estimated 2 times, at frames 4, 8, and carried on between."
    with Image.open("a.gif") as film:
        assert film.size == (2 * WIDTH, 2 * HEIGHT)
        assert film.n_frames == 4  # pyright: ignore[reportAttributeAccessIssue]
    (call,) = asked
    assert list(call["keys"]) == [4, 6, 8, 10] and call["scale"] == 2
    assert "frames" not in call and "key" not in call


def test_film_hands_on_what_is_to_be_solved_and_writes_pictures(scsr, file, asked):
    os.mkdir("pictures")
    options = ["--frames", "21", "--strength", "0.3", "--motion", "global", "--step", "10", "--pictures", "pictures"]
    assert scsr("film", file, "-o", "a.gif", *options, "--quiet") == ""
    (call,) = asked
    assert call["frames"] == 21 and call["strength"] == 0.3 and type(call["motion"]).__name__ == "Global"
    assert sorted(os.listdir("pictures")) == ["00.tif", "10.tif", "20.tif", "30.tif"]
    np.testing.assert_allclose(read_picture("pictures/20.tif"), 20 / FRAMES, rtol=1e-6)


def test_film_takes_about_25_pictures(scsr, file, asked):
    scsr("film", file, "-o", "a.gif", "--quiet", "--stop", "12")
    assert list(asked[0]["keys"]) == list(range(12))


def test_film_of_which_a_picture_fails_is_not_written(scsr, file, asked):
    said = scsr("film", file, "-o", "a.gif", "--start", "11", "--step", "1", code=1)
    assert "No film was written, because of frame 13: a value that is not finite appeared" in said
    assert os.listdir() == ["ramp.npz"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-o", "a.png"], "films end in .gif or .mp4"),
        (["-o", "a.gif", "--rate", "0"], "rate is 0"),
        (["-o", "a.gif", "--rate", "1e-9"], "rate is 1e-09, but it must be from 0.01 to 1000 pictures per second"),
        (["-o", "a.gif", "--gamma", "-1"], "gamma is -1"),
        (["-o", "a.gif", "--scale", "0"], "--scale is 0"),
        (["-o", "a.gif", "--frames", "0"], "--frames is 0"),
        (["-o", "a.gif", "--start", "31"], "A film from frame 31 to 31"),
        (["-o", "a.gif", "--step", "0"], "--step is 0"),
        (["-o", "a.gif", "--strength", "-1"], "--strength is -1"),
        (["-o", "a.gif", "--pictures", "nowhere"], "--pictures nowhere is no folder"),
        (["-o", "missing/a.gif"], "the folder missing does not exist"),
    ],
)
def test_film_refuses(scsr, here, file, asked, options, message):
    assert message in scsr("film", file, *options, code=2)
    assert os.listdir(here) == ["ramp.npz"] and not asked


def test_film_wants_a_motion_that_can_be_carried_on(scsr, here, file):
    assert "--motion 0.1,0 is the velocity at one moment" in scsr(
        "film", file, "-o", "a.gif", "--motion", "0.1,0", code=2
    )
    assert os.listdir(here) == ["ramp.npz"]
