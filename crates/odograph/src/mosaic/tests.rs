use super::*;
use crate::camera::Distortion;
use crate::geometry::GroundPoint;

/// The brightness of an analytic ground: waves in three directions, none shorter than 4 cm.
fn texture(point: GroundPoint) -> f64 {
    let wave = |along_x: f64, along_y: f64| (along_x * point.x_m + along_y * point.y_m).sin();
    128.0 + 34.0 * wave(95.0, 60.0) + 30.0 * wave(-50.0, 110.0) + 25.0 * wave(37.0, 11.0)
}

fn camera() -> Camera {
    let distortion = Distortion::from_opencv(&[-0.28, 0.07, 0.0002, -0.0003]).unwrap();
    Camera::new((320, 240), (260.0, 262.0), (158.0, 121.0), distortion).unwrap()
}

fn rays(camera: &Camera) -> Vec<crate::geometry::Ray> {
    let pixel = |k: usize| Pixel::new((k % camera.width()) as f64, (k / camera.width()) as f64);
    (0..camera.width() * camera.height()).map(|k| camera.ray_from_pixel(pixel(k)).unwrap()).collect()
}

fn rendered(camera: &Camera, rays: &[crate::geometry::Ray], pose: &GroundPose, gain: f64) -> GrayImage {
    let sample = |ray: &crate::geometry::Ray| {
        pose.ground_from_ray(*ray).map_or(0, |point| (gain * texture(point)).round().clamp(0.0, 255.0) as u8)
    };
    GrayImage::from_samples(camera.width(), camera.height(), rays.iter().map(sample).collect()).unwrap()
}

/// A drive along a bow, the camera slightly tilted and turning.
fn drive() -> Vec<GroundPose> {
    (0..60)
        .map(|k| 0.02 * f64::from(k))
        .map(|s| GroundPose {
            x_m: s,
            y_m: 0.3 * s * s,
            heading_rad: 0.8 * s,
            height_m: 0.5,
            roll_rad: 0.03,
            pitch_rad: -0.05 + 0.03 * s,
        })
        .collect()
}

/// Differences to the texture over the picture, in gray levels and as a shift in ground pixels
/// along the gradient.
fn errors(picture: &MosaicPicture) -> (Vec<f64>, Vec<f64>) {
    let (mut levels, mut shifts) = (vec![], vec![]);
    let side = picture.placement.metres_per_pixel;
    for (k, pixel) in picture.rgba.chunks_exact(4).enumerate().filter(|(_, p)| p[3] == 255) {
        let (column, row) = ((k % picture.width) as f64, (k / picture.width) as f64);
        let ground = picture.placement.ground_from_pixel(column, row);
        let at = |dx: f64, dy: f64| texture(GroundPoint::new(ground.x_m + dx * side, ground.y_m + dy * side));
        let slope = (0.5 * (at(1.0, 0.0) - at(-1.0, 0.0))).hypot(0.5 * (at(0.0, 1.0) - at(0.0, -1.0)));
        let difference = (f64::from(pixel[0]) - at(0.0, 0.0)).abs();
        levels.push(difference);
        if slope > 3.0 {
            shifts.push(difference / slope);
        }
    }
    levels.sort_by(f64::total_cmp);
    shifts.sort_by(f64::total_cmp);
    (levels, shifts)
}

#[test]
fn frames_under_known_poses_become_the_ground_they_saw() {
    let (camera, mut mosaic) = (camera(), Mosaic::new(MosaicOptions::default()));
    let rays = rays(&camera);
    let mut covered = 0;
    for pose in drive() {
        if mosaic.wants(&camera, &pose) {
            covered += 1;
            assert!(mosaic.add(&rendered(&camera, &rays, &pose, 1.0), &camera, &pose));
        }
    }
    assert!((5..40).contains(&covered), "{covered} of 60 frames covered");
    let picture = mosaic.picture().unwrap();
    let (levels, shifts) = errors(&picture);
    let quantile = |sorted: &[f64], share: f64| sorted[((sorted.len() - 1) as f64 * share) as usize];
    // Half a level is the rounding of the frames themselves; the rest is bilinear sampling of waves
    // of 20 pixels.
    assert!(quantile(&levels, 0.5) < 1.5, "median {}", quantile(&levels, 0.5));
    assert!(quantile(&levels, 0.99) < 5.0, "99 % {}", quantile(&levels, 0.99));
    assert!(quantile(&shifts, 0.5) < 0.1, "median shift {} px", quantile(&shifts, 0.5));
    assert!(quantile(&shifts, 0.99) < 0.5, "99 % shift {} px", quantile(&shifts, 0.99));
}

