//! What there is to see, in one place. Who tracks puts it there and never waits; who looks takes what is new to him since he last looked.

use crate::ground::Ground;
use crate::record::{Records, TrackRecord};
pub use crate::shown::{Introduction, Mark, Phase, Status, View};
use odograph::mapping::MosaicSquare;
use serde::Serialize;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// More marks than a person sets.
const MOST_MARKS: usize = 10_000;
/// How often the ground is looked at for changes.
const GROUND_INTERVAL: Duration = Duration::from_millis(250);

/// What there is to see.
pub struct Hub {
    introduction: Introduction,
    ground: Arc<dyn Ground>,
    seen: Mutex<Seen>,
    news: Condvar,
    stop_asked: AtomicBool,
    viewers: AtomicUsize,
    closing: AtomicBool,
}

#[derive(Default)]
struct Seen {
    records: Records,
    view: Option<Arc<View>>,
    views: u64,
    status: Status,
    statuses: u64,
    marks: Vec<Mark>,
    notices: Vec<Notice>,
    notices_told: u64,
}

/// The newest of what is told whole each time it changes.
struct Notice {
    kind: &'static str,
    number: u64,
    json: Arc<str>,
}

/// How far somebody has looked.
#[derive(Debug, Default)]
pub struct Cursor {
    records: usize,
    view: u64,
    status: u64,
    marks: usize,
    notices: u64,
    ground: u64,
    metres_per_pixel: f64,
    ground_looked: Option<Instant>,
    /// Not before then the next picture.
    next_view: Option<Instant>,
}

/// What is new to somebody.
#[derive(Debug, Default)]
pub struct News {
    /// The number of the first new record, and the records.
    pub records: Option<(usize, Vec<f32>)>,
    /// The newest picture.
    pub view: Option<Arc<View>>,
    /// How the run goes.
    pub status: Option<Status>,
    /// New marks.
    pub marks: Vec<Mark>,
    /// Messages in JSON, each the newest of its kind.
    pub notices: Vec<Arc<str>>,
    /// Squares of the ground that changed, and the side of a ground pixel, metres.
    pub ground: Option<(f64, Vec<MosaicSquare>)>,
}

impl Hub {
    /// A hub over a ground.
    pub fn new(introduction: Introduction, ground: Arc<dyn Ground>) -> Self {
        Self {
            introduction,
            ground,
            seen: Mutex::default(),
            news: Condvar::new(),
            stop_asked: AtomicBool::new(false),
            viewers: AtomicUsize::new(0),
            closing: AtomicBool::new(false),
        }
    }

    /// What does not change.
    pub fn introduction(&self) -> &Introduction {
        &self.introduction
    }

    /// The ground under the path.
    pub fn ground(&self) -> &dyn Ground {
        &*self.ground
    }

    fn seen(&self) -> MutexGuard<'_, Seen> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds a frame. Gives its number among the records.
    pub fn add_record(&self, record: &TrackRecord) -> usize {
        let mut seen = self.seen();
        seen.records.push(record);
        let number = seen.records.count() - 1;
        drop(seen);
        self.news.notify_all();
        number
    }

    /// Shows a picture in place of the one before.
    pub fn show_view(&self, view: View) {
        let mut seen = self.seen();
        seen.view = Some(Arc::new(view));
        seen.views += 1;
        drop(seen);
        self.news.notify_all();
    }

    /// Tells how the run goes.
    pub fn set_status(&self, status: Status) {
        let mut seen = self.seen();
        if seen.status != status || seen.statuses == 0 {
            seen.status = status;
            seen.statuses += 1;
        }
        drop(seen);
        self.news.notify_all();
    }

    /// How the run goes.
    pub fn status(&self) -> Status {
        self.seen().status.clone()
    }

    /// The newest picture.
    pub fn view(&self) -> Option<Arc<View>> {
        self.seen().view.clone()
    }

    /// Marks the place of the newest frame; `None` where there is none yet, or far too many marks.
    pub fn mark(&self, name: &str) -> Option<Mark> {
        let mut seen = self.seen();
        let count = seen.records.count();
        if count == 0 || seen.marks.len() >= MOST_MARKS {
            return None;
        }
        let last = seen.records.from(count - 1);
        let known = |value: f32| value.is_finite().then_some(value);
        let name: String = name.chars().filter(|c| !c.is_control()).take(80).collect();
        let mark = Mark {
            record: count - 1,
            time_s: last[0],
            x_m: known(last[1]),
            y_m: known(last[2]),
            name: if name.trim().is_empty() {
                format!("{}", seen.marks.len() + 1)
            } else {
                name.trim().to_owned()
            },
        };
        seen.marks.push(mark.clone());
        drop(seen);
        self.news.notify_all();
        Some(mark)
    }

