use super::*;
use odograph::camera::{Camera, Distortion};
use odograph::geometry::Pixel;
use odograph::image::GrayImage;
use odograph_calibration::selection::{Direction, Guidance, Hint, Region, ViewCoverage};
use odograph_calibration::{LensModel, ModelComparison, Parameter, Verdict};

fn camera() -> Camera {
    let distortion = Distortion::from_opencv(&[-0.28, 0.07, 0.0002, -0.0003]).unwrap();
    Camera::new((640, 480), (532.0, 533.0), (342.0, 233.0), distortion).unwrap()
}

/// Deterministic pseudo-random numbers in [-1, 1).
fn random(state: &mut u32) -> f64 {
    *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
    f64::from(*state >> 8) / f64::from(1 << 23) - 1.0
}

fn views(count: usize, thumbnail: &Thumbnail) -> Vec<ShownView<'_>> {
    let mut state = 7;
    (0..count)
        .map(|n| {
            let (left, top) = (20.0 + 37.0 * (n * 5 % 9) as f64, 15.0 + 40.0 * (n * 3 % 5) as f64);
            let residuals = (0..54)
                .map(|k| {
                    let seen = Pixel::new(left + 28.0 * (k % 9) as f64, top + 26.0 * (k / 9) as f64);
                    let pull = 0.0006 * (seen.x - 320.0);
                    ReprojectionError {
                        seen,
                        dx_px: 0.2 * random(&mut state) + pull,
                        dy_px: 0.2 * random(&mut state),
                    }
                })
                .collect();
            ShownView {
                name: format!("left{n:02}.jpg"),
                thumbnail: Some(thumbnail),
                residuals,
                rms_px: if n == 4 { 3.7 } else { 0.15 + 0.01 * (n % 7) as f64 },
                why_not: (n == 4).then(|| "its corners are 3.7 px off, the others' 0.2 px".to_owned()),
            }
        })
        .collect()
}

