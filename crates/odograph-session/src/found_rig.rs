//! The rig file that a run writes: where the camera and the antenna were found to be on the robot.

use crate::earth::{Antenna, FOUND_RIG};
use nalgebra::{Rotation2, Vector2};
use odograph::camera::{LeverArm, MeasuredRig, Rig, RigDeviations};
use odograph::filter::fusion::{SensorKind, SensorReport};
use odograph::formats::decimal::Rounded;
use odograph::formats::rig_file;
use odograph::geometry::wrap_angle;
use std::fmt::Write;

/// Largest standard deviation of a lever arm that is worth writing, metres.
const WORST_M: f64 = 0.1;

/// Where the camera was found to be in the frame of the wheels: their axle moves straight ahead.
#[derive(Debug, Clone, Copy)]
pub struct FoundMounting {
    yaw_rad: f64,
    yaw_deviation_rad: f64,
    place_m: Vector2<f64>,
    deviation_m: Vector2<f64>,
}

impl FoundMounting {
    /// As the wheel shows it, unless the rig file states it; `None` where the drive has not
    /// determined it.
    pub fn of(reports: &[SensorReport], rig: &Rig) -> Option<Self> {
        let wheel = reports.iter().find(|report| report.sensor == SensorKind::Wheel)?;
        if rig.lever_arm.is_some() || wheel.rejected.is_some() {
            return None;
        }
        let named = |name: &str| wheel.parameters.iter().find(|parameter| parameter.name == name);
        let (ahead, left) = (named("camera_ahead_m")?, named("camera_left_m")?);
        let direction = named("direction_rad")?;
        if ahead.sigma.max(left.sigma) > WORST_M {
            return None;
        }
        // The wheel has seen the place along the camera's axes.
        let yaw_rad = wrap_angle(-direction.value);
        let base_from_camera = Rotation2::new(yaw_rad);
        let place_m = base_from_camera * Vector2::new(ahead.value, left.value);
        let variances = Vector2::new(ahead.sigma.powi(2), left.sigma.powi(2));
        let squares = base_from_camera.matrix().map(|number| number * number);
        let turned = Vector2::new(place_m.y, place_m.x).map(|arm_m| (arm_m * direction.sigma).powi(2));
        let deviation_m = (squares * variances + turned).map(f64::sqrt);
        Some(Self { yaw_rad, yaw_deviation_rad: direction.sigma, place_m, deviation_m })
    }

    /// A sentence for the person who runs it.
    pub fn sentence(&self) -> String {
        let [x_m, y_m, worst_m] = [self.place_m.x, self.place_m.y, self.deviation_m.amax()].map(Rounded);
        format!(
            "by the wheel the camera is {x_m:.3} m ahead and {y_m:.3} m to the left of its axle (± {worst_m:.3} m); \
             {FOUND_RIG} has that, to be given as --rig for poses of the robot"
        )
    }
}

/// The text of the rig file; `None` where nothing was found.
pub fn text(rig: &Rig, mounting: Option<&FoundMounting>, antenna: &Antenna) -> Option<String> {
    let antenna_m = antenna.found_m();
    if mounting.is_none() && antenna_m.is_none() {
        return None;
    }
    let mut deviations = RigDeviations::default();
    let mut found = *rig;
    let below = LeverArm { x_m: 0.0, y_m: 0.0, z_m: rig.height_m };
    let mut comment = "";
    if let Some(mounting) = mounting {
        let at_m = rounded(mounting.place_m);
        let (x_m, y_m) = (at_m.x, at_m.y);
        found = Rig { yaw_rad: mounting.yaw_rad, lever_arm: Some(LeverArm { x_m, y_m, ..below }), ..found };
        deviations.yaw_rad = Some(mounting.yaw_deviation_rad);
        (deviations.x_m, deviations.y_m) = (Some(mounting.deviation_m.x), Some(mounting.deviation_m.y));
        comment = "# base_link is on the ground below the wheels' axle, as wheel and camera show.\n";
    } else if found.lever_arm.is_none() {
        found.lever_arm = Some(below);
        comment = "# base_link is taken to be on the ground below the camera.\n";
    }
    let antenna_line = antenna_m.map(|(at_m, sigma_m)| {
        deviations.antenna_m = Some(sigma_m);
        // Without a lever arm in the rig file the antenna was found along the camera's axes.
        let at_m = match rig.lever_arm {
            Some(_) => at_m,
            None => {
                let camera_m = found.lever_arm.map_or_else(Vector2::zeros, |arm| Vector2::new(arm.x_m, arm.y_m));
                camera_m + Rotation2::new(found.yaw_rad) * at_m
            }
        };
        let at_m = rounded(at_m);
        format!(
            "# The antenna by its positions; its height is not known.\ngnss_lever_arm_m = [{:?}, {:?}, 0.0]\n",
            at_m.x, at_m.y
        )
    });
    let mut text = String::from(comment);
    let _ = write!(text, "{}", rig_file::write_measured(&MeasuredRig { rig: found, deviations }));
    text += &antenna_line.unwrap_or_default();
    Some(text)
}

/// To a tenth of a millimetre.
fn rounded(place_m: Vector2<f64>) -> Vector2<f64> {
    place_m.map(|number| (1e4 * number).round() / 1e4 + 0.0)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;
    use odograph::filter::fusion::SensorParameter;

    fn wheel(direction_rad: f64, ahead_m: f64, left_m: f64) -> SensorReport {
        let parameter = |name, value, sigma| SensorParameter { name, value, sigma };
        SensorReport {
            sensor: SensorKind::Wheel,
            rejected: None,
            offset: None,
            parameters: vec![
                parameter("scale", 1.0, 0.01),
                parameter("direction_rad", direction_rad, 0.001),
                parameter("camera_ahead_m", ahead_m, 0.001),
                parameter("camera_left_m", left_m, 0.002),
            ],
            noise: None,
            seconds: 10,
            contradictions: 0,
            nis: None,
        }
    }

    #[test]
    fn a_camera_turned_to_the_left_is_where_the_wheel_has_it() {
        // The top of the image points to the robot's left, so that the robot drives to the right of
        // the image; the camera is 0.3 m ahead of the axle and 0.1 m to its left.
        let quarter = std::f64::consts::FRAC_PI_2;
        let report = wheel(-quarter, 0.1, -0.3);
        let found = FoundMounting::of(std::slice::from_ref(&report), &Rig::level(0.8)).unwrap();
        let text = text(&Rig::level(0.8), Some(&found), &Antenna::default()).unwrap();
        let read = rig_file::parse_measured(&text).unwrap();
        assert_eq!(read.rig.lever_arm, Some(LeverArm { x_m: 0.3, y_m: 0.1, z_m: 0.8 }), "{text}");
        assert!((read.rig.yaw_rad - quarter).abs() < 1e-9, "{text}");
        let deviations = read.deviations;
        assert!((deviations.x_m.unwrap() - 0.002).abs() < 1e-4, "{text}");
        assert!((deviations.y_m.unwrap() - 0.00104).abs() < 1e-4, "{text}");
        // What the rig file states is not found again.
        let stated = Rig { lever_arm: read.rig.lever_arm, ..Rig::level(0.8) };
        assert!(FoundMounting::of(&[report], &stated).is_none());
    }

    #[test]
    fn a_place_that_the_drive_leaves_open_is_not_written() {
        let mut report = wheel(0.0, 0.1, 0.0);
        report.parameters[2].sigma = 0.4;
        assert!(FoundMounting::of(&[report], &Rig::level(0.8)).is_none());
    }
}
