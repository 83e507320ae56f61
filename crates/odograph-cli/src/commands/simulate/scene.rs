//! From options to a scene.

use super::{PathName, SimulateArguments, TilingName, photographs};
use crate::{files, lengths};
use odograph::camera::{Camera, Rig};
use odograph::error::{Error, Result};
use odograph::formats::camera_file;
use odograph::geometry::Pixel;
use odograph_calibration::MarkerFamily;
use odograph_simulation::{
    Blackout, Breathing, Bumper, Dirt, Effects, ExposureJumps, Kerb, Lamp, Lighting, MovingObject, Path,
    PathKind, Ramp, Relief, SensorErrors, Shadow, SimulatedSensors, SimulationConfig, SlowVariation, Sway,
    Terrain, Texture, Tiling, Timing, Undulation, Vibration, ordinary_camera,
};
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Everything as used, for `simulation.toml`.
#[derive(Debug, Serialize)]
pub struct Parameters {
    texture: Vec<String>,
    photo_width_m: Vec<f64>,
    tiling: Vec<TilingName>,
    speed_m_s: f64,
    turn_rate_deg_s: f64,
    rolling: bool,
    duration_s: f64,
    fps: f64,
    seed: u64,
    color: bool,
    size_px: [usize; 2],
    camera: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    markers: Option<String>,
    path: PathKind,
    rig: Rig,
    effects: Effects,
    /// The errors of the other sensors, if they are written.
    #[serde(skip_serializing_if = "Option::is_none")]
    sensors: Option<BTreeMap<&'static str, SensorErrors>>,
}

impl Parameters {
    /// Adds the errors of the other sensors.
    pub fn with_sensors(self, sensors: &SimulatedSensors) -> Self {
        let SimulatedSensors { gyro, heading, wheel, range, .. } = *sensors;
        let errors = [("gyro", gyro), ("heading", heading), ("wheel", wheel), ("range", range)];
        Self { sensors: Some(BTreeMap::from(errors)), ..self }
    }

    /// The text of `simulation.toml`.
    pub fn as_toml(&self) -> Result<String> {
        toml::to_string(self)
            .map_err(|error| Error::output(format!("the parameters cannot be written as TOML: {error}")))
    }
}

/// `--vibration` as it was typed.
#[derive(Debug, Clone, Copy)]
pub struct VibrationOption(Vibration);

/// A number and a second one that may be left out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairOption(f64, Option<f64>);

/// `--markers` as it was typed.
#[derive(Debug, Clone, PartialEq)]
pub struct MarkersOption {
    pub family: MarkerFamily,
    pub spacing_m: f64,
    text: String,
}

/// `apriltag:36h11:80mm:10m`.
pub fn parse_markers(text: &str) -> std::result::Result<MarkersOption, String> {
    let (family, spacing) = text
        .rsplit_once(':')
        .filter(|(family, _)| family.matches(':').count() == 2)
        .ok_or("markers are written as FAMILY:SIZE:SPACING, for example apriltag:36h11:80mm:10m")?;
    let family = family.parse::<MarkerFamily>().map_err(|error| error.to_string())?;
    Ok(MarkersOption { family, spacing_m: lengths::metres(spacing)?, text: text.to_owned() })
}

/// Builds the scene that the options describe, and returns it with its parameters.
pub fn from_arguments(arguments: &SimulateArguments) -> Result<(SimulationConfig, Parameters)> {
    let camera = camera(arguments)?;
    let rig = Rig {
        height_m: arguments.height.metres,
        roll_rad: arguments.roll.to_radians(),
        pitch_rad: arguments.pitch.to_radians(),
        yaw_rad: arguments.yaw.to_radians(),
        lever_arm: None,
    }
    .validated()?;
    let kind = path_kind(arguments, &camera, &rig)?;
    let speed_m_s = arguments.speed.unwrap_or(0.5);
    let turn_rate_deg_s = arguments.turn_rate.unwrap_or(30.0);
    let path = Path::new(kind, speed_m_s, turn_rate_deg_s.to_radians(), !arguments.rolling)?;
    let effects = effects(arguments, &rig, &camera).validated()?;
    let config = SimulationConfig {
        texture: texture(arguments)?,
        effects: effects.clone(),
        fps: arguments.fps,
        duration_s: arguments.duration,
        colored: arguments.color,
        seed: arguments.seed,
        camera,
        rig,
        path,
    };
    let parameters = Parameters {
        texture: arguments.texture.clone(),
        photo_width_m: or_default(&arguments.photo_width, PHOTO_WIDTH_M),
        tiling: or_default(&arguments.tiling, TilingName::Mirror),
        speed_m_s,
        turn_rate_deg_s,
        rolling: arguments.rolling,
        duration_s: arguments.duration.unwrap_or(config.path.duration_s()),
        fps: arguments.fps,
        seed: arguments.seed,
        color: arguments.color,
        size_px: [config.camera.width(), config.camera.height()],
        camera: arguments.camera.as_ref().map(|file| file.display().to_string()),
        markers: arguments.markers.as_ref().map(|markers| markers.text.clone()),
        path: kind,
        rig,
        effects,
        sensors: None,
    };
    Ok((config, parameters))
}

