#!/usr/bin/env python3
"""Runs the fuzz targets and writes what their logs say to bench/fuzz.json.

    python3 fuzz/run.py [--seconds 180] [--jobs 2] [TARGET ...]     # builds, runs, writes the figures
    python3 fuzz/run.py --figures-only                              # from the logs that are there

Needs cargo-fuzz and a nightly compiler. Corpora, failed inputs and logs go to fuzz/corpus,
fuzz/artifacts and fuzz/logs, or below --folder. A target that fails, or that a busy machine held
up, is started again until it had its time. Inputs that took more than a second by the clock are run
again: more than a second of the processor is a failure. The figures are the sums over all logs of a
target; those of one session need an empty folder. Exits with 1 if a target failed.
"""

import argparse
import concurrent.futures
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

FUZZ = Path(__file__).resolve().parent
DATA = FUZZ.parent / "crates/odograph-video/tests/data"

# Recordings that the tests have anyway; the other seeds are in fuzz/seeds/TARGET.
RECORDINGS = {
    "mp4": ["*.mp4", "*.mov"],
    "matroska": ["*.mkv", "*.webm"],
    "avi": ["*.avi"],
    "annex_b": ["*.264", "*.h265"],
    "pictures": ["*.jpg"],
    "mcap": ["bags/*.mcap"],
    "rosbag1": ["bags/*.bag"],
    "rosbag2": ["bags/*.db3", "bags/*.db3.zstd"],
}

LIMITS = ["-report_slow_units=1", "-timeout=10", "-rss_limit_mb=2560", "-print_final_stats=1"]
# libFuzzer's code for an input that exceeded the timeout.
TIMEOUT = 70
# A target whose seeds fail would be started for ever.
MOST_STARTS = 40


def targets():
    return sorted(path.stem for path in (FUZZ / "fuzz_targets").glob("*.rs"))


def build(sanitizer):
    command = ["cargo", "+nightly", "fuzz", "build", "--release", "--debug-assertions", "--sanitizer", sanitizer]
    subprocess.run(command, cwd=FUZZ.parent, check=True)


def program(target):
    about = subprocess.run(["rustc", "+nightly", "-vV"], check=True, capture_output=True, text=True).stdout
    host = re.search(r"host: (\S+)", about)[1]
    folder = Path(os.environ.get("CARGO_TARGET_DIR", FUZZ / "target"))
    return folder / host / "release" / target


def run(target, arguments):
    """Runs a target for its time."""
    folders = {name: arguments.folder / name / target for name in ("corpus", "artifacts", "logs", "recordings")}
    for folder in folders.values():
        folder.mkdir(parents=True, exist_ok=True)
    for pattern in RECORDINGS.get(target, []):
        for path in DATA.glob(pattern):
            shutil.copy(path, folders["recordings"])
    own = [FUZZ / "seeds" / target, FUZZ / "regressions" / target]
    inputs = [folders["corpus"], folders["recordings"], *filter(Path.is_dir, own)]
    used_s = 0
    for _ in range(MOST_STARTS):
        left_s = round(arguments.seconds - used_s)
        if left_s < 1:
            break
        limits = [*LIMITS, f"-max_total_time={left_s}", f"-artifact_prefix={folders['artifacts']}/"]
        with open(folders["logs"] / f"{time.time_ns()}.log", "w") as log:
            code, processor_s = execute(target, [*limits, *inputs], log)
            log.write(f"\nended with {code} after {processor_s:.1f} s of the processor\n")
        used_s += processor_s


def execute(target, arguments, log):
    """Runs a target; its exit code and the seconds of the processor that it took."""
    # No other program decodes what the crates cannot.
    environment = os.environ | {"ODOGRAPH_FFMPEG": ""}
    process = subprocess.Popen([program(target), *arguments], stdout=log, stderr=log, env=environment)
    _, status, usage = os.wait4(process.pid, 0)
    for scratch in Path("/dev/shm").glob(f"odograph-fuzz-{process.pid}-*"):
        scratch.unlink()
    return os.waitstatus_to_exitcode(status), usage.ru_utime + usage.ru_stime


def figures(target, arguments):
    """The sums over all logs of a target; `None` if it was never run."""
    last = lambda pattern, text: int((re.findall(pattern, text) or [0])[-1])
    sums = {"executions": 0, "processor_s": 0.0, "failures": 0, "features": 0, "memory_mb": 0}
    logs = sorted((arguments.folder / "logs" / target).glob("*.log"))
    for path in logs:
        text = path.read_text(errors="replace")
        ended = re.search(r"^ended with (-?\d+) after ([\d.]+) s of the processor$", text, re.MULTILINE)
        if not ended:
            continue
        sums["executions"] += last(r"stat::number_of_executed_units:\s*(\d+)", text)
        sums["processor_s"] += float(ended[2])
        sums["failures"] += int(ended[1]) not in (0, TIMEOUT)
        sums["features"] = max(sums["features"], last(r" ft: (\d+)", text))
        sums["memory_mb"] = max(sums["memory_mb"], last(r"stat::peak_rss_mb:\s*(\d+)", text))
    artifacts = arguments.folder / "artifacts" / target
    slow = [path for kind in ("slow-unit-*", "timeout-*") for path in artifacts.glob(kind)]
    slow_s = [execute(target, [path], subprocess.DEVNULL)[1] for path in slow]
    sums["failures"] += sum(seconds > 1 for seconds in slow_s)
    sums["slowest_ms"] = round(1e3 * max(slow_s, default=0))
    sums["processor_s"] = round(sums["processor_s"])
    sums["regressions"] = len(list((FUZZ / "regressions" / target).glob("*")))
    return sums if logs else None


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("targets", nargs="*", metavar="TARGET")
    parser.add_argument("--seconds", type=int, default=180, help="time of each target, of the processor")
    parser.add_argument("--jobs", type=int, default=1, help="targets side by side")
    parser.add_argument("--sanitizer", default="none", help="`address` is several times slower")
    parser.add_argument("--no-build", action="store_true", help="run what was built before")
    parser.add_argument("--folder", type=Path, default=FUZZ, help="place of corpora, failed inputs and logs")
    parser.add_argument("--json", type=Path, default=FUZZ.parent / "bench/fuzz.json")
    parser.add_argument("--figures-only", action="store_true")
    arguments = parser.parse_args()
    if not arguments.figures_only:
        if not arguments.no_build:
            build(arguments.sanitizer)
        with concurrent.futures.ThreadPoolExecutor(arguments.jobs) as pool:
            list(pool.map(lambda target: run(target, arguments), arguments.targets or targets()))
    known = {target: figures(target, arguments) for target in targets()}
    known = {target: sums for target, sums in known.items() if sums}
    for target, sums in known.items():
        print(target, json.dumps(sums))
    arguments.json.write_text(json.dumps({"sanitizer": arguments.sanitizer, "targets": known}, indent=2) + "\n")
    return int(any(sums["failures"] for sums in known.values()))


if __name__ == "__main__":
    sys.exit(main())
