"""Grid and mosaic of a large place: `../tests/run PYTHON PROGRAM` with `../bench/large_ground.py` behind
it. Three sides of a square of 100 m in a minute."""

import json
import os
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

import messages as ros
from robot import LATCHED, Program, Recording, Robot, matched, odograph, play, stamp_ns, until

SECONDS = int(os.environ.get("SECONDS", "60"))


def of(arrived, bytes_of):
    sizes = [bytes_of(message) / 1e6 for _, message in arrived]
    gaps_s = sorted(b - a for (a, _), (b, _) in zip(arrived, arrived[1:]))
    return f"{len(arrived)}, the last of {sizes[-1]:.2f} MB, gaps of {gaps_s[0]:.1f} to {gaps_s[-1]:.1f} s"


def test_large_ground(tmp_path):
    way = "--path square --length 100 --speed 5 --height 1.2"
    odograph(tmp_path, f"simulate -o sim --format y4m --size 320x240 {way} --duration {SECONDS} -q")
    recording = Recording(tmp_path / "sim/sim.y4m")
    robot = Robot(38)
    odometry = robot.listen("/odom", ros.Odometry)
    grids = robot.listen("/odograph/grid", ros.OccupancyGrid, LATCHED)
    mosaics = robot.listen("/odograph/mosaic/compressed", ros.CompressedImage, LATCHED)
    images = robot.writer("/camera/image_raw", ros.Image)
    given = "--camera sim/camera.yaml --rig sim/rig.toml"
    program = Program(tmp_path, f"live ros2:/camera/image_raw {given} --ros2 -o live")
    until(lambda: matched(images), what="the subscription")
    before_s = program.processor_s()
    sent = play(recording, lambda number: images.write(recording.image(number)))
    used_s, memory_mb = program.processor_s() - before_s, program.memory_mb()
    time.sleep(3)
    program.interrupt()
    code, said = program.end(120)
    live = json.loads((tmp_path / "live/stats.json").read_text())["live"]
    numbers = {recording.time_ns(number): number for number in sent}
    delays_ms = sorted(1e3 * (at - sent[numbers[stamp_ns(message)]]) for at, message in odometry)
    print(said)
    info = grids[-1][1].info
    print(f"{live['frames_captured']} images captured, {live['frames_dropped']} dropped; {len(odometry)} odometries,")
    print(f"delay in the median {delays_ms[len(delays_ms) // 2]:.1f} ms, most {delays_ms[-1]:.1f} ms")
    print(f"grids: {of(grids, lambda grid: len(grid.data))}, {info.width}x{info.height} of {info.resolution:.2f} m")
    print(f"mosaics: {of(mosaics, lambda picture: len(picture.data))}")
    print(f"processor {100 * used_s / SECONDS:.0f} % of a core, memory at most {memory_mb:.0f} MB")
    robot.close()
    assert code == 0
