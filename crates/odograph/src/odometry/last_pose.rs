//! Where the camera was last, and so where it should be next.

use crate::geometry::{GroundPose, Ray};
use crate::motion::PoseRates;
use nalgebra::{Matrix6, Vector3};

/// The last measured pose, from which the next is predicted.
#[derive(Debug, Clone)]
pub struct LastPose {
    pub time_s: f64,
    pub pose: GroundPose,
    pub covariance: Matrix6<f64>,
    /// Change per second of x, y and heading.
    pub rates: [f64; 3],
    /// Mean rates of all six numbers since the measured pose before, or, if that was a relocation,
    /// until then; `None` where there is none.
    pub pose_rates: Option<PoseRates>,
    /// Change per second of the rates.
    accelerations: [f64; 3],
    /// The time from the measured pose before.
    pub step_s: f64,
    /// Recent extrapolation errors of each model of the motion, seen from the camera: lengths over
    /// the height, and radians.
    off_by: [f64; MODELS.len()],
}

/// How the pose goes on from one frame to the next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum MotionPrediction {
    /// Position and heading at constant velocity; height and tilt stay.
    Level,
    /// The same at constant acceleration.
    Accelerated,
    /// All six numbers at constant velocity, so that the image moves as before. A shift and a tilt
    /// that cancel in the image are hard to tell apart: their rates are only right together.
    Free,
}

const MODELS: [MotionPrediction; 3] =
    [MotionPrediction::Level, MotionPrediction::Accelerated, MotionPrediction::Free];

/// A jump exceeds both this (lengths over the height, and radians) and this multiple of the recent
/// prediction errors. Chosen on a flight over a checkerboard, where a jump by one square is 0.06.
const JUMP: f64 = 0.03;
const JUMP_OVER_USUAL: f64 = 5.0;

/// A longer step than this many of the last is a gap.
pub const USUAL_STEP: f64 = 1.5;

/// Decay per frame of the largest error of the extrapolation.
const ERROR_DECAY: f64 = 0.7;

impl LastPose {
    pub fn still(time_s: f64, pose: GroundPose, covariance: Matrix6<f64>) -> Self {
        Self {
            time_s,
            pose,
            covariance,
            rates: [0.0; 3],
            pose_rates: None,
            accelerations: [0.0; 3],
            step_s: 0.0,
            off_by: [f64::INFINITY; MODELS.len()],
        }
    }

    pub fn moved(self, time_s: f64, pose: GroundPose, covariance: Matrix6<f64>) -> Self {
        let step_s = time_s - self.time_s;
        if step_s <= 0.0 {
            let off_by = [f64::INFINITY; MODELS.len()];
            return Self { time_s: self.time_s.max(time_s), pose, covariance, step_s, off_by, ..self };
        }
        let before = self.pose;
        let rates = [pose.x_m - before.x_m, pose.y_m - before.y_m, pose.heading_rad - before.heading_rad]
            .map(|change| change / step_s);
        let jumps = self.is_a_jump(time_s, &pose);
        let rates = if jumps { self.rates } else { rates };
        // The rates are those of the middles of the two steps.
        let between_s = 0.5 * (step_s + self.step_s);
        let accelerations = [0, 1, 2].map(|i| (rates[i] - self.rates[i]) / between_s);
        let off_by = std::array::from_fn(|model| {
            let off_by = seen_apart(&self.predicted(time_s, MODELS[model]), &pose);
            match self.off_by[model] {
                // The distance of a relocation is no error of the motion model.
                before if jumps => before,
                // After `still` the rates are a guess, and a step later the accelerations.
                before if before.is_finite() => off_by.max(ERROR_DECAY * before),
                _ if MODELS[model] != MotionPrediction::Level && self.step_s == 0.0 => f64::INFINITY,
                _ => off_by,
            }
        });
        let pose_rates =
            if jumps { self.pose_rates } else { Some((pose.to_vector() - before.to_vector()) / step_s) };
        Self { time_s, pose, covariance, rates, pose_rates, accelerations, step_s, off_by }
    }

    /// Whether a pose is a relocation (the next tile of a floor, another keyframe) rather than a
    /// movement: the velocity is then kept.
    fn is_a_jump(&self, time_s: f64, pose: &GroundPose) -> bool {
        let off_by = seen_apart(&self.extrapolated(time_s), pose);
        self.off_by().is_finite() && off_by > JUMP.max(JUMP_OVER_USUAL * self.off_by())
    }

