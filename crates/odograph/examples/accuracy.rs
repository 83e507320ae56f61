//! The accuracy table of the README: rendered drives with exact truth, tracked, and what is wrong at the end.
//!
//! `cargo run --release -p odograph --example accuracy [-- NAME…]`

use odograph::camera::{Camera, Distortion, Rig};
use odograph::geometry::{GroundPose, Pixel};
use odograph::motion::MotionModel;
use odograph::odometry::{Odometry, OdometryConfig};
use odograph::simulation::{Effects, Path, PathKind, Simulation, SimulationConfig, Texture};
use odograph::trajectory::FrameEstimate;
use std::f64::consts::TAU;
use std::time::Instant;

struct Scene {
    name: &'static str,
    texture: Texture,
    path: PathKind,
    speed_m_s: f64,
    turn_rate_rad_s: f64,
    model: MotionModel,
}

fn camera() -> Camera {
    // A mild barrel, as a cheap USB camera has it.
    let distortion = Distortion::from_opencv(&[-0.12, 0.03, 0.0005, -0.0003]).expect("four coefficients");
    Camera::new((640, 480), (500.0, 500.0), (321.0, 238.5), distortion).expect("a sound camera")
}

fn scenes(rig: &Rig) -> Vec<Scene> {
    let corner =
        camera().ray_from_pixel(Pixel::new(0.0, 0.0)).and_then(|ray| rig.first_pose().ground_from_ray(ray));
    let pivot = PathKind::Pivot { about: corner.expect("ground in the corner"), turn_rad: TAU };
    let rigid = MotionModel::Rigid;
    let scene = |name, texture, path, speed_m_s, turn_rate_rad_s, model| Scene {
        name,
        texture,
        path,
        speed_m_s,
        turn_rate_rad_s,
        model,
    };
    let eight = PathKind::FigureEight { length_m: 3.0, laps: 1.0 };
    vec![
        scene("straight-asphalt", Texture::Asphalt, PathKind::Straight { length_m: 10.0 }, 0.8, 1.0, rigid),
        scene("straight-carpet", Texture::Carpet, PathKind::Straight { length_m: 10.0 }, 0.8, 1.0, rigid),
        scene(
            "square-asphalt",
            Texture::Asphalt,
            PathKind::SquareByTranslation { side_m: 2.5 },
            0.6,
            1.0,
            rigid,
        ),
        scene(
            "square-concrete",
            Texture::Concrete,
            PathKind::SquareByTranslation { side_m: 2.5 },
            0.6,
            1.0,
            rigid,
        ),
        scene("turns-grass", Texture::Grass, PathKind::SquareWithTurns { side_m: 2.5 }, 0.6, 1.0, rigid),
        scene("eight-asphalt", Texture::Asphalt, eight, 0.6, 1.0, rigid),
        scene("eight-tiles", Texture::Tiles, eight, 0.6, 1.0, rigid),
        scene("eight-bare", Texture::Bare, eight, 0.6, 1.0, rigid),
        scene("pivot-asphalt", Texture::Asphalt, pivot, 0.6, 1.0, rigid),
        scene("pivot-carpet", Texture::Carpet, pivot, 0.6, 1.0, rigid),
        scene("pivot-asphalt-mean", Texture::Asphalt, pivot, 0.6, 1.0, MotionModel::Mean),
        scene(
            "square-asphalt-mean",
            Texture::Asphalt,
            PathKind::SquareByTranslation { side_m: 2.5 },
            0.6,
            1.0,
            MotionModel::Mean,
        ),
        scene("eight-asphalt-free", Texture::Asphalt, eight, 0.6, 1.0, MotionModel::Free),
    ]
}

