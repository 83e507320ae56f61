//! The shared state of a live run. The tracking thread writes into it without ever waiting for a
//! viewer; each viewer reads what is new since its last read.

use crate::ground::TiledGround;
use crate::records::TrackRecords;
pub use crate::shown::{Introduction, Mark, Phase, Status, View};
use odograph::formats::track_record::TrackRecord;
use odograph::mosaic::MosaicSquare;
use serde::Serialize;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Maximum number of marks in a run; later ones are rejected.
const MAX_MARKS: usize = 10_000;
/// Interval at which a viewer polls the ground map for changes.
const GROUND_INTERVAL: Duration = Duration::from_millis(250);

/// The shared state of a run: trajectory, newest camera view, status, marks, notices and ground
/// map.
pub struct Hub {
    introduction: Introduction,
    ground: Arc<dyn TiledGround>,
    seen: Mutex<ViewerState>,
    news: Condvar,
    stop_asked: AtomicBool,
    viewers: AtomicUsize,
    closing: AtomicBool,
}

#[derive(Default)]
struct ViewerState {
    records: TrackRecords,
    view: Option<Arc<View>>,
    views: u64,
    status: Status,
    statuses: u64,
    marks: Vec<Mark>,
    /// Whether the marks are final: they can be neither set nor renamed.
    marks_closed: bool,
    /// Number of changes of the marks; and of those of marks that viewers already have.
    marks_changed: u64,
    marks_renamed: u64,
    /// Number of times that all records were replaced.
    replaced: u64,
    notices: Vec<Notice>,
    notices_sent: u64,
}

/// The newest message of one kind. Each message replaces the previous one of its kind.
struct Notice {
    kind: &'static str,
    number: u64,
    json: Arc<str>,
}

/// Read position of one viewer in the hub's data.
#[derive(Debug, Default)]
pub struct Cursor {
    records: usize,
    replaced: u64,
    view: u64,
    status: u64,
    marks: usize,
    renamed: u64,
    notices: u64,
    ground: u64,
    metres_per_pixel: f64,
    ground_looked: Option<Instant>,
    /// Earliest time for the next camera view (rate limit).
    next_view: Option<Instant>,
}

/// What is new to a viewer since its last read.
#[derive(Debug, Default)]
pub struct News {
    /// Whether all records before are void: the run has its final path.
    pub replaced: bool,
    /// Index of the first new record, and the new records' values, [`TrackRecord::LENGTH`] each.
    pub records: Option<(usize, Vec<f32>)>,
    /// The newest camera view.
    pub view: Option<Arc<View>>,
    /// The run's status, if it changed.
    pub status: Option<Status>,
    /// New and renamed marks, and the index of the first.
    pub marks: (usize, Vec<Mark>),
    /// JSON messages, the newest one of each kind.
    pub notices: Vec<Arc<str>>,
    /// Changed tiles of the ground map, and its ground sampling distance in metres per pixel.
    pub ground: Option<(f64, Vec<MosaicSquare>)>,
}

