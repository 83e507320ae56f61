//! End-to-end tests of `odograph site`: two robots, a server that is killed, and one map.

use serde_json::Value;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

/// The bundled drive with its camera and rig.
const DEMO: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/demo");

fn odograph(folder: &Path, arguments: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_odograph"));
    command.current_dir(folder).env("ODOGRAPH_FFMPEG", "").stdin(Stdio::null());
    command.args(arguments.split_whitespace());
    command
}

fn done(folder: &Path, arguments: &str) -> Output {
    let output = odograph(folder, arguments).output().unwrap();
    assert!(output.status.success(), "{arguments}: {}", String::from_utf8_lossy(&output.stderr));
    output
}

/// A running `site serve`; it is killed when dropped.
struct Serving {
    child: Child,
    url: String,
}

impl Serving {
    fn new(folder: &Path, address: &str) -> Self {
        let mut child = odograph(folder, &format!("site serve hall --listen {address}"))
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
        let line = lines.find(|line| line.contains("the site is at ")).unwrap();
        std::thread::spawn(move || lines.for_each(drop));
        let url = line.split("the site is at ").nth(1).unwrap().split(';').next().unwrap().to_owned();
        Self { child, url }
    }
}

impl Drop for Serving {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn drive() -> std::path::PathBuf {
    let mut files = std::fs::read_dir(DEMO).unwrap().map(|entry| entry.unwrap().path());
    files.find(|path| path.extension().is_some_and(|extension| extension == "mp4")).unwrap()
}

#[cfg(unix)]
#[test]
fn a_site_that_merges_nothing_any_more_ends_with_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut child =
        odograph(folder, "site serve hall --listen 127.0.0.1:0").stderr(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
    let line = lines.find(|line| line.contains("the site is at ")).unwrap();
    let url = line.split("the site is at ").nth(1).unwrap().split(';').next().unwrap().to_owned();
    // No map can be made here.
    std::fs::create_dir(folder.join("hall/map.gpkg")).unwrap();
    let camera = format!("--camera {DEMO}/camera.yaml --rig {DEMO}/rig.toml --quiet --max-frames 60");
    done(folder, &format!("run {} {camera} -o one --site {url} --robot one", drive().display()));
    let told = lines.next().unwrap();
    assert!(
        told.starts_with("warning: nothing is merged at the moment: ") && told.contains("map.gpkg"),
        "{told}"
    );
    for (command, shown) in [
        (format!("site robots --site {url}"), "one "),
        (format!("site robots --json --site {url}"), "{"),
        (format!("site withdraw one --site {url}"), ""),
    ] {
        let output = odograph(folder, &command).output().unwrap();
        let told = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(3) && told.contains("merges nothing at the moment: "), "{told}");
        let text = String::from_utf8(output.stdout).unwrap();
        assert!(text.starts_with(shown) && text.is_empty() == shown.is_empty(), "{command}: {text}");
    }
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    let told = lines.last().unwrap();
    assert!(told.starts_with("error: not everything is merged: "), "{told}");
    assert_eq!(child.wait().unwrap().code(), Some(130), "interrupted, with an error");
}

