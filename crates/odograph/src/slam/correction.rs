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
    let mut stretches = Stretches::default();
    for (frame, reference) in frames.iter().zip(references) {
        stretches.push(frame, reference.as_ref());
    }
    let mut straightening = stretches.straightening(mapper);
    frames.iter().map(|frame| straightening.next(frame.clone())).collect()
}

/// The stretches of a recording in which frames were measured against one keyframe, without a loss between them: what must be known of its end before a
/// stretch is laid. For frames that are not in memory at once: they are gone through twice, here and in [`Straightening`].
#[derive(Debug, Default)]
pub struct Stretches {
    /// In order; frames that were measured against nothing are in none.
    stretches: Vec<Stretch>,
    /// Whether the next frame may belong to the last of them.
    open: bool,
    frames: usize,
}

#[derive(Debug)]
struct Stretch {
    first: usize,
    count: usize,
    keyframe: KeyframeId,
    /// Where the next keyframe takes over: that one, the last frame's pose against it, and as it was measured here.
    end: Option<(KeyframeId, GroundPose, GroundPose)>,
}

impl Stretches {
    /// Takes the next frame, in the odometry frame, and what it was measured against.
    pub fn push(&mut self, frame: &FrameEstimate, reference: Option<&FrameReference>) {
        let index = self.frames;
        self.frames += 1;
        let Some(&FrameReference { keyframe, next }) = reference else {
            self.open = false;
            return;
        };
        let end = next.zip(frame.estimate.as_ref()).map(|((id, pose), known)| (id, pose, measured(known)));
        match self.stretches.last_mut().filter(|stretch| self.open && stretch.keyframe == keyframe) {
            Some(stretch) => {
                stretch.count += 1;
                stretch.end = end;
            }
            None => self.stretches.push(Stretch { first: index, count: 1, keyframe, end }),
        }
        self.open = next.is_none();
    }

    /// What lays the same frames where the map has them.
    pub fn straightening<'a>(&'a self, mapper: &'a Mapper) -> Straightening<'a> {
        Straightening { mapper, rest: &self.stretches, index: 0, laid: None }
    }
}

/// Takes frames to the map, one after the other.
#[derive(Debug)]
pub struct Straightening<'a> {
    mapper: &'a Mapper,
    /// The stretches that the next frame is in, or is before.
    rest: &'a [Stretch],
    index: usize,
    /// How the first of them is laid; `None` where that was not asked yet.
    laid: Option<Laid<'a>>,
}

/// How the frames of a stretch are laid.
#[derive(Debug, Clone, Copy)]
struct Laid<'a> {
    /// The keyframe; `None` where it is not in the map.
    here: Option<&'a MapKeyframe>,
    end: Option<Correction>,
}

impl<'a> Straightening<'a> {
    /// The next frame, where the map has it.
    pub fn next(&mut self, mut frame: FrameEstimate) -> FrameEstimate {
        let index = self.index;
        self.index += 1;
        let Some(stretch) =
            self.rest.first().filter(|stretch| stretch.first <= index && self.mapper.is_straightened())
        else {
            return frame;
        };
        let laid = *self.laid.get_or_insert_with(|| Laid::new(self.mapper, stretch));
        if let (Some(known), Some(here)) = (&mut frame.estimate, laid.here) {
            // The last of a stretch is where the next keyframe has it.
            let share = (index - stretch.first + 1) as f64 / stretch.count as f64;
            corrected(known, &Correction::of(here), laid.end.as_ref().map(|end| (end, share)), here);
        }
        if index + 1 == stretch.first + stretch.count {
            (self.rest, self.laid) = (&self.rest[1..], None);
        }
        frame
    }
}

impl<'a> Laid<'a> {
    fn new(mapper: &'a Mapper, stretch: &Stretch) -> Self {
        let here = mapper.of_run(stretch.keyframe);
        let end = here.zip(stretch.end).and_then(|(here, (next, in_next, measured))| {
            let begin = Correction::of(here);
            let to = Correction::of(mapper.of_run(next)?).pose(&in_next);
            let turns =
                ((to.heading_rad - measured.heading_rad - begin.turn_rad()) / std::f64::consts::TAU).round();
            let to = GroundPose { heading_rad: to.heading_rad - turns * std::f64::consts::TAU, ..to };
            Some(Correction { from: measured, to })
        });
        Self { here, end }
    }
}

/// A pose as its own pixels have it.
pub(super) fn measured(known: &PoseEstimate) -> GroundPose {
    let plane = &known.measured;
    GroundPose { x_m: plane.x_m, y_m: plane.y_m, heading_rad: plane.heading_rad, ..known.pose }
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
    let plane = measured(known);
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
