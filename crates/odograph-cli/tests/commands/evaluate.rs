//! Black-box tests of `odograph evaluate`.

use serde_json::Value;
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn odograph(arguments: &[&str], folder: &Path) -> Output {
    Command::new(env!("CARGO_BIN_EXE_odograph"))
        .arg("evaluate")
        .args(arguments)
        .current_dir(folder)
        .output()
        .unwrap()
}

/// A camera that looks down from 1 m and drives 10 m along x, multiplied by the scale error
/// `scale`.
fn tum(scale: f64) -> String {
    let lines = (0..=100).map(|i| {
        format!(
            "{:.2} {:.6} 0 1 0.7071067811865476 -0.7071067811865476 0 0\n",
            0.1 * f64::from(i),
            0.1 * f64::from(i) * scale
        )
    });
    lines.collect()
}

fn folder() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("truth.tum"), tum(1.0)).unwrap();
    fs::write(folder.path().join("estimate.tum"), tum(1.02)).unwrap();
    let path = folder.path().to_owned();
    (folder, path)
}

fn stdout(output: &Output) -> String {
    String::from_utf8(output.stdout.clone()).unwrap()
}

#[test]
fn a_table_with_units_is_printed() {
    let (_keep, folder) = folder();
    let output = odograph(&["estimate.tum", "truth.tum"], &folder);
    let table = stdout(&output);
    assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
    for part in [
        "101 compared",
        "10.000 m true, 10.200 m estimated, ups and downs included",
        "10.000 m true, 10.200 m estimated over the ground",
        "absolute position (m)",
        "position over 1 m (m)",
        "position %",
        "°/m",
    ] {
        assert!(table.contains(part), "{part:?} is not in\n{table}");
    }
    assert_eq!(stdout(&odograph(&["estimate.tum", "truth.tum"], &folder)), table);
}

#[test]
fn json_contains_the_results() {
    let (_keep, folder) = folder();
    let output = odograph(
        &["estimate.tum", "truth.tum", "--align", "none", "--json", "--delta", "2m,5f", "--segments", "2"],
        &folder,
    );
    let figures: Value = serde_json::from_slice(&output.stdout).unwrap();
    let near = |pointer: &str, expected: f64| {
        let value =
            figures.pointer(pointer).unwrap_or_else(|| panic!("{pointer} is missing")).as_f64().unwrap();
        assert!((value - expected).abs() < 1e-9, "{pointer} is {value}, not {expected}");
    };
    near("/absolute/translation_m/max", 0.2);
    near("/absolute/translation_m/mean", 0.1);
    near("/absolute/rotation_rad/max", 0.0);
    near("/relative/1/translation_m/rmse", 0.01);
    near("/drift/0/translation_percent", 2.0);
    near("/scale", 1.0 / 1.02);
    near("/truth_length_m", 10.0);
    assert_eq!(figures["compared_poses"], 101);
    assert_eq!(figures["relative"][0]["delta_unit"], "m");
    let aligned = odograph(&["estimate.tum", "truth.tum", "--align", "sim3", "--json"], &folder);
    let figures: Value = serde_json::from_slice(&aligned.stdout).unwrap();
    assert!(figures["absolute"]["translation_m"]["max"].as_f64().unwrap() < 1e-9);
}

#[test]
fn kitti_files_are_recognised_by_their_columns() {
    let (_keep, folder) = folder();
    let kitti = |scale: f64, count: i32| -> String {
        (0..count).map(|i| format!("1 0 0 {} 0 1 0 0 0 0 1 0\n", 0.1 * f64::from(i) * scale)).collect()
    };
    fs::write(folder.join("a.txt"), kitti(1.02, 101)).unwrap();
    fs::write(folder.join("b.txt"), kitti(1.0, 101)).unwrap();
    fs::write(folder.join("short.txt"), kitti(1.0, 50)).unwrap();
    fs::write(
        folder.join("times.txt"),
        (0..101).map(|i| format!("{}\n", 0.1 * f64::from(i))).collect::<String>(),
    )
    .unwrap();
    let json = |arguments: &[&str]| -> Value {
        serde_json::from_slice(&odograph(arguments, &folder).stdout).unwrap()
    };
    let by_number = json(&["a.txt", "b.txt", "--json", "--align", "origin"]);
    let by_time = json(&["a.txt", "b.txt", "--json", "--align", "origin", "--times", "times.txt"]);
    assert_eq!(by_number["absolute"], by_time["absolute"]);
    assert!((by_number["absolute"]["translation_m"]["max"].as_f64().unwrap() - 0.2).abs() < 1e-9);
    let output = odograph(&["short.txt", "b.txt"], &folder);
    assert_eq!(output.status.code(), Some(3));
    assert!(String::from_utf8_lossy(&output.stderr).contains("50 poses"));
}

