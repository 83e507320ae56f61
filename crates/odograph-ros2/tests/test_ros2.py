"""The program with ROS 2 beside Cyclone DDS, on rendered frames: run in a network of its own."""

import csv
import json
import math
import subprocess
import time

import messages as ros
import pytest
from robot import (
    BEGAN_NS,
    LATCHED,
    RELIABLE,
    Program,
    Recording,
    Robot,
    heading,
    matched,
    os,
    play,
    stamp_ns,
    until,
)


def odograph(folder, arguments):
    command = [os.environ["ODOGRAPH"], *arguments.split()]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)


@pytest.fixture(scope="session")
def simulated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("simulated")
    options = "--format y4m --size 320x240 --path eight --duration 6 -q"
    odograph(folder, f"simulate -o sim {options}")
    odograph(folder, "run sim/sim.y4m --camera sim/camera.yaml --rig sim/rig.toml -o run -q")
    return folder


@pytest.fixture
def robot():
    robot = Robot()
    yield robot
    robot.close()


def poses(path):
    with open(path, encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if row["x_m"]]


def test_images_become_odometry_as_in_a_run(simulated, robot, tmp_path):
    recording = Recording(simulated / "sim/sim.y4m")
    odometry = robot.listen("/odom", ros.Odometry)
    transforms = robot.listen("/tf", ros.TFMessage)
    images = robot.writer("/camera/image_raw", ros.Image)
    sim = simulated / "sim"
    program = Program(
        tmp_path,
        f"live ros2:/camera/image_raw --camera {sim}/camera.yaml --rig {sim}/rig.toml --ros2 -o live",
    )
    until(lambda: matched(images), what="the subscription")
    play(recording, lambda number: images.write(recording.image(number)))
    until(lambda: len(odometry) >= len(recording.frames) - 2, what="the last odometry")
    program.interrupt()
    code, said = program.end()
    assert code == 0, said
    statistics = json.loads((tmp_path / "live/stats.json").read_text())
    print(statistics["live"])
    newest = odometry[-1][1]
    last = recording.time_ns(len(recording.frames) - 1)
    assert stamp_ns(newest) == last
    assert (newest.header.frame_id, newest.child_frame_id) == ("odom", "camera_optical")
    # Loops are closed at the end of a run only.
    whole = poses(simulated / "run/trajectory.csv")[-1]
    position = newest.pose.pose.position
    off_m = math.hypot(position.x - float(whole["x_m"]), position.y - float(whole["y_m"]))
    assert off_m < 2e-3, (position, whole)
    covariance = newest.pose.covariance
    assert covariance[0] > 0 and covariance[7] > 0 and covariance[35] > 0
    newest = transforms[-1][1].transforms
    assert [(t.header.frame_id, t.child_frame_id) for t in newest] == [
        ("map", "odom"),
        ("odom", "camera_optical"),
    ]
    assert newest[1].transform.translation == position
