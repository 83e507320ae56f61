use super::*;
use crate::motion::Random;
use std::f64::consts::{FRAC_PI_2, TAU};

fn normal(random: &mut Random) -> f64 {
    let mut uniform = || (random.below(1 << 20) as f64 + 0.5) / f64::from(1 << 20);
    (-2.0 * uniform().ln()).sqrt() * (TAU * uniform()).cos()
}

/// Two minutes at about 0.6 m/s, in bends, within 30 m.
fn way(time_s: f64) -> Vector2<f64> {
    let (a, b) = (TAU * time_s / 120.0, TAU * time_s / 47.0);
    Vector2::new(14.0 * a.sin() + 1.5 * b.sin(), 8.0 * (2.0 * a).sin() + 1.5 * (1.0 - b.cos()))
}

/// The direction of travel.
fn heading_rad(time_s: f64) -> f64 {
    let step = way(time_s + 1e-3) - way(time_s - 1e-3);
    step.y.atan2(step.x)
}

/// The path as the camera measured it: exact to a millimetre, its metre `1 / scale` metres long.
fn path(scale: f64) -> Vec<AntennaPosition> {
    let at = |k: usize| {
        let time_s = k as f64 / 20.0;
        AntennaPosition {
            time_s,
            position_m: way(time_s) / scale,
            heading_rad: heading_rad(time_s),
            covariance_m2: Matrix2::identity() * 1e-6,
            segment: 0,
        }
    };
    (0..=2400).map(at).collect()
}

fn origin() -> EarthPosition {
    EarthPosition::from_degrees(48.2082, 16.3738).unwrap()
}

const BEARING_RAD: f64 = 0.7;
const ALTITUDE_M: f64 = 180.0;

fn plane() -> TangentPlane {
    TangentPlane { reference: origin(), altitude_m: ALTITUDE_M }
}

/// A point of the drive in the plane at the origin, metres east and north.
fn on_earth(point: Vector2<f64>) -> Vector2<f64> {
    let (sin, cos) = (FRAC_PI_2 - BEARING_RAD).sin_cos();
    Vector2::new(point.x * cos - point.y * sin, point.x * sin + point.y * cos)
}

/// A receiver.
#[derive(Clone, Copy)]
struct Receiver {
    sigma_m: f64,
    per_s: f64,
    /// Correlation of the error from fix to fix.
    correlation: f64,
    bias_m: Vector2<f64>,
    /// Fraction of fixes by a reflected signal.
    multipath: f64,
    clock_offset_s: f64,
}

const RTK: Receiver = Receiver {
    sigma_m: 0.02,
    per_s: 5.0,
    correlation: 0.0,
    bias_m: Vector2::new(0.0, 0.0),
    multipath: 0.0,
    clock_offset_s: 0.0,
};

/// Its fixes, and which of them are reflections.
fn received(receiver: &Receiver, seed: u64) -> (Vec<GnssFix>, Vec<bool>) {
    let mut random = Random::new(seed);
    let (mut fixes, mut reflections) = (Vec::new(), Vec::new());
    let mut error_m = Vector2::zeros();
    for k in 0..(120.0 * receiver.per_s) as usize {
        let time_s = 0.013 + k as f64 / receiver.per_s;
        let fresh = Vector2::from_fn(|_, _| normal(&mut random)) * receiver.sigma_m;
        let rho = receiver.correlation;
        error_m = if k == 0 { fresh } else { rho * error_m + (1.0 - rho * rho).sqrt() * fresh };
        let is_reflection = (random.below(1000) as f64) < 1000.0 * receiver.multipath;
        let detour_m = if is_reflection {
            let angle = 0.8 + 0.4 * normal(&mut random);
            (50.0 + random.below(100) as f64) * receiver.sigma_m * Vector2::new(angle.cos(), angle.sin())
        } else {
            Vector2::zeros()
        };
        let there = on_earth(way(time_s)) + error_m + receiver.bias_m + detour_m;
        fixes.push(GnssFix {
            time_s: time_s + receiver.clock_offset_s,
            place: plane().place([there.x, there.y]),
            altitude_m: Some(ALTITUDE_M),
            covariance_m2: GnssFix::covariance_m2(receiver.sigma_m, receiver.sigma_m),
        });
        reflections.push(is_reflection);
    }
    (fixes, reflections)
}

/// Errors of the placed path: east and north of its positions less the true ones.
fn errors(found: &Georeference, path: &[AntennaPosition]) -> Vec<Vector2<f64>> {
    let error = |at: &AntennaPosition| {
        let [east, north] = plane().point(found.anchor.place(at.position_m.x, at.position_m.y));
        Vector2::new(east, north) - on_earth(way(at.time_s))
    };
    path.iter().map(error).collect()
}

