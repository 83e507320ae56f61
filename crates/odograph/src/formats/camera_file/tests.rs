use super::*;
use proptest::prelude::*;
use std::path::Path;

const OPENCV: &str = "%YAML:1.0
---
calibration_time: \"today\"
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.3591573396163199e+02, 0., 3.4228315473308373e+02, 0.,
       5.3491573396163199e+02, 2.3557082909788173e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.6637260909660682e-01, -3.8588898922304653e-02,
       1.7831947042852964e-03, -2.8122100441115472e-04, 2.3839153080878486e-01 ]
";

fn camera(distortion: Distortion) -> Camera {
    Camera::new((640, 480), (500.0, 501.0), (320.0, 240.0), distortion).unwrap()
}

#[test]
fn opencv_yaml_is_read() {
    let camera = parse(OPENCV, None).unwrap();
    assert_eq!((camera.width(), camera.height()), (640, 480));
    assert_eq!(camera.focal_px(), (535.915733961632, 534.915733961632));
    assert_eq!(camera.principal_px(), (342.28315473308373, 235.57082909788173));
    assert_eq!(camera.distortion().coefficients()[4], 0.23839153080878486);
}

#[test]
fn ros_kalibr_euroc_colmap_and_json_are_read() {
    let expected = camera(Distortion::from_opencv(&[0.1, -0.02, 0.001, 0.002]).unwrap());
    let ros = "image_width: 640\nimage_height: 480\ncamera_name: head\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [500, 0, 320, 0, 501, 240, 0, 0, 1]\n\
               distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 4\n  data: [0.1, -0.02, 0.001, 0.002]\n\
               rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n";
    let message = "height: 480\nwidth: 640\ndistortion_model: plumb_bob\nD: [0.1, -0.02, 0.001, 0.002]\n\
                   K: [500.0, 0.0, 320.0, 0.0, 501.0, 240.0, 0.0, 0.0, 1.0]\n---\n";
    let kalibr = "cam0:\n  camera_model: pinhole\n  intrinsics: [500, 501, 320, 240]\n  distortion_model: radtan\n\
                  \x20 distortion_coeffs: [0.1, -0.02, 0.001, 0.002]\n  resolution: [640, 480]\n  rostopic: /cam0/image\n";
    let euroc = "%YAML:1.0\n# comment\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n\
                 resolution: [640, 480]\ncamera_model: pinhole\nintrinsics: [500, 501, 320, 240] #fu\n\
                 distortion_model: radial-tangential\ndistortion_coefficients: [0.1, -0.02, 0.001, 0.002]\n";
    let colmap = "# Camera list\n1 OPENCV 640 480 500 501 320.5 240.5 0.1 -0.02 0.001 0.002\n";
    let json = "{\"image_width\": 640, \"image_height\": 480, \"camera_matrix\": [[500, 0, 320], [0, 501, 240], [0, 0, 1]],\n\
                \"distortion_coefficients\": [[0.1, -0.02, 0.001, 0.002]]}";
    for text in [ros, message, kalibr, euroc, colmap, json] {
        assert_eq!(parse(text, None).unwrap_or_else(|error| panic!("{text}: {error}")), expected, "{text}");
    }
}

#[test]
fn colmap_principal_points_are_shifted_by_half_a_pixel() {
    for (line, distortion) in [
        ("7 SIMPLE_PINHOLE 640 480 500 320.5 240.5", Distortion::None),
        ("7 PINHOLE 640 480 500 501 320.5 240.5", Distortion::None),
        (
            "7 SIMPLE_RADIAL 640 480 500 320.5 240.5 0.1",
            Distortion::from_opencv(&[0.1, 0.0, 0.0, 0.0]).unwrap(),
        ),
        ("7 RADIAL 640 480 500 320.5 240.5 0.1 0.2", Distortion::from_opencv(&[0.1, 0.2, 0.0, 0.0]).unwrap()),
        (
            "7 FULL_OPENCV 640 480 500 501 320.5 240.5 1 2 3 4 5 6 7 8",
            Distortion::from_opencv(&[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]).unwrap(),
        ),
        (
            "7 OPENCV_FISHEYE 640 480 500 501 320.5 240.5 0.1 0.2 0.3 0.4",
            Distortion::KannalaBrandt { k1: 0.1, k2: 0.2, k3: 0.3, k4: 0.4 },
        ),
    ] {
        let camera = parse(line, None).unwrap();
        assert_eq!(camera.principal_px(), (320.0, 240.0), "{line}");
        assert_eq!(*camera.distortion(), distortion, "{line}");
    }
}

#[test]
fn fisheye_is_recognised_by_any_of_its_names() {
    let expected = camera(Distortion::KannalaBrandt { k1: 0.1, k2: 0.0, k3: 0.0, k4: 0.01 });
    let text = "imageSize: [640, 480]\nK: [500, 0, 320, 0, 501, 240, 0, 0, 1]\nD: [0.1, 0, 0, 0.01]\n";
    for name in [
        "distortion_model: equidistant",
        "camera_model: fisheye",
        "fisheye_model: 1",
        "distortion_model: FISHEYE",
    ] {
        assert_eq!(parse(&format!("{text}{name}\n"), None).unwrap(), expected, "{name}");
    }
}

