//! The frames of a run as a table for people and spreadsheets.

use crate::filter::SmoothedFrame;
use crate::trajectory::FrameEstimate;
use std::fmt::Write;

/// The names of the columns.
const HEADER: &str = "frame,time_s,x_m,y_m,heading_deg,height_m,roll_deg,pitch_deg,speed_m_s,heading_rate_deg_s,\
                      sigma_x_m,sigma_y_m,sigma_heading_deg,tracks,inliers,residual_px,keyframe,segment,status";

/// One line a frame, the first line names the columns; units are in the names, angles in degrees, counter-clockwise positive.
///
/// The standard deviations are against the start of the run. `keyframe` is 0 or 1, `status` is `tracked` or `lost:` with the
/// reason. A cell is empty where the quantity is not known.
pub fn csv_from_frames(frames: &[FrameEstimate]) -> String {
    let mut text = format!("{HEADER}\n");
    for frame in frames {
        let _ = write!(text, "{},{}", frame.frame, cell(Some(frame.time_s), 9));
        let estimate = frame.estimate.as_ref();
        let pose = estimate.map(|e| e.pose);
        let velocity = estimate.map(|e| e.velocity);
        let sigma = |index: usize| estimate.map(|e| e.covariance[(index, index)].sqrt());
        for (value, decimals) in [
            (pose.map(|p| p.x_m), 6),
            (pose.map(|p| p.y_m), 6),
            (pose.map(|p| p.heading_rad.to_degrees()), 6),
            (pose.map(|p| p.height_m), 6),
            (pose.map(|p| p.roll_rad.to_degrees()), 6),
            (pose.map(|p| p.pitch_rad.to_degrees()), 6),
            (velocity.map(|v| v.speed_m_s()), 6),
            (velocity.map(|v| v.heading_rad_s.to_degrees()), 6),
            (sigma(0), 9),
            (sigma(1), 9),
            (sigma(2).map(f64::to_degrees), 9),
        ] {
            let _ = write!(text, ",{}", cell(value, decimals));
        }
        let residual_px = (frame.inliers > 0).then_some(frame.residual_px);
        let _ = writeln!(
            text,
            ",{},{},{},{},{},{}",
            frame.tracks,
            frame.inliers,
            cell(residual_px, 4),
            u8::from(frame.keyframe),
            frame.segment,
            frame.status
        );
    }
    text
}

/// The names of the columns of smoothed frames.
const SMOOTHED_HEADER: &str = "frame,time_s,x_m,y_m,heading_deg,height_m,roll_deg,pitch_deg,speed_m_s,heading_rate_deg_s,\
                               sigma_x_m,sigma_y_m,sigma_heading_deg,segment,source";

/// Smoothed frames, one line each, in the units of [`csv_from_frames`]. `source` is `measured`, `bridged` or `sensors`.
pub fn csv_from_smoothed(path: &[SmoothedFrame]) -> String {
    let mut text = format!("{SMOOTHED_HEADER}\n");
    for frame in path {
        let (pose, velocity) = (&frame.pose, &frame.velocity);
        let sigma = |index: usize| frame.covariance[(index, index)].max(0.0).sqrt();
        let _ = write!(text, "{},{}", frame.frame, cell(Some(frame.time_s), 9));
        for (value, decimals) in [
            (pose.x_m, 6),
            (pose.y_m, 6),
            (pose.heading_rad.to_degrees(), 6),
            (pose.height_m, 6),
            (pose.roll_rad.to_degrees(), 6),
            (pose.pitch_rad.to_degrees(), 6),
            (velocity.speed_m_s(), 6),
            (velocity.heading_rad_s.to_degrees(), 6),
            (sigma(0), 9),
            (sigma(1), 9),
            (sigma(2).to_degrees(), 9),
        ] {
            let _ = write!(text, ",{}", cell(Some(value), decimals));
        }
        let _ = writeln!(text, ",{},{}", frame.segment, frame.source);
    }
    text
}

/// A finite number with the given count of decimals, or nothing.
fn cell(value: Option<f64>, decimals: usize) -> String {
    value.filter(|value| value.is_finite()).map_or_else(String::new, |value| format!("{value:.decimals$}"))
}
