//! The pose of a camera over points of a plane: robust Levenberg–Marquardt in pixels.

use nalgebra::{Matrix3, Matrix6, SMatrix, SVector, Vector6};
use odograph::camera::Camera;
use odograph::camera::PosedCamera;
use odograph::geometry::{GroundPoint, GroundPose, Pixel};

/// The pose of one view.
#[derive(Debug, Clone)]
pub struct ViewPoseFit {
    pub pose: GroundPose,
    /// Of (x, y, heading, height, roll, pitch).
    pub information: Matrix6<f64>,
    pub rms_px: f64,
}

/// The initial pose: the homography from the plane to the rays (R. Hartley and A. Zisserman,
/// "Multiple View Geometry", algorithm 4.2), decomposed after Z. Zhang ("A flexible new technique
/// for camera calibration", 2000, section 3.1). Its height is negative if the board is seen from
/// its back. `None` if the points are collinear.
pub fn start(camera: &Camera, points: &[(GroundPoint, Pixel)]) -> Option<GroundPose> {
    let n = points.len() as f64;
    let (mean_x, mean_y) =
        points.iter().fold((0.0, 0.0), |(x, y), (ground, _)| (x + ground.x_m / n, y + ground.y_m / n));
    let spread = |(ground, _): &(GroundPoint, Pixel)| (ground.x_m - mean_x).hypot(ground.y_m - mean_y);
    let size = points.iter().map(spread).fold(0.0, f64::max);
    if size <= 0.0 {
        return None;
    }
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for (ground, pixel) in points {
        let Some(ray) = camera.ray_from_pixel(*pixel) else { continue };
        let (x, y) = ((ground.x_m - mean_x) / size, (ground.y_m - mean_y) / size);
        let rows = [
            [x, y, 1.0, 0.0, 0.0, 0.0, -ray.x * x, -ray.x * y, -ray.x],
            [0.0, 0.0, 0.0, x, y, 1.0, -ray.y * x, -ray.y * y, -ray.y],
        ];
        for row in rows {
            let row = SVector::<f64, 9>::from(row);
            normal += row * row.transpose();
        }
    }
    let eigen = normal.symmetric_eigen();
    let mut order: Vec<usize> = (0..9).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    // A second vanishing direction: the points lie on a line.
    if eigen.eigenvalues[order[1]] < 1e-9 * eigen.eigenvalues[order[8]] {
        return None;
    }
    let h = eigen.eigenvectors.column(order[0]);
    let mut homography = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]);
    // The board is in front of the camera.
    if homography[(2, 2)] < 0.0 {
        homography = -homography;
    }
    let scale = 2.0 / (homography.column(0).norm() + homography.column(1).norm());
    let along_x = homography.column(0) * scale;
    let along_y = homography.column(1) * scale;
    let middle = homography.column(2) * (scale * size);
    let up = along_x.cross(&along_y);
    let nearest = Matrix3::from_columns(&[along_x, along_y, up]).svd(true, true);
    let camera_from_world = nearest.u? * nearest.v_t?;
    let centre = -(camera_from_world.transpose() * middle);
    let rotation = nalgebra::Rotation3::from_matrix_unchecked(camera_from_world.transpose());
    let isometry = nalgebra::Isometry3::from_parts(
        nalgebra::Translation3::from(centre),
        nalgebra::UnitQuaternion::from_rotation_matrix(&rotation),
    );
    let pose = GroundPose::from_world_from_camera(&isometry);
    Some(GroundPose { x_m: pose.x_m + mean_x, y_m: pose.y_m + mean_y, ..pose })
}

