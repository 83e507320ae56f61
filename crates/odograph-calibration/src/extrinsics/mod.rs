//! Extrinsic calibration: how the camera is mounted on its carrier, a [`odograph::camera::Rig`]
//! with its uncertainty, from views of a board that lies on the floor.
//!
//! Signs and units are those of [`odograph::camera::Rig`].

mod fit;
mod outliers;

use crate::{Board, BoardKind, BoardView};
use fit::{ViewPoseFit, fit};
use nalgebra::{Matrix1, Matrix3, Vector1, Vector3};
use odograph::camera::{Camera, CameraUncertainty, MeasuredRig, Rig, RigDeviations};
use odograph::error::{Error, Result};
use odograph::geometry::{GroundPoint, GroundPose, Pixel, wrap_angle};
use odograph::numerics::{Combined, Part, combine, inverse};
use std::f64::consts::TAU;

/// A direction of the printed board: x to the right, y down.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BoardDirection {
    /// To the right of the print.
    X,
    /// To its left.
    MinusX,
    /// Down the print.
    Y,
    /// Up the print: the top edge.
    MinusY,
}

/// A board on the floor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FloorBoard {
    /// Which board.
    pub board: Board,
    /// How far its printed side is above the floor, metres.
    pub thickness_m: f64,
    /// Its direction that points along the carrier's forward axis; without one the mount yaw is not
    /// measured.
    pub forward: Option<BoardDirection>,
}

/// The result of one view alone.
#[derive(Debug, Clone, PartialEq)]
pub struct MountingView {
    /// Pose of the camera; x along the board's forward direction (up the print if none is given),
    /// origin at the board's first point, height above the floor. `None` if no pose fits.
    pub pose: Option<GroundPose>,
    /// One standard deviation of height (metres), roll and pitch (radians) by the noise of the
    /// points alone.
    pub deviations: [f64; 3],
    /// Root mean square re-projection error, pixels.
    pub rms_px: f64,
    /// Why it was excluded, for people; `None` if it was used.
    pub why_not: Option<String>,
}

/// A rig measured by board.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardMounting {
    /// The rig with its standard deviations, including those of the camera's parameters if they
    /// were given.
    pub measured: MeasuredRig,
    /// Covariance of (height, roll, pitch), metres and radians.
    pub covariance: Matrix3<f64>,
    /// Every view, in the order given.
    pub views: Vec<MountingView>,
    /// Standard deviation of height, roll and pitch between views in addition to the noise of their
    /// points: an uneven floor, a bent board, a flexible carrier.
    pub scatter: [f64; 3],
    /// Warnings about the result, for people.
    pub notes: Vec<String>,
}

/// Largest tilt of a camera that looks at a floor.
const LARGEST_TILT_DEG: f64 = 60.0;

/// Minimum number of points whose residuals are meaningful.
const FEWEST_POINTS: usize = 6;

/// Scatter of the mount yaw above which the board had different directions.
const ALIGNED_DEG: f64 = 2.0;

/// Root mean square error above which the board is bent, or the camera is another, pixels.
const GOOD_FIT_PX: f64 = 1.0;

/// Estimates the rig from views of a board; height, roll and pitch are common to all views.
///
/// Each view gives a pose by robust least squares on its points. The poses are combined with a
/// random effect ([`odograph::numerics::combine`]); views that contradict the others are
/// excluded, with the reason. `uncertainty` is that of the camera's parameters, if known: that
/// error is the same in every view and does not average out.
///
/// Fails if a view does not have the camera's image size, if none shows the board lying on the
/// floor, or if fewer than half of several views agree on a rig.
pub fn rig_from_boards(
    camera: &Camera,
    uncertainty: Option<&CameraUncertainty>,
    floor: &FloorBoard,
    views: &[BoardView],
) -> Result<BoardMounting> {
    check(camera, floor, views)?;
    let points: Vec<_> = views.iter().map(|view| floor.points(view)).collect();
    let mut fits: Vec<_> = points.iter().map(|points| fitted(camera, points)).collect();
    outliers::leave_out(&mut fits)?;
    let used = outliers::used(&fits);
    let Some(Together { around, combined, yaw }) = together(floor, used.iter().map(|(_, fit)| fit)) else {
        return Err(none_used(&fits));
    };
    let mut covariance = combined.covariance;
    let mut yaw_variance = yaw.map(|yaw| yaw.variance);
    if let Some(uncertainty) = uncertainty {
        let outcome = |camera: &Camera| {
            let again: Option<Vec<ViewPoseFit>> =
                used.iter().map(|(index, before)| fit(camera, &points[*index], &before.pose)).collect();
            let again = again?;
            let Together { around, combined, yaw } = together(floor, again.iter())?;
            let at = around + combined.offset;
            Some([at[0], at[1], at[2], yaw.map_or(0.0, |yaw| yaw.rad)])
        };
        let propagated = uncertainty.propagated(camera, outcome).ok_or_else(|| {
            Error::input("the camera's parameters are too uncertain to determine the mount from the board; calibrate the camera again")
        })?;
        covariance += propagated.fixed_view::<3, 3>(0, 0);
        yaw_variance = yaw_variance.map(|variance| variance + propagated[(3, 3)]);
    }
    let at = around + combined.offset;
    let notes = notes(floor, &used, yaw);
    let yaw = yaw.filter(|yaw| yaw.scatter_rad < ALIGNED_DEG.to_radians());
    let rig = Rig {
        height_m: at[0] + floor.thickness_m,
        roll_rad: at[1],
        pitch_rad: at[2],
        yaw_rad: yaw.map_or(0.0, |yaw| yaw.rad),
        lever_arm: None,
    };
    let yaw_deviation = yaw.and(yaw_variance).map(f64::sqrt);
    Ok(BoardMounting {
        measured: MeasuredRig {
            rig: rig.validated().map_err(|error| Error::input(error.to_string()))?,
            deviations: RigDeviations::of(&covariance, yaw_deviation),
        },
        covariance,
        views: fits.into_iter().map(|fit| mounting_view(fit, floor.thickness_m)).collect(),
        scatter: combined.scatter.map(f64::sqrt).into(),
        notes,
    })
}

