#!/usr/bin/env python3
"""Our pipeline and a straightforward OpenCV program, on the same recording and the same core.

    cargo build --release && cargo build --release -p odograph --example speed && python3 bench/opencv.py

Needs numpy and opencv-python-headless. Renders a drive over asphalt at 640x480 and at 1280x720 (or
takes one written by `odograph simulate --format y4m` with --clip FOLDER), runs both programs in
turn, several times, on one thread, and prints a table of medians and ratios.

* Times are processor times of the thread, so other load of the machine has little effect.
* The OpenCV program: 400 Shi-Tomasi corners per keyframe, the same number as ours; Lucas-Kanade
  (21x21, 4 levels) from the keyframe, initialised with the positions in the previous frame, with a
  forward-backward check of half a pixel; undistorted points; a rigid fit by RANSAC to the
  keyframe's points on the ground; a new keyframe when fewer than half are left. No image is
  undistorted. The Python wheel builds both pyramids in every LK call; a C++ program would keep
  them, so their time is subtracted and one pyramid per frame is counted.
* Stages: both get 500 corners of the same frame and track them into the next, initialised with
  their previous positions; the error is measured against the ground truth.
"""

import argparse
import json
import math
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

POINTS = 500  # for the stages
PIPELINE_POINTS = 400  # for the whole pipeline: our default
WINDOW = dict(winSize=(21, 21), maxLevel=3, criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01))
STRIDE, STAGE_FRAMES = 16, 12


def milliseconds(work):
    start = time.thread_time()
    result = work()
    return 1e3 * (time.thread_time() - start), result


def best_of_three(work):
    work()
    return min(milliseconds(work)[0] for _ in range(3))


