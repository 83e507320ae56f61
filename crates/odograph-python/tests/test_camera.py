"""Cameras and rigs."""

import numpy as np
import odograph as od
import pytest

K = [[500.0, 0.0, 321.0], [0.0, 501.0, 238.0], [0.0, 0.0, 1.0]]


def test_a_camera_is_what_it_was_made_of(tmp_path):
    camera = od.Camera(K=K, dist=[-0.12, 0.02, 0.0004, -0.0003], size=(640, 480), readout=0.01)
    assert np.array_equal(camera.K, K) and camera.size == (640, 480) and camera.readout == 0.01
    assert np.array_equal(camera.dist[:4], [-0.12, 0.02, 0.0004, -0.0003])
    camera.save(tmp_path / "camera.yaml")
    assert np.array_equal(od.Camera.load(tmp_path / "camera.yaml").K, camera.K)
    fisheye = od.Camera(np.array(K), [0.1, 0.0, 0.0, 0.0], size=(640, 480), model="kannala-brandt")
    fisheye.save(tmp_path / "fisheye.yaml")
    assert od.Camera.load(str(tmp_path / "fisheye.yaml")) == fisheye != camera
    assert od.Camera.from_field_of_view((320, 240), (0.64, 0.48), 0.5).K[0, 0] == pytest.approx(250.0)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ({"K": [[1.0, 0.0], [0.0, 1.0]]}, "K is not a camera matrix"),
        ({"K": [[500.0, 3.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]}, "K is not a camera matrix"),
        ({"K": "wide"}, "K is no array of numbers"),
        ({"K": K, "dist": [0.1, 0.2, 0.3]}, "dist has 3 coefficients"),
        ({"K": K, "dist": [float("nan"), 0, 0, 0]}, "a distortion coefficient is NaN"),
        ({"K": K, "model": "pinhole"}, "no lens model"),
        ({"K": K, "readout": 3.0}, "readout time"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(arguments, why):
    with pytest.raises(od.Error, match=why):
        od.Camera(size=(640, 480), **arguments)


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(od.Error, match="no such.yaml cannot be read") as raised:
        od.Camera.load("no such.yaml")
    assert raised.value.kind == "input"
    (tmp_path / "camera.yaml").write_text("fx: wide\n")
    with pytest.raises(od.Error, match="camera.yaml"):
        od.Camera.load(tmp_path / "camera.yaml")


def test_a_rig_is_what_its_file_says(tmp_path):
    rig = od.Rig(0.75, roll=0.01, pitch=-0.02, yaw=1.5)
    rig.save(tmp_path / "rig.toml")
    read = od.Rig.load(tmp_path / "rig.toml")
    assert [read.height, read.roll, read.pitch, read.yaw] == pytest.approx([0.75, 0.01, -0.02, 1.5])
    with pytest.raises(od.Error, match="height"):
        od.Rig(0.0)
