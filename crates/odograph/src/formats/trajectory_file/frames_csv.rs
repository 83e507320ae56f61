//! The frames of a run as CSV for people and spreadsheets.

use crate::filter::SmoothedFrame;
use crate::trajectory::FrameEstimate;
use std::fmt::Write;

/// Header line of the frames table, with its newline. Units are in the column names; angles are in
/// degrees, counter-clockwise positive.
///
/// The standard deviations are relative to the start of the run. `keyframe` is 0 or 1; `status` is
/// `tracked`, or `lost:` with the reason. Unknown quantities have empty cells.
pub const FRAMES_HEADER: &str = "frame,time_s,x_m,y_m,heading_deg,height_m,roll_deg,pitch_deg,speed_m_s,heading_rate_deg_s,\
                      sigma_x_m,sigma_y_m,sigma_heading_deg,tracks,inliers,residual_px,keyframe,segment,status\n";

/// The frames as CSV: the header ([`FRAMES_HEADER`]), then one line per frame ([`frame_line`]).
pub fn csv_from_frames(frames: &[FrameEstimate]) -> String {
    let mut text = String::from(FRAMES_HEADER);
    frames.iter().for_each(|frame| text.push_str(&frame_line(frame)));
    text
}

/// A frame as a line of the table, with its newline.
pub fn frame_line(frame: &FrameEstimate) -> String {
    let mut text = format!("{},{}", frame.frame, cell(Some(frame.time_s), 9));
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
    text
}

/// Header line of the table of smoothed frames, with its newline, in the units of
/// [`FRAMES_HEADER`]. `source` is `measured`, `bridged` or `sensors`.
pub const SMOOTHED_HEADER: &str = "frame,time_s,x_m,y_m,heading_deg,height_m,roll_deg,pitch_deg,speed_m_s,heading_rate_deg_s,\
                               sigma_x_m,sigma_y_m,sigma_heading_deg,segment,source\n";

/// A smoothed frame as a line of the table, with its newline.
pub fn smoothed_line(frame: &SmoothedFrame) -> String {
    let (pose, velocity) = (&frame.pose, &frame.velocity);
    let sigma = |index: usize| frame.covariance[(index, index)].max(0.0).sqrt();
    let mut text = format!("{},{}", frame.frame, cell(Some(frame.time_s), 9));
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
    text
}

/// A finite number with the given number of decimals, otherwise an empty cell.
fn cell(value: Option<f64>, decimals: usize) -> String {
    value.filter(|value| value.is_finite()).map_or_else(String::new, |value| format!("{value:.decimals$}"))
}
