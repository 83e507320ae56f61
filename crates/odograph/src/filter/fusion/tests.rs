//! Sensor fusion on synthetic odometry with exact ground truth: simulated paths and sensors,
//! without rendering.

mod online;

use super::super::tests::smooth;
use super::super::{FilterConfig, PoseSource};
use super::*;
use crate::camera::{Camera, Rig};
use crate::geometry::GroundPose;
use crate::motion::Random;
use crate::simulation::{
    Blackout, Effects, Path, PathKind, Simulation, SimulationConfig, SlowVariation, Texture,
};
use crate::trajectory::Velocity;
use crate::trajectory::{LossReason, PlaneMeasurement, PoseEstimate, TrackStatus};
use nalgebra::Matrix6;

/// A simulated drive; only its poses are used.
fn drive(path: PathKind, speed_m_s: f64, effects: Effects, rig: Rig, seed: u64) -> Simulation {
    Simulation::new(SimulationConfig {
        camera: Camera::from_field_of_view((64, 48), (0.96, 0.72), rig.height_m).unwrap(),
        rig,
        texture: Texture::Asphalt,
        path: Path::new(path, speed_m_s, 1.0, true).unwrap(),
        effects,
        fps: 30.0,
        duration_s: None,
        colored: false,
        seed,
    })
    .unwrap()
}

fn gaussian(random: &mut Random) -> f64 {
    let uniform = |r: &mut Random| ((r.bits() >> 11) as f64 + 0.5) / (1u64 << 53) as f64;
    (-2.0 * uniform(random).ln()).sqrt() * (std::f64::consts::TAU * uniform(random)).cos()
}

const SIGMA_M: f64 = 5e-5;
const SIGMA_RAD: f64 = 1e-4;

/// Simulated odometry of a drive: ground truth plus noise. After each blackout it continues in a
/// frame displaced by `lost_by` (x and y in metres, heading in radians).
fn followed(simulation: &Simulation, lost_by: (f64, f64, f64)) -> Vec<FrameEstimate> {
    let blackouts = &simulation.config().effects.blackouts;
    let mut random = Random::new(simulation.config().seed);
    let times_s = simulation.times_s().iter().enumerate();
    times_s
        .map(|(number, &time_s)| {
            let dark = blackouts.iter().any(|dark| (dark.from_s..dark.to_s).contains(&time_s));
            let gaps = blackouts.iter().filter(|dark| time_s >= dark.to_s).count();
            let truth = simulation.truth(time_s);
            let (sin, cos) = (gaps as f64 * lost_by.2).sin_cos();
            let pose = GroundPose {
                x_m: cos * truth.x_m - sin * truth.y_m
                    + gaps as f64 * lost_by.0
                    + SIGMA_M * gaussian(&mut random),
                y_m: sin * truth.x_m
                    + cos * truth.y_m
                    + gaps as f64 * lost_by.1
                    + SIGMA_M * gaussian(&mut random),
                heading_rad: truth.heading_rad + gaps as f64 * lost_by.2 + SIGMA_RAD * gaussian(&mut random),
                ..truth
            };
            let mut own = Matrix6::zeros();
            (own[(0, 0)], own[(1, 1)], own[(2, 2)]) = (SIGMA_M.powi(2), SIGMA_M.powi(2), SIGMA_RAD.powi(2));
            let mut covariance = own;
            for axis in 0..3 {
                covariance[(axis, axis)] += gaps as f64 * 0.3;
            }
            FrameEstimate {
                frame: number as u64,
                time_s,
                status: if dark {
                    TrackStatus::Lost { reason: LossReason::Bare }
                } else {
                    TrackStatus::Tracked
                },
                estimate: (!dark).then_some(PoseEstimate {
                    pose,
                    velocity: Velocity::default(),
                    covariance,
                    measured: PlaneMeasurement::new(&pose, &own),
                }),
                tracks: 100,
                inliers: 100,
                residual_px: 0.1,
                keyframe: false,
                segment: gaps,
            }
        })
        .collect()
}

fn dark(from_s: f64, to_s: f64) -> Effects {
    Effects { blackouts: vec![Blackout { from_s, to_s }], ..Effects::default() }
}

