//! The compact record of a frame that pages draw: fifteen numbers, in binary messages of a live run
//! and in the memory of the page that tracks in a browser.

use crate::error::{Error, Result};
use crate::geometry::pose_index::{HEADING, X, Y};
use crate::trajectory::{FrameEstimate, LossReason, TrackStatus};

/// One frame of the trajectory: pose with its uncertainty, velocity, and tracking statistics.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrackRecord {
    /// The values in the order of [`TrackRecord::FIELDS`]; NaN where a frame has no such value.
    pub values: [f32; TrackRecord::LENGTH],
}

impl TrackRecord {
    /// Number of values in a record.
    pub const LENGTH: usize = 15;

    /// Index of the latency.
    pub const LATENCY: usize = 13;

    /// Names of the values.
    ///
    /// * `time_s`: seconds since the first frame.
    /// * position in metres and heading in radians; the covariance of x and y in m², the standard
    ///   deviation of the heading in radians; the speed in metres per second.
    /// * `state`: 0 if the pose was measured, otherwise the reason for the loss: 1 bare, 2 jump, 3
    ///   not planar, 4 dark, 5 blur, 6 shadow.
    /// * the number of gaps before the frame; the number of tracked corners, and of the inliers
    ///   among them; the latency from capture to pose in milliseconds; the number of the keyframe
    ///   that the frame was measured against.
    pub const FIELDS: [&'static str; Self::LENGTH] = [
        "time_s",
        "x_m",
        "y_m",
        "heading_rad",
        "var_x",
        "cov_xy",
        "var_y",
        "sigma_heading",
        "speed_m_s",
        "state",
        "segment",
        "tracks",
        "inliers",
        "latency_ms",
        "keyframe",
    ];

    /// Converts a frame. `first_time_s` is the time of the run's first frame, seconds.
    pub fn new(frame: &FrameEstimate, first_time_s: f64, latency_ms: Option<f64>) -> Self {
        let mut values = [f32::NAN; Self::LENGTH];
        if let Some(known) = &frame.estimate {
            let (pose, covariance) = (&known.pose, &known.covariance);
            let numbers = [
                pose.x_m,
                pose.y_m,
                pose.heading_rad,
                covariance[(X, X)],
                covariance[(X, Y)],
                covariance[(Y, Y)],
                covariance[(HEADING, HEADING)].max(0.0).sqrt(),
                known.velocity.speed_m_s(),
            ];
            values[1..9].iter_mut().zip(numbers).for_each(|(value, number)| *value = number as f32);
        }
        values[0] = (frame.time_s - first_time_s) as f32;
        values[9] = match frame.status {
            TrackStatus::Tracked => 0.0,
            TrackStatus::Lost { reason } => state_of(reason),
        };
        values[10] = frame.segment as f32;
        values[11] = frame.tracks as f32;
        values[12] = frame.inliers as f32;
        values[Self::LATENCY] = latency_ms.map_or(f32::NAN, |ms| ms as f32);
        Self { values }
    }
}

/// State of a frame that was lost for a reason without a number of its own.
const OTHER_LOSS: f32 = 3.0;

/// The state of a frame that was lost for this reason.
fn state_of(reason: LossReason) -> f32 {
    match reason {
        LossReason::Bare => 1.0,
        LossReason::Jump => 2.0,
        LossReason::Dark => 4.0,
        LossReason::Blur => 5.0,
        LossReason::Shadow => 6.0,
        LossReason::NotPlanar => OTHER_LOSS,
    }
}

impl TrackRecord {
    /// The record of a lost frame, of which nothing else is known, at this time since the first
    /// frame, seconds.
    pub fn lost(time_s: f64, reason: Option<LossReason>) -> Self {
        let mut values = [f32::NAN; Self::LENGTH];
        values[0] = time_s as f32;
        values[9] = reason.map_or(f32::NAN, state_of);
        Self { values }
    }

