//! `run.toml` repeated, damaged, and beside other options.

use super::recording::y4m;
use super::run_folder::HostileFolder;
use std::fs;

#[test]
fn invalid_plans_are_refused() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(3)).unwrap();
    for (name, text) in [
        ("run.toml", "this is = = no plan"),
        ("empty.toml", ""),
        ("bytes.toml", "\0\0\0"),
        ("other.toml", "[package]\nname = \"odograph\"\n"),
    ] {
        fs::write(place.path(name), text).unwrap();
        place.refused(&format!("{name} -o out"), 3, name);
    }
    place.refused("none.toml -o out", 3, "none.toml cannot be read");
    assert!(place.run_usual("drive.y4m").status.success());
    let plan = String::from_utf8(place.result("out", "run.toml")).unwrap();
    fs::create_dir(place.path("plans")).unwrap();
    let mut number = 0;
    // Replaces each number of a plan in turn by invalid values.
    for (line_number, line) in plan.lines().enumerate() {
        let Some((key, value)) = line.split_once(" = ") else { continue };
        if value.parse::<f64>().is_err() {
            continue;
        }
        for wrong in ["nan", "-1", "0", "9000000000000000000"] {
            let changed: Vec<String> = plan
                .lines()
                .enumerate()
                .map(|(n, line)| if n == line_number { format!("{key} = {wrong}") } else { line.to_owned() })
                .collect();
            number += 1;
            let name = format!("plans/{number}.toml");
            fs::write(place.path(&name), changed.join("\n")).unwrap();
            let done = place.run(&format!("{name} -q -o again --force"));
            let message = String::from_utf8(done.stderr).unwrap();
            let what = format!("{key} = {wrong}");
            assert!(matches!(done.status.code(), Some(0 | 2 | 3 | 4)), "{what}: {:?} {message}", done.status);
            assert!(!message.contains("panicked") && message.lines().count() <= 1, "{what}: {message}");
        }
    }
    assert!(number > 30, "{number} plans tried");
}

#[test]
fn options_beside_a_plan_are_not_ignored() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    assert!(place.run_usual("drive.y4m").status.success());
    for more in [
        "--every 2",
        "--start 1",
        "--end 1",
        "--fps 5",
        "--max-frames 3",
        "--timestamps t",
        "--height 2",
        "--motion mean",
    ] {
        place.refused(&format!("out/run.toml -o again {more}"), 2, "already says");
    }
}

#[test]
fn a_plan_is_repeated_from_any_folder() {
    let place = HostileFolder::new();
    fs::write(place.path("drive.y4m"), y4m(6)).unwrap();
    assert!(place.run_usual("drive.y4m").status.success());
    let mut there = place.command("run.toml -o ../again");
    let done = there.current_dir(place.path("out")).output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    assert!(place.result("again", "trajectory.csv") == place.result("out", "trajectory.csv"));
    // Moved together with its recording, the plan can still be repeated.
    fs::create_dir(place.path("elsewhere")).unwrap();
    for name in ["drive.y4m", "out"] {
        fs::rename(place.path(name), place.path("elsewhere").join(name)).unwrap();
    }
    let done = place.run("elsewhere/out/run.toml -o third");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
}
