//! The frames of a run, in an unnamed file, so that memory does not grow with the duration.

use nalgebra::{Matrix3, Matrix6};
use odograph::error::{Error, Result};
use odograph::geometry::GroundPose;
use odograph::keyframe::KeyframeId;
use odograph::odometry::FrameReference;
use odograph::trajectory::{
    FrameEstimate, LossReason, PlaneMeasurement, PoseEstimate, TrackStatus, Velocity,
};
use std::collections::VecDeque;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

/// A frame, and its reference keyframe.
type KeptFrame = (FrameEstimate, Option<FrameReference>);

/// Frames per write to disk: 160 kB, large enough to make writes rare.
const CHUNK: usize = 256;
/// Frame numbers kept in memory: more frames than pass before a frame can become a keyframe.
const NUMBERS: usize = 1024;

/// Frames in order, on disk except the last ones; in memory where the file cannot be written.
#[derive(Debug)]
pub struct KeptFrames {
    folder: PathBuf,
    /// Created with the first chunk.
    file: Option<File>,
    /// Bytes in the file.
    end: u64,
    full: bool,
    /// Frames that are not on disk yet.
    rest: Vec<KeptFrame>,
    count: u64,
    posed: u64,
    first_time_s: Option<f64>,
    last: Option<FrameEstimate>,
    numbers: VecDeque<u64>,
}

impl KeptFrames {
    /// On the file system of `folder`. Nothing is written yet.
    pub fn new(folder: &Path) -> Self {
        Self {
            folder: folder.to_owned(),
            file: None,
            end: 0,
            full: false,
            rest: Vec::new(),
            count: 0,
            posed: 0,
            first_time_s: None,
            last: None,
            numbers: VecDeque::new(),
        }
    }

    /// Adds the next frame.
    pub fn push(&mut self, frame: FrameEstimate, reference: Option<FrameReference>) {
        self.count += 1;
        self.posed += u64::from(frame.estimate.is_some());
        self.first_time_s.get_or_insert(frame.time_s);
        self.numbers.push_back(frame.frame);
        if self.numbers.len() > NUMBERS {
            self.numbers.pop_front();
        }
        self.rest.push((frame.clone(), reference));
        self.last = Some(frame);
        if self.rest.len() >= CHUNK && !self.full {
            self.full = self.write().is_err();
        }
    }

    /// Number of frames.
    pub fn count(&self) -> usize {
        self.count as usize
    }

    /// Number of frames with a pose.
    pub fn posed(&self) -> usize {
        self.posed as usize
    }

    /// The time of the first frame, seconds.
    pub fn first_time_s(&self) -> Option<f64> {
        self.first_time_s
    }

    /// The newest frame.
    #[cfg_attr(not(feature = "live"), allow(dead_code))]
    pub fn last(&self) -> Option<&FrameEstimate> {
        self.last.as_ref()
    }

    /// Source number of the `index`th frame, one of the last thousand.
    pub fn number_in_source(&self, index: u64) -> Option<u64> {
        let first = self.count - self.numbers.len() as u64;
        self.numbers.get(index.checked_sub(first)? as usize).copied()
    }

    /// Visits all frames in order, each with its reference. Fails where they cannot be read back,
    /// or if `take` fails.
    pub fn each(
        &mut self,
        mut take: impl FnMut(&FrameEstimate, Option<&FrameReference>) -> Result<()>,
    ) -> Result<()> {
        let Self { folder, file, end, rest, .. } = self;
        let failed = |error: io::Error| {
            Error::output(format!(
                "the path cannot be read back from the disk of {}: {error}; trajectory.csv.part has what was recorded",
                folder.display()
            ))
            .caused_by(error)
        };
        if let Some(file) = file {
            file.seek(SeekFrom::Start(0)).map_err(failed)?;
            let mut block = vec![0; FRAME_BYTES * CHUNK];
            let mut left = *end as usize;
            while left > 0 {
                let block = &mut block[..left.min(FRAME_BYTES * CHUNK)];
                file.read_exact(block).map_err(failed)?;
                left -= block.len();
                for bytes in block.chunks_exact(FRAME_BYTES) {
                    let (frame, reference) = decoded(bytes);
                    take(&frame, reference.as_ref())?;
                }
            }
        }
        rest.iter().try_for_each(|(frame, reference)| take(frame, reference.as_ref()))
    }