#[test]
fn a_file_without_times_is_compared_by_number_with_one_that_has_them() {
    let (_keep, folder) = folder();
    // The camera of `tum`, without its times.
    let kitti = |i: i32| format!("0 -1 0 {} -1 0 0 0 0 0 -1 1\n", 0.1 * f64::from(i) * 1.02);
    fs::write(folder.join("estimate.kitti"), (0..=100).map(kitti).collect::<String>()).unwrap();
    fs::write(folder.join("short.kitti"), (0..50).map(kitti).collect::<String>()).unwrap();
    let errors = |estimate: &str, truth: &str| -> Value {
        let output = odograph(&[estimate, truth, "--json", "--align", "none"], &folder);
        serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"))
    };
    for (estimate, truth) in [("estimate.kitti", "truth.tum"), ("truth.tum", "estimate.kitti")] {
        let figures = errors(estimate, truth);
        assert_eq!(figures["compared_poses"], 101);
        let most_m = figures["absolute"]["translation_m"]["max"].as_f64().unwrap();
        assert!((most_m - 0.2).abs() < 1e-6, "{most_m}");
    }
    let output = odograph(&["short.kitti", "truth.tum"], &folder);
    assert_eq!(output.status.code(), Some(3), "{output:?}");
}

#[test]
fn a_plot_is_written_and_not_overwritten() {
    let (_keep, folder) = folder();
    let draw = |extra: &[&str]| {
        let arguments = [&["estimate.tum", "truth.tum", "--quiet", "--plot", "errors.svg"], extra].concat();
        odograph(&arguments, &folder)
    };
    let output = draw(&[]);
    assert!(output.status.success() && output.stdout.is_empty() && output.stderr.is_empty(), "{output:?}");
    let svg = fs::read_to_string(folder.join("errors.svg")).unwrap();
    assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n"));
    for part in [
        "x (m)",
        "y (m)",
        "position error (m)",
        "rotation error (°)",
        "truth",
        "estimate.tum against truth.tum",
    ] {
        assert!(svg.contains(part), "{part:?} is not in the plot");
    }
    assert!(!svg.contains("NaN") && !svg.contains("inf"));
    let again = draw(&[]);
    assert_eq!(again.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&again.stderr).contains("--force"));
    assert!(draw(&["--force"]).status.success());
    assert_eq!(fs::read_to_string(folder.join("errors.svg")).unwrap(), svg);
}

