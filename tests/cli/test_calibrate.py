"""`scsr calibrate`, and `--calibration` in other commands."""

import numpy as np

from scsr_opt.calibration.maps import Calibration
from scsr_opt.camera import Recording, write_recording
from scsr_opt.report import read_picture


def test_calibrate_writes_maps_that_other_commands_use(scsr, here, asked):
    rng = np.random.default_rng(0)
    rate = rng.uniform(0.25, 0.35, (24, 40))
    rate[3, 4] = 0
    charge = rate * np.arange(301)[:, None, None]
    write_recording(here / "flat.npz", Recording.from_array(np.diff(np.floor(charge), axis=0).astype(np.uint8)))
    said = scsr("calibrate", "--flat", "flat.npz", "-o", "maps.npz")
    assert "40x24 pixels, of which 1 are bad: 1 dead." in said and "Gains spread by" in said and "not known" in said
    maps = Calibration.load("maps.npz")
    assert maps.bad.mask.sum() == 1 and maps.bad.mask[3, 4]
    scsr("solve", "flat.npz", "--calibration", "maps.npz", "-o", "a.npz", "--scale", "2")
    assert asked[0]["spikes"].bad_pixels.sum() == 1
    np.testing.assert_array_equal(asked[0]["gain"], maps.gain)
    for name, options in (("raw.npz", []), ("even.npz", ["--calibration", "maps.npz"])):
        scsr("play", "flat.npz", "--window", "300", "-o", name, *options)
    raw, even = (read_picture(name)[~maps.bad.mask].std() for name in ("raw.npz", "even.npz"))
    assert even < 0.4 * raw


def test_calibrate_refuses_what_it_cannot_use(scsr, file):
    assert "must end in .npz" in scsr("calibrate", file, "-o", "a.png", code=2)
    assert "leave --crop" in scsr("calibrate", file, "-o", "a.npz", "--crop", "0,0,5,5", code=2)
    assert "There is no recording to calibrate from" in scsr("calibrate", "-o", "a.npz", code=2)
    assert "There is no calibration" in scsr("info", file, "--calibration", "none.npz", code=2)
