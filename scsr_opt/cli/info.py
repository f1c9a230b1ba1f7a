"""`scsr info`: what is in a recording."""

from dataclasses import asdict
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from scsr_opt.cli.options import File, Quiet, Reading, progress, shown_white
from scsr_opt.progress import Progress

if TYPE_CHECKING:
    import scsr_opt.camera


def info(
    file: File,
    /,
    *,
    reading: Reading | None = None,
    json: Annotated[bool, Parameter(negative="", show_default=False, help="Print the numbers as JSON.")] = False,
    quiet: Quiet = False,
) -> int:
    """Show what is in a recording: size, duration, firing rates, pixels that look faulty.

    Intensity 1 is the light of a pixel that fires at the white rate (--white-rate). The intensity that 8-bit pictures,
    figures and films show as white is found from the recording.
    """
    recording, crop = (reading or Reading()).whole(file)
    facts = describe(recording if crop is None else recording.crop(*crop), progress(quiet))
    facts["crop"] = crop
    facts["file"] = str(file)
    if json:
        print(dumps(facts, indent=1))
    elif not quiet:
        print("\n".join(_lines(file, facts)))
    return 0


def describe(recording: "scsr_opt.camera.Recording", meter: Progress) -> dict[str, Any]:
    """The facts of a recording as plain numbers; it is read in windows, whatever its length."""
    import numpy as np

    from scsr_opt.camera.saturation import share_saturated

    step = max(1, (32 << 20) // (recording.height * recording.width))
    counts = np.zeros((recording.height, recording.width), np.int64)
    meter.start(recording.frames, "Counting spikes")
    try:
        for start in range(0, recording.frames, step):
            stop = min(start + step, recording.frames)
            counts += recording.window(start, stop).sum(axis=0, dtype=np.int64)
            meter.advance(stop - start)
    finally:
        meter.finish()
    rates = counts / recording.frames
    low, median, high = (float(value) for value in np.percentile(rates, [0.1, 50, 99.9]))
    bad, white = recording.bad_pixels, shown_white(recording, None, 0, recording.frames - 1)
    return {
        "frames": recording.frames,
        "width": recording.width,
        "height": recording.height,
        "readout_rate": float(recording.readout_rate),
        "duration": float(recording.duration),
        "stored_bottom_up": recording.flipped,
        "spikes": int(counts.sum()),
        "white_rate": float(recording.white_rate),
        "rate_mean": float(rates.mean()),
        "rate_low": low,
        "rate_median": median,
        "rate_high": high,
        "bad_pixels": None if bad is None else int(np.count_nonzero(bad)),
        "silent_pixels": int(np.count_nonzero(counts == 0)),
        "saturated": share_saturated(counts, recording.frames, bad),
        "white": asdict(white) | {"rate": white.level * recording.white_rate},
        "always_firing_pixels": int(np.count_nonzero(counts == recording.frames)),
    }


def _lines(file: Path | str, facts: dict[str, Any]) -> list[str]:
    milliseconds = facts["duration"] * 1e3
    bad = "none are marked" if facts["bad_pixels"] is None else f"{facts['bad_pixels']:,} are marked"
    order, other = ("bottom-up", "--no-flip") if facts["stored_bottom_up"] else ("top-down", "--flip")
    table = {
        "sensor": f"{facts['width']} x {facts['height']} pixels",
        **({} if facts["crop"] is None else {"crop": "from row {}, column {}".format(*facts["crop"])}),
        "frames": f"{facts['frames']:,} at {facts['readout_rate']:g} Hz = {milliseconds:.4g} ms",
        "row order": f"read as {order}; if scsr play shows the scene upside down, give {other}",
        "spikes": f"{facts['spikes']:,}, {facts['rate_mean']:.4g} per pixel and frame",
        "firing rate": f"{facts['rate_low']:.4g} (darkest pixels), {facts['rate_median']:.4g} (median), "
        f"{facts['rate_high']:.4g} (brightest) spikes per frame; 0.1 % of the pixels are beyond either end",
        "white rate": f"{facts['white_rate']:g} spikes per frame count as intensity 1; --white-rate changes it",
        "shown white": f"intensity {facts['white']['level']:.3g}, that is {facts['white']['rate']:.3g} spikes per "
        f"frame ({facts['white']['reason']})",
        "bad pixels": f"{bad}; {facts['silent_pixels']:,} never fired, {facts['always_firing_pixels']:,} fired in "
        f"every frame",
    }
    if facts["saturated"]:
        from scsr_opt.camera.saturation import said_of

        table["saturated"] = said_of(facts["saturated"])
    return [str(file), *(f"  {name:<12} {value}" for name, value in table.items())]
