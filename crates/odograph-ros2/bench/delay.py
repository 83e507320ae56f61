"""Delay, rate, processor time and memory of the program with ROS 2: `../tests/run PYTHON PROGRAM` with
`../bench/delay.py` behind it. Images of 640x480 at 30 Hz for a minute."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import messages as ros
from robot import Program, Recording, Robot, matched, play, stamp_ns, until

SECONDS = int(os.environ.get("SECONDS", "60"))


def test_delay(tmp_path):
    simulate = f"simulate -o sim --format y4m --size 640x480 --path eight --length 3 --duration {SECONDS} -q"
    subprocess.run([os.environ["ODOGRAPH"], *simulate.split()], cwd=tmp_path, check=True)
    recording = Recording(tmp_path / "sim/sim.y4m")
    robot = Robot(39)
    odometry = robot.listen("/odom", ros.Odometry)
    images = robot.writer("/camera/image_raw", ros.Image)
    given = "--camera sim/camera.yaml --rig sim/rig.toml"
    program = Program(tmp_path, f"live ros2:/camera/image_raw {given} --ros2 -o live")
    until(lambda: matched(images), what="the subscription")
    before_s = program.processor_s()
    writing_ms = []

    def send(number):
        began_s = time.monotonic()
        images.write(recording.image(number))
        writing_ms.append(1e3 * (time.monotonic() - began_s))

    sent = play(recording, send)
    used_s = program.processor_s() - before_s
    memory_mb = program.memory_mb()
    last = recording.time_ns(len(recording.frames) - 1)
    until(lambda: odometry and stamp_ns(odometry[-1][1]) == last, what="the last odometry")
    program.interrupt()
    code, said = program.end()
    live = json.loads((tmp_path / "live/stats.json").read_text())["live"]
    numbers = {recording.time_ns(number): number for number in sent}
    delays_ms = sorted(1e3 * (at - sent[numbers[stamp_ns(message)]]) for at, message in odometry)
    print(said)
    print(f"{len(sent)} images sent, {live['frames_captured']} captured, {live['frames_dropped']} dropped,")
    print(f"{len(odometry)} odometries; from before sending to receiving: median", end=" ")
    print(f"{delays_ms[len(delays_ms) // 2]:.1f} ms, 99 % {delays_ms[len(delays_ms) * 99 // 100]:.1f} ms,", end=" ")
    print(f"most {delays_ms[-1]:.1f} ms; inside the program {live['latency_median_ms']:.1f} ms")
    print(f"of this, sending took {sorted(writing_ms)[len(writing_ms) // 2]:.1f} ms in the median")
    print(f"processor {100 * used_s / SECONDS:.0f} % of a core, memory at most {memory_mb:.0f} MB")
    robot.close()
    assert code == 0
