#!/usr/bin/env python3
"""What errors of the camera file and the rig file do to a path, beside plain OpenCV.

    cargo build --release && python3 bench/careless_calibration.py [PATH …]

Needs numpy and opencv-python-headless. Renders drives and follows each with calibrations that are
off by one thing, as those of a careless user are. Both programs get the same wrong camera file; the
OpenCV program takes the camera to look straight down. Errors are of (x, y) over each metre, with
the first poses aligned. A wrong focal length is a wrong scale for both.
"""

import argparse
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np
from opencv import Clip
from opencv_reference import Reference
from random_drives import heading, judged, ours, plain

DRIVES = {
    "straight": "--texture asphalt --path straight --length 3 --seed 5",
    "eight": "--texture asphalt --path eight --duration 14 --seed 5",
    "square": "--texture concrete --path square --seed 6",
    "lanes": "--texture carpet --path lanes --duration 14 --seed 7",
}
COMMON = "--speed 0.5 --height 0.75 --format y4m"

# Added to (fx, fy, cx, cy), to (k1, k2, p1, p2, k3), and to roll and pitch in degrees.
ERRORS = {
    "none": ([0, 0, 0, 0], [0, 0, 0, 0, 0], [0, 0]),
    "focal length +1 %": ([5, 5, 0, 0], [0, 0, 0, 0, 0], [0, 0]),
    "fx +0.5 %": ([2.5, 0, 0, 0], [0, 0, 0, 0, 0], [0, 0]),
    "fy +0.5 %": ([0, 2.5, 0, 0], [0, 0, 0, 0, 0], [0, 0]),
    "centre +5, -4 px": ([0, 0, 5, -4], [0, 0, 0, 0, 0], [0, 0]),
    "centre -8, +6 px": ([0, 0, -8, 6], [0, 0, 0, 0, 0], [0, 0]),
    "k1 +0.02": ([0, 0, 0, 0], [0.02, 0, 0, 0, 0], [0, 0]),
    "p1 +0.002": ([0, 0, 0, 0], [0, 0, 0.002, 0, 0], [0, 0]),
    "p2 -0.002": ([0, 0, 0, 0], [0, 0, 0, -0.002, 0], [0, 0]),
    "no distortion": ([0, 0, 0, 0], [0.12, -0.02, -0.0004, 0.0003, 0], [0, 0]),
    "roll +3 deg": ([0, 0, 0, 0], [0, 0, 0, 0, 0], [3, 0]),
    "pitch -1 deg": ([0, 0, 0, 0], [0, 0, 0, 0, 0], [0, -1]),
}


def numbers(text, key):
    """The list after a key of a camera file, and where it stands."""
    found = re.search(key + r".*?data: \[([^\]]*)\]", text, re.DOTALL)
    return [float(value) for value in found.group(1).split(",")], found.span(1)


def replaced(text, span, values):
    return text[: span[0]] + ", ".join(repr(float(value)) for value in values) + text[span[1] :]


def write_calibration(folder, camera, rig, error):
    of_camera, of_lens, of_mount = error
    matrix, span = numbers(camera, "camera_matrix")
    for at, by in zip([0, 4, 2, 5], of_camera):
        matrix[at] += by
    camera = replaced(camera, span, matrix)
    lens, span = numbers(camera, "distortion_coefficients")
    camera = replaced(camera, span, np.add(lens, of_lens))
    for key, by in zip(["roll_deg", "pitch_deg"], of_mount):
        rig = re.sub(rf"{key} = (\S+)", lambda found: f"{key} = {float(found.group(1)) + by}", rig)
    (folder / "camera.yaml").write_text(camera)
    (folder / "rig.toml").write_text(rig)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--program", default="target/release/odograph")
    parser.add_argument("drives", nargs="*", metavar="PATH", help=", ".join(DRIVES))
    given = parser.parse_args()
    cv2.setNumThreads(1)
    for drive in given.drives or DRIVES:
        with tempfile.TemporaryDirectory() as folder:
            folder = Path(folder) / "drive"
            command = [given.program, "simulate", *DRIVES[drive].split(), *COMMON.split(), "-o", str(folder)]
            subprocess.run(command, check=True, capture_output=True)
            camera, rig = (folder / "camera.yaml").read_text(), (folder / "rig.toml").read_text()
            times = np.loadtxt(folder / "truth.tum")[:, 0]
            for name, error in ERRORS.items():
                write_calibration(folder, camera, rig, error)
                clip = Clip(folder)
                truth = np.column_stack([clip.positions[:, :2], [heading(turned) for turned in clip.rotations]])
                shutil.rmtree(folder / "out", ignore_errors=True)
                estimate, variance, code = ours(given.program, next(folder.glob("*.y4m")), times)
                figures, marks = judged(truth, estimate, variance, plain(Reference(clip), clip.frames))
                print(f"{drive}, {name}: {figures}, code {code} {marks}", flush=True)


if __name__ == "__main__":
    main()
