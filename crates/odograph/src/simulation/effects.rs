//! What makes a recording hard: each effect off by default, each repeatable by seed.

use super::fixtures::{Bumper, Cover, Dirt, Lamp};
use super::noise::{GaussianStream, Wobble, mix, uniform, value_noise};
use super::sway::Sway;
use super::terrain::Terrain;
use super::texture::luminance;
use crate::error::{Error, Result};
use crate::geometry::{GroundPoint, GroundPose};
use serde::{Deserialize, Serialize};

/// All effects; [`Effects::default`] is a perfect camera that drives smoothly over steadily lit ground.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Effects {
    /// Exposure time, seconds; 0 is a perfectly sharp image. The truth is the pose in the middle of the exposure.
    pub exposure_s: f64,
    /// How long the sensor takes from the first row to the last, seconds; 0 is a global shutter. Row `r` of `H` is exposed
    /// `readout_s · ((r + 0.5) / H − 0.5)` after the time of the frame, to which the truth belongs. At most the time between frames.
    pub readout_s: f64,
    /// Standard deviation of the sensor's noise, gray levels.
    pub noise_gray: f64,
    /// How much darker the corner of the image is than its centre, 0 to 1 (falls with the square of the distance).
    pub vignetting: f64,
    /// Shaking of the camera.
    pub vibration: Option<Vibration>,
    /// Slow change of the height; amplitude as a fraction of the rig's height.
    pub height_change: Option<Wander>,
    /// Slow change of roll and pitch; amplitude in radians.
    pub tilt_change: Option<Wander>,
    /// A focal length that changes.
    pub breathing: Option<Breathing>,
    /// Ground that is not flat.
    pub terrain: Terrain,
    /// Ground that moves by itself.
    pub sway: Option<Sway>,
    /// Light that changes.
    pub lighting: Option<Lighting>,
    /// Sudden changes of the camera's exposure.
    pub exposure_jumps: Option<ExposureJumps>,
    /// The carrier's own shadow, which stands still in the image.
    pub carrier_shadow: Option<Shadow>,
    /// A part of the carrier, which stands still in the image.
    pub bumper: Option<Bumper>,
    /// Specks on the lens, which stand still in the image.
    pub dirt: Option<Dirt>,
    /// A lamp on the carrier, whose spot stands still in the image.
    pub lamp: Option<Lamp>,
    /// Darkness (0 to 1) of shadows that lie on the ground; 0 is none.
    pub ground_shadow: f64,
    /// Things that cross the ground below the camera.
    pub object: Option<MovingObject>,
    /// Times when the lens is covered.
    pub blackouts: Vec<Blackout>,
    /// Frames that are missing or late.
    pub timing: Timing,
}

/// Shaking of the camera: smooth and random, around one frequency, up to the amplitudes given.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Vibration {
    /// To the sides and in height, metres.
    pub shift_m: f64,
    /// In heading, roll and pitch, radians.
    pub turn_rad: f64,
    /// Hertz.
    pub frequency_hz: f64,
}

/// A slow smooth random change.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Wander {
    /// Largest change to either side.
    pub amplitude: f64,
    /// About how long it takes there and back, seconds.
    pub period_s: f64,
}

/// A focus that goes back and forth and with it the focal length, in a sine that begins at the camera's own.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Breathing {
    /// Largest change of the focal length to either side, a fraction.
    pub share: f64,
    /// Time there and back, seconds.
    pub period_s: f64,
}

impl Breathing {
    /// By which share the focal length is longer at a time, in seconds.
    pub fn share_at(&self, time_s: f64) -> f64 {
        self.share * (std::f64::consts::TAU * time_s / self.period_s).sin()
    }
}

/// Light that drifts and flickers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lighting {
    /// Slow change of brightness to either side, a fraction, with a period of about 7 s.
    pub drift: f64,
    /// Slow change of the black level to either side, gray levels.
    pub offset_gray: f64,
    /// Flicker of lamps to either side, a fraction.
    pub flicker: f64,
    /// Its frequency, hertz (100 for lamps on 50 Hz mains).
    pub flicker_hz: f64,
}

/// Exposure that jumps to a new value at regular times.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExposureJumps {
    /// Largest change of brightness to either side, a fraction.
    pub amount: f64,
    /// Time between jumps, seconds.
    pub every_s: f64,
}

/// A soft round shadow that stands still in the image.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Shadow {
    /// Share of the light it takes, 0 to 1.
    pub darkness: f64,
    /// Its centre, in image widths and heights from the top left corner.
    pub center: (f64, f64),
    /// Its radius, in image heights.
    pub radius: f64,
}

impl Default for Shadow {
    fn default() -> Self {
        Self { darkness: 0.45, center: (0.7, 0.85), radius: 0.42 }
    }
}

/// Discs that slide over the ground through the view, one after the other, each in its own direction.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MovingObject {
    /// Radius of the disc, metres.
    pub radius_m: f64,
    /// Its speed over ground, metres per second.
    pub speed_m_s: f64,
    /// Time from one to the next, seconds; the first is in the middle of the view after half of it.
    pub every_s: f64,
}

/// A time when the lens is covered: hardly any light, no ground.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Blackout {
    /// First covered time, seconds.
    pub from_s: f64,
    /// First time that is free again, seconds.
    pub to_s: f64,
}

/// Frames that are missing or late; the timestamps tell the truth about both.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Timing {
    /// Share of frames that are missing, 0 to below 1.
    pub dropped: f64,
    /// Standard deviation of the time at which a frame is taken, seconds (cut off at 0.4 frame periods).
    pub jitter_s: f64,
}

