#!/usr/bin/env python3
"""Calibrates with odograph and with OpenCV from the same images; prints a Markdown table.

    pip install opencv-python-headless
    cargo build --release
    python3 bench/calibration.py --data FOLDER [--program target/release/odograph] [NAME ...]

FOLDER holds the sets named below; missing ones are skipped. Both programs use OpenCV's default lens
model (k1 k2 p1 p2 k3). OpenCV is used as in its tutorial, with a window that suits these sets:
findChessboardCorners, cornerSubPix with (5, 5), calibrateCamera. Each is run with one thread and
with all threads. Times cover reading, detection and solving, without writing results; the best of
--repeat runs counts.

Columns: boards detected; RMS over the views used; differences of focal lengths and principal point
in OpenCV's standard deviations; seconds for detection and for solving; the ratio of the total
times, above 1 where odograph is faster.
"""

import argparse
import glob
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SETS = {
    "left": ("calib_opencv/left*.jpg", (9, 6), 25),
    "right": ("calib_opencv/right*.jpg", (9, 6), 25),
    "wide": ("calib_carnd_wide/calibration_wide/GOPR*.jpg", (8, 6), 25),
    "table": ("calib_overhead_table/images/*.png", (24, 17), 15),
}


def opencv(paths, size, square_mm, threads):
    """One calibration by OpenCV, in a separate process so that its thread count can be set."""
    import cv2
    import numpy as np

    cv2.setNumThreads(threads if threads else -1)
    columns, rows = size
    board = np.zeros((columns * rows, 3), np.float32)
    board[:, :2] = np.mgrid[0:columns, 0:rows].T.reshape(-1, 2) * square_mm / 1000
    begun = time.perf_counter()
    found, points = [], []
    for path in paths:
        image = cv2.imread(path, cv2.IMREAD_GRAYSCALE)
        ok, corners = cv2.findChessboardCorners(image, size)
        if ok:
            criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.001)
            # (5, 5) is 11x11 pixels; the tutorial's (11, 11) covers the next corner and doubles the
            # error on these sets.
            points.append(cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), criteria))
            found.append(path)
    searched = time.perf_counter()
    rms, matrix, distortion, _, _, deviations, _, _ = cv2.calibrateCameraExtended(
        [board] * len(points), points, image.shape[::-1], None, None
    )
    solved = time.perf_counter()
    # In addition to the classic detector the newer one, for the maximum number that OpenCV detects.
    newer = [p for p in paths if cv2.findChessboardCornersSB(cv2.imread(p, 0), size)[0]] if threads == 1 else []
    return {
        "found": found,
        "found_newer": newer,
        "rms": rms,
        "values": [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]],
        "deviations": deviations.ravel()[:4].tolist(),
        "find": searched - begun,
        "solve": solved - searched,
    }


def odograph(program, paths, size, square_mm, threads, model):
    with tempfile.TemporaryDirectory() as folder:
        command = [program, "calibrate", *paths, "--board", f"chessboard:{size[0]}x{size[1]}:{square_mm}mm", "--json"]
        command += ["--model", model, "-o", f"{folder}/camera.yaml", "--max-views", "500"]
        command += ["--threads", str(threads)] if threads else []
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode not in (0, 4):
            raise SystemExit(f"{' '.join(command)}\n{done.stderr}")
        return json.loads(done.stdout)


def best(repeat, run):
    """The results of one of several runs, with the minimum times over all runs."""
    runs = [run() for _ in range(repeat)]
    seconds = [r.get("seconds", r) for r in runs]
    return runs[0], min(s["find"] for s in seconds), min(s["solve"] for s in seconds)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--program", default="target/release/odograph")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--model", default="brown5", help="the lens model that odograph uses")
    parser.add_argument("--opencv-only", help=argparse.SUPPRESS)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(SETS))
    arguments = parser.parse_args()
    if arguments.opencv_only:
        print(json.dumps(opencv(*json.loads(arguments.opencv_only))))
        return

    print("| set | threads | boards found | RMS px | Δfx Δfy Δcx Δcy, in OpenCV's σ | finding s | solving s | faster by |")
    print("|---|---|---|---|---|---|---|---|")
    for name in arguments.names or SETS:
        pattern, size, square_mm = SETS[name]
        paths = sorted(glob.glob(str(arguments.data / pattern)))
        if not paths:
            print(f"{name}: no pictures {arguments.data / pattern}", file=sys.stderr)
            continue
        for threads in (1, 0):
            def theirs():
                job = json.dumps([paths, size, square_mm, threads])
                here = [sys.executable, __file__, "--data", ".", "--opencv-only", job]
                return json.loads(subprocess.run(here, capture_output=True, text=True, check=True).stdout)

            other, other_find, other_solve = best(arguments.repeat, theirs)
            ours, find, solve = best(
                arguments.repeat, lambda: odograph(arguments.program, paths, size, square_mm, threads, arguments.model)
            )
            values = [ours["parameters"][key]["value"] for key in ("fx", "fy", "cx", "cy")]
            apart = [(a - b) / s for a, b, s in zip(values, other["values"], other["deviations"])]
            print(
                f"| {name} | {threads or 'all'} | {ours['with_board']} of {len(paths)} (OpenCV {len(other['found'])}"
                + (f", its newer finder {len(other['found_newer'])}" if threads == 1 else "")
                + f") | {ours['rms_px']:.4f}, {ours['views_used']} views (OpenCV {other['rms']:.4f}) "
                f"| {' '.join(f'{a:+.2f}' for a in apart)} "
                f"| {find:.2f} (OpenCV {other_find:.2f}) | {solve:.2f} (OpenCV {other_solve:.2f}) "
                f"| {(other_find + other_solve) / (find + solve):.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
