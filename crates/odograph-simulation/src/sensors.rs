//! Simulated low-cost sensors on the vehicle, with their typical errors.

use super::noise::{GaussianStream, mix, uniform};
use super::sequence::Simulation;
use odograph::error::Result;
use odograph::filter::fusion::{Quantity, SensorRecord, Sensors};
use odograph::geometry::{GroundPoint, GroundPose};
use serde::Serialize;

/// Errors of one sensor.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SensorErrors {
    /// Clock offset: sensor time minus camera time, seconds.
    pub offset_s: f64,
    /// Scale factor of the readings.
    pub scale: f64,
    /// Additive offset: bias of a gyroscope (rad/s), zero of a compass (radians) or of a range
    /// finder (metres).
    pub zero: f64,
    /// Standard deviation of the noise of a reading.
    pub noise: f64,
}

/// Sensor records of a simulated drive with the true errors.
#[derive(Debug, Clone)]
pub struct SimulatedSensors {
    /// Gyroscope at 100 Hz, compass at 20 Hz, wheel odometer at 50 Hz and range finder at 25 Hz.
    pub records: Sensors,
    /// Errors of the gyroscope.
    pub gyro: SensorErrors,
    /// Errors of the compass.
    pub heading: SensorErrors,
    /// Errors of the wheel odometer.
    pub wheel: SensorErrors,
    /// Errors of the range finder.
    pub range: SensorErrors,
}

/// Time by which the records begin before the first and end after the last frame, seconds.
const MARGIN_S: f64 = 1.5;

impl Simulation {
    /// Sensors on the same vehicle; the seed of the simulation determines their errors. The wheel
    /// measures the speed along the vehicle's forward direction at the ground point below the
    /// camera, without the vibration of the camera.
    pub fn sensors(&self) -> Result<SimulatedSensors> {
        let seed = |number: u64| mix(self.config().seed ^ (0x5E45 << 20) ^ number);
        // Uniform in [−1, 1).
        let either = |number: u64| 2.0 * uniform(seed(number), 0) - 1.0;
        let errors = |number: u64, scale: f64, zero: f64, noise: f64| SensorErrors {
            offset_s: 0.08 * either(10 * number),
            scale: 1.0 + scale * either(10 * number + 1),
            zero: zero * either(10 * number + 2),
            noise,
        };
        let gyro = errors(1, 0.01, 0.02, 0.005);
        let heading = errors(2, 0.0, 3.0, 0.02);
        let wheel = errors(3, 0.03, 0.0, 0.01);
        let range = errors(4, 0.0, 0.1, 0.003);
        const HALF_S: f64 = 0.001;
        let rate = |of: &dyn Fn(f64) -> f64, t: f64| (of(t + HALF_S) - of(t - HALF_S)) / (2.0 * HALF_S);
        let truth = |of: fn(&GroundPose) -> f64| move |t: f64| of(&self.truth(t));
        let over_ground = |t: f64| {
            let pose = self.truth(t);
            pose.height_m - self.ground_level_m(GroundPoint::new(pose.x_m, pose.y_m))
        };
        let speed = |t: f64| {
            let (path, rig) = (&self.config().path, &self.config().rig);
            let along = |of: fn(&GroundPose) -> f64| rate(&|t| of(&path.pose(t, rig)), t);
            let (sin, cos) = (path.pose(t, rig).heading_rad - rig.yaw_rad).sin_cos();
            cos * along(|pose| pose.x_m) + sin * along(|pose| pose.y_m)
        };
        let record = |quantity, hz: f64, errors: &SensorErrors, number: u64, of: &dyn Fn(f64) -> f64| {
            let last_s = self.times_s().last().copied().unwrap_or(0.0);
            let count = ((last_s + 2.0 * MARGIN_S) * hz).ceil() as usize;
            let mut noise = GaussianStream::new(seed(10 * number + 3));
            let (times_s, values) = (0..=count)
                .map(|i| {
                    let time_s = i as f64 / hz - MARGIN_S;
                    let value = errors.scale * of(time_s) + errors.zero;
                    (time_s + errors.offset_s, value + errors.noise * f64::from(noise.sample()))
                })
                .unzip();
            SensorRecord::new(quantity, times_s, vec![values])
        };
        let heading_of = truth(|pose| pose.heading_rad);
        let records = Sensors {
            gyro: Some(record(Quantity::TurnRate, 100.0, &gyro, 1, &|t| rate(&heading_of, t))?),
            heading: Some(record(Quantity::Heading, 20.0, &heading, 2, &heading_of)?),
            wheel: Some(record(Quantity::Speed, 50.0, &wheel, 3, &speed)?),
            range: Some(record(Quantity::Height, 25.0, &range, 4, &over_ground)?),
        };
        Ok(SimulatedSensors { records, gyro, heading, wheel, range })
    }
}
