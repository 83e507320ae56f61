//! An upper bound on the time per frame, kept by tracking fewer corners.
//!
//! The speed of the machine is measured once before the run, on an image of the recording's size,
//! and rounded to steps of √2. It determines the number of corners and of pyramid levels, which are
//! in `run.toml` like any other parameter: the run itself reads no clock, and repeated from its
//! `run.toml` it gives the same bytes on any machine.

use odograph::detection::{DetectionConfig, detect};
use odograph::error::{Error, Result};
use odograph::flow::{FlowConfig, Template, Warp, track};
use odograph::image::{GrayImage, Pyramid};
use odograph::odometry::OdometryConfig;
use serde::{Deserialize, Serialize};
use std::hint::black_box;
use std::ops::RangeInclusive;
use std::time::{Duration, Instant};

/// A time budget and the parameters reduced for it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Budget {
    /// Largest time per frame, milliseconds.
    pub frame_ms: f64,
    /// Corners of a keyframe.
    pub corners: usize,
    /// Corners that a keyframe would have without the budget.
    pub corners_without: usize,
    /// Pyramid levels.
    pub levels: usize,
    /// Pyramid levels without the budget.
    pub levels_without: usize,
}

/// Times on this machine, milliseconds.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Cost {
    /// Of a frame that becomes a keyframe, independent of the number of corners.
    image_ms: f64,
    /// Of a corner in such a frame: tracked forward, possibly a second time, and backward, and one
    /// new corner prepared.
    corner_ms: f64,
}

/// Minimum number of corners. Fewer take less time; with too few, those on a shadow or on the
/// vehicle outvote those on the ground.
const MIN_CORNERS: usize = 60;

/// Minimum number of pyramid levels. Fewer take less time; with one, only motions predicted to a
/// few pixels are tracked.
const MIN_LEVELS: usize = 2;

/// Fraction of the budget that is left unused: more makes fewer frames exceed the budget, less
/// leaves time for more corners.
const SPARE: f64 = 0.2;

/// Budgets that are accepted, milliseconds a frame.
const BUDGETS_MS: RangeInclusive<f64> = 0.01..=60_000.0;

/// Chooses the parameters so that a frame of `size` takes at most `frame_ms`, keyframes included.
/// Fails where no parameters do.
pub fn fit(config: &mut OdometryConfig, size: (usize, usize), frame_ms: f64) -> Result<Budget> {
    if !BUDGETS_MS.contains(&frame_ms) {
        return Err(Error::usage(format!(
            "a budget of {frame_ms:?} ms a frame is out of range; give between {} and {} ms",
            BUDGETS_MS.start(),
            BUDGETS_MS.end()
        )));
    }
    let (corners_without, levels_without) = (config.detection.corners, config.flow.levels);
    let (corners, levels) = (MIN_LEVELS.min(levels_without)..=levels_without)
        .rev()
        .find_map(|levels| {
            let corners = affordable(&measured(size, levels), frame_ms);
            (corners >= MIN_CORNERS.min(corners_without)).then_some((corners, levels))
        })
        .ok_or_else(|| {
            let cost = measured(size, MIN_LEVELS);
            let least_ms = (cost.image_ms + MIN_CORNERS as f64 * cost.corner_ms) / (1.0 - SPARE);
            Error::usage(format!(
                "a budget of {frame_ms} ms a frame cannot be kept here at {}x{}: about {least_ms:.1} ms is the least; give more, or smaller frames",
                size.0, size.1
            ))
        })?;
    config.detection.corners = corners.min(corners_without);
    config.flow.levels = levels;
    Ok(Budget { frame_ms, corners: config.detection.corners, corners_without, levels, levels_without })
}

/// Number of corners that fit into the budget, in steps of ten.
fn affordable(cost: &Cost, frame_ms: f64) -> usize {
    let left_ms = (1.0 - SPARE) * frame_ms - cost.image_ms;
    (left_ms / cost.corner_ms / 10.0).max(0.0) as usize * 10
}

/// Times for frames of this size on this machine, in steps of √2, the best of several.
fn measured(size: (usize, usize), levels: usize) -> Cost {
    let picture = |shift: usize| texture(size, shift);
    let (first, second) = (picture(0), picture(3));
    let image = || {
        let pyramid = Pyramid::new(first.clone(), levels);
        black_box(pyramid.coarser());
        black_box(detect(pyramid.base(), &DetectionConfig::default(), 9));
    };
    let (from, to) = (Pyramid::new(first.clone(), levels), Pyramid::new(second, levels));
    let corners = detect(from.base(), &DetectionConfig { corners: MIN_CORNERS, ..Default::default() }, 9);
    let flow = FlowConfig { levels, ..Default::default() };
    let follow = || {
        for corner in &corners {
            let Some(template) = Template::new(&from, (corner.x, corner.y)) else { continue };
            let _ =
                black_box(track(&template, &to, &Warp::translation(template.centre()), f64::INFINITY, &flow));
        }
    };
    Cost {
        image_ms: stepped(best_ms(image)),
        corner_ms: stepped(best_ms(follow) / corners.len().max(1) as f64),
    }
}

/// The shortest of several times.
fn best_ms(work: impl Fn()) -> f64 {
    let once = |_| {
        let started = Instant::now();
        work();
        started.elapsed()
    };
    1e3 * (0..7).map(once).min().unwrap_or(Duration::ZERO).as_secs_f64()
}

/// Rounded up to a power of √2, so that repeated measurements on a machine agree.
fn stepped(ms: f64) -> f64 {
    2f64.powf((2.0 * ms.max(1e-6).log2()).ceil() / 2.0)
}

/// An image with corners everywhere, shifted `shift` pixels to the left: blurred noise.
fn texture((width, height): (usize, usize), shift: usize) -> GrayImage {
    let noise = |x: usize, y: usize| {
        let mixed = ((x / 4 + 1) as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
            ^ ((y / 4 + 1) as u64).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        (mixed ^ (mixed >> 29)).wrapping_mul(0x94D0_49BB_1331_11EB) >> 57
    };
    let sample = |at: usize| {
        let (x, y) = (at % width + shift, at / width);
        let sum: u64 = [(0, 0), (2, 0), (0, 2), (2, 2)].iter().map(|(dx, dy)| noise(x + dx, y + dy)).sum();
        (sum / 4 + 64) as u8
    };
    GrayImage::from_samples(width, height, (0..width * height).map(sample).collect())
        .unwrap_or_else(|| GrayImage::new(width, height))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn less_time_is_fewer_corners_and_too_little_is_refused() {
        let cost = Cost { image_ms: 1.0, corner_ms: 0.005 };
        assert_eq!(affordable(&cost, 5.0), 600);
        assert_eq!(affordable(&cost, 2.0), 120);
        assert_eq!(affordable(&cost, 1.0), 0);
        let mut config = OdometryConfig::default();
        let plenty = fit(&mut config, (320, 240), 1e4).unwrap();
        assert_eq!((plenty.corners, plenty.levels), (plenty.corners_without, plenty.levels_without));
        assert_eq!(config, OdometryConfig::default());
        assert!(fit(&mut config, (320, 240), 0.011).unwrap_err().to_string().contains("cannot be kept"));
        for extreme in [f64::NAN, 1e-310, 1e308] {
            assert!(fit(&mut config, (320, 240), extreme).unwrap_err().to_string().contains("out of range"));
        }
    }

    #[test]
    fn costs_are_rounded_up_to_steps() {
        assert!((stepped(1.0) - 1.0).abs() < 1e-12);
        assert!((stepped(1.1) - 2f64.sqrt()).abs() < 1e-12);
    }
}
