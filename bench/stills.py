#!/usr/bin/env python3
"""A plain chain of similarities over drone stills, beside a run of odograph.

    python3 bench/recordings.py nadir_caliterra --data DATA && python3 bench/stills.py --data DATA

Needs numpy and opencv-python-headless. The chain: 2000 SIFT features per image, matches that pass
Lowe's ratio test of 0.75, a similarity between consecutive images by RANSAC (3 px), the camera in
the middle of each image. Prints the root mean square distance to GPS after the best similarity
transform, over the ground and with the altitude.
"""

import argparse
import csv
from pathlib import Path

import cv2
import numpy as np

FOCAL_PX = 729.3


def chain(images):
    """Position and height of the camera at each image, in pixels of the first one."""
    detector, matcher = cv2.SIFT_create(2000), cv2.BFMatcher()
    cv2.setRNGSeed(0)
    to_first, before, path = np.eye(3), None, []
    for name in images:
        image = cv2.imread(str(name), cv2.IMREAD_GRAYSCALE)
        points, descriptors = detector.detectAndCompute(image, None)
        if before is not None:
            pairs = [a for a, b in matcher.knnMatch(descriptors, before[1], k=2) if a.distance < 0.75 * b.distance]
            here = np.float32([points[pair.queryIdx].pt for pair in pairs])
            there = np.float32([before[0][pair.trainIdx].pt for pair in pairs])
            step, _ = cv2.estimateAffinePartial2D(here, there, ransacReprojThreshold=3)
            to_first = to_first @ np.vstack([step, [0, 0, 1]])
        before = points, descriptors
        height, width = image.shape
        x, y, _ = to_first @ [(width - 1) / 2, (height - 1) / 2, 1]
        path.append([x, -y, FOCAL_PX * np.sqrt(np.linalg.det(to_first[:2, :2]))])
    return np.array(path)


def error_m(estimate, truth):
    """Root mean square distance after the best similarity transform (S. Umeyama, 1991)."""
    x, y = estimate - estimate.mean(0), truth - truth.mean(0)
    u, singular, v = np.linalg.svd(y.T @ x)
    signs = np.ones(len(singular))
    signs[-1] = np.sign(np.linalg.det(u @ v))
    scale = (singular * signs).sum() / (x**2).sum()
    return np.sqrt(((y - scale * x @ (u * signs @ v).T) ** 2).sum(1).mean())


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--run", type=Path, default=Path("target/recordings/nadir_caliterra/run"))
    arguments = parser.parse_args()
    folder = arguments.data / "nadir_caliterra"
    with (folder / "gps.csv").open() as file:
        rows = list(csv.DictReader(file))
    truth = np.array([[float(row[key]) for key in ("east_m", "north_m", "alt")] for row in rows])
    paths = {"chain": (chain([folder / "images" / row["file"] for row in rows]), truth)}
    if (arguments.run / "trajectory.tum").exists():
        run = np.loadtxt(arguments.run / "trajectory.tum")
        paths["odograph"] = run[:, 1:4], truth[np.rint(run[:, 0]).astype(int)]
    print("| | images | over the ground, m | with the altitude, m |\n|---|---|---|---|")
    for name, (path, gps) in paths.items():
        print(f"| {name} | {len(path)} | {error_m(path[:, :2], gps[:, :2]):.1f} | {error_m(path, gps):.1f} |")


if __name__ == "__main__":
    main()
