#!/usr/bin/env python3
"""Drives with random combinations of effects, ours beside a plain OpenCV odometry.

    cargo build --release && python3 bench/random_drives.py --seed 1000 --count 90 [--photos FOLDER]

Needs numpy and opencv-python-headless. The rows of the gate and of the field have one effect each;
what goes wrong goes wrong where two or three meet. Each number is a drive: ground, path, speed,
height, image size, shutter, shaking, blur, relief, things fixed in the image, light, and what a
camera's processing does to its images. Errors are of (x, y), with the first poses aligned. NEES is
1 where the stated covariance of (x, y) is true. Marked are drives with lost frames, with a larger
error over each metre than OpenCV's, and with a NEES above 8. A drive takes some 20 s.
"""

import argparse
import csv
import math
import random
import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np

from opencv import Clip, rotation
from opencv_reference import Reference

FRAMES = 150
FOCAL_SHARE = 500 / 640  # of the renderer's camera, in widths of the image
GROUNDS = ["asphalt", "carpet", "tiles", "bricks", "grass", "concrete"]


def jpeg(image, quality):
    return cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 0)


def sharpened(image, amount):
    return cv2.addWeighted(image, 1 + amount, cv2.GaussianBlur(image, (0, 0), 1.5), -amount, 0)


def upscaled(image):
    height, width = image.shape
    small = cv2.resize(image, (width * 2 // 3, height * 2 // 3), interpolation=cv2.INTER_AREA)
    return cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)


PROCESSING = {
    "plain": lambda image: image,
    "jpeg-70": lambda image: jpeg(image, 70),
    "jpeg-30": lambda image: jpeg(image, 30),
    "sharpened": lambda image: sharpened(image, 1.0),
    "sharpened-jpeg": lambda image: jpeg(sharpened(image, 0.6), 80),
    "denoised": lambda image: cv2.bilateralFilter(image, 5, 20, 3),
    "median": lambda image: cv2.medianBlur(image, 3),
    "gamma": lambda image: (255 * (image / 255.0) ** 0.5).astype(np.uint8),
    "local-contrast": lambda image: cv2.createCLAHE(3.0, (8, 8)).apply(image),
    "upscaled": upscaled,
}


def drawn(seed, photos):
    """The options of `odograph simulate`, and the processing, of a drive."""
    r = random.Random(seed)
    often = lambda share: r.random() < share  # noqa: E731
    width, height = r.choice([(320, 240), (640, 480), (640, 480), (640, 360)])
    fps, above_m = r.choice([15, 20, 30, 30]), r.choice([0.15, 0.3, 0.5, 0.75, 1.2, 1.5])
    view_m = above_m * height / (FOCAL_SHARE * width)
    # Robots: 0.5 to 2.5 m/s at a height of 1 m, at most a quarter of the view in a frame.
    speed_m_s = min(r.uniform(0.02, 0.25) * view_m * fps, r.uniform(0.5, 2.5) * math.sqrt(above_m))
    seconds, focal_px = FRAMES / fps, FOCAL_SHARE * width
    options = {"size": f"{width}x{height}", "fps": fps, "height": above_m, "seed": seed}
    options |= {"duration": f"{seconds:.3f}", "speed": f"{speed_m_s:.4f}", "noise": r.choice([1, 2, 2, 3, 5])}
    if photos and often(0.5):
        options |= {"texture": r.choice(photos), "photo-width": f"{above_m * r.uniform(1.5, 4):.2f}m"}
        options["tiling"] = r.choice(["mirror", "scatter"])
    else:
        options["texture"] = r.choice(GROUNDS)
    options["path"] = r.choice(["straight", "eight", "square", "walk"])
    if options["path"] == "square":
        options["length"] = f"{max(speed_m_s * seconds / 5, 0.05):.3f}m"
    if often(0.5):
        options["readout-ms"] = f"{r.uniform(4, min(30, 950 / fps)):.1f}"
        if often(0.3):
            options["tell-readout"] = None
    if often(0.4):
        shake_mm, degrees, hertz = r.uniform(0.5, 4) * min(1, above_m), r.uniform(0.1, 0.5), r.uniform(3, 0.4 * fps)
        options["vibration"] = f"{shake_mm:.2f}:{degrees:.2f}:{hertz:.1f}"
    if often(0.4):  # at most 6 pixels
        options["blur"] = f"{min(r.uniform(0.002, 0.012), 6 * above_m / (speed_m_s * focal_px)):.4f}"
    if often(0.3):
        options["relief"] = f"{r.uniform(3, 15) * above_m:.1f}:{max(1, above_m * 6):.1f}"
    elif often(0.15):
        options["undulation"] = f"{above_m * 3:.1f}:{above_m * 3:.2f}"
        if often(0.5):
            options["ride"] = None
    rare = {
        "bumper": f"{r.uniform(0.05, 0.3):.2f}",
        "dirt": r.randint(3, 30),
        "lamp": None,
        "shadow": None,
        "ground-shadow": None,
        "lighting": None,
        "exposure-jumps": None,
        "object": None,
        "sway": f"{r.uniform(2, 8):.1f}:{r.uniform(0.1, 0.45):.2f}",
        "height-change": f"{r.uniform(2, 10):.1f}",
        "tilt-change": f"{r.uniform(0.5, 3):.1f}",
    }
    options |= {name: value for name, value in rare.items() if often(0.15)}
    return options, r.choice(list(PROCESSING))


def arguments(options):
    words = ([f"--{name}"] + ([] if value is None else [str(value)]) for name, value in options.items())
    return [word for pair in words for word in pair]


def process(clip, processing):
    """Replaces the video by its processed frames."""
    video = next(clip.folder.glob("*.y4m"))
    with open(video, "rb") as file:
        words = [word for word in file.readline().split() if not word.startswith(b"C")]
    clip.frames = [PROCESSING[processing](image) for image in clip.frames]
    with open(video, "wb") as file:
        file.write(b" ".join(words + [b"Cmono"]) + b"\n")
        for image in clip.frames:
            file.write(b"FRAME\n" + image.tobytes())
    return video


def heading(turned):
    """Direction of the image's top in the world."""
    return math.atan2(-turned[1, 1], -turned[0, 1])


def against(truth, estimate):
    """Errors over a metre (or a third of the path), per cent, and of (x, y), metres."""
    posed = np.isfinite(estimate[:, 0])
    first = int(np.argmax(posed))
    turn = truth[first, 2] - estimate[first, 2]
    matrix = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    aligned = (estimate[:, :2] - estimate[first, :2]) @ matrix.T + truth[first, :2]
    path_m = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(truth[:, :2], axis=0), axis=1))])
    unit_m, shares = min(1.0, path_m[-1] / 3), []
    for start in range(len(truth)):
        end = int(np.searchsorted(path_m, path_m[start] + unit_m))
        if end < len(truth) and posed[start] and posed[end]:
            known = local(truth[:, :2], truth[:, 2], start, end)
            found = local(aligned, estimate[:, 2] + turn, start, end)
            shares.append(np.linalg.norm(known - found) / (path_m[end] - path_m[start]))
    return 100 * np.mean(shares) if shares else math.nan, aligned - truth[:, :2], posed


