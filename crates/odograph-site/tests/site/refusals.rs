//! What a site refuses.

use crate::served::{Served, TOKEN, framed, sent};
use odograph::camera::Rig;
use odograph_map::MapFile;
use odograph_site::{Site, SiteServer};
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::Arc;

#[test]
fn only_who_has_the_token_is_answered() {
    let folder = tempfile::tempdir().unwrap();
    let served = Served::new(folder.path());
    let bearer = |token: &str| format!("Authorization: Bearer {token}\r\n");
    for path in ["/", "/state", "/mosaic.png"] {
        assert_eq!(served.ask("GET", path, "", b"").0, 403, "{path}");
        assert_eq!(served.ask("GET", path, &bearer("0123-a-tokem"), b"").0, 403, "{path}");
        assert_eq!(served.ask("GET", path, &bearer(""), b"").0, 403, "{path}");
    }
    for path in ["/sessions", "/records/one/0123456789abcdef0123456789abcdef", "/robots/one/withdraw"] {
        assert_eq!(served.ask("POST", path, "", b"{}").0, 403, "{path}");
        // Nobody makes a stranger's body wait in memory.
        assert_eq!(served.ask("POST", path, "", &vec![0; 200 << 10]).0, 403, "{path}");
        let foreign = format!("{}Origin: http://evil.example\r\n", bearer(TOKEN));
        assert_eq!(served.ask("POST", path, &foreign, b"{}").0, 403, "{path}");
    }
    assert_eq!(served.ask("GET", "/state", &bearer(TOKEN), b"").0, 200);
    assert_eq!(served.ask("GET", &format!("/?token={TOKEN}"), "", b"").0, 303);
    assert!(SiteServer::start("0.0.0.0:0".parse().unwrap(), Arc::clone(&served.site), None).is_err());
}

#[test]
fn idle_connections_make_room_for_robots() {
    let folder = tempfile::tempdir().unwrap();
    let served = Served::new(&folder.path().join("site"));
    let mut idle: Vec<TcpStream> =
        (0..64).map(|_| TcpStream::connect(served.server.address()).unwrap()).collect();
    // Half a request is none.
    idle[0].write_all(b"POST /records/one HTTP/1.1\r\n").unwrap();
    for _ in 0..3 {
        assert_eq!(served.ask("GET", "/state", &format!("Authorization: Bearer {TOKEN}\r\n"), b"").0, 200);
    }
    // The oldest was closed.
    let _ = idle[0].read_to_end(&mut Vec::new());
}

#[test]
fn records_are_taken_once_and_in_order() {
    let folder = tempfile::tempdir().unwrap();
    let (origin, description, records) = sent(folder.path());
    let served = Served::new(&folder.path().join("site"));
    let path = format!("/records/{}/{}", origin.robot, origin.key);
    assert_eq!(served.post(&path, &records[0]).0, 404, "a session is described first");
    let described = served.post("/sessions", description.to_string().as_bytes());
    assert_eq!((described.0, &described.1["acknowledged"]), (200, &Value::Null));
    // Not in order: the answer says what is there.
    assert_eq!(
        served.post(&path, &records[1]),
        (
            409,
            json!({
                "problem": "a record does not follow the last one that is stored", "acknowledged": null
            })
        )
    );
    assert_eq!(served.post(&path, &records[0]).1["acknowledged"], 0);
    assert_eq!(served.post(&path, &records[2]).1["acknowledged"], 0);
    // Once more, alone or together with the next, is no harm.
    assert_eq!(served.post(&path, &records[0]).1["acknowledged"], 0);
    assert_eq!(served.post(&path, &records[..3].concat()).1["acknowledged"], 2);
    assert_eq!(served.post("/sessions", description.to_string().as_bytes()).1["acknowledged"], 2);
    // Another record with the number of one that is there is from a robot of the same name.
    let mut other = records[1].clone();
    let at = other.windows(8).position(|eight| eight == b"\"frame\":").unwrap() + 8;
    other[at] = if other[at] == b'7' { b'8' } else { b'7' };
    let (status, answer) = served.post(&path, &other);
    assert_eq!((status, &answer["differs"]), (409, &json!(1)));
    // Of a body with one bad record nothing is taken.
    let (status, _) = served.post(&path, &[&records[3][..], b"more"].concat());
    assert_eq!(status, 422);
    assert_eq!(served.post(&path, b"").1["acknowledged"], 2);
}

#[test]
fn what_no_robot_sends_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (origin, description, records) = sent(folder.path());
    let served = Served::new(&folder.path().join("site"));
    let path = format!("/records/{}/{}", origin.robot, origin.key);
    let changed = |pointer: &str, value: Value| {
        let mut description = description.clone();
        *description.pointer_mut(pointer).unwrap() = value;
        description.to_string().into_bytes()
    };
    for body in [
        b"not json".to_vec(),
        b"{}".to_vec(),
        changed("/robot", json!("../etc")),
        changed("/key", json!("short")),
        changed("/rig/height_m", json!(-1.0)),
        changed("/rig", json!(null)),
    ] {
        assert_eq!(served.post("/sessions", &body).0, 422, "{}", String::from_utf8_lossy(&body));
    }
    assert_eq!(served.post("/sessions", &vec![b' '; 64 << 10]).0, 413);
    assert_eq!(served.post("/sessions", description.to_string().as_bytes()).0, 200);
    let mut no_image = records[0].clone();
    let at = 8 + u32::from_le_bytes(*no_image.first_chunk::<4>().unwrap()) as usize;
    no_image[at..].fill(0);
    for body in [
        b"x".to_vec(),
        u32::MAX.to_le_bytes().to_vec(),
        records[0][..records[0].len() - 1].to_vec(),
        framed(&json!({ "number": 0, "after": null, "keyframe": null, "edges": [] }), b"image"),
        // An image that is none.
        no_image,
    ] {
        assert_eq!(served.post(&path, &body).0, 422);
    }
    assert_eq!(served.post("/records/one/UPPER", b"").0, 422);
    assert_eq!(served.post("/records/nobody/0123456789abcdef0123456789abcdef", b"").0, 404);
    let huge = format!("Authorization: Bearer {TOKEN}\r\nContent-Length: 99999999\r\n");
    assert!([400, 413].contains(&served.ask("POST", &path, &huge, b"").0));
    assert_eq!(served.post(&path, b"").1["acknowledged"], Value::Null);
    assert_eq!(served.post("/nothing", b"").0, 404);
    assert_eq!(served.ask("PUT", "/sessions", "", b"").0, 405);
}

