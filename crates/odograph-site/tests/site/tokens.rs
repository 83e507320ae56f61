//! Robots with tokens of their own: what each may do, and what is refused, counted and shown.

use crate::served::{Served, TOKEN, bearer, sent};
use odograph_map::SessionOrigin;
use odograph_site::RobotTokens;
use serde_json::{Value, json};
use std::io::{Read, Write};
use std::net::TcpStream;
use tempfile::TempDir;

/// A site with a robot "one" that has a token, and what that robot sends.
struct Fleet {
    folder: TempDir,
    served: Served,
    token: String,
    origin: SessionOrigin,
    description: Value,
    records: Vec<Vec<u8>>,
}

impl Fleet {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let (origin, description, records) = sent(folder.path());
        let place = folder.path().join("site");
        let served = Served::new(&place);
        let token = RobotTokens::in_folder(&place).add(&origin.robot).unwrap();
        Self { folder, served, token, origin, description, records }
    }

    fn tokens(&self) -> RobotTokens {
        RobotTokens::in_folder(&self.folder.path().join("site"))
    }

    fn path(&self) -> String {
        format!("/records/{}/{}", self.origin.robot, self.origin.key)
    }

    fn describe(&self, token: &str, robot: &str) -> (u16, Value) {
        let mut description = self.description.clone();
        description["robot"] = json!(robot);
        self.served.post_with(token, "/sessions", description.to_string().as_bytes())
    }

    fn reasons(&self) -> Vec<String> {
        let state = self.served.state();
        let refusals = state["refusals"].as_array().unwrap().clone();
        refusals.iter().map(|refusal| refusal["reason"].as_str().unwrap().to_owned()).collect()
    }
}

#[test]
fn a_robot_writes_as_itself_alone() {
    let fleet = Fleet::new();
    let Fleet { served, token, records, .. } = &fleet;
    let two = fleet.tokens().add("two").unwrap();
    assert_eq!(fleet.describe(token, "one").0, 200);
    assert_eq!(served.post_with(token, &fleet.path(), &records[..2].concat()).1["acknowledged"], 1);
    let key = &fleet.origin.key;
    for (with, path) in [
        // Another robot's token, and a name without a token.
        (two.as_str(), fleet.path()),
        (token, format!("/records/two/{key}")),
        (token, format!("/records/three/{key}")),
        // That of the site, where the robot has its own.
        (TOKEN, fleet.path()),
        ("0123-another-site", fleet.path()),
    ] {
        let (status, answer) = served.post_with(with, &path, &records[2]);
        assert_eq!(status, 403, "{path}");
        assert!(answer["problem"].as_str().unwrap().contains("token"), "{answer}");
    }
    assert_eq!(served.ask("POST", &fleet.path(), "", &records[2]).0, 403, "no token");
    let in_query = format!("{}?token={token}", fleet.path());
    assert_eq!(served.ask("POST", &in_query, "", &records[2]).0, 403, "tokens of robots are not in URLs");
    assert_eq!(fleet.describe(&two, "one").0, 403);
    assert_eq!(fleet.describe(token, "two").0, 403);
    assert_eq!(fleet.describe(TOKEN, "one").0, 403);
    // Robots without a token of their own have that of the site.
    assert_eq!(fleet.describe(TOKEN, "small").0, 200);
    assert_eq!(served.post(&format!("/records/small/{key}"), &records[0]).0, 200);
    // Nothing was taken but what the robot itself sent.
    assert_eq!(served.post_with(token, &fleet.path(), b"").1["acknowledged"], 1);
    // Page and decisions are not for robots.
    for (method, path) in
        [("GET", "/"), ("GET", "/state"), ("GET", "/mosaic.png"), ("POST", "/robots/two/withdraw")]
    {
        assert_eq!(served.ask(method, path, &bearer(token), b"").0, 403, "{path}");
    }
    served.site.wait_until_settled();
    assert_eq!(served.site.page()["robots"]["one"]["state"], "active");
}

