"""Frame by frame."""

import sys
import threading

import numpy as np
import odograph as od
import pytest


def follow(drive, images, times=None, camera=None):
    odometry = od.Odometry(camera or drive.camera, rig=drive.rig)
    times = drive.timestamps if times is None else times
    return [odometry.process(image, t) for image, t in zip(images, times)]


def test_frame_by_frame_has_the_poses_of_a_run(drive, recording):
    # A run that finds a global shutter knows it from the first frame on.
    camera = od.Camera(K=drive.camera.K, dist=drive.camera.dist, size=drive.camera.size, readout=0.0)
    run = od.run(**recording, loops=False, readout=0.0)
    # frames.txt has nine decimals of a time.
    assert np.allclose(run.timestamps, drive.timestamps, rtol=0, atol=1e-9)
    frames = follow(drive, drive, run.timestamps, camera)
    assert all(frame.tracked for frame in frames)
    assert np.array_equal(run.poses, np.stack([frame.pose for frame in frames]))
    assert np.array_equal(run.covariances, np.stack([frame.covariance for frame in frames]))
    assert np.array_equal(run.x, [frame.x for frame in frames])


def test_with_a_lever_arm_the_poses_are_of_the_robot(drive, recording):
    place = (0.3, 0.05, 0.2)
    rig = od.Rig(height=drive.rig.height, lever_arm=place)
    camera = od.Camera(K=drive.camera.K, dist=drive.camera.dist, size=drive.camera.size, readout=0.0)
    of_camera = od.run(**{**recording, "rig": od.Rig(height=drive.rig.height)}, loops=False, readout=0.0)
    run = od.run(**{**recording, "rig": rig}, loops=False, readout=0.0)
    # The robot is level, and the camera looks down from its place on it.
    assert np.allclose(run.poses[:, 2, 2], 1.0, atol=1e-2)
    places = np.einsum("nij,j->ni", run.poses, np.append(place, 1.0))[:, :3]
    assert np.allclose(places, of_camera.poses[:, :3, 3], atol=1e-9)
    odometry = od.Odometry(camera, rig=rig)
    poses = [odometry.process(image, t).pose for image, t in zip(drive, run.timestamps)]
    assert np.allclose(poses, run.poses, rtol=0, atol=1e-9)


def test_a_view_is_the_image_that_it_shows(drive):
    part = [drive[at] for at in range(20)]
    plain = [frame.pose for frame in follow(drive, part)]
    views = {
        "every second column": lambda image: np.repeat(image, 2, axis=1)[:, ::2],
        "rows of a wider image": lambda image: np.hstack([image, image])[:, :320],
        "upside down, twice": lambda image: image[::-1].copy()[::-1],
        "Fortran's order": np.asfortranarray,
        "three equal channels": lambda image: np.stack([image] * 3, axis=2),
        "planes of colour": lambda image: np.stack([image] * 3).transpose(1, 2, 0),
    }
    for name, view in views.items():
        poses = [frame.pose for frame in follow(drive, [view(image) for image in part])]
        assert np.array_equal(plain, poses), name


def test_bgr_reversed_is_rgb():
    drive = od.simulate("straight", length=0.1, size=(160, 120), height=0.5, color=True)
    rgb = [drive[at] for at in range(len(drive))]
    bgr = [image[..., ::-1].copy() for image in rgb]
    poses = [[f.pose for f in follow(drive, images)] for images in (rgb, [i[..., ::-1] for i in bgr])]
    assert rgb[0].shape == (120, 160, 3) and not np.array_equal(rgb[0], bgr[0])
    assert np.array_equal(*poses)


def test_a_frame_says_what_it_knows(drive):
    frames = follow(drive, [drive[at] for at in range(30)])
    last = frames[-1]
    assert (last.frame, last.status, last.segment) == (29, "tracked", 0)
    assert last.time == drive.timestamps[29]
    assert last.pose.shape == (4, 4) and np.allclose(last.pose[:3, :3] @ last.pose[:3, :3].T, np.eye(3))
    assert np.allclose(last.pose[:3, 3], [last.x, last.y, last.height])
    assert last.covariance.shape == (6, 6) and np.all(np.diag(last.covariance) >= 0)
    assert last.tracks.shape[1] == 4 and len(last.tracks) == len(last.inliers) > 50
    truth = drive.poses[29]
    assert np.linalg.norm(last.pose[:3, 3] - truth[:3, 3]) < 1e-3
    dark = od.Odometry(drive.camera, rig=drive.rig).process(np.zeros((240, 320), np.uint8), 0.0)
    assert dark.status.startswith("lost:") and not dark.tracked
    assert dark.pose is None and dark.x is None and dark.covariance is None


def test_other_threads_run_while_a_frame_is_processed(drive):
    images = [drive[at] for at in range(len(drive))]
    odometry = od.Odometry(drive.camera, rig=drive.rig)
    ran, gate = [], threading.Lock()
    gate.acquire()

    def other():
        with gate:
            ran.append(True)

    thread = threading.Thread(target=other)
    thread.start()
    before = sys.getswitchinterval()
    # From here on the interpreter changes threads only where one lets go of it.
    sys.setswitchinterval(1000.0)
    try:
        gate.release()
        for image, t in zip(images, drive.timestamps):
            odometry.process(image, t)
            if ran:
                break
        assert ran
    finally:
        sys.setswitchinterval(before)
        thread.join()


def test_a_mask_is_not_ground(drive):
    mask = np.full((240, 320), 255, np.uint8)
    mask[:120] = 0
    odometry = od.Odometry(drive.camera, rig=drive.rig, mask=mask)
    frames = [odometry.process(drive[at], drive.timestamps[at]) for at in range(5)]
    assert frames[-1].tracked and frames[-1].tracks[:, 3].min() >= 115


@pytest.mark.parametrize(
    ("image", "why"),
    [
        (np.zeros((240, 320)), "this one is of float64"),
        (np.zeros((240, 320, 4), np.uint8), "this one is 240×320×4"),
        (np.zeros(320, np.uint8), "this one is 320"),
        (np.zeros((240, 0), np.uint8), "320x240"),
        (np.zeros((120, 160), np.uint8), "320x240"),
        ([[1, 2], [3, 4]], "this is a list"),
        ("drive.png", "this is a str"),
    ],
)
def test_what_is_no_image_is_refused(drive, image, why):
    odometry = od.Odometry(drive.camera, rig=drive.rig)
    with pytest.raises(od.Error, match=why) as raised:
        odometry.process(image, 0.0)
    assert raised.value.kind in ("usage", "input") and "\n" not in str(raised.value)
    assert odometry.process(drive[0], 0.0).tracked


def test_a_time_that_is_none_is_refused(drive):
    odometry = od.Odometry(drive.camera, rig=drive.rig)
    with pytest.raises(od.Error, match="time"):
        odometry.process(drive[0], float("nan"))


def test_a_mount_is_needed_once(drive):
    with pytest.raises(od.Error, match="height of the camera"):
        od.Odometry(drive.camera)
    with pytest.raises(od.Error, match="both given"):
        od.Odometry(drive.camera, 0.5, rig=drive.rig)
    with pytest.raises(od.Error, match="height"):
        od.Odometry(drive.camera, -1.0)
    with pytest.raises(od.Error, match="no motion model"):
        od.Odometry(drive.camera, 0.5, motion="fast")
    with pytest.warns(UserWarning, match="are centimetres meant"):
        od.Odometry(drive.camera, 90)
