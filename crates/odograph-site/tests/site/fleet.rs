//! A fleet and its site, over HTTP on this machine.

use crate::robots::Robot;
use odograph_map::{MapFile, SessionOrigin};
use odograph_site::protocol::RobotState;
use odograph_site::{LinkReport, Site, SiteClient, SiteLink, SiteServer};
use serde_json::Value;
use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc;
use std::time::Duration;

const PATIENCE: Duration = Duration::from_secs(600);

pub struct Served {
    pub site: Arc<Site>,
    server: SiteServer,
}

impl Drop for Served {
    fn drop(&mut self) {
        // A connection may still be served.
        self.site.close();
    }
}

impl Served {
    pub fn new(folder: &Path, address: SocketAddr) -> Self {
        let site = Arc::new(Site::open(folder).unwrap());
        let server = SiteServer::start(address, Arc::clone(&site), None).unwrap();
        Self { site, server }
    }

    pub fn client(&self) -> SiteClient {
        SiteClient::new(self.server.url().parse().unwrap())
    }

    /// Sends everything that a robot's map has.
    pub fn send(&self, robot: &Robot, map: &Path) -> LinkReport {
        let link = SiteLink::start(map, robot.name, self.client(), Box::new(|_| {})).unwrap();
        let report = link.finish(PATIENCE, &|| true);
        self.site.wait_until_settled();
        assert!(report.complete, "{report:?}");
        report
    }

    /// What the page says about a robot's session.
    pub fn session(&self, robot: &Robot) -> Value {
        let page = self.client().state().unwrap();
        let sessions = page["sessions"].as_array().unwrap();
        sessions.iter().find(|session| session["robot"] == robot.name).cloned().unwrap_or_default()
    }
}

pub fn any_port() -> SocketAddr {
    "127.0.0.1:0".parse().unwrap()
}

/// Number of keyframes of a robot in the map of the site.
fn in_map(folder: &Path, robot: &Robot) -> usize {
    let file = MapFile::open_read_only(&folder.join("map.gpkg")).unwrap();
    let sessions = file.sessions().unwrap();
    let own = sessions.iter().filter(|session| session.origin.as_ref().unwrap().robot == robot.name);
    let own: Vec<u32> = own.map(|session| session.id).collect();
    file.map().unwrap().keyframes.iter().filter(|keyframe| own.contains(&keyframe.session)).count()
}

fn keyframes(map: &Path) -> usize {
    MapFile::open_read_only(map).unwrap().map().unwrap().keyframes.len()
}

#[test]
fn a_link_to_a_silent_site_ends_without_its_answer() {
    let folder = tempfile::tempdir().unwrap();
    let robot = Robot { lane: ((0.0, 0.0), 0.0, 12), ..Robot::first() };
    let map = robot.drive(folder.path());
    let silent = TcpListener::bind(any_port()).unwrap();
    let url = format!("http://{}/", silent.local_addr().unwrap());
    let link = SiteLink::start(&map, robot.name, SiteClient::new(url.parse().unwrap()), Box::new(|_| {}));
    // The request is under way, and is not waited for: its time limit would be a problem to report.
    let accepted = silent.accept().unwrap();
    let report = link.unwrap().finish(Duration::ZERO, &|| true);
    assert_eq!((report.complete, report.acknowledged, report.problem), (false, 0, None));
    drop(accepted);
}

#[test]
fn robots_with_different_cameras_share_a_map_and_a_wrong_one_is_quarantined() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("site");
    let (one, two, wrong) = (Robot::first(), Robot::second(), Robot::wrong());
    let maps = [&one, &two, &wrong].map(|robot| robot.drive(folder.path()));
    let served = Served::new(&place, any_port());
    served.send(&one, &maps[0]);
    served.send(&two, &maps[1]);
    for (robot, map) in [(&one, &maps[0]), (&two, &maps[1])] {
        let session = served.session(robot);
        assert_eq!(session["connected"], true, "{session}");
        assert_eq!(session["condition"], "ended");
        assert_eq!(in_map(&place, robot), keyframes(map));
    }
    assert!(served.session(&two)["loops"].as_u64().unwrap() >= 2);
    // In the map the second robot is where it drove: on its lane, seen from the first one's begin.
    let file = MapFile::open_read_only(&place.join("map.gpkg")).unwrap();
    let map = file.map().unwrap();
    assert_eq!((map.camera_of(0), map.camera_of(1)), (&one.camera, &two.camera));
    assert_eq!(map.rig_of(1).height_m, two.told_m);
    let ((x, y), heading_rad, _) = two.lane;
    for keyframe in map.keyframes.iter().filter(|keyframe| keyframe.session == 1) {
        let (off_x, off_y) = (keyframe.pose.x_m - x, keyframe.pose.y_m - y);
        let across_m = off_y * heading_rad.cos() - off_x * heading_rad.sin();
        assert!(across_m.abs() < 0.01, "{:?}", keyframe.pose);
    }
    drop(file);
    // A height that is wrong by 6 % is named, with the height that would fit.
    let report = served.send(&wrong, &maps[2]);
    assert_eq!(served.site.page()["robots"]["three"]["state"], "quarantined", "{}", served.site.page());
    let reason = served.site.page()["robots"]["three"]["reason"].as_str().unwrap().to_owned();
    let fitting =
        reason.split("a height of ").nth(1).and_then(|rest| rest.split(' ').next()?.parse::<f64>().ok());
    assert!(fitting.is_some_and(|height_m| (height_m - wrong.height_m).abs() < 0.01), "{reason}");
    assert!(reason.contains("in place of 0.954 m"), "{reason}");
    assert_eq!(in_map(&place, &wrong), 0);
    assert_eq!(report.status.unwrap().acknowledged, Some(keyframes(&maps[2]) as u64));
    assert_eq!([&one, &two].map(|robot| served.session(robot)["connected"] == true), [true; 2]);
    // Its records are there: whoever knows better puts it into the map.
    served.client().set_robot("three", "trust").unwrap();
    served.site.wait_until_settled();
    assert_eq!(in_map(&place, &wrong), keyframes(&maps[2]));
    // What was withdrawn is out of the map, and comes back as it was.
    served.client().set_robot("two", "withdraw").unwrap();
    served.client().set_robot("three", "withdraw").unwrap();
    served.site.wait_until_settled();
    assert_eq!([&one, &two, &wrong].map(|robot| in_map(&place, robot)), [keyframes(&maps[0]), 0, 0]);
    served.client().set_robot("two", "restore").unwrap();
    served.site.wait_until_settled();
    assert_eq!(in_map(&place, &two), keyframes(&maps[1]));
    assert_eq!(served.session(&two)["connected"], true);
    assert!(served.client().set_robot("nobody", "withdraw").is_err());
    assert_eq!(served.site.page()["robots"]["two"]["state"], RobotState::Active.name());
}

