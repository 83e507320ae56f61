//! Regions that are static in the image while the ground moves: a bumper, dirt on the lens, the
//! light of the vehicle's own lamp.

use super::noise::{mix, smooth_step, uniform, value_noise};
use odograph::geometry::length;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// A part of the vehicle at the bottom of the image: striped, scratched, with an uneven outline and
/// two brackets.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bumper {
    /// Fraction of the image it covers, above 0 to 0.9.
    pub share: f64,
}

/// Dark specks on the lens, alternately soft and sharp-edged.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Dirt {
    /// Number of specks.
    pub count: u32,
}

/// A lamp beside the camera: a bright spot with fall-off, darkness around it, and a saturated
/// specular highlight.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lamp {
    /// Fraction of the light that comes from the lamp, 0 to 1; the rest is uniform ambient light.
    pub strength: f64,
    /// Centre of the spot, in image widths and heights from the top left corner.
    pub center: (f64, f64),
    /// Radius of the spot, in image heights.
    pub radius: f64,
}

impl Default for Lamp {
    fn default() -> Self {
        Self { strength: 0.7, center: (0.46, 0.42), radius: 0.45 }
    }
}

impl Lamp {
    /// Relative illumination at a pixel, 1 for purely ambient light.
    pub(super) fn light(&self, (x, y): (f64, f64), (width, height): (f64, f64)) -> f64 {
        let distance = length(x - self.center.0 * width, y - self.center.1 * height) / (self.radius * height);
        1.0 - 0.85 * self.strength + 2.0 * self.strength * (-distance * distance).exp()
    }

    /// Specular highlight at a pixel, gray levels; far above white in its centre.
    pub(super) fn highlight_gray(&self, (x, y): (f64, f64), (width, height): (f64, f64)) -> f64 {
        // The specular reflection is offset from the centre of the spot.
        let (x0, y0) = (self.center.0 * width, (self.center.1 + 0.12 * self.radius) * height);
        let distance = length(x - x0, y - y0) / (0.14 * self.radius * height);
        700.0 * self.strength * (-distance * distance).exp()
    }
}

/// Occlusion of a pixel: covered fraction and colour.
pub(super) type Cover = (f32, [f32; 3]);

impl Bumper {
    /// The occlusion of every pixel, in row order.
    pub(super) fn covers(&self, width: usize, height: usize, seed: u64) -> Vec<Cover> {
        let seed = mix(seed ^ 0xB0_3BE4) as u32;
        let (w, h) = (width as f64, height as f64);
        let bracket = |u: f64, at: f64| smooth_step(4.0 - 80.0 * (u - at).abs());
        let outline: Vec<f64> = (0..width)
            .map(|column| {
                let u = (column as f64 + 0.5) / w;
                1.0 + 0.3 * f64::from(value_noise(seed, 5.0 * u, 0.5))
                    + 0.1 * f64::from(value_noise(seed, 31.0 * u, 9.5))
                    + 0.45 * (bracket(u, 0.22) + bracket(u, 0.71))
            })
            .collect();
        let scale = self.share * h * w / outline.iter().sum::<f64>();
        (0..width * height)
            .map(|i| {
                let (column, row) = (i % width, i / width);
                let inside_px = row as f64 + 1.0 - (h - scale * outline[column]);
                // Out of focus so close to the camera: the edge is two pixels wide.
                let covered = (0.5 * inside_px + 0.25).clamp(0.0, 1.0) as f32;
                (covered, self.color((column as f64 / w, (row as f64 - h) / w), inside_px / w, seed))
            })
            .collect()
    }

