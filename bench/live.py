#!/usr/bin/env python3
"""Memory, latency and dropped frames of `odograph live` over a long time.

    bench/live.py pace [--minutes 60]                    a camera of 640x480 at 30 frames a second
    bench/live.py overload [--minutes 10] [--times 3]    a camera that gives more frames than can be tracked

The camera is a rendered drive, a figure of eight that closes upon itself, at the speed of life. Its frames are held in memory and written round after
round into the program's standard input, each when its time has come. For the overload the program is held to one core, which it shares with a
program that is always busy and has far more of it (`--nice`); how many frames a second a camera must give to give so many times what is tracked is
found first, by trying.

Prints a line a minute: resident, anonymous and file memory (MiB, the most of one measurement a second), the map file (MiB), frames written, tracked and
dropped in that minute, latency from the capture of a frame to its pose as the program has it (median, 99th percentile, most, ms), the most as
measured from outside (from the last byte written to the line read), frames lost, keyframes and stretches so far. `--table` writes every second's
measurement as CSV. Needs Linux, Python's standard library and the program.
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
    """A rendered drive: its frames with their headers, and what the program must be told of it."""

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
    """The program while it runs, what it says of each frame, and how much memory it has."""

    def __init__(self, program, source, drive, folder, held):
        self.folder, self.told = folder, folder.with_suffix(".told")
        self.lines = []  # of each frame tracked: when it was read, number, latency (ms), stretch, whether it was lost
        self.written = []  # when each frame was written
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
        """Writes round after round until the time is over. A frame that is late goes at once: the rate is held, not the gaps."""
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
        """Where the page is; the program says so when it has seen the source."""
        while not (url := re.search(r"http://\S+", self.told.read_text())):
            if self.process.poll() is not None:
                raise SystemExit(self.told.read_text())
            time.sleep(0.05)
        return url[0]

    def measured(self, url):
        """Resident, anonymous and file memory and the map file, MiB, and what the page says."""
        text = Path(f"/proc/{self.process.pid}/smaps_rollup").read_text()
        memory = [int(re.search(rf"^{key}:\s+(\d+)", text, re.M)[1]) / 1024 for key in ("Rss", "Pss_Anon", "Pss_File")]
        map_file = sum(file.stat().st_size for file in self.folder.glob("map.gpkg*")) / 2**20
        state = json.load(urllib.request.urlopen(url + "state", timeout=30))
        return *memory, map_file, state["status"]


def watch(live, writer, table):
    """A measurement a second and a line a minute until the writer is done."""
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
    """Prints a minute. Gives the counts at its end."""
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
    """A drive of a camera that gives so many times the frames that the program can track of it, found by trying."""
    rate = 120
    while True:
        drive = Drive(program, scratch / f"drive-{rate}", size, rate)
        round_s = len(drive.frames) / rate
        live = Live(program, "-", drive, scratch / f"trial-{rate}", held)
        live.write(drive, 3 * round_s)
        live.process.wait()
        live.reading.join()
        # The first round, in which the map is made, does not count.
        tracked = sum(1 for line in live.lines if line[1] > len(drive.frames)) / (2 * round_s)
        print(f"of a camera that gives {rate} frames/s of {size}, {tracked:.1f} can be tracked", flush=True)
        if rate >= times * tracked:
            return drive
        rate = round(1.15 * max(times * tracked, rate))


@contextmanager
def crowded(core, niceness):
    """A core that is always busy: gives what holds a program to it that gets little of it."""

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
    """Runs it, and tells how it ended."""
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