fn with_report<T>(verdict: Verdict, use_it: impl FnOnce(&CalibrationReport<'_>) -> T) -> T {
    let camera = camera();
    let parameter = |name, value, deviation| Parameter { name, value, deviation };
    let parameters = [
        parameter("fx", 532.826, 0.61),
        parameter("fy", 532.954, 0.58),
        parameter("cx", 342.487, 0.84),
        parameter("cy", 233.855, 0.79),
        parameter("k1", -0.28088, 0.0041),
        parameter("k2", 0.0252, 0.0107),
        parameter("p1", 0.00122, 0.00014),
        parameter("p2", -0.00014, 0.00016),
    ];
    let candidate = |model, hold_out_rms_px, rms_px| ModelComparison {
        model,
        hold_out_rms_px,
        rms_px,
        expected_error_px: 0.1,
        with_misfit_px: 0.12,
    };
    let candidates = [
        candidate(LensModel::Pinhole, 2.31, 2.2),
        candidate(LensModel::BrownConrady4, 0.217, 0.196),
        candidate(LensModel::BrownConrady5, 0.221, 0.195),
        candidate(LensModel::DoubleSphere, f64::INFINITY, f64::NAN),
    ];
    let picture: Vec<u8> =
        (0..640 * 480).map(|at| if at % 640 / 40 % 2 == at / 25_600 % 2 { 40 } else { 220 }).collect();
    let thumbnail = Thumbnail::new(&GrayImage::from_samples(640, 480, picture).unwrap()).unwrap();
    let views = views(13, &thumbnail);
    let mut points = vec![0; ViewCoverage::CELLS];
    for residual in views.iter().flat_map(|view| &view.residuals) {
        let cell = (residual.seen.y / 80.0) as usize * 9 + (residual.seen.x / 71.2) as usize;
        points[cell] += 1;
    }
    let guidance = Guidance {
        views: 13,
        coverage: ViewCoverage { points },
        missing: vec![Hint::Tilt(Direction::Sideways), Hint::GoTo(Region { column: 2, row: 2 })],
    };
    let expected_error = ExpectedError::new((640, 480), |pixel| {
        let r = pixel.distance(Pixel::new(300.0, 230.0)) / 300.0;
        (r < 1.32).then_some(0.03 + 0.2 * r.powi(4))
    });
    let reasons = ["the board was never in the bottom right of the image".to_owned()];
    let found = BoardDetections {
        looked_at: 14,
        with_board: 13,
        reasons: vec![("no chessboard corners".into(), 1)],
        pictures_without: vec![("left<10>.jpg".into(), "no chessboard corners".into())],
    };
    use_it(&CalibrationReport {
        title: "left <pictures>",
        source: "pictures (JPG), 640x480",
        board: "chessboard:9x6:25mm".into(),
        pictures: true,
        found: &found,
        camera: &camera,
        model: LensModel::BrownConrady4,
        focal_px: (532.826, 0.61),
        parameters: &parameters,
        rms_px: 0.196,
        hold_out_rms_px: 0.217,
        candidates: &candidates,
        verdict,
        reasons: &reasons,
        views: &views,
        expected_error_px: 0.1,
        expected_error: &expected_error,
        bent_board: Some(BentBoard { file: "bent-board.yaml", rms_px: 0.15, expected_error_px: 0.08 }),
        guidance: &guidance,
        warnings: &[],
        camera_file: "camera.yaml",
    })
}

/// If `ODOGRAPH_REPORT_OUT` names a folder, all files are written there for inspection.
#[test]
fn the_report_is_self_contained_and_deterministic() {
    for (name, verdict) in
        [("good", Verdict::Good), ("usable", Verdict::Usable), ("again", Verdict::DoItAgain)]
    {
        let files = with_report(verdict, |report| report.files().unwrap());
        let names: Vec<&str> = files.iter().map(|(name, _)| *name).collect();
        assert_eq!(
            names,
            [
                "report.html",
                "expected-error.png",
                "residuals.png",
                "coverage.png",
                "distortion.png",
                "views.png"
            ]
        );
        let html = String::from_utf8(files[0].1.clone()).unwrap();
        assert!(html.contains("left &lt;pictures&gt;") && html.contains("left&lt;10&gt;.jpg"));
        assert!(!html.contains("NaN") && !html.contains("http"), "the page refers to nothing outside");
        // Each view with its error, the one that was left out too; the figure of the camera file.
        assert_eq!(html.matches("<figure class=\"view").count(), 13);
        assert!(
            html.contains("left04.jpg<span>left out, 3.7 px")
                && html.contains("left00.jpg<span>used, 0.15 px")
        );
        assert!(html.contains("<em>Expected error of a ray</em><b>0.10 px</b>"));
        assert!(html.contains("href=\"bent-board.yaml\""));
        assert!(html.len() < 400_000, "{} bytes", html.len());
        assert!(files[1..].iter().all(|(_, bytes)| bytes.starts_with(b"\x89PNG")));
        if let Some(folder) = std::env::var_os("ODOGRAPH_REPORT_OUT") {
            let folder = std::path::Path::new(&folder).join(name);
            std::fs::create_dir_all(&folder).unwrap();
            files
                .iter()
                .for_each(|(name, bytes)| odograph_session::files::write(&folder.join(name), bytes).unwrap());
        }
        if verdict == Verdict::Good {
            assert_eq!(files, with_report(verdict, |report| report.files().unwrap()));
        }
    }
}

#[test]
fn drawings_tolerate_non_finite_numbers() {
    let nowhere = ReprojectionError {
        seen: Pixel::new(f64::NAN, f64::INFINITY),
        dx_px: f64::NAN,
        dy_px: f64::INFINITY,
    };
    let views = [
        ShownView {
            name: String::new(),
            thumbnail: None,
            residuals: vec![nowhere; 20],
            rms_px: f64::NAN,
            why_not: None,
        },
        ShownView {
            name: "x".into(),
            thumbnail: None,
            residuals: vec![],
            rms_px: f64::INFINITY,
            why_not: Some("?".into()),
        },
    ];
    let nothing = ExpectedError::new((64, 48), |_| Some(f64::NAN));
    assert_eq!(nothing.worst_px(), None);
    let coverage = ViewCoverage { points: vec![0; ViewCoverage::CELLS] };
    for drawing in [
        super::views::errors(&views, f64::NAN),
        super::views::residuals((64, 48), &views).0,
        super::views::coverage((64, 48), &views, &coverage),
        nothing.drawing(),
    ] {
        let svg = drawing.file("<&>", "\u{1}");
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        assert!(!svg.contains("var("), "a picture of its own has its own colours");
        crate::drawing_png(&svg, 200).unwrap();
    }
}

#[test]
fn cells_without_a_ray_have_a_key() {
    let everywhere = ExpectedError::new((640, 480), |_| Some(0.1));
    assert_eq!(everywhere.key(), "");
    let not_left = ExpectedError::new((640, 480), |pixel| (pixel.x > 40.0).then_some(0.1));
    assert_eq!(not_left.key(), " Gray: there the lens model has no ray.");
    let corner = |pixel: Pixel| if pixel.x + pixel.y < 30.0 { 10.0 } else { 0.1 };
    let steep = ExpectedError::new((640, 480), |pixel| Some(corner(pixel)));
    assert_eq!(steep.key(), " Yellow is 0.20 px and more; the worst is 10 px.");
}

#[test]
fn errors_are_formatted_with_two_digits() {
    for (pixels, text) in [
        (0.00234, "0.0023 px"),
        (0.0346, "0.035 px"),
        (0.2, "0.20 px"),
        (1.26, "1.3 px"),
        (46.2, "46 px"),
        (f64::NAN, "?"),
    ] {
        assert_eq!(pixels_text(pixels), text);
    }
}
