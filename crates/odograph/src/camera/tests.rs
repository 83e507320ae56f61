use super::*;
use crate::geometry::GroundPose;
use proptest::prelude::*;

fn cameras() -> Vec<Camera> {
    let size = (640, 480);
    let make = |distortion| Camera::new(size, (500.0, 505.0), (320.5, 238.0), distortion).unwrap();
    vec![
        make(Distortion::None),
        make(Distortion::from_opencv(&[-0.28, 0.07, 0.0002, -0.0003]).unwrap()),
        make(Distortion::from_opencv(&[-0.3, 0.15, -0.0008, 0.0003, -0.066]).unwrap()),
        make(Distortion::from_opencv(&[0.4, 0.1, 0.0, 0.0, 0.01, 0.7, 0.2, 0.02]).unwrap()),
        Camera::new(
            size,
            (300.0, 301.0),
            (320.0, 240.0),
            Distortion::KannalaBrandt { k1: -0.01, k2: 0.003, k3: -0.002, k4: 0.0003 },
        )
        .unwrap(),
        make(Distortion::DoubleSphere { xi: 0.0, alpha: 0.0 }),
        Camera::new(
            size,
            (240.0, 241.0),
            (320.0, 240.0),
            Distortion::DoubleSphere { xi: -0.18, alpha: 0.59 },
        )
        .unwrap(),
    ]
}

proptest! {
    #[test]
    fn every_pixel_comes_back_from_its_ray(x in 0.0..640.0, y in 0.0..480.0) {
        for camera in cameras() {
            let pixel = Pixel::new(x, y);
            let Some(ray) = camera.ray_from_pixel(pixel) else {
                return Err(TestCaseError::fail(format!("no ray for {pixel:?} in {camera:?}")));
            };
            let back = camera.pixel_from_ray(ray).unwrap();
            prop_assert!(pixel.distance(back) < 1e-6, "{camera:?} {pixel:?} {back:?}");
        }
    }

    #[test]
    fn the_derivative_is_that_of_the_projection(x in -0.5..0.5, y in -0.4..0.4) {
        for camera in cameras() {
            let (_, derivative) = camera.pixel_and_derivative(Ray::new(x, y)).unwrap();
            let step = 1e-6;
            for (column, (dx, dy)) in [(step, 0.0), (0.0, step)].into_iter().enumerate() {
                let ahead = camera.pixel_from_ray(Ray::new(x + dx, y + dy)).unwrap();
                let behind = camera.pixel_from_ray(Ray::new(x - dx, y - dy)).unwrap();
                let numeric = ((ahead.x - behind.x) / (2.0 * step), (ahead.y - behind.y) / (2.0 * step));
                prop_assert!((numeric.0 - derivative[(0, column)]).abs() < 1e-3);
                prop_assert!((numeric.1 - derivative[(1, column)]).abs() < 1e-3);
            }
        }
    }
}

#[test]
fn projection_agrees_with_opencv() {
    // The values of cv2.projectPoints((0.3, -0.2, 1), …) with the same parameters.
    let camera = Camera::new(
        (640, 480),
        (532.83, 532.95),
        (342.49, 233.86),
        Distortion::from_opencv(&[-0.28088, 0.02518, 0.00122, -0.00014, 0.16343]).unwrap(),
    )
    .unwrap();
    let pixel = camera.pixel_from_ray(Ray::new(0.3, -0.2)).unwrap();
    let r2: f64 = 0.13;
    let d = 1.0 - 0.28088 * r2 + 0.02518 * r2 * r2 + 0.16343 * r2 * r2 * r2;
    let x = 0.3 * d + 2.0 * 0.00122 * 0.3 * -0.2 - 0.00014 * (r2 + 2.0 * 0.09);
    let y = -0.2 * d + 0.00122 * (r2 + 2.0 * 0.04) - 2.0 * 0.00014 * 0.3 * -0.2;
    assert!((pixel.x - (532.83 * x + 342.49)).abs() < 1e-9);
    assert!((pixel.y - (532.95 * y + 233.86)).abs() < 1e-9);
}

#[test]
fn rays_beyond_the_monotonic_range_have_no_pixel() {
    let camera = Camera::new(
        (640, 480),
        (500.0, 500.0),
        (320.0, 240.0),
        Distortion::from_opencv(&[-0.3, 0.0, 0.0, 0.0]).unwrap(),
    )
    .unwrap();
    // d/dr (r − 0.3 r³) = 1 − 0.9 r² = 0 at r = 1.054.
    assert!(camera.pixel_from_ray(Ray::new(1.0, 0.0)).is_some());
    assert!(camera.pixel_from_ray(Ray::new(1.2, 0.0)).is_none());
}

#[test]
fn invalid_cameras_and_rigs_are_rejected() {
    let bad = Camera::new((640, 480), (f64::NAN, 500.0), (320.0, 240.0), Distortion::None).unwrap_err();
    assert!(bad.to_string().contains("fx is NaN"));
    assert!(Rig::level(-1.0).validated().is_err());
    assert!(Rig { pitch_rad: 2.0, ..Rig::level(1.0) }.validated().is_err());
}

#[test]
fn field_of_view_spans_outer_pixel_edges() {
    let camera = Camera::from_field_of_view((640, 480), (1.2, 0.9), 1.0).unwrap();
    let pose = GroundPose::level(1.0);
    let left = pose.ground_from_ray(camera.ray_from_pixel(Pixel::new(-0.5, 239.5)).unwrap()).unwrap();
    let right = pose.ground_from_ray(camera.ray_from_pixel(Pixel::new(639.5, 239.5)).unwrap()).unwrap();
    assert!((left.y_m - right.y_m - 1.2).abs() < 1e-12);
}