fn off_m(simulation: &Simulation, time_s: f64, pose: &GroundPose) -> f64 {
    let truth = simulation.truth(time_s);
    (truth.x_m - pose.x_m).hypot(truth.y_m - pose.y_m)
}

fn report(fusion: &Fusion, sensor: SensorKind) -> &SensorReport {
    fusion.reports.iter().find(|report| report.sensor == sensor).unwrap()
}

#[test]
fn gyroscope_and_wheel_bridge_two_seconds_of_darkness_within_centimetres() {
    let mut square_sum = 0.0;
    for seed in 1..=8 {
        // Through a bend of the figure eight at 0.5 m/s, with a mount yaw.
        let rig = Rig { yaw_rad: 0.4, ..Rig::level(0.75) };
        let eight = PathKind::FigureEight { length_m: 3.0, laps: 1.0 };
        let simulation = drive(eight, 0.5, dark(6.0, 8.0), rig, seed);
        let sensors = simulation.sensors().unwrap();
        let records = Sensors {
            gyro: sensors.records.gyro.clone(),
            wheel: sensors.records.wheel.clone(),
            ..Sensors::default()
        };
        let frames = followed(&simulation, (0.4, -0.3, 0.3));
        let fusion = fuse(&frames, &records);
        assert!(fusion.reports.iter().all(|report| report.rejected.is_none()), "{:?}", fusion.reports);
        for (sensor, truth) in [(SensorKind::Gyro, sensors.gyro), (SensorKind::Wheel, sensors.wheel)] {
            let found = report(&fusion, sensor).offset.unwrap();
            // Accurate to 5 ms and consistent with its standard deviation.
            let off_s = (found.offset_s - truth.offset_s).abs();
            assert!(
                off_s < 0.005 && off_s < 4.0 * found.sigma_s + 1e-3,
                "{sensor}: {found:?}, truth {}",
                truth.offset_s
            );
        }
        let first = fusion.frames.iter().find(|frame| frame.segment == 1).unwrap();
        let known = first.estimate.as_ref().unwrap();
        let off_m = off_m(&simulation, first.time_s, &known.pose);
        let sigma_m = (known.covariance[(0, 0)] + known.covariance[(1, 1)]).sqrt();
        // After one metre in the dark: within 3 cm and within three standard deviations.
        assert!(off_m < 0.03 && off_m < 3.0 * sigma_m, "seed {seed}: {off_m} m, sigma {sigma_m} m");
        assert!(sigma_m < 0.03, "{sigma_m}");
        square_sum += off_m.powi(2) / sigma_m.powi(2);
        // Every frame in the dark has a pose of the same accuracy.
        let mut path = Vec::with_capacity(frames.len());
        let mut merge = fusion.reckoned.merge();
        for frame in smooth(&fusion.frames, &FilterConfig::default()) {
            merge.next(frame, &mut |frame| path.push(frame));
        }
        merge.end(&mut |frame| path.push(frame));
        assert_eq!(path.len(), frames.len());
        for frame in path.iter().filter(|frame| (6.0..8.0).contains(&frame.time_s)) {
            assert_eq!(frame.source, PoseSource::Sensors);
            let truth = simulation.truth(frame.time_s);
            let off_m = (truth.x_m - frame.pose.x_m).hypot(truth.y_m - frame.pose.y_m);
            assert!(off_m < 0.03, "{off_m} at {}", frame.time_s);
        }
    }
    // For eight runs, χ² with 16 degrees of freedom puts the mean normalised squared error between
    // 0.3 and 2.2 in 99 % of cases. The lower bound is wider, because modelling the noise of cheap
    // sensors as white slightly overestimates the variance.
    let mean = square_sum / 8.0;
    assert!((0.02..2.2).contains(&mean), "{mean}");
}

