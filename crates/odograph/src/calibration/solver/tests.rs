use super::bundle::{Bundle, Sight, State, Unknowns, moved_pose, residuals};
use super::lens::{Lens, free_numbers};
use super::*;
use crate::calibration::SeenPoint;
use crate::camera::{Camera, Distortion};
use crate::geometry::{Pixel, Ray};
use crate::motion::Random;
use nalgebra::{DVector, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3, Vector6};

fn unit(random: &mut Random) -> f64 {
    (random.bits() >> 11) as f64 / (1u64 << 53) as f64
}

/// Box and Muller's Gaussian.
fn gaussian(random: &mut Random) -> f64 {
    let radius = (-2.0 * (1.0 - unit(random)).ln()).sqrt();
    radius * (std::f64::consts::TAU * unit(random)).cos()
}

/// A camera with a board waved in front of it.
struct Waved {
    board: Board,
    camera: Camera,
    noise_px: f64,
    /// How far from the axis, radians, the board's middle may be seen.
    aside_rad: f64,
    tilt_rad: f64,
}

impl Waved {
    fn barrel() -> Self {
        let lens = Distortion::from_opencv(&[-0.4, 0.18, 0.0008, -0.0005]).unwrap();
        Self {
            board: "chessboard:9x6:25mm".parse().unwrap(),
            camera: Camera::new((640, 480), (420.0, 421.5), (325.0, 236.0), lens).unwrap(),
            noise_px: 0.1,
            aside_rad: 0.5,
            tilt_rad: 0.7,
        }
    }

    fn large() -> Self {
        let lens = Distortion::from_opencv(&[-0.38, 0.16, 0.0008, -0.0005]).unwrap();
        let camera = Camera::new((1280, 720), (840.0, 843.0), (650.0, 351.0), lens).unwrap();
        Self { camera, ..Self::barrel() }
    }

    /// 168° over the diagonal.
    fn fisheye() -> Self {
        let lens = Distortion::KannalaBrandt { k1: -0.02, k2: 0.004, k3: -0.003, k4: 0.0004 };
        let camera = Camera::new((640, 480), (278.0, 277.5), (316.0, 243.0), lens).unwrap();
        Self { camera, aside_rad: 1.0, ..Self::barrel() }
    }

    /// The board near the image's middle or aside, tilted to any side; every point inside the image is seen.
    fn views(&self, count: usize, seed: u64) -> Vec<BoardView> {
        let mut random = Random::new(seed);
        let points = self.board.points();
        let last = points.last().unwrap();
        let middle = Vector3::new(last.x_m / 2.0, last.y_m / 2.0, 0.0);
        let lens = Lens::from_camera(&self.camera);
        let size = (self.camera.width(), self.camera.height());
        let mut views = Vec::new();
        while views.len() < count {
            let around = std::f64::consts::TAU * unit(&mut random);
            let aside = self.aside_rad * unit(&mut random).sqrt();
            let to = Vector3::new(aside.sin() * around.cos(), aside.sin() * around.sin(), aside.cos());
            // The board faces the camera, then is tilted and turned.
            let facing = UnitQuaternion::rotation_between(&Vector3::z(), &to).unwrap();
            let tilt_about = std::f64::consts::TAU * unit(&mut random);
            let tilt = self.tilt_rad * unit(&mut random);
            let tilted = Vector3::new(tilt_about.cos(), tilt_about.sin(), 0.0) * tilt;
            let turned = Vector3::z() * (0.8 * unit(&mut random) - 0.4);
            let rotation =
                facing * UnitQuaternion::from_scaled_axis(tilted) * UnitQuaternion::from_scaled_axis(turned);
            let distance = 0.2 + 0.25 * unit(&mut random);
            let shift = to * distance - rotation * middle;
            let pose = Isometry3::from_parts(Translation3::from(shift), rotation);
            let mut seen = Vec::new();
            for (index, point) in points.iter().enumerate() {
                let at = pose.rotation * Vector3::new(point.x_m, point.y_m, 0.0) + shift;
                let angle = at.x.hypot(at.y).atan2(at.z);
                let Some([x, y]) = lens.pixel(&at) else { continue };
                let pixel = Pixel::new(
                    x + self.noise_px * gaussian(&mut random),
                    y + self.noise_px * gaussian(&mut random),
                );
                // Beyond the fold of a polynomial lens there is no image.
                if angle < 1.45 && self.camera.contains(pixel, 5.0) {
                    let ray = Ray::new(at.x / at.z, at.y / at.z);
                    if self.camera.pixel_from_ray(ray).is_some() {
                        seen.push(SeenPoint { index, pixel });
                    }
                }
            }
            // Like a finder that needs the whole board.
            if seen.len() == points.len() {
                views.push(BoardView { size, points: seen });
            }
        }
        views
    }

