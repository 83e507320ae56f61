//! Landmarks: markers on the ground that keyframes show, each known by its number.
//!
//! A [`MarkerSighting`] is where a keyframe has a marker. Two sightings of the same marker are an
//! edge between their keyframes, however far the path has drifted ([`MarkerSighting::edge_to`]); a
//! surveyed one has a place in the survey frame ([`ControlPoint`]). Derivation:
//! `docs/math/pose-graph.md`, "Markers".

use crate::camera::Camera;
use crate::geometry::pose_index::{HEADING, HEIGHT, LN_SCALE};
use crate::geometry::{GroundPoint, GroundPose, Pixel, PlaneTransform, Se2, Sim2, WithCovariance};
use crate::ground_map::MapKeyframe;
use crate::keyframe::{EdgeKind, KeyframeId, MapEdge};
use nalgebra::{Matrix3, Matrix4, Matrix6, SMatrix, Vector2, Vector3};

/// A marker at a surveyed place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ControlPoint {
    /// Number of the marker.
    pub number: u32,
    /// x of its centre in the survey frame, metres.
    pub x_m: f64,
    /// y of its centre, metres.
    pub y_m: f64,
    /// Standard deviation of both, metres.
    pub sigma_m: f64,
    /// Direction of its top as printed, counter-clockwise from x, radians, where it is known.
    pub heading_rad: Option<f64>,
}

impl ControlPoint {
    /// Default standard deviation, metres: of a total station.
    pub const USUAL_SIGMA_M: f64 = 0.002;
    /// Standard deviation of a surveyed heading, radians: 1°, as markers are glued.
    pub const HEADING_SIGMA_RAD: f64 = 0.0175;
}

/// Where a keyframe has a marker.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MarkerSighting {
    /// Number of the marker.
    pub number: u32,
    /// The keyframe.
    pub keyframe: KeyframeId,
    /// The marker in the frame of the keyframe: its centre, and the direction of its top as
    /// printed; metres as they are at the height of the keyframe's `odometry_pose`.
    pub keyframe_from_marker: Se2,
    /// Covariance of these three numbers.
    pub covariance: Matrix3<f64>,
    /// Side of its black square in the same metres.
    pub side_m: f64,
    /// Standard deviation of the side, metres.
    pub side_sigma_m: f64,
}

/// A sighting, and which of the places of its number it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlacedSighting {
    /// The sighting.
    pub sighting: MarkerSighting,
    /// From 0; more than one place means two markers of the same number, or one that was moved.
    pub place: usize,
    /// How often the place had been left and come back to.
    pub visit: usize,
}

/// The markers of a map.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MarkerRecord {
    /// In order of time, those of earlier sessions first.
    pub sightings: Vec<PlacedSighting>,
    /// Number of edges between them that this session has added.
    pub edges: usize,
}

/// Standard deviation of a corner of a marker along an axis of the image, pixels.
const CORNER_SIGMA_PX: f64 = 0.2;
/// Largest relative difference of a side or a diagonal from those of a square.
const MAX_SKEWED: f64 = 0.12;

