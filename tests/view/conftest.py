"""What the tests of pictures share."""

import pytest

from warpav.view import Canvas, Picture, rig_plotter

WINDOW_PX = (480, 300)


@pytest.fixture
def draw():
    """Draws a picture of what is given by name; the plotters are closed at the end."""
    opened = []

    def make(*, labels=False, sectors=True, **parts):
        canvas = Canvas(window_size=WINDOW_PX, off_screen=True)
        opened.append(rig_plotter(Picture(**parts), canvas, labels=labels, sectors=sectors))
        return opened[-1]

    yield make
    for plotter in opened:
        plotter.close()
