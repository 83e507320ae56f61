#!/usr/bin/env python3
"""Undistortion of whole images compared with OpenCV's `remap`, in one run, each on one thread.

    cargo build --release -p odograph --example undistort_speed && python3 bench/undistort.py [--rounds 7]

OpenCV gets fixed-point maps (`convertMaps` to CV_16SC2 and CV_16UC1), bilinear. The images are
noise over a gradient, with strong barrel distortion. Prints minimum and median time of each in
milliseconds, their ratios, and the maximum difference in gray levels from bilinear interpolation in
double precision. On a machine with other load, only the minimum is meaningful.
"""

import argparse
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

LENS = np.array([-0.28, 0.07, 0.0002, -0.0003, 0.0])


def camera_file(size, matrix):
    def numbers(values):
        return ", ".join(f"{value:.12g}" for value in np.asarray(values).ravel())

    return (
        f"%YAML:1.0\n---\nimage_width: {size[0]}\nimage_height: {size[1]}\n"
        f"camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ {numbers(matrix)} ]\n"
        f"distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n   data: [ {numbers(LENS)} ]\n"
    )


def exact(image, maps):
    """Bilinear interpolation in double precision, black outside the outermost pixel centres."""
    x, y = (axis.astype(np.float64) for axis in maps)
    height, width = image.shape[:2]
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    left = np.clip(np.floor(x), 0, width - 2).astype(int)
    top = np.clip(np.floor(y), 0, height - 2).astype(int)
    shape = (*x.shape, *([1] * (image.ndim - 2)))
    u, v = (x - left).reshape(shape), (y - top).reshape(shape)
    samples = image.astype(np.float64)
    upper = samples[top, left] * (1 - u) + samples[top, left + 1] * u
    lower = samples[top + 1, left] * (1 - u) + samples[top + 1, left + 1] * u
    return upper * (1 - v) + lower * v, inside


def exact_maps(size, matrix):
    x, y = np.meshgrid(np.arange(size[0], dtype=np.float64), np.arange(size[1], dtype=np.float64))
    rays = np.stack([(x - matrix[0, 2]) / matrix[0, 0], (y - matrix[1, 2]) / matrix[1, 1], np.ones_like(x)], -1)
    places, _ = cv2.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, LENS)
    places = places.reshape(size[1], size[0], 2)
    return places[..., 0], places[..., 1]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--program", type=Path, default=Path("target/release/examples/undistort_speed"))
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--repetitions", type=int, default=40)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    random = np.random.default_rng(1)
    for size in [(640, 480), (1280, 720), (1920, 1080)]:
        focal = 0.75 * size[0]
        matrix = np.array([[focal, 0, size[0] / 2 + 3.3], [0, focal * 1.002, size[1] / 2 - 2.1], [0, 0, 1]])
        maps = cv2.initUndistortRectifyMap(matrix, LENS, None, matrix, size, cv2.CV_32FC1)
        fixed = cv2.convertMaps(*maps, cv2.CV_16SC2)
        for channels, name in [(1, "gray"), (3, "colour")]:
            gradient = np.linspace(40, 200, size[0])[None, :, None]
            image = np.clip(gradient + random.normal(0, 25, (size[1], size[0], channels)), 0, 255).astype(np.uint8)
            image = np.ascontiguousarray(image[..., 0]) if channels == 1 else image
            with tempfile.TemporaryDirectory() as folder:
                folder = Path(folder)
                (folder / "camera.yaml").write_text(camera_file(size, matrix))
                kind = b"P5" if channels == 1 else b"P6"
                picture = folder / "picture"
                picture.write_bytes(kind + f" {size[0]} {size[1]} 255\n".encode() + image.tobytes())
                theirs, ours = [], []
                for _ in range(arguments.rounds):
                    command = [arguments.program, folder / "camera.yaml", picture, folder / "corrected"]
                    output = subprocess.run([*command, str(arguments.repetitions)], check=True, capture_output=True)
                    ours += [float(line) for line in output.stdout.split()]
                    corrected = np.empty_like(image)
                    for _ in range(arguments.repetitions):
                        start = time.perf_counter()
                        cv2.remap(image, *fixed, cv2.INTER_LINEAR, dst=corrected)
                        theirs.append((time.perf_counter() - start) * 1e3)
                samples = (folder / "corrected").read_bytes()[-image.size :]
                mine = np.frombuffer(samples, np.uint8).reshape(image.shape)
            wanted, inside = exact(image, exact_maps(size, matrix))
            off = [np.abs(result - wanted)[inside].max() for result in (mine, corrected)]
            median, least = [statistics.median(times) for times in (ours, theirs)], [min(ours), min(theirs)]
            print(
                f"{size[0]}x{size[1]} {name}: smallest {least[0]:.3f} ms, OpenCV {least[1]:.3f} ms, ratio {least[1] / least[0]:.1f}; "
                f"median {median[0]:.3f} ms, OpenCV {median[1]:.3f} ms, ratio {median[1] / median[0]:.1f}; "
                f"off by at most {off[0]:.2f} gray levels, OpenCV by {off[1]:.2f}"
            )


if __name__ == "__main__":
    main()
