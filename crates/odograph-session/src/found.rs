//! Results of self-calibration that differ from the plan, as sentences and for `stats.json`.

use crate::plan::RunPlan;
use odograph::camera::{Camera, Rig};
use odograph::fixed_pattern::{ImageMask, NonuniformityCorrection};
use odograph::formats::decimal::Rounded;
use odograph::motion::MotionModel;
use odograph::mounting::{CalibrationUpdate, LensMeasurement, TiltMeasurement};
use odograph::odometry::Odometry;
use serde::Serialize;
use std::sync::Arc;

/// The part of the image that was ignored because it is static.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FixedInImage {
    /// Fraction of the image, 0 to 1.
    pub share: f64,
    /// Root mean square of the pattern that was subtracted from every image, gray levels; left out
    /// where there was none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pattern_gray: Option<f64>,
    /// Where it is; `None` where nothing is.
    #[serde(skip)]
    pub mask: Option<Arc<ImageMask>>,
}

impl FixedInImage {
    pub(crate) fn of(odometry: &Odometry) -> Self {
        let pattern_gray = odometry.correction().map(NonuniformityCorrection::rms_gray);
        Self { share: odometry.masked_share(), pattern_gray, mask: odometry.mask() }
    }

    /// Up to two lines; empty where there is nothing to say.
    pub fn sentence(&self) -> String {
        const WORTH_TELLING: f64 = 0.01;
        let mut sentence = match self.pattern_gray {
            Some(gray) => format!(
                "the camera adds a pattern of {gray:.1} gray levels to every image (dirt on the lens, sensor \
                 noise); it was estimated and subtracted\n"
            ),
            None => String::new(),
        };
        if self.share > WORTH_TELLING {
            let percent = 100.0 * self.share;
            sentence += &format!(
                "{percent:.0} % of the image does not move with the ground and is ignored; see mask.png\n"
            );
        }
        sentence
    }
}

/// Estimated mount of the camera.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FoundMount {
    /// Nominal roll from the vertical, degrees.
    #[serde(rename = "told_roll_deg")]
    pub given_roll_deg: f64,
    /// Nominal pitch from the vertical, degrees.
    #[serde(rename = "told_pitch_deg")]
    pub given_pitch_deg: f64,
    /// Estimated roll, degrees.
    pub roll_deg: f64,
    /// Estimated pitch, degrees.
    pub pitch_deg: f64,
    /// Standard deviation of that roll, degrees.
    pub roll_deviation_deg: f64,
    /// Standard deviation of that pitch, degrees.
    pub pitch_deviation_deg: f64,
}

impl FoundMount {
    /// The mount where self-calibration found another tilt than the given rig's.
    pub(crate) fn of(given: &Rig, found: Option<&CalibrationUpdate>) -> Option<Self> {
        Some(Self::new(given, found?.tilt.as_ref()?))
    }

    fn new(given: &Rig, found: &TiltMeasurement) -> Self {
        Self {
            given_roll_deg: given.roll_rad.to_degrees(),
            given_pitch_deg: given.pitch_rad.to_degrees(),
            roll_deg: found.roll_rad.to_degrees(),
            pitch_deg: found.pitch_rad.to_degrees(),
            roll_deviation_deg: found.covariance[(0, 0)].sqrt().to_degrees(),
            pitch_deviation_deg: found.covariance[(1, 1)].sqrt().to_degrees(),
        }
    }

    /// A warning for people after a live run.
    pub fn live_sentence(&self) -> String {
        self.and("estimated while driving and used from then on, and the path before it is bent: give both with --rig")
    }

    /// A warning for people.
    pub fn sentence(&self) -> String {
        self.and("found in the recording and used")
    }

    /// Both mounts, and what was done; a rig with a height alone looks straight down.
    fn and(&self, done: &str) -> String {
        let given = match (self.given_roll_deg, self.given_pitch_deg) {
            (0.0, 0.0) => "looking straight down".to_owned(),
            (roll, pitch) => format!("at {} and {} as given", angle(roll), angle(pitch)),
        };
        let [roll, pitch] = [self.roll_deg, self.pitch_deg].map(angle);
        format!(
            "the camera is mounted at a roll of {roll} and a pitch of {pitch}, not {given}; this was {done}"
        )
    }
}

/// Estimated lens distortion.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FoundLens {
    /// The estimated coefficients.
    pub coefficients: Vec<FoundCoefficient>,
    /// Largest error of the nominal calibration at the edge of the image, pixels.
    pub off_px: f64,
    /// Standard deviation of that, pixels.
    pub deviation_px: f64,
}

/// A coefficient of the lens.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FoundCoefficient {
    /// Its name.
    pub name: &'static str,
    /// Nominal value.
    #[serde(rename = "told")]
    pub given: f64,
    /// Estimated value.
    pub found: f64,
    /// Standard deviation of the estimate.
    pub deviation: f64,
}

impl FoundLens {
    /// The lens where self-calibration found another one than the given camera's.
    pub(crate) fn of(given: &Camera, found: Option<&CalibrationUpdate>) -> Option<Self> {
        Some(Self::new(given, found?.lens.as_ref()?))
    }

    fn new(given: &Camera, found: &LensMeasurement) -> Self {
        let both = found.coefficients.iter().zip(found.coefficients_of(given));
        let coefficients = both.map(|(found, given)| FoundCoefficient {
            name: found.name,
            given,
            found: found.value,
            deviation: found.deviation,
        });
        Self {
            coefficients: coefficients.collect(),
            off_px: found.off_from_px(given),
            deviation_px: found.deviation_px,
        }
    }

