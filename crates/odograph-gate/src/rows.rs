//! The rendered rows. To add one, add a `BenchmarkRow { … }` to [`rows`].

use crate::alterations::Alteration;
use odograph::camera::{Camera, Distortion, Rig};
use odograph::error::Result;
use odograph::geometry::Pixel;
use odograph_simulation::{
    Blackout, Bumper, Dirt, Effects, Kerb, Lamp, Lighting, MovingObject, PathKind, Ramp, Relief, Shadow,
    SlowVariation, Terrain, Timing, Undulation, Vibration,
};
use std::f64::consts::TAU;

/// How a clip is tracked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Follow {
    /// Frame by frame, as with a live camera.
    Live,
    /// As `odograph run` does: restarted if mount or lens are found to differ from the given
    /// calibration.
    Recorded,
    /// As `Recorded`, with a map whose loop closures correct every pose.
    Mapped,
}

/// One kind of recording, with a different drive for each seed.
#[derive(Debug, Clone)]
pub struct BenchmarkRow {
    /// Unique short name in kebab case.
    pub name: &'static str,
    /// A texture name known to `Texture::named`.
    pub texture: &'static str,
    /// The path, by seed.
    pub path: fn(u64) -> PathKind,
    /// Speed over ground, metres per second.
    pub speed_m_s: f64,
    /// Turn rate for turns on the spot or about a point, radians per second.
    pub turn_rate_rad_s: f64,
    /// Disturbances of the recording.
    pub effects: Effects,
    /// Width and height of the image, pixels.
    pub size_px: (usize, usize),
    /// Frame rate, frames per second.
    pub fps: f64,
    /// True mount of the camera.
    pub rig: Rig,
    /// Mount given to the odometry.
    pub given_rig: Rig,
    /// Whether the odometry is given a careless calibration of the lens ([`careless`]).
    pub lens_is_careless: bool,
    /// Whether the odometry is given the readout time of the rolling shutter.
    pub readout_is_given: bool,
    /// Quantisation parameter of H.264, 0 to 51; `None` for uncompressed recordings.
    pub h264_qp: Option<u8>,
    /// What the camera's software does to the images.
    pub alteration: Option<Alteration>,
    /// How it is tracked.
    pub follow: Follow,
    /// Default number of seeds; results are medians over them.
    pub seeds: u64,
}

/// Height of the camera above the ground, metres.
const HEIGHT_M: f64 = 0.75;
const FULL_PX: (usize, usize) = (640, 480);
/// A quarter of the pixels, for rows that take long to render.
const SMALL_PX: (usize, usize) = (320, 240);

/// The camera of all rendered rows, with mild barrel distortion.
pub fn camera((width, height): (usize, usize)) -> Result<Camera> {
    let share = width as f64 / 640.0;
    let distortion = Distortion::from_opencv(&[-0.12, 0.03, 0.0005, -0.0003]).unwrap_or(Distortion::None);
    let centre = (321.0 * share, 238.5 * share);
    Camera::new((width, height), (500.0 * share, 500.0 * share), centre, distortion)
}

/// A camera as a careless calibration has it: its principal point is off by a hundredth of the
/// focal length, its decentering by 0.002, its first radial coefficient by 0.01.
pub fn careless(camera: &Camera) -> Result<Camera> {
    let ((focal_px, _), (cx, cy)) = (camera.focal_px(), camera.principal_px());
    let distortion = match *camera.distortion() {
        Distortion::BrownConrady { k1, k2, p1, p2, k3, k4, k5, k6 } => {
            Distortion::BrownConrady { k1: k1 + 0.01, k2, p1: p1 + 0.002, p2: p2 - 0.002, k3, k4, k5, k6 }
        }
        other => other,
    };
    let centre = (cx - 0.01 * focal_px, cy + 0.01 * focal_px);
    let careless = Camera::new((camera.width(), camera.height()), camera.focal_px(), centre, distortion)?;
    careless.with_readout_s(camera.readout_s())
}

