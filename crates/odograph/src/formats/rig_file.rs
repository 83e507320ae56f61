//! Rig files: the mounting of the camera over the ground, as human-written TOML.
//!
//! ```toml
//! height_m = 0.75    # camera centre above the ground
//! roll_deg = -0.4    # 0 for a nadir-looking camera; default 0
//! pitch_deg = 1.2
//! yaw_deg = 90       # top of the image, counter-clockwise from forward
//! x_m = 0.30         # lever arm, left out where it is unknown: the camera on the robot (base_link),
//! y_m = 0            #   forward and to the left; default 0
//! z_m = 0.65         #   up; default height_m: base_link is on the ground
//! gnss_lever_arm_m = [0.1, 0, 1.2]   # antenna of a satellite receiver in base_link: x, y, z
//! ```
//!
//! Each angle may be in radians instead (`roll_rad`, …), and each of the four lengths a text with
//! its unit (`height = "75cm"`, `x = "300mm"`). A measured rig also has standard deviations, which
//! [`parse_measured`] reads: `height_deviation_m`, `roll_deviation_deg`, `pitch_deviation_deg`,
//! `yaw_deviation_deg`, `x_deviation_m`, `y_deviation_m`, and `gnss_lever_arm_deviation_m` along
//! each horizontal axis. Any other key is an error, because a misspelt angle would otherwise be 0.

use super::length;
use crate::camera::{LeverArm, MeasuredRig, Rig, RigDeviations};
use crate::error::{Error, Result};
use std::fmt::Write;
use toml::{Table, Value};

/// Largest accepted file size, bytes; rig files are a few lines.
const MAX_BYTES: usize = 1 << 20;

/// All valid keys.
const KEYS: [&str; 22] = [
    "height_m",
    "roll_deg",
    "pitch_deg",
    "yaw_deg",
    "roll_rad",
    "pitch_rad",
    "yaw_rad",
    "height_deviation_m",
    "roll_deviation_deg",
    "pitch_deviation_deg",
    "yaw_deviation_deg",
    "x_deviation_m",
    "y_deviation_m",
    "gnss_lever_arm_deviation_m",
    "x_m",
    "y_m",
    "z_m",
    "gnss_lever_arm_m",
    "height",
    "x",
    "y",
    "z",
];

/// Reads a rig from TOML.
///
/// Fails, naming the key, if the height is missing, a key is unknown, a value is not a finite
/// number or a length with its unit, a number is given twice, or the rig is invalid
/// ([`Rig::validated`]).
pub fn parse(text: &str) -> Result<Rig> {
    let table = table(text)?;
    let height_m = length(&table, "height")?.ok_or_else(|| {
        Error::input("the rig file has no `height_m`; add the camera's height above the ground in metres")
    })?;
    let rig = Rig {
        height_m,
        roll_rad: angle(&table, "roll")?,
        pitch_rad: angle(&table, "pitch")?,
        yaw_rad: angle(&table, "yaw")?,
        lever_arm: lever_arm(&table, height_m)?,
    };
    antenna(&table, &rig)?;
    rig.validated().map_err(|error| Error::input(error.to_string()))
}

/// Reads the lever arm of a satellite receiver's antenna in `base_link`; `None` if there is none.
/// Fails as [`parse`] does.
pub fn parse_antenna(text: &str) -> Result<Option<LeverArm>> {
    antenna(&table(text)?, &parse(text)?)
}

/// The lever arm of the antenna. Fails if it is not three possible lengths, or if where the camera
/// is in `base_link` is not known.
fn antenna(table: &Table, rig: &Rig) -> Result<Option<LeverArm>> {
    const KEY: &str = "gnss_lever_arm_m";
    let Some(value) = table.get(KEY) else { return Ok(None) };
    let number = |value: &Value| match value {
        Value::Float(number) => Some(*number),
        Value::Integer(number) => Some(*number as f64),
        _ => None,
    };
    let numbers: Option<Vec<f64>> = value.as_array().and_then(|array| array.iter().map(number).collect());
    let Some(&[x_m, y_m, z_m]) = numbers.as_deref() else {
        let shown: String = value.to_string().chars().take(40).flat_map(char::escape_debug).collect();
        return Err(Error::input(format!(
            "{KEY} is {shown} in the rig file; write the antenna in base_link as [forward, left, up] in metres"
        )));
    };
    if rig.lever_arm.is_none() {
        return Err(Error::input(format!(
            "the rig file has {KEY}, but not where the camera is; add x_m, y_m and z_m of the camera in base_link"
        )));
    }
    let arm = LeverArm { x_m, y_m, z_m }.validated();
    arm.map(Some).map_err(|error| Error::input(format!("{KEY} in the rig file: {error}")))
}

