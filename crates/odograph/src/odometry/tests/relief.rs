//! Ground that is not flat, rendered with exact truth.

use super::*;

/// The error at the end of a straight drive, over its length.
fn error(terrain: Terrain, length_m: f64, seed: u64) -> f64 {
    error_at_end_m(PathKind::Straight { length_m }, terrain, seed) / length_m
}

/// The error at the end of a drive, metres.
fn error_at_end_m(path: PathKind, terrain: Terrain, seed: u64) -> f64 {
    let world = World::new("asphalt");
    let simulation = Simulation::new(SimulationConfig {
        camera: world.camera.clone(),
        rig: Rig::level(HEIGHT_M),
        texture: Texture::Asphalt,
        path: Path::new(path, 0.6, 1.0, true).unwrap(),
        effects: Effects { terrain, noise_gray: 2.0, ..Effects::default() },
        fps: 30.0,
        duration_s: None,
        colored: false,
        seed,
    })
    .unwrap();
    let mut odometry = world.odometry();
    let mut off_m = f64::NAN;
    for frame in simulation.frames() {
        let pose = odometry.process(frame.image, frame.time_s).unwrap().estimate.expect("followed").pose;
        off_m = (pose.x_m - frame.truth.x_m).hypot(pose.y_m - frame.truth.y_m);
    }
    off_m
}

#[test]
fn a_kerb_keeps_the_scale() {
    // Points 5 cm nearer to the camera move by 7 % more, and a plane has half of that for error.
    // Over 4 cm the edge moves from the first rows of a new keyframe to where most of the ground
    // that it shows is the upper one.
    for (at_m, seed) in [(1.98, 3), (2.0, 3), (2.02, 5)] {
        let kerb = Some(Kerb { height_m: 0.05, at_m });
        let error = error(Terrain { kerb, ..Terrain::default() }, 3.0, seed);
        assert!(error < 5e-4, "kerb at {at_m} m: {error}");
    }
}

#[test]
fn a_kerb_is_found_again_on_the_way_back() {
    // The ground is not flat any more: what earlier keyframes say of it must not hold new ground
    // down. With that, the error was 18 mm.
    let path = PathKind::Lanes { length_m: 1.6, spacing_m: 0.4, count: 2 };
    let kerb = Some(Kerb { height_m: 0.03, at_m: 0.6 });
    let error_m = error_at_end_m(path, Terrain { kerb, ..Terrain::default() }, 1);
    assert!(error_m < 1e-3, "{error_m}");
}

#[test]
fn undulating_ground_keeps_the_scale() {
    // With a plane for the ground the error is 2 to 5 %.
    let undulation = Some(Undulation { amplitude_m: 0.03, wavelength_m: 2.0 });
    let error = error(Terrain { undulation, ..Terrain::default() }, 2.0, 4);
    assert!(error < 0.008, "{error}");
}
