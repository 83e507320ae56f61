#!/usr/bin/env python3
"""Where `odograph run --gnss` puts a rendered path on Earth, with simulated receivers.

    cargo build --release && python3 bench/gnss.py

Needs only Python. One rendered path around a square of 12 m, 48 m in 42 s; for each receiver five
draws of its errors. Every tenth position is moved by 3.6 m, as by a reflection. The errors are
normal; those that last are of first order with a correlation time of 30 s. Each path is compared
with the truth frame by frame, in metres east and north. Prints the table of docs/gnss.md.
"""

import argparse
import csv
import json
import math
import random
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

SEEDS = range(1, 6)
SPEED_M_S = 1.2
# Each with the deviation of a position, positions per second, how long an error lasts, and the
# factor by which the height of the camera is given wrongly.
RECEIVERS = [
    {"name": "RTK", "sigma_m": 0.02, "rate": 5, "lasts_s": 0, "height": 1.0},
    {"name": "RTK, the height given 3 % too large", "sigma_m": 0.02, "rate": 5, "lasts_s": 0, "height": 1.03},
    {"name": "RTK float", "sigma_m": 0.3, "rate": 5, "lasts_s": 0, "height": 1.0},
    {"name": "single", "sigma_m": 2.0, "rate": 1, "lasts_s": 0, "height": 1.0},
    {"name": "single, errors that last", "sigma_m": 2.0, "rate": 1, "lasts_s": 30, "height": 1.0},
]
# The ellipsoid WGS 84, and a place in Vienna with x of the path 30° north of east.
A_M, E2 = 6378137.0, 6.69437999014e-3
LATITUDE, LONGITUDE, TURN = math.radians(48.2082), math.radians(16.3738), math.radians(30)
ROOT = math.sqrt(1 - E2 * math.sin(LATITUDE) ** 2)
NORTH_M, EAST_M = A_M * (1 - E2) / ROOT**3, A_M / ROOT * math.cos(LATITUDE)


def on_earth(x, y):
    """Degrees of a point of the plane: exact to 0.1 mm over the path."""
    east, north = math.cos(TURN) * x - math.sin(TURN) * y, math.sin(TURN) * x + math.cos(TURN) * y
    return math.degrees(LATITUDE + north / NORTH_M), math.degrees(LONGITUDE + east / EAST_M)


def fixes(truth, receiver, seed):
    """The lines of a receiver, and how many positions were moved."""
    draw, moved = random.Random(seed), 0
    lines, error = ["time_s,latitude_deg,longitude_deg,sigma_m"], [0.0, 0.0]
    interval = 1 / receiver["rate"]
    kept = math.exp(-interval / receiver["lasts_s"]) if receiver["lasts_s"] else 0.0
    error = [draw.gauss(0, receiver["sigma_m"]) for _ in error]
    next_s = truth[0][0]
    for time_s, x, y in truth:
        if time_s < next_s - 1e-6:
            continue
        next_s += interval
        fresh = receiver["sigma_m"] * math.sqrt(1 - kept**2)
        error = [kept * value + draw.gauss(0, fresh) for value in error]
        at = [x + error[0], y + error[1]]
        if len(lines) % 10 == 5:
            turn, moved = draw.uniform(0, math.tau), moved + 1
            at = [at[0] + 3.6 * math.cos(turn), at[1] + 3.6 * math.sin(turn)]
        latitude, longitude = on_earth(*at)
        lines.append(f"{time_s:.6f},{latitude:.10f},{longitude:.10f},{receiver['sigma_m']}")
    return "\n".join(lines) + "\n", moved


def measured(program, folder, truth, receiver, seed):
    text, moved = fixes(truth, receiver, seed)
    (folder / "fixes.csv").write_text(text)
    height = ["--height", f"{0.75 * receiver['height']:.4f}"]
    command = [program, "run", "sim/frames", "--timestamps", "sim/frames.txt", "--camera", "sim/camera.yaml"]
    subprocess.run(command + height + ["--gnss", "fixes.csv", "-o", "run", "--force", "--quiet"], cwd=folder, check=True)
    gnss = json.loads((folder / "run/stats.json").read_text())["gnss"]
    there = {round(time_s, 4): on_earth(x, y) for time_s, x, y in truth}
    off_m = []
    with (folder / "run/trajectory-utm.csv").open() as table:
        for row in csv.DictReader(table):
            latitude, longitude = there[round(float(row["time_s"]), 4)]
            north_m = math.radians(float(row["latitude_deg"]) - latitude) * NORTH_M
            east_m = math.radians(float(row["longitude_deg"]) - longitude) * EAST_M
            off_m.append(math.hypot(east_m, north_m))
    bearing = (gnss["bearing_deg"] - (90 - math.degrees(TURN)) + 540) % 360 - 180
    return {
        "fixes": gnss["fixes"],
        "moved": moved,
        "rejected": gnss["rejected"],
        "rmse_m": math.sqrt(sum(value**2 for value in off_m) / len(off_m)),
        "most_m": max(off_m),
        "bearing_deg": abs(bearing),
        "scale": gnss["scale"],
        "bent": gnss["bent"],
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", default="target/release/odograph")
    program = str(Path(parser.parse_args().program).resolve())
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        simulate = f"simulate -o sim --path square --length 12 --speed {SPEED_M_S} --fps 15 --size 320x240"
        subprocess.run([program, *simulate.split(), "--height", "0.75", "--seed", "6", "--quiet"], cwd=folder, check=True)
        truth = [tuple(map(float, line.split()[:3])) for line in (folder / "sim/truth.tum").read_text().splitlines() if line[0] != "#"]
        for receiver in RECEIVERS:
            of = [measured(program, folder, truth, receiver, seed) for seed in SEEDS]
            print(receiver["name"], of, file=sys.stderr)
            middle = lambda key: statistics.median(one[key] for one in of)
            worst_m = max(one["rmse_m"] for one in of)
            sigma = f"{100 * receiver['sigma_m']:.0f} cm" if receiver["sigma_m"] < 1 else f"{receiver['sigma_m']:.0f} m"
            rows.append([
                receiver["name"], f"{sigma}, {receiver['rate']} per s", str(of[0]["fixes"]), str(of[0]["moved"]),
                f"{middle('rejected'):.0f}", length(middle("rmse_m")), length(worst_m), length(middle("most_m")),
                f"{middle('bearing_deg'):.2f}°", f"{middle('scale'):.4f}", f"{sum(one['bent'] for one in of)} of {len(SEEDS)}",
            ])
    print("| receiver | standard deviation | positions | moved | rejected | RMSE of the path | worst of five | largest error | "
          "error of the bearing | scale found | path corrected |")
    print("|---" * 11 + "|")
    for row in rows:
        print("| " + " | ".join(row) + " |")


def length(value_m):
    return f"{1000 * value_m:.0f} mm" if value_m < 0.1 else f"{value_m:.2f} m"


if __name__ == "__main__":
    main()