impl Effects {
    /// Checks that every number is in its range; the error names the first that is not.
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
        if let Some(wander) = self.height_change {
            checks.push(("height change", wander.amplitude, 0.0..0.9));
            checks.push(("height change's period", wander.period_s, tiny..1e6));
        }
        if let Some(wander) = self.tilt_change {
            checks.push(("tilt change", wander.amplitude, 0.0..0.8));
            checks.push(("tilt change's period", wander.period_s, tiny..1e6));
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
                "the {name} is {value}; it must be between {} and {}",
                if range.start == tiny { 0.0 } else { range.start },
                range.end
            ))),
        }
    }
}

/// The effects that move the camera, with their random functions drawn.
#[derive(Debug, Clone)]
pub(super) struct Disturbance {
    vibration: Option<(Vibration, [Wobble; 6])>,
    height: Option<(Wander, Wobble)>,
    tilt: Option<(Wander, [Wobble; 2])>,
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

    /// The pose as the disturbed camera has it. At time 0 everything starts from zero, so that the first pose stays the rig's.
    pub(super) fn applied(&self, pose: GroundPose, time_s: f64) -> GroundPose {
        let mut pose = pose;
        let since_start = |wobble: &Wobble| wobble.at(time_s) - wobble.at(0.0);
        if let Some((wander, wobble)) = &self.height {
            // Half, because the difference of two values in [−1, 1] reaches 2.
            pose.height_m *= 1.0 + 0.5 * wander.amplitude * since_start(wobble);
        }
        if let Some((wander, [roll, pitch])) = &self.tilt {
            pose.roll_rad += 0.5 * wander.amplitude * since_start(roll);
            pose.pitch_rad += 0.5 * wander.amplitude * since_start(pitch);
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

/// How long after the time of its frame a row of so many is exposed, seconds: 0 for the middle of the image.
pub(super) fn row_offset_s(readout_s: f64, row: usize, rows: usize) -> f64 {
    readout_s * ((row as f64 + 0.5) / rows as f64 - 0.5)
}

/// The effects between the ground's light and the delivered image.
#[derive(Debug, Clone)]
pub(super) struct Exposure {
    width: usize,
    readout_s: f64,
    /// Per pixel: what vignetting, the carrier's shadow, its lamp and dirt make of the light.
    shade: Vec<f32>,
    /// Per pixel: what hides the ground; empty where nothing does.
    covers: Vec<Cover>,
    /// Per pixel: what a lamp's highlight adds, gray levels; empty where there is no lamp.
    highlight: Vec<f32>,
    lighting: Option<(Lighting, Wobble, Wobble)>,
    jumps: Option<ExposureJumps>,
    blackouts: Vec<Blackout>,
    noise_gray: f32,
    seed: u64,
}

/// What a covered lens delivers, gray levels.
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

    /// Turns light (planes of gray levels, one a channel) into the 8-bit samples of frame `number`, interleaved.
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
                // Saturates at both ends, rounds to nearest.
                samples[i * channels + channel] = (gray + 0.5) as u8;
            }
        }
        samples
    }

    /// What the light at a row's time and the exposure of its frame make of gray levels.
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

/// The moving discs, with the camera's path they cross.
#[derive(Debug, Clone)]
pub(super) struct Discs {
    object: MovingObject,
    seed: u64,
}

/// A disc at one moment.
#[derive(Debug, Clone, Copy)]
pub(super) struct Disc {
    /// Where its centre is.
    pub(super) center: GroundPoint,
    radius_m: f64,
    seed: u32,
}

impl Discs {
    pub(super) fn new(object: MovingObject, seed: u64) -> Self {
        Self { object, seed: mix(seed ^ 0x0B1EC7) }
    }

    /// The discs that may be in view; `pose_at` tells where the camera is at a time.
    pub(super) fn at(&self, time_s: f64, pose_at: impl Fn(f64) -> GroundPose) -> Vec<Disc> {
        let now = (time_s / self.object.every_s).floor() as i64;
        // The one of this period, and its neighbours that may still or already be in view.
        (now - 1..=now + 1)
            .filter(|number| *number >= 0)
            .map(|number| {
                let meeting_s = (number as f64 + 0.5) * self.object.every_s;
                let below = pose_at(meeting_s);
                let angle = std::f64::consts::TAU * uniform(self.seed, number as u64);
                let way_m = self.object.speed_m_s * (time_s - meeting_s);
                let center =
                    GroundPoint::new(below.x_m + way_m * angle.cos(), below.y_m + way_m * angle.sin());
                Disc { center, radius_m: self.object.radius_m, seed: (self.seed ^ number as u64) as u32 }
            })
            .collect()
    }
}

impl Disc {
    /// Colour of the disc at a ground point and how much of a pixel with that footprint it covers.
    pub(super) fn color(&self, point: GroundPoint, footprint_m: f64) -> Option<([f32; 3], f32)> {
        let inside_m = self.radius_m - point.distance(self.center);
        let covered = (0.5 + inside_m / footprint_m).clamp(0.0, 1.0) as f32;
        if covered <= 0.0 {
            return None;
        }
        // The pattern moves with the disc: blotches of a tenth and a third of its size.
        let (x, y) = (point.x_m - self.center.x_m, point.y_m - self.center.y_m);
        let blotch = |size: f64, seed: u32| {
            value_noise(self.seed ^ seed, x / (size * self.radius_m), y / (size * self.radius_m))
        };
        let gray = 120.0 + 55.0 * blotch(0.33, 1) + 45.0 * blotch(0.1, 2);
        Some(([gray * 0.75, gray * 0.9, gray * 1.3].map(|v: f32| v.clamp(0.0, 255.0)), covered))
    }
}
