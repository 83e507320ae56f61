//! The tilt of the mount that nobody told, learned from frame to frame.

use super::RigEvidence;
use crate::geometry::GroundPose;
use nalgebra::{Matrix2, Matrix3x2, Matrix6, Vector2, Vector3};

/// Roll and pitch that the mount has beside what it was said to have.
///
/// Ground that slopes otherwise than thought makes the camera climb while it drives and roll while it turns, always alike. Height, roll and pitch of a
/// frame follow those of its keyframe, to the first order by a matrix B; where the keyframe was taken to be κ off the mount, and the mount is m off what
/// was said, the frame seems to be Bκ + (1 − B) m off. Every keyframe adds what the last frame that is measured against it tells of m (linear least
/// squares). Height is not among it: from pictures nobody can tell it.
#[derive(Debug, Clone, Default)]
pub struct SteadyTilt {
    /// Of the keyframes that no longer serve.
    settled: Sums,
    /// Of the one that serves, so far.
    serving: Sums,
    /// What is taken for the mount's: nothing until it is beyond doubt.
    found: Option<Vector2<f64>>,
}

/// How far off height, roll and pitch of a frame are (metres, radians) from what the mount was said to be.
#[derive(Debug, Clone, Copy)]
pub struct Off {
    /// The frame's, as its tracks alone have it.
    pub frame: Vector3<f64>,
    /// The keyframe's, as it was taken to be.
    pub keyframe: Vector3<f64>,
    /// What the frame's is not known by: variances.
    pub variances: Vector3<f64>,
    /// How much the camera sways: variances.
    pub sway: Vector3<f64>,
}

impl SteadyTilt {
    /// Roll and pitch beside what the mount was said to have, radians.
    pub fn found(&self) -> Vector2<f64> {
        self.found.unwrap_or_default()
    }

    /// Learns from a frame. Gives how far a steady tilt would make it seem to be off, where there seems to be one.
    pub fn learn(&mut self, evidence: &RigEvidence, off: &Off) -> Option<Vector3<f64>> {
        let b = &evidence.by_keyframe;
        let by_tilt = Matrix3x2::from_fn(|i, k| f64::from(u8::from(i == k + 1)) - b[(i, k + 1)]);
        let by_keyframe = b * off.keyframe;
        // Both may have swayed from the mount, and a keyframe that did makes others climb as one does that is taken for level.
        let variances = off.variances + off.sway + b.component_mul(b) * off.sway;
        self.serving = Sums::of_frame(&by_tilt, &(off.frame - by_keyframe), &variances);
        let all = self.settled.and(&self.serving);
        let tilt = all.tilt();
        (all.significance(&tilt) > LIKELY).then(|| by_keyframe + by_tilt * tilt)
    }

    /// Another keyframe serves from here on; roll and pitch sway by the root of so much, radians². Says whether the tilt is now taken for another.
    pub fn settle(&mut self, sway: f64) -> bool {
        let serving = std::mem::take(&mut self.serving);
        self.settled = self.settled.faded().and(&serving);
        let tilt = self.settled.tilt();
        let is_told = self.settled.keyframes > LEAST_KEYFRAMES
            && self.settled.significance(&tilt) > BEYOND_DOUBT
            && sway < STEADY * STEADY * tilt.norm_squared();
        let is_found = self.found.is_some() || is_told;
        if is_found {
            self.found = Some(tilt);
        }
        is_found
    }
}

/// Normal equations of the tilt.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    information: Matrix2<f64>,
    moment: Vector2<f64>,
    /// Of what was seen, each over its variance.
    squares: f64,
    keyframes: f64,
}

impl Sums {
    fn of_frame(by_tilt: &Matrix3x2<f64>, seen: &Vector3<f64>, variances: &Vector3<f64>) -> Self {
        let weighted = Matrix3x2::from_fn(|i, k| by_tilt[(i, k)] / variances[i]);
        Self {
            information: weighted.tr_mul(by_tilt),
            moment: weighted.tr_mul(seen),
            squares: seen.component_mul(seen).component_div(variances).sum(),
            keyframes: 1.0,
        }
    }

    fn and(&self, other: &Self) -> Self {
        Self {
            information: self.information + other.information,
            moment: self.moment + other.moment,
            squares: self.squares + other.squares,
            keyframes: self.keyframes + other.keyframes,
        }
    }