#[test]
fn a_revoked_token_is_refused_at_once_without_restart() {
    let fleet = Fleet::new();
    let Fleet { served, token, records, .. } = &fleet;
    assert_eq!(fleet.describe(token, "one").0, 200);
    assert_eq!(served.post_with(token, &fleet.path(), &records[0]).0, 200);
    // On a connection that is kept, and while a body is on its way.
    let mut stream = TcpStream::connect(served.server.address()).unwrap();
    let (first, second) = records[1].split_at(records[1].len() / 2);
    let head = format!(
        "POST {} HTTP/1.1\r\nHost: here\r\n{}Connection: close\r\nContent-Length: {}\r\n\r\n",
        fleet.path(),
        bearer(token),
        records[1].len()
    );
    stream.write_all(head.as_bytes()).unwrap();
    stream.write_all(first).unwrap();
    // It was admitted: an unknown token is answered before the body.
    stream.set_nonblocking(true).unwrap();
    assert!(stream.read(&mut [0; 1]).is_err());
    stream.set_nonblocking(false).unwrap();
    fleet.tokens().revoke("one").unwrap();
    stream.write_all(second).unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    assert!(
        answer.starts_with("HTTP/1.1 403 ") && answer.contains("the token of robot one is revoked"),
        "{answer}"
    );
    let (status, refused) = served.post_with(token, &fleet.path(), &records[1]);
    assert_eq!(status, 403);
    assert!(refused["problem"].as_str().unwrap().contains("is revoked"), "{refused}");
    // Nor is there a way around it.
    assert_eq!(served.post(&fleet.path(), &records[1]).0, 403);
    let new = fleet.tokens().add("one").unwrap();
    let status = served.post_with(&new, &fleet.path(), b"").1;
    assert_eq!(status["acknowledged"], 0, "nothing was taken with the revoked token");
    assert_eq!(served.post_with(token, &fleet.path(), &records[1]).0, 403, "the old one stays revoked");
}

#[test]
fn tokens_that_cannot_be_read_let_no_robot_in() {
    let fleet = Fleet::new();
    std::fs::write(fleet.folder.path().join("site/tokens.json"), "{").unwrap();
    for token in [fleet.token.as_str(), TOKEN] {
        let (status, answer) = fleet.describe(token, "one");
        assert_eq!(status, 503);
        assert!(answer["problem"].as_str().unwrap().contains("tokens.json"), "{answer}");
    }
    assert!(fleet.reasons()[0].contains("tokens.json"), "and the page says why");
}

#[test]
fn acknowledged_records_that_are_replayed_change_nothing() {
    let fleet = Fleet::new();
    let Fleet { served, token, records, .. } = &fleet;
    assert_eq!(fleet.describe(token, "one").0, 200);
    let all = records[..3].concat();
    assert_eq!(served.post_with(token, &fleet.path(), &all).1["acknowledged"], 2);
    served.site.wait_until_settled();
    let before = served.site.page();
    for body in [&all, &records[0], &records[1..3].concat()] {
        assert_eq!(served.post_with(token, &fleet.path(), body).1["acknowledged"], 2);
    }
    served.site.wait_until_settled();
    let after = served.site.page();
    assert_eq!(after["sessions"][0]["keyframes"], 3);
    assert_eq!(
        (&after["version"], &after["sessions"][0]["path"]),
        (&before["version"], &before["sessions"][0]["path"])
    );
    // Somebody who has recorded them, without the token.
    assert_eq!(served.ask("POST", &fleet.path(), "", &all).0, 403);
}

#[test]
fn a_flood_of_one_robot_leaves_the_others_room() {
    let fleet = Fleet::new();
    let Fleet { served, token, records, .. } = &fleet;
    let two = fleet.tokens().add("two").unwrap();
    assert_eq!((fleet.describe(token, "one").0, fleet.describe(&two, "two").0), (200, 200));
    // Large bodies that never end: two are admitted, no further memory is reserved.
    let claimed = |length: usize| {
        let mut stream = TcpStream::connect(served.server.address()).unwrap();
        let head = format!(
            "POST {} HTTP/1.1\r\nHost: here\r\n{}Content-Length: {length}\r\n\r\n",
            fleet.path(),
            bearer(token)
        );
        stream.write_all(head.as_bytes()).unwrap();
        stream
    };
    let held: Vec<TcpStream> = (0..3).map(|_| claimed(15 << 20)).collect();
    // All were read: which of them is refused depends on the order of their threads.
    let mut answers = Vec::new();
    while answers.is_empty() {
        for mut stream in held.iter().map(|stream| stream.try_clone().unwrap()) {
            stream.set_nonblocking(true).unwrap();
            let mut answer = [0; 4096];
            if let Ok(length) = stream.read(&mut answer) {
                answers.push(String::from_utf8_lossy(&answer[..length]).into_owned());
            }
            stream.set_nonblocking(false).unwrap();
        }
    }
    assert!(answers.len() == 1 && answers[0].starts_with("HTTP/1.1 429 "), "{answers:?}");
    assert!(answers[0].contains("Retry-After: 1\r\n"), "{answers:?}");
    // Many small requests at once.
    let mut stream = TcpStream::connect(served.server.address()).unwrap();
    let head =
        format!("POST {} HTTP/1.1\r\nHost: here\r\n{}Content-Length: 0\r\n\r\n", fleet.path(), bearer(token));
    let mut writer = stream.try_clone().unwrap();
    // Which fails where the server has closed.
    let writing = std::thread::spawn(move || writer.write_all(head.repeat(1000).as_bytes()));
    let mut answer = Vec::new();
    let _ = stream.read_to_end(&mut answer);
    let _ = writing.join().unwrap();
    let answer = String::from_utf8_lossy(&answer);
    assert!(answer.starts_with("HTTP/1.1 200 "), "{answer}");
    assert!(answer.contains("HTTP/1.1 429 ") && answer.contains("requests per second"), "{answer}");
    let of_two = format!("/records/two/{}", fleet.origin.key);
    assert_eq!(served.post_with(&two, &of_two, &records[..3].concat()).1["acknowledged"], 2);
    assert!(fleet.reasons().iter().any(|reason| reason.contains("robot one sends")), "{:?}", fleet.reasons());
}