#[test]
fn two_runs_share_the_map_of_a_site_that_was_killed() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let run = format!("{} --camera {DEMO}/camera.yaml --rig {DEMO}/rig.toml --quiet", drive().display());
    let serving = Serving::new(folder, "127.0.0.1:0");
    let url = serving.url.clone();
    let loud = run.trim_end_matches(" --quiet");
    let told = done(folder, &format!("run {loud} --max-frames 400 -o one --site {url} --robot one"));
    let told = String::from_utf8(told.stderr).unwrap();
    assert!(told.contains("; its map from this odometry: x 0.000 m, y 0.000 m"), "{told}");
    let status: Value =
        serde_json::from_slice(&std::fs::read(folder.join("one/site.json")).unwrap()).unwrap();
    assert_eq!(status["ended"], true);
    assert!(folder.join("one/map.gpkg").exists() && !folder.join("one/map.gpkg-wal").exists());
    // Killed, not ended: what it acknowledged is there when it comes back.
    drop(serving);
    let output = odograph(folder, &format!("site robots --site {url}")).output().unwrap();
    assert_eq!(output.status.code(), Some(3));
    let serving = Serving::new(folder, url.trim_start_matches("http://").trim_end_matches('/'));
    done(folder, &format!("live {run} -o two --site {url} --robot two"));
    let sent = done(folder, &format!("site send two/map.gpkg --site {url} --robot two"));
    let told = String::from_utf8(sent.stderr).unwrap();
    assert!(told.starts_with("note: the site had all records already; "), "{told}");
    // The merging thread may still be at it; what it has not merged it merges when it starts again.
    let connected = || {
        let state = done(folder, &format!("site robots --site {url} --json"));
        let state: Value = serde_json::from_slice(&state.stdout).unwrap();
        let sessions = state["sessions"].as_array().unwrap().clone();
        sessions.len() == 2 && sessions.iter().all(|session| session["connected"] == true)
    };
    assert!((0..600).any(|_| connected()), "both robots saw the same ground");
    // A killed run is run again as the robot that it was, and sent.
    let mut killed =
        odograph(folder, &format!("run {run} --max-frames 400 -o three --site {url} --robot three"))
            .spawn()
            .unwrap();
    let frames = folder.join("three/trajectory.csv.part");
    while std::fs::metadata(&frames).map_or(0, |frames| frames.len()) == 0 {
        assert!(killed.try_wait().unwrap().is_none(), "it ended before it was killed");
    }
    killed.kill().unwrap();
    killed.wait().unwrap();
    let other = odograph(folder, &format!("run --resume three --site {url} --robot four")).output().unwrap();
    let told = String::from_utf8(other.stderr).unwrap();
    assert_eq!(other.status.code(), Some(2), "{told}");
    assert!(told.contains("was begun as robot three, not four"), "{told}");
    done(folder, &format!("run --resume three --site {url} --quiet"));
    let status: Value =
        serde_json::from_slice(&std::fs::read(folder.join("three/site.json")).unwrap()).unwrap();
    assert_eq!(status["ended"], true);
    for (command, said) in [
        ("withdraw", "three is withdrawn: "),
        ("restore", "three is restored: "),
        ("restore --trust", "three is trusted: "),
    ] {
        let told = done(folder, &format!("site {command} three --site {url}"));
        let told = String::from_utf8(told.stdout).unwrap();
        assert!(told.starts_with(said) && told.lines().count() == 1, "{told}");
    }
    drop(serving);
    let info = done(folder, "map info hall/map.gpkg --json");
    let info: Value = serde_json::from_slice(&info.stdout).unwrap();
    let robots: Vec<&str> = info["sessions"]
        .as_array()
        .unwrap()
        .iter()
        .map(|session| session["origin"]["robot"].as_str().unwrap())
        .collect();
    assert_eq!(robots[..2], ["one", "two"]);
    for wrong in ["run x.mp4 --site http://h/", "site send one/map.gpkg --site hall --robot one"] {
        assert_eq!(odograph(folder, wrong).output().unwrap().status.code(), Some(2), "{wrong}");
    }
}

