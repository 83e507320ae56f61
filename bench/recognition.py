#!/usr/bin/env python3
"""How often `odograph localize` finds a single picture, and a clip, in a map of the same ground.

    bench/recognition.py [GROUND ...] [--pictures 60] [--clips 8] [--photographs FOLDER] [--keep FOLDER]

For every ground one drive is rendered and mapped. A second drive over the same ground, on another
path, with the camera turned by 70°, under other light and with more noise, gives single pictures
and clips of three seconds; a third, over ground of the same kind that is not in the map, gives
pictures that must not be found. The demo is looked up in its own map: those of its frames that are
no keyframes. With the folder of its two photographs (crates/odograph-cli/demo/README.md) a second
drive over its ground is rendered too.

A picture is `right` if it is found within 2 cm and 2° of the truth, `wrong` if it is found
elsewhere. What is not found is split by the verdict: `ambiguous` (places are listed; `listed` of
them have the true one among them, `first` as the most probable), `repeats`, `never` (never seen)
and `few` (too few features). Only pictures count of which the map shows half of the ground or
more. `ms` is the processor time of the whole program, the reading of the map included (median).

Needs the program (`cargo build --release -p odograph-cli`), NumPy and OpenCV.
"""

import argparse
import json
import math
import os
import resource
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
DEMO = ROOT / "crates" / "odograph-cli" / "demo"
GROUNDS = ["asphalt", "carpet", "tiles", "bricks", "grass", "concrete"]
CAMERA = ["--height", "0.9", "--roll", "1.5", "--pitch", "-3", "--vibration", "3:0.6:5", "--blur", "0.01"]
FPS = 15
CLIP_S = 3
RIGHT_M, RIGHT_DEG = 0.02, 2.0
HEADER = ("pictures", "right", "wrong", "ambiguous", "listed", "first", "repeats", "never", "few", "ms")


class Poses:
    """Where the camera is in each frame: x, y, heading; in the frame of another's first frame."""

    def __init__(self, path, begin=None):
        rows = np.loadtxt(path)
        self.poses = [planar(row) for row in rows]
        self.begin = begin or self.poses[0]

    def at(self, number):
        (x, y, heading), (x0, y0, heading0) = self.poses[number], self.begin
        cos, sin = math.cos(heading0), math.sin(heading0)
        dx, dy = x - x0, y - y0
        return cos * dx + sin * dy, cos * dy - sin * dx, wrapped(heading - heading0)


def planar(row):
    """x, y and the heading of what is up in the image, from a line of a TUM file."""
    x, y, qx, qy, qz, qw = row[1], row[2], *row[4:8]
    # Up in the image is -y of the camera: minus the second column of the rotation matrix.
    up = (-2 * (qx * qy - qz * qw), -(1 - 2 * (qx * qx + qz * qz)))
    return x, y, math.atan2(up[1], up[0])


def wrapped(angle):
    return math.atan2(math.sin(angle), math.cos(angle))