#[test]
fn all_ground_that_was_seen_is_covered_without_holes() {
    let (camera, mut mosaic) = (camera(), Mosaic::new(MosaicOptions::default()));
    let rays = rays(&camera);
    for pose in drive() {
        if mosaic.wants(&camera, &pose) {
            mosaic.add(&rendered(&camera, &rays, &pose, 1.0), &camera, &pose);
        }
    }
    let picture = mosaic.picture().unwrap();
    for pose in drive() {
        let (column, row) = picture.placement.pixel_from_ground(GroundPoint::new(pose.x_m, pose.y_m));
        let at = 4 * (row.round() as usize * picture.width + column.round() as usize);
        assert_eq!(picture.rgba[at + 3], 255, "{pose:?}");
    }
    assert!(!mosaic.wants(&camera, &drive()[30]), "ground seen already");
}

#[test]
fn changing_light_leaves_no_step() {
    let camera = camera();
    let rays = rays(&camera);
    let mut mosaic = Mosaic::new(MosaicOptions::default());
    for (k, pose) in drive().iter().enumerate().step_by(6) {
        let gain = if k % 12 == 0 { 1.0 } else { 0.8 };
        mosaic.add(&rendered(&camera, &rays, pose, gain), &camera, pose);
    }
    let (levels, _) = errors(&mosaic.picture().unwrap());
    // Without compensation the mean step between the frames would be 20 % of 128, 25 levels.
    assert!(levels[levels.len() / 2] < 3.0, "{}", levels[levels.len() / 2]);
}

#[test]
fn colours_stay_what_they_are() {
    let camera = camera();
    let mut image = RgbImage::new(320, 240);
    image.samples_mut().chunks_exact_mut(3).for_each(|p| p.copy_from_slice(&[200, 100, 50]));
    let mut mosaic = Mosaic::new(MosaicOptions::default());
    for pose in drive() {
        mosaic.add(&image, &camera, &pose);
    }
    let picture = mosaic.picture().unwrap();
    assert!(picture.rgba.chunks_exact(4).all(|p| p[3] == 0 || p == [200, 100, 50, 255]));
}

#[test]
fn motion_a_million_metres_apart_stays_within_its_memory() {
    let camera = camera();
    let image = GrayImage::from_samples(320, 240, vec![128; 320 * 240]).unwrap();
    let options = MosaicOptions { max_pixels: 2_000_000, ..MosaicOptions::default() };
    let mut mosaic = Mosaic::new(options);
    for k in 0..40 {
        let far = 1e6 * f64::from(k);
        let pose = GroundPose { x_m: far, y_m: -far * f64::from(k % 3), ..GroundPose::level(0.5) };
        mosaic.add(&image, &camera, &pose);
        assert!(mosaic.tiles.count() * 65_536 <= 2_000_000 + 65_536, "{} tiles", mosaic.tiles.count());
    }
    let picture = mosaic.picture().unwrap();
    assert!(picture.width * picture.height <= 2_000_000);
}

#[test]
fn a_growing_mosaic_is_halved_and_stays_in_its_place() {
    let camera = camera();
    let rays = rays(&camera);
    let options = MosaicOptions { max_pixels: 6 * 65_536, ..MosaicOptions::default() };
    let mut mosaic = Mosaic::new(options);
    let pose = |k: u32| GroundPose { x_m: 0.1 * f64::from(k), ..GroundPose::level(0.5) };
    for k in 0..40 {
        mosaic.add(&rendered(&camera, &rays, &pose(k), 1.0), &camera, &pose(k));
    }
    let picture = mosaic.picture().unwrap();
    assert!(picture.placement.metres_per_pixel > 0.003, "{}", picture.placement.metres_per_pixel);
    let (_, shifts) = errors(&picture);
    assert!(shifts[shifts.len() / 2] < 0.25, "{} px", shifts[shifts.len() / 2]);
    let small = mosaic.picture_within(200).unwrap();
    assert!(small.width <= 200 && small.height <= 200);
}

#[test]
fn invalid_poses_are_refused() {
    let camera = camera();
    let image = GrayImage::new(320, 240);
    let mut mosaic = Mosaic::new(MosaicOptions::default());
    let level = GroundPose::level(0.5);
    assert!(mosaic.picture().is_none());
    for pose in [
        GroundPose { x_m: f64::NAN, ..level },
        GroundPose { x_m: f64::INFINITY, ..level },
        GroundPose { height_m: -1.0, ..level },
        GroundPose { pitch_rad: 1.57, ..level },
        GroundPose { x_m: 1e300, ..level },
        GroundPose { height_m: 1e-300, x_m: 1.0, ..level },
    ] {
        assert!(!mosaic.add(&image, &camera, &pose), "{pose:?}");
    }
    assert!(!mosaic.add(&GrayImage::new(10, 10), &camera, &level), "another camera's size");
    assert!(mosaic.add(&image, &camera, &level));
}

#[test]
fn a_refused_frame_leaves_the_ground_as_it_was() {
    let camera = camera();
    let image = GrayImage::from_samples(320, 240, vec![90; 320 * 240]).unwrap();
    let mut mosaic = Mosaic::new(MosaicOptions::default());
    mosaic.add(&image, &camera, &GroundPose::level(0.5));
    let before = mosaic.picture();
    assert!(!mosaic.add(&image, &camera, &GroundPose { x_m: 1e30, ..GroundPose::level(50.0) }));
    assert_eq!(mosaic.picture(), before);
}