impl MarkerSighting {
    /// A marker with these corners (clockwise from the top left as printed) in the image of a
    /// keyframe with this pose in the odometry frame and its covariance. `None` if the corners do
    /// not see the ground or are not a square there.
    pub fn new(
        number: u32,
        keyframe: KeyframeId,
        corners: &[Pixel; 4],
        camera: &Camera,
        pose: &GroundPose,
        covariance: &Matrix6<f64>,
    ) -> Option<Self> {
        let (centre, side_m) = square_on_ground(corners, camera, pose)?;
        let numbers = |at: &GroundPose, corners: &[Pixel; 4]| -> Option<Vector3<f64>> {
            let (marker, _) = square_on_ground(corners, camera, at)?;
            let seen = pose.se2().between(&marker);
            Some(Vector3::new(seen.x_m, seen.y_m, seen.heading_rad))
        };
        let mut own = Matrix3::zeros();
        for corner in 0..4 {
            for axis in 0..2 {
                let stepped = |step_px: f64| {
                    let mut stepped = *corners;
                    let of = &mut stepped[corner];
                    *(if axis == 0 { &mut of.x } else { &mut of.y }) += step_px;
                    numbers(pose, &stepped)
                };
                let by = (stepped(0.5)? - stepped(-0.5)?) * CORNER_SIGMA_PX;
                own += by * by.transpose();
            }
        }
        // What is uncertain of height, roll and pitch; x, y and heading are those of the keyframe.
        let mut by_mount = SMatrix::<f64, 3, 3>::zeros();
        let steps = [1e-4 * pose.height_m, 1e-4, 1e-4];
        for (column, step) in steps.into_iter().enumerate() {
            let stepped = |step: f64| {
                let mut vector = pose.to_vector();
                vector[HEIGHT + column] += step;
                numbers(&GroundPose::from_vector(&vector), corners)
            };
            by_mount.set_column(column, &((stepped(step)? - stepped(-step)?) / (2.0 * step)));
        }
        let of_mount = covariance.fixed_view::<3, 3>(HEIGHT, HEIGHT).into_owned();
        let covariance = own + by_mount * of_mount * by_mount.transpose();
        let seen = pose.se2().between(&centre);
        // The heading has half the arm of the side's noise.
        let side_sigma_m = side_m * own[(HEADING, HEADING)].sqrt();
        let finite = covariance.iter().chain([&side_m]).all(|value| value.is_finite());
        finite.then_some(Self {
            number,
            keyframe,
            keyframe_from_marker: seen,
            covariance,
            side_m,
            side_sigma_m,
        })
    }

    /// The edge between the keyframes of two sightings of the same marker, from that of `self` to
    /// that of `other`. `heights_m` are the heights at which the two were measured; where heights
    /// are `held`, metres are equal.
    pub fn edge_to(&self, other: &Self, heights_m: [f64; 2], held: bool) -> MapEdge {
        let by_side = |sighting: &Self| {
            let Se2 { x_m, y_m, heading_rad } = sighting.keyframe_from_marker;
            let scale = if held { 1.0 } else { sighting.side_m };
            let mut covariance = with_scale(&sighting.covariance);
            if !held {
                covariance[(LN_SCALE, LN_SCALE)] = (sighting.side_sigma_m / sighting.side_m).powi(2);
            }
            WithCovariance { transform: Sim2 { x_m, y_m, heading_rad, scale }, covariance }
        };
        let seen = by_side(self) * by_side(other).inverse();
        let mut motion = seen.transform.to_vector();
        motion[HEADING] = crate::geometry::wrap_angle(motion[HEADING]);
        motion[LN_SCALE] = if held { 0.0 } else { motion[LN_SCALE] + (heights_m[1] / heights_m[0]).ln() };
        MapEdge {
            from: self.keyframe,
            to: other.keyframe,
            kind: EdgeKind::Loop,
            motion,
            covariance: seen.covariance,
        }
    }

    /// Where the marker is in the map, as this sighting by `keyframe` has it.
    pub fn in_map(&self, keyframe: &MapKeyframe) -> WithCovariance<Se2, 3> {
        let scale = keyframe.pose.height_m / keyframe.odometry_pose.height_m;
        let map_from_keyframe = WithCovariance {
            transform: Sim2 { scale, ..Sim2::rigid(&keyframe.pose.se2()) },
            covariance: with_scale(&keyframe.covariance.fixed_view::<3, 3>(0, 0).into_owned()),
        };
        let there = map_from_keyframe * self.keyframe_from_marker();
        let Sim2 { x_m, y_m, heading_rad, .. } = there.transform;
        WithCovariance {
            transform: Se2::new(x_m, y_m, heading_rad),
            covariance: there.covariance.fixed_view::<3, 3>(0, 0).into_owned(),
        }
    }

