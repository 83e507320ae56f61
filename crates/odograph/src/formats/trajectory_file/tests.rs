use super::*;
use crate::geometry::GroundPose;
use crate::trajectory::{FrameEstimate, LossReason, PlaneMeasurement, PoseEstimate, TrackStatus, Velocity};
use nalgebra::{Matrix6, Vector3};
use proptest::prelude::*;

fn frames() -> Vec<FrameEstimate> {
    let pose = GroundPose { x_m: 1.5, heading_rad: std::f64::consts::FRAC_PI_2, ..GroundPose::level(0.75) };
    let velocity = Velocity { x_m_s: 3.0, y_m_s: 4.0, heading_rad_s: 0.0 };
    let covariance = Matrix6::identity() * 1e-6;
    let tracked = FrameEstimate {
        frame: 3,
        time_s: 0.1,
        status: TrackStatus::Tracked,
        estimate: Some(PoseEstimate {
            pose,
            velocity,
            covariance,
            measured: PlaneMeasurement::new(&pose, &covariance),
        }),
        tracks: 120,
        inliers: 100,
        residual_px: 0.125,
        keyframe: true,
        segment: 0,
    };
    let lost = FrameEstimate {
        frame: 4,
        time_s: 0.2,
        status: TrackStatus::Lost { reason: LossReason::Bare },
        estimate: None,
        tracks: 2,
        inliers: 0,
        residual_px: 0.0,
        keyframe: false,
        segment: 0,
    };
    vec![tracked, lost]
}

#[test]
fn unknown_quantities_have_empty_cells() {
    let csv = csv_from_frames(&frames());
    let lines: Vec<_> = csv.lines().collect();
    assert_eq!(
        lines[1],
        "3,0.100000000,1.500000,0.000000,90.000000,0.750000,0.000000,0.000000,5.000000,0.000000,0.001000000,0.001000000,\
         0.057295780,120,100,0.1250,1,0,tracked"
    );
    assert_eq!(lines[2], "4,0.200000000,,,,,,,,,,,,2,0,,0,0,lost:bare");
    let columns = |line: &str| line.split(',').count();
    assert!(lines.iter().all(|line| columns(line) == columns(lines[0])));
}

#[test]
fn only_frames_with_a_pose_are_written_as_tum() {
    let text = write_tum(&Trajectory::from_frames(&frames()));
    let back = parse_tum(&text).unwrap();
    assert_eq!(back.poses.len(), 1);
    let pose = GroundPose::from_world_from_camera(&back.poses[0].world_from_camera);
    assert!((pose.heading_rad - std::f64::consts::FRAC_PI_2).abs() < 1e-9 && (pose.x_m - 1.5).abs() < 1e-9);
}

#[test]
fn tum_accepts_commas_tabs_comments_and_a_byte_order_mark() {
    let text = "\u{feff}# comment\r\n\r\n 1.5\t1 2 3 0 0 0 2 \r\n2.5, 1, 2, 3, 0, 0, 0, 1\n";
    let trajectory = parse_tum(text).unwrap();
    assert_eq!(trajectory.poses.len(), 2);
    assert_eq!(trajectory.poses[0].time_s, 1.5);
    assert!((trajectory.poses[0].world_from_camera.rotation.coords.w - 1.0).abs() < 1e-15);
}

#[test]
fn the_columns_that_a_comment_names_are_read() {
    let euroc = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], \
                 q_RS_z [], v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]\n\
                 1403636580838555648,1,2,3,0.8,0.6,0,0,9,9,9\n";
    let short = "#timestamp[ns], x,y,z, qw,qx,qy,qz\n1403636580838555648,1,2,3,0.8,0.6,0,0\n";
    for text in [euroc, short] {
        assert_eq!(guess_format(text).unwrap(), TrajectoryFormat::Tum);
        let pose = &parse_tum(text).unwrap().poses[0];
        assert!((pose.time_s - 1_403_636_580.838_555_6).abs() < 1e-6, "{}", pose.time_s);
        assert_eq!(pose.world_from_camera.translation.vector, Vector3::new(1.0, 2.0, 3.0));
        let q = pose.world_from_camera.rotation.coords;
        assert!((q.w - 0.8).abs() < 1e-12 && (q.x - 0.6).abs() < 1e-12, "{q}");
    }
    // Without a unit times are seconds.
    let pose = &parse_tum("# timestamp tx ty tz qw qx qy qz\n1.5 1 2 3 0.8 0.6 0 0\n").unwrap().poses[0];
    assert!(pose.time_s == 1.5 && (pose.world_from_camera.rotation.w - 0.8).abs() < 1e-12);
    // TUM's own comment changes nothing.
    let pose = &parse_tum("# timestamp tx ty tz qx qy qz qw\n1.5 1 2 3 0.6 0 0 0.8\n").unwrap().poses[0];
    assert!(pose.time_s == 1.5 && (pose.world_from_camera.rotation.w - 0.8).abs() < 1e-12);
    let error = parse_tum("#timestamp[ns],x,y,z,qw,qx,qy,qz\n1,1,2,3,1,0,0\n").unwrap_err().to_string();
    assert!(error.contains("line 2 has 7 values") && error.contains("names 8 columns"), "{error}");
}

