#!/usr/bin/env python3
"""Runs odograph and a plain OpenCV chain on variants of the real recordings of a carried camera.

    python3 bench/real_variants.py --data FOLDER [--program target/release/odograph] [NAME ...]

Needs numpy, scipy and opencv-python-headless. One recording is one sample, and results on it vary
with every change. Variants are further samples with the same effects: they begin later, are
mirrored, or are played backwards and turned upside down, so that the rows are still read in the
order of time. Others leave out frames, or look as another camera would have recorded them (`LOOKS`).
Errors are root mean square position errors after alignment with the ground truth by SE(3), over the
frames with a pose.

The chain: Lucas-Kanade from frame to frame with a forward-backward check, corners on the plane
where they were first seen, and the pose by PnP with RANSAC. It is given the same camera, height and
tilt, and knows no keyframes and no rolling shutter.
"""

import argparse
import math
import subprocess
import tempfile
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

STRAIGHT_DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
MIRROR_WORLD = np.diag([1.0, -1.0, 1.0])


class Recording:
    """Files, times, true poses (rotation, position) and the camera."""

    def __init__(self, files, times, poses, focal, centre, distortion, size):
        self.files, self.times, self.poses = files, times, poses
        self.focal, self.centre, self.distortion, self.size = focal, centre, distortion, size


def floor_flight(data):
    folder = data / "floor_flight"
    listed = [line.split() for line in (folder / "frames.txt").read_text().splitlines()]
    truth = np.loadtxt(folder / "truth.tum")
    poses = []
    for time, _ in listed:
        row = truth[np.argmin(abs(truth[:, 0] - float(time)))]
        near = abs(row[0] - float(time)) < 2e-3
        poses.append((Rotation.from_quat(row[4:]).as_matrix(), row[1:4]) if near else None)
    files = [folder / "frames" / name for _, name in listed]
    times = [float(time) for time, _ in listed]
    distortion = [-0.4406669766843282, 0.1964351557428028, 0.0, 0.0]
    focal = (325.1524118828996, 325.1524118828996)
    return Recording(files, times, poses, focal, (167.95643598863253, 115.65797936810387), distortion, (320, 240))


def planar_checker_a(data):
    folder = data / "planar_checker_a"
    files = sorted((folder / "images").iterdir())
    poses = []
    for values in np.loadtxt(folder / "poses_omega_t.txt"):
        turn = Rotation.from_rotvec(values[:3]).as_matrix().T
        position = -turn @ values[3:]
        if position[2] < 0:  # the board's z axis points into the board
            turn, position = np.diag([1.0, -1.0, -1.0]) @ turn, np.diag([1.0, -1.0, -1.0]) @ position
        poses.append((turn, position))
    times = [number / 30 for number in range(len(files))]
    distortion = [-0.31418, 0.10884, 0.0, 0.0]
    return Recording(files, times, poses, (419.97, 419.31), (353.93, 250.78), distortion, (752, 480))


def with_noise(image, sigma, number):
    """Pixel noise of this standard deviation, gray levels, other in each frame."""
    return image + np.random.default_rng(number).normal(0, sigma, image.shape)


def vignetted(image):
    """A lamp that is brightest beside the middle, and three times darker in the corners."""
    height, width = image.shape
    y, x = np.mgrid[:height, :width]
    distance = ((x - 0.6 * width) ** 2 + (y - 0.4 * height) ** 2) / (0.25 * width) ** 2
    return image * (0.4 + 1.2 * np.exp(-0.5 * distance))


def behind_a_bumper(image):
    image = image.copy()
    image[int(0.85 * len(image)) :] = 30
    image[int(0.85 * len(image)) :, ::9] = 220
    return image


def compressed(image):
    quality = [cv2.IMWRITE_JPEG_QUALITY, 15]
    return cv2.imdecode(cv2.imencode(".jpg", np.uint8(image), quality)[1], cv2.IMREAD_GRAYSCALE)


# From an image in floating point and the number of its frame to another image.
LOOKS = {
    "": lambda image, _: image,
    "dim": lambda image, number: with_noise(0.25 * image, 1.5, number),
    "noisy": lambda image, number: with_noise(image, 8.0, number),
    "blurred": lambda image, _: cv2.GaussianBlur(image, (0, 0), 2.0),
    "changing exposure": lambda image, number: image * (1.0 + 0.4 * math.sin(number / 9.0)),
    "JPEG": lambda image, _: compressed(image),
    "half the size": lambda image, _: cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA),
    "lamp": lambda image, _: vignetted(image),
    "bumper": lambda image, _: behind_a_bumper(image),
}


