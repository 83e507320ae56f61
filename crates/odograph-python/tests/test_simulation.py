"""Rendered drives."""

import numpy as np
import odograph as od
import pytest


def test_a_drive_is_a_sequence(drive):
    assert drive[0].shape == (240, 320) and drive[0].dtype == np.uint8
    assert len(drive) == len(drive.timestamps) == len(drive.poses)
    assert np.array_equal(drive[-1], drive[len(drive) - 1])
    assert sum(1 for _ in od.simulate("still", duration=0.1, size=(64, 48))) == 4
    with pytest.raises(IndexError):
        drive[len(drive)]


def test_files_are_the_drive(drive, folder):
    assert len(list((folder / "frames").iterdir())) == len(drive)
    assert od.Camera.load(folder / "camera.yaml") == drive.camera
    assert od.evaluate(folder / "truth.tum", drive, align="none").translation["max"] < 1e-5
    with pytest.raises(od.Error, match="exists already"):
        drive.save(folder)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ({"path": "circle"}, "no path"),
        ({"texture": "lava"}, "no texture"),
        ({"speed": -1.0}, "speed"),
        ({"fps": 0.0}, "frame rate"),
        ({"height": 0.0}, "height"),
        ({"size": (0, 480)}, "image size"),
        ({"camera": "no such.yaml"}, "no such.yaml"),
        ({"noise": float("nan")}, "noise"),
    ],
)
def test_what_cannot_be_rendered_is_refused(arguments, why):
    with pytest.raises(od.Error, match=why):
        od.simulate(**arguments)