class Clip:
    """The output of `odograph simulate --format y4m`."""

    def __init__(self, folder):
        self.folder = folder
        data = next(folder.glob("*.y4m")).read_bytes()
        header, rest = data.split(b"\n", 1)
        fields = {word[:1]: word[1:] for word in header.split(b" ")[1:]}
        self.width, self.height = int(fields[b"W"]), int(fields[b"H"])
        chroma = 0 if fields.get(b"C", b"420") == b"mono" else 2 * ((self.width + 1) // 2) * ((self.height + 1) // 2)
        area, self.frames, at = self.width * self.height, [], 0
        while at < len(rest):
            at = rest.index(b"\n", at) + 1
            self.frames.append(np.frombuffer(rest, np.uint8, area, at).reshape(self.height, self.width).copy())
            at += area + chroma
        store = cv2.FileStorage(str(folder / "camera.yaml"), cv2.FILE_STORAGE_READ)
        self.matrix = store.getNode("camera_matrix").mat()
        self.lens = store.getNode("distortion_coefficients").mat()
        rows = np.loadtxt(folder / "truth.tum")
        self.positions, self.rotations = rows[:, 1:4], [rotation(row[4:8]) for row in rows]
        self.height_m = float(self.positions[0, 2])

    def true_places(self, first, second, pixels):
        """Projects the ground points at `pixels` of frame `first` into frame `second`."""
        rays = cv2.undistortPoints(pixels.reshape(-1, 1, 2), self.matrix, self.lens).reshape(-1, 2)
        rays = np.column_stack([rays, np.ones(len(rays))]) @ self.rotations[first].T
        ground = self.positions[first] - rays * (self.positions[first, 2] / rays[:, 2])[:, None]
        seen = (ground - self.positions[second]) @ self.rotations[second]
        return cv2.projectPoints(seen, np.zeros(3), np.zeros(3), self.matrix, self.lens)[0].reshape(-1, 2)


def rotation(quaternion):
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def corners(image, most=POINTS):
    return cv2.goodFeaturesToTrack(image, most, 0.005, 10, blockSize=5)


def pyramid(image):
    return cv2.buildOpticalFlowPyramid(image, WINDOW["winSize"], WINDOW["maxLevel"], withDerivatives=True)[1]


class OpenCvProgram:
    """Odometry from gray images to poses."""

    def __init__(self, clip):
        self.matrix, self.lens, self.height_m = clip.matrix, clip.lens, clip.height_m
        self.pose = np.eye(3)  # world_from_camera on the ground, x and y as in the image
        self.key = None
        self.keyframes = 0

    def on_ground(self, points):
        return cv2.undistortPoints(points, self.matrix, self.lens).reshape(-1, 2) * self.height_m

    def make_keyframe(self, image):
        points = corners(image, PIPELINE_POINTS)
        ground = self.on_ground(points) @ self.pose[:2, :2].T + self.pose[:2, 2]
        self.key = (image, points, ground, len(points))
        self.last = points.copy()
        self.keyframes += 1

    def process(self, image):
        if self.key is None:
            return self.make_keyframe(image)
        key_image, points, ground, at_first = self.key
        flags = cv2.OPTFLOW_USE_INITIAL_FLOW
        found, good, _ = cv2.calcOpticalFlowPyrLK(key_image, image, points, self.last.copy(), flags=flags, **WINDOW)
        back, good_back, _ = cv2.calcOpticalFlowPyrLK(image, key_image, found, points.copy(), flags=flags, **WINDOW)
        kept = (good.ravel() == 1) & (good_back.ravel() == 1) & (np.abs(back - points).max(axis=(1, 2)) < 0.5)
        inliers = 0
        if kept.sum() >= 12:
            seen = self.on_ground(found[kept])
            limit = 2.0 * self.height_m / self.matrix[0, 0]
            similar, agree = cv2.estimateAffinePartial2D(seen, ground[kept], method=cv2.RANSAC, ransacReprojThreshold=limit)
            if similar is not None:
                agree = agree.ravel() == 1
                inliers = int(agree.sum())
                # Closed-form rigid fit to the inliers, without scale, as the height is constant.
                a, b = seen[agree], ground[kept][agree]
                a0, b0 = a.mean(axis=0), b.mean(axis=0)
                products = (a - a0).T @ (b - b0)
                angle = math.atan2(products[0, 1] - products[1, 0], products[0, 0] + products[1, 1])
                turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
                self.pose[:2, :2], self.pose[:2, 2] = turn, b0 - turn @ a0
        self.last = found
        if inliers < 0.5 * at_first:
            self.make_keyframe(image)
        else:
            self.key = (key_image, points[kept], ground[kept], at_first)
            self.last = found[kept]


def opencv_run(clip):
    stages = {name: [] for name in ["undistort_image", "undistort_points", "pyramid", "corners", "lk"]}
    size = (clip.width, clip.height)
    maps = cv2.initUndistortRectifyMap(clip.matrix, clip.lens, None, clip.matrix, size, cv2.CV_16SC2)
    tracks = []
    for first in list(range(0, len(clip.frames) - 1, STRIDE))[:STAGE_FRAMES]:
        image, following = clip.frames[first], clip.frames[first + 1]
        stages["undistort_image"].append(best_of_three(lambda: cv2.remap(image, *maps, cv2.INTER_LINEAR)))
        stages["pyramid"].append(best_of_three(lambda: pyramid(image)))
        stages["corners"].append(best_of_three(lambda: corners(image)))
        points = corners(image)
        stages["undistort_points"].append(best_of_three(lambda: cv2.undistortPoints(points, clip.matrix, clip.lens)))
        with_pyramids = best_of_three(lambda: cv2.calcOpticalFlowPyrLK(image, following, points, None, **WINDOW))
        stages["lk"].append(with_pyramids - 2 * stages["pyramid"][-1])
        found, good, _ = cv2.calcOpticalFlowPyrLK(image, following, points, None, **WINDOW)
        tracks += [(first, *p, *q) for p, q in zip(points[good == 1], found[good == 1])]
    spare_pyramids = 3 * statistics.median(stages["pyramid"])
    times, poses = None, None
    for _ in range(3):
        program = OpenCvProgram(clip)
        now, poses = [], []
        for image in clip.frames:
            followed = program.key is not None
            now.append(milliseconds(lambda: program.process(image))[0] - followed * spare_pyramids)
            poses.append(program.pose[:2, 2].copy())
        times = now if times is None else np.minimum(times, now)
    return {
        "stages_ms": {name: statistics.median(values) for name, values in stages.items()},
        "process": {
            "as_it_runs_ms": float(np.mean(times) + spare_pyramids),
            "mean_ms": float(np.mean(times)),
            "median_ms": float(np.median(times)),
            "p99_ms": float(np.sort(times)[len(times) * 99 // 100]),
        },
        "keyframes": program.keyframes,
        "tracks": tracks,
        "positions": np.array(poses),
    }


def our_run(program, clip):
    command = [program, next(clip.folder.glob("*.y4m")), clip.folder / "camera.yaml", str(clip.height_m), "--tracks"]
    run = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    run["positions"] = np.array([pose[1:3] for pose in run["poses"]])
    return run


def track_error_px(clip, tracks):
    """Median error against the ground truth, and the fraction of tracks within one pixel of it."""
    tracks = np.array(tracks, dtype=float)
    errors = []
    for first in np.unique(tracks[:, 0]):
        rows = tracks[tracks[:, 0] == first]
        truth = clip.true_places(int(first), int(first) + 1, rows[:, 1:3])
        errors.append(np.hypot(*(rows[:, 3:5] - truth).T))
    errors = np.concatenate(errors)
    return float(np.median(errors[errors < 1.0])), len(errors[errors < 1.0])


def path_error_mm(clip, positions):
    """RMSE against the ground truth after the best rigid alignment."""
    truth = clip.positions[: len(positions), :2]
    a, b = positions - positions.mean(axis=0), truth - truth.mean(axis=0)
    u, _, v = np.linalg.svd(a.T @ b)
    # The OpenCV program has x and y as in the image, mirrored against the view from above, so a
    # reflection is allowed.
    return 1e3 * float(np.sqrt(np.mean(np.sum((a @ (u @ v) - b) ** 2, axis=1))))


def table(clip, ours, theirs):
    def median(runs, *keys):
        values = []
        for run in runs:
            for key in keys:
                run = run[key]
            values.append(run)
        return statistics.median(values)

    size = f"{clip.width}x{clip.height}"
    rows = []

    def row(name, us, them):
        rows.append(f"| {size} | {name} | {us:.3g} ms | {them:.3g} ms | {them / us:.1f}x |")

    row("undistort an image", median(ours, "stages_ms", "undistort_image"), median(theirs, "stages_ms", "undistort_image"))
    row("undistort 500 points", median(ours, "stages_ms", "undistort_points"), median(theirs, "stages_ms", "undistort_points"))
    row("pyramid, 4 levels", median(ours, "stages_ms", "pyramid"), median(theirs, "stages_ms", "pyramid"))
    row("500 Shi-Tomasi corners", median(ours, "stages_ms", "corners"), median(theirs, "stages_ms", "corners"))
    both = [
        statistics.median(run["stages_ms"]["pyramid"] + run["stages_ms"]["lk"] for run in runs) for runs in (ours, theirs)
    ]
    row("pyramid and LK of 500 points, 4 levels", *both)
    for name, key in [("a frame, mean", "mean_ms"), ("a frame, median", "median_ms"), ("a frame, 99 of 100", "p99_ms")]:
        row(name, median(ours, "process", key), median(theirs, "process", key))
    row("a frame, mean; the wheel as it runs", median(ours, "process", "mean_ms"), median(theirs, "process", "as_it_runs_ms"))
    us, them = ours[0], theirs[0]
    notes = [
        f"{size}: {1e3 / median(ours, 'process', 'mean_ms'):.0f} frames/s against {1e3 / median(theirs, 'process', 'mean_ms'):.0f}; "
        f"{us['keyframes']} and {them['keyframes']} keyframes in {len(clip.frames)} frames",
        "path off by {:.2f} mm against {:.2f} mm (RMS, aligned)".format(*(path_error_mm(clip, run["positions"]) for run in (us, them))),
        "tracks off by {:.3f} px ({} within 1 px) against {:.3f} px ({})".format(
            *track_error_px(clip, us["tracks"]), *track_error_px(clip, them["tracks"])
        ),
    ]
    return rows, "; ".join(notes)


def simulate(program, size, folder):
    subprocess.run(
        [program, "simulate", "--path", "eight", "--length", "3", "--speed", "0.6", "--texture", "asphalt"]
        + ["--size", size, "--duration", "6", "--format", "y4m", "-o", folder],
        check=True,
        capture_output=True,
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", type=Path, default=Path("target/release/odograph"))
    parser.add_argument("--speed", type=Path, default=Path("target/release/examples/speed"))
    parser.add_argument("--clip", type=Path, action="append", help="a folder that `odograph simulate --format y4m` wrote")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        clips = arguments.clip or []
        for size in [] if clips else ["640x480", "1280x720"]:
            simulate(arguments.program, size, Path(folder) / size)
            clips.append(Path(folder) / size)
        rows, notes = [], []
        for clip in map(Clip, clips):
            ours, theirs = [], []
            for _ in range(arguments.rounds):
                ours.append(our_run(arguments.speed, clip))
                theirs.append(opencv_run(clip))
            more_rows, note = table(clip, ours, theirs)
            rows += more_rows
            notes.append(note)
    print(f"| size | stage | odograph | OpenCV {cv2.__version__} | ratio |\n|---|---|---|---|---|")
    print("\n".join(rows) + "\n")
    print("\n".join("* " + note for note in notes))


if __name__ == "__main__":
    main()
