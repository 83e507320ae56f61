use super::*;
use odograph::camera::Distortion;

fn pinhole() -> Camera {
    Camera::new((320, 240), (300.0, 300.0), (159.5, 119.5), Distortion::None).unwrap()
}

fn barrel() -> Camera {
    let distortion = Distortion::from_opencv(&[-0.3, 0.1, 0.001, -0.0005]).unwrap();
    Camera::new((640, 480), (420.0, 421.0), (322.0, 238.0), distortion).unwrap()
}

fn board(text: &str) -> Board {
    text.parse().unwrap()
}

#[test]
fn rendered_disc_centroids_match_the_ground_truth() {
    // Seen frontally, the image of a disc is a disc around the projection of its centre.
    let board = board("circles:4x3:40mm");
    let scene = BoardScene::new(&board, &pinhole(), 1);
    let effects = BoardEffects::default();
    for shift in [0.0, 0.137, 0.331] {
        let pose = Isometry3::translation(-0.06 + shift * 1e-3, -0.04 - shift * 1e-3, 0.3);
        let image = scene.render(&pose, &effects);
        let view = scene.true_view(&pose);
        assert_eq!(view.points.len(), 12);
        for SeenPoint { pixel, .. } in view.points {
            // The radius of a disc is 10 px and the next disc begins 30 px away.
            let (mut ink, mut x, mut y) = (0.0, 0.0, 0.0);
            for row in pixel.y as usize - 14..pixel.y as usize + 15 {
                for column in pixel.x as usize - 14..pixel.x as usize + 15 {
                    let dark = effects.white_gray - f64::from(image.row(row)[column]);
                    (ink, x, y) = (ink + dark, x + dark * column as f64, y + dark * row as f64);
                }
            }
            // Quantisation error: 100 edge pixels, each off by up to half of 1/185.
            assert!((x / ink - pixel.x).abs() < 0.005 && (y / ink - pixel.y).abs() < 0.005);
            let area_px = ink / (effects.white_gray - effects.black_gray);
            assert!((area_px / (std::f64::consts::PI * 100.0) - 1.0).abs() < 0.002, "{area_px}");
        }
    }
}

#[test]
fn pixels_away_from_edges_have_the_board_colour() {
    for text in ["chessboard:7x5:30mm", "charuco:5x7:30mm", "aprilgrid:3x3:50mm"] {
        let board = board(text);
        let scene = BoardScene::new(&board, &barrel(), 2);
        let effects = BoardEffects::default();
        for pose in scene.poses(3, Framing::Whole, 5) {
            let image = scene.render(&pose, &effects);
            let board_from_camera = pose.inverse();
            let color_at = |x: f64, y: f64| {
                let ray = scene.camera().ray_from_pixel(Pixel::new(x, y)).unwrap().vector();
                let (from, towards) = (board_from_camera.translation.vector, board_from_camera * ray);
                let at = from - towards * (from.z / towards.z);
                let point = BoardPoint { x_m: at.x, y_m: at.y };
                scene.sheet.contains(point).then(|| scene.drawing.is_black(point))
            };
            let mut checked = 0;
            for row in (0..480).step_by(7) {
                for column in (0..640).step_by(5) {
                    let (x, y) = (f64::from(column), f64::from(row));
                    let color = color_at(x, y);
                    let around = [(-0.7, -0.7), (0.7, -0.7), (-0.7, 0.7), (0.7, 0.7)];
                    if color.is_none() || around.iter().any(|(dx, dy)| color_at(x + dx, y + dy) != color) {
                        continue;
                    }
                    let expected = if color == Some(true) { 30 } else { 215 };
                    // A sliver of another colour may pass between the four positions checked.
                    let gray = i32::from(image.row(row as usize)[column as usize]);
                    assert!((gray - expected).abs() < 60, "{text} at {column}, {row}: {gray}");
                    checked += 1;
                }
            }
            assert!(checked > 500, "{checked}");
        }
    }
}

