#!/usr/bin/env python3
"""Runs odograph on the recordings with ground truth and prints its errors.

    python3 bench/recordings.py --data FOLDER [--program target/release/odograph] [--work FOLDER] [NAME ...]

Needs nothing but Python 3. FOLDER holds `planar_checker_a`, `static_euroc_v101`, `kylehart_ground`;
missing ones are skipped. The files of each recording are converted into the program's input (camera
file, rig, timestamps, ground truth), the program is run as a user would run it, and `odograph
evaluate` compares.
"""

import argparse
import json
import math
import subprocess
from pathlib import Path


def matmul(a, b):
    return [[sum(x * y for x, y in zip(row, column)) for column in zip(*b)] for row in a]


def transpose(a):
    return [list(row) for row in zip(*a)]


def rotation_from_axis_angle(w):
    angle = math.sqrt(sum(v * v for v in w))
    if angle < 1e-12:
        return [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    x, y, z = (v / angle for v in w)
    c, s = math.cos(angle), math.sin(angle)
    d = 1 - c
    return [
        [c + x * x * d, x * y * d - z * s, x * z * d + y * s],
        [y * x * d + z * s, c + y * y * d, y * z * d - x * s],
        [z * x * d - y * s, z * y * d + x * s, c + z * z * d],
    ]


def quaternion(r):
    """Unit quaternion (x, y, z, w) of a rotation matrix, from its largest component."""
    trace = r[0][0] + r[1][1] + r[2][2]
    squares = [1 + 2 * r[i][i] - trace for i in range(3)] + [1 + trace]
    largest = max(range(4), key=lambda i: squares[i])
    d = 2 * math.sqrt(squares[largest])
    if largest == 3:
        return (r[2][1] - r[1][2]) / d, (r[0][2] - r[2][0]) / d, (r[1][0] - r[0][1]) / d, d / 4
    i, j, k = largest, (largest + 1) % 3, (largest + 2) % 3
    q = [0.0] * 4
    q[i], q[j], q[k], q[3] = d / 4, (r[j][i] + r[i][j]) / d, (r[k][i] + r[i][k]) / d, (r[k][j] - r[j][k]) / d
    return tuple(q)


NADIR = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]


def rig_of(world_from_camera, height):
    """Roll and pitch relative to a camera that looks straight down:
    world_from_camera = Rz(heading) Ry(pitch) Rx(roll) NADIR."""
    turn = matmul(world_from_camera, transpose(NADIR))
    pitch = -math.asin(max(-1.0, min(1.0, turn[2][0])))
    roll = math.atan2(turn[2][1], turn[2][2])
    return f"height_m = {height!r}\nroll_rad = {roll!r}\npitch_rad = {pitch!r}\n"


def camera_file(size, fx, fy, cx, cy, distortion):
    return (
        "%YAML:1.0\n---\n"
        f"image_width: {size[0]}\nimage_height: {size[1]}\n"
        "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
        f"   data: [ {fx}, 0., {cx}, 0., {fy}, {cy}, 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n"
        f"   rows: 1\n   cols: {len(distortion)}\n   dt: d\n   data: {list(map(float, distortion))}\n"
    )


def tum(poses):
    lines = []
    for time, t, r in poses:
        lines.append(" ".join([f"{time:.9f}"] + [f"{v:.12g}" for v in (*t, *quaternion(r))]))
    return "\n".join(lines) + "\n"


def planar_checker(data, work):
    """A hand-held camera over a checkerboard; the world frame is that of the board."""
    folder = data / "planar_checker_a"
    poses = []
    for number, line in enumerate((folder / "poses_omega_t.txt").read_text().split("\n")):
        values = [float(v) for v in line.split()]
        if len(values) != 6:
            continue
        r, t = rotation_from_axis_angle(values[:3]), values[3:]
        world_from_camera = transpose(r)
        centre = [-sum(world_from_camera[i][j] * t[j] for j in range(3)) for i in range(3)]
        # The board's z axis points into the board, ours points up.
        if centre[2] < 0:
            flip = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]
            world_from_camera = matmul(flip, world_from_camera)
            centre = [centre[0], -centre[1], -centre[2]]
        poses.append((number / 30.0, centre, world_from_camera))
    names = sorted(p.name for p in (folder / "images").iterdir())
    (work / "frames.txt").write_text("".join(f"{i / 30.0:.9f} {n}\n" for i, n in enumerate(names)))
    (work / "truth.tum").write_text(tum(poses))
    (work / "rig.toml").write_text(rig_of(poses[0][2], poses[0][1][2]))
    (work / "camera.yaml").write_text(
        camera_file((752, 480), 419.97, 419.31, 353.93, 250.78, [-0.31418, 0.10884, 0, 0])
    )
    return [folder / "images", "--timestamps", work / "frames.txt"]


