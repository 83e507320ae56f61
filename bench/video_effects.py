#!/usr/bin/env python3
"""What cameras, drivers and passers-by do to images, ours beside a plain OpenCV odometry.

    cargo build --release && python3 bench/video_effects.py [--ground concrete] [EFFECT ...]

Needs numpy and opencv-python-headless. A drive is rendered once for each ground; each effect changes
its images or their times, and both programs get the result. Errors are of (x, y), with the first
poses aligned. NEES is 1 where the stated covariance of (x, y) is true. Marked are drives with lost
frames, with a larger error over each metre than OpenCV's, and with a NEES above 8.
"""

import argparse
import math
import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np

from opencv import Clip, rotation
from opencv_reference import Reference
from random_drives import heading, judged, ours, plain

DRIVE = "--path eight --length 2m --speed 0.6 --duration 7 --fps 30 --size 640x480 --height 0.75 --noise 2"


def shifted(image, x, y):
    matrix = np.float32([[1, 0, x], [0, 1, y]])
    return cv2.warpAffine(image, matrix, image.shape[::-1], borderMode=cv2.BORDER_REFLECT)


def zoomed(image, factor):
    height, width = image.shape
    matrix = np.float32([[factor, 0, width / 2 * (1 - factor)], [0, factor, height / 2 * (1 - factor)]])
    return cv2.warpAffine(image, matrix, (width, height), borderMode=cv2.BORDER_REFLECT)


def gray(values):
    return np.clip(values + 0.5, 0, 255).astype(np.uint8)


def chosen(images, numbers):
    return [images[i] for i in numbers], numbers


def gaps(images, random):
    """Three to ten images in a row are lost, now and then."""
    numbers, at = [], 0
    while at < len(images):
        numbers.append(at)
        at += 1 + (random.integers(3, 11) if random.random() < 0.04 else 0)
    return chosen(images, numbers)


def slow(images, _):
    """Five images a second."""
    return chosen(images, range(0, len(images), 6))


def frozen(images, _):
    """The camera hands out one image a dozen times."""
    return [images[i - (i % 50 - 30)] if 30 <= i % 50 < 42 else images[i] for i in range(len(images))]


def half_updated(images, _):
    """Every other image has the lower half of the one before."""
    top = images[0].shape[0] // 2
    return [np.vstack([image[:top], images[i - i % 2][top:]]) for i, image in enumerate(images)]


def stabilised(images, random):
    """The image is cut out of a larger one, where a stabiliser wants it."""
    at, speed, out = np.zeros(2), np.zeros(2), []
    for image in images:
        speed = 0.9 * speed + random.normal(0, 0.6, 2) - 0.02 * at
        at = np.clip(at + speed, -18, 18)
        out.append(shifted(image, *at))
    return out


def shimmer(images, random):
    """Hot air: smooth shifts of 0.8 pixels that change from image to image."""
    height, width = images[0].shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    field, out = random.normal(0, 1, (2, 6, 8)), []
    for image in images:
        field = 0.6 * field + 0.8 * random.normal(0, 1, field.shape)
        dx, dy = (0.8 * cv2.resize(part.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC) for part in field)
        out.append(cv2.remap(image, x + dx, y + dy, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT))
    return out


def row_jitter(images, random):
    """Each row is shifted by itself, by 0.7 pixels."""
    height, width = images[0].shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    shift = lambda: random.normal(0, 0.7, (height, 1)).astype(np.float32)  # noqa: E731
    return [cv2.remap(image, x + shift(), y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT) for image in images]


def focus_hunting(images, _):
    """The focus is lost and found every 1.7 s, and the view breathes with it by 0.4 %."""
    out = []
    for i, image in enumerate(images):
        off = max(0.0, math.sin(2 * math.pi * i / 50))
        image = zoomed(image, 1 + 0.004 * off)
        out.append(cv2.GaussianBlur(image, (0, 0), 3.5 * off) if off > 0.1 else image)
    return out


def zoom_drift(images, _):
    """The focal length grows by 1 %."""
    return [zoomed(image, 1 + 0.01 * i / len(images)) for i, image in enumerate(images)]


def fog(images, random):
    """The window mists over until a sixteenth of the contrast is left."""
    out = []
    for i, image in enumerate(images):
        contrast = 1 - 0.94 * min(1, 1.4 * i / len(images))
        out.append(gray(128 + contrast * (image - 128.0) + random.normal(0, 1.5, image.shape)))
    return out


def flashes(images, _):
    """Every 20th image is lit by a flash, and the next one is dark."""
    change = {10: lambda image: gray(2.5 * image + 60.0), 11: lambda image: gray(0.4 * image)}
    return [change.get(i % 20, lambda image: image)(image) for i, image in enumerate(images)]