    /// Returns the record with the number of its keyframe set, counted from 0 in this run.
    pub fn measured_against(mut self, keyframe: Option<u64>) -> Self {
        self.values[14] = keyframe.map_or(f32::NAN, |number| number as f32);
        self
    }
}

/// Maximum number of frames in a finished run: a week at 60 frames per second.
const MAX_FRAMES: usize = 40_000_000;

impl TrackRecord {
    /// Reads the records of a finished run from its `trajectory.csv`. Columns are identified by the
    /// names in `docs/output.md`. An incomplete last line, as a killed run leaves it, is ignored.
    ///
    /// # Errors
    /// If a column is missing or a line cannot be parsed.
    pub fn from_csv(text: &str) -> Result<Vec<Self>> {
        let mut lines = text.split_inclusive('\n').enumerate();
        let columns = CsvColumns::new(lines.next().map_or("", |(_, line)| line.trim_end()))?;
        let mut records = Vec::new();
        let mut first_time_s = None;
        for (number, line) in lines.filter(|(_, line)| line.ends_with('\n')).take(MAX_FRAMES) {
            let wrong = |what: String| Error::input(format!("line {} of trajectory.csv: {what}", number + 1));
            let (numbers, state) = columns.read(line.trim_end()).map_err(wrong)?;
            let begin_s = *first_time_s.get_or_insert(numbers[0]);
            records.push(Self::from_numbers(numbers, state, begin_s));
        }
        Ok(records)
    }

    /// The record of the columns [`CsvColumns::NAMES`]. `trajectory.csv` has no covariance of x and
    /// y, so the error ellipse of a finished run is axis-aligned.
    fn from_numbers(numbers: [f64; CsvColumns::NAMES.len()], state: f64, begin_s: f64) -> Self {
        let [time_s, x_m, y_m, heading_deg, sigma_x_m, sigma_y_m, sigma_heading_deg, rest @ ..] = numbers;
        let [speed_m_s, segment, tracks, inliers] = rest;
        let values = [
            time_s - begin_s,
            x_m,
            y_m,
            heading_deg.to_radians(),
            sigma_x_m * sigma_x_m,
            sigma_x_m * 0.0, // NaN where there is no pose
            sigma_y_m * sigma_y_m,
            sigma_heading_deg.to_radians(),
            speed_m_s,
            state,
            segment,
            tracks,
            inliers,
            f64::NAN,
            f64::NAN,
        ];
        Self { values: values.map(|value| value as f32) }
    }
}

/// The columns of a `trajectory.csv` that a record has.
struct CsvColumns {
    count: usize,
    /// Where the columns [`CsvColumns::NAMES`] are.
    numbers: [usize; Self::NAMES.len()],
    status: usize,
}

impl CsvColumns {
    const NAMES: [&str; 11] = [
        "time_s",
        "x_m",
        "y_m",
        "heading_deg",
        "sigma_x_m",
        "sigma_y_m",
        "sigma_heading_deg",
        "speed_m_s",
        "segment",
        "tracks",
        "inliers",
    ];

    fn new(header: &str) -> Result<Self> {
        let names: Vec<&str> = header.split(',').collect();
        let column = |name: &str| {
            names.iter().position(|known| *known == name).ok_or_else(|| {
                Error::input(format!("this is not the trajectory.csv of a run: it has no column {name}"))
            })
        };
        let mut numbers = [0; Self::NAMES.len()];
        for (at, name) in numbers.iter_mut().zip(Self::NAMES) {
            *at = column(name)?;
        }
        Ok(Self { count: names.len(), numbers, status: column("status")? })
    }