def static_euroc(data, work):
    """A stationary drone: any motion is an error.

    The height is unknown; 1 m is assumed, which gives the drift per metre of distance to the ground.
    """
    folder = data / "static_euroc_v101"
    (work / "camera.yaml").write_text((folder / "sensor.yaml").read_text())
    (work / "rig.toml").write_text("height_m = 1.0\n")
    return [folder / "cam0"]


def kylehart(data, work):
    """Steps of 0.1 m and 45° over a photographed floor, with the robot's shadow moving along.

    A test of recognition more than of tracking.
    """
    folder = data / "kylehart_ground"
    poses = []
    names = sorted(p for p in folder.iterdir() if p.suffix == ".txt" and p.stem.isdigit())
    for number, path in enumerate(names):
        x, y, z, roll, pitch, yaw = (float(v) for v in path.read_text().replace(",", " ").split()[:6])
        c, s = math.cos(yaw), math.sin(yaw)
        turn = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        poses.append((float(number), [x, y, 0.25], matmul(turn, NADIR)))
    (work / "truth.tum").write_text(tum(poses))
    (work / "rig.toml").write_text("height_m = 0.25\n")
    (work / "camera.yaml").write_text(camera_file((1280, 960), 1108.7, 1108.7, 640, 480, [0, 0, 0, 0]))
    frames = work / "frames"
    frames.mkdir(exist_ok=True)
    for path in names:
        link = frames / (path.stem + ".png")
        if not link.exists():
            link.symlink_to(path.with_suffix(".png").resolve())
    return [frames, "--fps", "1"]


def nadir_caliterra(data, work):
    """75 drone still images of a field, 2 to 4 s apart.

    The camera is not calibrated and the height is unknown: a pinhole camera of 4.5 mm with a sensor of 6.17 mm width and 1 m are assumed, so only the
    shape of the trajectory can be compared (alignment Sim(3))."""
    folder = data / "nadir_caliterra"
    rows = [line.split(",") for line in (folder / "gps.csv").read_text().splitlines()[1:]]
    identity = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    poses = [(float(i), [float(row[4]), float(row[5]), float(row[3])], matmul(identity, NADIR)) for i, row in enumerate(rows)]
    (work / "truth.tum").write_text(tum(poses))
    (work / "frames.txt").write_text("".join(f"{i} {row[0]}\n" for i, row in enumerate(rows)))
    (work / "rig.toml").write_text("height_m = 1.0\n")
    (work / "camera.yaml").write_text(camera_file((1000, 750), 729.3, 729.3, 499.5, 374.5, [0, 0, 0, 0]))
    return [folder / "images", "--timestamps", work / "frames.txt", "--motion", "free"]


RECORDINGS = {"planar_checker_a": planar_checker, "static_euroc_v101": static_euroc, "kylehart_ground": kylehart, "nadir_caliterra": nadir_caliterra}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--program", type=Path, default=Path("target/release/odograph"))
    parser.add_argument("--work", type=Path, default=Path("target/recordings"))
    arguments = parser.parse_args()
    for name, prepare in RECORDINGS.items():
        if (arguments.names and name not in arguments.names) or not (arguments.data / name).is_dir():
            continue
        work = arguments.work / name
        work.mkdir(parents=True, exist_ok=True)
        source = prepare(arguments.data, work)
        out = work / "run"
        command = [arguments.program, "run", *source, "--camera", work / "camera.yaml", "--rig", work / "rig.toml"]
        done = subprocess.run([*map(str, command), "-o", str(out), "--force", "--quiet"])
        print(f"== {name}: exit code {done.returncode}")
        if not (out / "stats.json").exists():
            continue
        stats = json.loads((out / "stats.json").read_text())
        keys = ["frames", "frames_with_pose", "distance_m", "fps", "keyframes", "losses"]
        print({key: stats[key] for key in keys})
        if (work / "truth.tum").exists():
            for align in ["sim3", "se3", "origin"]:
                subprocess.run([arguments.program, "evaluate", out / "trajectory.tum", work / "truth.tum", "--align", align])
        else:
            rows = [list(map(float, line.split())) for line in (out / "trajectory.tum").read_text().splitlines() if not line.startswith("#")]
            reach = max(math.dist(rows[0][1:4], row[1:4]) for row in rows)
            print(f"largest distance from the start {1e3 * reach:.3f} mm, at the end {1e3 * math.dist(rows[0][1:4], rows[-1][1:4]):.3f} mm")


if __name__ == "__main__":
    main()