/// Default width of the ground that a photograph shows, metres.
const PHOTO_WIDTH_M: f64 = 2.0;

fn or_default<T: Copy>(given: &[T], default: T) -> Vec<T> {
    if given.is_empty() { vec![default] } else { given.to_vec() }
}

/// The camera of the file, or the ordinary one of that size.
pub fn camera(arguments: &SimulateArguments) -> Result<Camera> {
    let Some(file) = &arguments.camera else {
        return ordinary_camera(arguments.size.unwrap_or((640, 480)));
    };
    let text = files::read_text(file)?;
    let camera = camera_file::parse(&text, arguments.size).map_err(|error| error.at(file.display()))?;
    let size = (camera.width(), camera.height());
    match arguments.size {
        Some((w, h)) if (w, h) != size => Err(Error::usage(format!(
            "--size {w}x{h} does not fit {}, whose images have {}x{}; leave one of them out",
            file.display(),
            size.0,
            size.1
        ))),
        _ => Ok(camera),
    }
}

fn path_kind(arguments: &SimulateArguments, camera: &Camera, rig: &Rig) -> Result<PathKind> {
    let length_m = |default: f64| arguments.length.unwrap_or(default);
    let pivot = |default_turns: f64| {
        let turns = arguments.turns.unwrap_or(default_turns);
        let corner = camera.ray_from_pixel(Pixel::new(0.0, 0.0));
        let about = corner.and_then(|ray| rig.first_pose().ground_from_ray(ray)).ok_or_else(|| {
            Error::usage("the top left corner of the image does not see the ground; tilt the camera less to pivot about it")
        })?;
        Ok(PathKind::Pivot { about, turn_rad: turns * std::f64::consts::TAU })
    };
    Ok(match arguments.path {
        PathName::Still => PathKind::Still { duration_s: arguments.duration.unwrap_or(5.0) },
        PathName::Straight => PathKind::Straight { length_m: length_m(5.0) },
        PathName::Square => PathKind::SquareByTranslation { side_m: length_m(2.0) },
        PathName::SquareTurns => PathKind::SquareWithTurns { side_m: length_m(2.0) },
        PathName::Pivot => pivot(1.0)?,
        PathName::Spin => pivot(5.0)?,
        PathName::Eight => {
            PathKind::FigureEight { length_m: length_m(4.0), laps: arguments.turns.unwrap_or(1.0) }
        }
        PathName::Lanes => PathKind::Lanes {
            length_m: length_m(3.0),
            spacing_m: arguments.spacing.unwrap_or(0.6),
            count: arguments.lanes.unwrap_or(4),
        },
        PathName::Walk => PathKind::RandomWalk { length_m: length_m(10.0), seed: arguments.seed },
    })
}

