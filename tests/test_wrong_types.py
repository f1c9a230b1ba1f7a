"""Arguments of a wrong type, or long ones, as a program meets them that has no checks of types: one short sentence.

The tests' own checks of types would refuse them first, so all calls are made in a process without these.
"""

import json
import re
import subprocess
import sys

SETUP = """
import json, sys
import numpy as np
from scsr_opt import Recording, estimate_motion, reconstruct
from scsr_opt.calibration.settings import GainSettings
from scsr_opt.camera import Sensor, read_recording, write_recording
from scsr_opt.camera.scenes import Translation
from scsr_opt.camera.video import Video
from scsr_opt.camera.flat import parse_size
from scsr_opt.motion import Motion
from scsr_opt.priors import Bounded, TotalVariation
from scsr_opt.report import read_picture, write_film, write_picture

SPIKES = (np.random.default_rng(0).random((24, 6, 8)) < 0.3).astype(np.uint8)
RAMP = np.linspace(0, 1, 12).reshape(3, 4)
MANY = np.arange(20_000.0)
write_recording("r.dat", SPIKES)
write_recording("r.npz", SPIKES)

def outcome(code):
    try:
        return ["", str(eval(code))]
    except Exception as error:
        return [type(error).__name__, str(error)]

json.dump([outcome(code) for code in json.load(sys.stdin)], sys.stdout)
"""

NO_PATH = "is no path of a file: give a str or a Path"
NO_SHAPE = "it must be .rows, columns. of the sensor, two whole numbers of at least 1"

CALLS = {
    **{
        call.format(value): NO_PATH
        for value in ("None", "5", "2.5", "['a.dat']", "MANY")
        for call in (
            "read_recording({})",
            "write_recording({}, SPIKES)",
            "write_picture({}, RAMP)",
            "write_film({}, [RAMP])",
            "read_picture({})",
        )
    },
    **{
        f"write_film('a.gif', [RAMP], {name}={value})": rf"{name} is .*, but it must be from 0\.\d+ to 10"
        for name in ("rate", "gamma")
        for value in ("'2'", "None", "1j", "MANY", "[1.0]", "b'1'", "float('nan')", "float('inf')")
        if (name, value) != ("rate", "None")  # the usual rate
    },
    **{f"write_picture('a.png', RAMP, gamma={value})": "gamma is .*, but it must" for value in ("'2'", "None", "MANY")},
    **{
        f"write_picture('a.png', RAMP, bits={value})": "bits per pixel cannot be stored in .png: choose 8 or 16"
        for value in ("'8'", "8.5", "[8]", "MANY", "1j")
    },
    **{
        f"reconstruct(SPIKES, scale=2, quality={value})": "quality is .*; it must be 'fast', 'best' or a Restoration"
        for value in ("'good'", "None", "5", "MANY", "['best']", "reconstruct")
    },
    **{
        call.format(value): ""
        for value in ("10**400", "10**5000")
        for call in (
            "reconstruct(SPIKES, scale={})",
            "reconstruct(SPIKES, scale=1, key={})",
            "reconstruct(SPIKES, scale=1, strength={})",
            "reconstruct(SPIKES, scale=1, white_rate={})",
            "reconstruct(SPIKES, scale=1, gain={})",
            "Motion.constant(({0}, 0), (6, 8))",
            "Recording.from_array(SPIKES, readout_rate={})",
            "Recording.from_array(SPIKES).window(0, {})",
            "Recording.from_array(SPIKES).around({}, 5)",
            "Sensor(white_rate={})",
            "Translation(RAMP, velocity=({0}, 0))",
            "Video([RAMP, RAMP], readouts_per_frame={})",
            "Bounded(TotalVariation(), lower={})",
            "GainSettings(pattern_spread={})",
            "write_film('a.gif', [RAMP], rate={})",
        )
    },
    **{
        call.format(value): ""
        for value in ("5", "'x'", "b'x'", "2.5", "{}", "object()", "MANY", "10**400")
        for call in (
            "Recording({})",
            "estimate_motion({})",
            "estimate_motion(SPIKES, key=({},))",
            "estimate_motion(SPIKES, estimator={})",
            "estimate_motion(SPIKES, gain={})",
            "estimate_motion(SPIKES, bad_pixels={})",
            "estimate_motion(SPIKES, settings={})",
            "reconstruct(SPIKES, scale=1, settings={})",
            "reconstruct(SPIKES, scale=1, shortcuts={})",
        )
    },
    **{f"reconstruct(SPIKES, scale=1, {name}=None)": "leave it out" for name in ("settings", "shortcuts")},
    **{
        f"Motion.of_velocity({value})": r"it must be (\(2, h, w\) numbers|an array)"
        for value in ("'x'", "b'x'", "[['a']]", "{}", "object()", "10**400")
    },
    **{f"write_film('a.gif', {value})": "give a list of them" for value in ("5", "None", "2.5", "RAMP.sum()")},
    **{
        call.format(f"{name}={value}"): f"{name} is .*; it must be {allowed}"
        for name, value, allowed in (
            ("flip", "'no'", "True or False"),
            ("flip", "MANY", "True or False"),
            ("row_bits", "'48'", "a whole number, at least 1"),
            ("row_bits", "48.5", "a whole number, at least 1"),
            ("row_bits", "0", "a whole number, at least 1"),
            ("row_bits", "MANY", "a whole number, at least 1"),
        )
        for call in ("read_recording('r.dat', size='8x6', {})", "write_recording('x.dat', SPIKES, {})")
    },
    **{
        f"read_recording('r.npz', key={value})": "it must be the name of an array in the file"
        for value in ("5", "MANY", "b'spikes'", "['spikes']")
    },
    **{
        f"Motion.constant((0, 0), {value})": NO_SHAPE
        for value in ("None", "5", "'ab'", "(6,)", "(6, 8, 1)", "(6.5, 8)", "(0, 8)", "(-1, 8)", "[[6, 8]]", "MANY")
    },
    **{
        call.format(value): ""
        for value in (
            "MANY",
            "MANY.tolist()",
            "MANY.reshape(2, 100, 100)",
            "'long ' * 100",
            "{i: i for i in range(999)}",
        )
        for call in (
            "reconstruct(SPIKES, scale=1, crop={})",
            "reconstruct(SPIKES, scale={})",
            "reconstruct(SPIKES, scale=1, strength={})",
            "reconstruct(SPIKES, scale=1, motion={})",
            "Motion.constant({}, (6, 8))",
            "Recording.from_array(SPIKES, white_rate={})",
            "Recording.from_array(SPIKES).window({}, 3)",
            "Recording.from_array(SPIKES).crop({}, 0, 1, 1)",
            "parse_size({})",
            "Sensor(white_rate={})",
        )
    },
}


def test_arguments_of_a_wrong_type_are_refused_in_one_sentence(tmp_path):
    command = [sys.executable, "-c", SETUP]
    ended = subprocess.run(
        command, input=json.dumps(list(CALLS)), capture_output=True, text=True, cwd=tmp_path, check=True
    )
    wrong = [
        (call, kind, message)
        for (call, pattern), (kind, message) in zip(CALLS.items(), json.loads(ended.stdout), strict=True)
        if kind != "InputError" or not re.search(pattern, message) or len(message) >= 300 or "\n" in message
    ]
    assert not wrong