    fn config(&self, model: LensModel) -> CalibrationConfig {
        CalibrationConfig { model: Some(model), ..Default::default() }
    }
}

/// Root mean square distance over the image between where the true camera and the estimated one see the same directions, pixels, the
/// best rotation taken out; and the same at the worst of the four corners.
fn ray_error_px(truth: &Camera, estimate: &Camera) -> (f64, f64) {
    let lens = Lens::from_camera(estimate);
    let (w, h) = (truth.width() as f64 - 1.0, truth.height() as f64 - 1.0);
    let mut places = Vec::new();
    for (i, j) in (0..=20).flat_map(|i| (0..=20).map(move |j| (i, j))) {
        let pixel = Pixel::new(w * j as f64 / 20.0, h * i as f64 / 20.0);
        places.extend(truth.ray_from_pixel(pixel).map(|ray| (pixel, ray.vector().normalize())));
    }
    let mut rotation = Rotation3::identity();
    for _ in 0..10 {
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for (pixel, ray) in &places {
            let turned = rotation * ray;
            let Some(seen) = lens.project(&turned) else { continue };
            let by = -(seen.by_point * turned.cross_matrix());
            let off = nalgebra::Vector2::new(pixel.x - seen.pixel[0], pixel.y - seen.pixel[1]);
            normal += by.transpose() * by;
            right += by.transpose() * off;
        }
        rotation = Rotation3::from_scaled_axis(normal.try_inverse().unwrap() * right) * rotation;
    }
    let (mut sum, mut worst) = (0.0, 0.0f64);
    for (pixel, ray) in &places {
        let off = lens.pixel(&(rotation * ray)).map_or(1e3, |[x, y]| (pixel.x - x).hypot(pixel.y - y));
        sum += off * off;
        if (pixel.x == 0.0 || pixel.x == w) && (pixel.y == 0.0 || pixel.y == h) {
            worst = worst.max(off);
        }
    }
    ((sum / places.len() as f64).sqrt(), worst)
}

fn lenses() -> Vec<Lens> {
    let mut all = Vec::new();
    for (model, coefficients) in [
        (LensModel::Pinhole, vec![]),
        (LensModel::BrownConrady8, vec![-0.3, 0.1, 0.002, -0.003, 0.01, 0.1, 0.05, 0.01]),
        (LensModel::KannalaBrandt4, vec![-0.02, 0.01, -0.003, 0.0004]),
        (LensModel::DoubleSphere, vec![-0.2, 0.6]),
    ] {
        let mut lens = Lens::new(model, 400.0, (320.0, 240.0));
        lens.numbers[1] = 410.0;
        lens.numbers[4..4 + coefficients.len()].copy_from_slice(&coefficients);
        all.push(lens);
    }
    all
}

