//! What a recording said of its camera that was not as it was told, for people and for
//! `stats.json`.

use odograph::camera::{Camera, Rig};
use odograph::image::GrayImage;
use odograph::mounting::{LensMeasurement, TiltMeasurement};
use odograph::odometry::Odometry;
use serde::Serialize;

/// What of the image was ignored because it does not move with the ground.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FixedInImage {
    /// The part of the image, 0 to 1.
    pub share: f64,
    /// White is ground.
    #[serde(skip)]
    pub picture: GrayImage,
}

impl FixedInImage {
    pub(crate) fn of(odometry: &Odometry) -> Self {
        let fixed = odometry.fixed_in_image();
        Self { share: fixed.share(), picture: fixed.picture() }
    }

    /// For people, a line; nothing where it is next to nothing.
    pub fn sentence(&self) -> String {
        const WORTH_TELLING: f64 = 0.01;
        if self.share <= WORTH_TELLING {
            return String::new();
        }
        let percent = 100.0 * self.share;
        format!("{percent:.0} % of the image does not move with the ground and is ignored; see mask.png\n")
    }
}

/// How the camera was found to sit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FoundMount {
    /// Roll against straight down as it was told, degrees.
    pub told_roll_deg: f64,
    /// Pitch against straight down as it was told, degrees.
    pub told_pitch_deg: f64,
    /// Roll as the recording has it, degrees.
    pub roll_deg: f64,
    /// Pitch as the recording has it, degrees.
    pub pitch_deg: f64,
    /// Standard deviation of that roll, degrees.
    pub roll_deviation_deg: f64,
    /// Standard deviation of that pitch, degrees.
    pub pitch_deviation_deg: f64,
}

impl FoundMount {
    pub(crate) fn new(told: &Rig, found: &TiltMeasurement) -> Self {
        Self {
            told_roll_deg: told.roll_rad.to_degrees(),
            told_pitch_deg: told.pitch_rad.to_degrees(),
            roll_deg: found.roll_rad.to_degrees(),
            pitch_deg: found.pitch_rad.to_degrees(),
            roll_deviation_deg: found.covariance[(0, 0)].sqrt().to_degrees(),
            pitch_deviation_deg: found.covariance[(1, 1)].sqrt().to_degrees(),
        }
    }

    /// What a person should know of it.
    pub fn sentence(&self) -> String {
        format!(
            "the camera is mounted at a roll of {:+.2}° and a pitch of {:+.2}°, not at {:+.2}° and {:+.2}° as was told; this was \
             found in the recording and used",
            self.roll_deg, self.pitch_deg, self.told_roll_deg, self.told_pitch_deg
        )
    }
}

/// How the lens was found to bend.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FoundLens {
    /// The coefficients that were looked for.
    pub coefficients: Vec<FoundCoefficient>,
    /// By how much the calibration was off at the edge of the image where it was most, pixels.
    pub off_px: f64,
    /// Standard deviation of that, pixels.
    pub deviation_px: f64,
}

/// A coefficient of the lens.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FoundCoefficient {
    /// Which one.
    pub name: &'static str,
    /// As the camera file has it.
    pub told: f64,
    /// As the recording has it.
    pub found: f64,
    /// Standard deviation of what was found.
    pub deviation: f64,
}

impl FoundLens {
    pub(crate) fn new(told: &Camera, found: &LensMeasurement) -> Self {
        let both = found.coefficients.iter().zip(found.coefficients_of(told));
        let coefficients = both.map(|(found, told)| FoundCoefficient {
            name: found.name,
            told,
            found: found.value,
            deviation: found.deviation,
        });
        Self {
            coefficients: coefficients.collect(),
            off_px: found.off_from_px(told),
            deviation_px: found.deviation_px,
        }
    }

    /// What a person should know of it.
    pub fn sentence(&self) -> String {
        let of = |value: fn(&FoundCoefficient) -> f64| {
            let all = self.coefficients.iter().map(|known| match known.name {
                // Pixels.
                "cx" | "cy" | "fy" => format!("{} {:.2}", known.name, value(known)),
                name => format!("{name} {:+.5}", value(known)),
            });
            all.collect::<Vec<_>>().join(", ")
        };
        format!(
            "the lens bends with {}, not with {} as the camera file says, which is {:.1} px at the edge of the image: the path was followed with the \
             former, which is in camera-found.yaml; odograph calibrate measures it, --motion rigid insists on the camera file",
            of(|known| known.found),
            of(|known| known.told),
            self.off_px
        )
    }
}

/// The readout time of the image.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FoundReadout {
    /// From the exposure of the first row to that of the last, milliseconds.
    pub readout_ms: f64,
    /// One standard deviation; 0 where it was given, or is that of a global shutter.
    pub deviation_ms: f64,
    /// Whether it was given, and not learned.
    pub given: bool,
}

/// A readout time whose standard deviation is larger than this is not known, milliseconds: at half
/// a metre a second over a view of half a metre it makes distances uncertain by a thousandth.
const UNKNOWN_MS: f64 = 1.0;

impl FoundReadout {
    /// What a run knows of it in the end; `None` where the shutter was taken to be global.
    pub(crate) fn of(camera: &Camera, odometry: &Odometry) -> Option<Self> {
        let readout = odometry.readout().filter(|_| odometry.readout_matters())?;
        Some(Self {
            readout_ms: 1e3 * readout.mean_s,
            deviation_ms: 1e3 * readout.variance_s2.sqrt(),
            // One that the recording showed has a deviation.
            given: camera.readout_s().is_some() && camera.readout_deviation_s() == 0.0,
        })
    }

    /// Whether it is known well enough not to make distances uncertain.
    pub fn is_known(&self) -> bool {
        self.deviation_ms <= UNKNOWN_MS
    }

    /// What a person should know of it.
    pub fn sentence(&self) -> Option<String> {
        let Self { readout_ms, deviation_ms, given } = *self;
        if given || (readout_ms == 0.0 && deviation_ms == 0.0) {
            return None;
        }
        Some(if !self.is_known() {
            format!(
                "the readout time of the image ({readout_ms:.1} ± {deviation_ms:.1} ms) could not be learned: nothing \
                 changed speed or turned enough; --readout-ms tells it, and 0 says that the shutter is global"
            )
        } else {
            format!(
                "the camera has a rolling shutter: the image is read in {readout_ms:.2} ± {deviation_ms:.2} ms; \
                 --readout-ms or readout_time_s in the camera file tells it from the start"
            )
        })
    }
}
