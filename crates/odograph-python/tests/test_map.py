"""Maps."""

import numpy as np
import odograph as od
import pytest


@pytest.fixture(scope="module")
def ground(followed):
    return od.Map(followed.folder / "map.gpkg")


def test_an_image_is_found_where_it_was_taken(ground, drive, followed):
    before = (followed.folder / "map.gpkg").read_bytes()
    at = len(drive) // 3
    place = ground.localize(drive[at])
    assert place.found and place.verdict == "found" and place.message is None
    assert np.hypot(place.x - followed.x[at], place.y - followed.y[at]) < 1e-3
    turned = place.heading - followed.heading[at]
    assert abs(np.arctan2(np.sin(turned), np.cos(turned))) < 1e-3
    assert all(0 < sd < 0.01 for sd in place.sd)
    assert (followed.folder / "map.gpkg").read_bytes() == before


def test_a_file_is_found_as_its_image_is(ground, drive, folder):
    at = len(drive) // 3
    by_file, by_image = ground.localize(folder / f"frames/{at:06}.png"), ground.localize(drive[at])
    assert (by_file.x, by_file.y, by_file.heading) == (by_image.x, by_image.y, by_image.heading)


def test_foreign_ground_is_not_found(ground, drive):
    other = od.simulate("still", camera=drive.camera, rig=drive.rig, texture="carpet", duration=0.1)
    place = ground.localize(other[0])
    assert not place.found and place.x is None and place.sd is None
    assert place.verdict != "found" and "the image" in place.message


def test_an_image_of_another_camera_is_refused(ground):
    with pytest.raises(od.Error, match="the frames of the image are 64x48"):
        ground.localize(np.zeros((48, 64), np.uint8))
    with pytest.raises(od.Error, match="uint8"):
        ground.localize(np.zeros((240, 320)))


def test_the_mosaic_lies_where_the_camera_looked(ground, drive, followed):
    picture, (left, side, skew, top, skew_too, down) = ground.mosaic()
    height, width, channels = picture.shape
    assert picture.dtype == np.uint8 and channels == 4 and side > 0
    assert (skew, skew_too, down) == (0.0, 0.0, -side)
    columns = ((followed.x - left) / side).astype(int)
    rows = ((followed.y - top) / down).astype(int)
    assert np.all((0 <= columns) & (columns < width) & (0 <= rows) & (rows < height))
    assert np.all(picture[rows, columns, 3] == 255)
    # The ground below the camera at the start is in the middle of the first image.
    first, (cx, cy) = drive[0].astype(float), (drive.camera.K[0, 2], drive.camera.K[1, 2])
    seen = first[int(cy) - 20 : int(cy) + 21, int(cx) - 20 : int(cx) + 21].mean()
    reach = int(20 * drive.rig.height / drive.camera.K[0, 0] / side)
    at = (slice(rows[0] - reach, rows[0] + reach + 1), slice(columns[0] - reach, columns[0] + reach + 1))
    assert abs(picture[at][..., :3].mean() - seen) < 8
    coarse, (_, coarse_side, *_) = ground.mosaic(max_pixels=height * width // 4)
    assert coarse.shape[0] < height and coarse_side == pytest.approx(2 * side)


def test_a_map_has_its_camera(ground, drive):
    assert ground.camera.size == drive.camera.size and np.allclose(ground.camera.K, drive.camera.K)
    assert ground.rig.height == drive.rig.height and len(ground.sessions) == 1


def test_what_is_no_map_is_refused(tmp_path):
    with pytest.raises(od.Error, match="no such.gpkg"):
        od.Map("no such.gpkg")
    (tmp_path / "map.gpkg").write_bytes(b"no database")
    with pytest.raises(od.Error, match="map.gpkg"):
        od.Map(tmp_path / "map.gpkg")