#[test]
fn robots_that_see_their_bumpers_are_connected_by_the_ground_alone() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("site");
    let [one, beside, elsewhere] = [("one", (0.0, 0.0)), ("four", (0.1, 0.12)), ("five", (0.0, 40.0))]
        .map(|(name, from)| Robot::with_bumper(name, from));
    let served = Served::new(&place, any_port());
    for robot in [&one, &beside, &elsewhere] {
        served.send(robot, &robot.drive(folder.path()));
    }
    assert_eq!(
        [&one, &beside, &elsewhere].map(|robot| served.session(robot)["connected"] == true),
        [true, true, false]
    );
    assert!(served.session(&beside)["loops"].as_u64().unwrap() >= 2);
    let map = MapFile::open_read_only(&place.join("map.gpkg")).unwrap().map().unwrap();
    for session in 0..3 {
        let share = map.masks[&session].share();
        assert!((share - 0.25).abs() < 0.08, "session {session}: {share}");
    }
    // The features are those of the ground.
    for keyframe in map.keyframes.iter().filter(|keyframe| keyframe.frame > 60) {
        let lowest =
            keyframe.signature.features.iter().map(|feature| feature.position_m[0]).fold(0.0, f32::min);
        assert!(lowest > -0.25, "{lowest} m");
    }
}

#[test]
fn a_robot_goes_on_when_the_site_comes_back() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("site");
    let one = Robot::first();
    let map = one.drive(folder.path());
    // An address where nobody listens yet.
    let address = TcpListener::bind(any_port()).unwrap().local_addr().unwrap();
    let client = SiteClient::new(format!("http://{address}/").parse().unwrap());
    let (tell, heard) = mpsc::channel();
    let listening = Box::new(move |report: &LinkReport| {
        let _ = tell.send(report.clone());
    });
    let link = SiteLink::start(&map, one.name, client, listening).unwrap();
    let problem = heard.recv_timeout(PATIENCE).unwrap().problem.unwrap();
    assert!(problem.contains("cannot be reached") && problem.contains("check the address"), "{problem}");
    let served = Served::new(&place, address);
    // All but the end of the session, which only comes when the run is over.
    let last = keyframes(&map) as u64 - 1;
    let has_all =
        |report: &LinkReport| report.status.as_ref().is_some_and(|status| status.acknowledged == Some(last));
    while !has_all(&heard.recv_timeout(PATIENCE).unwrap()) {}
    let version = {
        served.site.wait_until_settled();
        served.client().state().unwrap()["version"].as_u64().unwrap()
    };
    drop(served);
    // Back again, it knows what it had, and the link finishes.
    let served = Served::new(&place, address);
    let report = link.finish(PATIENCE, &|| true);
    assert!(report.complete && report.acknowledged == last + 2, "{report:?}");
    assert!(report.status.unwrap().ended);
    served.site.wait_until_settled();
    assert_eq!(in_map(&place, &one), keyframes(&map));
    assert!(served.client().state().unwrap()["version"].as_u64().unwrap() >= version);
    // Another link has nothing to send.
    assert_eq!(served.send(&one, &map).acknowledged, 0);
    assert!(Site::open(&place).unwrap_err().to_string().contains("another program"), "one server at a time");
}

#[test]
fn a_run_that_was_killed_sent_and_begun_again_is_one_session() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("site");
    let one = Robot::first();
    let origin = SessionOrigin::new(one.name).unwrap();
    let [half, whole] = [("half", 50), ("whole", 100)].map(|(name, frames)| {
        let folder = folder.path().join(name);
        std::fs::create_dir(&folder).unwrap();
        one.drive_part(&folder, &origin, frames)
    });
    let served = Served::new(&place, any_port());
    served.send(&one, &half);
    assert_eq!(served.session(&one)["records"], keyframes(&half));
    let report = served.send(&one, &whole);
    assert!(report.status.unwrap().ended);
    let page = served.client().state().unwrap();
    assert_eq!(page["sessions"].as_array().unwrap().len(), 1, "{page}");
    assert_eq!(
        (&page["sessions"][0]["condition"], in_map(&place, &one)),
        (&"ended".into(), keyframes(&whole))
    );
    assert!(keyframes(&whole) > keyframes(&half));
    // Nothing is left to send, neither of the whole nor of the half of it.
    for map in [&whole, &half] {
        assert_eq!(served.send(&one, map).acknowledged, 0);
    }
}