    fn faded(&self) -> Self {
        Self {
            information: KEPT * self.information,
            moment: KEPT * self.moment,
            squares: KEPT * self.squares,
            keyframes: KEPT * self.keyframes,
        }
    }

    fn tilt(&self) -> Vector2<f64> {
        let information = self.information + Matrix2::identity() / (USUAL_TILT * USUAL_TILT);
        information.cholesky().map_or(Vector2::zeros(), |information| information.solve(&self.moment))
    }

    /// Of how many squared standard deviations the tilt is, less where it does not explain what was seen: what sways makes one keyframe climb and the
    /// next descend.
    fn significance(&self, tilt: &Vector2<f64>) -> f64 {
        let by_tilt = (self.information * tilt).dot(tilt);
        let unexplained = self.squares - 2.0 * self.moment.dot(tilt) + by_tilt;
        let spare = (3.0 * self.keyframes - 2.0).max(1.0);
        by_tilt / (unexplained / spare).max(1.0)
    }
}

/// What a tilt is before anything was seen, one standard deviation, radians: larger ones are seen by whoever mounts the camera.
const USUAL_TILT: f64 = 0.05;

/// Weight that all earlier keyframes keep: about the last two hundred count.
const KEPT: f64 = 0.995;

/// A tilt of so many squared standard deviations is rather seen than not (of two numbers: one time in a hundred by chance).
const LIKELY: f64 = 9.0;

/// The same for one that is taken for the mount's, and between how many keyframes it must have held at least: a slow sway looks like it over one.
const BEYOND_DOUBT: f64 = 36.0;
const LEAST_KEYFRAMES: f64 = 2.5;

/// A tilt is that of the mount, and not of a hand or of a spring, where it sways by less than this part of itself.
const STEADY: f64 = 1.0 / 3.0;

/// The mount is known to be otherwise than was thought: (height, roll, pitch), metres and radians.
#[derive(Debug, Clone, Copy)]
pub struct MountChange {
    /// As it was thought to be.
    pub before: [f64; 3],
    /// As it is known to be.
    pub now: [f64; 3],
    /// Which of the three do not sway.
    pub steady: [bool; 3],
    /// How far the camera has gone with the mount as it was thought to be, metres.
    pub driven_m: f64,
}

impl MountChange {
    /// Moves the height and tilt of a keyframe: to those of the mount where these are steady, otherwise as far as the mount has moved, unless the tracks
    /// had found it there already.
    pub fn set_right(&self, pose: &mut GroundPose) {
        let values = [&mut pose.height_m, &mut pose.roll_rad, &mut pose.pitch_rad];
        for (i, value) in values.into_iter().enumerate() {
            let moved = *value + self.now[i] - self.before[i];
            if self.steady[i] {
                *value = self.now[i];
            } else if (moved - self.now[i]).abs() < (*value - self.now[i]).abs() {
                *value = moved;
            }
        }
    }