#[test]
fn a_stored_record_that_cannot_be_used_quarantines_its_robot_alone() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("site");
    let (origin, description, records) = sent(folder.path());
    // Taken by a program that did not refuse it yet.
    let (head, image) =
        records[1][4..].split_at(u32::from_le_bytes(*records[1].first_chunk().unwrap()) as usize);
    let mut head: Value = serde_json::from_slice(head).unwrap();
    head["keyframe"]["tilt_covariance"] = json!([-1.0, 5.0, -1.0]);
    let poison = framed(&head, &image[4..]);
    let served = Served::new(&place);
    let path = format!("/records/{}/{}", origin.robot, origin.key);
    assert_eq!(served.post("/sessions", description.to_string().as_bytes()).0, 200);
    assert_eq!(served.post(&path, &[&records[0][..], &poison].concat()).0, 422);
    assert_eq!(served.post(&path, &records[..3].concat()).0, 200);
    served.site.wait_until_settled();
    served.site.close();
    drop(served);
    let store = rusqlite::Connection::open(place.join("records.sqlite")).unwrap();
    store.execute("UPDATE record SET bytes = ?1 WHERE number = 1", [poison]).unwrap();
    drop(store);
    std::fs::remove_file(place.join("map.gpkg")).unwrap();
    let served = Served::new(&place);
    let mut other = description;
    other["robot"] = json!("other");
    assert_eq!(served.post("/sessions", other.to_string().as_bytes()).0, 200);
    assert_eq!(served.post(&format!("/records/other/{}", origin.key), &records[..3].concat()).0, 200);
    served.site.wait_until_settled();
    let page = served.site.page();
    assert_eq!((&page["failure"], &page["robots"]["one"]["state"]), (&Value::Null, &json!("quarantined")));
    let reason = page["robots"]["one"]["reason"].as_str().unwrap();
    assert!(reason.contains("record 1 of session") && reason.contains("no camera takes"), "{reason}");
    let merged = page["sessions"].as_array().unwrap().iter().map(|session| session["keyframes"].clone());
    assert_eq!(merged.collect::<Vec<_>>(), [json!(0), json!(3)]);
}

#[test]
fn a_site_that_cannot_merge_says_so_and_goes_on_when_it_can() {
    let folder = tempfile::tempdir().unwrap();
    let place = folder.path().join("site");
    let (origin, description, records) = sent(folder.path());
    let served = Served::new(&place);
    // No map can be made here.
    std::fs::create_dir(place.join("map.gpkg")).unwrap();
    assert_eq!(served.post("/sessions", description.to_string().as_bytes()).0, 200);
    let path = format!("/records/{}/{}", origin.robot, origin.key);
    assert_eq!(served.post(&path, &records[..3].concat()).0, 200);
    served.site.wait_until_settled();
    let failure = served.site.failure().unwrap();
    assert!(failure.contains("map.gpkg"), "{failure}");
    assert_eq!(served.site.page()["failure"], json!(failure));
    assert_eq!(served.site.page()["robots"]["one"]["state"], "active", "it is not the robot");
    // It may have been tried again meanwhile, with the same end.
    let said = served.post("/robots/one/withdraw", b"").1["failure"].to_string();
    assert!(said.contains("map.gpkg"), "{said}");
    let client = odograph_site::SiteClient::new(served.server.url().parse().unwrap());
    let complaint = client.set_robot("one", "restore").unwrap_err().to_string();
    assert!(complaint.contains("not carried out") && complaint.contains("map.gpkg"), "{complaint}");
    assert!(failure.ends_with("it is tried again every 10 s"), "{failure}");
    // What it acknowledged is merged by the same site; a decision about a robot wakes it at once.
    std::fs::remove_dir(place.join("map.gpkg")).unwrap();
    while served.site.failure().is_some() {
        let _ = client.set_robot("one", "restore");
    }
    served.site.wait_until_settled();
    assert_eq!((served.site.failure(), &served.site.page()["sessions"][0]["keyframes"]), (None, &json!(3)));
}

#[test]
fn the_folder_of_a_run_is_not_served() {
    let folder = tempfile::tempdir().unwrap();
    let camera = crate::robots::Robot::first().camera;
    let map = MapFile::create(&folder.path().join("map.gpkg"), &camera, &Rig::level(1.0)).unwrap();
    map.close().unwrap();
    let refused = Site::open(folder.path()).unwrap_err().to_string();
    assert!(refused.contains("has the map of a run"), "{refused}");
    assert!(!folder.path().join("records.sqlite").exists());
}
