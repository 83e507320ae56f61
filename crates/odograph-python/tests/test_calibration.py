"""Calibration with rendered views of a chessboard."""

import numpy as np
import odograph as od
import pytest

K = np.array([[420.0, 0.0, 161.5], [0.0, 421.0, 118.0], [0.0, 0.0, 1.0]])
SIZE = (320, 240)
SIDE = 0.03


def rotation(roll, pitch, yaw):
    def about(axis, angle):
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        matrix = np.eye(3)
        matrix[i, i] = matrix[j, j] = np.cos(angle)
        matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
        return matrix

    return about(2, yaw) @ about(1, pitch) @ about(0, roll)


def view(turn, shift):
    """An ideal camera over a board of 9×6 inner corners on white paper: 4×4 samples a pixel."""
    steps = (np.arange(4) - 1.5) / 4
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]]
    total = np.zeros(SIZE[::-1])
    for dy in steps:
        for dx in steps:
            pixels = np.stack([columns + dx, rows + dy, np.ones(total.shape)], axis=-1)
            rays = pixels @ np.linalg.inv(K).T
            depth = (turn[:, 2] @ shift) / (rays @ turn[:, 2])
            x, y, _ = np.moveaxis((rays * depth[..., None] - shift) @ turn, -1, 0) / SIDE
            column, row = np.floor(x + 5).astype(int), np.floor(y + 3.5).astype(int)
            inside = (0 <= column) & (column < 10) & (0 <= row) & (row < 7)
            total += np.where(inside & ((column + row) % 2 == 0), 30.0, 220.0)
    return (total / 16).round().astype(np.uint8)


@pytest.fixture(scope="module")
def views():
    random = np.random.default_rng(5)
    poses = [
        (rotation(*random.uniform(-0.5, 0.5, 2), random.uniform(-0.2, 0.2)), (*random.uniform(-0.04, 0.04, 2), z))
        for z in random.uniform(0.62, 0.8, 16)
    ]
    return [view(turn, np.array(shift)) for turn, shift in poses]


def test_the_camera_of_the_views_is_found(views, tmp_path):
    found = od.calibrate(views, "chessboard:9x6:30mm", model="pinhole")
    assert np.allclose(found.camera.K, K, atol=1.0)
    assert found.rms < 0.1 and found.camera.size == SIZE and found.model == "pinhole"
    assert found.verdict in ("good", "usable", "do it again") and len(found.views) == len(views)
    deviations = np.sqrt(np.diag(found.covariance))
    truth = dict(zip(["fx", "fy", "cx", "cy"], [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]))
    for name, value, deviation in zip(found.parameters, found.values, deviations):
        assert abs(value - truth[name]) < max(5 * deviation, 0.2), name
    found.save(tmp_path / "camera.yaml")
    assert np.allclose(od.Camera.load(tmp_path / "camera.yaml").K, found.camera.K)


@pytest.mark.parametrize(
    ("board", "why"),
    [("chessboard", "chessboard"), ("chessboard:5x4:30mm", "was not found in any of 16 pictures")],
)
def test_a_wrong_board_is_told(views, board, why):
    with pytest.raises(od.Error, match=why):
        od.calibrate(views, board)


def test_too_little_is_told(views):
    with pytest.raises(od.Error, match="one view only"):
        od.calibrate(views[:1], "chessboard:9x6:30mm")
    with pytest.raises(od.Error, match="one camera at one resolution"):
        od.calibrate([views[0], views[1][:, :300]], "chessboard:9x6:30mm")
    with pytest.raises(od.Error, match="no such.mp4"):
        od.calibrate("no such.mp4", "chessboard:9x6:30mm")
    with pytest.raises(od.Error, match="lens model"):
        od.calibrate(views, "chessboard:9x6:30mm", model="fish")
