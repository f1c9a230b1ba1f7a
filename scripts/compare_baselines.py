"""Draws every baseline beside `reconstruct`: python scripts/compare_baselines.py docs/baselines.png

A picture that comes with scikit-image is recorded by a simulated spike camera that pans and turns (the demo's
recording). Each panel shows the same part of a result, every pixel of it as a square of whole screen pixels, all with
one grey scale from black to white.
"""

import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from scsr_opt import reconstruct
from scsr_opt._files import whole_file
from scsr_opt.baselines import BASELINES
from scsr_opt.cli.demo_scene import KEY, SCALE, psnr, simulated
from scsr_opt.report import quantise

# The camera and its lens: (top, left, height, width) in pixels of the picture.
PART = (56, 216, 96, 112)
ZOOM = 3
COLUMNS = 4
MARGIN, LABEL = 8, 22


def main(target: Path) -> None:
    made = simulated()
    truth = made.truth(float(KEY))
    given = {"scale": SCALE, "key": KEY, "white_rate": made.white_rate}
    pictures = {name: function(made.spikes, **given) for name, function in BASELINES.items()}
    pictures["reconstruct"] = reconstruct(made.spikes, **given).image
    labels = {name: f"{name}  {psnr(truth, image, 8 * SCALE):.2f} dB" for name, image in pictures.items()}
    frame = np.kron(made.spikes[KEY], np.ones((SCALE, SCALE))).astype(np.float32)
    panels = [
        ("one spike frame", frame),
        *((labels[name], image) for name, image in pictures.items()),
        ("truth", truth),
    ]
    drawn = grid([(label, _part(image)) for label, image in panels])
    with whole_file(target) as temporary:
        drawn.save(temporary, optimize=True)
    print("\n".join(labels.values()))


def grid(panels: list[tuple[str, UInt8[np.ndarray, "tall wide"]]]) -> Image.Image:
    """The panels row by row, each under its label."""
    tall, wide = panels[0][1].shape
    rows = -(-len(panels) // COLUMNS)
    step_down, step_right = tall + LABEL + MARGIN, wide + MARGIN
    page = Image.new("L", (COLUMNS * step_right + MARGIN, rows * step_down + MARGIN), 255)
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(15)
    for number, (label, pixels) in enumerate(panels):
        top, left = MARGIN + number // COLUMNS * step_down, MARGIN + number % COLUMNS * step_right
        pen.text((left, top), label, fill=0, font=font)
        page.paste(Image.fromarray(pixels), (left, top + LABEL))
    return page


def _part(image: Float[np.ndarray, "H W"]) -> UInt8[np.ndarray, "tall wide"]:
    top, left, height, width = PART
    return quantise(np.kron(image[top : top + height, left : left + width], np.ones((ZOOM, ZOOM))))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
