"""Writes the small recordings beside this file. Needs rosbags 0.11, numpy and pillow from PyPI."""

import io
import shutil
import struct
from pathlib import Path

import numpy as np
from PIL import Image
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

HERE = Path(__file__).parent
WIDTH, HEIGHT, FRAMES = 24, 16, 6
START_NS = 1_700_000_000_123_456_789
STEP_NS = 33_333_333

ROS1 = get_typestore(Stores.ROS1_NOETIC)
ROS2 = get_typestore(Stores.ROS2_HUMBLE)
FFMPEG = "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\nbool is_bigendian\nuint8[] data\n"
FOXGLOVE = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
ROS2.register(get_types_from_msg(FFMPEG, "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"))
ROS2.register(get_types_from_msg(FOXGLOVE, "foxglove_msgs/msg/CompressedVideo"))


def level(number, x, y):
    """The gray level of a pixel, which the tests compute as well."""
    return (x * 7 + y * 13 + number * 31 + x * y) % 256


def gray(number):
    return np.array([[level(number, x, y) for x in range(WIDTH)] for y in range(HEIGHT)], np.uint8)


class Store:
    """Messages of ROS 1 or ROS 2."""

    def __init__(self, types, ros1):
        self.types, self.ros1 = types, ros1

    def message(self, name, **fields):
        return self.types.types[name](**fields)

    def stamp(self, time_ns):
        return self.message("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)

    def header(self, time_ns, frame="camera"):
        extra = {"seq": 0} if self.ros1 else {}
        return self.message("std_msgs/msg/Header", stamp=self.stamp(time_ns), frame_id=frame, **extra)

    def image(self, time_ns, encoding, width, height, step, data, big_endian=0):
        return self.message(
            "sensor_msgs/msg/Image", header=self.header(time_ns), height=height, width=width, encoding=encoding,
            is_bigendian=big_endian, step=step, data=np.frombuffer(data, np.uint8),
        )

    def compressed(self, time_ns, kind, samples):
        out = io.BytesIO()
        Image.fromarray(samples).save(out, kind, **({"quality": 90} if kind == "jpeg" else {}))
        data = np.frombuffer(out.getvalue(), np.uint8)
        return self.message("sensor_msgs/msg/CompressedImage", header=self.header(time_ns), format=kind, data=data)

    def camera_info(self, time_ns):
        region = self.message(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        upper = {} if not self.ros1 else None
        values = {
            "d": np.array([0.1, -0.05, 0.001, -0.002, 0.01]),
            "k": np.array([20.0, 0, 11.5, 0, 21.0, 7.5, 0, 0, 1]),
            "r": np.eye(3).flatten(),
            "p": np.array([19.0, 0, 11.0, 0, 0, 19.5, 7.0, 0, 0, 0, 1, 0]),
        }
        if upper is None:
            values = {name.upper(): value for name, value in values.items()}
        return self.message(
            "sensor_msgs/msg/CameraInfo", header=self.header(time_ns), height=HEIGHT, width=WIDTH,
            distortion_model="plumb_bob", binning_x=0, binning_y=0, roi=region, **values,
        )

    def vector(self, x, y, z):
        return self.message("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def quaternion(self):
        return self.message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)

    def imu(self, time_ns, number):
        zeros = np.zeros(9)
        return self.message(
            "sensor_msgs/msg/Imu", header=self.header(time_ns, "imu"), orientation=self.quaternion(),
            orientation_covariance=zeros, angular_velocity=self.vector(0.01 * number, 0.02, -0.03),
            angular_velocity_covariance=zeros, linear_acceleration=self.vector(0.0, 0.0, 9.81),
            linear_acceleration_covariance=zeros,
        )

    def odometry(self, time_ns, number):
        point = self.message("geometry_msgs/msg/Point", x=1.0, y=2.0, z=0.0)
        pose = self.message("geometry_msgs/msg/Pose", position=point, orientation=self.quaternion())
        twist = self.message(
            "geometry_msgs/msg/Twist", linear=self.vector(0.5 + 0.1 * number, 0.0, 0.0), angular=self.vector(0.0, 0.0, 0.1)
        )
        zeros = np.zeros(36)
        return self.message(
            "nav_msgs/msg/Odometry", header=self.header(time_ns, "odom"), child_frame_id="base_link",
            pose=self.message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=zeros),
            twist=self.message("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=zeros),
        )

    def range(self, time_ns, number):
        return self.message(
            "sensor_msgs/msg/Range", header=self.header(time_ns, "range"), radiation_type=1, field_of_view=0.1,
            min_range=0.1, max_range=4.0, range=0.75 + 0.25 * number,
        )

    def serialize(self, message):
        name = message.__msgtype__
        return bytes(self.types.serialize_ros1(message, name) if self.ros1 else self.types.serialize_cdr(message, name))


def drive(store, frames=range(FRAMES)):
    """A camera with its sensors: topic, time of recording, message."""
    for number in frames:
        time_ns = START_NS + number * STEP_NS
        log_ns = time_ns + 5_000_000
        yield "/camera/camera_info", log_ns, store.camera_info(time_ns)
        yield "/camera/image_raw", log_ns, store.image(time_ns, "mono8", WIDTH, HEIGHT, WIDTH, gray(number).tobytes())
        yield "/imu", log_ns, store.imu(time_ns, number)
        yield "/odom", log_ns, store.odometry(time_ns, number)
        yield "/range", log_ns, store.range(time_ns, number)


def encodings(store):
    """A topic for each encoding, each with one image; gray levels, so that all give the same."""
    samples = gray(0)
    wide = np.zeros((HEIGHT, WIDTH + 5), np.uint8)
    wide[:, :WIDTH] = samples
    three = np.repeat(samples[:, :, None], 3, 2)
    four = np.concatenate([three, np.full((HEIGHT, WIDTH, 1), 255, np.uint8)], 2)
    uyvy = np.stack([np.full_like(samples, 128), samples], 2)
    yuyv = np.stack([samples, np.full_like(samples, 128)], 2)
    deep = samples.astype(np.uint16) * 257
    nv12 = np.concatenate([samples, np.full((HEIGHT // 2, WIDTH), 128, np.uint8)])
    flat = np.full((HEIGHT, WIDTH), 77, np.uint8)
    raw = [
        ("mono8", "mono8", samples, WIDTH), ("wide", "mono8", wide, WIDTH + 5), ("unsigned", "8UC1", samples, WIDTH),
        ("mono16", "mono16", deep, 2 * WIDTH), ("rgb8", "rgb8", three, 3 * WIDTH), ("bgr8", "bgr8", three, 3 * WIDTH),
        ("three", "8UC3", three, 3 * WIDTH), ("rgba8", "rgba8", four, 4 * WIDTH), ("bgra8", "bgra8", four, 4 * WIDTH),
        ("uyvy", "yuv422", uyvy, 2 * WIDTH), ("yuyv", "yuv422_yuy2", yuyv, 2 * WIDTH), ("nv12", "nv12", nv12, WIDTH),
        ("bayer_rggb8", "bayer_rggb8", flat, WIDTH), ("bayer_gbrg8", "bayer_gbrg8", flat, WIDTH),
    ]
    for topic, encoding, data, step in raw:
        yield f"/{topic}", START_NS, store.image(START_NS, encoding, WIDTH, HEIGHT, step, data.tobytes())
    yield "/mono16_big", START_NS, store.image(
        START_NS, "mono16", WIDTH, HEIGHT, 2 * WIDTH, deep.astype(">u2").tobytes(), big_endian=1
    )
    yield "/depth", START_NS, store.image(START_NS, "32FC1", WIDTH, HEIGHT, 4 * WIDTH, bytes(4 * WIDTH * HEIGHT))
    yield "/png/compressed", START_NS, store.compressed(START_NS, "png", samples)
    yield "/jpeg/compressed", START_NS, store.compressed(START_NS, "jpeg", flat)


def unstamped(store):
    """Images whose header was never filled in."""
    for number in range(FRAMES):
        image = store.image(0, "mono8", WIDTH, HEIGHT, WIDTH, gray(number).tobytes())
        yield "/image", START_NS + number * STEP_NS, image


def access_units(path):
    """The access units of a raw stream (H.264 or HEVC) with one slice a picture."""
    data = path.read_bytes()
    hevc = path.suffix == ".h265"
    starts = [at for at in range(len(data) - 3) if data[at : at + 3] == b"\0\0\1"]
    units, current, has_slice = [], b"", False
    for start, end in zip(starts, starts[1:] + [len(data)]):
        nal = b"\0" + data[start:end].rstrip(b"\0")
        kind = nal[4] >> 1 & 63 if hevc else nal[4] & 31
        if has_slice:
            units.append(current)
            current, has_slice = b"", False
        current += nal
        has_slice = kind < 32 if hevc else kind in (1, 5)
    return units + [current]


def videos(store):
    """The packets of two videos, in the messages of two packages."""
    for number, unit in enumerate(access_units(HERE / "../hevc.h265")):
        time_ns = START_NS + number * STEP_NS
        yield "/video", time_ns, store.message(
            "foxglove_msgs/msg/CompressedVideo", timestamp=store.stamp(time_ns), frame_id="camera",
            data=np.frombuffer(unit, np.uint8), format="h265",
        )
    for number, unit in enumerate(access_units(HERE / "../h264_interlaced.264")):
        time_ns = START_NS + number * STEP_NS
        yield "/ffmpeg", time_ns, store.message(
            "ffmpeg_image_transport_msgs/msg/FFMPEGPacket", header=store.header(time_ns), width=0, height=0,
            encoding="libx264", pts=number, flags=0, is_bigendian=False, data=np.frombuffer(unit, np.uint8),
        )


def write1(name, messages, compression=None, threshold=None):
    path = HERE / name
    path.unlink(missing_ok=True)
    writer, store = Writer1(path), Store(ROS1, True)
    if compression:
        writer.set_compression(compression)
    if threshold:
        writer.chunk_threshold = threshold
    with writer:
        connections = {}
        for topic, log_ns, message in messages(store):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=ROS1)
            writer.write(connections[topic], log_ns, store.serialize(message))


def write2(name, messages, plugin, mode=None, folder=False):
    place = HERE / (name + ".folder")
    shutil.rmtree(place, ignore_errors=True)
    writer, store = Writer2(place, version=9, storage_plugin=plugin), Store(ROS2, False)
    if mode:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, log_ns, message in messages(store):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=ROS2)
            writer.write(connections[topic], log_ns, store.serialize(message))
    (file,) = [path for path in place.iterdir() if path.suffix != ".yaml"]
    target = HERE / name
    if not folder:
        file.replace(target)
        shutil.rmtree(place)
    return place


def mcap_lz4(source, target):
    """Compresses the records of an MCAP file into one lz4 chunk, without a summary."""
    import lz4.frame
    from binascii import crc32

    data, at, records, head = source.read_bytes(), 8, b"", b""
    while data[at] not in (0x02, 0x0F):
        kind, (length,) = data[at], struct.unpack_from("<Q", data, at + 1)
        record = data[at : at + 9 + length]
        if kind == 0x01:
            head = record
        elif kind == 0x06:
            size, _, name = struct.unpack_from("<QII", data, at + 9 + 16)
            assert name == 0, "the source is not compressed"
            records += record[9 + 16 + 8 + 4 + 4 + 8 :]
        elif kind in (0x03, 0x04, 0x05):
            records += record
        at += 9 + length
    packed = lz4.frame.compress(records)
    chunk = struct.pack("<QQQI", START_NS, START_NS + 10**9, len(records), crc32(records))
    chunk += struct.pack("<I", 3) + b"lz4" + struct.pack("<Q", len(packed)) + packed
    end = b"\x0f" + struct.pack("<QI", 4, 0) + b"\x02" + struct.pack("<QQQI", 20, 0, 0, 0)
    target.write_bytes(data[:8] + head + b"\x06" + struct.pack("<Q", len(chunk)) + chunk + end + data[:8])


def main():
    for old in HERE.iterdir():
        if old.is_dir():
            shutil.rmtree(old)
    one = 2500  # bytes of a chunk, so that there are several
    write1("drive.bag", drive, threshold=one)
    write1("drive_bz2.bag", drive, Writer1.CompressionFormat.BZ2, one)
    write1("drive_lz4.bag", drive, Writer1.CompressionFormat.LZ4, one)
    write2("drive.mcap", drive, StoragePlugin.MCAP)
    mcap_lz4(HERE / "drive.mcap", HERE / "drive_lz4.mcap")
    write2("drive_zstd.mcap", drive, StoragePlugin.MCAP, CompressionMode.STORAGE)
    write2("drive.db3", drive, StoragePlugin.SQLITE3)
    write2("drive_message.db3", drive, StoragePlugin.SQLITE3, CompressionMode.MESSAGE)
    write2("drive.db3.zstd", drive, StoragePlugin.SQLITE3, CompressionMode.FILE)
    write2("encodings.mcap", encodings, StoragePlugin.MCAP, CompressionMode.STORAGE)
    write1("encodings.bag", encodings, Writer1.CompressionFormat.BZ2)
    write2("unstamped.mcap", unstamped, StoragePlugin.MCAP, CompressionMode.STORAGE)
    write2("video.mcap", videos, StoragePlugin.MCAP)
    # Two parts of one recording, as `ros2 bag record --max-bag-size` writes them.
    split = write2("split", lambda store: drive(store, range(3)), StoragePlugin.MCAP, folder=True)
    second = write2("second.mcap", lambda store: drive(store, range(3, FRAMES)), StoragePlugin.MCAP)
    parts = HERE / "split"
    parts.mkdir()
    next(split.glob("*.mcap")).replace(parts / "split_0.mcap")
    (HERE / "second.mcap").replace(parts / "split_1.mcap")
    (parts / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  relative_file_paths:\n"
        "    - split_0.mcap\n    - split_1.mcap\n"
    )
    shutil.rmtree(split)
    assert not second.exists()


main()
