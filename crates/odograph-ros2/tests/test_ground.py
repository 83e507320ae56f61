"""The ground that is published: its cells, and its mosaic with the georeference."""

import re
import struct
import zlib

import messages as ros
import pytest
from robot import (
    LATCHED,
    Program,
    Robot,
    ended,
    given,
    matched,
    odograph,
    os,
    play,
    stamp_ns,
    until,
)


def grid_file(folder):
    """Cell size, corner, and cells from below of a map of Nav2's map server."""
    yaml = (folder / "grid.yaml").read_text()
    cell_m = float(re.search(r"resolution: (\S+)", yaml)[1])
    corner = [float(word) for word in re.search(r"origin: \[(\S+), (\S+),", yaml).groups()]
    _, size, _, samples = (folder / "grid.pgm").read_bytes().split(b"\n", 3)
    width, height = map(int, size.split())
    rows = [samples[row * width : (row + 1) * width] for row in range(height)]
    return cell_m, corner, rows[::-1]


def rgb(png):
    """Width, height and samples of a PNG in colour with 8 bits."""
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    at, packed = 8, b""
    while at < len(png):
        length, kind = struct.unpack(">I4s", png[at : at + 8])
        data = png[at + 8 : at + 8 + length]
        if kind == b"IHDR":
            width, height, depth, colour = struct.unpack(">IIBB", data[:10])
            assert (depth, colour) == (8, 2)
        packed += data if kind == b"IDAT" else b""
        at += length + 12
    data, above, rows = zlib.decompress(packed), bytes(3 * width), []
    for row in range(height):
        line = bytearray(data[row * (3 * width + 1) : (row + 1) * (3 * width + 1)])
        kind, line = line[0], line[1:]
        for x in range(3 * width):
            left, up, corner = (line[x - 3], above[x], above[x - 3]) if x >= 3 else (0, above[x], 0)
            base = left + up - corner
            nearest = min((abs(base - left), 0, left), (abs(base - up), 1, up), (abs(base - corner), 2, corner))
            line[x] = (line[x] + [0, left, up, (left + up) // 2, nearest[2]][kind]) % 256
        rows.append(bytes(line))
        above = line
    return width, height, rows


def test_the_ground_is_a_grid_and_a_mosaic(simulated, recording, robot, tmp_path):
    odometry = robot.listen("/odom", ros.Odometry)
    grids = robot.listen("/odograph/grid", ros.OccupancyGrid, LATCHED)
    mosaics = robot.listen("/odograph/mosaic/compressed", ros.CompressedImage, LATCHED)
    places = robot.listen("/odograph/mosaic/georeference", ros.MapMetaData, LATCHED)
    images = robot.writer("/camera/image_raw", ros.Image)
    program = Program(tmp_path, f"live ros2:/camera/image_raw {given(simulated)} --ros2 -o live")
    until(lambda: matched(images), what="the subscription")
    play(recording, lambda number: images.write(recording.image(number)))
    # Whoever comes later has the newest one at once.
    late = Robot(int(os.environ["ROS_DOMAIN_ID"]))
    late_grids = late.listen("/odograph/grid", ros.OccupancyGrid, LATCHED)
    until(lambda: late_grids, what="the grid of before")
    late.close()
    ended(program, recording, odometry)
    # It grows in a few messages, not one for each frame.
    until(lambda: len(places) == len(mosaics), what="the last mosaic")
    assert 2 <= len(grids) <= 8 and 2 <= len(mosaics) <= 5, (len(grids), len(mosaics))
    assert all(a < b for (a, _), (b, _) in zip(grids, grids[1:]))
    odograph(tmp_path, "map export live/map.gpkg -o grid.yaml -q")
    cell_m, corner, rows = grid_file(tmp_path)
    newest = grids[-1][1]
    info = newest.info
    assert newest.header.frame_id == "map" and stamp_ns(newest) == recording.time_ns(len(recording.frames) - 1)
    assert info.resolution == pytest.approx(cell_m)
    assert (info.width, info.height) == (len(rows[0]), len(rows))
    assert (info.origin.position.x, info.origin.position.y) == pytest.approx(corner, abs=1e-6)
    assert info.origin.orientation == ros.Quaternion(0.0, 0.0, 0.0, 1.0)
    # Free is 254 in the file and 0 in the message, unknown 205 and −1.
    cells = [{254: 0, 205: -1}[gray] for row in rows for gray in row]
    # The file is made of the stored mosaic, which has lossy pictures at its edge.
    off = sum(a != b for a, b in zip(cells, newest.data))
    assert off <= 0.01 * len(cells), (off, len(cells))
    assert 0.3 * len(cells) < cells.count(0) < len(cells)
    # The mosaic shows ground where the grid says so.
    picture, place = mosaics[-1][1], places[-1][1]
    assert picture.header.frame_id == "map" and picture.format == "rgb8; png compressed bgr8"
    assert place.map_load_time == picture.header.stamp
    width, height, lines = rgb(bytes(picture.data))
    assert (place.width, place.height) == (width, height)
    seen = [[any(value != 255 for value in line[3 * x : 3 * x + 3]) for x in range(width)] for line in lines]
    agreeing = 0
    for number, cell in enumerate(newest.data):
        x_m = info.origin.position.x + (number % info.width + 0.5) * info.resolution
        y_m = info.origin.position.y + (number // info.width + 0.5) * info.resolution
        column = int((x_m - place.origin.position.x) / place.resolution)
        row = height - 1 - int((y_m - place.origin.position.y) / place.resolution)
        inside = 0 <= column < width and 0 <= row < height
        agreeing += (inside and seen[row][column]) == (cell == 0)
    assert agreeing > 0.95 * len(newest.data), (agreeing, len(newest.data))


def test_the_ground_can_be_left_out(simulated, recording, robot, tmp_path):
    odometry = robot.listen("/odom", ros.Odometry)
    grids = robot.listen("/odograph/grid", ros.OccupancyGrid, LATCHED)
    mosaics = robot.listen("/odograph/mosaic/compressed", ros.CompressedImage, LATCHED)
    images = robot.writer("/camera/image_raw", ros.Image)
    program = Program(
        tmp_path,
        f"live ros2:/camera/image_raw {given(simulated)} --ros2 --ros2-without mosaic,grid -o live",
    )
    until(lambda: matched(images), what="the subscription")
    play(recording, lambda number: images.write(recording.image(number)))
    ended(program, recording, odometry)
    assert not grids and not mosaics
