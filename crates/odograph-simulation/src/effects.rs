//! Disturbances and image degradations. Each is off by default and reproducible by its seed.

use super::fixtures::{Bumper, Cover, Dirt, Lamp};
use super::noise::{GaussianStream, Wobble, mix, uniform, value_noise};
use super::sway::Sway;
use super::terrain::Terrain;
use super::texture::luminance;
use odograph::error::{Error, Result};
use odograph::geometry::{GroundPoint, GroundPose};
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

/// Effects that move the camera, with their random functions.
#[derive(Debug, Clone)]
pub(super) struct Disturbance {
    vibration: Option<(Vibration, [Wobble; 6])>,
    height: Option<(SlowVariation, Wobble)>,
    tilt: Option<(SlowVariation, [Wobble; 2])>,
}

impl Disturbance {
    pub(super) fn new(effects: &Effects, seed: u64) -> Self {
        let seed = |i: u64| mix(seed ^ (0xD157 << 16) ^ i);
        Self {
            vibration: effects
                .vibration
                .map(|v| (v, std::array::from_fn(|i| Wobble::new(seed(i as u64), v.frequency_hz)))),
            height: effects.height_change.map(|w| (w, Wobble::new(seed(10), 1.0 / w.period_s))),
            tilt: effects
                .tilt_change
                .map(|w| (w, std::array::from_fn(|i| Wobble::new(seed(20 + i as u64), 1.0 / w.period_s)))),
        }
    }

    /// The disturbed pose. Every disturbance is zero at time 0, so that the first pose is the
    /// mounting pose.
    pub(super) fn applied(&self, pose: GroundPose, time_s: f64) -> GroundPose {
        let mut pose = pose;
        let since_start = |wobble: &Wobble| wobble.at(time_s) - wobble.at(0.0);
        if let Some((variation, wobble)) = &self.height {
            // Half, because the difference of two values in [−1, 1] reaches 2.
            pose.height_m *= 1.0 + 0.5 * variation.amplitude * since_start(wobble);
        }
        if let Some((variation, [roll, pitch])) = &self.tilt {
            pose.roll_rad += 0.5 * variation.amplitude * since_start(roll);
            pose.pitch_rad += 0.5 * variation.amplitude * since_start(pitch);
        }
        if let Some((vibration, [x, y, height, heading, roll, pitch])) = &self.vibration {
            let (shift_m, turn_rad) = (0.5 * vibration.shift_m, 0.5 * vibration.turn_rad);
            pose.x_m += shift_m * since_start(x);
            pose.y_m += shift_m * since_start(y);
            pose.height_m += shift_m * since_start(height);
            pose.heading_rad += turn_rad * since_start(heading);
            pose.roll_rad += turn_rad * since_start(roll);
            pose.pitch_rad += turn_rad * since_start(pitch);
        }
        pose
    }
}

/// Time offset of a row from the time of its frame, seconds; 0 in the middle of the `rows` rows.
pub(super) fn row_offset_s(readout_s: f64, row: usize, rows: usize) -> f64 {
    readout_s * ((row as f64 + 0.5) / rows as f64 - 0.5)
}

/// Effects between the light from the ground and the delivered image.
#[derive(Debug, Clone)]
pub(super) struct Exposure {
    width: usize,
    readout_s: f64,
    /// Per pixel: gain from vignetting, vehicle shadow, lamp and dirt.
    shade: Vec<f32>,
    /// Per pixel: occlusion by the bumper; empty without one.
    covers: Vec<Cover>,
    /// Per pixel: additive specular highlight of the lamp, gray levels; empty without one.
    highlight: Vec<f32>,
    lighting: Option<(Lighting, Wobble, Wobble)>,
    jumps: Option<ExposureJumps>,
    blackouts: Vec<Blackout>,
    noise_gray: f32,
    seed: u64,
}

/// Gray level of an image with a covered lens.
const COVERED_GRAY: f32 = 6.0;