/// The keys of a rig file. Fails if there is one that is not known.
fn table(text: &str) -> Result<Table> {
    if text.len() > MAX_BYTES {
        return Err(Error::input(format!("the rig file has {} bytes; is this the right file?", text.len())));
    }
    let text = text.trim_start_matches('\u{feff}');
    let table: Table = text.parse().map_err(|error: toml::de::Error| {
        let line =
            error.span().map_or(1, |span| 1 + text.bytes().take(span.start).filter(|&b| b == b'\n').count());
        let message = error.message().split_whitespace().collect::<Vec<_>>().join(" ");
        let value =
            text.lines().nth(line - 1).and_then(|line| line.split_once('=')).map(|(_, value)| value.trim());
        let is_decimal_comma = value.is_some_and(|value| value.replacen(',', ".", 1).parse::<f64>().is_ok());
        let hint = if is_decimal_comma { "; write decimals with a point, 0.5 and not 0,5" } else { "" };
        Error::input(format!("line {line} of the rig file is not TOML: {message}{hint}"))
    })?;
    if let Some(unknown) = table.keys().find(|key| !KEYS.contains(&key.as_str())) {
        let shown: String = unknown.chars().take(40).flat_map(char::escape_debug).collect();
        // Every key of a few letters resembles the shortest ones.
        let long = KEYS.iter().filter(|key| key.len() > MAX_EDITS);
        let nearest = long.map(|key| (edits(&shown, key), key)).min();
        let hint = match nearest.filter(|(edits, _)| *edits <= MAX_EDITS) {
            Some((_, key)) => format!("did you mean `{key}`?"),
            None => "the keys are height_m, roll_deg, pitch_deg, yaw_deg, and x_m, y_m, z_m of the camera in base_link"
                .to_owned(),
        };
        return Err(Error::input(format!("the rig file has an unknown key `{shown}`; {hint}")));
    }
    Ok(table)
}

/// A key with more edits than this to the nearest known one is no misspelling of it.
const MAX_EDITS: usize = 4;

/// Levenshtein distance: insertions, deletions and substitutions of a character from `a` to `b`.
fn edits(a: &str, b: &str) -> usize {
    let mut row: Vec<usize> = (0..=b.chars().count()).collect();
    for (i, from) in a.chars().enumerate() {
        let mut diagonal = std::mem::replace(&mut row[0], i + 1);
        for (j, to) in b.chars().enumerate() {
            let substituted = diagonal + usize::from(from != to);
            diagonal = row[j + 1];
            row[j + 1] = substituted.min(row[j] + 1).min(diagonal + 1);
        }
    }
    row[b.chars().count()]
}

/// Writes a rig as TOML in degrees. [`parse`] returns the identical rig, except for the last bit of
/// an angle that no number of degrees represents.
pub fn write(rig: &Rig) -> String {
    let mut text = format!("height_m = {:?}\n", rig.height_m);
    for (name, radians) in [("roll", rig.roll_rad), ("pitch", rig.pitch_rad), ("yaw", rig.yaw_rad)] {
        let nearest = radians.to_degrees();
        let candidates = [nearest, nearest.next_up(), nearest.next_down()];
        let exact = candidates.into_iter().find(|degrees| degrees.to_radians() == radians);
        let _ = writeln!(text, "{name}_deg = {:?}", exact.unwrap_or(nearest));
    }
    if let Some(LeverArm { x_m, y_m, z_m }) = rig.lever_arm {
        let _ = writeln!(text, "x_m = {x_m:?}\ny_m = {y_m:?}\nz_m = {z_m:?}");
    }
    text
}