    /// The sighting as another keyframe has it, which lies at `new_from_keyframe` of this one's.
    #[must_use]
    pub fn moved_to(&self, new: KeyframeId, new_from_keyframe: &WithCovariance<Sim2, 4>) -> Self {
        let seen = *new_from_keyframe * self.keyframe_from_marker();
        let Sim2 { x_m, y_m, heading_rad, scale } = seen.transform;
        Self {
            keyframe: new,
            keyframe_from_marker: Se2::new(x_m, y_m, heading_rad),
            covariance: seen.covariance.fixed_view::<3, 3>(0, 0).into_owned(),
            side_m: scale * self.side_m,
            side_sigma_m: scale * self.side_sigma_m,
            ..*self
        }
    }

    /// The sighting as a similarity of the scale 1.
    fn keyframe_from_marker(&self) -> WithCovariance<Sim2, 4> {
        WithCovariance {
            transform: Sim2::rigid(&self.keyframe_from_marker),
            covariance: with_scale(&self.covariance),
        }
    }

    /// The sighting in metres that are longer by a factor.
    #[must_use]
    pub fn rescaled(mut self, factor: f64) -> Self {
        self.keyframe_from_marker.x_m *= factor;
        self.keyframe_from_marker.y_m *= factor;
        let by = Matrix3::from_diagonal(&Vector3::new(factor, factor, 1.0));
        self.covariance = by * self.covariance * by;
        self.side_m *= factor;
        self.side_sigma_m *= factor;
        self
    }
}

/// The covariance of a pose and of a scale that is certain.
fn with_scale(of_pose: &Matrix3<f64>) -> Matrix4<f64> {
    let mut covariance = Matrix4::zeros();
    covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(of_pose);
    covariance
}

