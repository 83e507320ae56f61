//! Where the camera was last, and so where it should be next.

use crate::geometry::GroundPose;
use nalgebra::Matrix6;

/// The last measured pose, from which the next is predicted.
#[derive(Debug, Clone)]
pub struct LastPose {
    pub time_s: f64,
    pub pose: GroundPose,
    pub covariance: Matrix6<f64>,
    /// Change per second of x, y and heading.
    pub rates: [f64; 3],
    /// The time from the measured pose before.
    pub step_s: f64,
    /// How far off the extrapolations to the last poses were, seen from the camera: lengths over the height, and radians.
    pub off_by: f64,
}

impl LastPose {
    pub fn still(time_s: f64, pose: GroundPose, covariance: Matrix6<f64>) -> Self {
        Self { time_s, pose, covariance, rates: [0.0; 3], step_s: 0.0, off_by: f64::INFINITY }
    }

    pub fn moved(self, time_s: f64, pose: GroundPose, covariance: Matrix6<f64>) -> Self {
        let step_s = time_s - self.time_s;
        let rates = if step_s > 0.0 {
            let before = self.pose;
            [pose.x_m - before.x_m, pose.y_m - before.y_m, pose.heading_rad - before.heading_rad]
                .map(|change| change / step_s)
        } else {
            self.rates
        };
        let off_by = seen_apart(&self.extrapolated(time_s), &pose);
        // After `still` the rates are a guess; a large surprise is remembered for a few frames.
        let remembered = if self.step_s > 0.0 { 0.7 * self.off_by } else { 0.0 };
        let off_by = if step_s > 0.0 { off_by.max(remembered) } else { f64::INFINITY };
        Self { time_s: time_s.max(self.time_s), pose, covariance, rates, step_s, off_by }
    }

    /// The pose at `time_s` had the camera gone on as it went; height and tilt stay.
    pub fn extrapolated(&self, time_s: f64) -> GroundPose {
        let step_s = (time_s - self.time_s).max(0.0);
        GroundPose {
            x_m: self.pose.x_m + self.rates[0] * step_s,
            y_m: self.pose.y_m + self.rates[1] * step_s,
            heading_rad: self.pose.heading_rad + self.rates[2] * step_s,
            ..self.pose
        }
    }

    /// How far off [`LastPose::extrapolated`] may be over a gap: the camera may have stopped or doubled its speed (two standard deviations), and
    /// may have set off from rest at 0.2 m/s and 0.2 rad/s.
    pub fn gap_covariance(&self, time_s: f64) -> Matrix6<f64> {
        let gap_s = (time_s - self.time_s).max(0.0);
        let variance = |rate: f64| ((0.5 * rate.abs() + 0.1) * gap_s).powi(2);
        let mut covariance = Matrix6::zeros();
        let speed = self.rates[0].hypot(self.rates[1]);
        covariance[(0, 0)] = variance(speed);
        covariance[(1, 1)] = variance(speed);
        covariance[(2, 2)] = variance(self.rates[2]);
        covariance
    }
}

/// How far apart the same ground is seen from two poses, at most and roughly: lengths over the height, and radians.
fn seen_apart(a: &GroundPose, b: &GroundPose) -> f64 {
    let moved_m = (a.x_m - b.x_m).hypot(a.y_m - b.y_m) + (a.height_m - b.height_m).abs();
    let turns = [a.heading_rad - b.heading_rad, a.roll_rad - b.roll_rad, a.pitch_rad - b.pitch_rad];
    moved_m / b.height_m + turns.map(f64::abs).iter().sum::<f64>()
}
