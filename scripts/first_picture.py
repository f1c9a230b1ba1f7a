"""Makes the picture at the head of the README: python scripts/first_picture.py docs/first_picture.png"""

import sys
import tempfile
from pathlib import Path

from comparison import write_comparison
from scsr_opt.camera import tfp
from scsr_opt.cli.demo_scene import KEY, SCALE, run
from scsr_opt.report import bicubic, detailed_part


def main(target: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        made = run(Path(folder))
    playback = tfp(made.simulation.spikes, KEY, white_rate=made.simulation.white_rate)
    columns = {"Playback, enlarged": bicubic(playback, SCALE), "Reconstruction": made.solution.image}
    crop = detailed_part(made.solution.image, scale=SCALE)
    write_comparison(target, columns, made.simulation.truth(float(KEY)), scale=SCALE, crop=crop, dpi=100)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