class Ground:
    """A map, and pictures with their true places in it."""

    def __init__(self, name, program, folder, map_file):
        self.name, self.program, self.folder, self.map_file = name, program, folder, map_file
        self.keyframes = keyframe_poses(map_file)

    def localize(self, source, extra=()):
        command = [self.program, "localize", source, "--map", self.map_file, "--json", "--quiet", "--threads", "1", *extra]
        run = subprocess.Popen([str(word) for word in command], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        output = run.stdout.read()
        _, status, usage = os.wait4(run.pid, 0)
        run.returncode = os.waitstatus_to_exitcode(status)
        if run.returncode not in (0, 4):
            raise SystemExit(f"{' '.join(map(str, command))} ended with {run.returncode}")
        return json.loads(output), 1e3 * (usage.ru_utime + usage.ru_stime)

    def is_mapped(self, pose, view_m):
        """Whether half of the view is in view of some keyframe: the views as squares."""
        x, y, _ = pose
        return any(math.hypot(x - kx, y - ky) < 0.4 * view_m for kx, ky in self.keyframes)


def keyframe_poses(map_file):
    with sqlite3.connect(f"file:{map_file}?mode=ro", uri=True) as db:
        return db.execute("SELECT x_m, y_m FROM keyframes").fetchall()


def judged(found, truth):
    """The verdict on one answer, and whether the truth is listed and first."""
    def is_right(place):
        off_m = math.hypot(place["x_m"] - truth[0], place["y_m"] - truth[1])
        off = wrapped(math.radians(place["heading_deg"]) - truth[2])
        return off_m < RIGHT_M and abs(math.degrees(off)) < RIGHT_DEG

    if found["recognised"]:
        return ("right" if truth and is_right(found["place"]) else "wrong"), False, False
    name = {"never-seen": "never", "too-few-features": "few"}.get(found["verdict"], found["verdict"])
    alike = found["alike"] if truth else []
    return name, any(map(is_right, alike)), bool(alike) and is_right(alike[0])


def count(ground, name, asked, threads, verbose):
    """Looks (source, truth, options) up and prints a line."""
    with ThreadPoolExecutor(threads) as pool:
        answers = list(pool.map(lambda one: ground.localize(one[0], one[2]), asked))
    total = dict.fromkeys(HEADER, 0)
    times = []
    for (source, truth, _), (found, ms) in zip(asked, answers):
        verdict, listed, first = judged(found, truth)
        total[verdict] += 1
        total["listed"] += listed
        total["first"] += first
        times.append(ms)
        if verbose and verdict != "right":
            print("  ", Path(source).name, verdict, truth and [round(v, 3) for v in truth], json.dumps(found["place"]),
                  json.dumps(found["alike"][:3]), file=sys.stderr)
    total["pictures"] = len(asked)
    total["ms"] = f"{float(np.median(times)) if times else 0:.0f}"
    print(f"{ground.name:12} {name:9}", *(f"{total[key]:>{max(6, len(key))}}" for key in HEADER), flush=True)



class Clip:
    """Frames of a drive in a folder of their own."""

    def __init__(self, frames, first, count, folder):
        folder.mkdir(parents=True)
        for frame in frames[first : first + count]:
            os.link(frame, folder / frame.name)
        self.folder, self.first = folder, first


def count_clips(ground, clips, poses, threads, verbose):
    """As `count`; the place is that of the frame which the program names."""
    with ThreadPoolExecutor(threads) as pool:
        answers = list(pool.map(lambda clip: ground.localize(clip.folder, ["--fps", str(FPS)]), clips))
    total = dict.fromkeys(HEADER, 0)
    times = []
    for clip, (found, ms) in zip(clips, answers):
        frame = found["place"]["frame"] if found["recognised"] else 0
        verdict, listed, first = judged(found, poses and poses.at(clip.first + frame))
        total[verdict] += 1
        total["listed"] += listed
        total["first"] += first
        times.append(ms)
        if verbose and verdict != "right":
            print("  ", clip.folder.name, verdict, json.dumps(found["place"]), json.dumps(found["alike"][:3]), file=sys.stderr)
    total["pictures"], total["ms"] = len(clips), f"{float(np.median(times)) if times else 0:.0f}"
    print(f"{ground.name:12} {'clips':9}", *(f"{total[key]:>{max(6, len(key))}}" for key in HEADER), flush=True)


def simulate(program, folder, options):
    if not folder.exists():
        subprocess.run([program, "simulate", "-q", "-o", folder, *CAMERA, *options], check=True)
    return folder


def mapped(program, drive, folder):
    map_file = folder / "map.gpkg"
    if not map_file.exists():
        video = next(drive.glob("frames"))
        command = [program, "run", video, "--fps", str(FPS), "--camera", drive / "camera.yaml", "--rig", drive / "rig.toml",
                   "--readout-ms", "0", "-q", "-o", folder]
        subprocess.run([str(word) for word in command], check=True)
    return map_file


def spread(items, most):
    step = max(1.0, len(items) / most)
    return [items[int(i * step)] for i in range(min(most, len(items)))]


def rendered(name, texture, arguments, scratch):
    """Maps a rendered ground, and looks up a second drive and one elsewhere."""
    program, here = arguments.program, scratch / name
    here.mkdir(parents=True, exist_ok=True)
    way = ["--path", "eight", "--fps", str(FPS), "--vignetting", "0.35", *texture]
    first = simulate(program, here / "first", [*way, "--length", "4.2", "--speed", "0.36", "--seed", "7", "--noise", "1.5",
                                                "--lighting", "0.06"])
    second_way = [*way, "--length", "3.9", "--speed", "0.5", "--yaw", "70", "--noise", "2.5", "--lighting", "0.2"]
    second = simulate(program, here / "second", [*second_way, "--seed", "7"])
    elsewhere = simulate(program, here / "elsewhere", [*second_way, "--seed", "8"])
    ground = Ground(name, program, here, mapped(program, first, here / "mapped"))
    poses = Poses(second / "truth.tum", Poses(first / "truth.tum").begin)
    look_up(ground, sorted((second / "frames").iterdir()), poses, arguments, here)
    others = spread(sorted((elsewhere / "frames").iterdir()), arguments.pictures)
    count(ground, "foreign", [(frame, None, ()) for frame in others], arguments.threads, arguments.verbose)


def look_up(ground, frames, poses, arguments, here, excluded=()):
    view_m = 0.8
    known = [i for i in range(len(frames)) if i not in excluded and ground.is_mapped(poses.at(i), view_m)]
    asked = [(frames[i], poses.at(i), ()) for i in spread(known, arguments.pictures)]
    count(ground, "pictures", asked, arguments.threads, arguments.verbose)
    length = CLIP_S * FPS
    starts = spread(range(0, len(frames) - length), arguments.clips) if arguments.clips else []
    shutil.rmtree(here / "clips", ignore_errors=True)
    clips = [Clip(frames, start, length, here / "clips" / f"{start:06}") for start in starts]
    count_clips(ground, clips, poses, arguments.threads, arguments.verbose)


def demo(arguments, scratch):
    """Looks the frames of the demo up in the map that the demo makes."""
    here = scratch / "demo"
    if not here.exists():
        subprocess.run([arguments.program, "demo", "-q", "-o", here], check=True)
    frames_folder = here / "frames"
    if not frames_folder.exists():
        frames_folder.mkdir()
        video = cv2.VideoCapture(str(here / "input" / "drive.mp4"))
        number = 0
        while True:
            ok, frame = video.read()
            if not ok:
                break
            if number % 2 == 0:
                cv2.imwrite(str(frames_folder / f"{number:06}.png"), frame, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            number += 1
    ground = Ground("demo", arguments.program, here, here / "map.gpkg")
    with sqlite3.connect(f"file:{here / 'map.gpkg'}?mode=ro", uri=True) as db:
        keyframes = {row[0] // 2 for row in db.execute("SELECT frame FROM keyframes")}
    poses = Poses(here / "input" / "truth.tum")
    poses.poses = poses.poses[::2]
    look_up(ground, sorted(frames_folder.iterdir()), poses, arguments, here, keyframes)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("grounds", nargs="*", help=f"demo, demo-ground, {', '.join(GROUNDS)}")
    parser.add_argument("--program", default=ROOT / "target" / "release" / "odograph", type=Path)
    parser.add_argument("--pictures", type=int, default=60)
    parser.add_argument("--clips", type=int, default=8)
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--photographs", type=Path, help="folder of bricks.jpg and grass_dry.png")
    parser.add_argument("--keep", type=Path, help="keep the drives and maps here, and use those that are there")
    parser.add_argument("--verbose", action="store_true", help="a line for each picture that is not found")
    arguments = parser.parse_args()
    print(f"{'':22}", *(f"{key:>6}" for key in HEADER))
    with tempfile.TemporaryDirectory() as temporary:
        scratch = arguments.keep or Path(temporary)
        for name in arguments.grounds or ["demo", *(["demo-ground"] if arguments.photographs else []), *GROUNDS]:
            if name == "demo":
                demo(arguments, scratch)
            elif name == "demo-ground":
                photographs = arguments.photographs.resolve()
                texture = ["--texture", photographs / "bricks.jpg", "--photo-width", "1.6", "--tiling", "repeat",
                           "--texture", photographs / "grass_dry.png", "--photo-width", "1.0", "--tiling", "scatter"]
                rendered(name, [str(word) for word in texture], arguments, scratch)
            else:
                rendered(name, ["--texture", name], arguments, scratch)


if __name__ == "__main__":
    main()