impl Exposure {
    pub(super) fn new(effects: &Effects, width: usize, height: usize, seed: u64) -> Self {
        let (w, h) = (width as f64, height as f64);
        let place = |i: usize| ((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        let mut shade: Vec<f32> = (0..width * height)
            .map(|i| {
                let (x, y) = place(i);
                let corner = (x - 0.5 * w).hypot(y - 0.5 * h) / (0.5 * w.hypot(h));
                let mut left = 1.0 - effects.vignetting * corner * corner;
                if let Some(shadow) = effects.carrier_shadow {
                    let distance =
                        (x - shadow.center.0 * w).hypot(y - shadow.center.1 * h) / (shadow.radius * h);
                    left *= 1.0 - shadow.darkness * (-distance.powi(4)).exp();
                }
                if let Some(lamp) = effects.lamp {
                    left *= lamp.light((x, y), (w, h));
                }
                left as f32
            })
            .collect();
        if let Some(dirt) = effects.dirt {
            dirt.darken(&mut shade, width, seed);
        }
        let highlight =
            |lamp: Lamp| (0..width * height).map(|i| lamp.highlight_gray(place(i), (w, h)) as f32).collect();
        let lighting = effects.lighting.map(|light| {
            (light, Wobble::new(mix(seed ^ 0x11), 1.0 / 7.0), Wobble::new(mix(seed ^ 0x12), 1.0 / 5.0))
        });
        Self {
            width,
            readout_s: effects.readout_s,
            shade,
            covers: effects.bumper.map_or(vec![], |bumper| bumper.covers(width, height, seed)),
            highlight: effects.lamp.map_or(vec![], highlight),
            lighting,
            jumps: effects.exposure_jumps,
            blackouts: effects.blackouts.clone(),
            noise_gray: effects.noise_gray as f32,
            seed,
        }
    }

    /// Whether the lens is covered at a time.
    pub(super) fn covered(&self, time_s: f64) -> bool {
        self.blackouts.iter().any(|b| (b.from_s..b.to_s).contains(&time_s))
    }

    /// Converts light (one plane of gray levels per channel) to the interleaved 8-bit samples of
    /// frame `number`.
    pub(super) fn develop(&self, planes: &[f32], number: u64, time_s: f64) -> Vec<u8> {
        let pixels = self.shade.len();
        let (width, rows) = (self.width, pixels / self.width);
        let (mut gain, mut offset) = (1.0, 0.0);
        let covered = self.covered(time_s);
        let channels = planes.len() / pixels;
        let mut samples = vec![0u8; planes.len()];
        let mut noise = GaussianStream::new(mix(self.seed ^ 0x4015E) ^ mix(number));
        for (i, shade) in self.shade.iter().enumerate() {
            if i % width == 0 {
                let row_s = time_s + row_offset_s(self.readout_s, i / width, rows);
                (gain, offset) = self.gain_and_offset(row_s, time_s);
            }
            let cover = self.covers.get(i).filter(|(share, _)| *share > 0.0);
            let highlight = self.highlight.get(i).copied().unwrap_or(0.0);
            for channel in 0..channels {
                let mut light = planes[channel * pixels + i];
                if let Some((share, color)) = cover {
                    let own = if channels == 1 { luminance(*color) } else { color[channel] };
                    light += share * (own - light);
                }
                let mut gray =
                    if covered { COVERED_GRAY } else { (light * shade + highlight) * gain + offset };
                if self.noise_gray > 0.0 {
                    gray += self.noise_gray * noise.sample();
                }
                // The cast saturates at both ends; 0.5 rounds to nearest.
                samples[i * channels + channel] = (gray + 0.5) as u8;
            }
        }
        samples
    }

    /// Gain and offset of a row: illumination at the row's time and exposure of its frame.
    fn gain_and_offset(&self, row_s: f64, frame_s: f64) -> (f32, f32) {
        let (mut gain, mut offset) = (1.0, 0.0);
        if let Some((light, drift, black)) = &self.lighting {
            let flicker = (std::f64::consts::TAU * light.flicker_hz * row_s).sin();
            gain *= (1.0 + light.drift * drift.at(row_s)) * (1.0 + light.flicker * flicker);
            offset += light.offset_gray * black.at(row_s);
        }
        if let Some(jumps) = self.jumps {
            let number = (frame_s / jumps.every_s).floor() as i64 as u64;
            gain *= 1.0 + jumps.amount * (2.0 * uniform(self.seed ^ 0x30B, number) - 1.0);
        }
        (gain as f32, offset as f32)
    }
}

/// The moving discs.
#[derive(Debug, Clone)]
pub(super) struct MovingDiscs {
    object: MovingObject,
    seed: u64,
}

/// A disc at one moment.
#[derive(Debug, Clone, Copy)]
pub(super) struct MovingDisc {
    /// Centre of the disc.
    pub(super) center: GroundPoint,
    radius_m: f64,
    seed: u32,
}

impl MovingDiscs {
    pub(super) fn new(object: MovingObject, seed: u64) -> Self {
        Self { object, seed: mix(seed ^ 0x0B1EC7) }
    }

    /// Discs that may be in view; `pose_at` is the camera pose as a function of time.
    pub(super) fn at(&self, time_s: f64, pose_at: impl Fn(f64) -> GroundPose) -> Vec<MovingDisc> {
        let now = (time_s / self.object.every_s).floor() as i64;
        // The disc of this period, and its neighbours, which may still or already be in view.
        (now - 1..=now + 1)
            .filter(|number| *number >= 0)
            .map(|number| {
                let meeting_s = (number as f64 + 0.5) * self.object.every_s;
                let below = pose_at(meeting_s);
                let angle = std::f64::consts::TAU * uniform(self.seed, number as u64);
                let way_m = self.object.speed_m_s * (time_s - meeting_s);
                let center =
                    GroundPoint::new(below.x_m + way_m * angle.cos(), below.y_m + way_m * angle.sin());
                MovingDisc {
                    center,
                    radius_m: self.object.radius_m,
                    seed: (self.seed ^ number as u64) as u32,
                }
            })
            .collect()
    }
}

impl MovingDisc {
    /// Colour of the disc at a ground point, and the fraction of a pixel of that footprint that it
    /// covers.
    pub(super) fn color(&self, point: GroundPoint, footprint_m: f64) -> Option<([f32; 3], f32)> {
        let inside_m = self.radius_m - point.distance(self.center);
        let covered = (0.5 + inside_m / footprint_m).clamp(0.0, 1.0) as f32;
        if covered <= 0.0 {
            return None;
        }
        // The pattern moves with the disc: blotches of a third and a tenth of its radius.
        let (x, y) = (point.x_m - self.center.x_m, point.y_m - self.center.y_m);
        let blotch = |size: f64, seed: u32| {
            value_noise(self.seed ^ seed, x / (size * self.radius_m), y / (size * self.radius_m))
        };
        let gray = 120.0 + 55.0 * blotch(0.33, 1) + 45.0 * blotch(0.1, 2);
        Some(([gray * 0.75, gray * 0.9, gray * 1.3].map(|v: f32| v.clamp(0.0, 255.0)), covered))
    }
}
