#!/usr/bin/env python3
"""Speed of whole runs on the bundled drive (H.264, 640x480, 1083 frames).

    cargo build --release && python3 bench/real_time.py [--program target/release/odograph] [--runs 5]

A run decodes, tracks, draws the mosaic and writes. Prints frames per second of whole runs (minimum,
median, maximum) with one, two and three threads, and the time per stage. For the stages of tracking
see `cargo bench -p odograph`.
"""

import argparse
import json
import statistics
import subprocess
import tempfile
from pathlib import Path


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--program", type=Path, default=Path("target/release/odograph"))
    parser.add_argument("--runs", type=int, default=5)
    arguments = parser.parse_args()
    for threads in [1, 2, 3]:
        runs = []
        for _ in range(arguments.runs):
            with tempfile.TemporaryDirectory() as folder:
                command = [arguments.program, "demo", "--json", "--threads", str(threads), "-o", folder + "/demo"]
                runs.append(json.loads(subprocess.run(command, check=True, capture_output=True).stdout))
        rates = sorted(run["fps"] for run in runs)
        stages = {
            name: f"{statistics.median(run['stages'][name]['mean_ms'] for run in runs):.2f} ms"
            for name in runs[0]["stages"]
        }
        print(f"{threads} threads: {rates[0]:.0f} / {statistics.median(rates):.0f} / {rates[-1]:.0f} frames/s, stages {stages}")


if __name__ == "__main__":
    main()