#[test]
fn a_robot_sends_with_its_own_token_until_that_is_revoked() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let serving = Serving::new(folder, "127.0.0.1:0");
    let url = serving.url.clone();
    let printed = done(folder, "site token add hall one").stdout;
    let printed = String::from_utf8(printed).unwrap();
    assert!(
        printed.len() == 65 && printed.trim_end().bytes().all(|byte| byte.is_ascii_hexdigit()),
        "{printed}"
    );
    let noted = done(folder, "site token add hall two -o two.token");
    assert!(noted.stdout.is_empty());
    let token = std::fs::read_to_string(folder.join("two.token")).unwrap();
    #[cfg(unix)]
    for file in ["two.token", "hall/tokens.json"] {
        use std::os::unix::fs::PermissionsExt;
        let mode = std::fs::metadata(folder.join(file)).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600, "{file}");
    }
    let camera = format!("--camera {DEMO}/camera.yaml --rig {DEMO}/rig.toml --max-frames 60");
    let run = format!("run {} {camera} --site {url} --robot two", drive().display());
    let sent = done(folder, &format!("{run} --site-token two.token -o sent"));
    let mut shown = String::from_utf8(sent.stderr).unwrap();
    assert!(shown.contains("the site took "), "{shown}");
    // Without its token, and with it after it was revoked, the run ends well and nothing is sent.
    let refused = done(folder, &format!("{run} -o refused"));
    let refused = String::from_utf8(refused.stderr).unwrap();
    assert!(refused.contains("robot two has a token of its own"), "{refused}");
    let list = |arguments: &str| String::from_utf8(done(folder, arguments).stdout).unwrap();
    assert_eq!(list("site token list hall"), "one              valid\ntwo              valid\n");
    assert!(list("site token revoke hall two").starts_with("the token of two is revoked; "));
    let revoked =
        odograph(folder, &format!("site send sent/map.gpkg --site {url} --robot two --site-token two.token"));
    let revoked = { revoked }.output().unwrap();
    let told = String::from_utf8(revoked.stderr).unwrap();
    assert_eq!(revoked.status.code(), Some(3), "{told}");
    assert!(told.contains("refuses: the token of robot two is revoked"), "{told}");
    let json: Value = serde_json::from_str(&list("site token list hall --json")).unwrap();
    assert_eq!(json["robots"][1], serde_json::json!({ "robot": "two", "revoked": true }));
    let robots = list(&format!("site robots --site {url}"));
    assert!(robots.contains("refused ") && robots.contains("the token of robot two is revoked"), "{robots}");
    shown += &format!("{refused}{told}{robots}{}", String::from_utf8_lossy(&noted.stderr));
    assert!(!shown.contains(token.trim_end()) && !shown.contains(printed.trim_end()), "{shown}");
    // What is wrong with an address is said without the token in it.
    let wrong = odograph(folder, "site robots --site http://h:0/?token=secret-1").output().unwrap();
    let told = String::from_utf8(wrong.stderr).unwrap();
    assert!(wrong.status.code() == Some(2) && !told.contains("secret-1"), "{told}");
}

#[test]
fn a_map_that_is_not_sent_is_sent_by_a_command_without_the_token() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let camera = format!("--camera {DEMO}/camera.yaml --rig {DEMO}/rig.toml --max-frames 60");
    let run = format!("run {} {camera} --robot one", drive().display());
    std::fs::write(folder.join("a.token"), "secret-1\n").unwrap();
    for (site, advice) in [
        ("http://127.0.0.1:1/?token=secret-1", "--site http://127.0.0.1:1/ --site-token FILE --robot one"),
        (
            "http://127.0.0.1:1/ --site-token a.token",
            "--site http://127.0.0.1:1/ --site-token a.token --robot one",
        ),
    ] {
        let told = done(folder, &format!("{run} --site {site} -o out --force"));
        let told = String::from_utf8(told.stderr).unwrap();
        assert!(told.contains(advice) && !told.contains("secret-1"), "{told}");
    }
}

#[cfg(not(feature = "tls"))]
#[test]
fn a_program_without_tls_says_how_to_have_it() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    for command in
        ["site serve hall --tls-certificate a.pem --tls-key a.key", "site robots --site https://hall/"]
    {
        let output = odograph(folder, command).output().unwrap();
        let told = String::from_utf8(output.stderr).unwrap();
        assert!(output.status.code() == Some(2) && told.contains("--features tls"), "{told}");
        assert!(!folder.join("hall").exists());
    }
}

#[cfg(unix)]
#[test]
fn an_address_that_others_reach_without_encryption_is_warned_of() {
    let folder = tempfile::tempdir().unwrap();
    let mut child = odograph(folder.path(), "site serve hall --listen 0.0.0.0:0 --token 5f1c-hall")
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
    let told = lines.next().unwrap();
    let _ = child.kill();
    child.wait().unwrap();
    assert!(told.starts_with("warning: nothing is encrypted: "), "{told}");
}
