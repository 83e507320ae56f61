#!/usr/bin/env python3
"""A plain OpenCV odometry on the clips of the gate, with its results beside those of the gate.

    cargo build --release -p odograph-gate && python3 bench/opencv_reference.py [--ours bench/baseline.json] [ROW ...]

Needs numpy and opencv-python-headless. The gate writes the clips of the rows whose name contains
one of the words (all rendered rows without any; several gigabytes, one row at a time). The
reference is that of `bench/opencv.py`: corners per keyframe, Lucas-Kanade, undistorted points, a
rigid fit by RANSAC to ground points. It is given only the camera and the height, and always outputs
a pose. Measures are defined as in the gate; times are processor times of the thread.
"""

import argparse
import json
import math
import subprocess
import tempfile
import tomllib
from pathlib import Path

import cv2
import numpy as np

from opencv import Clip, OpenCvProgram, corners, milliseconds

# Camera axes in the world, for a camera that looks straight down with the image's top towards +x.
STRAIGHT_DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class Reference(OpenCvProgram):
    """The same, with the height of the rig file, continuing where an image has no corners."""

    def __init__(self, clip):
        super().__init__(clip)
        self.height_m = tomllib.loads((clip.folder / "rig.toml").read_text())["height_m"]

    def make_keyframe(self, image):
        if corners(image) is not None:
            super().make_keyframe(image)

    def world_from_camera(self):
        """The pose in the world, from that in the axes of the first image, which are mirrored."""
        up = -self.pose[:2, 1]
        heading = math.atan2(-up[0], -up[1])
        c, s = math.cos(heading), math.sin(heading)
        pose = np.eye(4)
        pose[:3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ STRAIGHT_DOWN
        pose[:3, 3] = -self.pose[1, 2], -self.pose[0, 2], self.height_m
        return pose


def true_poses(clip):
    poses = np.tile(np.eye(4), (len(clip.positions), 1, 1))
    poses[:, :3, :3] = clip.rotations
    poses[:, :3, 3] = clip.positions
    return poses


def error_between(truth, estimate, start, end):
    """Relative pose error between two poses, after Sturm et al. 2012, equation 1."""
    inverse = np.linalg.inv
    return inverse(inverse(truth[start]) @ truth[end]) @ inverse(estimate[start]) @ estimate[end]


def heading_error(truth, error, end):
    """The rotation about the world's z axis in a relative rotation error."""
    in_world = truth[end, :3, :3] @ error[:3, :3] @ truth[end, :3, :3].T
    return math.atan2(in_world[1, 0] - in_world[0, 1], in_world[0, 0] + in_world[1, 1])


def figures(clip):
    program, estimate, times_ms = Reference(clip), [], []
    for image in clip.frames:
        times_ms.append(milliseconds(lambda: program.process(image))[0])
        estimate.append(program.world_from_camera())
    truth, estimate = true_poses(clip), np.array(estimate)
    steps = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    path_m = np.concatenate([[0.0], np.cumsum(steps)])
    drift, heading = [], []
    for start in range(len(truth)):
        end = int(np.searchsorted(path_m, path_m[start] + 1.0))
        if end >= len(truth):
            break
        error, length_m = error_between(truth, estimate, start, end), path_m[end] - path_m[start]
        drift.append(100 * np.linalg.norm(error[:3, 3]) / length_m)
        heading.append(abs(math.degrees(heading_error(truth, error, end))) / length_m)
    last = error_between(truth, estimate, 0, len(truth) - 1)
    return {
        "drift_percent": float(np.mean(drift)),
        "heading_deg_per_m": float(np.mean(heading)),
        "end_mm": 1e3 * float(np.linalg.norm(last[:3, 3])),
        "frame_ms": float(np.mean(times_ms)),
    }


def median_over_seeds(runs):
    return {key: sorted(run[key] for run in runs)[len(runs) // 2] for key in runs[0]}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gate", type=Path, default=Path("target/release/gate"))
    parser.add_argument("--ours", type=Path, default=Path("bench/baseline.json"), help="figures that the gate wrote")
    parser.add_argument("--field", action="store_true", help="the figures are those of gate --field")
    parser.add_argument("--json", type=Path, help="writes the reference's figures there")
    parser.add_argument("words", nargs="*")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    theirs = {}
    print("| row | error over each metre, % | OpenCV | heading, °/m | OpenCV | at the end, mm | OpenCV | a frame, ms | OpenCV |")
    print("|---|---|---|---|---|---|---|---|---|", flush=True)
    for row in json.loads(arguments.ours.read_text())["rows"]:
        name, ours = row["name"], row["figures"]
        chosen = not arguments.words or any(word in name for word in arguments.words)
        if not chosen or "drift_percent" not in ours:
            continue
        with tempfile.TemporaryDirectory() as folder:
            seeds = ["--first-seed", str(row["first_seed"]), "--seeds", str(row["seeds"])]
            field = ["--field"] if arguments.field else []
            subprocess.run([arguments.gate, name, *field, "--export", folder, *seeds], check=True, capture_output=True)
            # The word may match other rows as well.
            clips = [path for path in sorted(Path(folder).iterdir()) if path.name.rpartition("-")[0] == name]
            theirs[name] = median_over_seeds([figures(Clip(path)) for path in clips])
        cells = []
        for key, form in [("drift_percent", ".4f"), ("heading_deg_per_m", ".4f"), ("end_mm", ".2f"), ("frame_ms", ".2f")]:
            cells += [f"{ours[key]:{form}}", f"{theirs[name][key]:{form}}"]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(theirs, indent=2) + "\n")


if __name__ == "__main__":
    main()