fn rms(errors: &[Vector2<f64>]) -> f64 {
    (errors.iter().map(Vector2::norm_squared).sum::<f64>() / errors.len() as f64).sqrt()
}

fn turned_by(found: &Georeference) -> f64 {
    wrap_angle(found.anchor.bearing_rad(0.0) - BEARING_RAD)
}

#[test]
fn rtk_places_a_path_to_a_centimetre_in_spite_of_reflections_and_a_late_clock() {
    let path = path(1.0);
    for seed in 0..8 {
        let receiver = Receiver { multipath: 0.1, clock_offset_s: 0.07, ..RTK };
        let (fixes, reflections) = received(&receiver, seed);
        let found = georeference(&path, &fixes, 0.2, true).unwrap();
        let off_m = rms(&errors(&found, &path));
        assert!(off_m < 0.01 && turned_by(&found).abs() < 1e-3, "{off_m} {}", turned_by(&found));
        assert!((found.clock_offset_s - 0.07).abs() < 0.01, "{}", found.clock_offset_s);
        assert!((found.rmse_m - 0.02 * 2f64.sqrt()).abs() < 0.004, "{}", found.rmse_m);
        assert_eq!(found.scale, 1.0);
        let mut lost = 0;
        for (fix, is_reflection) in found.fixes.iter().zip(reflections) {
            match fix {
                FixUse::Used(_) => assert!(!is_reflection),
                FixUse::Rejected(off_m) => {
                    lost += usize::from(!is_reflection);
                    assert!(!is_reflection || *off_m > 0.9);
                }
                FixUse::NoPath => {}
            }
        }
        // By chance one in ten thousand.
        assert!(lost <= 2, "{lost}");
    }
}

#[test]
fn metres_of_noise_leave_the_shape_as_it_is() {
    let path = path(1.0);
    let receiver = Receiver { sigma_m: 2.0, per_s: 1.0, multipath: 0.1, ..RTK };
    for seed in 0..8 {
        let found = georeference(&path, &received(&receiver, seed).0, 0.2, true).unwrap();
        let placed: Vec<Vector2<f64>> = path
            .iter()
            .map(|at| Vector2::from(plane().point(found.anchor.place(at.position_m.x, at.position_m.y))))
            .collect();
        // The ellipsoid at the altitude of the plane: 1 / (1 + 2e-5) would be 0.6 mm.
        for (k, l) in [(0, 600), (300, 1700), (900, 2400)] {
            let on_path_m = (path[k].position_m - path[l].position_m).norm();
            assert!(((placed[k] - placed[l]).norm() - on_path_m).abs() < 1e-4);
        }
        assert!(turned_by(&found).abs() < 4.0 * found.heading_sigma_rad);
        assert!(rms(&errors(&found, &path)) < 1.5);
    }
}

/// Mean of the squared errors of the direction and of the shift, in their standard deviations.
fn consistency(receiver: &Receiver) -> [f64; 2] {
    let (path, seeds) = (path(1.0), 40);
    let mut sums = [0.0; 2];
    for seed in 0..seeds {
        let found = georeference(&path, &received(receiver, 100 + seed).0, 0.2, true).unwrap();
        sums[0] += (turned_by(&found) / found.heading_sigma_rad).powi(2) / seeds as f64;
        let errors = errors(&found, &path);
        let mean = errors.iter().sum::<Vector2<f64>>() / errors.len() as f64;
        let information = found.shift_covariance_m2.try_inverse().unwrap();
        sums[1] += mean.dot(&(information * mean)) / 2.0 / seeds as f64;
    }
    sums
}

#[test]
fn the_stated_deviations_are_those_of_the_errors() {
    let white = consistency(&Receiver { sigma_m: 1.0, per_s: 1.0, ..RTK });
    // The mean of 40 squares: 1 ± 0.22. The shift's has room for an error that is common to all.
    assert!((0.5..1.7).contains(&white[0]) && white[1] < 0.1, "{white:?}");
    // Errors that last for ten fixes.
    let slow = consistency(&Receiver { sigma_m: 1.0, per_s: 1.0, correlation: 0.9, ..RTK });
    assert!((0.3..2.5).contains(&slow[0]) && slow[1] < 1.0, "{slow:?}");
    // An error common to all fixes, of the size that they state.
    let bias_m = Vector2::new(0.7, -0.7);
    let biased = consistency(&Receiver { sigma_m: 1.0, per_s: 1.0, bias_m, ..RTK });
    assert!((0.3..1.5).contains(&biased[1]), "{biased:?}");
}