    /// What the way up to here may have become wrong by: covariance of (x, y, heading, height, roll, pitch). Ground that slopes sideways is seen faster on
    /// one side than on the other, and half of that is taken for a turn; what slopes along the way makes it as much too long or too short.
    pub fn of_the_way(&self) -> Matrix6<f64> {
        let tilt_rad = (self.now[1] - self.before[1]).hypot(self.now[2] - self.before[2]);
        let turn_rad = 0.5 * tilt_rad * self.driven_m / self.now[0];
        let shift_m = 0.5 * turn_rad * self.driven_m;
        let sigmas = [shift_m, shift_m, turn_rad, 0.0, 0.0, 0.0];
        Matrix6::from_diagonal(&sigmas.map(|sigma| sigma * sigma).into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::Random;
    use nalgebra::Matrix3;

    /// A frame that was measured a way (metres, along the keyframe's axes) and a turn away from its keyframe, which is taken to be on the mount.
    fn evidence(way: [f64; 2], turn_rad: f64) -> RigEvidence {
        let (sin, cos) = turn_rad.sin_cos();
        let by_keyframe = Matrix3::new(1.0, -way[1], way[0], 0.0, cos, sin, 0.0, -sin, cos);
        RigEvidence { value: [0.0; 3], variance: [1e-10; 3], by_keyframe }
    }

    fn off(evidence: &RigEvidence, mount: [f64; 2], sway: [f64; 3]) -> Off {
        let tilt = Vector3::new(0.0, mount[0], mount[1]);
        Off {
            frame: tilt - evidence.by_keyframe * tilt + Vector3::from(sway),
            keyframe: Vector3::zeros(),
            variances: Vector3::from(evidence.variance),
            sway: Vector3::zeros(),
        }
    }

    /// The ways and turns of some keyframes.
    const WAYS: [([f64; 2], f64); 6] = [
        ([0.2, 0.0], 0.0),
        ([0.2, 0.01], 0.1),
        ([0.19, 0.05], 0.4),
        ([0.2, -0.02], -0.2),
        ([0.2, 0.0], 0.0),
        ([0.18, 0.06], 0.3),
    ];

    #[test]
    fn a_tilt_that_stays_is_found() {
        let mut steady = SteadyTilt::default();
        let mount = [0.004, -0.007];
        for (n, (way, turn)) in WAYS.into_iter().enumerate() {
            let evidence = evidence(way, turn);
            let off = off(&evidence, mount, [0.0; 3]);
            let explained = steady.learn(&evidence, &off).expect("a tilt that is seen");
            assert!((explained - off.frame).norm() < 1e-6, "{explained} is not {}", off.frame);
            assert_eq!(steady.settle(0.0), n >= 2, "after {} keyframes", n + 1);
        }
        // The tilt that is usual pulls by the square of noise over it.
        assert!((steady.found() - Vector2::from(mount)).norm() < 1e-6, "{}", steady.found());
    }

    #[test]
    fn a_keyframe_that_is_off_the_mount_tells_the_same() {
        let mut steady = SteadyTilt::default();
        let (mount, keyframe) = ([0.004, -0.007], Vector3::new(0.001, 0.003, 0.002));
        for (way, turn) in WAYS {
            let evidence = evidence(way, turn);
            let mut off = off(&evidence, mount, [0.0; 3]);
            (off.keyframe, off.frame) = (keyframe, off.frame + evidence.by_keyframe * keyframe);
            steady.learn(&evidence, &off);
            steady.settle(0.0);
        }
        assert!((steady.found() - Vector2::from(mount)).norm() < 1e-6, "{}", steady.found());
    }

    #[test]
    fn a_sway_is_no_tilt() {
        let mut random = Random::new(5);
        let mut uniform = move || (random.bits() >> 11) as f64 / (1u64 << 53) as f64 - 0.5;
        let mut steady = SteadyTilt::default();
        for (n, (way, turn)) in WAYS.into_iter().cycle().take(300).enumerate() {
            let evidence = evidence(way, turn);
            let sway = [1e-3, 3e-3, 3e-3].map(|most| most * uniform());
            steady.learn(&evidence, &off(&evidence, [0.0; 2], sway));
            assert!(!steady.settle(0.0), "taken for a tilt after {} keyframes: {:?}", n + 1, steady.found());
        }
    }

    #[test]
    fn a_tilt_that_sways_as_much_is_not_that_of_the_mount() {
        let mut steady = SteadyTilt::default();
        for (way, turn) in WAYS.into_iter().cycle().take(60) {
            let evidence = evidence(way, turn);
            steady.learn(&evidence, &off(&evidence, [0.004, -0.007], [0.0; 3]));
            assert!(!steady.settle(0.004 * 0.004));
        }
        assert!(steady.settle(0.001 * 0.001), "it came to rest");
    }

    #[test]
    fn keyframes_go_where_the_mount_is() {
        let change = MountChange {
            before: [1.0, 0.0, 0.0],
            now: [1.0, 0.01, -0.02],
            steady: [true, false, false],
            driven_m: 1.0,
        };
        let mut pose = GroundPose {
            x_m: 1.0,
            y_m: 2.0,
            heading_rad: 3.0,
            height_m: 1.002,
            roll_rad: 0.001,
            pitch_rad: -0.021,
        };
        let before = pose;
        change.set_right(&mut pose);
        assert_eq!(pose.height_m, 1.0);
        assert_eq!(pose.roll_rad, 0.011);
        assert_eq!(pose.pitch_rad, before.pitch_rad, "it was found there already");
        assert_eq!((pose.x_m, pose.y_m, pose.heading_rad), (before.x_m, before.y_m, before.heading_rad));
    }
}