    /// Colour at a position in image widths; `inside` is the distance from the outline.
    fn color(&self, (x, y): (f64, f64), inside: f64, seed: u32) -> [f32; 3] {
        let stripe = smooth_step(8.0 * ((TAU * (x + y) / 0.075).sin()) + 0.5) as f32;
        let scratches = 14.0 * value_noise(seed ^ 2, 110.0 * x, 30.0 * y)
            + 12.0 * value_noise(seed ^ 3, 25.0 * x, 260.0 * y);
        // A row of bolts below the outline.
        let bolt = length((x / 0.05).fract() * 0.05 - 0.025, inside - 0.022) < 0.006;
        let (dark, bright) = ([34.0, 33.0, 36.0], [222.0, 188.0, 52.0]);
        std::array::from_fn(|c| {
            let paint = dark[c] + stripe * (bright[c] - dark[c]);
            (if bolt { 150.0 } else { paint } + scratches).clamp(4.0, 250.0)
        })
    }
}

impl Dirt {
    /// Multiplies the light of each pixel by the transmission of the specks.
    pub(super) fn darken(&self, shade: &mut [f32], width: usize, seed: u64) {
        let (w, h) = (width as f64, (shade.len() / width) as f64);
        for speck in 0..u64::from(self.count) {
            let draw = |index: u64| uniform(seed ^ 0xD1_27, 8 * speck + index);
            let (x0, y0) = (w * draw(0), h * draw(1));
            let soft = speck % 2 == 0;
            let radius_px = w * if soft { 0.02 + 0.035 * draw(2) } else { 0.006 + 0.018 * draw(2) };
            let darkness = if soft { 0.35 + 0.4 * draw(3) } else { 0.7 + 0.25 * draw(3) };
            let outline = mix(seed ^ speck) as u32;
            let reach_px = 2.0 * radius_px;
            let span = |center: f64, size: f64| {
                (center - reach_px).max(0.0) as usize..(center + reach_px).clamp(0.0, size) as usize
            };
            for row in span(y0, h) {
                for column in span(x0, w) {
                    let (dx, dy) = ((column as f64 - x0) / radius_px, (row as f64 - y0) / radius_px);
                    let uneven = 0.3 * f64::from(value_noise(outline, 1.5 * dx, 1.5 * dy));
                    let distance = length(dx, dy) * (1.0 + uneven);
                    let covered = match soft {
                        true => (-distance.powi(4)).exp(),
                        false => smooth_step(0.4 * (1.0 - distance) * radius_px + 0.5),
                    };
                    shade[row * width + column] *= (1.0 - darkness * covered) as f32;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bumper_covers_the_configured_fraction_from_the_bottom() {
        for share in [0.05, 0.15, 0.25] {
            let covers = Bumper { share }.covers(320, 240, 3);
            let covered = covers.iter().map(|(covered, _)| f64::from(*covered)).sum::<f64>() / 76_800.0;
            assert!((covered - share).abs() < 0.005, "{covered} of {share}");
            for column in 0..320 {
                let rows = (0..240).map(|row| covers[row * 320 + column].0);
                assert!(rows.is_sorted(), "column {column}");
            }
            let tops: Vec<usize> =
                (0..320).map(|c| (0..240).position(|r| covers[r * 320 + c].0 > 0.5).unwrap()).collect();
            assert!(tops.iter().max().unwrap() - tops.iter().min().unwrap() > 4, "the outline is uneven");
        }
    }

    #[test]
    fn dirt_only_darkens_within_its_specks() {
        let mut shade = vec![1.0; 320 * 240];
        Dirt { count: 8 }.darken(&mut shade, 320, 3);
        let touched = shade.iter().filter(|left| **left < 1.0).count();
        assert!(shade.iter().all(|left| (0.0..=1.0).contains(left)));
        assert!((500..20_000).contains(&touched), "{touched}");
        assert!(shade.iter().any(|left| *left < 0.4));
    }

    #[test]
    fn a_lamp_is_brightest_at_its_centre_and_dark_around() {
        let (lamp, size) = (Lamp::default(), (640.0, 480.0));
        let center = (0.46 * 640.0, 0.42 * 480.0);
        assert!(lamp.light(center, size) > 1.5 && lamp.light((639.0, 479.0), size) < 0.5);
        let highlight = (center.0, center.1 + 0.12 * 0.45 * 480.0);
        assert!(lamp.highlight_gray(highlight, size) > 255.0);
        assert!(lamp.highlight_gray((0.0, 0.0), size) < 1e-6);
    }
}
