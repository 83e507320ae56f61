#!/usr/bin/env python3
"""Clips of one to ten seconds with nothing but a camera and a height: the error against what is stated.

    cargo build --release && python3 bench/short_clips.py --count 40 [--photos FOLDER]

Needs numpy. Each number is a clip: ground, path, speed, height, a tilt of the mount that the program
is not told (1.5 degrees, one standard deviation), now and then vibration or a rolling shutter. What
a frame or two show of the tilt cannot be much, so that the stated covariance has to say it. NEES is
1 where it is true; first of (x, y), then of the heading. Errors are root mean squares, beside the
stated standard deviations. A clip takes some five seconds.
"""

import argparse
import csv
import math
import random
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from opencv import rotation

GROUNDS = ["asphalt", "carpet", "tiles", "bricks", "grass", "concrete"]
SECONDS = [1, 2, 3, 10]


def drawn(seed, photos):
    """The options of `odograph simulate`."""
    r = random.Random(seed)
    height_m, fps = r.choice([0.3, 0.5, 0.75, 1.2]), r.choice([20, 30])
    options = {"height": height_m, "fps": fps, "seed": seed, "duration": SECONDS[seed % len(SECONDS)]}
    options |= {"speed": f"{r.uniform(0.4, 1.2) * height_m:.3f}", "noise": r.choice([1, 2, 3])}
    options |= {"roll": f"{r.gauss(0, 1.5):.2f}", "pitch": f"{r.gauss(0, 1.5):.2f}"}
    options |= {"size": r.choice(["320x240", "640x480", "640x360"])}
    options["path"] = r.choice(["straight", "straight", "eight", "walk"])
    if photos and r.random() < 0.6:
        options |= {"texture": r.choice(photos), "photo-width": f"{height_m * r.uniform(1.5, 4):.2f}m"}
        options["tiling"] = "scatter"
    else:
        options["texture"] = r.choice(GROUNDS)
    if r.random() < 0.25:
        mm, degrees, hertz = r.uniform(0.5, 2) * height_m, r.uniform(0.05, 0.3), r.uniform(3, 0.4 * fps)
        options["vibration"] = f"{mm:.2f}:{degrees:.2f}:{hertz:.1f}"
    if r.random() < 0.25:
        options["readout-ms"] = f"{r.uniform(5, 25):.1f}"
    return options


def heading(turned):
    """Direction of the image's top in the world."""
    return math.atan2(-turned[1, 1], -turned[0, 1])


def pose(row):
    return [row[1], row[2], heading(rotation(row[4:8]))]


def followed(program, options, folder):
    """Poses, ground truth, and stated deviations of (x, y, heading) of every frame with a pose."""
    words = [f"--{name}={value}" for name, value in options.items()]
    subprocess.run([program, "simulate", *words, "--format", "y4m", "-o", folder], check=True, capture_output=True)
    given = ["--camera", folder / "camera.yaml", "--height", str(options["height"])]
    run = [program, "run", next(folder.glob("*.y4m")), *given, "-o", folder / "out"]
    subprocess.run(run, capture_output=True)
    truth = {round(row[0], 4): pose(row) for row in np.loadtxt(folder / "truth.tum")}
    with open(folder / "out" / "trajectory.csv") as file:
        table = {round(float(row["time_s"]), 4): row for row in csv.DictReader(file) if row["x_m"]}
    poses = np.array([pose(row) for row in np.loadtxt(folder / "out" / "trajectory.tum", ndmin=2)])
    deviation = lambda row: [  # noqa: E731
        float(row["sigma_x_m"]),
        float(row["sigma_y_m"]),
        math.radians(float(row["sigma_heading_deg"])),
    ]
    return poses, np.array([truth[time] for time in table]), np.array([deviation(row) for row in table.values()])


def figures(poses, truth, stated):
    """Errors after alignment of the first pose, stated deviations, and NEES."""
    turn = truth[0, 2] - poses[0, 2]
    matrix = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    off_m = (poses[:, :2] - poses[0, :2]) @ matrix.T + truth[0, :2] - truth[:, :2]
    off_rad = (poses[:, 2] + turn - truth[:, 2] + math.pi) % (2 * math.pi) - math.pi
    variance = 0.5 * (stated[:, :2] ** 2).sum(axis=1)
    known = (variance > 0) & (stated[:, 2] > 0)  # the first pose is exact
    of_place = ((off_m[known] ** 2).sum(axis=1) / 2 / variance[known]).mean()
    of_heading = ((off_rad[known] / stated[known, 2]) ** 2).mean()
    root = lambda squares: math.sqrt(squares.mean())  # noqa: E731
    place = 1e3 * root((off_m**2).sum(axis=1)), 1e3 * root(2 * variance)
    turned = math.degrees(root(off_rad**2)), math.degrees(root(stated[:, 2] ** 2))
    return place, turned, of_place, of_heading


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--program", default="target/release/odograph")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--photos", type=Path, help="a folder of photographs of ground")
    given = parser.parse_args()
    photos = sorted(map(str, given.photos.iterdir())) if given.photos else []
    all_nees = []
    for seed in range(given.seed, given.seed + given.count):
        options = drawn(seed, photos)
        with tempfile.TemporaryDirectory() as folder:
            place, turned, *nees = figures(*followed(given.program, options, Path(folder) / "drive"))
        all_nees.append(nees)
        label = " ".join(f"--{name}={value}" for name, value in options.items())
        error = f"{place[0]:.2f} mm (stated {place[1]:.2f}), {turned[0]:.3f}° ({turned[1]:.3f})"
        print(f"{seed}: {error}, NEES {nees[0]:.1f} {nees[1]:.1f} | {label}", flush=True)
    for name, values in zip(("x, y", "heading"), np.array(all_nees).T):
        spread = f"median {np.median(values):.2f}, mean {values.mean():.1f}, largest {values.max():.1f}"
        print(f"NEES of {name}: {spread}, above 4 in {(values > 4).sum()} of {len(values)}")


if __name__ == "__main__":
    main()