/// A random walk with continuous turning, different for every seed.
fn wandering(seed: u64) -> PathKind {
    PathKind::RandomWalk { length_m: 4.0, seed: 100 + seed }
}

/// One and a half turns about the ground point in a corner of the image; the corner depends on the
/// seed.
fn corner_turn(seed: u64) -> PathKind {
    let corner = [(0.0, 0.0), (639.0, 0.0), (0.0, 479.0), (639.0, 479.0)][seed as usize % 4];
    let ray = camera(FULL_PX).ok().and_then(|camera| camera.ray_from_pixel(Pixel::new(corner.0, corner.1)));
    let about = ray.and_then(|ray| Rig::level(HEIGHT_M).first_pose().ground_from_ray(ray));
    about.map_or(PathKind::Still { duration_s: 1.0 }, |about| PathKind::Pivot { about, turn_rad: 1.5 * TAU })
}

/// 4 m straight ahead, from standstill to standstill.
pub fn ahead(_: u64) -> PathKind {
    PathKind::Straight { length_m: 4.0 }
}

pub fn eight(_: u64) -> PathKind {
    PathKind::FigureEight { length_m: 1.5, laps: 1.0 }
}

fn straight(_: u64) -> PathKind {
    PathKind::Straight { length_m: 40.0 }
}

/// Lanes with 50 % overlap, so that each lane closes loops with the previous one.
fn lanes(_: u64) -> PathKind {
    PathKind::Lanes { length_m: 2.5, spacing_m: 0.4, count: 4 }
}

/// Image noise of two gray levels (standard deviation) and no other effect.
fn noise() -> Effects {
    Effects { noise_gray: 2.0, ..Effects::default() }
}

/// An easy drive over asphalt; the base of all other rows.
pub fn clean() -> BenchmarkRow {
    BenchmarkRow {
        name: "asphalt",
        texture: "asphalt",
        path: wandering,
        speed_m_s: 0.6,
        turn_rate_rad_s: TAU / 2.0,
        effects: noise(),
        size_px: FULL_PX,
        fps: 30.0,
        rig: Rig::level(HEIGHT_M),
        given_rig: Rig::level(HEIGHT_M),
        lens_is_careless: false,
        readout_is_given: false,
        h264_qp: None,
        alteration: None,
        follow: Follow::Recorded,
        seeds: 1,
    }
}

/// The clean drive with other effects.
pub fn with(name: &'static str, effects: Effects) -> BenchmarkRow {
    BenchmarkRow { name, effects, ..clean() }
}

/// The same at 320x240 with three seeds, at a quarter of the time per seed.
fn small(name: &'static str, effects: Effects) -> BenchmarkRow {
    BenchmarkRow { size_px: SMALL_PX, seeds: 3, ..with(name, effects) }
}