def write_variant(recording, folder, start, mirrored, backwards, every, look):
    """Frames, frames.txt, camera.yaml, rig.toml and truth.tum of one variant."""
    (folder / "frames").mkdir()
    order = list(range(len(recording.files)))[:: -1 if backwards else 1][start::every]
    (width, height), (x, y) = recording.size, recording.centre
    (fx, fy), k = recording.focal, recording.distortion
    camera_axes = np.diag([-1.0 if mirrored else 1.0, -1.0 if backwards else 1.0, 1.0])
    world_axes = MIRROR_WORLD if mirrored != backwards else np.eye(3)
    if mirrored:
        x = width - 1 - x
    if backwards:
        y = height - 1 - y
    if look == "half the size":
        width, height, fx, fy, x, y = width // 2, height // 2, fx / 2, fy / 2, x / 2 - 0.25, y / 2 - 0.25
    frames, truth = [], []
    for number, index in enumerate(order):
        image = cv2.imread(str(recording.files[index]), cv2.IMREAD_GRAYSCALE)
        image = image[:: -1 if backwards else 1, :: -1 if mirrored else 1]
        image = LOOKS[look](np.ascontiguousarray(image, np.float32), number)
        name = f"{number:06d}.png"
        cv2.imwrite(str(folder / "frames" / name), np.clip(np.round(image), 0, 255).astype(np.uint8))
        time = abs(recording.times[index] - recording.times[order[0]])
        frames.append(f"{time:.9f} {name}\n")
        if recording.poses[index] is not None:
            turn, position = recording.poses[index]
            turn, position = world_axes @ turn @ camera_axes, world_axes @ position
            if not truth:
                write_rig(folder / "rig.toml", turn, position[2])
            truth.append([time, *position, *Rotation.from_matrix(turn).as_quat()])
    (folder / "frames.txt").write_text("".join(frames))
    np.savetxt(folder / "truth.tum", truth, fmt="%.9f")
    (folder / "camera.yaml").write_text(
        f"%YAML:1.0\n---\nimage_width: {width}\nimage_height: {height}\n"
        "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        f"   data: [ {fx}, 0., {x}, 0., {fy}, {y}, 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: 4\n   dt: d\n"
        f"   data: {k}\n"
    )


def write_rig(path, turn, height_m):
    """Roll and pitch: world_from_camera = Rz(heading) Ry(pitch) Rx(roll) STRAIGHT_DOWN."""
    tilt = turn @ STRAIGHT_DOWN.T
    pitch, roll = -math.asin(tilt[2, 0]), math.atan2(tilt[2, 1], tilt[2, 2])
    path.write_text(f"height_m = {float(height_m)!r}\nroll_rad = {roll!r}\npitch_rad = {pitch!r}\n")


def chain(folder):
    """Times and positions by the plain chain."""
    storage = cv2.FileStorage(str(folder / "camera.yaml"), cv2.FILE_STORAGE_READ)
    matrix = storage.getNode("camera_matrix").mat()
    distortion = storage.getNode("distortion_coefficients").mat().ravel()
    rig = dict(line.split(" = ") for line in (folder / "rig.toml").read_text().splitlines())
    tilt = Rotation.from_euler("y", float(rig["pitch_rad"])) * Rotation.from_euler("x", float(rig["roll_rad"]))
    turn, position = tilt.as_matrix() @ STRAIGHT_DOWN, np.array([0.0, 0.0, float(rig["height_m"])])
    pixels, ground, before, path = np.zeros((0, 2), np.float32), np.zeros((0, 3)), None, []
    for time, name in (line.split() for line in (folder / "frames.txt").read_text().splitlines()):
        image = cv2.imread(str(folder / "frames" / name), cv2.IMREAD_GRAYSCALE)
        if before is not None and len(pixels) >= 6:
            follow = {"winSize": (21, 21), "maxLevel": 4}
            found, there, _ = cv2.calcOpticalFlowPyrLK(before, image, pixels[:, None], None, **follow)
            again, back, _ = cv2.calcOpticalFlowPyrLK(image, before, found, None, **follow)
            kept = (there.ravel() == 1) & (back.ravel() == 1) & (abs(again[:, 0] - pixels).max(1) < 0.5)
            pixels, ground = found[:, 0][kept], ground[kept]
            start = cv2.Rodrigues(turn.T)[0], (-turn.T @ position).reshape(3, 1)
            if len(pixels) >= 6:
                seen = pixels.astype(float)
                ok, r, t, inliers = cv2.solvePnPRansac(ground, seen, matrix, distortion, *start, True, 100, 2.0)
                if ok and inliers is not None and len(inliers) >= 6:
                    kept = inliers.ravel()
                    pixels, ground = pixels[kept], ground[kept]
                    r, t = cv2.solvePnPRefineLM(ground, pixels.astype(float), matrix, distortion, r, t)
                    turn = cv2.Rodrigues(r)[0].T
                    position = (-turn @ t).ravel()
        path.append((float(time), *position))
        if len(pixels) < 150:
            mask = np.full(image.shape, 255, np.uint8)
            for x, y in pixels:
                cv2.circle(mask, (int(x), int(y)), 8, 0, -1)
            new = cv2.goodFeaturesToTrack(image, 300 - len(pixels), 0.01, 8, mask=mask)
            if new is not None:
                rays = cv2.undistortPoints(new.astype(float), matrix, distortion)[:, 0]
                rays = np.c_[rays, np.ones(len(rays))] @ turn.T
                down = rays[:, 2] < -0.1
                there = position - rays[down] * (position[2] / rays[down, 2])[:, None]
                pixels, ground = np.r_[pixels, new[down, 0]], np.r_[ground, there]
        before = image
    return np.array(path)


def error_mm(path, truth):
    """Root mean square position error after alignment by SE(3), millimetres."""
    nearest = [np.argmin(abs(truth[:, 0] - time)) for time in path[:, 0]]
    kept = abs(truth[nearest, 0] - path[:, 0]) < 2e-3
    a, b = path[kept, 1:4], truth[np.array(nearest)[kept], 1:4]
    a, b = a - a.mean(0), b - b.mean(0)
    u, _, v = np.linalg.svd(b.T @ a)
    turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v
    return 1e3 * math.sqrt(((b - a @ turn.T) ** 2).sum(1).mean())


# How each recording is read, and the frames at which its variants begin.
RECORDINGS = {
    "floor_flight": (floor_flight, [0, 75, 150, 225, 300]),
    "planar_checker_a": (planar_checker_a, [0, 100, 200]),
}


def variants(name, starts):
    """(start, mirrored, backwards, every, look) of each variant of a recording."""
    for start in starts:
        for mirrored, backwards in [(False, False), (True, False), (False, True)]:
            yield start, mirrored, backwards, 1, ""
    flight = name == "floor_flight"
    for backwards in [False, True] if flight else [False]:
        yield from ((0, False, backwards, every, "") for every in [2, 3, 4])
        yield from ((0, False, backwards, 2 if backwards else 1, look) for look in LOOKS if look)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", default=list(RECORDINGS))
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--program", type=Path, default=Path("target/release/odograph"))
    arguments = parser.parse_args()
    print("| variant | frames | odograph: with a pose | error, mm | chain: error, mm |\n|---|---|---|---|---|")
    for name in arguments.names:
        read, starts = RECORDINGS[name]
        recording = read(arguments.data)
        for variant in variants(name, starts):
            start, mirrored, backwards, every, look = variant
            with tempfile.TemporaryDirectory() as place:
                folder = Path(place)
                write_variant(recording, folder, *variant)
                command = [str(arguments.program.resolve()), "run", "frames", "--timestamps", "frames.txt"]
                command += ["--camera", "camera.yaml", "--rig", "rig.toml", "-o", "drive", "--quiet"]
                subprocess.run(command, cwd=folder, check=False, stderr=subprocess.DEVNULL)
                frames = len((folder / "frames.txt").read_text().splitlines())
                truth = np.loadtxt(folder / "truth.tum")
                ours = np.loadtxt(folder / "drive" / "trajectory.tum", ndmin=2)
                label = f"{name} from {start}" + ", mirrored" * mirrored + ", backwards" * backwards
                label += f", every {every}" * (every > 1) + f", {look}" * bool(look)
                plain = error_mm(chain(folder), truth)
                print(f"| {label} | {frames} | {len(ours)} | {error_mm(ours, truth):.1f} | {plain:.1f} |")


if __name__ == "__main__":
    main()