#[test]
fn derivatives_of_lenses_are_those_of_their_projection() {
    for lens in lenses() {
        for point in [Vector3::new(0.1, -0.2, 0.5), Vector3::new(-0.4, 0.1, 0.3), Vector3::new(0.0, 0.0, 1.0)]
        {
            let seen = lens.project(&point).unwrap();
            assert_eq!(lens.pixel(&point).unwrap().map(|v| v as f32), seen.pixel.map(|v| v as f32));
            let step = 1e-6;
            for column in 0..3 {
                let mut shift = Vector3::zeros();
                shift[column] = step;
                let (ahead, behind) =
                    (lens.pixel(&(point + shift)).unwrap(), lens.pixel(&(point - shift)).unwrap());
                for axis in 0..2 {
                    let numeric = (ahead[axis] - behind[axis]) / (2.0 * step);
                    assert!((numeric - seen.by_point[(axis, column)]).abs() < 1e-3, "{lens:?} {point}");
                }
            }
            for at in 0..4 + lens.model.coefficients() {
                let (mut more, mut less) = (lens, lens);
                more.numbers[at] += step;
                less.numbers[at] -= step;
                let (ahead, behind) = (more.pixel(&point).unwrap(), less.pixel(&point).unwrap());
                for axis in 0..2 {
                    let numeric = (ahead[axis] - behind[axis]) / (2.0 * step);
                    assert!(
                        (numeric - seen.by_numbers[axis][at]).abs() < 1e-3,
                        "{lens:?} {point} number {at}"
                    );
                }
            }
        }
    }
}

#[test]
fn a_lens_as_a_camera_sees_the_same() {
    for lens in lenses() {
        let camera = lens.camera((640, 480)).unwrap();
        let again = Lens::from_camera(&camera);
        for ray in [Ray::new(0.3, -0.2), Ray::new(0.0, 0.0), Ray::new(-0.5, 0.4)] {
            let pixel = camera.pixel_from_ray(ray).unwrap();
            let [x, y] = again.pixel(&(ray.vector() * 2.0)).unwrap();
            assert!((pixel.x - x).hypot(pixel.y - y) < 1e-9, "{lens:?}");
        }
    }
}

/// The gradient of the loss, of poses, lens and board, against differences of the residuals.
#[test]
fn one_step_of_the_adjustment_undoes_a_small_change() {
    let waved = Waved { noise_px: 0.0, ..Waved::barrel() };
    let views: Vec<Vec<Sight>> =
        waved.views(6, 1).iter().map(|view| sights::sights_of(&waved.board, view).unwrap()).collect();
    let refs: Vec<&[Sight]> = views.iter().map(Vec::as_slice).collect();
    let truth = calibrate(&waved.board, &waved.views(6, 1), &waved.config(LensModel::BrownConrady4)).unwrap();
    let mut state = State {
        lens: Lens { model: LensModel::BrownConrady4, ..Lens::from_camera(&waved.camera) },
        shape: [1e-5, -2e-5, 1e-5, 1e-4, -1e-4],
        poses: truth.views.iter().map(|view| view.camera_from_board).collect(),
    };
    state.lens.numbers[0] += 0.05;
    state.lens.numbers[4] += 1e-4;
    state.poses[2] = moved_pose(&state.poses[2], &Vector6::new(1e-4, -1e-4, 2e-4, 1e-5, 1e-5, -1e-5));
    let unknowns = Unknowns {
        lens: free_numbers(LensModel::BrownConrady4, false, false, 4),
        shape: true,
        poses: true,
        priors: Vec::new(),
    };
    let bundle = Bundle { views: &refs, unknowns: &unknowns, noise_px: 1.0 };
    bundle.minimise(&mut state, 2);
    // From hundredths of a pixel two Gauss–Newton steps with true derivatives leave next to nothing; with a wrong one they do not.
    for (sights, pose) in refs.iter().zip(&state.poses) {
        for off in residuals(&state.lens, &state.shape, pose, sights).flatten() {
            assert!(off.0.hypot(off.1) < 1e-5, "{off:?}");
        }
    }
}