#[test]
fn a_climbing_camera_makes_the_mosaic_coarser() {
    let camera = camera();
    let image = GrayImage::new(320, 240);
    let mut mosaic = Mosaic::new(MosaicOptions::default());
    mosaic.add(&image, &camera, &GroundPose::level(0.5));
    let fine = mosaic.resolution_m().unwrap();
    assert!(mosaic.add(&image, &camera, &GroundPose::level(50.0)));
    assert!(mosaic.resolution_m().unwrap() > 40.0 * fine);
}

#[test]
fn changed_tiles_put_together_are_the_picture() {
    let camera = camera();
    let rays = rays(&camera);
    let options = MosaicOptions { max_pixels: 6 * 65_536, ..MosaicOptions::default() };
    let mut mosaic = Mosaic::new(options);
    // A viewer that takes only what changed, as a page does while the ground grows; once it
    // outgrows its bound all of it changes.
    let (mut seen, mut resolution_m) = (0, None);
    let mut held = std::collections::BTreeMap::new();
    let mut coarser = 0;
    for k in 0..30 {
        let pose = GroundPose { x_m: 0.1 * f64::from(k), ..GroundPose::level(0.5) };
        mosaic.add(&rendered(&camera, &rays, &pose, 1.0), &camera, &pose);
        if mosaic.resolution_m() != resolution_m {
            held.clear();
            coarser += 1;
            (seen, resolution_m) = (0, mosaic.resolution_m());
        }
        for tile in mosaic.changed_since(seen) {
            held.insert(tile, mosaic.tile_rgba(tile).unwrap());
        }
        seen = mosaic.revision();
    }
    assert!(coarser > 1 && mosaic.changed_since(seen).next().is_none());
    let picture = mosaic.picture().unwrap();
    let side = Mosaic::TILE_SIDE_PX as i64;
    let resolution_m = picture.placement.metres_per_pixel;
    let left = (picture.placement.x_m / resolution_m - 0.5).round() as i64;
    let top = (-picture.placement.y_m / resolution_m - 0.5).round() as i64;
    let mut opaque = 0;
    for (k, pixel) in picture.rgba.chunks_exact(4).enumerate().filter(|(_, pixel)| pixel[3] > 0) {
        let (x, y) = (left + (k % picture.width) as i64, top + (k / picture.width) as i64);
        let tile = MosaicSquare { column: x.div_euclid(side), row: y.div_euclid(side) };
        let at = 4 * (y.rem_euclid(side) * side + x.rem_euclid(side)) as usize;
        assert_eq!(&held[&tile][at..at + 4], pixel, "{x} {y}");
        opaque += 1;
    }
    assert_eq!(opaque, held.values().flat_map(|rgba| rgba.chunks_exact(4)).filter(|p| p[3] > 0).count());
}

#[test]
fn what_a_mask_covers_is_no_ground() {
    let camera = camera();
    let rays = rays(&camera);
    let mut picture = GrayImage::new(camera.width(), camera.height());
    let (width, height) = (camera.width(), camera.height());
    picture.samples_mut()[..width * height / 2].fill(255);
    let mask = Arc::new(ImageMask::from_picture(&picture));
    // A bumper in the lower half: white, which the waves of the ground never are.
    let with_bumper = |pose: &GroundPose| {
        let mut image = rendered(&camera, &rays, pose, 1.0);
        image.samples_mut()[width * height / 2..].fill(255);
        image
    };
    let poses = [GroundPose::level(0.5), GroundPose { x_m: 0.2, ..GroundPose::level(0.5) }];
    // The same view again has nothing new, although the bumper's half was never seen.
    let mut once = Mosaic::new(MosaicOptions::default());
    once.set_mask(Some(mask.clone()));
    assert!(once.add(&with_bumper(&poses[0]), &camera, &poses[0]) && !once.wants(&camera, &poses[0]));
    let rendered_with = |mask: Option<Arc<ImageMask>>| {
        let mut mosaic = Mosaic::new(MosaicOptions::default());
        mosaic.set_mask(mask);
        poses.iter().for_each(|pose| assert!(mosaic.add(&with_bumper(pose), &camera, pose)));
        mosaic.picture().unwrap()
    };
    let seen = |picture: &MosaicPicture| picture.rgba.chunks(4).filter(|pixel| pixel[3] > 0).count();
    let white = |picture: &MosaicPicture| {
        picture.rgba.chunks(4).filter(|pixel| pixel[3] > 0 && pixel[0] > 240).count()
    };
    let (with, without) = (rendered_with(Some(mask)), rendered_with(None));
    assert!(white(&without) > seen(&without) / 4);
    assert_eq!(white(&with), 0);
    assert!(seen(&with) > seen(&without) / 3);
}