/// The pose of a square on the ground, its x towards the top as printed, and its side; `None` if a
/// corner does not see the ground, or if it is no square there.
fn square_on_ground(corners: &[Pixel; 4], camera: &Camera, pose: &GroundPose) -> Option<(Se2, f64)> {
    let mut ground = [Vector2::zeros(); 4];
    for (ground, corner) in ground.iter_mut().zip(corners) {
        let GroundPoint { x_m, y_m } = pose.ground_from_ray(camera.ray_from_pixel(*corner)?)?;
        *ground = Vector2::new(x_m, y_m);
    }
    let [a, b, c, d] = ground;
    let centre = 0.25 * (a + b + c + d);
    let (up, right) = (0.5 * (a + b - c - d), 0.5 * (b + c - a - d));
    // To the right of its top, turned back to the left, is its top.
    let top = 0.5 * (up + Vector2::new(-right.y, right.x));
    let side_m = top.norm();
    let sides = [b - a, c - b, d - c, a - d].map(|side| side.norm() / side_m);
    let diagonals = [c - a, d - b].map(|diagonal| diagonal.norm() / (side_m * std::f64::consts::SQRT_2));
    let is_square = sides.iter().chain(&diagonals).all(|ratio| (ratio - 1.0).abs() < MAX_SKEWED);
    is_square.then(|| (Se2::new(centre.x, centre.y, top.y.atan2(top.x)), side_m))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::keyframe::relative_pose::relative_motion;
    use proptest::prelude::*;

    /// The corners of a marker in an image.
    fn corners(camera: &Camera, pose: &GroundPose, marker: &Se2, side_m: f64) -> Option<[Pixel; 4]> {
        let half = 0.5 * side_m;
        let mut seen = [Pixel::new(0.0, 0.0); 4];
        // Top left, top right, bottom right, bottom left; x towards the top, y to the left.
        for (seen, (x, y)) in
            seen.iter_mut().zip([(half, half), (half, -half), (-half, -half), (-half, half)])
        {
            let there = marker.apply(GroundPoint::new(x, y));
            *seen = camera.pixel_from_ray(pose.ray_from_ground(there)?)?;
        }
        Some(seen)
    }

    fn camera() -> Camera {
        Camera::from_field_of_view((640, 480), (1.2, 0.9), 0.9).unwrap()
    }

    prop_compose! {
        fn poses()(x_m in -3.0..3.0, y_m in -3.0..3.0, heading_rad in -3.0..3.0, height_m in 0.6..1.4, roll_rad in -0.1..0.1,
                   pitch_rad in -0.1..0.1) -> GroundPose {
            GroundPose { x_m, y_m, heading_rad, height_m, roll_rad, pitch_rad }
        }
    }

    proptest! {
        #[test]
        fn a_sighting_is_where_the_marker_is(pose in poses(), x in -0.2..0.2f64, y in -0.2..0.2f64, turn in -3.0..3.0f64) {
            let marker = pose.se2() * Se2::new(x, y, turn);
            let seen = corners(&camera(), &pose, &marker, 0.08).unwrap();
            let sighting = MarkerSighting::new(7, KeyframeId(3), &seen, &camera(), &pose, &Matrix6::zeros()).unwrap();
            let found = sighting.keyframe_from_marker;
            prop_assert!((found.x_m - x).hypot(found.y_m - y) < 1e-4, "{found:?}");
            prop_assert!(crate::geometry::wrap_angle(found.heading_rad - turn).abs() < 1e-3);
            prop_assert!((sighting.side_m - 0.08).abs() < 1e-4);
        }

        #[test]
        fn two_sightings_tie_their_keyframes(a in poses(), b in poses(), drift in 0.8..1.25f64) {
            // Both see a marker that lies in front of each; b measures at a height that is off.
            let marker = a.se2() * Se2::new(0.1, 0.05, 0.7);
            let b = GroundPose { x_m: marker.x_m - 0.1, y_m: marker.y_m + 0.1, ..b };
            let measured = GroundPose { height_m: b.height_m * drift, ..b };
            let see = |pose: &GroundPose, by: &GroundPose, id| {
                let seen = corners(&camera(), pose, &marker, 0.08).unwrap();
                MarkerSighting::new(0, KeyframeId(id), &seen, &camera(), by, &Matrix6::zeros()).unwrap()
            };
            let (first, second) = (see(&a, &a, 1), see(&b, &measured, 2));
            let edge = first.edge_to(&second, [a.height_m, measured.height_m], false);
            let off = edge.motion - relative_motion(&a, &b);
            prop_assert!(off[0].hypot(off[1]) < 1e-3 && crate::geometry::wrap_angle(off[2]).abs() < 2e-3 && off[3].abs() < 2e-3, "{off}");
        }
    }

    #[test]
    fn the_covariance_of_a_sighting_is_that_of_its_corners() {
        let pose = GroundPose { roll_rad: 0.03, ..GroundPose::level(0.9) };
        let marker = Se2::new(0.1, -0.2, 0.4);
        let exact = corners(&camera(), &pose, &marker, 0.08).unwrap();
        let mut random = crate::motion::Random::new(5);
        let mut normal = || (0..12).map(|_| random.below(1_000_001) as f64 / 1e6).sum::<f64>() - 6.0;
        let (mut sum, runs) = (0.0, 400);
        for _ in 0..runs {
            let noisy = exact.map(|corner| {
                Pixel::new(corner.x + CORNER_SIGMA_PX * normal(), corner.y + CORNER_SIGMA_PX * normal())
            });
            let seen =
                MarkerSighting::new(0, KeyframeId(0), &noisy, &camera(), &pose, &Matrix6::zeros()).unwrap();
            let found = seen.keyframe_from_marker;
            let off = Vector3::new(
                found.x_m - marker.x_m,
                found.y_m - marker.y_m,
                found.heading_rad - marker.heading_rad,
            );
            sum += off.dot(&(seen.covariance.try_inverse().unwrap() * off));
        }
        // Three degrees of freedom: 3 ± 0.12 of 400 values.
        assert!((sum / f64::from(runs) - 3.0).abs() < 0.4, "{}", sum / f64::from(runs));
    }

    #[test]
    fn what_is_no_square_on_the_ground_is_no_marker() {
        let pose = GroundPose::level(0.9);
        let mut seen = corners(&camera(), &pose, &Se2::new(0.1, 0.0, 0.4), 0.08).unwrap();
        seen[0].x += 8.0;
        assert_eq!(MarkerSighting::new(0, KeyframeId(0), &seen, &camera(), &pose, &Matrix6::zeros()), None);
    }
}
