"""Whole runs, their errors, and what they are turned into."""

import os
import signal
import sys
import threading

import numpy as np
import odograph as od
import pytest


def test_simulated_driven_and_evaluated(drive, folder, followed):
    assert (followed.end, len(followed)) == ("completed", len(drive))
    assert followed.poses.shape == (len(drive), 4, 4) and followed.covariances.shape == (len(drive), 6, 6)
    error = od.evaluate(followed, drive)
    assert error.compared == len(drive) and error.time_covered == 1.0
    assert error.translation["rmse"] < 1e-3 and error.rotation["rmse"] < 1e-3
    # The same by files, by arrays, and by hand.
    for estimate in (followed.folder / "trajectory.tum", (followed.timestamps, followed.poses)):
        again = od.evaluate(estimate, folder / "truth.tum")
        assert again.translation["rmse"] == pytest.approx(error.translation["rmse"], abs=1e-6)
        assert again.rotation["rmse"] == pytest.approx(error.rotation["rmse"], abs=1e-6)
    unaligned = od.evaluate(followed, drive, align="none")
    distances = np.linalg.norm(followed.poses[:, :3, 3] - drive.poses[:, :3, 3], axis=1)
    assert np.allclose(unaligned.errors[:, 1], distances, atol=1e-12)
    assert unaligned.translation["max"] == pytest.approx(distances.max())


def test_a_worse_path_has_a_larger_error(drive, followed):
    poses = followed.poses.copy()
    poses[:, :3, 3] *= 1.01
    error = od.evaluate((followed.timestamps, poses), drive, align="origin", deltas=[0.5], segments=[1.0])
    assert error.scale == pytest.approx(1 / 1.01, rel=1e-3)
    assert error.translation["rmse"] > 5 * od.evaluate(followed, drive, align="origin").translation["rmse"]
    assert [entry["delta"] for entry in error.relative] == ["1 frame", "0.5 m"]
    assert error.drift[0]["length_m"] == 1.0 and error.drift[0]["translation_percent"] > 0.3


def test_a_folder_has_the_results(followed):
    assert (followed.folder / "trajectory.csv").exists() and (followed.folder / "map.gpkg").exists()
    assert followed.statistics["frames_with_pose"] == len(followed)


def test_without_a_folder_nothing_stays(recording):
    run = od.run(**recording, max_frames=10)
    assert run.folder is None and len(run) == 10


def test_results_that_are_there_stay(recording, followed):
    with pytest.raises(od.Error, match="already there") as raised:
        od.run(**recording, output=followed.folder)
    assert raised.value.kind == "usage"


def test_a_run_is_repeated_by_its_run_toml(followed, tmp_path):
    again = od.run(followed.folder / "run.toml", output=tmp_path / "again", threads=1)
    assert np.array_equal(again.poses, followed.poses)
    with pytest.raises(od.Error, match="leave height away"):
        od.run(followed.folder / "run.toml", height=0.5)


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ({"source": "no such.mp4"}, "no such.mp4"),
        ({"camera": "no such.yaml"}, "no such.yaml cannot be read"),
        ({"rig": None}, "height of the camera above the ground is missing"),
        ({"camera": None}, "no camera is given"),
        ({"field_of_view": (1.0, 0.75)}, "both given"),
        ({"start": 1e6}, "no frame"),
        ({"timestamps": None, "fps": -3.0}, "frames a second must be"),
        ({"motion": "fast"}, "no motion model"),
    ],
)
def test_bad_input_is_one_sentence(recording, arguments, why, tmp_path):
    with pytest.raises(od.Error, match=why) as raised:
        od.run(**{**recording, **arguments}, output=tmp_path / "out")
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").iterdir())


def test_images_of_another_camera_are_refused(recording):
    camera = od.Camera.from_field_of_view((640, 480), (0.6, 0.45), 0.5)
    with pytest.raises(od.Error, match="the camera is calibrated for 640x480"):
        od.run(**{**recording, "camera": camera})


@pytest.mark.skipif(sys.platform == "win32", reason="signals are sent as Unix has them")
def test_ctrl_c_ends_a_run(tmp_path):
    drive = od.simulate("walk", length=2.0, size=(320, 240), height=0.5, fps=60.0)
    drive.save(tmp_path)
    arguments = {"camera": drive.camera, "rig": drive.rig, "output": tmp_path / "out"}
    # A shell starts programs in the background with this signal ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    running = threading.Timer(0.0, os.kill, (os.getpid(), signal.SIGINT))
    try:
        with pytest.raises(KeyboardInterrupt):
            running.start()
            od.run(tmp_path / "frames", fps=60.0, **arguments)
    finally:
        running.join()
        signal.signal(signal.SIGINT, before)


def test_a_table_has_every_frame(followed):
    pandas = pytest.importorskip("pandas")
    table = followed.to_pandas()
    assert isinstance(table, pandas.DataFrame) and table.index.name == "time_s"
    assert np.array_equal(table.index, followed.timestamps) and np.array_equal(table.x_m, followed.x)
    assert np.array_equal(table.sd_x_m, np.sqrt(followed.covariances[:, 0, 0]))
    assert set(table.status) == {"tracked"}


def test_evo_has_the_same_poses(followed):
    pytest.importorskip("evo")
    path = followed.to_evo()
    assert np.array_equal(path.timestamps, followed.timestamps)
    assert np.allclose(path.positions_xyz, followed.poses[:, :3, 3])


@pytest.mark.parametrize(("method", "package"), [("to_pandas", "pandas"), ("to_evo", "evo")])
def test_a_missing_package_is_named(followed, method, package, monkeypatch):
    for name in [name for name in sys.modules if name == package or name.startswith(package + ".")]:
        monkeypatch.delitem(sys.modules, name)
    # None in sys.modules is what the import system takes for a module that is not there.
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(od.Error, match=f"{method} needs the package {package}.*pip install {package}"):
        getattr(followed, method)()


@pytest.mark.parametrize(
    ("estimate", "why"),
    [
        ("no such.tum", "no such.tum cannot be read"),
        (([0.0, 1.0], np.zeros((3, 4, 4))), "N and N×4×4"),
        (([0.0], [[1.0]]), "N and N×4×4"),
        (([1e9], [np.eye(4)]), "time"),
        (([0.0, 0.0], [np.eye(4)] * 2), "do not increase"),
        (([0.0], [np.full((4, 4), np.nan)]), "pose 0 of the estimate is no rigid transform"),
        (([0.0, 1.0], [np.eye(4), 2 * np.eye(4)]), "pose 1 of the estimate is no rigid transform"),
        (([float("nan")], [np.eye(4)]), "finite"),
    ],
)
def test_what_cannot_be_compared_is_refused(drive, estimate, why):
    with pytest.raises(od.Error, match=why):
        od.evaluate(estimate, drive)
