//! Results of the merging thread, for the threads that answer requests.

use crate::fleet_map::FleetMap;
use crate::protocol::{MapFromOdom, RobotState, SiteStatus};
use crate::records::RecordStore;
use odograph::error::Result;
use odograph_map::SessionOrigin;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// Time without a message after which a robot is shown as silent.
const SILENT_AFTER: Duration = Duration::from_secs(30);
/// Maximum number of points of a session's path on the page; longer paths are thinned.
const MAX_POINTS: usize = 4000;

/// The state of the site as of the last merged record.
#[derive(Debug, Default)]
pub struct Published {
    pub version: u64,
    placements: BTreeMap<SessionOrigin, MapFromOdom>,
    robots: BTreeMap<String, (RobotState, Option<String>)>,
    sessions: Vec<PublishedSession>,
    /// Ends of the loops between sessions: x and y of both, metres.
    loops: Vec<[f64; 4]>,
    /// When a robot last reported, and whether it reported that it is lost.
    heard: BTreeMap<SessionOrigin, (Instant, bool)>,
    /// Number of renderings of the mosaic.
    pub mosaic: u64,
    /// The error that keeps merging from going on, if any.
    pub failure: Option<String>,
}

#[derive(Debug)]
struct PublishedSession {
    origin: SessionOrigin,
    source: String,
    ended: bool,
    records: Option<u64>,
    keyframes: usize,
    connected: bool,
    loops: usize,
    scale: Option<(f64, f64)>,
    /// Why it is probably wrong about itself, if it is.
    doubt: Option<String>,
    /// x, y, and heading of the keyframes in the map.
    path: Vec<[f64; 3]>,
}

impl Published {
    /// Takes over the state of store and map.
    pub fn update(&mut self, records: &RecordStore, map: Option<&FleetMap>) -> Result<()> {
        self.version = records.version()?;
        self.robots =
            records.robots()?.into_iter().map(|(name, state, reason)| (name, (state, reason))).collect();
        let loops: Vec<_> = map.map(|map| map.shared_loops().collect()).unwrap_or_default();
        let mut sessions = Vec::new();
        self.placements.clear();
        for session in records.sessions()? {
            let origin = session.description.origin()?;
            let mapped = map.and_then(|map| Some((map, map.session(&origin)?)));
            let placement = mapped.and_then(|(map, mapped)| map.placement(mapped));
            let number = mapped.map(|(_, mapped)| mapped.session);
            let own = mapped.map(|(map, _)| map.map().keyframes.iter());
            let own: Vec<_> =
                own.into_iter().flatten().filter(|keyframe| Some(keyframe.session) == number).collect();
            let every = own.len().div_ceil(MAX_POINTS).max(1);
            // The last one is always shown: that is where the robot is.
            let shown = own.iter().rev().step_by(every).rev();
            let millimetres = |value: f64| (1000.0 * value).round() / 1000.0;
            let scale = mapped.and_then(|(map, mapped)| map.scale(mapped));
            let own_loops = loops
                .iter()
                .filter(|(one, other)| [one.session, other.session].map(Some).contains(&number))
                .count();
            // A right robot is connected by the second place.
            let doubt = scale.filter(|_| own_loops == 0).map(|scale| {
                format!(
                    "its ground was recognised at {} places, and no two of them agree on where it is: check its lens, \
                     focal length, height and mount",
                    scale.places
                )
            });
            sessions.push(PublishedSession {
                source: session.description.source.clone(),
                ended: session.ended,
                records: records.last(session.id)?,
                keyframes: own.len(),
                connected: placement.is_some(),
                loops: own_loops,
                doubt,
                scale: scale.map(|scale| (scale.ratio, scale.deviation)),
                path: shown
                    .map(|keyframe| {
                        let pose = &keyframe.pose;
                        [pose.x_m, pose.y_m, pose.heading_rad].map(millimetres)
                    })
                    .collect(),
                origin: origin.clone(),
            });
            self.placements.extend(placement.map(|placement| (origin, placement)));
        }
        self.sessions = sessions;
        self.loops = loops
            .iter()
            .map(|(one, other)| [one.pose.x_m, one.pose.y_m, other.pose.x_m, other.pose.y_m])
            .collect();
        Ok(())
    }

    /// Records that a robot has reported.
    pub fn heard(&mut self, origin: &SessionOrigin, lost: bool) {
        self.heard.insert(origin.clone(), (Instant::now(), lost));
    }

    /// What is answered to a robot.
    pub fn status(&self, origin: &SessionOrigin) -> SiteStatus {
        let (state, reason) = self.robots.get(&origin.robot).cloned().unwrap_or_default();
        SiteStatus {
            acknowledged: None,
            ended: false,
            version: self.version,
            state,
            reason,
            map_from_odom: self.placements.get(origin).copied(),
        }
    }

    /// Everything for the page.
    pub fn page(&self) -> Value {
        let session = |session: &PublishedSession| {
            let heard = self.heard.get(&session.origin);
            let following = heard.is_some_and(|(at, _)| at.elapsed() < SILENT_AFTER);
            json!({
                "robot": session.origin.robot,
                "key": session.origin.key,
                "source": session.source,
                "condition": match heard {
                    _ if session.ended => "ended",
                    Some((_, true)) if following => "lost",
                    _ if following => "following",
                    _ => "silent",
                },
                "records": session.records.map_or(0, |last| last + u64::from(!session.ended)),
                "keyframes": session.keyframes,
                "connected": session.connected,
                "loops": session.loops,
                "scale": session.scale.map(|(ratio, deviation)| json!({ "ratio": ratio, "deviation": deviation })),
                "doubt": session.doubt,
                "path": session.path,
            })
        };
        let robots: BTreeMap<&String, Value> = self
            .robots
            .iter()
            .map(|(name, (state, reason))| (name, json!({ "state": state, "reason": reason })))
            .collect();
        json!({
            "version": self.version,
            "mosaic": self.mosaic,
            "failure": self.failure,
            "robots": robots,
            "sessions": self.sessions.iter().map(session).collect::<Vec<_>>(),
            "loops": self.loops,
        })
    }
}