    /// A warning for people.
    pub fn sentence(&self) -> String {
        let of = |value: fn(&FoundCoefficient) -> f64| {
            let all = self.coefficients.iter().map(|known| match known.name {
                // Pixels.
                "cx" | "cy" | "fy" => format!("{} {:.2}", known.name, value(known)),
                name => format!("{name} {:+.5}", Rounded(value(known))),
            });
            all.collect::<Vec<_>>().join(", ")
        };
        format!(
            "the lens has {}, not {} as in the camera file, a difference of {:.1} px at the edge of the image: the path was followed with \
             the estimate, which is in camera-found.yaml; odograph calibrate measures it, --motion rigid insists on the camera file",
            of(|known| known.found),
            of(|known| known.given),
            self.off_px
        )
    }
}

/// The readout time of the image.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FoundReadout {
    /// From the exposure of the first row to that of the last, milliseconds.
    pub readout_ms: f64,
    /// Standard deviation; 0 where it was given or the shutter is global.
    pub deviation_ms: f64,
    /// Whether it was given rather than estimated.
    pub given: bool,
    /// Whether height and tilt were fixed ([`MotionModel::Rigid`]): it is hardly estimated then.
    #[serde(skip)]
    pub is_fixed_mount: bool,
}

/// Largest standard deviation of a known readout time, seconds: at 0.5 m/s over a view of 0.5 m it
/// makes distances uncertain by 0.1 %.
const KNOWN_READOUT_S: f64 = 1e-3;

/// A shutter is global, which no one needs to hear, if its readout time is zero to this,
/// milliseconds.
const GLOBAL_WITHIN_MS: f64 = 0.1;

/// A readout time within this many standard deviations of zero may be that of a global shutter.
const GLOBAL_SIGMAS: f64 = 3.0;

impl FoundReadout {
    /// The readout time at the end of a run; `None` where the shutter was taken to be global.
    pub(crate) fn of(plan: &RunPlan, odometry: &Odometry) -> Option<Self> {
        let camera = &plan.camera;
        let readout = odometry.readout().filter(|_| odometry.readout_matters())?;
        Some(Self {
            readout_ms: 1e3 * readout.mean_s,
            deviation_ms: 1e3 * readout.variance_s2.sqrt(),
            // An estimated readout time has a standard deviation.
            given: camera.readout_s().is_some() && camera.readout_deviation_s() == 0.0,
            is_fixed_mount: plan.odometry.motion.model == MotionModel::Rigid,
        })
    }

    /// Whether it is known well enough not to make distances uncertain.
    pub fn is_known(&self) -> bool {
        self.deviation_ms <= 1e3 * KNOWN_READOUT_S
    }

    /// A warning for people.
    pub fn sentence(&self) -> Option<String> {
        let Self { readout_ms, deviation_ms, given, is_fixed_mount } = *self;
        if given || (readout_ms == 0.0 && deviation_ms <= GLOBAL_WITHIN_MS) {
            return None;
        }
        let why_not = match is_fixed_mount {
            true => "with height and tilt fixed (--motion rigid, --field-of-view)",
            false => "because the drive has too few turns and changes of speed, or can be read only once",
        };
        let may_be_global = readout_ms.abs() <= GLOBAL_SIGMAS * deviation_ms;
        Some(match (self.is_known(), may_be_global) {
            (true, true) => format!(
                "the shutter is global: the readout time was found to be {readout_ms:.2} ± {deviation_ms:.2} ms; --readout-ms 0, or \
                 readout_time_s in a camera file, gives it from the start"
            ),
            (true, false) => format!(
                "the camera has a rolling shutter: the image is read in {readout_ms:.2} ± {deviation_ms:.2} ms; \
                 --readout-ms, or readout_time_s in a camera file, gives it from the start"
            ),
            (false, true) => format!(
                "the readout time of the image ({readout_ms:.1} ± {deviation_ms:.1} ms) could not be learned {why_not}; \
                 --readout-ms gives it, and 0 says that the shutter is global"
            ),
            (false, false) => format!(
                "the camera has a rolling shutter: the image is read in about {readout_ms:.1} ± {deviation_ms:.1} ms, which \
                 leaves distances somewhat uncertain; more turns and changes of speed, or --readout-ms, make it certain"
            ),
        })
    }
}

/// An angle with its sign; one that rounds to zero has none of its own.
fn angle(degrees: f64) -> String {
    format!("{:+.2}°", Rounded(degrees))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_angle_that_rounds_to_zero_is_not_negative() {
        assert_eq!([-0.004, 0.004, -0.006, 3.0].map(angle), ["+0.00°", "+0.00°", "-0.01°", "+3.00°"]);
    }

    #[test]
    fn a_readout_time_of_nothing_is_a_global_shutter() {
        let sentence = |readout_ms, deviation_ms, given| {
            FoundReadout { readout_ms, deviation_ms, given, is_fixed_mount: false }
                .sentence()
                .unwrap_or_default()
        };
        assert!(sentence(0.0, 0.27, false).contains("the shutter is global"));
        assert!(sentence(-0.3, 0.27, false).contains("the shutter is global"));
        assert!(sentence(19.8, 0.27, false).contains("rolling shutter: the image is read in 19.80"));
        assert!(sentence(3.0, 4.0, false).contains("could not be learned"));
        // Estimated, but not to a millisecond.
        assert!(sentence(19.0, 1.4, false).contains("is read in about 19.0 ± 1.4 ms"));
        assert_eq!(sentence(20.0, 0.0, true), "");
        // An eight that is driven has turns enough.
        let fixed = FoundReadout { readout_ms: 0.0, deviation_ms: 10.0, given: false, is_fixed_mount: true };
        assert!(
            fixed
                .sentence()
                .is_some_and(|text| text.contains("could not be learned with height and tilt fixed"))
        );
    }
}
