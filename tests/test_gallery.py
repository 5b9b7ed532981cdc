"""The script that draws the documentation's images."""

import sys
from pathlib import Path

import pytest
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
import gallery


@pytest.mark.slow
def test_gallery_draws_every_image(tmp_path):
    gallery.main([str(tmp_path)])
    names = {
        *("objects_by_shape.png", "scenes.png", "foreign_objects.png"),
        *("ambiguity.png", "joint_control.png"),
    }
    assert {path.name for path in tmp_path.iterdir()} == names
    for name in names:
        with Image.open(tmp_path / name) as image:
            assert len(image.convert("RGB").getcolors(1 << 24)) > 50