#[test]
fn an_antenna_beside_the_camera_is_found_and_is_no_scale() {
    let truth_m = Vector2::new(-0.1, 0.3);
    let there = |path: Vec<AntennaPosition>| -> Vec<AntennaPosition> {
        let moved = |at: AntennaPosition| {
            let (s, c) = at.heading_rad.sin_cos();
            let arm = Vector2::new(c * truth_m.x - s * truth_m.y, s * truth_m.x + c * truth_m.y);
            AntennaPosition { position_m: at.position_m - arm, ..at }
        };
        path.into_iter().map(moved).collect()
    };
    let path = there(path(1.0));
    let fixes = received(&Receiver { multipath: 0.05, ..RTK }, 5).0;
    let found = georeference(&path, &fixes, 0.2, false).unwrap();
    let (at_m, sigma_m) = found.antenna_m.unwrap();
    assert!((at_m - truth_m).norm() < 4.0 * sigma_m && sigma_m < 0.01, "{at_m} ± {sigma_m}");
    assert_eq!(found.scale, 1.0);
    // It is not sought where it is known, nor shown where it is right.
    assert_eq!(georeference(&path, &fixes, 0.2, true).unwrap().antenna_m, None);
    assert_eq!(georeference(&self::path(1.0), &fixes, 0.2, false).unwrap().antenna_m, None);
}

#[test]
fn a_scale_is_estimated_only_where_it_is_shown() {
    let path = path(1.01);
    let found = georeference(&path, &received(&Receiver { multipath: 0.1, ..RTK }, 3).0, 0.2, true).unwrap();
    assert!((found.scale - 1.01).abs() < 4.0 * found.scale_sigma && found.scale_sigma < 1e-3, "{found:?}");
    let off_m = rms(&errors(&found, &path));
    assert!(off_m < 0.01, "{off_m}");
    let metres = Receiver { sigma_m: 2.0, per_s: 1.0, ..RTK };
    assert_eq!(georeference(&path, &received(&metres, 3).0, 0.2, true).unwrap().scale, 1.0);
}

#[test]
fn a_start_that_a_person_states_is_corrected() {
    let path = path(1.0);
    let receiver = Receiver { sigma_m: 0.3, per_s: 1.0, clock_offset_s: -1.7, multipath: 0.1, ..RTK };
    let found = georeference(&path, &received(&receiver, 9).0, 1.0, true).unwrap();
    assert!((found.clock_offset_s + 1.7).abs() < 0.3, "{}", found.clock_offset_s);
}

#[test]
fn what_cannot_be_placed_has_a_reason() {
    let path = path(1.0);
    let (fixes, _) = received(&Receiver { per_s: 1.0, ..RTK }, 1);
    assert_eq!(georeference(&path, &fixes[..2], 0.2, true), Err(Unplaced::TooFew { fixes: 2 }));
    assert_eq!(georeference(&path, &[], 0.2, true), Err(Unplaced::TooFew { fixes: 0 }));
    assert_eq!(georeference(&[], &fixes, 0.2, true), Err(Unplaced::TooFew { fixes: 0 }));
    assert!(georeference(&path, &fixes[..3], 0.2, true).is_ok());
    // Another day.
    let late: Vec<GnssFix> = fixes.iter().map(|fix| GnssFix { time_s: fix.time_s + 1e5, ..*fix }).collect();
    assert_eq!(georeference(&path, &late, 0.2, true), Err(Unplaced::TooFew { fixes: 0 }));
    // A robot that stands still, and fixes about it.
    let standing: Vec<AntennaPosition> =
        path.iter().map(|at| AntennaPosition { position_m: Vector2::zeros(), ..*at }).collect();
    let here: Vec<GnssFix> = fixes.iter().map(|fix| GnssFix { place: fixes[0].place, ..*fix }).collect();
    let unknown = georeference(&standing, &here, 0.2, true).unwrap_err();
    assert!(matches!(unknown, Unplaced::NoHeading { .. }), "{unknown}");
    // The fixes of another drive.
    let mut random = Random::new(4);
    let elsewhere: Vec<GnssFix> = fixes
        .iter()
        .map(|fix| GnssFix { place: plane().place([(); 2].map(|()| 20.0 * normal(&mut random))), ..*fix })
        .collect();
    let unknown = georeference(&path, &elsewhere, 0.2, true);
    assert!(unknown.is_err(), "{unknown:?}");
    // Numbers that no receiver gives.
    let odd = EarthPosition { latitude_rad: -1.2, longitude_rad: 9.0 };
    let odd: Vec<GnssFix> = fixes
        .iter()
        .enumerate()
        .map(|(k, fix)| GnssFix { place: if k % 2 == 0 { odd } else { fix.place }, ..*fix })
        .collect();
    let _ = georeference(&path, &odd, 0.2, true);
}