/// Writes a measured rig: the output of [`write()`] with a line for each known standard deviation.
pub fn write_measured(measured: &MeasuredRig) -> String {
    let mut text = write(&measured.rig);
    let RigDeviations { height_m, roll_rad, pitch_rad, yaw_rad, x_m, y_m, antenna_m } = measured.deviations;
    let degrees = [("roll", roll_rad), ("pitch", pitch_rad), ("yaw", yaw_rad)]
        .map(|(name, deviation)| (format!("{name}_deviation_deg"), deviation.map(f64::to_degrees)));
    let lengths = [
        ("height_deviation_m", height_m),
        ("x_deviation_m", x_m),
        ("y_deviation_m", y_m),
        ("gnss_lever_arm_deviation_m", antenna_m),
    ]
    .map(|(key, deviation)| (key.to_owned(), deviation));
    let all = lengths.into_iter().chain(degrees);
    for (key, deviation) in all {
        if let Some(deviation) = deviation {
            // Three significant digits; a standard deviation is not known more precisely.
            let _ = writeln!(text, "{key} = {deviation:.2e}");
        }
    }
    text
}

/// Reads a rig with its standard deviations. Fails as [`parse`] does, and if a standard deviation
/// is negative or not finite.
pub fn parse_measured(text: &str) -> Result<MeasuredRig> {
    let rig = parse(text)?;
    let table = table(text)?;
    let deviation = |key: &str| match number(&table, key)? {
        Some(value) if value < 0.0 => {
            Err(Error::input(format!("{key} is {value} in the rig file; it must not be negative")))
        }
        other => Ok(other),
    };
    let angle = |key: &str| Ok::<_, Error>(deviation(key)?.map(f64::to_radians));
    Ok(MeasuredRig {
        rig,
        deviations: RigDeviations {
            height_m: deviation("height_deviation_m")?,
            roll_rad: angle("roll_deviation_deg")?,
            pitch_rad: angle("pitch_deviation_deg")?,
            yaw_rad: angle("yaw_deviation_deg")?,
            x_m: deviation("x_deviation_m")?,
            y_m: deviation("y_deviation_m")?,
            antenna_m: deviation("gnss_lever_arm_deviation_m")?,
        },
    })
}

/// The lever arm, if any of its numbers is there.
fn lever_arm(table: &Table, height_m: f64) -> Result<Option<LeverArm>> {
    let [x_m, y_m, z_m] = [length(table, "x")?, length(table, "y")?, length(table, "z")?];
    let known = x_m.is_some() || y_m.is_some() || z_m.is_some();
    Ok(known.then(|| LeverArm {
        x_m: x_m.unwrap_or(0.0),
        y_m: y_m.unwrap_or(0.0),
        z_m: z_m.unwrap_or(height_m),
    }))
}

/// A length in metres, from the key in metres or the one with a unit.
fn length(table: &Table, name: &str) -> Result<Option<f64>> {
    let metres = number(table, &format!("{name}_m"))?;
    let Some(written) = table.get(name) else { return Ok(metres) };
    if metres.is_some() {
        return Err(Error::input(format!("the rig file has both `{name}` and `{name}_m`; keep one of them")));
    }
    match written.as_str().and_then(length::parse) {
        Some((metres, true)) if metres.is_finite() => Ok(Some(metres)),
        _ => {
            // As in the file, in one line.
            let in_line = |c: char| if c.is_control() { ' ' } else { c };
            let shown: String = written.to_string().chars().take(40).map(in_line).collect();
            Err(Error::input(format!(
                "{name} is {shown} in the rig file; write a length with its unit, such as \"90cm\", or \
                 {name}_m with a number of metres"
            )))
        }
    }
}

/// An angle in radians from the key in either unit; 0 if both are absent.
fn angle(table: &Table, name: &str) -> Result<f64> {
    let degrees = number(table, &format!("{name}_deg"))?;
    let radians = number(table, &format!("{name}_rad"))?;
    match (degrees, radians) {
        (Some(_), Some(_)) => Err(Error::input(format!(
            "the rig file has both `{name}_deg` and `{name}_rad`; keep one of them"
        ))),
        (Some(degrees), None) => Ok(degrees.to_radians()),
        (None, Some(radians)) => Ok(radians),
        (None, None) => Ok(0.0),
    }
}