/// All rendered rows, in the order of the table.
pub fn rows() -> Vec<BenchmarkRow> {
    let degree = 1f64.to_radians();
    let vibration = Vibration { shift_m: 0.004, turn_rad: 0.01, frequency_hz: 7.0 };
    let lit = Effects {
        lighting: Some(Lighting { drift: 0.25, offset_gray: 8.0, flicker: 0.08, flicker_hz: 97.0 }),
        ground_shadow: 0.35,
        carrier_shadow: Some(Shadow::default()),
        ..noise()
    };
    let object = MovingObject { radius_m: 0.09, speed_m_s: 0.3, every_s: 2.5 };
    let height = |amplitude| Some(SlowVariation { amplitude, period_s: 5.0 });
    let tilt = |degrees: f64| Some(SlowVariation { amplitude: degrees.to_radians(), period_s: 4.0 });
    let hand_held = Effects {
        vibration: Some(Vibration { shift_m: 0.006, turn_rad: 0.012, frequency_hz: 4.0 }),
        height_change: height(0.1),
        tilt_change: tilt(3.0),
        exposure_s: 0.004,
        object: Some(object),
        noise_gray: 3.0,
        ..lit.clone()
    };
    let tilted = Rig { roll_rad: 1.0 * degree, pitch_rad: -0.7 * degree, ..Rig::level(HEIGHT_M) };
    let rolling = Effects { readout_s: 0.020, ..noise() };
    let on = |terrain| Effects { terrain, ..noise() };
    let relief = Relief { amplitude_m: 0.005, scale_m: 0.06 };
    let undulation = Undulation { amplitude_m: 0.03, wavelength_m: 2.0 };
    let gravel = Relief { amplitude_m: 0.015, scale_m: 0.06 };
    let ramp = Ramp { slope: 0.1, at_m: 2.0 };
    let kerb = Kerb { height_m: 0.05, at_m: 2.0 };
    let low_kerb = Kerb { height_m: 0.03, at_m: 1.0 };
    let dark = vec![Blackout { from_s: 3.0, to_s: 5.0 }];
    vec![
        clean(),
        BenchmarkRow { name: "carpet", texture: "carpet", ..clean() },
        BenchmarkRow { name: "grass", texture: "grass", ..clean() },
        BenchmarkRow { name: "concrete", texture: "concrete", ..clean() },
        BenchmarkRow { name: "corner-turn", path: corner_turn, ..clean() },
        BenchmarkRow { name: "tiles", texture: "tiles", ..clean() },
        BenchmarkRow { name: "bricks", texture: "bricks", ..clean() },
        BenchmarkRow { texture: "bare", ..with("faint", Effects { noise_gray: 1.0, ..noise() }) },
        BenchmarkRow { texture: "bare", ..small("faint-noise", noise()) },
        BenchmarkRow {
            texture: "bare",
            rig: tilted,
            ..with("faint-tilt-unknown", Effects { noise_gray: 1.0, ..noise() })
        },
        with("noise-6-gray", Effects { noise_gray: 6.0, ..noise() }),
        with("vibration", Effects { vibration: Some(vibration), ..noise() }),
        with("blur-10ms", Effects { exposure_s: 0.010, ..noise() }),
        small("blur-33ms", Effects { exposure_s: 0.033, ..noise() }),
        with("light-shadow", lit),
        with("moving-object", Effects { object: Some(object), ..noise() }),
        with("dropped", Effects { timing: Timing { dropped: 0.33, jitter_s: 0.003 }, ..noise() }),
        with("height-10pct", Effects { height_change: height(0.1), ..noise() }),
        with("tilt-3deg", Effects { tilt_change: tilt(3.0), ..noise() }),
        BenchmarkRow { name: "tilt-unknown", rig: tilted, ..clean() },
        BenchmarkRow { name: "tilt-unknown-live", rig: tilted, follow: Follow::Live, ..clean() },
        BenchmarkRow { name: "height-told-2pct-low", given_rig: Rig::level(0.98 * HEIGHT_M), ..clean() },
        BenchmarkRow { name: "lens-careless", lens_is_careless: true, ..clean() },
        BenchmarkRow { name: "lens-careless-ahead", path: ahead, lens_is_careless: true, ..clean() },
        BenchmarkRow { texture: "grass", ..with("hand-held", hand_held.clone()) },
        BenchmarkRow { texture: "grass", ..small("hand-held-small", hand_held) },
        BenchmarkRow {
            path: straight,
            // 0.58 m per frame is 60 % of the image width on the ground.
            speed_m_s: 17.3,
            ..with("fast", Effects { exposure_s: 0.0009, ..noise() })
        },
        BenchmarkRow { path: ahead, ..with("rolling-20ms", rolling.clone()) },
        BenchmarkRow { path: ahead, readout_is_given: true, ..with("rolling-20ms-told", rolling.clone()) },
        BenchmarkRow { path: eight, ..with("rolling-eight", rolling.clone()) },
        BenchmarkRow { path: eight, readout_is_given: true, ..with("rolling-eight-told", rolling.clone()) },
        BenchmarkRow {
            path: ahead,
            readout_is_given: true,
            ..with(
                "rolling-undulation-told",
                Effects {
                    terrain: Terrain { undulation: Some(undulation), ..Terrain::default() },
                    ..rolling.clone()
                },
            )
        },
        with("rolling-vibration", Effects { vibration: Some(vibration), ..rolling.clone() }),
        BenchmarkRow {
            path: ahead,
            ..small(
                "rolling-gravel",
                Effects {
                    terrain: Terrain { relief: Some(relief), ..Terrain::default() },
                    ..rolling.clone()
                },
            )
        },
        BenchmarkRow {
            texture: "tiles",
            path: ahead,
            ..small(
                "rolling-tiles-shadow",
                Effects {
                    carrier_shadow: Some(Shadow { darkness: 0.5, ..Shadow::default() }),
                    noise_gray: 4.0,
                    ..rolling
                },
            )
        },
        BenchmarkRow {
            texture: "concrete",
            ..with("bumper", Effects { bumper: Some(Bumper { share: 0.15 }), ..noise() })
        },
        BenchmarkRow {
            texture: "concrete",
            ..with("dirt", Effects { dirt: Some(Dirt { count: 30 }), ..noise() })
        },
        BenchmarkRow {
            texture: "concrete",
            ..with("own-shadow", Effects { carrier_shadow: Some(Shadow::default()), ..noise() })
        },
        BenchmarkRow {
            texture: "concrete",
            ..with("own-lamp", Effects { lamp: Some(Lamp::default()), ..noise() })
        },
        BenchmarkRow {
            seeds: 1,
            ..small("relief-5mm", on(Terrain { relief: Some(relief), ..Terrain::default() }))
        },
        BenchmarkRow {
            seeds: 1,
            ..small("undulation", on(Terrain { undulation: Some(undulation), ..Terrain::default() }))
        },
        BenchmarkRow {
            seeds: 1,
            ..small("relief-15mm", on(Terrain { relief: Some(gravel), ..Terrain::default() }))
        },
        BenchmarkRow {
            seeds: 1,
            ..small(
                "undulation-ride",
                on(Terrain { undulation: Some(undulation), ride: true, ..Terrain::default() }),
            )
        },
        BenchmarkRow {
            seeds: 1,
            ..with(
                "undulation-ride-bumper",
                Effects {
                    terrain: Terrain { undulation: Some(undulation), ride: true, ..Terrain::default() },
                    bumper: Some(Bumper { share: 0.25 }),
                    noise_gray: 4.0,
                    ..noise()
                },
            )
        },
        BenchmarkRow {
            path: ahead,
            seeds: 1,
            ..small("ramp-ride", on(Terrain { ramp: Some(ramp), ride: true, ..Terrain::default() }))
        },
        BenchmarkRow {
            path: ahead,
            seeds: 1,
            ..small("kerb", on(Terrain { kerb: Some(kerb), ..Terrain::default() }))
        },
        BenchmarkRow {
            path: lanes,
            fps: 15.0,
            follow: Follow::Mapped,
            seeds: 1,
            ..small("kerb-lanes", on(Terrain { kerb: Some(low_kerb), ..Terrain::default() }))
        },
        BenchmarkRow {
            path: lanes,
            fps: 15.0,
            follow: Follow::Mapped,
            seeds: 1,
            ..small("undulation-lanes", on(Terrain { undulation: Some(undulation), ..Terrain::default() }))
        },
        small("blackout-2s", Effects { blackouts: dark, ..noise() }),
        BenchmarkRow { name: "h264-qp28", h264_qp: Some(28), ..clean() },
        BenchmarkRow { name: "grille", texture: "concrete", alteration: Some(Alteration::Grille), ..clean() },
        BenchmarkRow {
            path: lanes,
            fps: 15.0,
            rig: Rig { roll_rad: 0.3 * degree, pitch_rad: -0.2 * degree, ..Rig::level(HEIGHT_M) },
            follow: Follow::Mapped,
            ..small("loop", Effects { noise_gray: 10.0, ..noise() })
        },
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn names_are_unique_and_in_kebab_case() {
        let names: BTreeSet<&str> = rows().iter().map(|row| row.name).collect();
        assert_eq!(names.len(), rows().len());
        let kebab = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-';
        assert!(names.iter().all(|name| name.chars().all(kebab)), "{names:?}");
    }
}