    /// The marks from a number on.
    pub fn marks_from(&self, first: usize) -> Vec<Mark> {
        self.seen().marks.get(first..).unwrap_or_default().to_vec()
    }

    /// Puts back the marks of a finished run.
    pub fn set_marks(&self, marks: Vec<Mark>) {
        self.seen().marks = marks;
        self.news.notify_all();
    }

    /// Tells something that is whole in itself, in place of what was told of its kind before: a page gets `{"kind": kind, kind: value}`.
    pub fn tell(&self, kind: &'static str, value: &impl Serialize) {
        let json: Arc<str> = serde_json::json!({ "kind": kind, kind: value }).to_string().into();
        let mut seen = self.seen();
        seen.notices_told += 1;
        let number = seen.notices_told;
        seen.notices.retain(|notice| notice.kind != kind);
        seen.notices.push(Notice { kind, number, json });
        drop(seen);
        self.news.notify_all();
    }

    /// Asks the run to end and to write everything.
    pub fn ask_to_stop(&self) {
        self.stop_asked.store(true, Ordering::Relaxed);
    }

    /// Whether the run was asked to end.
    pub fn stop_asked(&self) -> bool {
        self.stop_asked.load(Ordering::Relaxed)
    }

    /// How many look.
    pub fn viewers(&self) -> usize {
        self.viewers.load(Ordering::Relaxed)
    }

    /// Lets everybody go who looks.
    pub fn close(&self) {
        self.closing.store(true, Ordering::Relaxed);
        self.news.notify_all();
    }

    /// Whether nobody shall look any more.
    pub fn is_closing(&self) -> bool {
        self.closing.load(Ordering::Relaxed)
    }

    /// Somebody begins to look; counted until the value is dropped.
    pub fn look(self: &Arc<Self>) -> Viewer {
        self.viewers.fetch_add(1, Ordering::Relaxed);
        Viewer { hub: Arc::clone(self), cursor: Cursor::default() }
    }

    /// Pictures a second for each of those who look: sixty for all together, so that many cost no more than one or two.
    fn view_interval(&self) -> Duration {
        let rate = (60.0 / self.viewers().max(1) as f64).clamp(2.0, 30.0);
        // A little less than the interval of 30 pictures a second, which do not come evenly.
        Duration::from_secs_f64(0.9 / rate)
    }

    fn collect(&self, seen: &Seen, cursor: &mut Cursor) -> Option<News> {
        let mut news = News::default();
        let mut any = false;
        if seen.records.count() > cursor.records {
            let records = seen.records.from(cursor.records).to_vec();
            let next = cursor.records + records.len() / TrackRecord::LENGTH;
            news.records = Some((cursor.records, records));
            cursor.records = next;
            any = true;
        }
        let now = Instant::now();
        if seen.views > cursor.view && cursor.next_view.is_none_or(|next| now >= next) {
            news.view = seen.view.clone();
            cursor.view = seen.views;
            cursor.next_view = Some(now + self.view_interval());
            any = true;
        }
        if seen.statuses > cursor.status {
            news.status = Some(seen.status.clone());
            cursor.status = seen.statuses;
            any = true;
        }
        if seen.marks.len() > cursor.marks {
            news.marks = seen.marks[cursor.marks..].to_vec();
            cursor.marks = seen.marks.len();
            any = true;
        }
        if seen.notices_told > cursor.notices {
            let new = seen.notices.iter().filter(|notice| notice.number > cursor.notices);
            news.notices = new.map(|notice| Arc::clone(&notice.json)).collect();
            cursor.notices = seen.notices_told;
            any = true;
        }
        any.then_some(news)
    }
}

/// Somebody who looks.
pub struct Viewer {
    hub: Arc<Hub>,
    cursor: Cursor,
}