#[test]
fn faulty_sensors_are_rejected_and_the_others_accepted() {
    let eight = PathKind::FigureEight { length_m: 3.0, laps: 1.0 };
    let simulation = drive(eight, 0.5, dark(6.0, 8.0), Rig::level(0.75), 3);
    let frames = followed(&simulation, (0.4, -0.3, 0.3));
    let records = simulation.sensors().unwrap().records;
    let lying = |record: &SensorRecord, lie: &dyn Fn(f64, f64) -> f64| {
        let (times_s, values) =
            record.samples().map(|(time_s, values)| (time_s, lie(time_s, values[0]))).unzip();
        Some(SensorRecord::new(record.quantity(), times_s, vec![values]).unwrap())
    };
    let [gyro, heading, wheel, range] = [&records.gyro, &records.heading, &records.wheel, &records.range]
        .map(|record| record.as_ref().unwrap());
    let one = |change: fn(&mut Sensors, Option<SensorRecord>), record| {
        let mut sensors = records.clone();
        change(&mut sensors, record);
        sensors
    };
    let set_gyro = |record| one(|s, r| s.gyro = r, record);
    let set_wheel = |record| one(|s, r| s.wheel = r, record);
    let set_heading = |record| one(|s, r| s.heading = r, record);
    let set_range = |record| one(|s, r| s.range = r, record);
    for (name, liar, sensors) in [
        ("a gyroscope that stands still", SensorKind::Gyro, set_gyro(lying(gyro, &|_, _| 0.0))),
        ("one of another axis", SensorKind::Gyro, set_gyro(lying(gyro, &|t, _| 0.5 * (1.7 * t).sin()))),
        ("one in degrees", SensorKind::Gyro, set_gyro(lying(gyro, &|_, rate| rate.to_degrees()))),
        (
            "a wheel that slips half of the time",
            SensorKind::Wheel,
            set_wheel(lying(wheel, &|t, v| if t % 4.0 < 2.0 { 3.0 * v } else { v })),
        ),
        ("a wheel that does not turn", SensorKind::Wheel, set_wheel(lying(wheel, &|_, _| 0.0))),
        ("a compass on a motor", SensorKind::Heading, set_heading(lying(heading, &|t, _| (9.0 * t).sin()))),
        ("a compass that is stuck", SensorKind::Heading, set_heading(lying(heading, &|_, _| 1.0))),
        (
            "a range finder that sees the wheel",
            SensorKind::Range,
            set_range(lying(range, &|t, h| if t % 3.0 < 1.5 { 0.3 } else { h })),
        ),
    ] {
        let fusion = fuse(&frames, &sensors);
        for report in &fusion.reports {
            assert_eq!(report.rejected.is_some(), report.sensor == liar, "{name}: {report:?}");
        }
        if matches!(liar, SensorKind::Heading | SensorKind::Range) {
            let first = fusion.frames.iter().find(|frame| frame.segment == 1).unwrap();
            let off_m = off_m(&simulation, first.time_s, &first.estimate.as_ref().unwrap().pose);
            assert!(off_m < 0.03, "{name}: {off_m}");
        }
    }
}

#[test]
fn a_gyroscope_of_another_scale_is_told_so() {
    let eight = PathKind::FigureEight { length_m: 3.0, laps: 1.0 };
    let simulation = drive(eight, 0.5, Effects::default(), Rig::level(0.75), 3);
    let frames = followed(&simulation, (0.0, 0.0, 0.0));
    let gyro = simulation.sensors().unwrap().records.gyro.unwrap();
    for (factor, parts) in [
        (2.0, ["times those that the camera saw", "check the unit"]),
        (1f64.to_degrees(), ["its rates are about 5", "they seem to be degrees per second"]),
    ] {
        let (times_s, rates) = gyro.samples().map(|(time_s, values)| (time_s, factor * values[0])).unzip();
        let scaled = SensorRecord::new(gyro.quantity(), times_s, vec![rates]).unwrap();
        let fusion = fuse(&frames, &Sensors { gyro: Some(scaled), ..Sensors::default() });
        let reason = report(&fusion, SensorKind::Gyro).rejected.unwrap().to_string();
        assert!(parts.iter().all(|part| reason.contains(part)), "{factor}: {reason}");
    }
}