impl Hub {
    /// Creates a hub that serves `ground` as its map.
    pub fn new(introduction: Introduction, ground: Arc<dyn TiledGround>) -> Self {
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

    /// The constant description of the run.
    pub fn introduction(&self) -> &Introduction {
        &self.introduction
    }

    /// The ground map below the trajectory.
    pub fn ground(&self) -> &dyn TiledGround {
        &*self.ground
    }

    fn seen(&self) -> MutexGuard<'_, ViewerState> {
        self.seen.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Changes what viewers see, and wakes them.
    fn change<T>(&self, change: impl FnOnce(&mut ViewerState) -> T) -> T {
        let outcome = change(&mut self.seen());
        self.news.notify_all();
        outcome
    }

    /// Appends a frame to the trajectory and returns its record index.
    pub fn add_record(&self, record: &TrackRecord) -> usize {
        self.change(|seen| {
            seen.records.push(record);
            seen.records.count() - 1
        })
    }

    /// Replaces the current camera view.
    pub fn show_view(&self, view: View) {
        self.change(|seen| {
            seen.view = Some(Arc::new(view));
            seen.views += 1;
        });
    }

    /// Sets the status of the run.
    pub fn set_status(&self, status: Status) {
        self.change(|seen| {
            if seen.status != status || seen.statuses == 0 {
                seen.status = status;
                seen.statuses += 1;
            }
        });
    }

    /// The status of the run.
    pub fn status(&self) -> Status {
        self.seen().status.clone()
    }

    /// The newest camera view; `None` before the first one.
    pub fn view(&self) -> Option<Arc<View>> {
        self.seen().view.clone()
    }

    /// Adds a mark at the newest frame; returns its index and the mark, `None` if there is no frame
    /// yet, if there are as many marks as there may be, or if they are closed. Control characters
    /// are removed from the name and it is cut at 80 characters; an empty name becomes the mark's
    /// number.
    pub fn mark(&self, name: &str) -> Option<(usize, Mark)> {
        self.change(|seen| {
            let (count, index) = (seen.records.count(), seen.marks.len());
            if count == 0 || index >= MAX_MARKS || seen.marks_closed {
                return None;
            }
            let last = seen.records.from(count - 1);
            let known = |value: f32| value.is_finite().then_some(value);
            let mark = Mark {
                record: count - 1,
                time_s: last[0],
                x_m: known(last[1]),
                y_m: known(last[2]),
                name: mark_name(name, index),
            };
            seen.marks.push(mark.clone());
            seen.marks_changed += 1;
            Some((index, mark))
        })
    }

    /// Gives a mark another name, as [`Hub::mark`] does. Returns `None` if there is no such mark,
    /// or if the marks are closed.
    pub fn rename_mark(&self, index: usize, name: &str) -> Option<Mark> {
        self.change(|seen| {
            let mark = seen.marks.get_mut(index).filter(|_| !seen.marks_closed)?;
            mark.name = mark_name(name, index);
            seen.marks_changed += 1;
            seen.marks_renamed += 1;
            Some(mark.clone())
        })
    }

    /// Number of changes of the marks so far.
    pub fn marks_changed(&self) -> u64 {
        self.seen().marks_changed
    }

    /// Replaces all records by those of the finished run. Their latencies stay, which a finished
    /// run does not have.
    pub fn replace_records(&self, records: &[TrackRecord]) {
        self.change(|seen| {
            let mut fresh = TrackRecords::default();
            for (index, record) in records.iter().enumerate() {
                let mut record = *record;
                if index < seen.records.count() && record.values[TrackRecord::LATENCY].is_nan() {
                    record.values[TrackRecord::LATENCY] = seen.records.from(index)[TrackRecord::LATENCY];
                }
                fresh.push(&record);
            }
            seen.records = fresh;
            seen.replaced += 1;
        });
    }

    /// The marks from index `first` on.
    pub fn marks_from(&self, first: usize) -> Vec<Mark> {
        self.seen().marks.get(first..).unwrap_or_default().to_vec()
    }

    /// Closes the marks before they are written for the last time.
    pub fn close_marks(&self) {
        self.seen().marks_closed = true;
    }

    /// Sets the marks of a finished run, replacing all present ones.
    pub fn set_marks(&self, marks: Vec<Mark>) {
        self.change(|seen| (seen.marks, seen.marks_closed) = (marks, true));
    }

    /// Publishes a message that replaces the previous one of its kind. A page receives `{"kind":
    /// kind, kind: value}`.
    pub fn notify(&self, kind: &'static str, value: &impl Serialize) {
        let json: Arc<str> = serde_json::json!({ "kind": kind, kind: value }).to_string().into();
        self.change(|seen| {
            seen.notices_sent += 1;
            seen.notices.retain(|notice| notice.kind != kind);
            seen.notices.push(Notice { kind, number: seen.notices_sent, json });
        });
    }

    /// Requests the run to stop and write its results.
    pub fn ask_to_stop(&self) {
        self.stop_asked.store(true, Ordering::Relaxed);
    }

    /// Whether [`Hub::ask_to_stop`] was called.
    pub fn stop_asked(&self) -> bool {
        self.stop_asked.load(Ordering::Relaxed)
    }

    /// Number of connected viewers.
    pub fn viewers(&self) -> usize {
        self.viewers.load(Ordering::Relaxed)
    }

    /// Disconnects all viewers.
    pub fn close(&self) {
        self.closing.store(true, Ordering::Relaxed);
        self.news.notify_all();
    }

    /// Whether [`Hub::close`] was called.
    pub fn is_closing(&self) -> bool {
        self.closing.load(Ordering::Relaxed)
    }

    /// Registers a viewer. It is counted until the returned value is dropped.
    pub fn look(self: &Arc<Self>) -> Viewer {
        self.viewers.fetch_add(1, Ordering::Relaxed);
        Viewer { hub: Arc::clone(self), cursor: Cursor::default() }
    }

    /// Minimum interval between two camera views of one viewer. All viewers share 60 views a
    /// second, so that many viewers cost no more than one or two.
    fn view_interval(&self) -> Duration {
        let rate = (60.0 / self.viewers().max(1) as f64).clamp(2.0, 30.0);
        // Ten percent shorter than the nominal interval, because frames arrive with jitter.
        Duration::from_secs_f64(0.9 / rate)
    }

    fn collect(&self, seen: &ViewerState, cursor: &mut Cursor) -> Option<News> {
        let mut news = News::default();
        let mut any = false;
        if seen.replaced != cursor.replaced {
            // One that connects later has nothing to replace.
            news.replaced = cursor.records > 0;
            (cursor.replaced, cursor.records) = (seen.replaced, 0);
            any = true;
        }
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
        // All marks again if one that the viewer has was renamed.
        let first = if seen.marks_renamed == cursor.renamed { cursor.marks } else { 0 };
        if seen.marks.len() > first {
            news.marks = (first, seen.marks[first..].to_vec());
            (cursor.marks, cursor.renamed) = (seen.marks.len(), seen.marks_renamed);
            any = true;
        }
        if seen.notices_sent > cursor.notices {
            let new = seen.notices.iter().filter(|notice| notice.number > cursor.notices);
            news.notices = new.map(|notice| Arc::clone(&notice.json)).collect();
            cursor.notices = seen.notices_sent;
            any = true;
        }
        any.then_some(news)
    }
}

/// The name of the mark with this index: control characters are removed from what a person gave, it
/// is cut at 80 characters, and an empty name becomes the mark's number.
fn mark_name(given: &str, index: usize) -> String {
    let name: String = given.chars().filter(|c| !c.is_control()).take(80).collect();
    if name.trim().is_empty() { format!("{}", index + 1) } else { name.trim().to_owned() }
}

/// A connected viewer with its read position.
pub struct Viewer {
    hub: Arc<Hub>,
    cursor: Cursor,
}

impl Viewer {
    /// Returns what is new, after waiting for it for at most `patience`.
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
        // The ground map has its own lock, which may be held while a frame is orthorectified. The
        // two locks are never held together.
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
    use odograph::mosaic::Mosaic;