impl Viewer {
    /// What is new; waits for it at most so long.
    pub fn news(&mut self, patience: Duration) -> News {
        let until = Instant::now() + patience;
        let mut seen = self.hub.seen();
        let mut news = loop {
            if let Some(news) = self.hub.collect(&seen, &mut self.cursor) {
                break news;
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() || self.hub.is_closing() {
                break News::default();
            }
            seen = self.hub.news.wait_timeout(seen, left).unwrap_or_else(PoisonError::into_inner).0;
        };
        drop(seen);
        // The ground has a lock of its own, which may be held while a frame is laid: never both.
        if self.cursor.ground_looked.is_none_or(|looked| looked.elapsed() >= GROUND_INTERVAL) {
            self.cursor.ground_looked = Some(Instant::now());
            news.ground = self.ground_news();
        }
        news
    }

    fn ground_news(&mut self) -> Option<(f64, Vec<MosaicSquare>)> {
        let state = self.hub.ground.state()?;
        let cursor = &mut self.cursor;
        if state.metres_per_pixel != cursor.metres_per_pixel {
            (cursor.ground, cursor.metres_per_pixel) = (0, state.metres_per_pixel);
        } else if state.revision == cursor.ground {
            return None;
        }
        let changed = self.hub.ground.changed_since(cursor.ground);
        cursor.ground = state.revision;
        Some((state.metres_per_pixel, changed))
    }
}

impl Drop for Viewer {
    fn drop(&mut self) {
        self.hub.viewers.fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use odograph::mapping::Mosaic;

    fn hub() -> Arc<Hub> {
        let introduction = Introduction {
            title: "drive".into(),
            source: "a drive".into(),
            width: 4,
            height: 3,
            height_m: 1.0,
            live: true,
            calibration: false,
        };
        Arc::new(Hub::new(introduction, Arc::new(Mutex::new(Mosaic::new(Default::default())))))
    }

    fn record(time_s: f32, x_m: f32) -> TrackRecord {
        let mut values = [0.0; TrackRecord::LENGTH];
        (values[0], values[1]) = (time_s, x_m);
        TrackRecord { values }
    }

    #[test]
    fn each_takes_what_is_new_to_him_and_the_slow_one_only_the_newest_picture() {
        let hub = hub();
        let (mut quick, mut slow) = (hub.look(), hub.look());
        assert_eq!(hub.viewers(), 2);
        for k in 0..3 {
            assert_eq!(hub.add_record(&record(k as f32, 0.0)), k);
            hub.show_view(View { record: k, jpeg: vec![k as u8], tracks: Vec::new() });
            let (first, records) = quick.news(Duration::ZERO).records.unwrap();
            assert_eq!((first, records.len()), (k, TrackRecord::LENGTH));
        }
        let news = slow.news(Duration::ZERO);
        assert_eq!(news.records.unwrap().1.len(), 3 * TrackRecord::LENGTH);
        assert_eq!(news.view.unwrap().jpeg, [2]);
        assert!(slow.news(Duration::ZERO).records.is_none());
        // Of what is told whole each hears the newest once, whenever he comes.
        hub.tell("map", &1);
        hub.tell("board", &2);
        hub.tell("map", &3);
        let told = |viewer: &mut Viewer| viewer.news(Duration::ZERO).notices.concat();
        assert_eq!(told(&mut slow), r#"{"board":2,"kind":"board"}{"kind":"map","map":3}"#);
        assert_eq!(told(&mut slow), "");
        hub.tell("board", &4);
        assert_eq!(told(&mut slow), r#"{"board":4,"kind":"board"}"#);
        drop(slow);
        assert_eq!(hub.viewers(), 1);
    }

    #[test]
    fn a_long_path_comes_whole_and_in_order_however_late_somebody_looks() {
        let hub = hub();
        let mut early = hub.look();
        let count = 2 * Records::IN_A_PIECE + 10;
        let mut met = 0;
        for k in 0..count {
            hub.add_record(&record(k as f32, 0.0));
            if k % 1000 == 0 {
                met += early.news(Duration::ZERO).records.unwrap().1.len() / TrackRecord::LENGTH;
            }
        }
        let mut late = hub.look();
        let mut next = 0;
        while let Some((first, records)) = late.news(Duration::ZERO).records {
            assert_eq!(first, next);
            for record in records.chunks_exact(TrackRecord::LENGTH) {
                assert_eq!(record[0], next as f32);
                next += 1;
            }
        }
        assert_eq!(next, count);
        while let Some((first, records)) = early.news(Duration::ZERO).records {
            assert_eq!(first, met);
            met += records.len() / TrackRecord::LENGTH;
        }
        assert_eq!(met, count);
    }

    #[test]
    fn a_mark_is_where_the_newest_frame_is_and_has_a_harmless_name() {
        let hub = hub();
        assert!(hub.mark("too early").is_none());
        hub.add_record(&record(1.5, 2.5));
        assert_eq!(hub.mark(" door\r\n ").unwrap().name, "door");
        let unnamed = hub.mark("").unwrap();
        assert_eq!((unnamed.name.as_str(), unnamed.time_s, unnamed.x_m), ("2", 1.5, Some(2.5)));
        hub.add_record(&record(2.0, f32::NAN));
        assert_eq!(hub.mark("lost").unwrap().x_m, None);
        assert_eq!(hub.marks_from(1).len(), 2);
    }
}