fn check(camera: &Camera, floor: &FloorBoard, views: &[BoardView]) -> Result<()> {
    if !(floor.thickness_m.is_finite() && (0.0..1.0).contains(&floor.thickness_m)) {
        return Err(Error::usage(format!(
            "a board {} mm thick is not usable; give the height of its printed side above the floor, less than 1000 mm",
            floor.thickness_m * 1e3
        )));
    }
    let (width, height) = (camera.width(), camera.height());
    if let Some((index, other)) = views.iter().enumerate().find(|(_, view)| view.size != (width, height)) {
        return Err(Error::input(format!(
            "picture {} is {}x{} but the camera is calibrated for {width}x{height}; calibrate at the size of the pictures",
            index + 1,
            other.size.0,
            other.size.1
        )));
    }
    Ok(())
}

fn none_used(fits: &[Fitted]) -> Error {
    let why = fits.iter().find_map(|fit| fit.as_ref().err());
    Error::input(match why {
        Some(left_out) if fits.len() == 1 => format!("the rig cannot be measured: {}", left_out.why),
        Some(left_out) => format!(
            "none of the {} views shows the board lying on the floor; of the first, {}",
            fits.len(),
            left_out.why
        ),
        None => "there is no view of the board".to_owned(),
    })
}

/// An excluded view, with its fit, if any.
#[derive(Debug, Clone)]
struct LeftOut {
    why: String,
    fit: Option<Box<ViewPoseFit>>,
}

/// The pose of a view, or the reason why it is excluded.
type Fitted = std::result::Result<ViewPoseFit, LeftOut>;

/// The combination of the used views.
struct Together {
    /// Height above the board, roll and pitch about which the views are linearised.
    around: Vector3<f64>,
    combined: Combined<3>,
    yaw: Option<Yaw>,
}

#[derive(Debug, Clone, Copy)]
struct Yaw {
    rad: f64,
    variance: f64,
    scatter_rad: f64,
}

fn together<'a>(floor: &FloorBoard, fits: impl Iterator<Item = &'a ViewPoseFit> + Clone) -> Option<Together> {
    let first = fits.clone().next()?;
    let around = first.quantities();
    let parts: Vec<Part<3>> = fits.clone().map(|fit| fit.part(&around)).collect::<Option<_>>()?;
    let combined = combine(&parts)?;
    let yaw = floor.forward.and_then(|_| {
        let turn = TAU / ambiguity_turns(&floor.board) as f64;
        let nearest = |to: f64, rad: f64| rad - turn * ((rad - to) / turn).round();
        let first = nearest(0.0, wrap_angle(first.pose.heading_rad));
        let part = |fit: &ViewPoseFit| {
            let information = 1.0 / fit.heading_variance()?;
            let off = nearest(0.0, fit.pose.heading_rad - first);
            Some(Part { information: Matrix1::new(information), slope: Vector1::new(information * off) })
        };
        let parts: Vec<Part<1>> = fits.map(part).collect::<Option<_>>()?;
        let yaw = combine(&parts)?;
        Some(Yaw {
            rad: wrap_angle(first + yaw.offset[0]),
            variance: yaw.covariance[0],
            scatter_rad: yaw.scatter[0].sqrt(),
        })
    });
    Some(Together { around, combined, yaw })
}

/// The pose of one view, or the reason why it has none.
fn fitted(camera: &Camera, points: &[(GroundPoint, Pixel)]) -> Fitted {
    let refuse = |why: String, fit: Option<ViewPoseFit>| Err(LeftOut { why, fit: fit.map(Box::new) });
    if points.len() < FEWEST_POINTS {
        return refuse(
            format!(
                "only {} points of the board are seen; at least {FEWEST_POINTS} are needed",
                points.len()
            ),
            None,
        );
    }
    let Some(start) = fit::start(camera, points) else {
        return refuse("the points seen do not spread over the board".to_owned(), None);
    };
    if start.height_m <= 0.0 {
        return refuse("the board is seen mirrored, as if from its back".to_owned(), None);
    }
    let Some(found) = fit(camera, points, &start) else {
        return refuse("no pose of the camera puts the board where it is seen".to_owned(), None);
    };
    let tilt_deg = (found.pose.roll_rad.cos() * found.pose.pitch_rad.cos()).acos().to_degrees();
    if tilt_deg > LARGEST_TILT_DEG {
        let why = format!(
            "the board stands upright before the camera (tilted by {tilt_deg:.0}°) instead of lying on the floor below it"
        );
        return refuse(why, Some(found));
    }
    Ok(found)
}

