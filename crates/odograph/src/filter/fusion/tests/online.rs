//! Fusion while frames come, with readings only up to the present.

use super::{SIGMA_RAD, dark, drive, followed, off_m};
use crate::camera::Rig;
use crate::filter::fusion::{OnlineFusion, SensorCalibration, SensorRecord, Sensors};
use crate::geometry::pose_index::HEADING;
use crate::simulation::{PathKind, Simulation};
use crate::trajectory::FrameEstimate;

/// What is published of a drive with darkness from 6 to 8 s.
struct Published {
    simulation: Simulation,
    frames: Vec<FrameEstimate>,
    distrusted: usize,
}

/// The readings that have come at a time, each `late_s` after it.
fn come(
    record: &SensorRecord,
    time_s: f64,
    late_s: f64,
    change: impl Fn(f64, f64) -> Option<f64>,
) -> Option<SensorRecord> {
    let samples = record.samples().filter(|(at_s, _)| at_s + late_s <= time_s);
    let kept = samples.filter_map(|(at_s, values)| change(at_s, values[0]).map(|value| (at_s, value)));
    let (times_s, values): (Vec<f64>, Vec<f64>) = kept.unzip();
    SensorRecord::new(record.quantity(), times_s, vec![values]).ok()
}

/// Publishes a drive; `wheel` changes or loses its readings.
fn published(seed: u64, late_s: f64, wheel: impl Fn(f64, f64) -> Option<f64> + Copy) -> Published {
    let rig = Rig { yaw_rad: 0.4, ..Rig::level(0.75) };
    let eight = PathKind::FigureEight { length_m: 3.0, laps: 1.0 };
    let simulation = drive(eight, 0.5, dark(6.0, 8.0), rig, seed);
    let records = simulation.sensors().unwrap().records;
    let (gyro, speed) = (records.gyro.unwrap(), records.wheel.unwrap());
    let until = |time_s: f64| Sensors {
        gyro: come(&gyro, time_s, late_s, |_, value| Some(value)),
        wheel: come(&speed, time_s, late_s, wheel),
        ..Sensors::default()
    };
    let alone = followed(&simulation, (0.4, -0.3, 0.3));
    let mut fusion = OnlineFusion::default();
    let mut is_calibrated = false;
    let mut distrusted = 0;
    let mut frames = Vec::new();
    for (index, frame) in alone.iter().enumerate() {
        if frame.time_s > 4.5 && !is_calibrated {
            is_calibrated = true;
            fusion.calibrate(SensorCalibration::of(&alone[..index], &until(frame.time_s)));
        }
        let fused = fusion.add(frame, &until(frame.time_s));
        distrusted += usize::from(fused.distrusted);
        frames.push(fused.frame);
    }
    assert_eq!(frames.len(), alone.len());
    Published { simulation, frames, distrusted }
}

impl Published {
    /// Error and stated standard deviation of the position, metres, of frames with a pose.
    fn errors(&self, from_s: f64, to_s: f64) -> Vec<(f64, f64)> {
        let within = self.frames.iter().filter(|frame| (from_s..to_s).contains(&frame.time_s));
        let known = within.filter_map(|frame| frame.estimate.as_ref().map(|known| (frame.time_s, known)));
        known
            .map(|(time_s, known)| {
                let sigma_m = (known.covariance[(0, 0)] + known.covariance[(1, 1)]).sqrt();
                (off_m(&self.simulation, time_s, &known.pose), sigma_m)
            })
            .collect()
    }
}

#[test]
fn poses_are_published_through_darkness_and_after_it() {
    for seed in 1..=8 {
        let drive = published(seed, 0.0, |_, speed| Some(speed));
        let in_the_dark = drive.errors(6.0, 8.0);
        // A clock that is behind has no reading after the last frame with a pose at first.
        assert!((57..=60).contains(&in_the_dark.len()), "{}", in_the_dark.len());
        for (off_m, sigma_m) in in_the_dark.iter().chain(&drive.errors(8.0, 60.0)) {
            assert!(
                *off_m < 0.05 && *off_m < 3.5 * sigma_m + 1e-3,
                "seed {seed}: {off_m} m, sigma {sigma_m} m"
            );
            assert!(*sigma_m < 0.08, "seed {seed}: {sigma_m}");
        }
        let last = drive.frames.last().unwrap();
        let known = last.estimate.as_ref().unwrap();
        let truth = drive.simulation.truth(last.time_s);
        let (off_rad, variance) =
            (known.pose.heading_rad - truth.heading_rad, known.covariance[(HEADING, HEADING)]);
        assert!(
            off_rad.abs() < 3.5 * variance.sqrt() + 3.0 * SIGMA_RAD && variance.sqrt() < 0.02,
            "{off_rad}"
        );
        // Before the darkness the sensors change nothing.
        assert!(drive.errors(0.0, 6.0).iter().all(|(off_m, _)| *off_m < 3e-4));
    }
}

#[test]
fn late_readings_are_extrapolated_with_a_covariance_to_match() {
    for seed in 1..=4 {
        let drive = published(seed, 0.3, |_, speed| Some(speed));
        let errors = drive.errors(6.0, 60.0);
        assert!(errors.len() > 300);
        for (off_m, sigma_m) in errors {
            assert!(off_m < 0.2 && off_m < 3.5 * sigma_m + 1e-3, "seed {seed}: {off_m} m, sigma {sigma_m} m");
        }
    }
}

#[test]
fn a_wheel_that_sticks_before_the_darkness_is_not_followed() {
    let drive = published(3, 0.0, |time_s, speed| Some(if time_s < 5.0 { speed } else { 0.0 }));
    assert_eq!(drive.distrusted, 1);
    assert!(drive.errors(6.0, 8.0).is_empty());
    for (off_m, sigma_m) in drive.errors(8.0, 60.0) {
        assert!(off_m < 3.5 * sigma_m, "{off_m} m, sigma {sigma_m} m");
    }
}

#[test]
fn a_wheel_that_dies_in_the_dark_is_soon_not_followed() {
    let drive = published(3, 0.0, |time_s, speed| (time_s < 6.5).then_some(speed));
    let in_the_dark = drive.errors(6.0, 8.0);
    // To its last reading, and a second of extrapolation.
    assert!((40..50).contains(&in_the_dark.len()), "{}", in_the_dark.len());
    for (off_m, sigma_m) in in_the_dark.into_iter().chain(drive.errors(8.0, 60.0)) {
        assert!(off_m < 3.5 * sigma_m + 1e-3, "{off_m} m, sigma {sigma_m} m");
    }
}
