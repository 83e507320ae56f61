"""A robot, and a drive for it."""

import itertools

import pytest
from robot import Recording, Robot, odograph


@pytest.fixture(scope="session")
def simulated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("simulated")
    options = "--size 320x240 --path eight --duration 6 -q"
    odograph(folder, f"simulate -o sim --format y4m {options}")
    odograph(folder, f"simulate -o jpeg --format mjpeg {options}")
    odograph(folder, "run sim/sim.y4m --camera sim/camera.yaml --rig sim/rig.toml -o run -q")
    return folder


@pytest.fixture
def recording(simulated):
    return Recording(simulated / "sim/sim.y4m")


@pytest.fixture
def robot(domains=itertools.count(40)):
    # No test hears another one.
    robot = Robot(next(domains))
    yield robot
    robot.close()