fn effects(arguments: &SimulateArguments, rig: &Rig, camera: &Camera) -> Effects {
    Effects {
        exposure_s: arguments.blur,
        readout_s: arguments.readout_ms / 1000.0,
        noise_gray: arguments.noise,
        vignetting: arguments.vignetting,
        vibration: arguments.vibration.map(|vibration| vibration.0),
        height_change: arguments
            .height_change
            .map(|percent| SlowVariation { amplitude: percent / 100.0, period_s: 6.0 }),
        tilt_change: arguments
            .tilt_change
            .map(|degrees| SlowVariation { amplitude: degrees.to_radians(), period_s: 4.0 }),
        breathing: arguments.breathing.map(|PairOption(percent, seconds)| Breathing {
            share: percent / 100.0,
            period_s: seconds.unwrap_or(5.0),
        }),
        terrain: terrain(arguments),
        sway: arguments.sway.map(|PairOption(px, share)| {
            let (fx, fy) = camera.focal_px();
            let footprint_m = rig.height_m / (fx * fy).sqrt();
            Sway { amplitude_m: px * footprint_m, share: share.unwrap_or(0.3), period_s: 1.6 }
        }),
        bumper: arguments.bumper.map(|share| Bumper { share }),
        dirt: arguments.dirt.map(|count| Dirt { count }),
        lamp: arguments.lamp.map(|strength| Lamp { strength, ..Lamp::default() }),
        // Lamps on 50 Hz mains flicker at 100 Hz.
        lighting: arguments.lighting.map(|share| Lighting {
            drift: share,
            offset_gray: 20.0 * share,
            flicker: share / 4.0,
            flicker_hz: 100.0,
        }),
        exposure_jumps: arguments.exposure_jumps.map(|amount| ExposureJumps { amount, every_s: 3.0 }),
        carrier_shadow: arguments.shadow.map(|darkness| Shadow { darkness, ..Shadow::default() }),
        ground_shadow: arguments.ground_shadow.unwrap_or(0.0),
        object: arguments.object.map(|speed_m_s| MovingObject {
            // About a fifth of the view of an ordinary lens.
            radius_m: 0.13 * rig.height_m,
            speed_m_s,
            every_s: 4.0,
        }),
        blackouts: arguments.blackout.clone(),
        timing: Timing { dropped: arguments.dropped, jitter_s: arguments.jitter / 1000.0 },
    }
}

fn terrain(arguments: &SimulateArguments) -> Terrain {
    Terrain {
        relief: arguments.relief.map(|PairOption(mm, scale_cm)| Relief {
            amplitude_m: mm / 1000.0,
            scale_m: scale_cm.unwrap_or(3.0) / 100.0,
        }),
        undulation: arguments.undulation.map(|PairOption(cm, wavelength_m)| Undulation {
            amplitude_m: cm / 100.0,
            wavelength_m: wavelength_m.unwrap_or(2.0),
        }),
        kerb: arguments
            .kerb
            .map(|PairOption(cm, at_m)| Kerb { height_m: cm / 100.0, at_m: at_m.unwrap_or(1.0) }),
        ramp: arguments
            .ramp
            .map(|PairOption(percent, at_m)| Ramp { slope: percent / 100.0, at_m: at_m.unwrap_or(1.0) }),
        ride: arguments.ride,
    }
}

fn texture(arguments: &SimulateArguments) -> Result<Texture> {
    // Values given once hold for all photographs.
    let nth = |n: usize| {
        let width_m =
            arguments.photo_width.get(n).or(arguments.photo_width.last()).copied().unwrap_or(PHOTO_WIDTH_M);
        let tiling =
            arguments.tiling.get(n).or(arguments.tiling.last()).copied().unwrap_or(TilingName::Mirror);
        (width_m, tiling)
    };
    let one = |n: usize, name: &str| {
        if let Some(texture) = Texture::named(name) {
            return Ok(texture);
        }
        let (width_m, tiling) = nth(n);
        let image = photographs::read(name)?;
        let tiling = match tiling {
            TilingName::Mirror => Tiling::Mirror,
            TilingName::Repeat => Tiling::Repeat,
            TilingName::Scatter => Tiling::Scatter,
        };
        Texture::from_image(&image, width_m / image.width() as f64, tiling).map_err(|error| error.at(name))
    };
    match arguments.texture.as_slice() {
        [name] => one(0, name),
        [first, second] => Ok(Texture::Patchwork {
            first: Arc::new(one(0, first)?),
            second: Arc::new(one(1, second)?),
            patch_m: 1.6,
        }),
        more => Err(Error::usage(format!("--texture was given {} times; two are the limit", more.len()))),
    }
}

/// `640x480`.
pub fn parse_size(text: &str) -> std::result::Result<(usize, usize), String> {
    let parts = text.split_once(['x', 'X', '×']);
    let size = parts.and_then(|(w, h)| Some((w.trim().parse().ok()?, h.trim().parse().ok()?)));
    match size {
        Some((w, h)) if (16..=8192).contains(&w) && (16..=8192).contains(&h) => Ok((w, h)),
        _ => Err("an image size is written as 640x480, each side from 16 to 8192".to_string()),
    }
}

