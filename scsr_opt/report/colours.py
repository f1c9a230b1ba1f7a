"""Motion as colour: the hue is the direction, the saturation the speed; what stands still is white.

The convention of the optical-flow literature (Baker et al., A Database and Evaluation Methodology for Optical Flow,
2011), so that pictures can be compared with those of other work: hue goes round once, and equal steps of speed are
equal steps of saturation.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float


def motion_colours(velocity: Float[Any, "2 h w"], fastest: float) -> Float[np.ndarray, "h w 3"]:
    """RGB in [0, 1] of a velocity field.

    **Arguments:**
    - `velocity`: sensor pixels per frame, [0] rows (down), [1] columns (right). Not finite: shown grey.
    - `fastest`: the speed that gets full saturation; what is faster is shown like it. 0 where nothing moves.
    """
    from matplotlib.colors import hsv_to_rgb

    down, right = np.asarray(velocity, dtype=np.float32)
    known = np.isfinite(down) & np.isfinite(right)
    down, right = np.where(known, down, 0.0), np.where(known, right, 0.0)
    hue = (np.arctan2(-down, right) / (2 * math.pi)) % 1.0  # anticlockwise from the right, as angles are drawn
    speed = np.hypot(down, right) / fastest if fastest > 0 else np.zeros_like(down)
    colours = hsv_to_rgb(np.stack([hue, np.clip(speed, 0.0, 1.0), np.ones_like(hue)], axis=-1))
    return np.where(known[..., None], colours, 0.6).astype(np.float32)


def full_speed(velocity: Float[Any, "2 h w"]) -> float:
    """The speed to give full saturation to, sensor pixels per frame: nearly the largest, rounded up to two digits.

    The largest itself may belong to a few outliers, and would leave everything else pale.
    """
    speed = np.hypot(*np.asarray(velocity, dtype=np.float64))
    speed = speed[np.isfinite(speed)]
    top = float(np.percentile(speed, 99.5)) if speed.size else 0.0
    if top < 1e-6:
        return 0.0
    step = 10.0 ** (math.floor(math.log10(top)) - 1)
    return math.ceil(top / step - 1e-9) * step


def colour_wheel(pixels: int = 128) -> Float[np.ndarray, "n n 4"]:
    """The legend: a disc whose every point has the colour of the motion from the centre to it; transparent outside."""
    axis = np.linspace(-1.0, 1.0, pixels)
    down, right = np.meshgrid(axis, axis, indexing="ij")
    wheel = motion_colours(np.stack([down, right]), 1.0)
    # One pixel of soft edge, so that the disc does not look cut out.
    cover = np.clip((1.0 - np.hypot(down, right)) * pixels / 2, 0.0, 1.0)
    return np.concatenate([wheel, cover[..., None]], axis=-1).astype(np.float32)
