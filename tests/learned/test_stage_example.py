"""The example of docs/learned.md, "Stage by stage": what the page says is what its commands print."""

import re
from pathlib import Path

import pytest

from learned.evaluation.compare import compare_stages
from scsr_opt.camera import read_recording
from scsr_opt.cli import main
from scsr_opt.report import read_picture

PAGE = Path(__file__).parents[2] / "docs" / "learned.md"


@pytest.mark.slow
def test_the_page_shows_what_the_commands_print(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    section = PAGE.read_text(encoding="utf-8").split("\n## Stage by stage\n")[1].split("\n## ")[0]
    simulate = re.search(r"^scsr (simulate .*?)  #", section, re.M)
    assert simulate is not None
    assert main(simulate[1].split()) == 0
    rows = re.findall(r"^\| `(\S+)` \| (\d+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|", section, re.M)
    assert len(rows) == 3
    names = [row[0] for row in rows]
    found = compare_stages(read_recording("coins.npz"), names, scale=2, truth=read_picture("t.tif"), costs=False)
    strength = re.search(r"λ = ([\d.]+), found", section)
    # Another machine's rounding moves λ, and so the picture; a change of the method moves them by far more.
    assert strength is not None and found.strength == pytest.approx(float(strength[1]), rel=0.03)
    for model, (name, stages, objective, distance, psnr, ssim) in zip(found.models, rows, strict=True):
        last = model.stages[-1]
        assert model.name == name and len(model.stages) == pytest.approx(int(stages), abs=2)
        assert last.objective == pytest.approx(float(objective), rel=1e-3)
        assert last.distance == pytest.approx(float(distance), abs=2e-3)
        assert (last.psnr, last.ssim) == pytest.approx((float(psnr), float(ssim)), abs=0.1)