#[test]
fn without_sensors_and_without_gaps_nothing_changes() {
    let eight = PathKind::FigureEight { length_m: 3.0, laps: 1.0 };
    let simulation = drive(eight, 0.5, Effects::default(), Rig::level(0.75), 3);
    let frames = followed(&simulation, (0.0, 0.0, 0.0));
    assert_eq!(fuse(&frames, &Sensors::default()).frames, frames);
    let records = simulation.sensors().unwrap().records;
    let records = Sensors { heading: None, range: None, ..records };
    let fusion = fuse(&frames, &records);
    assert!(!fusion.moved && fusion.frames == frames);
    assert!(fuse(&[], &records).frames.is_empty());
}

#[test]
fn clock_offsets_are_estimated_only_where_observable() {
    for seed in 1..=4 {
        let eight = PathKind::FigureEight { length_m: 3.0, laps: 1.0 };
        let simulation = drive(eight, 0.5, Effects::default(), Rig::level(0.75), seed);
        let frames = followed(&simulation, (0.0, 0.0, 0.0));
        let sensors = simulation.sensors().unwrap();
        let fusion = fuse(&frames, &Sensors { gyro: None, wheel: None, ..sensors.records });
        let found = report(&fusion, SensorKind::Heading).offset.unwrap();
        let off_s = (found.offset_s - sensors.heading.offset_s).abs();
        assert!(
            off_s < 0.015 && off_s < 4.0 * found.sigma_s,
            "{found:?}, truth {}",
            sensors.heading.offset_s
        );
        // The height is constant, so the range finder's clock offset is unobservable.
        let found = report(&fusion, SensorKind::Range).offset.unwrap();
        assert!(found.offset_s == 0.0 && found.sigma_s.is_infinite(), "{found:?}");
    }
}

#[test]
fn a_three_axis_gyroscope_is_calibrated_for_any_orientation() {
    let eight = PathKind::FigureEight { length_m: 3.0, laps: 1.0 };
    let simulation = drive(eight, 0.5, dark(6.0, 8.0), Rig::level(0.75), 5);
    let frames = followed(&simulation, (0.4, -0.3, 0.3));
    let records = simulation.sensors().unwrap().records;
    let axis = [-0.48, 0.6, -0.64];
    let one = records.gyro.as_ref().unwrap();
    let mut random = Random::new(9);
    let (times_s, rates): (Vec<f64>, Vec<f64>) =
        one.samples().map(|(time_s, values)| (time_s, values[0])).unzip();
    let mut channel =
        |share: f64| rates.iter().map(|rate| share * rate + 0.003 * gaussian(&mut random)).collect();
    let channels = vec![channel(axis[0]), channel(axis[1]), channel(axis[2])];
    let gyro = SensorRecord::new(Quantity::TurnRates, times_s, channels).unwrap();
    let fusion = fuse(&frames, &Sensors { gyro: Some(gyro), wheel: records.wheel, ..Sensors::default() });
    let found = report(&fusion, SensorKind::Gyro);
    assert_eq!(found.rejected, None);
    // The carrier rotates about one axis only: just the scale along that axis is observable, and no
    // more is needed.
    let along: f64 =
        found.parameters.iter().zip(axis).map(|(parameter, truth)| parameter.value * truth).sum();
    assert!((along - 1.0).abs() < 0.03, "{found:?}");
    let first = fusion.frames.iter().find(|frame| frame.segment == 1).unwrap();
    let off_m = off_m(&simulation, first.time_s, &first.estimate.as_ref().unwrap().pose);
    assert!(off_m < 0.03, "{off_m}");
}

