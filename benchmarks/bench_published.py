"""Published figures beside ours: PSNR in dB / SSIM, each on its own recordings.

`PUBLISHED` is Table 1 of the paper (SpikeSR-Net, AAAI 2023), whose recordings and weights are not public. `OURS` are
figures of this project's pages (`tests/benchmarks/test_bench.py` holds that they are still there).
"""

from typing import NamedTuple

SETS = ("DIV2K-based, ×2", "DIV2K-based, ×4", "REDS-based, ×2", "REDS-based, ×4")
PUBLISHED: dict[str, tuple[str, str, str, str]] = {
    "TFP + SISR": ("20.18/0.3538", "20.01/0.4132", "23.09/0.5055", "23.14/0.5230"),
    "TFP + MISR": ("20.53/0.4168", "19.99/0.4087", "24.15/0.5810", "23.15/0.5180"),
    "STP + SISR": ("14.61/0.3585", "14.37/0.3214", "14.82/0.4237", "14.84/0.4111"),
    "STP + MISR": ("15.03/0.4027", "14.46/0.3296", "15.44/0.4876", "14.97/0.4260"),
    "Spk2ImgNet + SISR": ("24.48/0.7806", "24.59/0.7064", "25.39/0.8165", "25.97/0.7637"),
    "Spk2ImgNet + MISR": ("27.14/0.8197", "25.85/0.7253", "28.76/0.8687", "27.24/0.7881"),
    "MGSR": ("23.96/0.6603", "22.93/0.5999", "23.63/0.6341", "22.73/0.5921"),
    "SpikeSR-Net": ("28.70/0.8413", "26.88/0.7451", "30.79/0.8883", "28.46/0.8012"),
}


class Own(NamedTuple):
    """Figures of one method. **Fields:** `page` where they stand, `recordings`, and for ×2 and ×4 (None: not there)
    what it says of each scene, dB and, where the page has it, SSIM."""

    method: str
    page: str
    recordings: str
    twice: tuple[tuple[float, float | None], ...] | None
    four_times: tuple[tuple[float, float | None], ...] | None


_STILLS = "12 stills, day: static, translate, affine, object, fan"
_FEW = "4 stills, day: translate, object"
OURS = (
    Own(
        "playback (TFP)", "learned.md", _STILLS,
        ((24.4, None), (21.9, None), (23.7, None), (22.4, None), (22.7, None)), None,
    ),
    Own(
        "`reconstruct`, defaults", "learned.md", _STILLS,
        ((26.87, 0.847), (29.59, 0.889), (31.53, 0.931), (26.70, 0.854), (27.01, 0.870)),
        ((23.09, 0.640), (24.45, 0.719), (25.43, 0.772), (22.21, 0.660), (22.67, 0.698)),
    ),
    Own(
        "`ridge-centred`", "learned.md", _STILLS, None,
        ((23.89, 0.673), (24.78, 0.725), (25.83, 0.783), (22.65, 0.679), (23.14, 0.720)),
    ),
    Own(
        "`unrolled`", "learned.md", _STILLS,
        ((27.39, 0.855), (29.53, 0.891), (31.06, 0.925), (27.03, 0.859), (27.38, 0.876)),
        ((23.74, 0.665), (24.66, 0.716), (25.31, 0.751), (22.53, 0.674), (23.01, 0.708)),
    ),
    Own(
        "`spikesr-small`", "learned.md", _STILLS,
        ((27.25, 0.842), (26.70, 0.817), (28.17, 0.869), (25.88, 0.830), (25.96, 0.839)),
        ((23.58, 0.655), (23.61, 0.642), (24.35, 0.697), (21.61, 0.611), (22.14, 0.650)),
    ),
    Own(
        "`spikesr-full`", "learned.md", _STILLS,
        ((27.24, 0.844), (27.52, 0.839), (29.54, 0.899), (25.55, 0.821), (25.28, 0.826)), None,
    ),
    Own("`tfp_sr`", "baselines.md", _FEW, ((23.21, 0.494), (23.99, 0.685)), ((21.83, 0.375), (20.79, 0.497))),
    Own("`stp_sr`", "baselines.md", _FEW, ((23.43, 0.561), (23.85, 0.653)), ((21.88, 0.418), (21.20, 0.501))),
    Own("`mgsr`", "baselines.md", _FEW, ((29.89, 0.860), (26.95, 0.806)), ((25.40, 0.623), (23.18, 0.639))),
    Own(
        "`reconstruct`, the same stills", "baselines.md", _FEW, ((30.69, 0.886), (28.49, 0.849)),
        ((25.55, 0.654), (24.55, 0.686)),
    ),
)  # fmt: skip


def mean(scenes: tuple[tuple[float, float | None], ...] | None) -> str:
    """dB and, where all scenes have it, SSIM; the mean over the scenes."""
    if scenes is None:
        return "–"
    ratio = f"{sum(one for one, _ in scenes) / len(scenes):.2f}"
    likeness = [one for _, one in scenes if one is not None]
    return ratio if len(likeness) < len(scenes) else f"{ratio}/{sum(likeness) / len(likeness):.3f}"
