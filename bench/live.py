#!/usr/bin/env python3
"""Memory, latency and dropped frames of `odograph live` over a long time.

    bench/live.py pace [--minutes 60]                    a camera of 640x480 at 30 frames per second
    bench/live.py overload [--minutes 10] [--times 3]    a camera with more frames than can be tracked

The camera is a rendered drive in real time, a closed figure eight. Its frames are held in memory
and written repeatedly to the program's standard input, each when it is due. For the overload the
program is bound to one core, together with a busy program of higher priority (`--nice`). The frame
rate that is a given multiple of the trackable one is determined first, by trial.

Prints one line per minute: resident, anonymous and file memory (MiB, maximum of one measurement per
second), the map file (MiB), frames written, tracked and dropped in that minute, the latency from
capture to pose reported by the program (median, 99th percentile, maximum, ms), the maximum latency
measured from outside (from the last byte written to the line read), and the frames lost, keyframes
and segments so far. `--table` writes the measurements of every second as CSV. Needs Linux, the
standard library of Python and the program.
"""

import argparse
import csv
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from contextlib import contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
COLUMNS = "minute  memory   anon  file   map  written tracked dropped  median    p99   most outside   lost keyframes stretches"


def quantile(values, share):
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("nan")


class Drive:
    """A rendered drive: its frames with their headers, and the options for the program."""

    def __init__(self, program, folder, size, rate):
        width, height = (int(side) for side in size.split("x"))
        way = ["--path", "eight", "--length", "2", "--rolling", "--size", size, "--fps", str(rate)]
        subprocess.run([program, "simulate", *way, "--format", "y4m", "-q", "-o", folder], check=True)
        self.video = next(folder.glob("*.y4m"))
        data = memoryview(self.video.read_bytes())
        header = bytes(data[:200]).index(b"\n") + 1
        frame = len(b"FRAME\n") + width * height
        self.header, body = data[:header], data[header:]
        if len(body) % frame:
            raise SystemExit(f"{self.video} is not gray Y4M of {size}")
        self.frames = [body[at : at + frame] for at in range(0, len(body), frame)]
        self.options = ["--camera", folder / "camera.yaml", "--rig", folder / "rig.toml"]
        self.rate = rate


class Live:
    """The running program, its output per frame, and its memory."""

    def __init__(self, program, source, drive, folder, held):
        self.folder, self.told = folder, folder.with_suffix(".told")
        # Per tracked frame: time when read, number, latency (ms), segment, whether it was lost.
        self.lines = []
        self.written = []  # time when each frame was written
        self.process = subprocess.Popen(
            [program, "live", source, *drive.options, "--print", "poses", "--serve", "127.0.0.1:0", "-o", folder],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.told.open("w"), preexec_fn=held,
        )  # fmt: skip
        self.reading = threading.Thread(target=self.read, daemon=True)
        self.reading.start()

    def read(self):
        for line in self.process.stdout:
            now, pose = time.monotonic(), json.loads(line)
            lost = pose["status"] != "tracked"
            self.lines.append((now, pose["frame"], pose["latency_ms"], pose["segment"], lost))

    def write(self, drive, seconds):
        """Writes the frames repeatedly until the time is over.

        Late frames are written at once, which keeps the average rate, not the intervals.
        """
        pipe, begun, count = self.process.stdin.fileno(), time.monotonic(), 0
        os.write(pipe, drive.header)
        while (now := time.monotonic()) < begun + seconds:
            due = begun + count / drive.rate
            if due > now:
                time.sleep(due - now)
            left = drive.frames[count % len(drive.frames)]
            while left:
                left = left[os.write(pipe, left) :]
            self.written.append(time.monotonic())
            count += 1
        self.process.stdin.close()

    def url(self):
        """URL of the page, which the program prints once it has opened the source."""
        while not (url := re.search(r"http://\S+", self.told.read_text())):
            if self.process.poll() is not None:
                raise SystemExit(self.told.read_text())
            time.sleep(0.05)
        return url[0]

    def measured(self, url):
        """Resident, anonymous and file memory and the map file, MiB, and the status of the page."""
        text = Path(f"/proc/{self.process.pid}/smaps_rollup").read_text()
        memory = [int(re.search(rf"^{key}:\s+(\d+)", text, re.M)[1]) / 1024 for key in ("Rss", "Pss_Anon", "Pss_File")]
        map_file = sum(file.stat().st_size for file in self.folder.glob("map.gpkg*")) / 2**20
        state = json.load(urllib.request.urlopen(url + "state", timeout=30))
        return *memory, map_file, state["status"]