#[test]
fn incomparable_trajectories_are_refused_in_one_sentence() {
    let (_keep, folder) = folder();
    let mut later = String::new();
    for line in tum(1.0).lines() {
        let _ = writeln!(later, "9{line}");
    }
    for (name, content) in [
        ("empty.tum", &b""[..]),
        ("words.tum", b"this is no trajectory at all, is it\n"),
        ("binary.tum", b"\xff\xfe\x00\x01"),
        ("nan.tum", b"0 1 2 3 0 0 0 1\n1 1 nan 3 0 0 0 1\n"),
        ("back.tum", b"1 1 2 3 0 0 0 1\n0 1 2 3 0 0 0 1\n"),
        ("still.tum", b"0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n"),
        ("one.tum", b"1 1 2 3 0 0 0 1\n"),
        ("later.tum", later.as_bytes()),
    ] {
        fs::write(folder.join(name), content).unwrap();
    }
    fs::create_dir(folder.join("folder")).unwrap();
    for (arguments, code, part) in [
        (&["missing.tum", "truth.tum"][..], 3, "missing.tum cannot be read"),
        (&["folder", "truth.tum"], 3, "folder cannot be read"),
        (&["empty.tum", "truth.tum"], 3, "empty.tum: there is no pose"),
        (&["words.tum", "truth.tum"], 3, "words.tum: line 1"),
        (&["binary.tum", "truth.tum"], 3, "binary.tum is not a text file"),
        (&["truth.tum", "nan.tum"], 3, "nan.tum: line 2: \"nan\""),
        (&["back.tum", "truth.tum"], 3, "back.tum: line 2: the time 0 s"),
        (&["later.tum", "truth.tum"], 3, "no pose of the estimate"),
        (&["one.tum", "truth.tum"], 3, "only one pose of one.tum and truth.tum can be compared"),
        (&["truth.tum", "one.tum", "--align", "origin"], 3, "alignment origin leaves it no error"),
        (&["still.tum", "truth.tum", "--align", "sim3"], 3, "do not determine a scale"),
        (&["estimate.tum", "truth.tum", "--delta", "0m"], 2, "not a stretch"),
        (&["estimate.tum", "truth.tum", "--delta", "3"], 2, "not a stretch"),
        (&["estimate.tum", "truth.tum", "--segments", "-1"], 2, "-1"),
        (&["estimate.tum", "truth.tum", "--max-time-difference", "nan"], 2, "largest time difference"),
        (&["estimate.tum", "truth.tum", "--align", "best"], 2, "best"),
        (&["estimate.tum", "truth.tum", "--plot", "plot.bmp"], 2, "plot.bmp is not"),
        (&["estimate.tum", "truth.tum", "--plot", "truth.tum/plot.svg"], 3, "there is a file of this name"),
        (&["estimate.tum", "truth.tum", "--format", "kitti"], 3, "has 8 values, not 12"),
        (&["estimate.tum"], 2, "TRUTH"),
    ] {
        let output = odograph(arguments, &folder);
        let message = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(code), "{arguments:?}: {message}");
        assert!(message.contains(part), "{part:?} is not in: {message}");
        assert!(output.stdout.is_empty(), "{arguments:?} printed a result");
        assert!(code != 3 || message.lines().count() == 1, "{message}");
    }
}

#[test]
fn extreme_numbers_give_no_nan() {
    let (_keep, folder) = folder();
    let ends = |far: &str| {
        format!(
            "-1{far} 0 0 1 0 0 0 1\n0 1 0 1 0 0 0 1\n1 2 0 1 0 0 0 1\n2 3 1 1 0 0 0 1\n1{far} 9 0 1 0 0 0 1\n"
        )
    };
    fs::write(folder.join("long.tum"), ends("e308")).unwrap();
    let output = odograph(&["long.tum", "long.tum"], &folder);
    let table = stdout(&output);
    assert!(!table.contains("NaN") && table.contains("over 100.0 % of its time"), "{table} {output:?}");
    let far = "0 1e200 0 1 0 0 0 1\n1 -1e200 5e199 1 0 0 0 1\n2 3e200 0 1 0 0 0 1\n3 0 0 1 0 0 0 1\n";
    fs::write(folder.join("far.tum"), far).unwrap();
    let output = odograph(&["far.tum", "far.tum"], &folder);
    assert!(!stdout(&output).contains("NaN"), "{output:?}");
}

#[test]
fn control_characters_of_a_file_name_are_escaped() {
    let (_keep, folder) = folder();
    let name = "evil\u{1b}[2J.tum";
    fs::write(folder.join(name), tum(1.0)).unwrap();
    let output = odograph(&[name, "truth.tum"], &folder);
    let table = stdout(&output);
    assert!(output.status.success() && !table.contains('\u{1b}'), "{table:?}");
}

#[test]
fn a_single_pose_has_a_path_of_zero() {
    let (_keep, folder) = folder();
    fs::write(folder.join("one.tum"), "1 0 0 1 0 0 0 1\n").unwrap();
    let table = stdout(&odograph(&["one.tum", "one.tum", "--align", "none"], &folder));
    assert!(table.contains("0.000 m estimated over the ground") && !table.contains("-0.000"), "{table}");
}

#[test]
fn both_lengths_are_of_the_compared_poses_before_scaling() {
    let (_keep, folder) = folder();
    let all = tum(1.02);
    let half: Vec<&str> = all.lines().take(51).collect();
    fs::write(folder.join("half.tum"), half.join("\n")).unwrap();
    let table = stdout(&odograph(&["half.tum", "truth.tum", "--align", "sim3"], &folder));
    for line in [
        "5.000 m true, 5.100 m estimated, ups and downs included",
        "5.000 m true, 5.100 m estimated over the ground",
    ] {
        assert!(table.contains(line), "{line:?} is not in\n{table}");
    }
}