    fn hub() -> Arc<Hub> {
        let introduction = Introduction {
            title: "drive".into(),
            source: "a drive".into(),
            width: 4,
            height: 3,
            height_m: 1.0,
            live: true,
            recovered: false,
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
    fn slow_viewers_get_all_records_but_only_the_newest_picture() {
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
        // Each viewer receives the newest notice of a kind once, whenever it reads.
        hub.notify("map", &1);
        hub.notify("board", &2);
        hub.notify("map", &3);
        let notices = |viewer: &mut Viewer| viewer.news(Duration::ZERO).notices.concat();
        assert_eq!(notices(&mut slow), r#"{"board":2,"kind":"board"}{"kind":"map","map":3}"#);
        assert_eq!(notices(&mut slow), "");
        hub.notify("board", &4);
        assert_eq!(notices(&mut slow), r#"{"board":4,"kind":"board"}"#);
        drop(slow);
        assert_eq!(hub.viewers(), 1);
    }

    #[test]
    fn late_viewers_receive_the_whole_path_in_order() {
        let hub = hub();
        let mut early = hub.look();
        let count = 2 * TrackRecords::IN_A_PIECE + 10;
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
    fn marks_are_at_the_newest_frame_and_have_sanitised_names() {
        let hub = hub();
        assert!(hub.mark("too early").is_none());
        hub.add_record(&record(1.5, 2.5));
        assert_eq!(hub.mark(" door\r\n ").unwrap().1.name, "door");
        let (index, unnamed) = hub.mark("").unwrap();
        assert_eq!(index, 1);
        assert_eq!((unnamed.name.as_str(), unnamed.time_s, unnamed.x_m), ("2", 1.5, Some(2.5)));
        hub.add_record(&record(2.0, f32::NAN));
        assert_eq!(hub.mark("lost").unwrap().1.x_m, None);
        assert_eq!(hub.marks_from(1).len(), 2);
        hub.close_marks();
        assert!(hub.mark("after the last that is saved").is_none());
        assert_eq!(hub.marks_from(0).len(), 3);
    }

    #[test]
    fn a_mark_can_be_renamed_until_the_marks_are_closed() {
        let hub = hub();
        hub.add_record(&record(1.5, 2.5));
        let mut viewer = hub.look();
        hub.mark("");
        assert_eq!(viewer.news(Duration::ZERO).marks.1[0].name, "1");
        hub.mark("");
        assert_eq!(hub.rename_mark(0, " gate\n").unwrap().name, "gate");
        assert_eq!(hub.rename_mark(1, " ").unwrap().name, "2");
        let (first, marks) = viewer.news(Duration::ZERO).marks;
        assert_eq!((first, marks[0].name.as_str(), marks.len()), (0, "gate", 2));
        assert!(viewer.news(Duration::ZERO).marks.1.is_empty());
        assert_eq!((hub.marks_changed(), hub.rename_mark(2, "none")), (4, None));
        hub.close_marks();
        assert_eq!(hub.rename_mark(0, "late"), None);
    }

    #[test]
    fn the_final_path_replaces_the_records_and_keeps_their_latencies() {
        let hub = hub();
        let mut viewer = hub.look();
        for k in 0..3 {
            let mut record = record(k as f32, 0.0);
            record.values[TrackRecord::LATENCY] = 4.0 + k as f32;
            hub.add_record(&record);
        }
        viewer.news(Duration::ZERO);
        let finals: Vec<TrackRecord> = (0..3)
            .map(|k| {
                let mut record = record(k as f32, 9.0);
                record.values[TrackRecord::LATENCY] = f32::NAN;
                record
            })
            .collect();
        hub.replace_records(&finals);
        let news = viewer.news(Duration::ZERO);
        let (first, values) = news.records.unwrap();
        assert!(news.replaced && first == 0 && values.len() == 3 * TrackRecord::LENGTH);
        assert_eq!((values[1], values[TrackRecord::LENGTH + TrackRecord::LATENCY]), (9.0, 5.0));
        assert!(!viewer.news(Duration::ZERO).replaced);
        // One that comes later has nothing that is void.
        assert!(!hub.look().news(Duration::ZERO).replaced);
    }
}