def watch(live, writer, table):
    """Measures once per second and prints one line per minute until the writer is done."""
    url, begun, rows, counts = live.url(), time.monotonic(), [], (0, 0, 0)
    print(COLUMNS, flush=True)
    while writer.is_alive():
        writer.join(1.0)
        *memory, map_file, status = live.measured(url)
        rows.append((time.monotonic() - begun, *memory, map_file, status["captured"], status["dropped"], len(live.lines)))
        minute = int(rows[-1][0] // 60)
        ended = len(rows) > 1 and int(rows[-2][0] // 60) < minute
        if ended or not writer.is_alive():
            counts = tell(live, minute if ended else minute + 1, [row for row in rows if row[0] > rows[-1][0] - 60], status, counts)
    if table:
        with table.open("w", newline="") as out:
            names = ["seconds", "rss_mib", "anon_mib", "file_mib", "map_mib", "captured", "dropped", "tracked"]
            csv.writer(out).writerows([names, *([round(value, 2) for value in row] for row in rows)])


def tell(live, minute, rows, status, before):
    """Prints the line of a minute. Returns the counts at its end."""
    counts = (len(live.written), len(live.lines), status["dropped"])
    written, tracked, dropped = (now - then for now, then in zip(counts, before))
    lines = live.lines[before[1] : counts[1]]
    latencies = [line[2] for line in lines]
    outside = max((read - live.written[frame] for read, frame, *_ in lines if frame < len(live.written)), default=0)
    memory, anonymous, file = (max(row[at] for row in rows) for at in (1, 2, 3))
    print(
        f"{minute:6} {memory:7.1f} {anonymous:6.1f} {file:5.1f} {rows[-1][4]:5.1f} {written:8} {tracked:7} {dropped:7} "
        f"{quantile(latencies, 0.5):7.2f} {quantile(latencies, 0.99):6.1f} {max(latencies, default=0):6.0f} {1e3 * outside:7.0f} "
        f"{sum(line[4] for line in lines):6} {status['keyframes']:9} {lines[-1][3] + 1 if lines else 0:9}",
        flush=True,
    )
    return counts


def overloading(program, scratch, size, times, held):
    """A drive whose frame rate is `times` times what the program can track, found by trial."""
    rate = 120
    while True:
        drive = Drive(program, scratch / f"drive-{rate}", size, rate)
        round_s = len(drive.frames) / rate
        live = Live(program, "-", drive, scratch / f"trial-{rate}", held)
        live.write(drive, 3 * round_s)
        live.process.wait()
        live.reading.join()
        # The first round, which builds the map, does not count.
        tracked = sum(1 for line in live.lines if line[1] > len(drive.frames)) / (2 * round_s)
        print(f"of a camera that gives {rate} frames/s of {size}, {tracked:.1f} can be tracked", flush=True)
        if rate >= times * tracked:
            return drive
        rate = round(1.15 * max(times * tracked, rate))


@contextmanager
def crowded(core, niceness):
    """Keeps a core busy; yields a function that binds a process to it with low priority."""

    def pinned(nice):
        os.sched_setaffinity(0, {core})
        os.nice(nice)

    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"], preexec_fn=lambda: pinned(0))
    try:
        yield lambda: pinned(niceness)
    finally:
        busy.kill()
        busy.wait()


def follow(program, drive, scratch, seconds, held, table):
    """Runs the program and prints its final statistics."""
    live = Live(program, "-", drive, scratch / "run", held)
    writer = threading.Thread(target=live.write, args=(drive, seconds))
    writer.start()
    watch(live, writer, table)
    live.process.wait()
    statistics = json.loads((scratch / "run" / "stats.json").read_text())
    names = ("frames", "losses", "distance_m", "keyframes", "peak_memory_bytes", "live")
    print(json.dumps({name: statistics[name] for name in names}))
    print(f"{statistics['live']['frames_captured'] / statistics['frames']:.2f} frames came for each that was tracked")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["pace", "overload"])
    parser.add_argument("--minutes", type=float, help="60, of an overload 10")
    parser.add_argument("--times", type=float, default=3.0, help="overload: times the rate that can be tracked")
    parser.add_argument("--nice", type=int, default=10, help="overload: how far the program stands back behind the busy one")
    parser.add_argument("--size", default="640x480")
    parser.add_argument("--table", type=Path)
    parser.add_argument("--program", type=Path, default=ROOT / "target/release/odograph")
    arguments = parser.parse_args()
    program = arguments.program.resolve()
    with tempfile.TemporaryDirectory() as scratch:
        scratch = Path(scratch)
        if arguments.what == "pace":
            drive = Drive(program, scratch / "drive", arguments.size, 30)
            follow(program, drive, scratch, 60 * (arguments.minutes or 60), None, arguments.table)
            return
        with crowded(max(os.sched_getaffinity(0)), arguments.nice) as held:
            drive = overloading(program, scratch, arguments.size, arguments.times, held)
            follow(program, drive, scratch, 60 * (arguments.minutes or 10), held, arguments.table)


if __name__ == "__main__":
    main()