/// Figures of one waved board; printed so that they can be read with `--nocapture`.
fn figures(name: &str, waved: &Waved, config: &CalibrationConfig, seeds: u64) -> Vec<(f64, f64, f64)> {
    (0..seeds)
        .map(|seed| {
            let found = calibrate(&waved.board, &waved.views(20, seed), config).unwrap();
            let (fx, fy) = found.camera.focal_px();
            let (tx, ty) = waved.camera.focal_px();
            let (cx, cy) = found.camera.principal_px();
            let (ux, uy) = waved.camera.principal_px();
            let focal = (fx / tx - 1.0).abs().max((fy / ty - 1.0).abs());
            let (rays_px, corner_px) = ray_error_px(&waved.camera, &found.camera);
            println!(
                "{name} {}: focal {:.3} %, centre {:.2} px, rays {rays_px:.3} px (expected {:.3}), corner {corner_px:.2}, rms {:.3}, \
                 held out {:.3}, {} {:?}",
                found.model,
                100.0 * focal,
                (cx - ux).hypot(cy - uy),
                found.expected_error_over_image_px(),
                found.rms_px,
                found.hold_out_rms_px,
                found.verdict,
                found.reasons
            );
            (focal, (cx - ux).hypot(cy - uy), rays_px)
        })
        .collect()
}

#[test]
fn barrels_and_fisheyes_are_found() {
    for (name, waved, model) in [
        ("barrel", Waved::barrel(), LensModel::BrownConrady4),
        ("large", Waved::large(), LensModel::BrownConrady4),
        ("fisheye", Waved::fisheye(), LensModel::KannalaBrandt4),
    ] {
        for (focal, centre_px, rays_px) in figures(name, &waved, &waved.config(model), 3) {
            assert!(focal < 0.002 && centre_px < 1.0 && rays_px < 0.2);
        }
    }
}

#[test]
fn the_model_is_chosen_by_views_held_out() {
    for (name, waved) in
        [("barrel", Waved::barrel()), ("large", Waved::large()), ("fisheye", Waved::fisheye())]
    {
        for (_, _, rays_px) in figures(name, &waved, &CalibrationConfig::default(), 3) {
            assert!(rays_px < 0.3);
        }
    }
}

/// Normalised estimation error squared of the lens over many seeds: with a true covariance its mean is that of a χ² of as many degrees
/// as there are numbers, within the bounds that 95 % of such means keep.
#[test]
fn the_covariance_is_true() {
    let seeds = 100;
    for (name, waved, model) in [
        ("barrel", Waved::barrel(), LensModel::BrownConrady4),
        ("fisheye", Waved::fisheye(), LensModel::KannalaBrandt4),
    ] {
        let truth = Lens::from_camera(&waved.camera).numbers;
        let (mut sum, mut degrees) = (0.0, 0.0);
        let (mut rays, mut expected) = (0.0, 0.0);
        for seed in 0..seeds {
            let found = calibrate(&waved.board, &waved.views(20, 1000 + seed), &waved.config(model)).unwrap();
            let numbers = Lens::from_camera(&found.camera).numbers;
            let free = free_numbers(model, false, false, 8);
            let error = DVector::from_iterator(free.len(), free.iter().map(|f| numbers[f.at] - truth[f.at]));
            let scale = DVector::from_iterator(
                free.len(),
                found.parameters.iter().map(|parameter| 1.0 / parameter.deviation),
            );
            let correlation = found.covariance.map_with_location(|i, j, value| value * scale[i] * scale[j]);
            let error = error.component_mul(&scale);
            sum += error.dot(&(correlation.try_inverse().unwrap() * &error));
            degrees += free.len() as f64;
            rays += ray_error_px(&waved.camera, &found.camera).0.powi(2);
            expected += found.expected_error_over_image_px().powi(2);
        }
        // The mean of χ² has variance twice its degrees.
        let bound = 1.96 * (2.0 * degrees).sqrt();
        println!(
            "{name}: NEES {:.3} of {}, bound {:.3}",
            sum / seeds as f64,
            degrees / seeds as f64,
            bound / seeds as f64
        );
        let (rays, expected) = ((rays / seeds as f64).sqrt(), (expected / seeds as f64).sqrt());
        println!("{name}: rays {rays:.4} px, expected {expected:.4} px");
        assert!((sum - degrees).abs() < bound, "{name}");
        // What is expected of a ray is what comes: root mean squares of 100 seeds agree within a few percent.
        assert!((rays / expected - 1.0).abs() < 0.15, "{name}");
    }
}
