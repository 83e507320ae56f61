#![allow(clippy::print_stdout, clippy::unwrap_used, missing_docs)]
use odograph::camera::Rig;
use odograph::evaluation::{Alignment, EvaluationOptions, evaluate};
use odograph::formats::camera_file;
use odograph::image::GrayImage;
use odograph::odometry::{Odometry, OdometryConfig};
use odograph::trajectory::{StampedPose, Trajectory, TrackStatus};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Quaternion};
use odograph::geometry::GroundPose;

fn tum(path: &str) -> Vec<(f64, Isometry3<f64>)> {
    std::fs::read_to_string(path).unwrap().lines().filter(|l| !l.starts_with('#') && !l.trim().is_empty()).map(|l| {
        let v: Vec<f64> = l.split_whitespace().map(|x| x.parse().unwrap()).collect();
        (v[0], Isometry3::from_parts(Translation3::new(v[1], v[2], v[3]), UnitQuaternion::from_quaternion(Quaternion::new(v[7], v[4], v[5], v[6]))))
    }).collect()
}

fn main() {
    let mut readout: Option<f64> = None;
    let mut verbose = false; let mut every = 5usize;
    let mut motion = String::from("auto");
    let mut args = std::env::args().skip(1);
    let mut folders = vec![];
    while let Some(a) = args.next() {
        match a.as_str() {
            "--readout-ms" => readout = Some(args.next().unwrap().parse::<f64>().unwrap() / 1e3),
            "--motion" => motion = args.next().unwrap(),
            "-v" => verbose = true, "-e" => every = args.next().unwrap().parse().unwrap(),
            _ => folders.push(a),
        }
    }
    for f in folders {
        let camera = camera_file::parse(&std::fs::read_to_string(format!("{f}/camera.yaml")).unwrap(), None).unwrap();
        let camera = camera.with_readout_s(readout).unwrap();
        let rig: Rig = {
            let t: toml::Table = std::fs::read_to_string(format!("{f}/rig.toml")).unwrap().parse().unwrap();
            let g = |k: &str| t.get(k).and_then(|v| v.as_float());
            Rig { height_m: g("height_m").unwrap(), roll_rad: g("roll_rad").or(g("roll_deg").map(f64::to_radians)).unwrap_or(0.0), pitch_rad: g("pitch_rad").or(g("pitch_deg").map(f64::to_radians)).unwrap_or(0.0), yaw_rad: 0.0 }
        };
        let truth_all = tum(&format!("{f}/truth.tum"));
        let (w, h) = (camera.width(), camera.height());
        // Frames: y4m mono/420 or the pictures that frames.txt names.
        let mut images: Vec<Vec<u8>> = vec![];
        let y4m = std::fs::read_dir(&f).unwrap().filter_map(|e| e.ok()).map(|e| e.path()).find(|p| p.extension().is_some_and(|x| x == "y4m" || x == "gray"));
        let path = y4m.unwrap();
        let data = std::fs::read(&path).unwrap();
        if path.extension().unwrap() == "gray" {
            images.extend(data.chunks(w * h).map(|c| c.to_vec()));
        } else {
            let head = data.iter().position(|&b| b == b'\n').unwrap();
            let header = String::from_utf8_lossy(&data[..head]).to_string();
            let mono = header.contains("Cmono");
            let mut at = head + 1;
            while at < data.len() {
                let e = at + data[at..].iter().position(|&b| b == b'\n').unwrap() + 1;
                images.push(data[e..e + w * h].to_vec());
                at = e + if mono { w * h } else { w * h + 2 * w.div_ceil(2) * h.div_ceil(2) };
            }
        }
        let mut config = OdometryConfig::default();
        config.motion.model = match motion.as_str() { "rigid" => odograph::motion::MotionModel::Rigid, "free" => odograph::motion::MotionModel::Free, "similarity" => odograph::motion::MotionModel::Similarity, _ => odograph::motion::MotionModel::Auto };
        let mut odometry = Odometry::new(camera.clone(), rig, config).unwrap();
        let (mut estimate, mut truth) = (Trajectory::default(), Trajectory::default());
        let first = GroundPose::from_world_from_camera(&truth_all[0].1);
        let (mut squares, mut n, mut lost, mut was) = (0.0, 0usize, 0, true);
        let t0 = std::time::Instant::now();
        for (k, image) in images.into_iter().enumerate() {
            let (t, pose) = truth_all[k];
            let frame = odometry.process(GrayImage::from_samples(w, h, image).unwrap(), t).unwrap();
            truth.poses.push(StampedPose { time_s: t, world_from_camera: pose });
            let ok = matches!(frame.status, TrackStatus::Tracked);
            if !ok && was { lost += 1; }
            was = ok;
            let Some(known) = frame.estimate else { if verbose { println!("{k} lost {:?}", frame.status); } continue };
            estimate.poses.push(StampedPose { time_s: t, world_from_camera: known.pose.world_from_camera() });
            // Truth in the frame of the first pose.
            let now = GroundPose::from_world_from_camera(&pose);
            let (s, c) = (-first.heading_rad).sin_cos();
            let (dx, dy) = (now.x_m - first.x_m, now.y_m - first.y_m);
            let (tx, ty) = (c * dx - s * dy, s * dx + c * dy);
            let e = nalgebra::Vector3::new(known.pose.x_m - tx, known.pose.y_m - ty, odograph::geometry::wrap_angle(known.pose.heading_rad - (now.heading_rad - first.heading_rad)));
            if k > 30 { if let Some(i) = known.covariance.fixed_view::<3,3>(0,0).into_owned().try_inverse() { squares += e.dot(&(i * e)); n += 1; } }
            if verbose && k % every == 0 {
                println!("{k:4} {t:.3} true {tx:.4} {ty:.4} h {:.4} err mm {:.3} {:.3} {:.3} deg h {:.4} r {:.4} p {:.4} sig mm {:.3} {:.3} deg {:.4} inl {} res {:.3} kf {} {}", now.height_m, 1e3*e.x, 1e3*e.y, 1e3*(known.pose.height_m-now.height_m), e.z.to_degrees(), (known.pose.roll_rad-now.roll_rad).to_degrees(), (known.pose.pitch_rad-now.pitch_rad).to_degrees(), 1e3*known.covariance[(0,0)].sqrt(), 1e3*known.covariance[(1,1)].sqrt(), known.covariance[(2,2)].sqrt().to_degrees(), frame.inliers, frame.residual_px, odometry.keyframes(), odometry.readout().map_or(String::new(), |r| format!("readout {:.3} ± {:.3} ms", 1e3 * r.mean_s, 1e3 * r.variance_s2.sqrt())));
            }
        }
        let ms = 1e3 * t0.elapsed().as_secs_f64() / truth.poses.len() as f64;
        let found = evaluate(&estimate, &truth, &EvaluationOptions { alignment: Alignment::Origin, segment_lengths_m: vec![1.0], ..Default::default() });
        let se3 = evaluate(&estimate, &truth, &EvaluationOptions { alignment: Alignment::Se3, segment_lengths_m: vec![1.0], ..Default::default() });
        let name = f.rsplit('/').next().unwrap();
        match found {
            Ok(found) => {
                let d = found.drift.first();
                println!("{name:24} drift {:.4} % {:.4} deg/m end {:.2} mm {:.3} deg NEES {:.2} posed {:.1} % lost {lost} masked {:.3} kf {} ate {:.2} mm {ms:.2} ms {}", d.map_or(f64::NAN, |d| d.translation_percent), d.map_or(f64::NAN, |d| d.heading_deg_per_m), 1e3*found.final_position_error_m, found.final_heading_error_rad.to_degrees(), squares / n.max(1) as f64, 100.0*estimate.poses.len() as f64/truth.poses.len() as f64, odometry.fixed_in_image().share(), odometry.keyframes(), se3.map_or(f64::NAN, |s| 1e3*s.absolute.translation.rmse), odometry.readout().map_or(String::new(), |r| format!("readout {:.3} ± {:.3} ms", 1e3 * r.mean_s, 1e3 * r.variance_s2.sqrt())));
            }
            Err(e) => println!("{name}: {e}"),
        }
    }
}
