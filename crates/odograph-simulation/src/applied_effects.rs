//! Effects on the camera's motion and on its images, with their random functions.

use super::effects::{Blackout, Effects, ExposureJumps, Lighting, MovingObject, SlowVariation, Vibration};
use super::fixtures::{Cover, Lamp};
use super::noise::{GaussianStream, Wobble, mix, uniform, value_noise};
use super::texture::luminance;
use odograph::geometry::{GroundPoint, GroundPose};

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
