#!/usr/bin/env python3
"""Accuracy of the trajectory on compressed video.

    cargo build --release && python3 bench/compression.py [--program target/release/odograph] [--first-seed 300]

Needs ffmpeg with libx264, and nothing but Python 3. Renders drives (a figure eight of 9 m, 640x480
at 30 frames per second, 0.75 m above the ground, mild vignetting, image noise of 2 gray levels)
with a rigid mount and with one that vibrates by 1 mm and 0.2° at 5 Hz. Encodes them with H.264 at
several qualities, tracks them with `odograph run` given only camera and height, and prints a table:
medians of the relative error over 1 m of path, for the odometry without loop closures.
"""

import argparse
import re
import statistics
import subprocess
import tempfile
from pathlib import Path

GROUNDS = ["asphalt", "carpet", "grass"]
MOUNTS = {"steady": [], "shaking": ["--vibration", "1:0.2:5"]}
QUALITIES = [None, 18, 23, 28, 38]


def call(*command):
    return subprocess.run([str(word) for word in command], check=True, capture_output=True, text=True).stdout


def encoded(folder, crf):
    """The recording, uncompressed or as H.264, and its bit rate in kbit/s."""
    raw = next(folder.glob("*.y4m"))
    if crf is None:
        return raw, 640 * 480 * 8 * 30 / 1e3
    video = folder / f"{crf}.mp4"
    call("ffmpeg", "-v", "error", "-y", "-i", raw, "-c:v", "libx264", "-crf", crf, "-pix_fmt", "yuv420p", "-threads", 1, video)
    frames = raw.stat().st_size / (640 * 480)
    return video, video.stat().st_size * 8 / 1e3 / (frames / 30)


def drift_percent(program, folder, video):
    run = folder / "run"
    call(program, "run", video, "--camera", folder / "camera.yaml", "--height", 0.75, "-o", run, "--force", "--quiet")
    report = call(program, "evaluate", run / "odometry.tum", folder / "truth.tum")
    return float(re.search(r"^1 m +([0-9.]+)", report, re.MULTILINE).group(1))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", type=Path, action="append", help="one table each; target/release/odograph by default")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=300)
    arguments = parser.parse_args()
    programs = arguments.program or [Path("target/release/odograph")]
    drifts, rates = {}, {}
    for ground in GROUNDS:
        for mount, options in MOUNTS.items():
            for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
                with tempfile.TemporaryDirectory() as scratch:
                    folder = Path(scratch) / "drive"
                    drive = ["--path", "eight", "--length", 3, "--speed", 0.4, "--height", 0.75, "--seed", seed]
                    looks = ["--texture", ground, "--noise", 2, "--vignetting", 0.2, "--blur", 0.005]
                    call(programs[0], "simulate", "-o", folder, "--format", "y4m", *drive, *looks, *options)
                    for crf in QUALITIES:
                        video, rate = encoded(folder, crf)
                        rates.setdefault(crf, []).append(rate)
                        for program in programs:
                            drift = drift_percent(program, folder, video)
                            drifts.setdefault((program, mount, crf), {}).setdefault(ground, []).append(drift)
    for program in programs:
        print(f"{program}\n\n| mount | H.264 | kbit/s | " + " | ".join(GROUNDS) + " |\n|---|---|---|" + "---|" * len(GROUNDS))
        for mount in MOUNTS:
            for crf in QUALITIES:
                cells = [f"{statistics.median(drifts[program, mount, crf][ground]):.4f} %" for ground in GROUNDS]
                name = "not compressed" if crf is None else f"crf {crf}"
                print(f"| {mount} | {name} | {statistics.median(rates[crf]):.0f} | " + " | ".join(cells) + " |")
        print()


if __name__ == "__main__":
    main()
