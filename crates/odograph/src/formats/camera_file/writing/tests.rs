use super::super::{parse, write};
use super::*;
use crate::formats::decimal::decimal;
use crate::geometry::Ray;

fn camera(distortion: Distortion) -> Camera {
    Camera::new((640, 480), (500.25, 501.5), (318.7, 241.3), distortion).unwrap()
}

fn brown(coefficients: &[f64]) -> Distortion {
    Distortion::from_opencv(coefficients).unwrap()
}

const FISHEYE: Distortion = Distortion::KannalaBrandt { k1: 0.1, k2: -0.02, k3: 3e-6, k4: 0.004 };

/// Every lens model with the formats that can represent it.
fn lenses() -> Vec<(Distortion, Vec<CameraFormat>)> {
    use CameraFormat::{Colmap, Kalibr, OpenCv, Ros};
    vec![
        (Distortion::None, vec![OpenCv, Ros, Kalibr, Colmap]),
        (brown(&[-0.28, 0.07, 2e-4, -3e-5]), vec![OpenCv, Ros, Kalibr, Colmap]),
        (brown(&[-0.28, 0.07, 2e-4, -3e-5, 0.16]), vec![OpenCv, Ros, Colmap]),
        (brown(&[0.4, 0.1, 1e-7, 0.0, 0.01, 0.7, 0.2, 0.02]), vec![OpenCv, Ros, Colmap]),
        (Distortion::DoubleSphere { xi: -0.18, alpha: 0.59 }, vec![Kalibr]),
        (FISHEYE, vec![OpenCv, Ros, Kalibr, Colmap]),
    ]
}

/// Asserts equality, except that a pinhole may be a lens with zero coefficients.
fn same(a: &Camera, b: &Camera) {
    assert_eq!((a.width(), a.height(), a.focal_px()), (b.width(), b.height(), b.focal_px()));
    let (p, q) = (a.principal_px(), b.principal_px());
    // Adding and subtracting half a pixel rounds the last digit.
    assert!((p.0 - q.0).abs() < 1e-12 && (p.1 - q.1).abs() < 1e-12, "{p:?} {q:?}");
    let none = |camera: &Camera| camera.distortion().coefficients().iter().all(|&k| k == 0.0);
    assert!(a.distortion() == b.distortion() || (none(a) && none(b)), "{a:?} {b:?}");
}

#[test]
fn every_camera_round_trips_through_every_pair_of_formats() {
    for (lens, formats) in lenses() {
        let camera = camera(lens);
        for &first in &formats {
            for &second in &formats {
                let once = parse(&write_as(&camera, first).unwrap(), None).unwrap();
                let twice = parse(&write_as(&once, second).unwrap(), None).unwrap();
                same(&camera, &twice);
            }
        }
    }
}

#[test]
fn unsupported_lens_models_are_rejected_by_name() {
    for (lens, formats) in lenses() {
        for (_, format) in CameraFormat::NAMED {
            let written = write_as(&camera(lens), format);
            assert_eq!(written.is_ok(), formats.contains(&format), "{lens:?} {format}");
        }
    }
    let sphere = camera(Distortion::DoubleSphere { xi: -0.18, alpha: 0.59 });
    assert!(write_as(&sphere, CameraFormat::Ros).unwrap_err().to_string().contains("no double-sphere lens"));
    // Our own format is OpenCV's with an additional lens model.
    assert_eq!(parse(&write(&sphere), None).unwrap(), sphere);
    let kalibr = write_as(&sphere, CameraFormat::Kalibr).unwrap();
    for (from, to, part) in [
        ("-0.18, ", "", "has 5 numbers; a double sphere's are"),
        ("camera_model: ds", "camera_model: pinhole", "only the camera model `ds`"),
    ] {
        assert!(kalibr.contains(from));
        let error = parse(&kalibr.replace(from, to), None).unwrap_err().to_string();
        assert!(error.contains(part), "{error}");
    }
    let error = write_as(&camera(brown(&[0.1, 0.0, 0.0, 0.0, 0.25])), CameraFormat::Kalibr).unwrap_err();
    assert!(error.to_string().contains("the camera's k3 is 0.25"), "{error}");
    let error = write_as(&camera(brown(&[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0])), CameraFormat::Kalibr);
    assert!(error.unwrap_err().to_string().contains("the camera's k5 is 0.5"));
}