def night(images, random):
    """An eighth of the light: shot noise, and two gray levels for each electron."""
    return [gray(2.0 * random.poisson(0.12 * image) + random.normal(2, 1.5, image.shape)) for image in images]


def temporal_filter(images, _):
    """Noise reduction over time: what hardly changes follows late."""
    mean, out = images[0].astype(np.float32), []
    for image in images:
        change = np.abs(cv2.GaussianBlur(image - mean, (0, 0), 2))
        mean = mean + (image - mean) * np.clip(change / 12, 0.25, 1)
        out.append(gray(mean))
    return out


def fine_texture(random):
    return cv2.GaussianBlur(random.integers(0, 256, (900, 900), np.uint8), (0, 0), 0.8)


def over(image, texture, x, y, ellipse):
    """The image with a part of a texture at a place: an ellipse, or else a rectangle."""
    height, width = texture.shape
    full = cv2.warpAffine(texture, np.float32([[1, 0, x], [0, 1, y]]), image.shape[::-1])
    shape = np.full((height, width), 0 if ellipse else 255, np.uint8)
    if ellipse:
        cv2.ellipse(shape, (width // 2, height // 2), (width // 2, height // 2), 0, 0, 360, 255, -1)
    mask = cv2.warpAffine(shape, np.float32([[1, 0, x], [0, 1, y]]), image.shape[::-1])
    return np.where(mask > 127, full, image)


def feet(images, random):
    """Two feet walk through the view."""
    texture, out = fine_texture(random)[:100, :230], []
    for i, image in enumerate(images):
        for k in range(2):
            step = max(0.0, math.sin(2 * math.pi * (i / 45 + k / 2)))
            image = over(image, texture, -270 + (7 * i + 120 * k) % 1000 + 60 * step, 150 + 90 * k, True)
        out.append(image)
    return out


def cart(images, random):
    """A cart crosses three quarters of the view."""
    texture = fine_texture(random)[:460, :500]
    return [over(image, texture, -520 + 4.5 * i, 10, False) for i, image in enumerate(images)]


def arm(images, random):
    """An arm comes in within eight images, rests over the whole view, and goes back."""
    height, width = images[0].shape
    texture, out = fine_texture(random)[:height, :width], []
    for i, image in enumerate(images):
        at = i % 100
        share = min(max(0, at - 30) / 8, 1, max(0, 68 - at) / 8)
        out.append(over(image, texture, round((share - 1) * width), 0, False) if share > 0 else image)
    return out


EFFECTS = [
    gaps, slow, frozen, half_updated, stabilised, shimmer, row_jitter, focus_hunting, zoom_drift, fog, flashes,
    night, temporal_filter, feet, cart, arm,
]  # fmt: skip


def written(folder, drive, images, times):
    """The clip as both programs read it."""
    folder.mkdir()
    for name in ["camera.yaml", "rig.toml"]:
        (folder / name).write_bytes((drive / name).read_bytes())
    height, width = images[0].shape
    with open(folder / "clip.y4m", "wb") as file:
        file.write(b"YUV4MPEG2 W%d H%d F30:1 Ip A1:1 Cmono XCOLORRANGE=FULL\n" % (width, height))
        for image in images:
            file.write(b"FRAME\n" + image.tobytes())
    (folder / "times.txt").write_text("".join(f"{time:.9f}\n" for time in times))


def figures(program, effect, clip, drive, folder):
    changed = effect(clip.frames, np.random.default_rng(7))
    images, numbers = changed if isinstance(changed, tuple) else (changed, range(len(changed)))
    truth = np.loadtxt(drive / "truth.tum")[list(numbers)]
    written(folder, drive, images, truth[:, 0])
    video, times = folder / "clip.y4m", truth[:, 0]
    estimate, variance, _ = ours(program, video, times, ["--timestamps", folder / "times.txt"])
    true = np.column_stack([truth[:, 1:3], [heading(rotation(row[4:8])) for row in truth]])
    return " ".join(judged(true, estimate, variance, plain(Reference(clip), images)))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--program", default="target/release/odograph")
    parser.add_argument("--ground", default="concrete")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("effects", nargs="*", metavar="EFFECT", help=", ".join(e.__name__ for e in EFFECTS))
    given = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        command = f"simulate {DRIVE} --texture {given.ground} --seed {given.seed} --format y4m -o".split()
        subprocess.run([given.program, *command, folder / "drive"], check=True, capture_output=True)
        clip = Clip(folder / "drive")
        for effect in EFFECTS:
            if not given.effects or effect.__name__ in given.effects:
                row = figures(given.program, effect, clip, folder / "drive", folder / effect.__name__)
                print(f"{given.ground} {effect.__name__}: {row}", flush=True)


if __name__ == "__main__":
    main()
