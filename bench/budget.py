#!/usr/bin/env python3
"""Whether `--budget-ms` is kept, and at what cost: the bundled drive with several budgets.

    cargo build --release && python3 bench/budget.py [--program target/release/odograph] [BUDGET_MS ...]

For each budget: the share of frames tracked within it, what was reduced to achieve that, and the
resulting deviation of the trajectory. Times are wall-clock times, so other load of the machine
counts.
"""

import argparse
import json
import subprocess
import tempfile
from pathlib import Path


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--program", type=Path, default=Path("target/release/odograph"))
    parser.add_argument("budgets_ms", nargs="*", type=float, default=[8, 4, 2])
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as work:
        demo, run = Path(work) / "demo", Path(work) / "run"
        subprocess.run([arguments.program, "demo", "--quiet", "-o", demo], check=True)
        inputs = demo / "input"
        command = [arguments.program, "run", inputs / "drive.mp4", "--camera", inputs / "camera.yaml", "--rig", inputs / "rig.toml"]
        print("| budget | frames within it | p99 of a frame | corners | levels | path off, mean |\n|---|---|---|---|---|---|")
        for budget_ms in arguments.budgets_ms:
            options = ["--budget-ms", str(budget_ms), "--threads", "1", "--json", "--force", "-o", run]
            done = subprocess.run(command + options, capture_output=True, text=True)
            if done.returncode:
                print(f"| {budget_ms:g} ms | refused: {done.stderr.strip().removeprefix('error: ')} | | | | |")
                continue
            stats = json.loads(done.stdout)
            budget = stats["budget"]
            within = 100 * (1 - budget["frames_over"] / stats["frames"])
            evaluate = [arguments.program, "evaluate", run / "trajectory.tum", inputs / "truth.tum", "--align", "origin", "--json"]
            found = json.loads(subprocess.run(evaluate, check=True, capture_output=True, text=True).stdout)
            off_mm = 1e3 * found["absolute"]["translation_m"]["mean"]
            print(
                f"| {budget_ms:g} ms | {within:.2f} % | {stats['stages']['track']['p99_ms']:.2f} ms "
                f"| {budget['corners']} of {budget['corners_without']} | {budget['levels']} of {budget['levels_without']} | {off_mm:.1f} mm |"
            )


if __name__ == "__main__":
    main()