fn number(table: &Table, key: &str) -> Result<Option<f64>> {
    let number = match table.get(key) {
        None => return Ok(None),
        Some(Value::Float(number)) => *number,
        Some(Value::Integer(number)) => *number as f64,
        Some(other) => {
            let shown: String = other.to_string().chars().take(40).collect();
            return Err(Error::input(format!("{key} is {shown} in the rig file; it must be a number")));
        }
    };
    if number.is_finite() {
        return Ok(Some(number));
    }
    Err(Error::input(format!("{key} is {number} in the rig file; it must be a finite number")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn degrees_and_radians_are_read() {
        let rig = parse("height_m = 1\nroll_deg = 90e-1\npitch_rad = 0.1").unwrap();
        assert_eq!(
            rig,
            Rig { height_m: 1.0, roll_rad: 9f64.to_radians(), pitch_rad: 0.1, yaw_rad: 0.0, lever_arm: None }
        );
    }

    #[test]
    fn lengths_are_read_in_metres_and_with_units() {
        let rig = parse("height = '75cm'\nx = '300 mm'\ny_m = -0.02").unwrap();
        assert_eq!(rig.height_m, 0.75);
        assert_eq!(rig.lever_arm, Some(LeverArm { x_m: 0.3, y_m: -0.02, z_m: 0.75 }));
        let low = parse("height_m = 0.75\nz = '65cm'").unwrap().lever_arm;
        assert_eq!(low, Some(LeverArm { x_m: 0.0, y_m: 0.0, z_m: 0.65 }));
    }

    #[test]
    fn an_antenna_is_read_where_the_camera_is_known() {
        let text = "height_m = 0.75\nx_m = 0.3\ngnss_lever_arm_m = [0.1, 0, 1.25]";
        let arm = LeverArm { x_m: 0.1, y_m: 0.0, z_m: 1.25 };
        assert_eq!(parse_antenna(text).unwrap(), Some(arm));
        assert_eq!(parse_antenna("height_m = 0.75").unwrap(), None);
        for (arm, part) in [
            ("[0.1, 0]", "gnss_lever_arm_m is [0.1, 0] in the rig file; write the antenna"),
            ("1.2", "gnss_lever_arm_m is 1.2"),
            ("[0, 0, nan]", "gnss_lever_arm_m in the rig file: the lever arm's z is NaN"),
        ] {
            let error = parse(&format!("height_m = 1\nx_m = 0\ngnss_lever_arm_m = {arm}")).unwrap_err();
            assert!(error.to_string().contains(part), "{error}");
        }
        let error = parse("height_m = 1\ngnss_lever_arm_m = [0, 0, 1]").unwrap_err().to_string();
        assert!(error.contains("not where the camera is"), "{error}");
    }

    #[test]
    fn errors_name_the_key_and_the_value() {
        for (text, part) in [
            ("", "no `height_m`"),
            ("height_m = -1", "-1 m"),
            ("height_m = nan", "height_m is NaN"),
            ("height_m = 'tall'", "height_m is \"tall\""),
            ("height_m = 1\nroll_deg = 1\nroll_rad = 1", "both `roll_deg` and `roll_rad`"),
            ("height_m = 1\npitch_deg = 95", "does not look at the ground"),
            ("height_m = 1\nroll_deg = 78", "does not look at the ground"),
            ("height_m = 1\nroll_deg = 60\npitch_deg = -62", "does not look at the ground"),
            ("height_m = 1\n\nroll_deg = = 3", "line 3"),
            ("height_m = 1\nheight_m = 2", "line 2"),
            ("height_m = 1\nroll_dg = 2", "unknown key `roll_dg`; did you mean `roll_deg`?"),
            ("height = 1", "height is 1 in the rig file; write a length with its unit"),
            ("height = \"75xx\"", "height is \"75xx\" in the rig file; write a length with its unit"),
            ("height = '1'", "with its unit"),
            ("hight_m = 1", "unknown key `hight_m`; did you mean `height_m`?"),
            ("height_m = 1\nx_mm = 300", "unknown key `x_mm`; the keys are height_m, roll_deg"),
            ("height_m = 1\nx_m = 300", "the lever arm's x is 300.0 m"),
            ("height_m = 1\nz = '-1e9cm'", "the lever arm's z is -10000000.0 m"),
            ("height_m = 1\ny_m = inf", "y_m is inf"),
            ("height_m = 1\nx_m = 1\nx = '1m'", "both `x` and `x_m`"),
            ("focal_length = 1", "unknown key `focal_length`; the keys are height_m, roll_deg"),
            ("height_m = 1\n[more]\nx = 1", "`more`"),
            ("height_m = 1\n\"a\\u001B[2J\" = 1", "`a\\u{1b}[2J`"),
            ("height_m = 1e300", "the height is 1.0e300 m"),
        ] {
            let error = parse(text).unwrap_err();
            assert!(error.to_string().contains(part), "{text:?}: {error}");
            assert_eq!(error.kind(), crate::error::ErrorKind::Input);
            assert!(!error.to_string().contains('\n'));
        }
    }

    #[test]
    fn a_measured_rig_round_trips_and_reads_as_a_rig() {
        let rig = Rig { roll_rad: 0.1, pitch_rad: -0.2, ..Rig::level(0.75) };
        let deviations = RigDeviations {
            height_m: Some(0.001),
            roll_rad: Some(0.002),
            pitch_rad: Some(0.0031),
            yaw_rad: None,
            x_m: Some(0.002),
            y_m: Some(0.003),
            antenna_m: Some(0.004),
        };
        let text = write_measured(&MeasuredRig { rig, deviations });
        assert_eq!(parse(&text).unwrap(), rig);
        let back = parse_measured(&text).unwrap();
        assert_eq!((back.rig, back.deviations.yaw_rad), (rig, None));
        let RigDeviations { x_m, y_m, antenna_m, .. } = back.deviations;
        assert_eq!((x_m, y_m, antenna_m), (Some(0.002), Some(0.003), Some(0.004)));
        assert!(parse_measured("height_m = 1\nx_deviation_m = -1").is_err());
        assert!((back.deviations.pitch_rad.unwrap() / 0.0031 - 1.0).abs() < 1e-2, "{text}");
        assert!(parse_measured("height_m = 1\nroll_deviation_deg = -1").is_err());
        assert_eq!(parse_measured("height_m = 1").unwrap().deviations, RigDeviations::default());
    }

    #[test]
    fn deep_nesting_does_not_crash() {
        for bracket in ["[", "{a="] {
            assert!(parse(&format!("a = {}", bracket.repeat(100_000))).is_err());
        }
    }

    proptest! {
        #[test]
        fn a_written_rig_is_in_degrees_and_read_back(height_m in 1e-3..1e3, roll_rad in -1.0..1.0, pitch_rad in -1.0..1.0, yaw_rad in -4.0..4.0, x_m in -9.0..9.0, z_m in -9.0..9.0, armed: bool) {
            let lever_arm = armed.then_some(LeverArm { x_m, y_m: -x_m / 3.0, z_m });
            let rig = Rig { height_m, roll_rad, pitch_rad, yaw_rad, lever_arm };
            if let Ok(rig) = rig.validated() {
                let text = write(&rig);
                prop_assert!(!text.contains("_rad"), "{}", text);
                let back = parse(&text).unwrap();
                prop_assert_eq!(back.height_m, rig.height_m);
                prop_assert_eq!(back.lever_arm, rig.lever_arm);
                for (back, rad) in [(back.roll_rad, roll_rad), (back.pitch_rad, pitch_rad), (back.yaw_rad, yaw_rad)] {
                    prop_assert!((back - rad).abs() <= rad.abs() * f64::EPSILON, "{} {}", back, rad);
                }
            }
        }

        #[test]
        fn any_text_is_survived(text in ".*") {
            let _ = parse(&text);
        }
    }
}