#[test]
fn poses_keep_the_board_visible_and_cover_the_image() {
    let whole = board("chessboard:8x6:25mm");
    let scene = BoardScene::new(&whole, &barrel(), 0);
    let poses = scene.poses(20, Framing::Whole, 9);
    assert!(poses.iter().all(|pose| scene.true_view(pose).points.len() == 48));
    let mut quarters = [0; 4];
    for seen in poses.iter().flat_map(|pose| scene.true_view(pose).points) {
        quarters[usize::from(seen.pixel.x > 320.0) + 2 * usize::from(seen.pixel.y > 240.0)] += 1;
    }
    assert!(quarters.iter().all(|count| *count > 20 * 48 / 8), "{quarters:?}");
    let tilts = poses.iter().map(|pose| (pose.rotation * Vector3::z()).z.acos().to_degrees());
    assert!(tilts.filter(|tilt| *tilt > 25.0).count() >= 6);
    let partial = BoardScene::new(&board("charuco:8x11:20mm"), &barrel(), 0);
    let poses = partial.poses(20, Framing::Partial, 9);
    assert!(poses.iter().any(|pose| partial.true_view(pose).points.len() < 60));
    assert!(poses.iter().all(|pose| partial.true_view(pose).points.len() >= 23));
}

#[test]
fn a_recorded_board_is_held_still_and_then_moved() {
    let recording = |seed: u64| {
        let scene = BoardScene::new(&board("charuco:5x7:30mm"), &pinhole(), 1);
        BoardRecording::new(scene, BoardEffects::camera_like(2.0, 0), 10.0, 3.0, seed).unwrap()
    };
    let shown = recording(4);
    assert_eq!((shown.times_s().len(), shown.times_s()[30]), (31, 3.0));
    let place = |time_s: f64| shown.camera_from_board(time_s);
    assert_eq!(place(0.0), place(0.45));
    let apart = |a: f64, b: f64| (place(a).inverse() * place(b)).translation.vector.norm();
    assert!(apart(0.0, 1.0) > 0.01 && apart(0.5, 0.75) > 1e-3 && apart(0.98, 1.0) < 0.05 * apart(0.0, 1.0));
    // The board is turned and moved along the shortest way.
    let middle = shown.scene().middle();
    let half = nalgebra::center(&(place(0.0) * middle), &(place(1.0) * middle));
    assert!((place(0.75) * middle - half).norm() < 1e-9);
    // Noise differs from frame to frame, and the same seed has the same recording.
    let frame = |number: usize| shown.frame(number).unwrap();
    assert_ne!(frame(0).samples(), frame(1).samples());
    assert_eq!(frame(7).samples(), recording(4).frame(7).unwrap().samples());
    assert_ne!(frame(7).samples(), recording(5).frame(7).unwrap().samples());
    assert!(shown.frame(31).is_none());
}

#[test]
fn board_effects_have_the_configured_strength() {
    let board = board("chessboard:7x5:30mm");
    let scene = BoardScene::new(&board, &pinhole(), 3);
    let pose = Isometry3::translation(-0.09, -0.06, 0.35);
    let plain = scene.render(&pose, &BoardEffects::default());
    let mirrored = scene.render(&pose, &BoardEffects { mirrored: true, ..Default::default() });
    assert!((0..320).all(|x| plain.row(100)[x] == mirrored.row(100)[319 - x]));
    let noisy = BoardEffects { noise_gray: 3.0, seed: 4, ..Default::default() };
    assert_eq!(scene.render(&pose, &noisy).samples(), scene.render(&pose, &noisy).samples());
    let deviation = |image: &GrayImage| {
        let squares: f64 = (image.samples().iter().zip(plain.samples()))
            .map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2))
            .sum();
        (squares / image.samples().len() as f64).sqrt()
    };
    assert!((deviation(&scene.render(&pose, &noisy)) - 3.0).abs() < 0.1);
    let blurred = scene.render(&pose, &BoardEffects { blur_px: 1.5, ..Default::default() });
    let mean = |image: &GrayImage| image.samples().iter().map(|s| f64::from(*s)).sum::<f64>();
    assert!((mean(&blurred) / mean(&plain) - 1.0).abs() < 0.01 && deviation(&blurred) > 5.0);
    let occlusion = Some(Occlusion { from: (0.25, 0.25), to: (0.5, 0.5) });
    let hidden = scene.render(&pose, &BoardEffects { occlusion, ..Default::default() });
    assert!(hidden.row(90)[80..160].iter().all(|sample| *sample == 105));
}