fn mounting_view(fit: Fitted, thickness_m: f64) -> MountingView {
    let (fit, why_not) = match fit {
        Ok(fit) => (Some(fit), None),
        Err(LeftOut { why, fit }) => (fit.map(|fit| *fit), Some(why)),
    };
    let raised = |pose: GroundPose| GroundPose { height_m: pose.height_m + thickness_m, ..pose };
    MountingView {
        deviations: fit.as_ref().and_then(ViewPoseFit::deviations).unwrap_or([f64::INFINITY; 3]),
        rms_px: fit.as_ref().map_or(f64::INFINITY, |fit| fit.rms_px),
        pose: fit.map(|fit| raised(fit.pose)),
        why_not,
    }
}

fn notes(floor: &FloorBoard, used: &[(usize, ViewPoseFit)], yaw: Option<Yaw>) -> Vec<String> {
    let mut notes = Vec::new();
    let worst = used.iter().max_by(|a, b| a.1.rms_px.total_cmp(&b.1.rms_px));
    if let Some((index, worst)) = worst.filter(|(_, fit)| fit.rms_px > GOOD_FIT_PX) {
        notes.push(format!(
            "the board fits to only {:.1} px in view {}: it is bent, or the camera file is not that of this camera",
            worst.rms_px,
            index + 1
        ));
    }
    let turns = ambiguity_turns(&floor.board);
    match yaw {
        Some(yaw) if yaw.scatter_rad >= ALIGNED_DEG.to_radians() => notes.push(format!(
            "the board lay in directions that differ by {:.0}°, so the mount yaw is not measured; lay it along the carrier's forward \
             in every view",
            yaw.scatter_rad.to_degrees()
        )),
        Some(yaw) if turns > 1 => notes.push(format!(
            "a {} looks the same after a turn of {}°: of the mount yaws that may be, {:.1}° is the one nearest to 0",
            floor.board,
            360 / turns,
            yaw.rad.to_degrees()
        )),
        _ => {}
    }
    notes
}

/// Order of the rotational symmetry of a board: 1 without symmetry, 2 for a half turn, 4 for
/// quarter turns.
pub fn ambiguity_turns(board: &Board) -> usize {
    let (columns, rows) = (board.columns(), board.rows());
    let square = columns == rows;
    match board.kind() {
        // A half turn exchanges the colours if one count is odd and the other even.
        BoardKind::Chessboard if (columns + rows) % 2 == 1 => 1,
        BoardKind::Chessboard if square && rows % 2 == 0 => 4,
        BoardKind::Chessboard => 2,
        BoardKind::Circles if square => 4,
        BoardKind::Circles => 2,
        BoardKind::AsymmetricCircles if rows % 2 == 0 => 2,
        _ => 1,
    }
}

impl FloorBoard {
    /// The seen points with their positions in a world whose z = 0 is the printed side and whose x
    /// is the board's forward direction.
    fn points(&self, view: &BoardView) -> Vec<(GroundPoint, Pixel)> {
        let all = self.board.points();
        let place = |x: f64, y: f64| match self.forward.unwrap_or(BoardDirection::MinusY) {
            // Seen from above, as the print is: left of x is up the print.
            BoardDirection::X => GroundPoint::new(x, -y),
            BoardDirection::MinusX => GroundPoint::new(-x, y),
            BoardDirection::Y => GroundPoint::new(y, x),
            BoardDirection::MinusY => GroundPoint::new(-y, -x),
        };
        let seen = |point: &crate::SeenPoint| {
            all.get(point.index).map(|board| (place(board.x_m, board.y_m), point.pixel))
        };
        view.points.iter().filter_map(seen).collect()
    }
}

impl ViewPoseFit {
    /// Height, roll and pitch.
    fn quantities(&self) -> Vector3<f64> {
        Vector3::new(self.pose.height_m, self.pose.roll_rad, self.pose.pitch_rad)
    }

    /// Its information on them, with position and heading marginalised.
    fn part(&self, around: &Vector3<f64>) -> Option<Part<3>> {
        let covariance = inverse(&self.information)?.fixed_view::<3, 3>(3, 3).into_owned();
        let information = inverse(&covariance)?;
        Some(Part { information, slope: information * (self.quantities() - around) })
    }

    fn heading_variance(&self) -> Option<f64> {
        Some(inverse(&self.information)?[(2, 2)])
    }

    fn deviations(&self) -> Option<[f64; 3]> {
        let covariance = inverse(&self.information)?;
        Some([3, 4, 5].map(|i| covariance[(i, i)].sqrt()))
    }
}

#[cfg(test)]
mod tests;
