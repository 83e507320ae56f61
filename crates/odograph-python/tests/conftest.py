"""A short rendered drive that the tests share."""

import odograph as od
import pytest


@pytest.fixture(scope="session")
def drive():
    return od.simulate("square-turns", length=0.4, size=(320, 240), height=0.5, seed=3)


@pytest.fixture(scope="session")
def folder(drive, tmp_path_factory):
    """The drive as files."""
    folder = tmp_path_factory.mktemp("drive")
    drive.save(folder)
    return folder


@pytest.fixture(scope="session")
def recording(folder):
    """What od.run needs to follow the drive."""
    return {
        "source": folder / "frames",
        "timestamps": folder / "frames.txt",
        "camera": folder / "camera.yaml",
        "rig": folder / "rig.toml",
    }


@pytest.fixture(scope="session")
def followed(recording, tmp_path_factory):
    """A run over the drive, with its folder."""
    return od.run(**recording, output=tmp_path_factory.mktemp("run") / "results")