#[test]
fn errors_name_the_line() {
    for (text, part) in [
        ("", "no pose"),
        ("# nothing\n", "no pose"),
        ("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0", "line 2 has 7 values, not 8"),
        ("0 1 2 3 0 0 0 1 9", "line 1 has 9 values"),
        ("0 1 2 three 0 0 0 1", "line 1: \"three\""),
        ("0 1 2 NaN 0 0 0 1", "line 1: \"NaN\""),
        ("0 1 2 1e999 0 0 0 1", "line 1: \"1e999\""),
        ("\n\n0 1 2 3 0 0 0 0", "line 3: the quaternion is zero"),
        ("1 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1", "line 2: the time 1 s is not later"),
    ] {
        let error = parse_tum(text).unwrap_err().to_string();
        assert!(error.contains(part), "{text:?}: {error}");
    }
    for (text, part) in [
        ("1 0 0 0 0 1 0 0 0 0 1", "line 1 has 11 values"),
        ("1 0 0 0 0 1 0 0 0 0 2 0", "line 1: the left 3x3 part is not a rotation"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0", "line 1: the left 3x3 part is not a rotation"),
        ("1e300 0 0 0 0 1e300 0 0 0 0 1 0", "not a rotation"),
    ] {
        let error = parse_kitti(text, None).unwrap_err().to_string();
        assert!(error.contains(part), "{text:?}: {error}");
    }
    assert!(parse_kitti("1 0 0 0 0 1 0 0 0 0 1 0", Some(&[0.0, 1.0])).is_err());
    assert!(parse_times("1\n1").unwrap_err().to_string().contains("line 2"));
    assert!(guess_format("1 2 3").unwrap_err().to_string().contains("3 values"));
    assert_eq!(guess_format("# x\n1 0 0 0 0 1 0 0 0 0 1 0").unwrap(), TrajectoryFormat::Kitti);
}

#[test]
fn a_rounded_kitti_matrix_becomes_a_rotation() {
    let turned = Rotation3::from_euler_angles(0.3, -0.2, 1.1);
    let rounded = turned.matrix().map(|v: f64| (v * 1e4).round() / 1e4);
    let exact = nearest_rotation(rounded);
    assert!((exact * exact.transpose() - Matrix3::identity()).amax() < 1e-14);
    assert!((exact - turned.matrix()).amax() < 1e-4);
}

prop_compose! {
    fn trajectories()(steps in prop::collection::vec(
        (1e-3..1.0f64, -100.0..100.0f64, -100.0..100.0f64, -100.0..100.0f64, -3.0..3.0f64, -3.0..3.0f64, -3.0..3.0f64), 1..20
    ), start in 0.0..2e9f64) -> Trajectory {
        let mut time_s = start;
        let poses = steps.into_iter().map(|(dt, x, y, z, a, b, c)| {
            time_s += dt;
            StampedPose { time_s, world_from_camera: Isometry3::new(Vector3::new(x, y, z), Vector3::new(a, b, c)) }
        });
        Trajectory { poses: poses.collect() }
    }
}

fn assert_same(a: &Trajectory, b: &Trajectory, times: bool) {
    assert_eq!(a.poses.len(), b.poses.len());
    for (a, b) in a.poses.iter().zip(&b.poses) {
        assert!(!times || (a.time_s - b.time_s).abs() < 1e-9);
        let (a, b) = (a.world_from_camera, b.world_from_camera);
        assert!((a.translation.vector - b.translation.vector).norm() < 1e-9);
        assert!(a.rotation.angle_to(&b.rotation) < 1e-7, "acos loses half the digits near zero");
        let same = (a.rotation.coords - b.rotation.coords)
            .norm()
            .min((a.rotation.coords + b.rotation.coords).norm());
        assert!(same < 1e-11);
    }
}

proptest! {
    #[test]
    fn tum_round_trips(trajectory in trajectories()) {
        assert_same(&trajectory, &parse_tum(&write_tum(&trajectory)).unwrap(), true);
    }

    #[test]
    fn kitti_round_trips(trajectory in trajectories()) {
        let times: Vec<_> = trajectory.poses.iter().map(|p| p.time_s).collect();
        let text = write_kitti(&trajectory);
        assert_same(&trajectory, &parse_kitti(&text, Some(&times)).unwrap(), true);
        assert_same(&trajectory, &parse_kitti(&text, None).unwrap(), false);
    }

    #[test]
    fn any_text_is_survived(text in "[-0-9eE+., #\n\tNaInf]*") {
        let _ = (parse_tum(&text), parse_kitti(&text, None), parse_times(&text), guess_format(&text));
    }

    #[test]
    fn any_bytes_are_survived(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let text = String::from_utf8_lossy(&bytes);
        let _ = (parse_tum(&text), parse_kitti(&text, None), parse_times(&text), guess_format(&text));
    }
}
