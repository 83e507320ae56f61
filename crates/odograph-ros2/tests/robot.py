"""A robot in ROS 2, made of Cyclone DDS alone, and the program beside it."""

import csv
import json
import math
import os
import re
import signal
import subprocess
import threading
import time
from pathlib import Path

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

import messages as ros

SENSOR = Qos(Policy.Reliability.BestEffort, Policy.History.KeepLast(5))
RELIABLE = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(200))
LATCHED = Qos(
    Policy.Reliability.Reliable(duration(seconds=1)),
    Policy.Durability.TransientLocal,
    Policy.History.KeepLast(10),
)

# Images have their own times, which are not those of this machine.
BEGAN_NS = 1_750_000_000_123_456_789


def header(time_ns, frame):
    return ros.Header(ros.Time(time_ns // 1_000_000_000, time_ns % 1_000_000_000), frame)


def stamp_ns(message):
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


class Robot:
    """Publishes and collects on a domain, which is that of programs from now on."""

    def __init__(self, domain):
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        self.participant = DomainParticipant(domain)
        self.writers = {}
        self.collected = {}
        self.ended = threading.Event()

    def writer(self, name, kind, qos=SENSOR):
        if name not in self.writers:
            topic = Topic(self.participant, f"rt{name}", kind)
            self.writers[name] = DataWriter(self.participant, topic, qos=qos)
        return self.writers[name]

    def listen(self, name, kind, qos=RELIABLE):
        """A list that grows by (time of arrival, message)."""
        topic = Topic(self.participant, f"rt{name}" if name.startswith("/") else name, kind)
        reader = DataReader(self.participant, topic, qos=qos)
        taken = []

        def take():
            while not self.ended.is_set():
                for message in reader.take_iter(timeout=duration(milliseconds=100)):
                    taken.append((time.monotonic(), message))

        threading.Thread(target=take, daemon=True).start()
        self.collected[name] = taken
        return taken

    def client(self, name, kind):
        """A client of a service, as rmw_cyclonedds makes one: call it with the fields of a request."""
        return Client(self.participant, name, kind)

    def close(self):
        """Vanishes from the domain."""
        self.ended.set()
        time.sleep(0.2)
        self.writers.clear()
        self.participant = None


class Client:
    """A client of a service; several may call at once, and each gets its own replies."""

    identifiers = iter(range(0x1234_5678_9ABC_DEF0, 2**64))

    def __init__(self, participant, name, kind):
        request, reply = getattr(ros, f"{kind}Request"), getattr(ros, f"{kind}Reply")
        quality = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(10))
        self.name, self.request = name, request
        self.writer = DataWriter(participant, Topic(participant, f"rq{name}Request", request), qos=quality)
        self.reader = DataReader(participant, Topic(participant, f"rr{name}Reply", reply), qos=quality)
        self.identifier, self.number = next(self.identifiers), 0

    def is_there(self):
        """As rmw_service_server_is_available says."""
        return self.writer.get_matched_subscriptions() and self.reader.get_matched_publications()

    def send(self, *fields):
        self.number += 1
        self.writer.write(self.request(self.identifier, self.number, *fields))

    def __call__(self, *fields, seconds=10):
        until(self.is_there, what=f"the service {self.name}")
        self.send(*fields)
        ends = time.monotonic() + seconds
        while time.monotonic() < ends:
            for reply in self.reader.take_iter(timeout=duration(milliseconds=100)):
                if (reply.guid, reply.number) == (self.identifier, self.number):
                    return reply
        raise AssertionError(f"{self.name} has not answered in {seconds} s")


class Program:
    """The program `odograph` with ROS 2, while it runs."""

    def __init__(self, folder, arguments):
        self.folder = Path(folder)
        self.began = time.monotonic()
        self.process = subprocess.Popen(
            [os.environ["ODOGRAPH"], *arguments.split()],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def interrupt(self):
        self.process.send_signal(signal.SIGINT)

    def memory_mb(self):
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return int(re.search(r"VmHWM:\s+(\d+)", status)[1]) / 1024

    def processor_s(self):
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def end(self, seconds=60):
        """Its exit code and what it has said."""
        try:
            said, _ = self.process.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
            said, _ = self.process.communicate()
            raise AssertionError(f"the program hangs: {said}") from None
        return self.process.returncode, said


class Recording:
    """The frames of a Y4M file in gray."""

    def __init__(self, path):
        data = Path(path).read_bytes()
        head, rest = data.split(b"\n", 1)
        fields = {field[:1]: field[1:] for field in head.decode().split()[1:]}
        assert fields["C"] == "mono", head
        self.width, self.height = int(fields["W"]), int(fields["H"])
        self.fps = int(fields["F"].split(":")[0])
        size = self.width * self.height
        step = size + len(b"FRAME\n")
        self.frames = [rest[at + 6 : at + step] for at in range(0, len(rest), step)]

    def time_ns(self, number):
        return BEGAN_NS + number * 1_000_000_000 // self.fps

    def image(self, number, frame="camera_optical"):
        return ros.Image(
            header(self.time_ns(number), frame),
            self.height,
            self.width,
            "mono8",
            0,
            self.width,
            self.frames[number],
        )


def play(recording, send, rate_hz=None, numbers=None):
    """Sends the frames at their rate; the time at which each was sent."""
    period_s = 1 / (rate_hz or recording.fps)
    sent, due = {}, time.monotonic()
    for number in numbers if numbers is not None else range(len(recording.frames)):
        due += period_s
        time.sleep(max(0.0, due - time.monotonic()))
        sent[number] = time.monotonic()
        send(number)
    return sent


def until(condition, seconds=20, what="it"):
    ends = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < ends, f"{what} has not happened in {seconds} s"
        time.sleep(0.05)


def matched(writer, count=1):
    return len(writer.get_matched_subscriptions()) >= count


def heading(quaternion):
    q = quaternion
    return math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))


def odograph(folder, arguments):
    command = [os.environ["ODOGRAPH"], *arguments.split()]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)


def poses(path):
    with open(path, encoding="utf-8") as file:
        return [row for row in csv.DictReader(file) if row["x_m"]]


def given(simulated):
    return f"--camera {simulated}/sim/camera.yaml --rig {simulated}/sim/rig.toml"


def statistics(folder):
    return json.loads((folder / "live/stats.json").read_text())


def ended(program, recording, odometry):
    """Interrupts the run when its last frame has been published; what it has said."""
    last = recording.time_ns(len(recording.frames) - 1)
    until(lambda: odometry and stamp_ns(odometry[-1][1]) == last, what="the last odometry")
    program.interrupt()
    code, said = program.end()
    assert code == 0, said
    return said