#[test]
fn a_compass_bounds_the_heading_drift_of_the_camera() {
    // The camera's heading drifts as a random walk of 0.6°/√s, with a consistent covariance.
    let rig = Rig::level(0.75);
    let walk = PathKind::RandomWalk { length_m: 60.0, seed: 4 };
    let simulation = drive(walk, 0.25, Effects::default(), rig, 7);
    let heading = simulation.sensors().unwrap().records.heading;
    let density: f64 = 1e-4;
    let (mut alone, mut fused) = ([0.0; 2], [0.0; 2]);
    for seed in 1..=3 {
        let mut frames = followed(&simulation, (0.0, 0.0, 0.0));
        let mut random = Random::new(seed);
        let (mut drift_rad, mut place) = (0.0f64, (0.0, 0.0));
        let mut before = simulation.truth(0.0);
        for frame in &mut frames {
            let truth = simulation.truth(frame.time_s);
            drift_rad += (density / 30.0).sqrt() * gaussian(&mut random);
            let (sin, cos) = drift_rad.sin_cos();
            let (dx, dy) = (truth.x_m - before.x_m, truth.y_m - before.y_m);
            place = (place.0 + cos * dx - sin * dy, place.1 + sin * dx + cos * dy);
            before = truth;
            let known = frame.estimate.as_mut().unwrap();
            known.pose = GroundPose {
                x_m: place.0,
                y_m: place.1,
                heading_rad: truth.heading_rad + drift_rad,
                ..truth
            };
            known.covariance[(2, 2)] += density * frame.time_s;
            known.measured.x_m = place.0;
            known.measured.y_m = place.1;
            known.measured.heading_rad = known.pose.heading_rad;
        }
        let fusion = fuse(&frames, &Sensors { heading: heading.clone(), ..Sensors::default() });
        assert_eq!(report(&fusion, SensorKind::Heading).rejected, None);
        for (sums, frames) in [(&mut alone, &frames), (&mut fused, &fusion.frames)] {
            for frame in frames {
                let (pose, truth) = (frame.estimate.as_ref().unwrap().pose, simulation.truth(frame.time_s));
                sums[0] += (pose.x_m - truth.x_m).powi(2) + (pose.y_m - truth.y_m).powi(2);
                sums[1] += (pose.heading_rad - truth.heading_rad).powi(2);
            }
        }
    }
    // Squared errors: the heading error falls to a third, the position error to a half.
    assert!(fused[1] < 0.11 * alone[1] && fused[0] < 0.25 * alone[0], "{alone:?} {fused:?}");
}

#[test]
fn a_range_finder_bounds_scale_drift() {
    // The camera's height and translations grow by 8 % over the drive, within its stated
    // covariance.
    let rig = Rig::level(0.75);
    let effects = Effects {
        height_change: Some(SlowVariation { amplitude: 0.1, period_s: 6.0 }),
        ..Effects::default()
    };
    let simulation = drive(PathKind::Straight { length_m: 20.0 }, 0.5, effects, rig, 7);
    let mut frames = followed(&simulation, (0.0, 0.0, 0.0));
    let last_s = simulation.times_s().last().copied().unwrap();
    let (mut x_m, mut before_m) = (0.0, 0.0);
    for frame in &mut frames {
        let truth = simulation.truth(frame.time_s);
        let scale = 1.0 + 0.08 * frame.time_s / last_s;
        x_m += scale * (truth.x_m - before_m);
        before_m = truth.x_m;
        let known = frame.estimate.as_mut().unwrap();
        known.pose = GroundPose { x_m, height_m: scale * truth.height_m, ..truth };
        known.measured.x_m = x_m;
        known.covariance[(3, 3)] = (0.01f64.powi(2)) * frame.time_s;
    }
    let sensors = simulation.sensors().unwrap();
    let fusion = fuse(&frames, &Sensors { range: sensors.records.range.clone(), ..Sensors::default() });
    let found = report(&fusion, SensorKind::Range);
    assert_eq!(found.rejected, None, "{found:?}");
    assert!(
        (found.offset.unwrap().offset_s - sensors.range.offset_s).abs() < 0.02,
        "{found:?} {:?}",
        sensors.range
    );
    // The height of the camera above the sensor is minus the sensor's bias.
    assert!((found.parameters[0].value + sensors.range.zero).abs() < 0.005, "{found:?} {:?}", sensors.range);
    let last = |frames: &[FrameEstimate]| {
        off_m(&simulation, last_s, &frames.last().unwrap().estimate.as_ref().unwrap().pose)
    };
    assert!(last(&frames) > 0.7, "{}", last(&frames));
    // 0.5 % of 20 m.
    assert!(last(&fusion.frames) < 0.1, "{}", last(&fusion.frames));
}