#[test]
fn colmaps_principal_point_is_half_a_pixel_larger() {
    let text = write_as(&camera(Distortion::None), CameraFormat::Colmap).unwrap();
    let line = text.lines().last().unwrap();
    assert_eq!(line, "1 PINHOLE 640 480 500.25 501.5 319.2 241.8");
    assert_eq!(parse(line, None).unwrap().principal_px(), (318.7, 241.3));
    // The principal point is the same image point in both conventions: COLMAP's (0.5, 0.5) is our
    // (0, 0).
    let ours = camera(Distortion::None).pixel_from_ray(Ray::new(0.0, 0.0)).unwrap();
    assert_eq!((ours.x + 0.5, ours.y + 0.5), (319.2, 241.8));
}

/// Evaluates the formulas of COLMAP (`sensor/models.h`) and Kalibr (`RadialTangentialDistortion`)
/// in their own notation: the written coefficients must have the same meaning there, including the
/// signs of the tangential terms.
#[test]
fn written_coefficients_agree_with_the_formulas_of_colmap_and_kalibr() {
    let lens = brown(&[-0.28, 0.07, 2e-3, -3e-3]);
    let ray = Ray::new(0.31, -0.22);
    let ours = camera(lens).pixel_from_ray(ray).unwrap();
    let after = |text: &str, key: &str| -> Vec<f64> {
        let line = text.lines().find(|line| line.contains(key)).unwrap();
        let list = line.split_once(key).unwrap().1;
        list.trim_matches([':', ' ', '[', ']'])
            .split([',', ' '])
            .filter_map(|word| word.parse().ok())
            .collect()
    };
    let colmap = after(&write_as(&camera(lens), CameraFormat::Colmap).unwrap(), "OPENCV 640 480");
    let kalibr_text = write_as(&camera(lens), CameraFormat::Kalibr).unwrap();
    let mut kalibr = after(&kalibr_text, "intrinsics");
    kalibr.extend(after(&kalibr_text, "distortion_coeffs"));
    for (program, half_px) in [(colmap, 0.5), (kalibr, 0.0)] {
        let [fx, fy, cx, cy, k1, k2, p1, p2] = program[..] else { panic!("{program:?}") };
        let (u, v) = (ray.x, ray.y);
        let (u2, uv, v2) = (u * u, u * v, v * v);
        let r2 = u2 + v2;
        let radial = k1 * r2 + k2 * r2 * r2;
        let du = u * radial + 2.0 * p1 * uv + p2 * (r2 + 2.0 * u2);
        let dv = v * radial + 2.0 * p2 * uv + p1 * (r2 + 2.0 * v2);
        let (x, y) = (fx * (u + du) + cx, fy * (v + dv) + cy);
        assert!((x - half_px - ours.x).abs() < 1e-9 && (y - half_px - ours.y).abs() < 1e-9);
    }
}

#[test]
fn exponents_are_written_for_yaml_1_1_readers() {
    for (value, text) in [(1e-5, "1.0e-5"), (1.5e-7, "1.5e-7"), (-2e16, "-2.0e+16"), (3.0, "3.0")] {
        assert_eq!(decimal(value), text);
        assert_eq!(text.parse::<f64>().unwrap(), value);
    }
    let camera = camera(FISHEYE);
    assert_eq!(write_as(&camera, CameraFormat::OpenCv).unwrap(), write(&camera));
}

#[test]
fn formats_are_inferred_from_unambiguous_file_names() {
    use CameraFormat::{Colmap, Kalibr, OpenCv, Ros};
    for (name, format) in [
        ("cameras.txt", Some(Colmap)),
        ("robot-camchain.yaml", Some(Kalibr)),
        ("camchain.yaml", Some(Kalibr)),
        ("camera_info.yaml", Some(Ros)),
        ("left_ros.yaml", Some(Ros)),
        ("intrinsics.yml", Some(OpenCv)),
        ("opencv.yaml", Some(OpenCv)),
        ("camera.yaml", None),
        ("across.yaml", None),
    ] {
        assert_eq!(CameraFormat::of_file_name(name), format, "{name}");
    }
    for (name, format) in CameraFormat::NAMED {
        assert_eq!(name.parse::<CameraFormat>().unwrap(), format);
        assert_eq!(format.to_string(), name);
    }
    assert!("nerf".parse::<CameraFormat>().is_err());
}
