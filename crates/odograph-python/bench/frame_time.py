"""Time of a frame in Python beside Rust: the same images, the same loop, in turns.

    python bench/frame_time.py [ROUNDS]

Needs the package installed and cargo. Prints milliseconds a frame, the best of the rounds.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import odograph as od

CRATE = Path(__file__).resolve().parents[1]
RUST = ["cargo", "run", "--release", "--quiet", "--example", "frame_time", "--"]


def python_ms(drive, images):
    odometry = od.Odometry(drive.camera, rig=drive.rig)
    times = drive.timestamps
    began = time.perf_counter()
    for image, t in zip(images, times):
        odometry.process(image, t)
    return 1e3 * (time.perf_counter() - began) / len(images)


def rust_ms(folder):
    ran = subprocess.run([*RUST, folder], cwd=CRATE, env=os.environ, check=True, capture_output=True, text=True)
    return float(ran.stdout)


def main():
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    drive = od.simulate("square", length=1.0)
    with tempfile.TemporaryDirectory() as folder:
        drive.save(folder)
        rust_ms(folder)  # builds
        images = [drive[at] for at in range(len(drive))]
        pairs = [(python_ms(drive, images), rust_ms(folder)) for _ in range(rounds)]
    python, rust = (min(column) for column in zip(*pairs))
    print(f"{len(images)} frames of 640x480: Python {python:.3f} ms, Rust {rust:.3f} ms, {python / rust:.3f} times")


if __name__ == "__main__":
    main()
