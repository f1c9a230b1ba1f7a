"""`scsr demo`."""

import os


def test_demo(scsr, here, asked):
    said = scsr("demo", "-o", "made/here")
    assert sorted(os.listdir(here / "made" / "here")) == [
        "figure.png", "picture.png", "recording.npz", "report.json", "truth.png",
    ]  # fmt: skip
    assert "PSNR against the truth" in said and "Look at made/here/figure.png" in said


def test_demo_where_nothing_can_be_written(scsr, here):
    (here / "demo_output").write_text("a file")
    assert "The folder demo_output cannot be made: file exists" in scsr("demo", code=2)