#[test]
fn a_flood_of_descriptions_does_not_grow_the_site() {
    let fleet = Fleet::new();
    let mut description = fleet.description.clone();
    description["robot"] = json!("small");
    for number in 0..100 {
        description["key"] = json!(format!("{number:032x}"));
        assert_eq!(fleet.served.post_until_taken("/sessions", description.to_string().as_bytes()), 200);
    }
    // One that has a record stays.
    let path = format!("/records/small/{:032x}", 99);
    assert_eq!(fleet.served.post_until_taken(&path, &fleet.records[0]), 200);
    fleet.served.site.wait_until_settled();
    assert!(fleet.served.site.page()["sessions"].as_array().unwrap().len() <= 65);
}

#[test]
fn what_is_refused_is_shown_and_logged_without_tokens() {
    let fleet = Fleet::new();
    let Fleet { served, token, records, .. } = &fleet;
    let secret = "deadbeef-of-another-site";
    assert_eq!(fleet.describe(token, "one").0, 200);
    served.post_with(secret, &fleet.path(), &records[0]);
    served.ask("GET", &format!("/?token={secret}"), "", b"");
    served.ask("POST", &fleet.path(), "", &records[0]);
    let foreign = format!("{}Origin: http://evil.example\r\n", bearer(token));
    assert_eq!(served.ask("POST", &fleet.path(), &foreign, &records[0]).0, 403, "a page of another origin");
    assert_eq!(served.post_with(token, &fleet.path(), b"no record").0, 422);
    assert_eq!(served.post_with(token, &fleet.path(), &[&records[0][..], b"more"].concat()).0, 422);
    fleet.tokens().revoke("one").unwrap();
    served.post_with(token, &fleet.path(), &records[0]);
    let reasons = fleet.reasons();
    for part in ["is revoked", "robot one: a record", "of another site", "no token", "not valid"] {
        assert!(reasons.iter().any(|reason| reason.contains(part)), "{part}: {reasons:?}");
    }
    let state = served.state();
    let is_malformed = |refusal: &&Value| refusal["reason"].as_str().unwrap().contains("a record");
    let malformed = state["refusals"].as_array().unwrap().iter().find(is_malformed).unwrap();
    assert_eq!((&malformed["address"], &malformed["count"]), (&json!("127.0.0.1"), &json!(2)));
    let lines = served.server.new_refusals();
    assert_eq!(lines.len(), reasons.len());
    assert!(lines.iter().all(|line| line.starts_with("refused a request from 127.0.0.1")), "{lines:?}");
    assert!(served.server.new_refusals().is_empty(), "each is logged once");
    let shown = format!("{state} {lines:?}");
    for text in [token.as_str(), secret, TOKEN] {
        assert!(!shown.contains(text), "{shown}");
    }
}

#[test]
fn malformed_records_of_a_robot_spoil_nothing() {
    let fleet = Fleet::new();
    let Fleet { served, token, records, .. } = &fleet;
    assert_eq!(fleet.describe(token, "one").0, 200);
    let cut = &records[0][..records[0].len() - 1];
    let mut noise = records[0].clone();
    noise[4..]
        .iter_mut()
        .enumerate()
        .for_each(|(at, byte)| *byte = byte.wrapping_mul(31).wrapping_add(at as u8));
    for body in [cut, &noise, b"\xff\xff\xff\xff", &[&records[0][..], cut].concat()] {
        assert_eq!(served.post_with(token, &fleet.path(), body).0, 422);
    }
    let long = format!("{}Content-Length: 99999999\r\n", bearer(token));
    assert!([400, 413].contains(&served.ask("POST", &fleet.path(), &long, b"").0));
    assert_eq!(served.post_with(token, &fleet.path(), b"").1["acknowledged"], Value::Null);
    assert_eq!(served.post_with(token, &fleet.path(), &records[0]).1["acknowledged"], 0);
}