def local(places, headings, start, end):
    c, s = math.cos(headings[start]), math.sin(headings[start])
    return np.array([[c, s], [-s, c]]) @ (places[end] - places[start])


def ours(program, video, times, more=()):
    """Our path, its variances, and the exit code."""
    folder = video.parent
    out = folder / "out"
    given = ["--camera", folder / "camera.yaml", "--rig", folder / "rig.toml", *more]
    run = subprocess.run([program, "run", video, *given, "-o", out], capture_output=True)
    estimate, variance = np.full((len(times), 3), np.nan), np.full(len(times), np.nan)
    if (out / "trajectory.tum").exists():
        for row in np.loadtxt(out / "trajectory.tum", ndmin=2):
            estimate[np.argmin(abs(times - row[0]))] = [row[1], row[2], heading(rotation(row[4:8]))]
        with open(out / "trajectory.csv") as file:
            for row in csv.DictReader(file):
                if row["sigma_x_m"]:
                    at = np.argmin(abs(times - float(row["time_s"])))
                    variance[at] = 0.5 * (float(row["sigma_x_m"]) ** 2 + float(row["sigma_y_m"]) ** 2)
    return estimate, variance, run.returncode


def plain(reference, images):
    """The path of the OpenCV odometry."""
    poses = []
    for image in images:
        reference.process(image)
        pose = reference.world_from_camera()
        poses.append([pose[0, 3], pose[1, 3], heading(pose[:3, :3])])
    return np.array(poses)


def judged(truth, estimate, variance, of_opencv):
    """The figures of a drive, and its marks."""
    share, errors, posed = against(truth, estimate)
    share_of_opencv, _, _ = against(truth, of_opencv)
    stated = posed & (variance > 0)  # the first pose is exact
    squares = (errors[stated] ** 2).sum(axis=1) / 2 / variance[stated]
    nees = squares.mean() if stated.any() else math.nan
    marks = [("LOST", posed.mean() < 0.995), ("WORSE", not share <= share_of_opencv), ("NEES", nees > 8)]
    marks = " ".join(mark for mark, applies in marks if applies)
    rmse_mm = 1e3 * math.sqrt(np.mean((errors[posed] ** 2).sum(axis=1))) if posed.any() else math.nan
    figures = f"{share:.4f} % (OpenCV {share_of_opencv:.4f}), RMSE {rmse_mm:.2f} mm, NEES {nees:.1f}"
    return f"{figures}, posed {100 * posed.mean():.0f} %", marks


def row(program, seed, photos):
    options, processing = drawn(seed, photos)
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder) / "drive"
        command = [program, "simulate", *arguments(options), "--format", "y4m", "-o", str(folder)]
        rendered = subprocess.run(command, capture_output=True, text=True)
        label = f"{processing} {' '.join(arguments(options))}"
        if rendered.returncode:
            return f"{seed}: {rendered.stderr.strip().splitlines()[-1]} ({label})"
        clip = Clip(folder)
        video = process(clip, processing)
        times = np.loadtxt(folder / "truth.tum")[:, 0]
        truth = np.column_stack([clip.positions[:, :2], [heading(turned) for turned in clip.rotations]])
        estimate, variance, code = ours(program, video, times)
        figures, marks = judged(truth, estimate, variance, plain(Reference(clip), clip.frames))
    return f"{seed}: {figures}, code {code} {marks} | {label}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--program", default="target/release/odograph")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--photos", type=Path, help="a folder of photographs of ground")
    given = parser.parse_args()
    photos = sorted(map(str, given.photos.iterdir())) if given.photos else []
    cv2.setNumThreads(1)
    for seed in range(given.seed, given.seed + given.count):
        print(row(given.program, seed, photos), flush=True)


if __name__ == "__main__":
    main()