/// `2`, `2:0.5` or `2:0.5:12`: millimetres, degrees, hertz.
pub fn parse_vibration(text: &str) -> std::result::Result<VibrationOption, String> {
    let numbers: Option<Vec<f64>> = text.split(':').map(|part| part.trim().parse().ok()).collect();
    let (mm, degrees, frequency_hz) = match numbers.as_deref() {
        Some([mm]) => (*mm, 0.1 * mm, 8.0),
        Some([mm, degrees]) => (*mm, *degrees, 8.0),
        Some([mm, degrees, hz]) => (*mm, *degrees, *hz),
        _ => {
            return Err("vibration is written as MM, MM:DEG or MM:DEG:HZ, for example 2:0.3:8".to_string());
        }
    };
    Ok(VibrationOption(Vibration { shift_m: mm / 1000.0, turn_rad: degrees.to_radians(), frequency_hz }))
}

/// Millimetres, and a distance in centimetres, or both with units: `8`, `8:3`, `8mm:3cm`.
pub fn parse_mm_cm(text: &str) -> std::result::Result<PairOption, String> {
    lengths_of(text, 1e-3, 1e-2)
}

/// Centimetres, and a distance in metres, or both with units: `5`, `5:1.5`, `50mm:150cm`.
pub fn parse_cm_m(text: &str) -> std::result::Result<PairOption, String> {
    lengths_of(text, 1e-2, 1.0)
}

/// Two lengths, the second of which may be missing, each in its own unit.
fn lengths_of(text: &str, first_m: f64, second_m: f64) -> std::result::Result<PairOption, String> {
    let (first, second) = text.split_once(':').map_or((text, None), |(a, b)| (a, Some(b)));
    let second = second.map(|text| lengths::in_unit(text, second_m)).transpose()?;
    Ok(PairOption(lengths::in_unit(first, first_m)?, second))
}

/// `5` or `5:1.5`.
pub fn parse_pair(text: &str) -> std::result::Result<PairOption, String> {
    let number = |part: &str| part.trim().parse::<f64>().ok();
    let pair = match text.split_once(':') {
        Some((first, second)) => number(first).zip(number(second)).map(|(a, b)| PairOption(a, Some(b))),
        None => number(text).map(|first| PairOption(first, None)),
    };
    pair.ok_or("it is written as one number, or as two with a colon between, for example 5:1.5".to_string())
}

/// `2.5:4`: covered from 2.5 to 4 seconds.
pub fn parse_blackout(text: &str) -> std::result::Result<Blackout, String> {
    let times =
        text.split_once(':').and_then(|(a, b)| Some((a.trim().parse().ok()?, b.trim().parse().ok()?)));
    match times {
        Some((from_s, to_s)) if from_s < to_s => Ok(Blackout { from_s, to_s }),
        _ => Err("a blackout is written as FROM:TO in seconds, for example 2.5:4".to_string()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_or_refused() {
        assert_eq!(parse_size("640x480"), Ok((640, 480)));
        for bad in ["640", "0x480", "640x", "640x-480", "99999x99999", "axb"] {
            assert!(parse_size(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn vibration_and_blackouts_are_read_or_refused() {
        let VibrationOption(vibration) = parse_vibration("2:0.5:12").unwrap();
        assert_eq!((vibration.shift_m, vibration.frequency_hz), (0.002, 12.0));
        assert!(parse_vibration("a lot").is_err() && parse_vibration("1:2:3:4").is_err());
        assert_eq!(parse_blackout("2.5:4"), Ok(Blackout { from_s: 2.5, to_s: 4.0 }));
        assert_eq!(parse_pair("-5"), Ok(PairOption(-5.0, None)));
        assert_eq!(parse_pair("5:1.5"), Ok(PairOption(5.0, Some(1.5))));
        assert_eq!(parse_cm_m("-5"), Ok(PairOption(-5.0, None)));
        assert_eq!(parse_cm_m("50mm:150cm"), Ok(PairOption(5.0, Some(1.5))));
        assert_eq!(parse_mm_cm("8:3"), Ok(PairOption(8.0, Some(3.0))));
        assert!(parse_mm_cm("8 apples").unwrap_err().contains("90cm"));
        assert_eq!(parse_markers("apriltag:36h11:80mm:10m").unwrap().spacing_m, 10.0);
        assert!(parse_markers("apriltag:36h11:80mm").unwrap_err().contains("FAMILY:SIZE:SPACING"));
        assert!(parse_markers("apriltag:99:80mm:1m").unwrap_err().contains("there is no family"));
        assert!(parse_pair("5:").is_err() && parse_pair("high").is_err() && parse_pair("1:2:3").is_err());
        assert!(parse_blackout("4:2.5").is_err() && parse_blackout("4").is_err());
    }
}