    /// The pose extrapolated to `time_s` by the model that predicted the last poses best.
    pub fn extrapolated(&self, time_s: f64) -> GroundPose {
        let best =
            (1..MODELS.len()).fold(0, |best, i| if self.off_by[i] < self.off_by[best] { i } else { best });
        self.predicted(time_s, MODELS[best])
    }

    /// The pose at `time_s` by each model, and where the camera stands still.
    pub fn predictions(&self, time_s: f64) -> [GroundPose; MODELS.len() + 1] {
        let [level, accelerated, free] = MODELS.map(|model| self.predicted(time_s, model));
        [level, accelerated, free, self.pose]
    }

    /// Recent extrapolation error, seen from the camera: lengths over the height, and radians.
    pub fn off_by(&self) -> f64 {
        self.off_by.iter().copied().fold(f64::INFINITY, f64::min)
    }

    /// The pose at `time_s` by one model.
    fn predicted(&self, time_s: f64, model: MotionPrediction) -> GroundPose {
        let step_s = (time_s - self.time_s).max(0.0);
        if let (MotionPrediction::Free, Some(rates)) = (model, &self.pose_rates) {
            // Height and tilt do not go on over a gap.
            let brief_s = if step_s < USUAL_STEP * self.step_s { step_s } else { 0.0 };
            let durations = PoseRates::new(step_s, step_s, step_s, brief_s, brief_s, brief_s);
            return GroundPose::from_vector(&(self.pose.to_vector() + rates.component_mul(&durations)));
        }
        let share = if model == MotionPrediction::Accelerated { 1.0 } else { 0.0 };
        // An acceleration does not last: over a gap it continues for one more step.
        let accelerated_s = step_s.min(self.step_s.max(0.0));
        let further = |i: usize| {
            let gained = share * self.accelerations[i] * accelerated_s * 0.5 * (step_s + self.step_s);
            self.rates[i] * step_s + gained
        };
        GroundPose {
            x_m: self.pose.x_m + further(0),
            y_m: self.pose.y_m + further(1),
            heading_rad: self.pose.heading_rad + further(2),
            ..self.pose
        }
    }

    /// The pose at `time_s` after motion at the mean velocity, which continues.
    pub fn extrapolated_over_gap(&self, time_s: f64) -> Self {
        let covariance = self.covariance + self.gap_covariance(time_s);
        Self { time_s, pose: self.extrapolated(time_s), covariance, pose_rates: None, ..self.clone() }
    }

    /// Covariance of [`LastPose::extrapolated`] over a gap: the camera may have stopped or doubled
    /// its speed (two standard deviations), and may have started from rest at 0.2 m/s and 0.2
    /// rad/s.
    fn gap_covariance(&self, time_s: f64) -> Matrix6<f64> {
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

/// Largest distance between the images of the same ground seen from two poses, over the focal
/// length: at the centre and the corners of a view of 0.8 by 0.6.
pub fn seen_apart(a: &GroundPose, b: &GroundPose) -> f64 {
    const VIEW: [(f64, f64); 5] = [(0.0, 0.0), (0.4, 0.3), (-0.4, 0.3), (0.4, -0.3), (-0.4, -0.3)];
    let camera_from_world = a.world_from_camera_rotation().transpose();
    let apart = |(x, y): (f64, f64)| {
        let ground = b.ground_from_ray(Ray::new(x, y))?;
        let seen = camera_from_world * Vector3::new(ground.x_m - a.x_m, ground.y_m - a.y_m, -a.height_m);
        (seen.z > 0.0).then(|| (seen.x / seen.z - x).hypot(seen.y / seen.z - y))
    };
    VIEW.into_iter().map(|ray| apart(ray).unwrap_or(f64::INFINITY)).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_relocation_changes_no_prediction_of_the_motion() {
        let at = |x_m: f64| GroundPose { x_m, ..GroundPose::level(0.75) };
        let mut last = LastPose::still(0.0, at(0.0), Matrix6::zeros());
        for frame in 1..10 {
            last = last.moved(0.1 * f64::from(frame), at(0.01 * f64::from(frame)), Matrix6::zeros());
        }
        let usual = last.off_by();
        // A tile of 0.2 m back, twice in a row: the second is a relocation, too.
        for (frame, x_m) in [(10, -0.1), (11, -0.3)] {
            last = last.moved(0.1 * f64::from(frame), at(x_m), Matrix6::zeros());
            for prediction in &last.predictions(0.1 * f64::from(frame + 1))[..MODELS.len()] {
                assert!((prediction.x_m - x_m - 0.01).abs() < 1e-9, "{}", prediction.x_m);
            }
            assert_eq!(last.off_by(), usual);
        }
    }
}