    /// All frames with their references. Fails where they cannot be read back.
    pub fn all(&mut self) -> Result<(Vec<FrameEstimate>, Vec<Option<FrameReference>>)> {
        let (mut frames, mut references) = (Vec::new(), Vec::new());
        frames.reserve_exact(self.count());
        references.reserve_exact(self.count());
        self.each(|frame, reference| {
            frames.push(frame.clone());
            references.push(reference.copied());
            Ok(())
        })?;
        Ok((frames, references))
    }

    fn write(&mut self) -> io::Result<()> {
        let mut bytes = Vec::with_capacity(FRAME_BYTES * self.rest.len());
        for kept in &self.rest {
            encoded(kept).into_iter().for_each(|number| bytes.extend(number.to_le_bytes()));
        }
        let file = match &mut self.file {
            Some(file) => file,
            none => none.insert(tempfile::tempfile_in(&self.folder)?),
        };
        file.seek(SeekFrom::Start(self.end))?;
        file.write_all(&bytes)?;
        self.end += bytes.len() as u64;
        self.rest.clear();
        Ok(())
    }
}

/// Numbers of a frame, its pose, velocity, covariance and measurement, and ten of its reference.
const NUMBERS_OF_A_FRAME: usize = 9 + 6 + 3 + 36 + 12 + 10;
const FRAME_BYTES: usize = 8 * NUMBERS_OF_A_FRAME;

/// Reasons of loss in the order of their codes from 1 on; 0 is not lost.
const REASONS: [LossReason; 6] = [
    LossReason::Bare,
    LossReason::Dark,
    LossReason::Jump,
    LossReason::Blur,
    LossReason::Shadow,
    LossReason::NotPlanar,
];

fn numbers_of(pose: &GroundPose) -> [f64; 6] {
    [pose.x_m, pose.y_m, pose.heading_rad, pose.height_m, pose.roll_rad, pose.pitch_rad]
}

fn pose_of([x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad]: [f64; 6]) -> GroundPose {
    GroundPose { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad }
}

/// A frame as numbers, exact: integers are far below 2⁵³.
fn encoded((frame, reference): &KeptFrame) -> Vec<f64> {
    let status = match frame.status {
        TrackStatus::Tracked => 0,
        TrackStatus::Lost { reason } => 1 + REASONS.iter().position(|known| *known == reason).unwrap_or(0),
    };
    let mut numbers = vec![
        frame.frame as f64,
        frame.time_s,
        status as f64,
        frame.tracks as f64,
        frame.inliers as f64,
        frame.residual_px,
        f64::from(u8::from(frame.keyframe)),
        frame.segment as f64,
        f64::from(u8::from(frame.estimate.is_some())),
    ];
    match &frame.estimate {
        Some(PoseEstimate { pose, velocity, covariance, measured }) => {
            numbers.extend(numbers_of(pose));
            numbers.extend([velocity.x_m_s, velocity.y_m_s, velocity.heading_rad_s]);
            numbers.extend(covariance.iter());
            numbers.extend([measured.x_m, measured.y_m, measured.heading_rad]);
            numbers.extend(measured.covariance.iter());
        }
        None => numbers.extend([0.0; 6 + 3 + 36 + 12]),
    }
    let next = reference.as_ref().and_then(|reference| reference.next);
    numbers.push(f64::from(u8::from(reference.is_some())));
    numbers.push(reference.map_or(0.0, |reference| reference.keyframe.0 as f64));
    numbers.push(f64::from(u8::from(next.is_some())));
    numbers.push(next.map_or(0.0, |(id, _)| id.0 as f64));
    numbers.extend(next.map_or([0.0; 6], |(_, pose)| numbers_of(&pose)));
    numbers
}

