//! Black-box tests of profiles.

use std::fs;
use std::path::Path;
use std::process::Command;

/// Exit code, standard output and standard error of the program in a folder, with the configuration
/// below it.
fn odograph(folder: &Path, arguments: &[&str]) -> (i32, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_odograph"))
        .args(arguments)
        .current_dir(folder)
        .env("XDG_CONFIG_HOME", folder.join("config"))
        .output()
        .unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
}

fn with_recording() -> tempfile::TempDir {
    let place = tempfile::tempdir().unwrap();
    let simulate = ["simulate", "-o", "sim", "--format", "y4m", "--size", "160x120", "--duration", "0.4"];
    assert_eq!(odograph(place.path(), &simulate).0, 0);
    place
}

#[test]
fn a_profile_stands_for_camera_and_mount_in_any_folder() {
    let place = with_recording();
    let folder = place.path();
    assert!(odograph(folder, &["profile", "list"]).2.contains("there are no profiles"));
    let save = ["profile", "save", "cart", "--camera", "sim/camera.yaml", "--rig", "sim/rig.toml"];
    assert_eq!(odograph(folder, &save).0, 0);
    let kept = fs::read_to_string(folder.join("config/odograph/profiles/cart.toml")).unwrap();
    let camera = folder.join("sim/camera.yaml");
    assert!(kept.contains(&format!("camera = \"{}\"", camera.display())), "{kept}");
    assert!(odograph(folder, &["profile", "list"]).1.starts_with("cart  camera /"));
    assert!(odograph(folder, &["profile", "show", "cart"]).1.contains(&kept));

    let elsewhere = folder.join("elsewhere");
    fs::create_dir(&elsewhere).unwrap();
    let config = folder.join("config");
    let with_profile = |arguments: &[&str]| {
        Command::new(env!("CARGO_BIN_EXE_odograph"))
            .args(arguments)
            .current_dir(&elsewhere)
            .env("XDG_CONFIG_HOME", &config)
            .output()
            .unwrap()
    };
    for arguments in [
        vec!["run", "../sim/sim.y4m", "--profile", "cart", "-o", "profiled"],
        vec![
            "run",
            "../sim/sim.y4m",
            "--camera",
            "../sim/camera.yaml",
            "--rig",
            "../sim/rig.toml",
            "-o",
            "typed",
        ],
        vec!["live", "../sim/sim.y4m", "--profile", "cart", "-o", "live"],
        vec!["localize", "../sim/sim.y4m", "--map", "typed/map.gpkg", "--profile", "cart"],
        vec!["info", "../sim/sim.y4m", "--profile", "cart"],
        vec!["doctor", "../sim/sim.y4m", "--profile", "cart"],
    ] {
        let output = with_profile(&arguments);
        assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    }
    let path = |run: &str| fs::read(elsewhere.join(run).join("trajectory.tum")).unwrap();
    assert_eq!(path("profiled"), path("typed"));
    // What is typed goes before the profile: twice the height, twice the path.
    let higher = ["run", "../sim/sim.y4m", "--profile", "cart", "--height", "180cm", "-o", "higher"];
    assert!(with_profile(&higher).status.success());
    assert!(fs::read_to_string(elsewhere.join("higher/run.toml")).unwrap().contains("height_m = 1.8"));

    assert_eq!(odograph(folder, &["profile", "remove", "cart"]).0, 0);
    assert!(camera.exists());
    assert_eq!(odograph(folder, &["profile", "list"]).1, "");
}

#[test]
fn what_is_wrong_with_a_profile_is_one_sentence() {
    let place = with_recording();
    let folder = place.path();
    fs::write(folder.join("other.toml"), "camara = 1\n").unwrap();
    for (arguments, code, says) in [
        (&["profile", "save", "../cart", "--height", "1"][..], 2, "is no name of a profile"),
        (&["profile", "save", "cart"], 2, "nothing to save"),
        (&["profile", "save", "cart", "--camera", "nowhere.yaml"], 3, "nowhere.yaml cannot be read"),
        (&["profile", "save", "cart", "--camera", "sim/rig.toml"], 3, "sim/rig.toml"),
        (&["profile", "save", "cart", "--rig", "other.toml"], 3, "other.toml"),
        (&["profile", "save", "cart", "--height", "0"], 2, "the height is 0 m"),
        (&["profile", "show", "cart"], 3, "no profile named cart; there are none yet"),
        (&["profile", "remove", "cart"], 3, "no profile named cart"),
        (&["run", "sim/sim.y4m", "--profile", "cart"], 3, "no profile named cart"),
        (&["run", "sim/run.toml", "--profile", "cart"], 2, "leave --profile away"),
    ] {
        let (got, _, message) = odograph(folder, arguments);
        assert_eq!(got, code, "{arguments:?}: {message}");
        assert!(message.contains(says) && message.lines().count() == 1, "{arguments:?}: {message}");
    }
    let save = ["profile", "save", "cart", "--camera", "sim/camera.yaml", "--height", "90cm"];
    assert_eq!(odograph(folder, &save).0, 0);
    assert!(odograph(folder, &save).2.contains("already there; --force replaces it"));
    assert_eq!(odograph(folder, &[&save[..], &["--force"]].concat()).0, 0);
    assert!(odograph(folder, &["info", "sim/sim.y4m", "--profile", "cat"]).2.contains("profiles are: cart"));
    fs::remove_file(folder.join("sim/camera.yaml")).unwrap();
    let (code, _, message) = odograph(folder, &["run", "sim/sim.y4m", "--profile", "cart"]);
    assert!(code == 3 && message.contains("is no longer there; save the profile again"), "{message}");
    fs::write(folder.join("config/odograph/profiles/cart.toml"), "camara = 1\n").unwrap();
    let (code, _, message) = odograph(folder, &["run", "sim/sim.y4m", "--profile", "cart"]);
    assert!(code == 3 && message.contains("cart.toml is not a profile"), "{message}");
    assert_eq!(odograph(folder, &["profile", "list"]).1, "cart  damaged\n");
}