#[test]
fn fallback_size_is_used_only_without_size_in_file() {
    let text = "K: [500, 0, 320, 0, 501, 240, 0, 0, 1]\nD: [0, 0, 0, 0]\n";
    let error = parse(text, None).unwrap_err().to_string();
    assert!(error.contains("add `image_width:` and `image_height:`"), "{error}");
    assert_eq!(parse(text, Some((640, 480))).unwrap().width(), 640);
    assert_eq!(parse(OPENCV, Some((1280, 960))).unwrap().width(), 640);
}

#[test]
fn errors_name_the_key_and_the_value() {
    let with = |from: &str, to: &str| {
        assert!(OPENCV.contains(from), "{from}");
        OPENCV.replacen(from, to, 1)
    };
    let fx = "5.3591573396163199e+02, 0.,";
    let many = |numbers: &str| {
        let head = OPENCV.split("distortion_coefficients").next().unwrap();
        format!("{head}distortion_coefficients: [{numbers}]\n")
    };
    let cases = [
        (String::new(), "empty"),
        ("just words".to_owned(), "instead of keys"),
        ("- 1\n- 2\n".to_owned(), "instead of keys"),
        ("<?xml version=\"1.0\"?><opencv_storage></opencv_storage>".to_owned(), "XML"),
        ("speed: 3\nname: x\n".to_owned(), "its keys are: speed, name"),
        (with(fx, ".nan, 0.,"), "camera_matrix.data[0] is NaN"),
        (with(fx, ".inf, 0.,"), "camera_matrix.data[0] is inf"),
        (with(fx, ".Nan, 0.,"), "camera_matrix.data[0] is "),
        (with(fx, "\"500\", 0.,"), "camera_matrix.data[0] is the text \"500\""),
        (with(fx, "~, 0.,"), "camera_matrix.data[0] is empty"),
        (with(fx, "-500., 0.,"), "fx is -500"),
        (with(fx, "0., 0.,"), "fx is 0"),
        (with(fx, "500., 0.25,"), "camera_matrix has a skew of 0.25"),
        (with("0., 0., 1. ]", "0., 0., 2. ]"), "not a camera matrix"),
        (with("0., 0., 1. ]", "0., 0. ]"), "camera_matrix says it has 3 x 3 numbers, but its data has 8"),
        (with("image_width: 640", "image_width: 0"), "image_width is 0"),
        (with("image_width: 640", "image_width: 640.5"), "image_width is 640.5"),
        (with("image_width: 640", "image_width: -640"), "image_width is -640"),
        (with("image_width: 640", "image_width: wide"), "image_width is the text \"wide\""),
        (with("image_width: 640\n", ""), "image_width is missing"),
        (
            with("image_width: 640", "image_width: 640\nimage_width: 641"),
            "the key `image_width` twice (line 5)",
        ),
        (with("3.4228315473308373e+02", "9.4e+09"), "principal point"),
        (
            with("---\n", "---\ndistortion_model: omnidirectional\n"),
            "distortion_model is \"omnidirectional\"",
        ),
        (
            with("---\n", "---\ndistortion_model: fisheye\n"),
            "distortion_coefficients has 5 numbers; the equidistant",
        ),
        (
            with("---\n", "---\nK: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n"),
            "camera_matrix and K hold different numbers",
        ),
        (many("1, 2, 3"), "distortion_coefficients has 3 numbers"),
        (many("0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.5"), "thin-prism"),
        (with("distortion_coefficients", "other_key"), "no `distortion_coefficients`"),
        (
            "cam0: {intrinsics: [1, 1, 1, 1]}\ncam1: {intrinsics: [1, 1, 1, 1]}\n".to_owned(),
            "2 cameras (cam0, cam1)",
        ),
        ("M1: [1]\nM2: [2]\n".to_owned(), "a pair of cameras"),
        ("1 PINHOLE 640 480 500 501 320 240\n2 PINHOLE 640 480 500 501 320 240\n".to_owned(), "2 cameras"),
        ("1 FOV 640 480 500 501 320 240 1\n".to_owned(), "COLMAP model FOV"),
        ("1 PINHOLE 640 480 500 501 320\n".to_owned(), "PINHOLE has 4 parameters, not 3"),
        ("1 PINHOLE 640 480 500 NaN 320 240\n".to_owned(), "\"NaN\""),
        ("1 PINHOLE 640 -480 500 501 320 240\n".to_owned(), "image size of 640x-480"),
        (format!("a: {}", "[".repeat(100_000)), "YAML"),
        ("a: &a [1, 1]\n".to_owned() + &"b: [*a, *a]\n".repeat(2), "the key `b` twice"),
        ("- ".repeat(100_000), "nested deeper than any calibration"),
        ("a: 1\n---\nb: 2\n".to_owned(), "several YAML documents"),
        ("1 2 3 4\n".to_owned(), "instead of keys"),
        ("a: &a [1]\n".to_owned() + &"b: {c: ".repeat(60), "YAML"),
    ];
    for (text, part) in cases {
        let error = parse(&text, None).unwrap_err().to_string();
        assert!(error.contains(part), "{part:?} is not in: {error}");
        assert!(!error.contains('\n') && error.len() < 500, "{error}");
    }
    let twelve = parse(&many("0.1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0"), None).unwrap();
    assert_eq!(twelve.distortion().coefficients(), [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
}

#[test]
fn the_covariance_of_a_calibration_is_read() {
    let with = |names: &str, covariance: &str| {
        let text = format!(
            "{OPENCV}{names}parameter_covariance: !!opencv-matrix\n   rows: 2\n   cols: 2\n   dt: d\n   data: {covariance}\n"
        );
        parse_uncertainty(&text).map_err(|error| error.to_string())
    };
    let names = "parameter_names:\n   - \"fx\"\n   - \"cx\"\n";
    assert!(with(names, "[ 0.25, 0., 0., 1. ]").unwrap().is_some());
    assert_eq!(parse_uncertainty(OPENCV).unwrap(), None);
    assert_eq!(parse_uncertainty("1 PINHOLE 640 480 500 501 320 240").unwrap(), None);
    assert!(with("", "[ 0.25, 0., 0., 1. ]").unwrap_err().contains("parameter_names is missing"));
    assert!(with("parameter_names: 3\n", "[ 1., 0., 0., 1. ]").unwrap_err().contains("not a list of names"));
    assert!(with("parameter_names: [fx]\n", "[ 1., 0., 0., 1. ]").unwrap_err().contains("1 x 1"));
    assert!(with(names, "[ -1., 0., 0., 1. ]").unwrap_err().contains("impossible"));
    assert!(with(names, "[ .nan, 0., 0., 1. ]").unwrap_err().contains("NaN"));
}

#[test]
fn real_files_are_read() {
    let folder = std::env::var_os("ODOGRAPH_DATA")
        .map_or_else(|| Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data"), Into::into);
    let Ok(text) = std::fs::read_to_string(folder.join("calib_opencv/left_intrinsics.yml")) else {
        println!("skipped: data: {} does not hold the recordings", folder.display());
        return;
    };
    let left = parse(&text, None).unwrap();
    assert_eq!((left.width(), left.height(), left.focal_px().0), (640, 480, 535.915733961632));
    let read = |name: &str| parse(&std::fs::read_to_string(folder.join(name)).unwrap(), None);
    assert!(
        read("calib_opencv/intrinsics.yml").unwrap_err().to_string().contains("pair of cameras (M1, M2)")
    );
    assert!(read("calib_opencv/stereo_calib.xml").unwrap_err().to_string().contains("XML"));
    let euroc = read("static_euroc_v101/sensor.yaml").unwrap();
    assert_eq!((euroc.width(), euroc.focal_px()), (752, (458.654, 457.296)));
}

prop_compose! {
    // Focal lengths are multiples of the image's longer side that `Camera::new` accepts.
    fn cameras()(width in 1usize..5000, height in 1usize..5000, fx in 2e-3..500.0f64, fy in 2e-3..500.0f64,
                 u in -0.5..1.5f64, v in -0.5..1.5f64, k in prop::array::uniform8(-1.0..1.0f64), kind in 0..4) -> Camera {
        let distortion = match kind {
            0 => Distortion::None,
            1 => Distortion::from_opencv(&k[..5]).unwrap(),
            2 => Distortion::from_opencv(&k).unwrap(),
            _ => Distortion::KannalaBrandt { k1: k[0], k2: k[1], k3: k[2] * 1e-7, k4: k[3] },
        };
        let longer = width.max(height) as f64;
        let principal_px = (u * width as f64, v * height as f64);
        Camera::new((width, height), (fx * longer, fy * longer), principal_px, distortion).unwrap()
    }
}

proptest! {
    #[test]
    fn a_written_camera_is_read_back_identically(camera in cameras()) {
        prop_assert_eq!(parse(&write(&camera), None).unwrap(), camera);
    }

    #[test]
    fn any_bytes_are_survived(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = parse(&String::from_utf8_lossy(&bytes), None);
    }

    #[test]
    fn a_damaged_file_is_survived(at in 0usize..700, with in prop::collection::vec(any::<u8>(), 0..6), cut in 0usize..20) {
        let mut bytes = OPENCV.as_bytes().to_vec();
        let at = at.min(bytes.len());
        let end = (at + cut).min(bytes.len());
        bytes.splice(at..end, with);
        let _ = parse(&String::from_utf8_lossy(&bytes), None);
    }

    #[test]
    fn yaml_like_text_is_survived(text in "[-a-k0-9:.&*!%{}\\[\\], \n\"'|>?#~<]*") {
        let _ = parse(&text, Some((640, 480)));
    }
}