    /// The numbers of a line, NaN where a cell is empty, and the code of its state. The error is
    /// the end of a sentence.
    fn read(&self, line: &str) -> std::result::Result<([f64; Self::NAMES.len()], f64), String> {
        let cells: Vec<&str> = line.split(',').collect();
        if cells.len() != self.count {
            return Err(format!("{} cells, but {} columns", cells.len(), self.count));
        }
        let mut numbers = [f64::NAN; Self::NAMES.len()];
        for (value, cell) in numbers.iter_mut().zip(self.numbers.map(|at| cells[at])) {
            if !cell.is_empty() {
                *value = cell.parse().map_err(|_| format!("{cell} is no number"))?;
            }
        }
        let state = match cells[self.status] {
            "tracked" => 0.0,
            status => status.strip_prefix("lost:").and_then(LossReason::named).map_or(OTHER_LOSS, state_of),
        };
        let state = f64::from(state);
        Ok((numbers, state))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::trajectory_file;
    use crate::geometry::GroundPose;
    use crate::trajectory::{PlaneMeasurement, PoseEstimate, Velocity};

    #[test]
    fn records_read_from_the_table_equal_the_live_ones() {
        let frame = |number: u64, status: TrackStatus| {
            let pose = GroundPose {
                x_m: 0.5 * number as f64,
                y_m: -1.25,
                heading_rad: 0.75,
                ..GroundPose::level(1.0)
            };
            let covariance = covariance_of_plane();
            let velocity = Velocity { x_m_s: 0.3, y_m_s: 0.4, heading_rad_s: 0.0 };
            let measured = PlaneMeasurement::new(&pose, &covariance);
            FrameEstimate {
                frame: number,
                time_s: 100.0 + 0.25 * number as f64,
                status,
                estimate: (status == TrackStatus::Tracked).then_some(PoseEstimate {
                    pose,
                    velocity,
                    covariance,
                    measured,
                }),
                tracks: 50,
                inliers: 40,
                residual_px: 0.1,
                keyframe: false,
                segment: number as usize,
            }
        };
        let lost = |reason| TrackStatus::Lost { reason };
        use LossReason::{Bare, Blur, Dark, Jump, NotPlanar, Shadow};
        let mut frames =
            vec![frame(0, TrackStatus::Tracked), frame(1, lost(Jump)), frame(2, TrackStatus::Tracked)];
        let others = [Bare, Blur, Dark, NotPlanar, Shadow];
        frames.extend((3..).zip(others).map(|(number, reason)| frame(number, lost(reason))));
        // Each reason for a loss has a different code.
        let mut states: Vec<_> =
            frames[2..].iter().map(|frame| TrackRecord::new(frame, 0.0, None).values[9] as u8).collect();
        states.sort_unstable();
        assert_eq!(states, [0, 1, 3, 4, 5, 6]);
        let text = trajectory_file::csv_from_frames(&frames);
        let read = TrackRecord::from_csv(&text).unwrap();
        assert_eq!(read.len(), 8);
        for (frame, read) in frames.iter().zip(&read) {
            let shown = TrackRecord::new(frame, 100.0, None);
            for (field, (a, b)) in TrackRecord::FIELDS.iter().zip(shown.values.iter().zip(read.values)) {
                // The table has at least six decimals.
                assert!((a - b).abs() < 2e-6 || (a.is_nan() && b.is_nan()), "{field}: {a} {b}");
            }
        }
        // The table of a run that was killed in the middle of a line.
        assert_eq!(TrackRecord::from_csv(&text[..text.len() - 9]).unwrap().len(), 7);
        assert!(TrackRecord::from_csv("a,b\n1,2\n").unwrap_err().to_string().contains("no column time_s"));
        assert!(
            TrackRecord::from_csv(&text.replace("100.25", "now")).unwrap_err().to_string().contains("line 3")
        );
    }

    /// Standard deviations of 2 mm, 1 mm and 0.01 rad, uncorrelated.
    fn covariance_of_plane() -> nalgebra::Matrix6<f64> {
        let mut covariance = nalgebra::Matrix6::zeros();
        for (index, sigma) in [(0, 2e-3), (1, 1e-3), (2, 1e-2)] {
            covariance[(index, index)] = sigma * sigma;
        }
        covariance
    }
}
