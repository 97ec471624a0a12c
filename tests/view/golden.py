"""Golden images: figures as small pictures, held against stored ones as far as fonts and versions agree."""

import io
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from packaging.version import Version
from PIL import Image

FOLDER = Path(__file__).parent / "golden"
WIDTH_PX = 450
DIFFERENCE_MAX = 1.2
"""Greatest mean difference of coarse pixels, 0..255: 0.1 to 0.5 come from the stored palette."""


def picture(figure):
    """A figure as a small image, uint8 [row, column, 3]."""
    encoded = io.BytesIO()
    figure.savefig(encoded, format="png", dpi=WIDTH_PX / figure.get_figwidth())
    return np.asarray(Image.open(encoded).convert("RGB"))


def difference(figure, name):
    """Mean difference of a figure's blocks of 3 x 3 pixels from those of a stored image, 0..255.

    Where no image is stored, this one is, and the difference is infinite: look at it, and run the test again.
    """
    file, found = FOLDER / f"{name}.png", picture(figure)
    if not file.is_file():
        FOLDER.mkdir(exist_ok=True)
        Image.fromarray(found).quantize(64).save(file, optimize=True)
        return np.inf
    with Image.open(file) as image:
        stored = image.convert("RGB")
    size = stored.width // 3, stored.height // 3
    coarse = [np.asarray(each.resize(size, Image.Resampling.BOX), float) for each in (stored, Image.fromarray(found))]
    return float(np.abs(coarse[0] - coarse[1]).mean())


same_text = pytest.mark.skipif(
    Version(matplotlib.__version__) < Version("3.10"), reason="older versions of matplotlib set text otherwise"
)
"""Of tests whose images and places hold text."""