fn decoded(bytes: &[u8]) -> KeptFrame {
    let mut numbers = bytes.chunks_exact(8).map(|bytes| {
        let mut number = [0; 8];
        number.copy_from_slice(bytes);
        f64::from_le_bytes(number)
    });
    let mut next = || numbers.next().unwrap_or(f64::NAN);
    let [frame, time_s, status, tracks, inliers, residual_px, keyframe, segment, posed] =
        std::array::from_fn(|_| next());
    let pose = pose_of(std::array::from_fn(|_| next()));
    let [x_m_s, y_m_s, heading_rad_s] = std::array::from_fn(|_| next());
    let covariance = Matrix6::from_iterator((0..36).map(|_| next()));
    let [x_m, y_m, heading_rad] = std::array::from_fn(|_| next());
    let own = Matrix3::from_iterator((0..9).map(|_| next()));
    let estimate = (posed == 1.0).then_some(PoseEstimate {
        pose,
        velocity: Velocity { x_m_s, y_m_s, heading_rad_s },
        covariance,
        measured: PlaneMeasurement { x_m, y_m, heading_rad, covariance: own },
    });
    let [referred, keyframe_id, followed, next_id] = std::array::from_fn(|_| next());
    let next_pose = pose_of(std::array::from_fn(|_| next()));
    let reference = (referred == 1.0).then_some(FrameReference {
        keyframe: KeyframeId(keyframe_id as u64),
        next: (followed == 1.0).then_some((KeyframeId(next_id as u64), next_pose)),
    });
    let lost = (status as usize).checked_sub(1).and_then(|code| REASONS.get(code));
    let frame = FrameEstimate {
        frame: frame as u64,
        time_s,
        status: lost.map_or(TrackStatus::Tracked, |&reason| TrackStatus::Lost { reason }),
        estimate,
        tracks: tracks as usize,
        inliers: inliers as usize,
        residual_px,
        keyframe: keyframe == 1.0,
        segment: segment as usize,
    };
    (frame, reference)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)] // a test fails by panicking

    use super::*;

    /// Frames with every number different, some of them lost, every third frame of the source.
    fn frames() -> Vec<KeptFrame> {
        let kept = |k: u64| {
            let at = |i: u64| (1000 * k + i) as f64 / 7.0;
            let pose = |from: u64| pose_of(std::array::from_fn(|i| at(from + i as u64)));
            let reason = (k % 8 > 1).then(|| REASONS[k as usize % 8 - 2]);
            let estimate = PoseEstimate {
                pose: pose(0),
                velocity: Velocity { x_m_s: at(10), y_m_s: at(11), heading_rad_s: at(12) },
                covariance: Matrix6::from_fn(|i, j| at(20 + (6 * i + j) as u64)),
                measured: PlaneMeasurement {
                    x_m: at(60),
                    y_m: at(61),
                    heading_rad: at(62),
                    covariance: Matrix3::from_fn(|i, j| at(63 + (3 * i + j) as u64)),
                },
            };
            let frame = FrameEstimate {
                frame: 3 * k,
                time_s: at(80),
                status: reason.map_or(TrackStatus::Tracked, |reason| TrackStatus::Lost { reason }),
                estimate: reason.is_none().then_some(estimate),
                tracks: k as usize,
                inliers: k as usize / 2,
                residual_px: at(81),
                keyframe: k.is_multiple_of(5),
                segment: k as usize / 100,
            };
            let next = (k % 4 == 1).then(|| (KeyframeId(k + 1), pose(90)));
            let reference =
                (!k.is_multiple_of(3)).then_some(FrameReference { keyframe: KeyframeId(k), next });
            (frame, reference)
        };
        (0..2 * CHUNK as u64 + 10).map(kept).collect()
    }

    #[test]
    fn what_comes_back_from_disk_is_what_was_kept_to_the_last_bit() {
        let folder = tempfile::tempdir().unwrap();
        let mut kept = KeptFrames::new(folder.path());
        for (frame, reference) in frames() {
            kept.push(frame, reference);
        }
        assert_eq!(kept.rest.len(), 10);
        assert_eq!(kept.number_in_source(2 * CHUNK as u64 + 9), Some(3 * (2 * CHUNK as u64 + 9)));
        assert_eq!(kept.number_in_source(2 * CHUNK as u64 + 10), None);
        assert_eq!(kept.first_time_s(), Some(80.0 / 7.0));
        let (expected, references): (Vec<_>, Vec<_>) = frames().into_iter().unzip();
        assert_eq!(kept.last(), expected.last());
        assert_eq!(kept.all().unwrap(), (expected, references));
    }

    #[test]
    fn where_nothing_can_be_written_all_stays_in_memory() {
        let mut kept = KeptFrames::new(Path::new("/nowhere/at/all"));
        for (frame, reference) in frames() {
            kept.push(frame, reference);
        }
        let (expected, references): (Vec<_>, Vec<_>) = frames().into_iter().unzip();
        assert_eq!(kept.all().unwrap(), (expected, references));
    }
}