/// The pose near `start` of least re-projection error, with Huber's loss (P. Huber, "Robust
/// statistics", k = 1.345). `None` if the points do not determine it.
pub fn fit(camera: &Camera, points: &[(GroundPoint, Pixel)], start: &GroundPose) -> Option<ViewPoseFit> {
    let mut pose = *start;
    let mut weights = vec![1.0; points.len()];
    for _ in 0..ROBUST_ROUNDS {
        pose = levenberg_marquardt(camera, points, &weights, pose)?;
        let errors = distances(camera, points, &pose)?;
        let deviation = variance_px2(&errors, &weights).sqrt().max(SMALLEST_NOISE_PX);
        weights = errors.iter().map(|&e| (REACH * deviation / e.max(1e-12)).min(1.0)).collect();
    }
    let PoseSystem { information, .. } = system(camera, points, &weights, &pose)?;
    let errors = distances(camera, points, &pose)?;
    let n = points.len() as f64;
    let variance_px2 = variance_px2(&errors, &weights);
    let rms_px = (errors.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
    Some(ViewPoseFit {
        pose,
        information: information / variance_px2.max(SMALLEST_NOISE_PX * SMALLEST_NOISE_PX),
        rms_px,
    })
}

const ROBUST_ROUNDS: usize = 4;

/// Limit of Huber's loss, in standard deviations of a coordinate: 1 in 100 of Gaussian errors
/// exceeds it (Rayleigh).
const REACH: f64 = 3.0;

/// Lower bound of the noise, pixels, for exact points in tests.
const SMALLEST_NOISE_PX: f64 = 1e-6;

/// Variance of a coordinate, from the weighted mean square distance.
fn variance_px2(errors: &[f64], weights: &[f64]) -> f64 {
    let squares: f64 = errors.iter().zip(weights).map(|(e, w)| w * e * e).sum();
    let kept: f64 = weights.iter().sum();
    // Degrees of freedom: two coordinates per point, less six parameters.
    squares / (2.0 * kept - 6.0).max(1.0)
}

fn distances(camera: &Camera, points: &[(GroundPoint, Pixel)], pose: &GroundPose) -> Option<Vec<f64>> {
    let posed = PosedCamera::new(camera, *pose);
    points.iter().map(|(ground, pixel)| Some(posed.see(*ground)?.pixel.distance(*pixel))).collect()
}

struct PoseSystem {
    information: Matrix6<f64>,
    slope: Vector6<f64>,
    cost: f64,
}

/// `None` if a point is not in front of the lens.
fn system(
    camera: &Camera,
    points: &[(GroundPoint, Pixel)],
    weights: &[f64],
    pose: &GroundPose,
) -> Option<PoseSystem> {
    let posed = PosedCamera::new(camera, *pose);
    let mut system = PoseSystem { information: Matrix6::zeros(), slope: Vector6::zeros(), cost: 0.0 };
    for ((ground, pixel), &weight) in points.iter().zip(weights) {
        let seen = posed.see(*ground)?;
        let error = nalgebra::Vector2::new(seen.pixel.x - pixel.x, seen.pixel.y - pixel.y);
        system.information += weight * seen.by_pose.transpose() * seen.by_pose;
        system.slope += weight * seen.by_pose.transpose() * error;
        system.cost += weight * error.norm_squared();
    }
    Some(system)
}

fn levenberg_marquardt(
    camera: &Camera,
    points: &[(GroundPoint, Pixel)],
    weights: &[f64],
    start: GroundPose,
) -> Option<GroundPose> {
    let mut pose = start;
    let mut here = system(camera, points, weights, &pose)?;
    let mut damping = 1e-4;
    for _ in 0..STEPS {
        let damped =
            Matrix6::from_fn(|i, j| here.information[(i, j)] * if i == j { 1.0 + damping } else { 1.0 });
        let step = damped.cholesky()?.solve(&here.slope);
        let next = GroundPose {
            x_m: pose.x_m - step[0],
            y_m: pose.y_m - step[1],
            heading_rad: pose.heading_rad - step[2],
            height_m: pose.height_m - step[3],
            roll_rad: pose.roll_rad - step[4],
            pitch_rad: pose.pitch_rad - step[5],
        };
        let there = system(camera, points, weights, &next).filter(|_| next.height_m > 0.0);
        match there {
            Some(there) if there.cost <= here.cost => {
                let gained = here.cost - there.cost;
                (pose, here) = (next, there);
                damping = (damping * 0.1).max(1e-12);
                if gained <= 1e-14 * here.cost || here.cost == 0.0 {
                    break;
                }
            }
            _ => {
                damping *= 10.0;
                if damping > 1e8 {
                    break;
                }
            }
        }
    }
    Some(pose)
}

const STEPS: usize = 50;
