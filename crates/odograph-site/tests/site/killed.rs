//! A server that is killed at any moment has lost nothing that it acknowledged.

use crate::robots::Robot;
use odograph_map::MapFile;
use odograph_site::{LinkReport, Site, SiteClient, SiteLink, SiteServer};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, mpsc};
use std::time::Duration;

const FOLDER: &str = "ODOGRAPH_TEST_SITE";
const ADDRESS: &str = "ODOGRAPH_TEST_SITE_ADDRESS";

#[test]
#[ignore = "run by the other test, to be killed"]
#[allow(clippy::print_stdout)] // the other test waits for it
fn server() {
    let folder = std::env::var(FOLDER).unwrap();
    let address = std::env::var(ADDRESS).unwrap().parse().unwrap();
    let site = Arc::new(Site::open(Path::new(&folder)).unwrap());
    let server = SiteServer::start(address, site, None).unwrap();
    println!("\nserved at {}", server.address());
    loop {
        std::thread::park();
    }
}

/// Starts the server; returns the address as well.
fn serve(folder: &Path, address: &str) -> (Child, String) {
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--ignored", "--exact", "--nocapture", "killed::server"])
        .env(FOLDER, folder)
        .env(ADDRESS, address)
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines().map_while(Result::ok);
    let address = lines.find_map(|line| line.strip_prefix("served at ").map(str::to_owned)).unwrap();
    std::thread::spawn(move || lines.for_each(drop));
    (child, address)
}

#[test]
fn what_was_acknowledged_survives_kills() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("site");
    let robot = Robot::first();
    let map = robot.drive(folder.path());
    let (mut child, address) = serve(&place, "127.0.0.1:0");
    let client = SiteClient::new(format!("http://{address}/").parse().unwrap());
    let (tell, heard) = mpsc::channel();
    let listening = Box::new(move |report: &LinkReport| {
        let _ = tell.send(report.clone());
    });
    let link = SiteLink::start(&map, robot.name, client, listening).unwrap();
    let patience = Duration::from_secs(600);
    for _ in 0..4 {
        // At every news: while records are merged, and before, and after.
        let report = heard.recv_timeout(patience).unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
        let acknowledged = report.status.and_then(|status| status.acknowledged);
        let stored = {
            let connection = rusqlite::Connection::open(place.join("records.sqlite")).unwrap();
            let sql = "SELECT max(number) FROM record";
            connection.query_row(sql, [], |row| row.get::<_, Option<u64>>(0)).unwrap()
        };
        assert!(stored >= acknowledged, "{stored:?} {acknowledged:?}");
        child = serve(&place, &address).0;
    }
    let report = link.finish(patience, &|| true);
    assert!(report.complete, "{report:?}");
    child.kill().unwrap();
    child.wait().unwrap();
    // The records alone suffice for the map.
    let site = Site::open(&place).unwrap();
    site.wait_until_settled();
    drop(site);
    let count = |path: &Path| MapFile::open_read_only(path).unwrap().map().unwrap().keyframes.len();
    assert_eq!(count(&place.join("map.gpkg")), count(&map));
    let mut merged = MapFile::open_read_only(&place.join("map.gpkg")).unwrap();
    merged.check().unwrap();
    let numbers: Vec<u64> = merged
        .map()
        .unwrap()
        .keyframes
        .iter()
        .map(|keyframe| merged.number_of(keyframe.id).unwrap().unwrap())
        .collect();
    assert_eq!(numbers, (0..numbers.len() as u64).collect::<Vec<_>>());
    // Nobody has lived to render the mosaic; the next site does, though nothing is new.
    assert_eq!(merged.mosaic().unwrap(), None);
    drop(merged);
    let site = Site::open(&place).unwrap();
    while site.mosaic(1 << 20).unwrap().is_none() {
        std::thread::yield_now();
    }
}
