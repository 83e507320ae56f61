//! The frames in the map frame.
//!
//! A frame lies to its keyframe as odometry measured it, wherever the map has moved that keyframe. On the way from one keyframe to the next what
//! the map says changes a little; that is shared out over the frames between, so that the path has no steps.

use super::Mapper;
use crate::geometry::GroundPose;
use crate::mapping::{KeyframeId, MapKeyframe};
use crate::odometry::FrameReference;
use crate::trajectory::{FrameEstimate, PoseEstimate};
use nalgebra::{Matrix3, Matrix6};

/// Takes poses in the odometry frame to the map: a turn and a scale about a point, and a shift.
#[derive(Debug, Clone, Copy)]
struct Correction {
    from: GroundPose,
    to: GroundPose,
}

impl Correction {
    fn of(keyframe: &MapKeyframe) -> Self {
        Self { from: keyframe.odometry_pose, to: keyframe.pose }
    }

    fn turn_rad(&self) -> f64 {
        self.to.heading_rad - self.from.heading_rad
    }

    fn scale(&self) -> f64 {
        self.to.height_m / self.from.height_m
    }

    fn place(&self, x_m: f64, y_m: f64) -> (f64, f64) {
        let (sin, cos) = self.turn_rad().sin_cos();
        let (dx, dy) = (x_m - self.from.x_m, y_m - self.from.y_m);
        let scale = self.scale();
        (self.to.x_m + scale * (cos * dx - sin * dy), self.to.y_m + scale * (sin * dx + cos * dy))
    }

    fn pose(&self, pose: &GroundPose) -> GroundPose {
        let (x_m, y_m) = self.place(pose.x_m, pose.y_m);
        GroundPose {
            x_m,
            y_m,
            heading_rad: pose.heading_rad + self.turn_rad(),
            height_m: pose.height_m * self.scale(),
            ..*pose
        }
    }
}

/// The frames in the map frame, from those in the odometry frame and what each was measured against. Without loops they are what they were.
pub fn map_frames(
    mapper: &Mapper,
    frames: &[FrameEstimate],
    references: &[Option<FrameReference>],
) -> Vec<FrameEstimate> {
    if !mapper.is_straightened() {
        return frames.to_vec();
    }
    let mut straight = frames.to_vec();
    let mut first = 0;
    while first < frames.len() {
        let Some(keyframe) = references.get(first).copied().flatten().map(|reference| reference.keyframe)
        else {
            first += 1;
            continue;
        };
        let stretch = stretch(&references[first..], keyframe);
        lay(mapper, keyframe, &mut straight[first..first + stretch], references[first + stretch - 1]);
        first += stretch;
    }
    straight
}

/// How many frames from the first on were measured against a keyframe, without a loss between them.
fn stretch(references: &[Option<FrameReference>], keyframe: KeyframeId) -> usize {
    let mut count = 0;
    for reference in references {
        match reference {
            Some(reference) if reference.keyframe == keyframe => {
                count += 1;
                if reference.next.is_some() {
                    break;
                }
            }
            _ => break,
        }
    }
    count
}

/// Lays the frames that were measured against one keyframe, up to where the next one takes over.
fn lay(mapper: &Mapper, keyframe: KeyframeId, frames: &mut [FrameEstimate], last: Option<FrameReference>) {
    let Some(here) = mapper.of_run(keyframe) else { return };
    let begin = Correction::of(here);
    // The last of them is where the next keyframe has it.
    let next = last.and_then(|last| last.next);
    let end = frames.last().and_then(|frame| {
        let (id, in_next) = next?;
        let known = frame.estimate.as_ref()?;
        let measured = GroundPose {
            x_m: known.measured.x_m,
            y_m: known.measured.y_m,
            heading_rad: known.measured.heading_rad,
            ..known.pose
        };
        let to = Correction::of(mapper.of_run(id)?).pose(&in_next);
        let turns =
            ((to.heading_rad - measured.heading_rad - begin.turn_rad()) / std::f64::consts::TAU).round();
        let to = GroundPose { heading_rad: to.heading_rad - turns * std::f64::consts::TAU, ..to };
        Some(Correction { from: measured, to })
    });
    let count = frames.len() as f64;
    for (at, frame) in frames.iter_mut().enumerate() {
        let Some(known) = &mut frame.estimate else { continue };
        let share = (at + 1) as f64 / count;
        corrected(known, &begin, end.as_ref().map(|end| (end, share)), here);
    }
}

/// Corrects a frame: between what its own keyframe says and, with a share, the next one.
fn corrected(
    known: &mut PoseEstimate,
    begin: &Correction,
    end: Option<(&Correction, f64)>,
    keyframe: &MapKeyframe,
) {
    let blend = |of: &dyn Fn(&Correction) -> GroundPose| {
        let a = of(begin);
        let Some((end, share)) = end else { return a };
        let b = of(end);
        let between = |a: f64, b: f64| a + share * (b - a);
        GroundPose {
            x_m: between(a.x_m, b.x_m),
            y_m: between(a.y_m, b.y_m),
            heading_rad: between(a.heading_rad, b.heading_rad),
            height_m: between(a.height_m, b.height_m),
            ..a
        }
    };
    let pose = blend(&|correction| correction.pose(&known.pose));
    let plane = GroundPose {
        x_m: known.measured.x_m,
        y_m: known.measured.y_m,
        heading_rad: known.measured.heading_rad,
        ..known.pose
    };
    let plane = blend(&|correction| correction.pose(&plane));
    let turn_rad = plane.heading_rad - known.measured.heading_rad;
    let scale = pose.height_m / known.pose.height_m;
    let (sin, cos) = turn_rad.sin_cos();
    let turn = Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0);
    let own = turn * known.measured.covariance * turn.transpose();
    let velocity = &mut known.velocity;
    (velocity.x_m_s, velocity.y_m_s) = (
        scale * (cos * velocity.x_m_s - sin * velocity.y_m_s),
        scale * (sin * velocity.x_m_s + cos * velocity.y_m_s),
    );
    known.pose = pose;
    (known.measured.x_m, known.measured.y_m) = (plane.x_m, plane.y_m);
    known.measured.heading_rad = plane.heading_rad;
    known.measured.covariance = own;
    known.covariance = carried(keyframe, &pose, &known.covariance);
    let with_own = known.covariance.fixed_view::<3, 3>(0, 0) + own;
    known.covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&with_own);
}

/// What the keyframe's own uncertainty does to a pose measured against it; of height and tilt, where the map does not know them better, what
/// odometry knows.
fn carried(keyframe: &MapKeyframe, pose: &GroundPose, odometry: &Matrix6<f64>) -> Matrix6<f64> {
    let (dx, dy) = (pose.x_m - keyframe.pose.x_m, pose.y_m - keyframe.pose.y_m);
    let height_m = keyframe.pose.height_m;
    let mut carry = Matrix6::identity();
    (carry[(0, 2)], carry[(1, 2)]) = (-dy, dx);
    (carry[(0, 3)], carry[(1, 3)]) = (dx / height_m, dy / height_m);
    let mut carried = carry * keyframe.covariance * carry.transpose();
    for i in 3..6 {
        carried[(i, i)] = odometry[(i, i)];
    }
    carried
}
