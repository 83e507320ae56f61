//! Rolling shutters on rendered ground with exact truth.

use super::*;
use crate::continuous_time::ReadoutEstimation;
use crate::motion::Readout;
use crate::mounting::OnlineCalibration;

const READOUT_S: f64 = 0.020;

fn drive(readout_s: f64, seed: u64) -> Simulation {
    drive_at((0.6, 1.0), 1.2, readout_s, seed)
}

/// A straight drive with a speed in m/s and an acceleration in m/s².
fn drive_at(
    (speed_m_s, acceleration_m_s2): (f64, f64),
    length_m: f64,
    readout_s: f64,
    seed: u64,
) -> Simulation {
    let world = World::new("asphalt");
    Simulation::new(SimulationConfig {
        camera: world.camera,
        rig: Rig::level(HEIGHT_M),
        texture: Texture::Asphalt,
        path: Path::new(PathKind::Straight { length_m }, speed_m_s, acceleration_m_s2, true).unwrap(),
        effects: Effects { readout_s, noise_gray: 2.0, ..Effects::default() },
        fps: 30.0,
        duration_s: None,
        colored: false,
        seed,
    })
    .unwrap()
}

/// Where a drive ends, millimetres from the truth, and the readout time if that was estimated.
fn end_mm(simulation: &Simulation, given_s: Option<f64>) -> (f64, Option<Readout>) {
    let camera = World::new("asphalt").camera.with_readout_s(given_s).unwrap();
    let mut estimation = ReadoutEstimation::new(&camera);
    let mut odometry = Odometry::new(camera, Rig::level(HEIGHT_M), OdometryConfig::default()).unwrap();
    let (mut off_mm, mut found) = (f64::NAN, None);
    for frame in simulation.frames() {
        let tracked = odometry.process(frame.image, frame.time_s).unwrap();
        found = found.or(estimation.as_mut().and_then(|estimation| estimation.watch(&tracked, &odometry)));
        let pose = tracked.estimate.expect("followed").pose;
        off_mm = 1e3 * (pose.x_m - frame.truth.x_m).hypot(pose.y_m - frame.truth.y_m);
    }
    (off_mm, found.or(estimation.and_then(|estimation| estimation.at_end())))
}

#[test]
fn a_given_readout_time_makes_the_drive_exact() {
    // Without the shutter in the model the drive is 16 mm (1.4 %) too long. Measured: 0.04 mm.
    let (off_mm, found) = end_mm(&drive(READOUT_S, 3), Some(READOUT_S));
    assert!(off_mm < 0.3, "{off_mm} mm");
    assert_eq!(found, None, "it was given");
}

#[test]
fn the_readout_time_is_estimated_from_a_change_of_speed() {
    let found = end_mm(&drive(READOUT_S, 4), None).1.expect("a start and a stop");
    let (off_s, deviation_s) = ((found.mean_s - READOUT_S).abs(), found.variance_s2.sqrt());
    assert!(off_s < 2e-4 && off_s < 3.0 * deviation_s, "{found:?}");
}

#[test]
fn a_skew_of_a_seventh_of_the_view_is_estimated_before_it_misleads() {
    // The odometry follows as if the shutter were global, and drops the corners that disagree.
    let simulation = drive_at((4.0, 6.0), 6.0, 0.026, 4);
    let mut estimation = ReadoutEstimation::new(&World::new("asphalt").camera).unwrap();
    let mut odometry = World::new("asphalt").odometry();
    let found = simulation.frames().take(60).find_map(|frame| {
        let tracked = odometry.process(frame.image, frame.time_s).unwrap();
        estimation.watch(&tracked, &odometry)
    });
    let found = found.or(estimation.at_end()).expect("a start");
    assert!((found.mean_s - 0.026).abs() < 0.003, "{found:?}");
}

#[test]
fn a_global_shutter_is_not_taken_for_a_rolling_one() {
    let (off_mm, found) = end_mm(&drive(0.0, 5), None);
    assert!(off_mm < 0.2, "{off_mm} mm");
    let found = found.expect("a start and a stop");
    assert!(found.mean_s == 0.0 && found.variance_s2.sqrt() < 5e-4, "{found:?}");
}

#[test]
fn a_live_readout_time_makes_the_beginning_exact_too() {
    let simulation = drive(READOUT_S, 6);
    let (camera, rig) = (World::new("asphalt").camera, Rig::level(HEIGHT_M));
    let mut odometry = Odometry::new(camera.clone(), rig, OdometryConfig::default()).unwrap();
    let mut calibration = OnlineCalibration::new(&camera, &rig, true);
    let mut off_mm = Vec::new();
    for frame in simulation.frames() {
        let tracked = odometry.process(frame.image.clone(), frame.time_s).unwrap();
        let pose = tracked.estimate.as_ref().expect("followed").pose;
        off_mm.push(1e3 * (pose.x_m - frame.truth.x_m).hypot(pose.y_m - frame.truth.y_m));
        calibration.watch(&frame.image, &tracked, &mut odometry).unwrap();
    }
    // Known after 16 frames. The bound is that of a readout time that is given; without one the
    // drive is 16 mm too long.
    assert!(off_mm[20..].iter().all(|off_mm| *off_mm < 0.3), "{off_mm:.2?}");
}