fn main() {
    let wanted: Vec<String> = std::env::args().skip(1).collect();
    let rig = Rig::level(0.75);
    println!(
        "{:20} {:>6} {:>5} {:>4} {:>9} {:>9} {:>9} {:>9} {:>6} {:>7} {:>6}",
        "scene", "frames", "lost", "kf", "err/m %", "deg/m", "end mm", "end deg", "resid", "ms", "nees"
    );
    for scene in scenes(&rig) {
        if !wanted.is_empty() && !wanted.iter().any(|w| scene.name.contains(w.as_str())) {
            continue;
        }
        let path = Path::new(scene.path, scene.speed_m_s, scene.turn_rate_rad_s, true).expect("a path");
        let effects = Effects { noise_gray: 2.0, ..Effects::default() };
        let simulation = Simulation::new(SimulationConfig {
            camera: camera(),
            rig,
            texture: scene.texture.clone(),
            path,
            effects,
            fps: 30.0,
            duration_s: None,
            colored: false,
            seed: 5,
        })
        .expect("a simulation");
        let mut config = OdometryConfig::default();
        config.motion.model = scene.model;
        let mut odometry = Odometry::new(camera(), rig, config).expect("a pipeline");
        let mut frames: Vec<(FrameEstimate, GroundPose)> = Vec::new();
        let mut spent = 0.0;
        for number in 0..simulation.len() {
            let rendered = simulation.frame(number).expect("a frame");
            let start = Instant::now();
            let estimate = odometry.process(rendered.image, rendered.time_s).expect("a sound frame");
            spent += start.elapsed().as_secs_f64();
            if std::env::var("DBG").is_ok() {
                eprintln!(
                    "{} tr {} in {} res {:.3} kf {} {:?} truth {:.4} {:.4} {:.4} got {:?}",
                    number,
                    estimate.tracks,
                    estimate.inliers,
                    estimate.residual_px,
                    estimate.keyframe,
                    estimate.status,
                    rendered.truth.x_m,
                    rendered.truth.y_m,
                    rendered.truth.heading_rad,
                    estimate.estimate.as_ref().map(|e| (e.pose.x_m, e.pose.y_m, e.pose.heading_rad))
                );
            }
            frames.push((estimate, rendered.truth));
        }
        let (percent, degrees) = drift(&frames);
        let lost = frames.iter().filter(|f| f.0.estimate.is_none()).count();
        let (last, truth) = frames.last().expect("frames");
        let residual = frames.iter().map(|f| f.0.residual_px).sum::<f64>() / frames.len() as f64;
        let (mm, deg, nees) = last.estimate.as_ref().map_or((f64::NAN, f64::NAN, f64::NAN), |e| {
            let (dx, dy, dh) = (
                e.pose.x_m - truth.x_m,
                e.pose.y_m - truth.y_m,
                odograph::geometry::wrap_angle(e.pose.heading_rad - truth.heading_rad),
            );
            let c = e.covariance.fixed_view::<3, 3>(0, 0).into_owned();
            let v = nalgebra::Vector3::new(dx, dy, dh);
            let nees = c.try_inverse().map_or(f64::NAN, |i| (v.transpose() * i * v)[0]);
            (1e3 * dx.hypot(dy), dh.to_degrees(), nees)
        });
        println!(
            "{:20} {:6} {:5} {:4} {:9.4} {:9.4} {:9.2} {:9.4} {:6.3} {:7.2} {:6.1}",
            scene.name,
            frames.len(),
            lost,
            odometry.keyframes(),
            percent,
            degrees,
            mm,
            deg,
            residual,
            1e3 * spent / frames.len() as f64,
            nees
        );
    }
}

/// Mean error over each metre of the way: position in per cent, heading in degrees a metre.
fn drift(frames: &[(FrameEstimate, GroundPose)]) -> (f64, f64) {
    let posed: Vec<(GroundPose, GroundPose)> =
        frames.iter().filter_map(|(f, t)| f.estimate.as_ref().map(|e| (e.pose, *t))).collect();
    let mut way = vec![0.0];
    for pair in posed.windows(2) {
        let d = (pair[1].1.x_m - pair[0].1.x_m).hypot(pair[1].1.y_m - pair[0].1.y_m);
        way.push(way[way.len() - 1] + d);
    }
    let (mut sum, mut turn, mut count) = (0.0, 0.0, 0.0);
    let mut j = 0;
    for i in 0..posed.len() {
        while j < posed.len() && way[j] < way[i] + 1.0 {
            j += 1;
        }
        if j == posed.len() {
            break;
        }
        let relative = |a: GroundPose, b: GroundPose| {
            let (dx, dy) = (b.x_m - a.x_m, b.y_m - a.y_m);
            let (s, c) = a.heading_rad.sin_cos();
            (c * dx + s * dy, -s * dx + c * dy, b.heading_rad - a.heading_rad)
        };
        let (e, t) = (relative(posed[i].0, posed[j].0), relative(posed[i].1, posed[j].1));
        let length = way[j] - way[i];
        sum += (e.0 - t.0).hypot(e.1 - t.1) / length;
        turn += odograph::geometry::wrap_angle(e.2 - t.2).abs() / length;
        count += 1.0;
    }
    (100.0 * sum / count, (turn / count).to_degrees())
}
