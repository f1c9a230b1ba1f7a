"""Makes the picture at the head of the README: python scripts/first_picture.py docs/first_picture.png"""

import sys
import tempfile
from pathlib import Path

from scsr_opt._files import whole_file
from scsr_opt.camera import tfp
from scsr_opt.cli.demo_scene import KEY, SCALE, run
from scsr_opt.report import bicubic, compare, detailed_part


def main(target: Path) -> None:
    with tempfile.TemporaryDirectory() as folder:
        made = run(Path(folder))
    playback = tfp(made.simulation.spikes, KEY, white_rate=made.simulation.white_rate)
    columns = {
        "Playback, enlarged": bicubic(playback, SCALE),
        "Reconstruction": made.solution.image,
        "Truth": made.simulation.truth(float(KEY)),
    }
    drawn = compare(columns, scale=SCALE, crop=detailed_part(made.solution.image, scale=SCALE))
    with whole_file(target) as temporary:
        drawn.savefig(temporary, dpi=100, pil_kwargs={"optimize": True})
    print(f"{target}: {target.stat().st_size // 1000} kB, PSNR {made.playback_psnr:.2f} -> {made.psnr:.2f} dB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
