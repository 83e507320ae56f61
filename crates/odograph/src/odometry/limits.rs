//! Valid ranges of the parameters, which users edit in files.

use super::OdometryConfig;
use crate::error::{Error, Result};
use std::fmt::Display;
use std::ops::RangeInclusive;

impl OdometryConfig {
    /// Checks that each parameter is within its range.
    ///
    /// # Errors
    ///
    /// Names the parameter, its value and its range if it is not a number or out of range. Upper
    /// limits are far beyond use and bound memory and time.
    pub fn validated(self) -> Result<Self> {
        let Self { detection, flow, motion, keyframe, filter } = &self;
        check("detection.corners", detection.corners, 1..=100_000)?;
        check("detection.minimum_distance_px", detection.minimum_distance_px, 1.0..=10_000.0)?;
        check("detection.quality", detection.quality, 0.0..=1.0)?;
        check("detection.window_radius_px", detection.window_radius_px, 1..=15)?;
        check("flow.levels", flow.levels, 1..=16)?;
        check("flow.iterations", flow.iterations, 1..=1000)?;
        check("flow.step_px", flow.step_px, 0.0..=1.0)?;
        check("flow.forward_backward_px", flow.forward_backward_px, 0.0..=10_000.0)?;
        check("flow.dissimilarity", flow.dissimilarity, 0.0..=1.0)?;
        check("motion.inlier_px", motion.inlier_px, 1e-3..=10_000.0)?;
        check("motion.minimum_inliers", motion.minimum_inliers, 3..=100_000)?;
        check("motion.minimum_inlier_fraction", motion.minimum_inlier_fraction, 0.0..=1.0)?;
        check("motion.height_prior", motion.height_prior, 1e-9..=1e3)?;
        check("motion.tilt_prior_rad", motion.tilt_prior_rad, 1e-9..=1e3)?;
        check("keyframe.support", keyframe.support, 0.0..=1.0)?;
        check("keyframe.revisit", keyframe.revisit, 0.0..=1.0)?;
        check("keyframe.remembered", keyframe.remembered, 0..=10_000)?;
        check("filter.jerk_density", filter.jerk_density, 1e-12..=1e12)?;
        check("filter.heading_jerk_density", filter.heading_jerk_density, 1e-12..=1e12)?;
        Ok(self)
    }
}

fn check<T: PartialOrd + Display>(name: &str, value: T, range: RangeInclusive<T>) -> Result<()> {
    Error::check_range(&format!("odometry.{name}"), value, range)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::FlowConfig;

    #[test]
    fn what_is_meant_by_default_is_allowed() {
        assert_eq!(OdometryConfig::default().validated().unwrap(), OdometryConfig::default());
    }

    #[test]
    fn what_makes_no_sense_is_named() {
        let with = |flow: FlowConfig| OdometryConfig { flow, ..Default::default() }.validated();
        let error = with(FlowConfig { levels: 0, ..Default::default() }).unwrap_err();
        assert_eq!(error.to_string(), "odometry.flow.levels is 0; it must lie between 1 and 16");
        let error = with(FlowConfig { step_px: f64::NAN, ..Default::default() }).unwrap_err();
        assert_eq!(error.to_string(), "odometry.flow.step_px is NaN; it must lie between 0 and 1");
    }
}
