//! Parameters of disturbances and image degradations. Each is off by default and reproducible by
//! its seed.

use super::fixtures::{Bumper, Dirt, Lamp};
use super::sway::Sway;
use super::terrain::Terrain;
use odograph::error::{Error, Result};
use serde::{Deserialize, Serialize};

/// All effects. [`Effects::default`] is an ideal camera with smooth motion over evenly lit flat
/// ground.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Effects {
    /// Exposure time, seconds; 0 is no motion blur. The ground truth is the pose in the middle of
    /// the exposure.
    pub exposure_s: f64,
    /// Readout time from the first row to the last, seconds; 0 is a global shutter. Row `r` of `H`
    /// is exposed `readout_s · ((r + 0.5) / H − 0.5)` after the time of the frame, which is the
    /// time of the ground truth. At most the frame period.
    pub readout_s: f64,
    /// Standard deviation of the sensor noise, gray levels.
    pub noise_gray: f64,
    /// Vignetting: relative loss of brightness in the image corners, 0 to 1; quadratic in the
    /// distance from the centre.
    pub vignetting: f64,
    /// Vibration of the camera.
    pub vibration: Option<Vibration>,
    /// Slow variation of the camera height; amplitude as a fraction of the mounting height.
    pub height_change: Option<SlowVariation>,
    /// Slow variation of roll and pitch; amplitude in radians.
    pub tilt_change: Option<SlowVariation>,
    /// Focus breathing: a varying focal length.
    pub breathing: Option<Breathing>,
    /// Uneven ground.
    pub terrain: Terrain,
    /// Ground texture that moves by itself.
    pub sway: Option<Sway>,
    /// Varying illumination.
    pub lighting: Option<Lighting>,
    /// Sudden changes of the camera's exposure.
    pub exposure_jumps: Option<ExposureJumps>,
    /// Shadow of the vehicle, static in the image.
    pub carrier_shadow: Option<Shadow>,
    /// A part of the vehicle in view, static in the image.
    pub bumper: Option<Bumper>,
    /// Dirt on the lens, static in the image.
    pub dirt: Option<Dirt>,
    /// A lamp on the vehicle whose light spot is static in the image.
    pub lamp: Option<Lamp>,
    /// Darkness of shadows fixed to the ground, 0 (no shadows) to 1.
    pub ground_shadow: f64,
    /// Moving objects that cross the view.
    pub object: Option<MovingObject>,
    /// Time intervals in which the lens is covered.
    pub blackouts: Vec<Blackout>,
    /// Dropped frames and timing jitter.
    pub timing: Timing,
}

/// Vibration: smooth random motion around one frequency, bounded by the given amplitudes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vibration {
    /// Amplitude of each coordinate of the position, metres.
    pub shift_m: f64,
    /// Amplitude of heading, roll and pitch, radians.
    pub turn_rad: f64,
    /// Centre frequency, hertz.
    pub frequency_hz: f64,
}

/// A slow smooth random variation.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SlowVariation {
    /// Maximum deviation to either side.
    pub amplitude: f64,
    /// Approximate period, seconds.
    pub period_s: f64,
}

/// Focus breathing: the focal length varies as a sine of time, nominal at time 0.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Breathing {
    /// Maximum relative change of the focal length to either side.
    pub share: f64,
    /// Period, seconds.
    pub period_s: f64,
}

impl Breathing {
    /// Relative change of the focal length at a time, seconds.
    pub fn share_at(&self, time_s: f64) -> f64 {
        self.share * (std::f64::consts::TAU * time_s / self.period_s).sin()
    }
}

/// Illumination drift and flicker.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lighting {
    /// Amplitude of the slow gain variation, a fraction; its period is about 7 s.
    pub drift: f64,
    /// Amplitude of the slow variation of the black level, gray levels.
    pub offset_gray: f64,
    /// Amplitude of the lamp flicker, a fraction.
    pub flicker: f64,
    /// Frequency of the flicker, hertz (100 for lamps on 50 Hz mains).
    pub flicker_hz: f64,
}

/// Exposure that changes abruptly at regular intervals.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExposureJumps {
    /// Maximum relative change of brightness to either side.
    pub amount: f64,
    /// Interval between changes, seconds.
    pub every_s: f64,
}

/// A soft round shadow, static in the image.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shadow {
    /// Fraction of the light it removes, 0 to 1.
    pub darkness: f64,
    /// Centre, in image widths and heights from the top left corner.
    pub center: (f64, f64),
    /// Radius, in image heights.
    pub radius: f64,
}

impl Default for Shadow {
    fn default() -> Self {
        Self { darkness: 0.45, center: (0.7, 0.85), radius: 0.42 }
    }
}

/// Discs that cross the view over the ground one after the other, each in a random direction.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MovingObject {
    /// Radius of a disc, metres.
    pub radius_m: f64,
    /// Speed over ground, metres per second.
    pub speed_m_s: f64,
    /// Interval between discs, seconds; the first is in the middle of the view after half of it.
    pub every_s: f64,
}

