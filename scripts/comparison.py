"""`write_comparison`: what the scripts that make pictures of the documentation share."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from scsr_opt._files import whole_file
from scsr_opt.cli.demo_scene import psnr
from scsr_opt.report import compare


def write_comparison(
    target: Path,
    columns: Mapping[str, Float[Any, "H W"]],
    truth: Float[np.ndarray, "H W"],
    *,
    scale: int,
    crop: tuple[int, int, int, int] | None = None,
    dpi: int = 70,
) -> None:
    """Writes pictures of one scene and the truth, side by side, and prints the size of the file and each PSNR in dB.

    **Arguments:**
    - `target`: of the PNG.
    - `columns`: name → picture.
    - `scale`: HR pixels per sensor pixel; 8 sensor pixels along the border do not count for the PSNR.
    - `crop`: (top, left, height, width) in pixels of the part to enlarge; None chooses one by the truth.
    - `dpi`: pixels of the file per inch of the page, which is 13 inches wide.
    """
    scores = [f"{name} {psnr(truth, np.asarray(image), 8 * scale):.2f} dB" for name, image in columns.items()]
    drawn = compare({**columns, "Truth": truth}, scale=scale, crop=crop)
    with whole_file(target) as temporary:
        drawn.savefig(temporary, dpi=dpi, pil_kwargs={"optimize": True})
    print(f"{target}: {target.stat().st_size // 1000} kB; {', '.join(scores)}")