/// A time interval in which the lens is covered: the image is nearly black.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Blackout {
    /// Start of the interval, seconds.
    pub from_s: f64,
    /// End of the interval, exclusive, seconds.
    pub to_s: f64,
}

/// Dropped and late frames; the timestamps are true.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Timing {
    /// Fraction of frames that are dropped, 0 to below 1.
    pub dropped: f64,
    /// Standard deviation of the jitter of the capture time, seconds (truncated at 0.4 frame
    /// periods).
    pub jitter_s: f64,
}

impl Effects {
    /// Checks that every value is in range; the error names the first that is not.
    pub fn validated(self) -> Result<Self> {
        let mut checks = vec![
            ("exposure time", self.exposure_s, 0.0..10.0),
            ("readout time", self.readout_s, 0.0..10.0),
            ("noise", self.noise_gray, 0.0..128.0),
            ("vignetting", self.vignetting, 0.0..1.000_001),
            ("darkness of the ground's shadows", self.ground_shadow, 0.0..1.000_001),
            ("share of dropped frames", self.timing.dropped, 0.0..1.0),
            ("jitter", self.timing.jitter_s, 0.0..10.0),
        ];
        let tiny = f64::MIN_POSITIVE;
        if let Some(vibration) = self.vibration {
            checks.push(("vibration", vibration.shift_m, 0.0..1.0));
            checks.push(("vibration's turn", vibration.turn_rad, 0.0..0.5));
            checks.push(("vibration's frequency", vibration.frequency_hz, tiny..10_000.0));
        }
        if let Some(variation) = self.height_change {
            checks.push(("height change", variation.amplitude, 0.0..0.9));
            checks.push(("height change's period", variation.period_s, tiny..1e6));
        }
        if let Some(variation) = self.tilt_change {
            checks.push(("tilt change", variation.amplitude, 0.0..0.8));
            checks.push(("tilt change's period", variation.period_s, tiny..1e6));
        }
        if let Some(lighting) = self.lighting {
            checks.push(("drift of the light", lighting.drift, 0.0..1.0));
            checks.push(("black level's change", lighting.offset_gray, 0.0..128.0));
            checks.push(("flicker", lighting.flicker, 0.0..1.0));
            checks.push(("flicker's frequency", lighting.flicker_hz, 0.0..100_000.0));
        }
        if let Some(jumps) = self.exposure_jumps {
            checks.push(("exposure jump", jumps.amount, 0.0..1.0));
            checks.push(("time between exposure jumps", jumps.every_s, tiny..1e6));
        }
        if let Some(shadow) = self.carrier_shadow {
            checks.push(("shadow's darkness", shadow.darkness, 0.0..1.000_001));
            checks.push(("shadow's radius", shadow.radius, tiny..10.0));
            checks.push(("shadow's place", shadow.center.0, -10.0..10.0));
            checks.push(("shadow's place", shadow.center.1, -10.0..10.0));
        }
        if let Some(breathing) = self.breathing {
            checks.push(("change of the focal length", breathing.share, 0.0..0.2));
            checks.push(("period of the focal length's change", breathing.period_s, tiny..1e6));
        }
        if let Some(sway) = self.sway {
            checks.push(("sway", sway.amplitude_m, 0.0..1.0));
            checks.push(("share of the ground that sways", sway.share, tiny..1.000_001));
            checks.push(("sway's period", sway.period_s, tiny..1e6));
        }
        if let Some(bumper) = self.bumper {
            checks.push(("bumper's share of the image", bumper.share, tiny..0.9));
        }
        if let Some(dirt) = self.dirt {
            checks.push(("number of specks on the lens", f64::from(dirt.count), 0.0..10_001.0));
        }
        if let Some(lamp) = self.lamp {
            checks.push(("lamp's strength", lamp.strength, 0.0..1.000_001));
            checks.push(("radius of the lamp's spot", lamp.radius, tiny..10.0));
            checks.push(("place of the lamp's spot", lamp.center.0, -10.0..10.0));
            checks.push(("place of the lamp's spot", lamp.center.1, -10.0..10.0));
        }
        if let Some(object) = self.object {
            checks.push(("object's radius", object.radius_m, tiny..1e4));
            checks.push(("object's speed", object.speed_m_s, 0.0..1e4));
            checks.push(("time between objects", object.every_s, tiny..1e6));
        }
        for blackout in &self.blackouts {
            checks.push(("blackout's start", blackout.from_s, 0.0..1e6));
            checks.push(("blackout's length", blackout.to_s - blackout.from_s, 0.0..1e6));
        }
        match checks.into_iter().find(|(_, value, range)| !range.contains(value)) {
            None => Ok(Self { terrain: self.terrain.validated()?, ..self }),
            Some((name, value, range)) => Err(Error::usage(format!(
                "the {name} is {value:?}; it must be between {} and {}",
                if range.start == tiny { 0.0 } else { range.start },
                range.end
            ))),
        }
    }
}
